"""``pbonet sem``, ``queue``, ``mailbox``, ``file`` on one machine, without agents."""

from __future__ import annotations

import json
import os
import subprocess
import threading
from contextlib import closing

import pytest

from pbonet import xm
from pbonet.cli import completing
from pbonet.xm.ipc import names

DOMAIN = "t-mail"


@pytest.fixture(autouse=True)
def home(monkeypatch, tmp_path):
    """A domain without agents, which names of this process belong to."""
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path))
    monkeypatch.setenv("PBONET_DOMAIN", DOMAIN)
    with names.living_on(names.NOWHERE, domain=DOMAIN):
        yield


@pytest.fixture
def ask(call):
    """Call a verb that must do its work; return its data."""

    def run(*words):
        status, out, err = call(*words, "--json")
        assert status == 0, out + err
        return json.loads(out)

    return run


def fault(call, *words):
    """Return the error of a verb that must fail."""
    status, out, _ = call(*words, "--json")
    assert status == 1
    return json.loads(out)["error"]


def test_a_semaphore_is_made_taken_given_listed_and_removed(call, ask):
    ask("sem", "new", "parts", "--initial", 1, "--maximum", 2)
    ask("sem", "get", "parts")
    error = fault(call, "sem", "get", "parts", "--wait", 0.01)
    assert error["what"] == "the semaphore was not free within 0.01 s"
    assert "--wait" in error["remedy"]
    assert ask("sem", "put", "parts")["value"] == 1
    assert ask("sem", "put", "parts")["value"] == 2
    assert "at its maximum" in fault(call, "sem", "put", "parts")["what"]
    (one,) = ask("sem", "ls")["resources"]
    assert (one["name"], one["value"], one["settings"]["maximum"]) == (
        "local:parts",
        2,
        2,
    )
    status, out, _ = call("sem", "ls", "local")
    assert (status, out.splitlines()[0].split()[:3]) == (
        0,
        ["name", "value", "maximum"],
    )
    ask("sem", "rm", "parts")
    assert ask("sem", "ls")["resources"] == []
    assert fault(call, "sem", "rm", "parts")["code"] == "XM_MISSING"


def test_a_waiting_verb_gets_what_another_process_gives(ask):
    ask("sem", "new", "go", "--initial", 0)
    with closing(xm.Semaphore.attach("go")) as go:
        done = threading.Event()

        def give():
            while not go.waiting and not done.is_set():
                done.wait(0.001)
            go.v()

        giver = threading.Thread(target=give)
        giver.start()
        try:
            ask("sem", "get", "go", "--wait", 60)
        finally:
            done.set()
            giver.join()
    ask("sem", "rm", "go")


def test_a_command_holds_a_binary_semaphore(call, ask, tmp_path):
    ask("sem", "new", "grip", "--binary")
    assert "binary semaphore" in fault(call, "sem", "get", "grip")["what"]
    seen = tmp_path / "seen"
    command = f"touch {seen}; exit 7"
    assert call("sem", "get", "grip", "--run", command)[0] == 7
    assert seen.exists()
    (one,) = ask("sem", "ls")["resources"]
    assert (one["value"], one["holder"]) == (1, None), "it was given back"
    ask("sem", "rm", "grip")


def test_messages_go_through_a_queue_by_priority(call, ask, tmp_path):
    ask("queue", "new", "orders", "--policy", "hpf", "--messages", 3)
    ask("queue", "put", "orders", "later")
    ask("queue", "put", "orders", "now", "--priority", 2)
    ask("queue", "put", "orders", "--hex", "ff00")
    error = fault(call, "queue", "put", "orders", "no room")
    assert error["code"] == "XM_QUEUE_FULL"
    done = ask("queue", "put", "orders", "no room", "--full", "drop")
    assert done["sent"] is False
    (one,) = ask("queue", "ls")["resources"]
    assert (one["value"], one["sent"], one["dropped"]) == (3, 3, 1)
    assert call("queue", "get", "orders")[1] == "now\n"
    found = ask("queue", "get", "orders", "--count", 9)["messages"]
    assert [one["text"] for one in found] == ["later", None]
    assert found[1]["hex"] == "ff00"
    assert "no message came" in fault(call, "queue", "get", "orders")["what"]
    (tmp_path / "in").write_bytes(bytes(range(256)))
    ask("queue", "new", "raw", "--block", 512)
    ask("queue", "put", "raw", "--file", tmp_path / "in")
    lost = tmp_path / "no" / "out"
    assert fault(call, "queue", "get", "raw", "-o", lost)["code"] == "CONFIG_FILE"
    ask("queue", "get", "raw", "-o", tmp_path / "out")
    assert (tmp_path / "out").read_bytes() == bytes(range(256)), "it was still there"
    for name in ("orders", "raw"):
        ask("queue", "rm", name)
    assert call("queue", "put", "orders")[0] == 2
    assert call("queue", "put", "orders", "a", "--hex", "00")[0] == 2
    assert call("queue", "put", "orders", "--hex", "0")[0] == 2


