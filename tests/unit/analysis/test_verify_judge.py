"""What may be changed: lists by their end, single signals by what they make worse."""

import pytest
from verify_parts import configuration, module, port, rtpu, task

from pbonet.analysis import legality
from pbonet.errors import VerificationError

PID = task("pid", invar="Q", outvar="T")
OTHER = task("dls", invar="Q", outvar="T")
ARM = task("arm", outconst="N", invar="T", outvar="Q", critical=True)
GRAV = task("grav", inconst="N", invar="Q", outvar="G")


def codes(problems) -> list[str]:
    return [problem.code.value for problem in problems]


def test_a_job_is_judged_by_its_end() -> None:
    verdict = legality.judge(
        configuration(PID, ARM, on=set()), legality.job([PID, ARM])
    )
    assert verdict.problems == ()
    assert verdict.after.on == {"pid", "arm"}
    verdict.check()
    verdict = legality.judge(configuration(PID, on=set()), legality.job([PID]))
    assert codes(verdict.refused) == ["no-writer"]
    with pytest.raises(VerificationError) as caught:
        verdict.check()
    assert str(caught.value) == legality.as_text(verdict.refused[0])


def test_a_loop_can_be_built_by_hand() -> None:
    config = configuration(PID, ARM, on=set())
    verdict = legality.judge(config, legality.signal("pid", "on"))
    assert verdict.refused == ()
    assert codes(verdict.warnings) == ["no-writer"]
    verdict = legality.judge(verdict.after, legality.signal("arm", "on"))
    assert verdict.problems == ()


def test_a_second_writer_is_refused_even_alone() -> None:
    config = configuration(PID, OTHER, ARM, on={"pid", "arm"})
    verdict = legality.judge(config, legality.signal("dls", "on"))
    assert codes(verdict.refused) == ["two-writers"]


@pytest.mark.parametrize("sent", ["off", "kill", "stop"])
def test_ending_is_never_refused(sent: str) -> None:
    config = configuration(PID, ARM, GRAV)
    verdict = legality.judge(config, legality.signal("arm", sent))
    assert verdict.refused == ()
    assert "no-writer" in codes(verdict.warnings)
    assert "arm" not in verdict.after.on
    assert (sent == "off") == ("arm" in [t.name for t in verdict.after.tasks])
    verdict = legality.judge(config, legality.reconfig([("arm", sent), ("pid", sent)]))
    assert verdict.refused == ()


def test_ending_what_is_not_there_is_told_only() -> None:
    verdict = legality.judge(
        configuration(PID, on=set()), legality.signal("pd", "kill")
    )
    assert verdict.refused == ()
    assert legality.as_text(verdict.problems[0]) == (
        "pd: there is no task pd to send kill to (expected pid, got pd); did you mean "
        "pid?"
    )
    verdict = legality.judge(configuration(PID, on=set()), legality.signal("pd", "on"))
    assert codes(verdict.refused) == ["unknown-task"]


def test_a_swap_is_legal_in_its_end() -> None:
    config = configuration(PID, OTHER, ARM, on={"pid", "arm"})
    swap = [("pid", "off"), ("dls", "on")]
    verdict = legality.judge(config, legality.reconfig(swap))
    assert verdict.problems == ()
    assert verdict.after.on == {"dls", "arm"}


def test_a_swap_in_the_wrong_order_is_warned_of() -> None:
    config = configuration(PID, OTHER, ARM, on={"pid", "arm"})
    verdict = legality.judge(config, legality.reconfig([("dls", "on"), ("pid", "off")]))
    assert verdict.refused == ()
    (problem,) = verdict.warnings
    assert legality.as_text(problem) == (
        "dls.rmod: pid and dls both write T while the list is carried out (expected "
        "one task that writes a variable (equation 1), got 2: pid.rmod, dls.rmod); "
        "turn pid off before dls is turned on, else the table refuses the second writer"
    )


def test_a_list_that_ends_illegally_is_refused_once() -> None:
    config = configuration(PID, OTHER, ARM, on={"pid", "arm"})
    verdict = legality.judge(config, legality.reconfig([("dls", "on")]))
    assert codes(verdict.problems) == ["two-writers"]
    assert codes(verdict.refused) == ["two-writers"]


def test_a_list_may_spawn_what_it_turns_on() -> None:
    config = configuration(PID, OTHER, ARM, on={"pid", "arm"})
    config = legality.Configuration(svar=config.svar, tasks=(PID, ARM), on=config.on)
    items = [("pid", "kill"), ("dls", "spawn"), ("dls", "on")]
    verdict = legality.judge(config, legality.reconfig(items, [OTHER]))
    assert verdict.problems == ()
    assert {t.name for t in verdict.after.tasks} == {"arm", "dls"}


def test_spawning_before_the_constants_producer_is_refused() -> None:
    config = configuration(ARM, GRAV, on=set())
    empty = legality.Configuration(
        svar=config.svar, producers=legality.producers([ARM.rmod, GRAV.rmod])
    )
    verdict = legality.judge(empty, legality.spawn(GRAV))
    assert codes(verdict.refused) == ["no-constant"]
    assert verdict.refused[0].remedy == (
        "in the library, arm does; add it to the configuration, or give it a value by "
        "INIT in the .svar file"
    )
    after = legality.judge(empty, legality.spawn(ARM)).after
    assert legality.judge(after, legality.spawn(GRAV)).problems == ()


