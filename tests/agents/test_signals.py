"""Signals of real tasks: counted under load, masked, waited for by a master."""

import json
import re
import signal
import subprocess
import sys
import threading

import pytest
from nodekit import rmod
from watching import wait_for

from pbonet.errors import ClaimError, NoAnswerError, StateError, UnknownTaskError
from pbonet.master.configuration.environment import Place
from pbonet.master.console import oneshot
from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.xm.net import messages as m

TASKS = 8
TOTAL = 1252
"""Signals of each task; 10,016 in all."""


def sent(arm, task):
    return arm.status(task).signals


@pytest.fixture
def program(nodes, tmp_path):
    """An open subsystem of its own files, with tasks that talk and flood."""
    nodes.agent_process("arm0")
    (tmp_path / "t.svar").write_text(
        "".join(
            f"NAME Y{n}\nTYPE double\nDESC y\nUNITS none\nNELEM 2\n\n" for n in range(4)
        )
        + "EOF\n"
    )
    for n, (name, module, freq, local) in enumerate((
        ("talks", "talks", 200.0, None),
        ("floods", "floods", 200.0, {"TOTAL": 30}),
        ("dies", "segfaults", 200.0, None),
        ("raises", "recovers", 1000.0, None),
    )):
        text = rmod(module, out=f"Y{n}", freq=freq, local=local)
        (tmp_path / f"{name}.rmod").write_text(text)
    (tmp_path / "t.sbs").write_text(
        "SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nUSAGE exclusive\nEOF\n"
    )
    libraries = [*nodes.config("x").libraries]
    with Subsystem(
        tmp_path / "t.sbs", domain=nodes.domain, libraries=libraries
    ) as subsystem:
        yield subsystem


def follow(program, *words):
    command = ["events", str(program.files.path), "--follow", "--json", *words]
    command += ["--domain", program.domain]
    return subprocess.Popen(
        [sys.executable, "-m", "pbonet.cli", *command],
        stdout=subprocess.PIPE,
        text=True,
    )


class TestCounts:
    """What a task sends is counted where nothing can be dropped."""

    def test_no_signal_is_lost_under_load(self, arm):
        for n in range(TASKS):
            local = {"TOTAL": TOTAL, "BURST": 100}
            arm.spawn(f"f{n}", "floods", out=f"Y{n}", freq=50.0, local=local)
        arm.ask(m.Reconfig(items=[(f"f{n}", "on") for n in range(TASKS)]))
        for n in range(TASKS):
            wait_for(
                lambda n=n: sum(sent(arm, f"f{n}").values()) == TOTAL,
                f"all signals of f{n}",
            )
        found = arm.status()
        counts = [found[f"f{n}"].signals for n in range(TASKS)]
        assert sum(sum(one.values()) for one in counts) == TASKS * TOTAL > 10_000
        for one in counts:
            assert (one["DROP"], one["FINISH"], one["WARNING"]) == (418, 417, 417)
        held = [e for e in arm.events() if e.code in {"SIGNAL", "WARNING"}]
        assert len(held) < TASKS * TOTAL / 2  # most notices did not become events

    def test_events_account_for_what_notices_did_not_tell(self, arm):
        arm.spawn("f", "floods", freq=50.0, local={"TOTAL": 3000, "BURST": 1000})
        arm.on("f")

        def told():
            total = 0
            for event in arm.events(task="f"):
                if event.code == "SIGNALS":
                    text = event.text.removeprefix("not reported individually: ")
                    total += sum(int(part.split()[0]) for part in text.split(", "))
                elif event.bits:
                    total += 1
                elif joined := re.match(r"\[(\d+) more in ", event.text):
                    total += int(joined[1])
            return total

        wait_for(lambda: told() == 3000, "3000 signals in events")
        events = [e for e in arm.events(task="f") if e.bits]
        assert len(events) < 1500
        assert {e.code for e in events} == {"SIGNAL", "WARNING", "SIGNALS"}

    def test_a_death_counts_as_error_and_the_rest_stands(self, arm):
        arm.spawn("d", "segfaults")
        arm.on("d")
        wait_for(lambda: arm.status("d").state == "NOT-CREATED", "its death")
        assert sent(arm, "d")["ERROR"] == 1

    def test_masks_of_task_and_subsystem(self, arm):
        arm.ask(m.Sigmask(names=["WARNING", "DROP"]))
        arm.spawn("a", "floods", out="Y0", local={"TOTAL": 300})
        arm.spawn("b", "floods", out="Y1", local={"TOTAL": 300})
        got = arm.ask(m.Sigmask(task="b", names=["FINISH"]), dict[str, list[str]])
        assert got == {"": ["WARNING", "DROP"], "b": ["FINISH"]}
        arm.on("a")
        arm.on("b")
        wait_for(lambda: sent(arm, "a")["FINISH"] == 100, "the signals of a")
        wait_for(lambda: sent(arm, "b")["DROP"] == 100, "the signals of b")
        wait_for(lambda: arm.value("Y0").values[0] == 300, "the end of a")
        wait_for(lambda: arm.value("Y1").values[0] == 300, "the end of b")
        a, b = sent(arm, "a"), sent(arm, "b")
        assert (a["WARNING"], a["DROP"], a["FINISH"]) == (0, 0, 100)
        assert (b["WARNING"], b["DROP"], b["FINISH"]) == (100, 100, 0)
        assert arm.ask(m.Sigmask(task="b", unset=True)) == {"": ["WARNING", "DROP"]}
        arm.stop()
        arm.ask(m.Release())