def test_interrupts_reach_a_mailbox_and_wait_for_a_handler(call, ask):
    assert fault(call, "mailbox", "put", "door")["code"] == "XM_MISSING"
    with closing(xm.Mailbox("door", depth=2)):
        ask("mailbox", "put", "door", 3)
        ask("mailbox", "put", "door", -4)
        assert fault(call, "mailbox", "put", "door")["code"] == "XM_QUEUE_FULL"
        assert fault(call, "mailbox", "get", "door")["code"] == "XM_LAYOUT"
        (one,) = ask("mailbox", "ls")["resources"]
        assert (one["name"], one["value"], one["dropped"], one["holder"]) == (
            "local:door",
            2,
            1,
            os.getpid(),
        )
    ask("mailbox", "rm", "door")
    assert fault(call, "mailbox", "rm", "door")["code"] == "XM_MISSING"
    with closing(xm.Mailbox("bell")):
        assert fault(call, "mailbox", "get", "bell")["code"] == "XM_TAKEN"
        ask("mailbox", "put", "bell", 5)
    assert ask("mailbox", "get", "bell", "--count", 3)["values"] == [5]
    assert "no interrupt came" in fault(call, "mailbox", "get", "bell")["what"]
    assert fault(call, "mailbox", "put", "bell", 2**70)["code"] == "XM"
    ask("mailbox", "rm", "bell")


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("sem", "ls", "arm9"), "UNREACHABLE"),
        (("sem", "get", "no name"), "XM_NAME"),
        (("queue", "new", "big", "--messages", 2**40), "XM"),
        (("sem", "get", "arm9:x"), "UNREACHABLE"),
        (("mailbox", "get", "arm9:x"), "XM_NAME"),
        (("file", "rm", "arm9"), "XM_NAME"),
        (("file", "put", "/nowhere/at/all", "arm9/x"), "CONFIG_FILE"),
        (("file", "put", "/", "arm9/x"), "CONFIG_FILE"),
        (("file", "ls", "arm9/x"), "UNREACHABLE"),
    ],
)
def test_faults_have_a_code_and_a_remedy(call, words, code):
    error = fault(call, *words)
    assert error["code"] == code
    assert error["remedy"]


def test_the_shell_is_offered_names_of_this_machine(ask):
    ask("sem", "new", "parts")
    ask("queue", "new", "orders")
    with closing(xm.Mailbox("door")):
        offered = {
            kind: list(completing.lines("bash", (kind, "rm", "")))
            for kind in ("sem", "queue", "mailbox")
        }
    assert offered == {
        "sem": ["local:parts"],
        "queue": ["local:orders"],
        "mailbox": ["local:door"],
    }
    for kind, name in (("sem", "parts"), ("queue", "orders"), ("mailbox", "door")):
        ask(kind, "rm", name)


def test_a_new_one_takes_no_others_place(call, ask):
    ask("queue", "new", "orders", "--messages", 1)
    ask("queue", "put", "orders", "fetch")
    assert "--full" in fault(call, "queue", "put", "orders", "more")["remedy"]
    error = fault(call, "queue", "new", "orders")
    assert (error["code"], "pbonet queue rm orders" in error["remedy"]) == (
        "XM_EXISTS",
        True,
    )
    assert ask("queue", "get", "orders")["messages"][0]["text"] == "fetch"
    ask("sem", "new", "grip", "--binary")
    assert fault(call, "sem", "new", "grip")["code"] == "XM_EXISTS"
    ask("queue", "rm", "orders")
    ask("sem", "rm", "grip")


@pytest.mark.parametrize(
    "words",
    [
        ("queue", "put", "q", "x", "--priority", 2**31),
        ("queue", "get", "q", "--priority", 2**31),
        ("sem", "get", "s", "--priority", -(2**31) - 1),
    ],
)
def test_priorities_have_32_bits(call, words):
    status, _, err = call(*words)
    assert (status, "--priority must be at" in err) == (2, True)


def test_an_interrupt_is_for_the_command_which_holds_it_until_it_ends(
    call, ask, monkeypatch
):
    ask("sem", "new", "grip", "--binary")
    wait, values = subprocess.Popen.wait, []

    def interrupted(process, timeout=None):
        if not values:
            values.append(ask("sem", "ls")["resources"][0]["value"])
            raise KeyboardInterrupt
        return wait(process, timeout)

    monkeypatch.setattr(subprocess.Popen, "wait", interrupted)
    assert call("sem", "get", "grip", "--run", "kill -TERM $$")[0] == 128 + 15
    assert values == [0]
    assert ask("sem", "ls")["resources"][0]["value"] == 1
    ask("sem", "rm", "grip")


def test_a_device_or_a_link_stays_what_it_is(ask, tmp_path):
    ask("queue", "new", "q")
    ask("queue", "put", "q", "news")
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "target")
    ask("queue", "get", "q", "--out", link)
    assert link.is_symlink()
    assert (tmp_path / "target").read_text() == "news"
    ask("queue", "rm", "q")
