"""A program of jobs in virtual time: every kind of line, errors, pause and abort."""

from __future__ import annotations

import re
import runpy
import sys
import threading
from textwrap import dedent

import pytest
from watching import wait_for

from pbonet import cli
from pbonet.errors import ConditionError, ConfigError, NoAnswerError, StateError
from pbonet.master import Subsystem
from pbonet.master.configuration import check_file
from pbonet.master.subsystem import Phase, Sequencer

MODULE = """
    from typing import Annotated as A
    from pbonet import *

    class Says(Params):
        finish: A[int, param("none", "cycle of its signal FINISH; 0: never")] = 0
        good: A[int, param("none", "cycle of its signal GOOD; 0: never")] = 0
        fail: A[int, param("none", "cycle in which it fails; 0: never")] = 0

    class Count(PortBasedObject[Says]):
        '''Count its cycles.'''

        GOOD = UserSignal(0, "it is good")
        y: A[float, OutVar("Y", "1", "none", "cycles since on")]

        def on(self) -> None:
            self.y = 0.0

        def cycle(self, dt: float) -> None:
            self.y += 1.0
            if self.y == self.params.finish:
                self.task.signal(Signal.FINISH)
            if self.y == self.params.good:
                self.task.signal(self.GOOD)
            if self.y == self.params.fail:
                raise ValueError("it broke")
"""
RMOD = (
    "MODULE count\nDESC a test\nINCONST none\nOUTCONST none\nINVAR none\nOUTVAR Y\n"
    "TASKTYPE periodic\nFREQ 100\nLOCAL\n{}\nEOF\n"
)
TASKS = {
    "quick": "FINISH 3",
    "slow": "FINISH 50",
    "silent": "",
    "good": "GOOD 4",
    "both": "GOOD 4\nFINISH 6",
    "broken": "FAIL 2",
    "rest": "",
}
VARIABLE = "NAME {}\nTYPE double\nDESC a test\nUNITS none\nNELEM 1\n\n"
CONDITIONS = {
    "slow": "POST Y > 45\n",
    "good": "PRE FREE < 1\n",
}


@pytest.fixture
def shop(tmp_path):
    """A folder with a job for each task, and a function that writes a sequence."""
    table = VARIABLE.format("Y") + VARIABLE.format("FREE")
    (tmp_path / "shop.svar").write_text(f"{table}EOF\n")
    (tmp_path / "shop.sbs").write_text(
        "SUBSYSTEM shop\nSVARFILE shop.svar\nRTPU a\nEOF\n"
    )
    (tmp_path / "count.py").write_text(dedent(MODULE))
    for name, local in TASKS.items():
        (tmp_path / f"{name}.rmod").write_text(RMOD.format(local))
        (tmp_path / f"{name}.job").write_text(
            f"JOB {name}\nDESC\nSBS shop.sbs\n{CONDITIONS.get(name, '')}"
            f"TASK {name}\nEOF\n"
        )
    return tmp_path


HEAD = "WAIT 0.05\nWITHIN 5\nSAFE rest FOR 0.1"


def write(folder, text, head=HEAD):
    path = folder / "test.seq"
    path.write_text(f"SEQUENCE test\nDESC\nSBS shop.sbs\n{head}\n{dedent(text)}\nEOF\n")
    return path


def run(folder, text, *, head=HEAD, told=None, limit=None):
    """Run a sequence; return its last state and its time in seconds."""
    with Subsystem(write(folder, text, head), virtual=True) as shop:
        begin = shop.clock.now()

        def tell(state):
            if told is not None:
                told(shop, sequencer, state)

        sequencer = Sequencer(shop, told=tell, limit=limit)
        return sequencer.run(), shop.clock.now() - begin


