"""Warnings of a master: which are told, and when again."""

from __future__ import annotations

from unittest.mock import patch

import pytest

from pbonet.config.library import Library
from pbonet.errors import ConditionError, MethodError, NoAnswerError
from pbonet.master.configuration import subsystem_files

OTHER = """
JOB   other
DESC  follows another trace
SBS   puma.sbs
TASK  puma_pidg  arm0
TASK  grav_comp  arm1
TASK  odd        arm1
TASK  qrdiff     arm1
EOF
"""
AXES = """
NAME   AXES
TYPE   int
DESC   as many as NDOF
UNITS  none
NELEM  1
INIT   6

EOF
"""


@pytest.fixture
def puma(puma):
    """The example with a trace that gives rise to a warning; arm1 has RM."""
    text = Library([]).find_rmod("jttrace").read_text()
    text = text.replace("INCONST ", "SVARALIAS NDOF=AXES\nINCONST ")
    (puma.parent / "odd.rmod").write_text(text)
    (puma.parent / "other.job").write_text(OTHER)
    svar = puma.with_suffix(".svar")
    svar.write_text(svar.read_text().replace("EOF", AXES))
    before, _, after = puma.read_text().rpartition("MUF")
    puma.write_text(f"{before}RM{after}")
    return puma


@pytest.fixture
def odd(arm):
    """A warning that there is of the other trace; the job is ON."""
    arm.start("puma")
    arm.heard.clear()
    return "no task produces the constant AXES, which odd needs"


def heard(arm):
    """Return what was told since it was last asked for."""
    told = list(arm.heard)
    arm.heard.clear()
    return told


def test_warning_is_told_once_while_it_holds_and_again_when_it_is_back(arm):
    arm.start("puma")
    arm.heard.clear()
    arm.control("grav_comp", "off")
    (told,) = arm.heard
    arm.control("jttrace", "off")
    arm.control("jttrace", "on")
    assert arm.heard.count(told) == 1
    with patch.object(subsystem_files.config, "parse_rmod", side_effect=AssertionError):
        arm.control("jttrace", "reinit")  # no file of the library is parsed again
    arm.control("grav_comp", "on")
    arm.heard.clear()
    arm.control("grav_comp", "off")
    assert arm.heard == [told]


def test_a_change_that_is_not_made_is_told_of_each_time(arm, agents, odd):
    for _ in range(2):
        arm.swap("jttrace", "odd", dry_run=True)
        (told,) = heard(arm)
        assert odd in told
    agents["arm1"].fail["spawn", "odd"] = MethodError("init raised", where="x")
    for change, names in ((arm.spawn, ("odd", "arm1")), (arm.swap, ("jttrace", "odd"))):
        with pytest.raises(MethodError):
            change(*names)
        assert heard(arm) == [told]
    agents["arm1"].fail["freq", "jttrace"] = NoAnswerError("gone")
    for _ in range(2):
        with pytest.raises(NoAnswerError):
            arm.freq("jttrace", 5.0)
        (other,) = heard(arm)
        assert "task jttrace runs at 5 Hz" in other
    agents["arm1"].fail.clear()
    arm.swap("jttrace", "odd")
    assert heard(arm) == [told]
    arm.swap("odd", "jttrace")
    assert heard(arm) == []  # it stands, and nothing is new


def test_a_swap_of_two_that_give_a_constant_says_nothing_of_both(arm, puma):
    """It is what mends it; what stands behind it, no change makes."""
    text = Library([]).find_rmod("puma_pidg").read_text()
    (puma.parent / "twin.rmod").write_text(text)
    arm.start("puma")
    told = "puma_pidg and twin both produce the constant"
    arm.heard.clear()
    arm.swap("puma_pidg", "twin", dry_run=True)
    arm.swap("puma_pidg", "twin")
    arm.swap("twin", "puma_pidg")
    arm.control("twin", "kill")
    assert told not in str(arm.heard)
    arm.spawn("twin", "arm0")
    assert str(arm.heard).count(told) == 2, "NDOF and DH"
    arm.control("twin", "kill")
    assert str(arm.heard).count(told) == 2


def test_a_change_that_waits_is_told_of_when_it_is_made(arm, world, odd):
    place = world.values["puma"]["Q^_MEZ"]
    place[0] = 1.0  # it is not where it may be left
    for asked in (False, True):
        with pytest.raises(ConditionError):
            arm.switch("other", dry_run=asked, wait=0.5)
    assert heard(arm) == []
    place[0] = 0.0
    arm.switch("other", dry_run=True)
    (told,) = heard(arm)
    assert odd in told
    arm.switch("other")
    assert heard(arm) == [told]
