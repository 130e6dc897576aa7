"""A run whose tasks fail as they end: nothing is taken for a success."""

import contextlib

import pytest

from pbonet.errors import NodeError
from pbonet.master import console

MODULE = """
from typing import Annotated as A
from pbonet import OutVar, PortBasedObject, Vector


class Brake(PortBasedObject, freq=50):
    "Fails where it should brake."

    x: A[Vector, OutVar("X", "2", "m", "position")]

    def cycle(self, dt):
        pass

    def {method}(self):
        raise OSError("the brake does not answer")
"""
FILES = {
    "t.svar": "NAME X\nTYPE double\nDESC\nUNITS m\nNELEM 2\nEOF\n",
    "t.sbs": "SUBSYSTEM t\nSVARFILE t.svar\nRTPU c0\nEOF\n",
    "t.job": "JOB t\nDESC d\nSBS t.sbs\nTASK brake\nEOF\n",
}


@pytest.mark.parametrize("method", ["off", "kill"])
def test_a_method_that_fails_at_the_end_is_an_error_of_the_run(call, tmp_path, method):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "brake.py").write_text(MODULE.format(method=method))
    words = ("run", "--sim", "--record", "off", "--seconds", "0.1")
    status, out, err = call(*words, tmp_path / "t.job")
    assert status == 1
    place = f"{tmp_path}/brake.py:15 in {method}"
    assert (
        f"the task brake failed as it ended: {method}: OSError: the brake does not "
        f"answer ({place}); it has ended; see that what it controls is safe, and "
        "correct its off() or kill()"
    ) in out + err


def test_agents_that_were_started_early_end_with_a_run_that_cannot_begin(
    call, monkeypatch, tmp_path
):
    left = []

    @contextlib.contextmanager
    def launched(*_, **__):
        try:
            yield left
        finally:
            left.append("ended")

    def refuses(*_, agents, **__):
        assert agents is left
        raise NodeError("it cannot begin")

    monkeypatch.setattr(console, "launch_agents", launched)
    monkeypatch.setattr(console, "run", refuses)
    status, _, err = call("run", tmp_path / "t.job")
    assert (status, left) == (1, ["ended"])
    assert "it cannot begin" in err