def test_steps_follow_each_other_and_are_told(shop):
    states = []
    state, passed = run(
        shop,
        """
        STEP quick UNTIL FINISH
        STEP slow  UNTIL slow FINISH
        STEP silent UNTIL (Y > 20) WITHIN 1
        STEP last: rest FOR 0.5
        DONE all is well
        """,
        told=lambda _, __, state: states.append(state),
    )
    assert (state.phase, state.text) == (Phase.DONE, "all is well")
    assert state.entered == ("quick", "slow", "silent", "last")
    assert state.errors == ()
    assert passed == pytest.approx(0.03 + 0.5 + 0.21 + 0.5, abs=0.1)
    waits = [one.waiting for one in states if one.phase is Phase.WAITS and one.waiting]
    assert list(dict.fromkeys(waits)) == [
        "FINISH",
        "slow FINISH",
        "(Y > 20)",
        "0.5 s",
    ]
    assert [one.line for one in states] == sorted(one.line for one in states)


def test_each_step_is_an_event_of_the_log(shop):
    path = write(shop, "STEP quick UNTIL FINISH\nSTEP last: rest")
    with Subsystem(path, virtual=True) as subsystem:
        Sequencer(subsystem).run()
        told = [one.text for one in subsystem.events() if one.code == "STEP"]
    assert told == [
        "job quick is entered: test: STEP quick UNTIL FINISH",
        "job rest is entered: test: STEP last: rest",
    ]


def test_a_signal_leads_to_its_branch_and_a_condition_to_its_own(shop):
    text = """
        WRITE FREE {free}
        STEP {first} UNTIL GOOD OR FINISH
        GOTO bad IF FINISH
        GOTO free IF (FREE == 0)
        FAIL neither
        STEP bad: rest
        FAIL bad
        STEP free: rest
        DONE free
    """
    state, _ = run(shop, text.format(first="quick", free=0))
    assert (state.phase, state.text) == (Phase.FAILED, "bad")
    state, _ = run(shop, text.format(first="both", free=0))
    assert (state.phase, state.text) == (Phase.DONE, "free")
    state, _ = run(shop, text.format(first="both", free=1))
    assert (state.phase, state.text) == (Phase.FAILED, "neither")
    assert state.entered == ("both",), "FAIL does not lead to the safe job"


def test_loops_count_anew_each_time_they_are_entered(shop):
    state, _ = run(
        shop,
        """
        REPEAT 2
        STEP quick UNTIL FINISH
        REPEAT 3
        STEP silent
        STEP both UNTIL GOOD
        END
        END
        STEP rest
        """,
    )
    assert state.entered == (*("quick", *("silent", "both") * 3) * 2, "rest")


def test_a_step_of_the_present_job_waits_for_the_next_signal(shop):
    state, passed = run(
        shop, "STEP quick UNTIL FINISH\nSTEP again: quick UNTIL FINISH WITHIN 0.5"
    )
    assert state.phase is Phase.FAILED
    assert "no FINISH within 0.5 s" in state.text
    assert passed > 0.5, "the FINISH of the first step has been taken"


def test_a_loop_without_end_ends_by_goto_or_by_the_limit(shop):
    text = """
        REPEAT forever
        STEP silent
        GOTO out IF (Y > {y})
        END
        STEP out: rest
    """
    state, _ = run(shop, text.format(y=10))
    assert state.phase is Phase.DONE
    assert state.entered[-1] == "out"
    state, _ = run(shop, text.format(y=1000), limit=2.0)
    assert (state.phase, state.text) == (Phase.ABORTED, "2 s are over")
    assert state.entered[-1] == "rest"
    assert state.safe


@pytest.mark.parametrize(
    ("step", "cause"),
    [
        ("STEP broken UNTIL FINISH", "the task broken sent ERROR"),
        ("STEP silent UNTIL FINISH WITHIN 0.2", "no FINISH within 0.2 s"),
        ("WRITE FREE 2\nSTEP good UNTIL GOOD", "PRE of good does not hold: FREE < 1"),
        ("STEP slow UNTIL FINISH WITHIN 0.2", "no FINISH within 0.2 s"),
        ("STEP silent UNTIL NONE", "no task has a signal NONE"),
    ],
)
def test_an_error_leads_to_the_else_step_or_to_the_safe_job(shop, step, cause):
    """POST of the job that is given up, as of slow, is not asked then."""
    with_else = f"{step} ELSE care\nFAIL it went on\nSTEP care: both UNTIL GOOD"
    state, _ = run(shop, with_else)
    assert state.phase is Phase.DONE, state
    assert state.entered[-1] == "care"
    assert len(state.errors) == 1
    assert cause in state.errors[0]
    state, passed = run(shop, step)
    assert state.phase is Phase.FAILED
    assert cause in state.text
    assert state.text.startswith("line ")
    assert (state.entered[-1], state.safe) == ("rest", True)
    assert passed > 0.1, "the safe job lasts as long as its line says"


