"""Which signals are pending: of tasks that go on, die, and are spawned anew."""

from pathlib import Path

import pytest

from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.master.subsystem.task_signal_inbox import Inbox
from pbonet.xm.net import messages as m

COUNTS = ("crit", "cycle", "miss", "warn")
FIGURES = ("ref_f", "mez_f", "mez_t", "ptime", "tot_c", "tick", "min_c", "max_c")
LOOKED = dict.fromkeys(COUNTS, 0) | dict.fromkeys([*FIGURES, "last_c"], 0.0)


def seen(tid, now, **signals):
    return m.TaskStatus(
        rmod="t",
        task="t",
        rtpu="r",
        tid=tid,
        S="P",
        state="ON",
        now=now,
        signals=signals,
        **LOOKED,
    )


def take(inbox, status, *signals):
    inbox.note(status)
    sent = inbox.take([status], signals, ())
    return sent and (sent.signal, sent.count)


@pytest.fixture
def inbox():
    made = Inbox()
    made.begin([seen(7, 1, ERROR=0, FINISH=2)])
    return made


def test_each_death_of_a_task_that_is_spawned_anew_is_told(inbox):
    assert take(inbox, seen(0, 10, ERROR=1, FINISH=2)) == ("ERROR", 1)
    for n in (1, 2):
        inbox.note(seen(7 + n, 20 * n, ERROR=0, FINISH=0))  # as a spawn is answered
        died = seen(0, 20 * n + 10, ERROR=1, FINISH=0)
        assert take(inbox, died) == ("ERROR", 1)
        assert take(inbox, died) is None


def test_a_status_from_before_a_death_that_is_known_counts_for_nothing(inbox):
    """Two threads have asked, and the earlier answer is heard last."""
    assert take(inbox, seen(0, 10, ERROR=1, FINISH=2)) == ("ERROR", 1)
    assert take(inbox, seen(7, 9, ERROR=1, FINISH=2)) is None
    assert take(inbox, seen(0, 10, ERROR=1, FINISH=2)) is None


def test_what_nobody_took_before_the_next_life_stays(inbox):
    inbox.note(seen(0, 10, ERROR=1, FINISH=3))
    new = seen(8, 20, ERROR=0, FINISH=1)
    assert take(inbox, new) == ("ERROR", 1)
    assert take(inbox, new) == ("FINISH", 2)
    assert take(inbox, new) is None


def test_a_death_is_told_of_a_life_that_was_never_seen(inbox):
    assert take(inbox, seen(0, 10, ERROR=1, FINISH=2)) == ("ERROR", 1)
    assert take(inbox, seen(0, 30, ERROR=1, FINISH=0)) == ("ERROR", 1)


def test_a_killed_task_takes_what_was_pending_with_it(inbox):
    inbox.note(seen(7, 10, ERROR=0, FINISH=3))
    assert take(inbox, seen(8, 20, ERROR=0, FINISH=0)) is None


def test_a_status_that_comes_late_counts_for_nothing(inbox):
    inbox.note(seen(0, 10, ERROR=1, FINISH=2))
    inbox.note(seen(8, 20, ERROR=0, FINISH=0))
    assert take(inbox, seen(8, 20, ERROR=0, FINISH=0)) == ("ERROR", 1)
    assert take(inbox, seen(0, 10, ERROR=1, FINISH=2)) is None
    assert take(inbox, seen(7, 9, ERROR=0, FINISH=2)) is None


def test_a_dead_task_that_is_killed_takes_what_was_pending_with_it(inbox):
    inbox.note(seen(0, 10, ERROR=1, FINISH=3))
    assert inbox.dead() == {"t": "r"}
    inbox.bury(["t"])
    assert inbox.dead() == {}
    inbox.note(seen(0, 10, ERROR=1, FINISH=3))  # as the kill is answered, or late
    assert inbox.pending([seen(0, 10)]) == []
    assert take(inbox, seen(8, 20, ERROR=0, FINISH=0)) is None
    assert take(inbox, seen(0, 30, ERROR=1, FINISH=0)) == ("ERROR", 1)


@pytest.mark.parametrize("tid", [7, 8])
def test_a_machine_that_was_booted_anew_is_heard(inbox, tid):
    """Its clock begins at 0 again; the task's process may have the same number."""
    assert take(inbox, seen(7, 9_000_000_000_000, FINISH=3)) == ("FINISH", 1)
    assert take(inbox, seen(tid, 30_000_000_000, FINISH=2)) == ("FINISH", 2)
    assert take(inbox, seen(tid, 31_000_000_000, FINISH=3)) == ("FINISH", 1)


RAISES = '''"""Raises."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject


class Raises(PortBasedObject):
    """Raises in its third cycle."""

    y: A[float, OutVar("Y", "1", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y += 1.0
        if self.y == 3.0:
            raise RuntimeError("oops")
'''


@pytest.fixture
def raises(tmp_path: Path) -> Path:
    """The job of one task that raises in its third cycle."""
    texts = {
        "raises.py": RAISES,
        "raises.rmod": "MODULE raises\nDESC raises\nINCONST none\nOUTCONST none\n"
        "INVAR none\nOUTVAR Y\nTASKTYPE periodic\nFREQ 100\nEOF\n",
        "t.svar": "NAME Y\nTYPE double\nDESC y\nUNITS none\nNELEM 1\nEOF\n",
        "t.sbs": "SUBSYSTEM t\nSVARFILE t.svar\nRTPU r\nEOF\n",
        "t.job": "JOB t\nDESC raises\nSBS t.sbs\nTASK raises\nEOF\n",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    return tmp_path / "t.job"


def test_one_exception_in_virtual_time_is_one_error(raises):
    with Subsystem(raises, virtual=True, libraries=[raises.parent]) as subsystem:
        subsystem.start()
        subsystem.wait(0.1)
        assert subsystem.status("raises").signals["ERROR"] == 1
        sent = subsystem.sigwait(["ERROR"], timeout=1.0)
        assert (sent.task, sent.count) == ("raises", 1)
        assert subsystem.signals() == []
