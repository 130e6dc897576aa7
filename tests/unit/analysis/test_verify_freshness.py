"""Circles of tasks in which ages would never end are refused before anything moves."""

import pytest
from msgspec import structs
from verify_parts import configuration, module, port, task

from pbonet.analysis import legality
from pbonet.config.model import SvarFile, Variable

LOOP = (legality.Code.STAMP_LOOP, legality.Code.HOLD_LOOP)


def limits(**ages: float | None) -> SvarFile:
    variables = tuple(
        Variable(name=name, type="double", maxage=age) for name, age in ages.items()
    )
    return SvarFile(file="t.svar", defines={}, variables=variables)


def found(svar: SvarFile, *tasks: legality.Task) -> list[legality.Problem]:
    problems = legality.check(structs.replace(configuration(*tasks), svar=svar))
    return [one for one in problems if one.code in LOOP]


def robot(*, new: bool = False, **more) -> legality.Task:
    info = module(port("invar", "U", **more), port("outvar", "Q", new=new))
    return task("robot", invar="U", outvar="Q", info=info)


def pd(stale: str | None = None, **more) -> legality.Task:
    ports = port("invar", "Q", **more), port("invar", "REF"), port("outvar", "U")
    return task("pd", invar="Q REF", outvar="U", info=module(*ports), stale=stale)


def test_a_circle_without_new_information_is_refused() -> None:
    (one,) = found(limits(Q=None, U=0.05, REF=None), robot(), pd())
    assert one.code is legality.Code.STAMP_LOOP
    assert one.severity is legality.Severity.REFUSE
    assert set(one.tasks) == {"robot", "pd"}
    assert "OutVar(..., new=True)" in one.remedy


@pytest.mark.parametrize(
    "tasks",
    [
        (robot(new=True), pd()),
        (robot(feedback=True), pd()),
        (robot(), pd(feedback=True)),
    ],
)
def test_one_declaration_opens_the_circle(tasks) -> None:
    assert found(limits(Q=0.05, U=0.05, REF=None), *tasks) == []


def test_a_circle_in_which_nothing_has_a_limit_is_none() -> None:
    assert found(limits(Q=None, U=None, REF=None), robot(), pd()) == []


def test_tasks_that_all_hold_for_each_other_are_refused() -> None:
    svar = limits(Q=0.05, U=0.05, REF=None)
    both = robot(new=True, stale="hold"), pd(stale="hold")
    (one,) = found(svar, *both)
    assert one.code is legality.Code.HOLD_LOOP
    assert found(svar, robot(new=True), pd(stale="hold")) == []