def test_post_is_asked_when_no_error_came_first(shop):
    state, _ = run(shop, "STEP slow FOR 0.1\nSTEP quick")
    assert state.phase is Phase.FAILED
    assert "POST of slow does not hold" in state.text
    assert "within 0.05 s" in state.text, "as long as WAIT says"


def test_a_job_can_be_given_up_without_its_post(shop):
    with Subsystem(shop / "slow.job", virtual=True) as subsystem:
        subsystem.start()
        with pytest.raises(ConditionError, match="POST of slow does not hold"):
            subsystem.switch("quick")
        subsystem.wait(0.55)
        subsystem.switch("silent")
        subsystem.switch("slow")
        assert [one.signal for one in subsystem.signals()] == []
        subsystem.switch("both", abandon=True)
        assert [one.task for one in subsystem.status()] == ["both"]


def test_an_order_that_fails_leads_to_the_else_of_the_step_above(shop):
    state, _ = run(
        shop,
        "STEP silent FOR 0.1 ELSE care\nKILL nobody\nFAIL\nSTEP care: rest\nDONE",
    )
    assert state.phase is Phase.DONE
    assert "nobody" in state.errors[0]


def test_orders_set_spawn_kill_and_write(shop):
    values = []

    def told(subsystem, _, state):
        if state.phase is Phase.WAITS and not values:
            values.append(subsystem.get("quick", "good")[0].value)
            values.append(subsystem.display("FREE")[0].values)
            values.append(sorted(one.task for one in subsystem.status()))

    state, _ = run(
        shop,
        """
        SPAWN quick a
        SPAWN silent
        SET quick good 7
        KILL silent
        WRITE FREE -1.5
        STEP quick UNTIL GOOD
        """,
        told=told,
    )
    assert state.phase is Phase.DONE
    assert values == [7, [-1.5], ["quick"]]


def test_a_task_that_is_there_is_spawned_again_in_a_loop_and_stays(shop):
    tasks = set()

    def told(subsystem, _, state):
        if state.step == "quick" and state.phase is Phase.WAITS:
            tasks.add(subsystem.status("silent").tid)

    text = """
        REPEAT 3
        SPAWN silent
        STEP quick FOR 0.05
        END
    """
    state, _ = run(shop, text, told=told)
    assert (state.phase, state.count, state.text) == (Phase.DONE, 3, "")
    assert len(tasks) == 1


def test_a_task_of_that_name_from_another_rmod_is_in_the_way(shop):
    """Its file was changed since it was spawned."""
    with Subsystem(write(shop, "STEP quick"), virtual=True) as subsystem:
        first = subsystem.spawn("silent", keep=True)
        assert subsystem.spawn("silent", keep=True).tid == first.tid
        with pytest.raises(StateError, match="there is a task silent already"):
            subsystem.spawn("silent")
        text = (shop / "silent.rmod").read_text()
        (shop / "silent.rmod").write_text(f"# changed\n{text}")
        with pytest.raises(StateError, match="the task silent is in the way"):
            subsystem.spawn("silent", keep=True)


def test_a_task_with_a_fallback_may_fail(shop):
    (shop / "broken.job").write_text(
        "JOB broken\nDESC\nSBS shop.sbs\nTASK broken FALLBACK quick\nEOF\n"
    )
    state, _ = run(shop, "STEP broken UNTIL quick FINISH WITHIN 1")
    assert (state.phase, state.errors) == (Phase.DONE, ())