GRIP = task("grip", outconst="MASS", outvar="T")
DRILL = task("drill", outconst="MASS", outvar="T")
SAW = task("saw", outconst="MASS", outvar="S")
SWAP = [("drill", "spawn"), ("grip", "off"), ("drill", "on")]


def test_a_second_giver_of_a_constant_is_told_when_it_comes() -> None:
    config = configuration(GRIP, DRILL, on=set())
    alone = legality.Configuration(svar=config.svar, tasks=(GRIP,))
    verdict = legality.judge(alone, legality.spawn(DRILL))
    assert codes(verdict.warnings) == ["two-constants"]
    verdict = legality.judge(alone, legality.reconfig(SWAP[:1], [DRILL]))
    assert codes(verdict.warnings) == ["two-constants"]
    assert codes(legality.check(config)) == ["two-constants"]


def test_an_exchange_of_two_givers_mends_what_it_would_warn_of() -> None:
    config = configuration(GRIP, DRILL, SAW)
    alone = legality.Configuration(
        svar=config.svar, tasks=(GRIP,), on=frozenset({"grip"})
    )
    change = legality.reconfig(SWAP, [DRILL], {"drill": ["grip"]})
    verdict = legality.judge(alone, change)
    assert verdict.problems == ()
    back = legality.reconfig(
        [("drill", "off"), ("grip", "on")], [], {"grip": ["drill"]}
    )
    assert legality.judge(verdict.after, back).problems == ()
    assert (
        legality.judge(verdict.after, legality.signal("grip", "reinit")).problems == ()
    )
    three = configuration(GRIP, DRILL, SAW)
    assert legality.judge(three, legality.signal("grip", "kill")).problems == ()


def test_a_third_giver_that_stays_is_told_of() -> None:
    config = configuration(GRIP, DRILL, SAW)
    two = legality.Configuration(
        svar=config.svar, tasks=(GRIP, SAW), on=frozenset({"grip", "saw"})
    )
    change = legality.reconfig(SWAP, [DRILL], {"drill": ["grip"]})
    (problem,) = legality.judge(two, change).problems
    assert problem.code is legality.Code.TWO_CONSTANTS
    assert "saw" in problem.what
    assert "drill" in problem.what


def test_one_that_is_replaced_and_stays_on_still_gives() -> None:
    config = configuration(GRIP, SAW)
    alone = legality.Configuration(
        svar=config.svar, tasks=(GRIP,), on=frozenset({"grip"})
    )
    items = [("saw", "spawn"), ("saw", "on")]
    change = legality.reconfig(items, [SAW], {"saw": ["grip"]})
    assert codes(legality.judge(alone, change).problems) == ["two-constants"]


def test_a_task_that_is_wrong_by_itself_is_not_spawned() -> None:
    info = module(port("outvar", "X"), critical_ok=False)
    wrong = task("a", outvar="X", critical=True, info=info)
    config = configuration(wrong)
    empty = legality.Configuration(svar=config.svar)
    assert codes(legality.judge(empty, legality.spawn(wrong)).refused) == ["no-stable"]


def test_a_signal_is_not_refused_for_what_was_wrong_before() -> None:
    config = configuration(PID, OTHER, ARM, GRAV, on={"pid", "dls", "arm"})
    verdict = legality.judge(config, legality.signal("grav", "on"))
    assert verdict.refused == ()
    assert codes(verdict.warnings) == ["two-writers"]
    config = configuration(PID, OTHER, ARM, on={"pid", "dls", "arm"})
    verdict = legality.judge(config, legality.spawn(task("log", invar="Q")))
    assert verdict.refused == ()
    assert codes(verdict.warnings) == ["two-writers"]


@pytest.mark.parametrize("sent", ["clear", "reinit", "17"])
def test_other_signals_change_nothing(sent: str) -> None:
    config = configuration(PID, OTHER)
    verdict = legality.judge(config, legality.signal("pid", sent))
    assert verdict.refused == ()
    assert verdict.after == config


def test_a_frequency_that_overloads_is_refused() -> None:
    slow = task("a", freq=100, maxc=0.001)
    other = task("b", freq=100, maxc=0.0025)
    edf = [rtpu(scheduler="EDF")]
    config = configuration(slow, other, rtpus=edf, strict=True)
    faster = legality.Task(rmod=slow.rmod, info=slow.info, rtpu="arm0", freq=700.0)
    verdict = legality.judge(config, legality.frequency(faster))
    assert verdict.refused == ()
    assert verdict.after.tasks[0].hz == 700
    faster = legality.Task(rmod=slow.rmod, info=slow.info, rtpu="arm0", freq=800.0)
    verdict = legality.judge(config, legality.frequency(faster))
    assert codes(verdict.refused) == ["not-guaranteed"]
    too_fast = legality.Task(rmod=slow.rmod, info=slow.info, rtpu="arm0", freq=1100.0)
    verdict = legality.judge(configuration(slow), legality.frequency(too_fast))
    assert codes(verdict.refused) == ["times"]


def test_every_problem_says_where_and_what_to_do() -> None:
    config = configuration(PID, OTHER, GRAV, rtpus=[rtpu("other")])
    problems = legality.check(config)
    assert len(set(codes(problems))) >= 3
    for problem in problems:
        assert problem.where
        assert problem.remedy
        assert problem.tasks
