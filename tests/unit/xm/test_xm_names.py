"""Names of resources: their form, where they are, and what refusals say."""

from pathlib import Path

import pytest

from pbonet import xm
from pbonet.errors import UnreachableError, XmMissingError, XmNameError
from pbonet.xm.ipc import names
from pbonet.xm.net import run_folder


@pytest.fixture(autouse=True)
def home(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    monkeypatch.setattr(names, "_home", names.home())


def test_a_name_alone_belongs_to_the_processs_own_rtpu() -> None:
    assert names.find("events") == (("default", "local", "events"), True)
    xm.live_on("arm0", domain="lab")
    name, here = names.find("events")
    assert (str(name), here) == ("arm0:events", True)
    assert names.find("events") == names.find("arm0:events")
    assert name.path("queue").name.endswith(".lab:arm0:events.queue")
    assert names.find("arm1:events") == (("lab", "arm1", "events"), False)


@pytest.mark.parametrize(
    "name", ["", ":", "a:", ":b", "a:b:c", "a/b", "../x", "-a", "a b", "x" * 65]
)
def test_what_is_no_name_is_refused(name) -> None:
    with pytest.raises(XmNameError, match="this is not a valid resource name") as error:
        xm.semaphore(name)
    assert isinstance(error.value, ValueError)


def test_another_machine_that_no_agent_leads_to_says_what_to_do() -> None:
    with pytest.raises(UnreachableError) as error:
        xm.semaphore("arm1:grip", initial=1)
    assert "no agent of domain default runs on this machine" in str(error.value)
    assert str(error.value).endswith("; a program sets PBONET_CONNECT instead")


def test_memory_of_another_machine_says_what_to_use() -> None:
    with pytest.raises(UnreachableError) as error:
        xm.segment("arm1:map", 100)
    assert str(error.value) == (
        "arm1:map: RTPU arm1 is not on this machine (expected an RTPU that runs here, "
        "in domain default, got none); memory is shared within a machine only; to "
        "another one use a link (pbonet.tbuf), or a variable of the table"
    )


def test_an_rtpu_that_runs_here_is_found() -> None:
    lock = run_folder.NameLock(run_folder.Places("default", "arm1").ctl_lock)
    try:
        with pytest.raises(UnreachableError, match=r"got arm1\); did you mean arm1\?"):
            xm.segment("amr1:map", 100)
        grip = xm.semaphore("arm1:grip", initial=1)
        assert grip.name == "arm1:grip"
        grip.destroy()
    finally:
        lock.release()


def test_a_missing_one_names_those_that_stand() -> None:
    with pytest.raises(XmMissingError) as error:
        xm.Queue.attach("events")
    assert str(error.value) == (
        "local:events: there is no such queue (got none at all); create it; "
        "xm.queue(name) does"
    )
    queue = xm.queue("events")
    with pytest.raises(XmMissingError, match=r"did you mean local:events\?"):
        xm.Queue.attach("event")
    with pytest.raises(XmMissingError, match="there is no such semaphore"):
        xm.semaphore("events")
    queue.destroy()


def test_domains_are_apart() -> None:
    queue = xm.queue("events")
    xm.live_on("local", domain="other")
    with pytest.raises(XmMissingError):
        xm.Queue.attach("events")
    queue.destroy()


def test_a_sweep_removes_what_nobody_uses_of_one_rtpu(shared_memory) -> None:
    xm.live_on("arm0")
    used = xm.queue("used")
    for name in ("left", "left2"):
        xm.queue(name).close()
    xm.semaphore("left", initial=1).close()
    xm.live_on("arm01")
    other = xm.semaphore("left", initial=1)
    other.close()
    assert xm.sweep("arm0") == ["left.queue", "left.sem", "left2.queue"]
    assert xm.sweep("arm01") == ["left.sem"]
    assert [path.name for path in shared_memory.iterdir()] == [Path(used.path).name]
    used.destroy()