def test_an_abort_leads_to_the_safe_job_and_a_second_one_ends_it(shop):
    def told(_, sequencer, state):
        if state.step == "silent" and state.phase is Phase.WAITS:
            sequencer.abort("enough")

    state, _ = run(shop, "STEP silent UNTIL FINISH\nSTEP quick", told=told)
    assert (state.phase, state.text) == (Phase.ABORTED, "enough")
    assert state.entered == ("silent", "rest")

    def twice(subsystem, sequencer, state):
        told(subsystem, sequencer, state)
        if state.safe and state.phase is Phase.WAITS:
            sequencer.abort()

    head = "SAFE rest UNTIL (Y < 0) WITHIN 9"
    state, _ = run(shop, "STEP silent UNTIL FINISH", head=head, told=twice)
    assert state.phase is Phase.ABORTED
    assert "the safe job rest was given up" in state.errors[-1]


def test_an_abort_waits_for_no_signal_of_a_safe_job_that_has_done_its_work(shop):
    times = []

    def told(subsystem, sequencer, state):
        waits = state.phase is Phase.WAITS and not state.safe
        if waits and not state.pausing:
            sequencer.pause()
        if state.phase is Phase.PAUSED and not times:
            times.append(subsystem.clock.now())
            sequencer.abort()
        if state.ended:
            times.append(subsystem.clock.now())

    head = "SAFE quick UNTIL FINISH WITHIN 9"
    text = "STEP quick UNTIL FINISH\nSTEP silent UNTIL FINISH"
    state, _ = run(shop, text, head=head, told=told)
    assert (state.phase, state.errors) == (Phase.ABORTED, ())
    begin, end = times
    assert end - begin < 1.0  # of virtual time


def test_an_abort_waits_for_a_safe_job_that_is_at_work(shop):
    waits = []

    def told(_, sequencer, state):
        if state.phase is Phase.WAITS:
            waits.append(state.safe)
            if not state.safe:
                sequencer.abort()

    head = "SAFE slow UNTIL FINISH WITHIN 9"
    state, _ = run(shop, "STEP slow UNTIL FINISH", head=head, told=told)
    assert (state.phase, state.errors) == (Phase.ABORTED, ())
    assert waits[:2] == [False, True]


def test_a_stop_ends_it_and_nothing_is_started_again(shop):
    def told(subsystem, _, state):
        if state.step == "silent" and state.phase is Phase.WAITS and not state.ended:
            subsystem.stop()

    path = write(shop, "STEP silent UNTIL FINISH ELSE care\nSTEP care: rest")
    with Subsystem(path, virtual=True) as subsystem:
        sequencer = Sequencer(
            subsystem, told=lambda state: told(subsystem, sequencer, state)
        )
        assert sequencer.run().phase is Phase.STOPPED
        assert subsystem.status() == []
        assert sequencer.state.entered == ("silent",)
        with pytest.raises(StateError, match="has run already"):
            sequencer.run()


def test_a_stop_during_the_wait_for_conditions_starts_nothing(shop, monkeypatch):
    path = write(shop, "STEP silent FOR 0.1\nSTEP rest", head="WAIT 9")
    change_to = Subsystem.change_to

    def later(subsystem, job, **more):
        """Refuse the second job at first; a stop from elsewhere comes meanwhile."""
        if [one.task for one in subsystem.status()] == ["silent"]:
            subsystem.task_set.stop()
            raise ConditionError("it still moves")
        return change_to(subsystem, job, **more)

    monkeypatch.setattr(Subsystem, "change_to", later)
    with Subsystem(path, virtual=True) as subsystem:
        sequencer = Sequencer(subsystem)
        assert sequencer.run().phase is Phase.STOPPED
        assert subsystem.status() == []


def paused(sequencer):
    wait_for(lambda: sequencer.state.phase is Phase.PAUSED, "the pause")


def test_a_pause_holds_the_next_line_and_a_step_does_one(shop):
    path = write(shop, "STEP quick UNTIL FINISH\nSTEP both UNTIL GOOD\nSTEP rest")
    with Subsystem(path, virtual=True) as subsystem:
        sequencer = Sequencer(subsystem)
        sequencer.pause()
        thread = threading.Thread(target=sequencer.run)
        thread.start()
        try:
            paused(sequencer)
            assert sequencer.state.pausing
            assert subsystem.status() == []
            sequencer.step()
            wait_for(lambda: sequencer.state.count == 1, "the first step")
            paused(sequencer)
            assert [one.task for one in subsystem.status()] == ["quick"]
            assert sequencer.state.line == 1, "the line that is held"
        finally:
            sequencer.resume()
            thread.join()
        assert sequencer.state.phase is Phase.DONE
        assert sequencer.state.entered == ("quick", "both", "rest")