class TestSigwait:
    """A program, and the prompt's commands, wait for what tasks tell."""

    def test_in_the_order_of_a_run_and_by_name(self, program):
        program.spawn("talks")
        program.control("talks", "on")
        for name in ("WARNING", "FINISH", "HALFWAY", "OFF"):
            one = program.sigwait([name], task=["talks"], timeout=30.0)
            assert (one.task, one.signal, one.count, one.rtpu) == (
                *("talks", name),
                *(1, "arm0"),
            )
        assert program.signals() == []

    def test_what_is_not_waited_for_stays_pending(self, program):
        program.spawn("talks")
        program.control("talks", "on")
        assert program.sigwait(["OFF"], timeout=30.0).signal == "OFF"
        rest = {(one.signal, one.count) for one in program.signals()}
        assert rest == {("WARNING", 1), ("FINISH", 1), ("HALFWAY", 1)}

    def test_repeats_are_counted_over_several_waits(self, program):
        program.spawn("floods")
        program.spawn("talks")
        program.control("floods", "on")
        program.control("talks", "on")
        got = 0
        while got < 10:
            got += program.sigwait(["DROP"], timeout=30.0).count
        assert got == 10
        with pytest.raises(NoAnswerError, match=r"floods: no signal DROP within 0 s"):
            program.sigwait(["DROP"], task=["floods"], timeout=0.0)

    def test_a_death_is_an_error_and_comes_first(self, program):
        program.spawn("dies")
        program.control("dies", "on")
        one = program.sigwait(["FINISH", "ERROR"], timeout=30.0)
        assert (one.task, one.signal) == ("dies", "ERROR")

    def test_each_death_is_told_though_the_task_is_spawned_anew(self, program):
        for _ in range(3):
            program.spawn("dies")
            program.control("dies", "on")
            one = program.sigwait(["ERROR"], timeout=30.0)
            assert (one.task, one.count) == ("dies", 1)

    def test_a_death_is_told_behind_the_next_spawn(self, program):
        for n in range(2):
            program.spawn("dies")
            program.control("dies", "on")
            wait_for(lambda n=n: len(program.events(code="TASK_DIED")) > n, "its death")
        program.spawn("dies")
        one = program.sigwait(["ERROR"], timeout=0.0)
        assert (one.task, one.count) == ("dies", 2)

    def test_a_dead_task_that_is_killed_takes_its_error_along(self, program):
        program.spawn("dies")
        program.control("dies", "on")
        program.spawn("talks")
        wait_for(lambda: program.events(code="TASK_DIED"), "its death")
        assert program.signals()
        with pytest.raises(UnknownTaskError):
            program.reconfig([("dies", "off"), ("talks", "kill")])
        items = [("talks", "kill"), ("dies", "kill")]
        assert program.reconfig(items) == dict.fromkeys(dict(items), "NOT-CREATED")
        assert [one.task for one in program.status()] == []
        program.spawn("dies")
        assert program.signals() == []

    def test_a_task_spawned_anew_begins_anew(self, program):
        for _ in range(2):
            program.spawn("talks")
            program.control("talks", "on")
            assert program.sigwait(["HALFWAY"], timeout=30.0).count == 1
            program.control("talks", "kill")

    def test_refusals(self, program):
        program.spawn("talks")
        with pytest.raises(
            StateError, match=r"no task has a signal HALFWY .*HALFWAY\?"
        ):
            program.sigwait(["HALFWY"])
        with pytest.raises(UnknownTaskError):
            program.sigwait(task=["nobody"])
        with pytest.raises(StateError, match="no task has a signal NONE"):
            program.sigmask(["NONE"], "talks")

    def test_a_stop_ends_it(self, program):
        program.spawn("talks")
        ended = threading.Event()

        def stop():
            while not ended.wait(0.1):
                program.stop()

        stopping = threading.Thread(target=stop)
        stopping.start()
        try:
            with pytest.raises(StateError, match="stopped during the wait"):
                program.sigwait(["FINISH"], timeout=30.0)
        finally:
            ended.set()
            stopping.join()

    def test_masks_through_the_program(self, program):
        program.spawn("talks")
        assert program.sigmask(["FINISH"]) == {"": ["FINISH"]}
        assert program.sigmask(["none"], "talks") == {"": ["FINISH"], "talks": []}
        assert program.sigmask(["unset"], "talks") == {"": ["FINISH"]}
        program.control("talks", "on")
        program.sigwait(["OFF"], timeout=30.0)
        assert "FINISH" not in {one.signal for one in program.signals()}
        looker = Subsystem(program.files.path, domain=program.domain, watch=True)
        with looker:
            assert looker.sigmask() == {"": ["FINISH"]}
            with pytest.raises(ClaimError):
                looker.sigmask(["OFF"])

    def test_verb_and_prompt(self, program):
        program.spawn("talks")
        place = Place(domain=program.domain)
        over = threading.Event()

        def turn_on():
            """Until it is heard: a verb hears nothing of what came before it."""
            while not over.wait(0.1):
                if program.status("talks").state == "OFF":
                    program.control("talks", "on")

        turning = threading.Thread(target=turn_on)
        turning.start()
        try:
            asked = {"signal": ["HALFWAY"], "timeout": 30}
            reply = oneshot.run(program.files.path, "sigwait", asked, place)
        finally:
            over.set()
            turning.join()
        assert reply.data["sent"]["task"] == "talks"
        from pbonet.master.console import render
        from pbonet.master.console.command_session import CommandSession

        reply = CommandSession(program).execute("sigwait HALFWAY task=talks timeout=30")
        assert render.text(reply.command, reply.data).startswith("talks HALFWAY")
        reply = CommandSession(program).execute("sigmask WARNING OFF task=talks")
        assert "talks  WARNING OFF" in render.text(reply.command, reply.data)


