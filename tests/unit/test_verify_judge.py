"""What may be changed: lists by their end, single signals by what they make worse."""

import pytest
from verify_parts import configuration, module, port, rtpu, task

from pbonet import verify
from pbonet.errors import VerificationError

PID = task("pid", invar="Q", outvar="T")
OTHER = task("dls", invar="Q", outvar="T")
ARM = task("arm", outconst="N", invar="T", outvar="Q", critical=True)
GRAV = task("grav", inconst="N", invar="Q", outvar="G")


def codes(problems) -> list[str]:
    return [problem.code.value for problem in problems]


def test_a_job_is_judged_by_its_end() -> None:
    verdict = verify.judge(configuration(PID, ARM, on=set()), verify.job([PID, ARM]))
    assert verdict.problems == ()
    assert verdict.after.on == {"pid", "arm"}
    verdict.check()
    verdict = verify.judge(configuration(PID, on=set()), verify.job([PID]))
    assert codes(verdict.refused) == ["no-writer"]
    with pytest.raises(VerificationError) as caught:
        verdict.check()
    assert str(caught.value) == verify.as_text(verdict.refused[0])


def test_a_loop_can_be_built_by_hand() -> None:
    config = configuration(PID, ARM, on=set())
    verdict = verify.judge(config, verify.signal("pid", "on"))
    assert verdict.refused == ()
    assert codes(verdict.warnings) == ["no-writer"]
    verdict = verify.judge(verdict.after, verify.signal("arm", "on"))
    assert verdict.problems == ()


def test_a_second_writer_is_refused_even_alone() -> None:
    config = configuration(PID, OTHER, ARM, on={"pid", "arm"})
    verdict = verify.judge(config, verify.signal("dls", "on"))
    assert codes(verdict.refused) == ["two-writers"]


@pytest.mark.parametrize("sent", ["off", "kill", "stop"])
def test_ending_is_never_refused(sent: str) -> None:
    config = configuration(PID, ARM, GRAV)
    verdict = verify.judge(config, verify.signal("arm", sent))
    assert verdict.refused == ()
    assert "no-writer" in codes(verdict.warnings)
    assert "arm" not in verdict.after.on
    assert (sent == "off") == ("arm" in [t.name for t in verdict.after.tasks])
    verdict = verify.judge(config, verify.reconfig([("arm", sent), ("pid", sent)]))
    assert verdict.refused == ()


def test_ending_what_is_not_there_is_told_only() -> None:
    verdict = verify.judge(configuration(PID, on=set()), verify.signal("pd", "kill"))
    assert verdict.refused == ()
    assert verify.as_text(verdict.problems[0]) == (
        "pd: there is no task pd to send kill to (expected pid, got pd); did you mean "
        "pid?"
    )
    verdict = verify.judge(configuration(PID, on=set()), verify.signal("pd", "on"))
    assert codes(verdict.refused) == ["unknown-task"]


def test_a_swap_is_legal_in_its_end() -> None:
    config = configuration(PID, OTHER, ARM, on={"pid", "arm"})
    swap = [("pid", "off"), ("dls", "on")]
    verdict = verify.judge(config, verify.reconfig(swap))
    assert verdict.problems == ()
    assert verdict.after.on == {"dls", "arm"}


def test_a_swap_in_the_wrong_order_is_warned_of() -> None:
    config = configuration(PID, OTHER, ARM, on={"pid", "arm"})
    verdict = verify.judge(config, verify.reconfig([("dls", "on"), ("pid", "off")]))
    assert verdict.refused == ()
    (problem,) = verdict.warnings
    assert verify.as_text(problem) == (
        "dls.rmod: pid and dls both write T while the list is carried out (expected "
        "one task that writes a variable (equation 1), got 2: pid.rmod, dls.rmod); "
        "turn pid off before dls is turned on, else the table refuses the second writer"
    )


def test_a_list_that_ends_illegally_is_refused_once() -> None:
    config = configuration(PID, OTHER, ARM, on={"pid", "arm"})
    verdict = verify.judge(config, verify.reconfig([("dls", "on")]))
    assert codes(verdict.problems) == ["two-writers"]
    assert codes(verdict.refused) == ["two-writers"]


def test_a_list_may_spawn_what_it_turns_on() -> None:
    config = configuration(PID, OTHER, ARM, on={"pid", "arm"})
    config = verify.Configuration(svar=config.svar, tasks=(PID, ARM), on=config.on)
    items = [("pid", "kill"), ("dls", "spawn"), ("dls", "on")]
    verdict = verify.judge(config, verify.reconfig(items, [OTHER]))
    assert verdict.problems == ()
    assert {t.name for t in verdict.after.tasks} == {"arm", "dls"}


def test_spawning_before_the_constants_producer_is_refused() -> None:
    config = configuration(ARM, GRAV, on=set())
    empty = verify.Configuration(
        svar=config.svar, producers=verify.producers([ARM.rmod, GRAV.rmod])
    )
    verdict = verify.judge(empty, verify.spawn(GRAV))
    assert codes(verdict.refused) == ["no-constant"]
    assert verdict.refused[0].remedy == (
        "in the library, arm does; add it to the configuration, or give it a value by "
        "INIT in the .svar file"
    )
    after = verify.judge(empty, verify.spawn(ARM)).after
    assert verify.judge(after, verify.spawn(GRAV)).problems == ()


