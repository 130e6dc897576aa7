"""Processor exceptions in a C extension end one task, and say where (chapter 8)."""

import pytest
from svar_rig import build
from watching import wait_for

from pbonet.errors import Severity

WORDS = {
    "sigfpe": "SIGFPE (arithmetic fault in native code)",
    "sigbus": "SIGBUS (bus error)",
    "sigill": "SIGILL (illegal instruction)",
    "sigsegv": "SIGSEGV (segmentation fault)",
    "sigabrt": "SIGABRT (abort)",
}


@pytest.fixture(scope="module")
def extension(tmp_path_factory):
    folder = tmp_path_factory.mktemp("extension")
    return build("crashes.c", folder / "crashes.so", "-shared", "-fPIC")


@pytest.mark.parametrize("which", WORDS)
def test_it_is_an_event_with_its_place_and_ends_only_that_task(arm, extension, which):
    arm.spawn("good", "counts", out="Y1")
    arm.on("good")
    local = {"LIBRARY": extension, "FUNCTION": which}
    arm.spawn("bad", "crashes", local=local)
    arm.on("bad")
    event = arm.wait_event("TASK_DIED", "bad")
    assert event.severity == Severity.ERROR
    assert event.cycle == 9
    first, *place = event.text.splitlines()
    assert first == f"the task ended by itself: signal {WORDS[which]}"
    assert any("crashes.py" in line and "in cycle" in line for line in place)
    status = arm.status("bad")
    assert (status.state, status.signals["ERROR"]) == ("NOT-CREATED", 1)
    arm.wait_cycles("good", 20)
    assert arm.status("good").state == "ON"
    arm.spawn("bad", "counts")
    arm.on("bad")
    wait_for(lambda: arm.value("Y0").values[0] > 0, "another task in its place")