def test_until_and_holds_are_there_for_programs(shop):
    with Subsystem(shop / "silent.job", virtual=True) as subsystem:
        subsystem.start()
        assert not subsystem.holds("Y > 5")
        assert subsystem.until(["FINISH", "(Y > 5)"], timeout=1) == "(Y > 5)"
        assert subsystem.holds("Y > 5")
        assert subsystem.until(seconds=0.1) == ""
        with pytest.raises(NoAnswerError, match=r"no \(Y < 0\) within 0.1 s") as caught:
            subsystem.until("(Y < 0)", timeout=0.1)
        assert "Y = " in caught.value.got
        with pytest.raises(ConfigError, match="neither a signal nor a condition"):
            subsystem.until("Y < 0")


def test_a_sequencer_needs_a_sequence(shop):
    with (
        Subsystem(shop / "silent.job", virtual=True) as subsystem,
        pytest.raises(ConfigError, match="opened without a sequence"),
    ):
        Sequencer(subsystem)


def verb(*words):
    """Run a verb; return its status."""
    with pytest.raises(SystemExit) as ended:
        cli.main(list(map(str, words)))
    return ended.value.code


# -- the command line ------------------------------------------------------------------


ALL = """
    SPAWN rest
    SET rest finish 1000
    STEP first: quick UNTIL FINISH
    REPEAT 2
    WRITE FREE 0
    STEP between: silent
    STEP both UNTIL GOOD OR FINISH
    GOTO third IF FINISH
    END
    STEP broken UNTIL FINISH ELSE care
    STEP third: silent
    FAIL not here
    STEP care: good UNTIL GOOD OR (Y > 100) WITHIN 1
    GOTO last IF (FREE == 0)
    FAIL nor here
    STEP last: silent FOR 0.2
    DONE it's "done"
"""


def test_the_exported_program_does_the_same(shop, monkeypatch, capsys):
    state, _ = run(shop, ALL)
    assert state.phase is Phase.DONE
    (shop / "programs").mkdir()
    program = shop / "programs" / "made.py"
    assert verb("new", "program", shop / "test.seq", program) == 0
    capsys.readouterr()
    (shop / "test.seq").unlink()
    monkeypatch.setattr(sys, "argv", [str(program), "--sim"])
    runpy.run_path(str(program), run_name="__main__")
    out = capsys.readouterr().out.splitlines()
    names = [line.split()[-1] for line in out if line[:1] == " "]
    assert [name for name in names if name in state.entered] == list(state.entered)
    assert out[-1] == 'it\'s "done"'
    assert any(line.startswith("broken: ") and "sent ERROR" in line for line in out)


def test_a_program_ends_with_a_status_as_the_sequence_does(shop, monkeypatch, capsys):
    path = write(shop, "STEP silent UNTIL FINISH WITHIN 0.2\nFAIL never")
    assert verb("new", "program", path) == 0
    monkeypatch.setattr(sys, "argv", ["test.py", "--sim"])
    with pytest.raises(SystemExit, match=r"test: .*no FINISH within 0\.2 s"):
        runpy.run_path(str(shop / "test.py"), run_name="__main__")
    assert "the sequence is given up" in capsys.readouterr().out
    assert verb("new", "program", path) == 1
    assert "a file exists there already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "last"),
    [
        ("STEP quick UNTIL FINISH\nDONE well", "done: well"),
        ("STEP quick UNTIL FINISH\nFAIL badly", "failed: badly"),
        ("STEP silent UNTIL FINISH", "aborted: 1 s are over"),
    ],
)
def test_run_sim_runs_a_sequence_and_its_status_says_how(shop, capsys, text, last):
    status = 0 if last.startswith("done") else 1
    path = str(write(shop, text))
    runs = shop / "runs"
    assert verb("run", path, "--sim", "--seconds", "1", "--runs", runs) == status
    out = capsys.readouterr().out
    assert last in out
    assert "step 1: job " in out
    assert "every cycle is in" in out
    (log,) = runs.iterdir()
    assert verb("log", "events", log) == 0
    assert "is entered: test: STEP" in capsys.readouterr().out
    assert verb("replay", log) == 0, "the sequence is simulated again from its log"
    assert "identical" in capsys.readouterr().out


