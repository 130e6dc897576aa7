"""A job is judged with each standby in its original's place, and never with both."""

from functools import partial

import pytest
from msgspec import structs
from verify_parts import configuration, task

from pbonet.analysis import legality
from pbonet.config.model import RtpuEntry, Variable


def standby(original, name="safe", **more):
    return structs.replace(task(name, **more), fallback_of=original)


def judged(*tasks, **more):
    empty = configuration(*tasks, on=set(), **more)
    return legality.judge(structs.replace(empty, tasks=()), legality.job(tasks))


def whats(verdict):
    return [problem.what for problem in verdict.problems]


READER = task("robot", invar="T")


def test_a_standby_is_not_turned_on_and_no_second_writer():
    verdict = judged(task("pid", outvar="T"), standby("pid", outvar="T"), READER)
    assert verdict.after.on == {"pid", "robot"}
    assert verdict.problems == ()


def test_a_standby_must_write_what_others_read():
    verdict = judged(task("pid", outvar="T"), standby("pid", outvar="U"), READER)
    assert whats(verdict) == [
        "no task that is ON writes T, which robot reads, once safe is in the place of "
        "pid"
    ]
    assert verdict.refused


def test_a_standby_must_find_its_own_inputs_and_take_nobodys_outputs():
    verdict = judged(
        task("pid", outvar="T"),
        standby("pid", outvar="T V", invar="CAMERA"),
        task("other", outvar="V"),
        READER,
    )
    assert whats(verdict) == [
        "safe and other both write V, once safe is in the place of pid",
        "no task that is ON writes CAMERA, which safe reads, once safe is in the place "
        "of pid",
    ]


def heavy(name, share, **more):
    return task(name, freq=100.0, maxc=share / 100.0, **more)


def test_the_load_counts_one_of_the_two():
    rtpus = (RtpuEntry(name="arm0"),)
    pid = heavy("pid", 0.5, outvar="T")
    light = structs.replace(heavy("safe", 0.4, outvar="T"), fallback_of="pid")
    assert judged(pid, light, READER, rtpus=rtpus).problems == ()
    large = structs.replace(heavy("safe", 1.2, outvar="T"), fallback_of="pid")
    told = whats(judged(pid, large, READER, rtpus=rtpus))
    assert (
        "on RTPU arm0 safe may miss deadlines, once safe is in the place of pid" in told
    )


def test_the_load_of_several_standbys_is_judged_together():
    rtpus = (RtpuEntry(name="arm0"),)
    tasks = (
        heavy("a", 0.1, outvar="A"),
        heavy("b", 0.1, outvar="B"),
        structs.replace(heavy("a_safe", 0.6, outvar="A"), fallback_of="a"),
        structs.replace(heavy("b_safe", 0.6, outvar="B"), fallback_of="b"),
    )
    assert whats(judged(*tasks, rtpus=rtpus)) == [
        "on RTPU arm0 b_safe may miss deadlines, once every fallback is engaged"
    ]


def test_a_standby_that_is_engaged_is_judged_as_any_task():
    tasks = (task("pid", outvar="T"), standby("pid", outvar="T"), READER)
    assert legality.check(configuration(*tasks, on={"safe", "robot"})) == []


def test_an_original_that_is_turned_on_beside_its_fallback_is_swapped_back():
    tasks = (task("pid", outvar="T"), standby("pid", outvar="T"), READER)
    fell = configuration(*tasks, on={"safe", "robot"})
    (problem,) = legality.judge(fell, legality.signal("pid", "on")).problems
    assert problem.remedy == (
        "`swap safe pid` lets pid take over again, and its fallback safe stands by"
    )


def away(takeover, *, rtpu="arm1", critical=True, **more):
    """Judge an original on arm0, and a standby on another RTPU."""
    first = task("pid", outvar="T")
    first = structs.replace(
        first, rtpu="arm0", rmod=structs.replace(first.rmod, critical=critical)
    )
    spare = standby("pid", outvar="T")
    spare = structs.replace(spare, rtpu=rtpu, takeover=takeover)
    rtpus = tuple(RtpuEntry(name=f"arm{n}") for n in range(3))
    limit = Variable(name="T", type="double", maxage=0.1)  # READER is on arm0
    judge = partial(judged, first, spare, READER, rtpus=rtpus, variables=(limit,))
    return judge(**more).problems


APART = {"arm0": "a", "arm1": "b", "arm2": "b"}


@pytest.mark.parametrize(
    ("takeover", "more"),
    [
        (0.0, {"machines": APART, "keeper": "arm0", "alone": 0.0}),
        (3.0, {"machines": APART, "keeper": "arm2"}),
        (0.5, {"machines": dict.fromkeys(APART, "a"), "keeper": "arm0"}),
        (0.5, {"keeper": "arm0"}),
    ],
    ids=["by an order alone", "long enough", "on one machine", "of unknown machines"],
)
def test_a_standby_on_another_rtpu_is_legal(takeover, more):
    assert away(takeover, **more) == ()


@pytest.mark.parametrize(
    ("takeover", "said", "more"),
    [
        (3.0, "TAKEOVER is for the loss of another RTPU", {"rtpu": "arm0"}),
        (3.0, "has the keeper arm0, so it is never alone", {"keeper": "arm0"}),
        (2.9, "must have ended its cycles before", {}),
        (30.0, "must have ended its cycles before", {"alone": 0.0}),
        (3.0, "pid is not CRITICAL", {"critical": False}),
    ],
    ids=["one RTPU", "the keeper's machine", "too early", "never alone", "goes on"],
)
def test_a_standby_that_could_write_beside_its_original_is_refused(
    takeover, said, more
):
    (problem,) = away(takeover, **{"machines": APART, "keeper": "arm2", **more})
    assert problem.code is legality.Code.FALLBACK_RTPU
    assert problem.severity is legality.Severity.REFUSE
    assert said in problem.what
