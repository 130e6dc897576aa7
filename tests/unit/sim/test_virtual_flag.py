"""The illegal-configuration flag of a program in virtual time: as agents raise it."""

from __future__ import annotations

import pytest

from pbonet.master import Subsystem

MODULE = '''"""A link of a ring; what it hears is passed on."""

from typing import Annotated as A

from pbonet import InVar, OutVar, Params, PortBasedObject, param


class When(Params):
    """When it fails, or says that something is not legal."""

    fails: A[int, param("1", "cycle in which it fails", ge=0)] = 0
    says: A[int, param("1", "cycle in which it raises the flag", ge=0)] = 0


class Link(PortBasedObject[When]):
    """Pass on what is heard."""

    z: A[float, InVar("Z", "1", "none", "heard")]
    y: A[float, OutVar("Y", "1", "none", "told")]

    def on(self) -> None:
        self.count = 0

    def cycle(self, dt: float) -> None:
        self.count += 1
        if self.count == self.params.fails:
            raise ValueError("it breaks")
        if self.count == self.params.says:
            self.task.illegal("not calibrated")
        if self.count == self.params.says + 5:
            self.task.legal()
        self.y = self.z + 1.0

    def stable(self, dt: float) -> None:
        self.y = -1.0
'''
RMOD = (
    "MODULE link\nDESC d\nSVARALIAS Z={z}\nSVARALIAS Y={y}\nINCONST none\n"
    "OUTCONST none\nINVAR Z\nOUTVAR Y\nTASKTYPE periodic\nFREQ 100\n{more}"
    "LOCAL\n{local}\nEOF\n"
)
SVAR = "NAME {}\nTYPE double\nDESC d\nUNITS none\nNELEM 1\n\n"
UNFED = "equation 2: no task writes {} for {} (master)"


@pytest.fixture
def ring(tmp_path):
    """A program with a ring of two tasks on two RTPUs; `b` is critical."""
    (tmp_path / "link.py").write_text(MODULE)
    (tmp_path / "x.svar").write_text("".join(map(SVAR.format, "XY")) + "EOF\n")
    (tmp_path / "x.sbs").write_text(
        "SUBSYSTEM x\nSVARFILE x.svar\nRTPU r\nRTPU s\nEOF\n"
    )
    (tmp_path / "x.job").write_text("JOB x\nDESC\nSBS x.sbs\nTASK a\nTASK b s\nEOF\n")
    opened = []

    def begin(**local):
        words = "\n".join(f"{name} {value}" for name, value in local.items())
        for name, z, y, more in (("a", "X", "Y", ""), ("b", "Y", "X", "CRITICAL\n")):
            own = words if name == "a" else ""
            text = RMOD.format(z=z, y=y, more=more, local=own)
            (tmp_path / f"{name}.rmod").write_text(text)
        subsystem = Subsystem(
            tmp_path / "x.job", libraries=[tmp_path], virtual=True, warned=print
        )
        subsystem.open()
        opened.append(subsystem)
        subsystem.start()
        return subsystem

    yield begin
    for one in opened:
        one.finish()


def told(subsystem):
    """Return who told which causes of the flag, in order."""
    return [
        (event.rtpu, event.code, event.text.removeprefix("no longer: "))
        for event in subsystem.events()
        if event.code in {"ILLEGAL", "LEGAL"}
    ]


def causes(subsystem):
    return {cause for one in subsystem.rtpu_status() for cause in one.illegal}


def test_a_job_that_is_assembled_and_ended_raises_nothing(ring):
    subsystem = ring()
    subsystem.wait(0.1)
    assert causes(subsystem) == set()
    subsystem.stop()
    assert told(subsystem) == []


def test_a_task_in_error_raises_it_until_it_is_put_right(ring):
    subsystem = ring(fails=5)
    subsystem.wait(0.1)
    cause = "a is in ERROR (r/a)"
    assert causes(subsystem) == {cause}
    assert subsystem.display(["X"])[0].values == [-1.0], "stable in place of cycle"
    assert told(subsystem) == [("r", "ILLEGAL", cause)]
    subsystem.clear("a")
    subsystem.on("a")
    assert causes(subsystem) == set()
    unfed = UNFED.format("Y", "b")
    assert told(subsystem)[1:] == [
        ("r", "LEGAL", cause),
        ("r", "ILLEGAL", unfed),
        ("r", "LEGAL", unfed),
    ]
    subsystem.wait(0.03)
    assert subsystem.display(["X"])[0].values != [-1.0]


def test_the_master_raises_it_for_an_input_that_nobody_writes(ring):
    subsystem = ring()
    subsystem.off("b")
    unfed = UNFED.format("X", "a")
    assert causes(subsystem) == {unfed}
    subsystem.on("b")
    assert causes(subsystem) == set()
    assert told(subsystem) == [("r", "ILLEGAL", unfed), ("r", "LEGAL", unfed)]


def test_a_module_raises_it_and_lets_it_down(ring):
    subsystem = ring(says=3)
    cause = "not calibrated (r/a)"
    subsystem.wait(0.04)
    assert causes(subsystem) == {cause}
    subsystem.wait(0.1)
    assert causes(subsystem) == set()
    assert told(subsystem) == [("r", "ILLEGAL", cause), ("r", "LEGAL", cause)]