def test_simulate_says_how_to_run_a_sequence(shop, capsys):
    assert verb("simulate", write(shop, "STEP quick")) == 1
    assert "pbonet run" in capsys.readouterr().err


# -- check -----------------------------------------------------------------------------


def test_a_good_sequence_is_legal(shop):
    found = check_file(write(shop, ALL, head="SAFE rest"))
    assert found.errors == []
    assert found.about == "sequence test of 7 steps"
    assert [text.partition(": ")[2] for text in found.notes] == [
        "the step first waits without a limit for FINISH (no WITHIN)",
        "the step both waits without a limit for GOOD or FINISH (no WITHIN)",
        "the step broken waits without a limit for FINISH (no WITHIN)",
    ]
    assert check_file(shop / "test.seq", code=False).errors == []


@pytest.mark.parametrize(
    ("text", "place", "what"),
    [
        ("STEP quik", "5:1", "there is no job quik .*did you mean quick"),
        ("STEP quick UNTIL FINSH", "5:18", "no task of quick has a signal FINSH"),
        ("STEP quick UNTIL slow FINISH", "5:18", "the job quick has no task slow"),
        ("STEP quick UNTIL (YY > 1)", "5:19", "YY, which the table does not have"),
        ("STEP quick\nGOTO quick IF (YY > 1)", "6:16", "YY, which the table does not"),
        ("SPAWN quick b\nSTEP quick", "5:1", "b, which is no RTPU"),
        ("SPAWN quik\nSTEP quick", "5:1", "there is no RMOD quik"),
        ("STEP quick\nKILL slwo\nSTEP slow", "6:1", "no job .* has a task slwo"),
        ("STEP quick\nSET quick finsh 2", "6:1", "finsh, which is no parameter"),
        ("STEP quick\nWRITE FRE 2", "6:1", "the table has no variable FRE"),
        ("STEP quick\nWRITE FREE 2 3", "6:1", "WRITE has 2 numbers for FREE"),
        ("STEP slow\nSTEP early", "6:1", "slow -> early: POST .* never hold together"),
    ],
)
def test_check_finds_what_cannot_be(shop, text, place, what):
    (shop / "early.job").write_text(
        "JOB early\nDESC\nSBS shop.sbs\nPRE Y < 40\nTASK quick\nEOF\n"
    )
    path = write(shop, text, head="SAFE rest")
    found = check_file(path)
    (error,) = found.errors
    told = f"{error['where']}: {found.lines()[0]}"
    assert error["where"].startswith(f"{path}:{place}"), told
    assert re.search(what, told), told


def test_check_judges_each_job(shop):
    (shop / "quick.rmod").write_text(RMOD.format("FINISH none"))
    found = check_file(write(shop, "STEP quick\nSTEP slow\nSTEP again: quick"))
    assert len(found.errors) == 1, "each fault once"
    assert "quick.rmod" in found.lines()[0]


def test_check_tells_what_is_never_reached_and_what_has_no_end(shop):
    found = check_file(
        write(
            shop,
            """
            REPEAT forever
            STEP quick UNTIL FINISH WITHIN 1
            END
            STEP slow
            """,
            head="",
        )
    )
    assert found.errors == []
    assert [text.partition(".seq:")[2] for text in found.warnings] == [
        "9:1: the step slow is never reached"
    ]
    ending, safe = found.notes
    assert "from this loop on the sequence has no end" in ending
    assert "there is no SAFE job" in safe


def test_check_says_what_neighbours_do_not_ensure(shop):
    found = check_file(
        write(
            shop,
            "STEP quick UNTIL (FREE < 0.5) WITHIN 1\nSTEP good\nSTEP rest\n"
            "STEP again: good",
        )
    )
    assert found.errors == []
    (told,) = found.warnings
    assert "rest -> again: POST of rest does not ensure PRE of good: FREE < 1" in told