GRIP = task("grip", outconst="MASS", outvar="T")
DRILL = task("drill", outconst="MASS", outvar="T")
SAW = task("saw", outconst="MASS", outvar="S")
SWAP = [("drill", "spawn"), ("grip", "off"), ("drill", "on")]


def test_a_second_giver_of_a_constant_is_told_when_it_comes() -> None:
    config = configuration(GRIP, DRILL, on=set())
    alone = verify.Configuration(svar=config.svar, tasks=(GRIP,))
    verdict = verify.judge(alone, verify.spawn(DRILL))
    assert codes(verdict.warnings) == ["two-constants"]
    verdict = verify.judge(alone, verify.reconfig(SWAP[:1], [DRILL]))
    assert codes(verdict.warnings) == ["two-constants"]
    assert codes(verify.check(config)) == ["two-constants"]


def test_an_exchange_of_two_givers_mends_what_it_would_warn_of() -> None:
    config = configuration(GRIP, DRILL, SAW)
    alone = verify.Configuration(
        svar=config.svar, tasks=(GRIP,), on=frozenset({"grip"})
    )
    change = verify.reconfig(SWAP, [DRILL], {"drill": ["grip"]})
    verdict = verify.judge(alone, change)
    assert verdict.problems == ()
    back = verify.reconfig([("drill", "off"), ("grip", "on")], [], {"grip": ["drill"]})
    assert verify.judge(verdict.after, back).problems == ()
    assert verify.judge(verdict.after, verify.signal("grip", "reinit")).problems == ()
    three = configuration(GRIP, DRILL, SAW)
    assert verify.judge(three, verify.signal("grip", "kill")).problems == ()


def test_a_third_giver_that_stays_is_told_of() -> None:
    config = configuration(GRIP, DRILL, SAW)
    two = verify.Configuration(
        svar=config.svar, tasks=(GRIP, SAW), on=frozenset({"grip", "saw"})
    )
    change = verify.reconfig(SWAP, [DRILL], {"drill": ["grip"]})
    (problem,) = verify.judge(two, change).problems
    assert problem.code is verify.Code.TWO_CONSTANTS
    assert "saw" in problem.what
    assert "drill" in problem.what


def test_one_that_is_replaced_and_stays_on_still_gives() -> None:
    config = configuration(GRIP, SAW)
    alone = verify.Configuration(
        svar=config.svar, tasks=(GRIP,), on=frozenset({"grip"})
    )
    items = [("saw", "spawn"), ("saw", "on")]
    change = verify.reconfig(items, [SAW], {"saw": ["grip"]})
    assert codes(verify.judge(alone, change).problems) == ["two-constants"]


def test_a_task_that_is_wrong_by_itself_is_not_spawned() -> None:
    info = module(port("outvar", "X"), critical_ok=False)
    wrong = task("a", outvar="X", critical=True, info=info)
    config = configuration(wrong)
    empty = verify.Configuration(svar=config.svar)
    assert codes(verify.judge(empty, verify.spawn(wrong)).refused) == ["no-stable"]


def test_a_signal_is_not_refused_for_what_was_wrong_before() -> None:
    config = configuration(PID, OTHER, ARM, GRAV, on={"pid", "dls", "arm"})
    verdict = verify.judge(config, verify.signal("grav", "on"))
    assert verdict.refused == ()
    assert codes(verdict.warnings) == ["two-writers"]
    config = configuration(PID, OTHER, ARM, on={"pid", "dls", "arm"})
    verdict = verify.judge(config, verify.spawn(task("log", invar="Q")))
    assert verdict.refused == ()
    assert codes(verdict.warnings) == ["two-writers"]


@pytest.mark.parametrize("sent", ["clear", "reinit", "17"])
def test_other_signals_change_nothing(sent: str) -> None:
    config = configuration(PID, OTHER)
    verdict = verify.judge(config, verify.signal("pid", sent))
    assert verdict.refused == ()
    assert verdict.after == config


def test_a_frequency_that_overloads_is_refused() -> None:
    slow = task("a", freq=100, maxc=0.001)
    other = task("b", freq=100, maxc=0.0025)
    config = configuration(slow, other, rtpus=[rtpu(scheduler="EDF")])
    faster = verify.Task(rmod=slow.rmod, info=slow.info, rtpu="arm0", freq=700.0)
    verdict = verify.judge(config, verify.frequency(faster))
    assert verdict.refused == ()
    assert verdict.after.tasks[0].hz == 700
    faster = verify.Task(rmod=slow.rmod, info=slow.info, rtpu="arm0", freq=800.0)
    verdict = verify.judge(config, verify.frequency(faster))
    assert codes(verdict.refused) == ["overload"]
    too_fast = verify.Task(rmod=slow.rmod, info=slow.info, rtpu="arm0", freq=1100.0)
    verdict = verify.judge(configuration(slow), verify.frequency(too_fast))
    assert codes(verdict.refused) == ["times"]


def test_every_problem_says_where_and_what_to_do() -> None:
    config = configuration(PID, OTHER, GRAV, rtpus=[rtpu("other")])
    problems = verify.check(config)
    assert len(set(codes(problems))) >= 3
    for problem in problems:
        assert problem.where
        assert problem.remedy
        assert problem.tasks