class TestFollow:
    """``pbonet events`` from outside."""

    def test_each_event_is_one_line_of_json(self, program):
        program.spawn("talks")
        shown = follow(program, "--severity", "info")
        try:
            assert json.loads(shown.stdout.readline())["rtpu"] == "arm0"
            program.control("talks", "on")
            found = []
            for line in shown.stdout:
                found.append(json.loads(line))
                if found[-1]["text"].startswith("turned off"):
                    break
        finally:
            shown.send_signal(signal.SIGINT)
            shown.stdout.close()
            shown.wait(30.0)
        told = [(e["code"], e["bits"]) for e in found if e["bits"]]
        assert told == [
            ("WARNING", 8),
            ("SIGNAL", 2),
            ("SIGNAL", 1 << 10),
            ("SIGNAL", 1),
        ]
        numbers = [event["n"] for event in found]
        assert numbers == sorted(set(numbers))

    def test_a_flood_is_limited_and_counted(self, program):
        program.spawn("raises")
        program.control("raises", "on")
        place = Place(domain=program.domain)

        def told():
            reply = oneshot.run(
                program.files.path, "events count", {"task": ["raises"]}, place
            )
            return {one["code"]: one["count"] for one in reply.data["counts"]}

        counts = wait_for(
            lambda: (now := told()).get("METHOD", 0) >= 600 and now, "600 errors"
        )
        events = [e for e in program.events() if e.code == "METHOD"]
        assert len(events) < counts["METHOD"]
