"""What is unsafe is a warning, and refused with STRICT."""

import pytest
from msgspec import structs
from verify_parts import configuration, module, port, task

from pbonet.analysis import legality
from pbonet.config.model import SvarFile, Variable

CODES = (legality.Code.NO_LIMIT, legality.Code.UNSAFE_ROBOT)
APART = {"arm0": "one", "arm1": "other"}


def limits(**ages: float | None) -> SvarFile:
    variables = tuple(
        Variable(name=name, type="double", maxage=age) for name, age in ages.items()
    )
    return SvarFile(file="t.svar", defines={}, variables=variables)


def found(*tasks: legality.Task, age=None, strict=False, machines=APART):
    now = structs.replace(
        configuration(*tasks),
        svar=limits(U=age, Q=None),
        machines=machines,
        strict=strict,
    )
    return [one for one in legality.check(now) if one.code in CODES]


def writer(rtpu="arm1", name="src") -> legality.Task:
    return task(name, outvar="U", info=module(port("outvar", "U")), rtpu=rtpu)


def reader(**more) -> legality.Task:
    info = module(port("invar", "U", **more), port("outvar", "Q"))
    return task("ctl", invar="U", outvar="Q", info=info, rtpu="arm0")


def robot(*, critical: bool, ok: bool) -> legality.Task:
    info = structs.replace(
        module(port("invar", "U")), module_class="robot interface", critical_ok=ok
    )
    made = task("arm", invar="U", info=info, rtpu="arm1")
    return structs.replace(made, rmod=structs.replace(made.rmod, critical=critical))


def test_an_input_from_another_machine_needs_a_limit() -> None:
    (one,) = found(writer(), reader())
    assert one.severity is legality.Severity.WARN
    assert one.what == (
        "ctl reads U, which comes from src on another machine (arm1), whatever its age"
    )
    assert "MAXAGE" in one.remedy
    assert (one.tasks, one.ports, one.variables) == (("ctl",), ("U",), ("U",))
    (one,) = found(writer(), reader(), strict=True)
    assert one.severity is legality.Severity.REFUSE


@pytest.mark.parametrize(
    ("tasks", "more"),
    [
        ((writer(), reader()), {"age": 0.1}),
        ((writer(), reader(max_age=0.1)), {}),
        ((writer("arm0"), reader()), {}),
        ((writer(), reader()), {"machines": {"arm0": "one", "arm1": "one"}}),
        ((writer(), reader()), {"machines": {}}),
    ],
    ids=["MAXAGE", "max_age", "one RTPU", "one machine", "not known"],
)
def test_other_inputs_need_none(tasks, more) -> None:
    assert found(*tasks, **more) == []


def test_an_input_over_a_link_needs_a_limit() -> None:
    receiver = writer("arm0")
    rmod = structs.replace(receiver.rmod, module="tbuf_receive")
    (one,) = found(structs.replace(receiver, rmod=rmod), reader())
    assert "which comes over the link that src receives" in one.what


@pytest.mark.parametrize(
    ("critical", "ok", "said"),
    [
        (False, True, "is a robot interface and not CRITICAL"),
        (False, False, "does not say what to do when the configuration is illegal"),
        (True, True, ""),
    ],
)
def test_a_robot_interface_is_critical_and_safe(critical, ok, said) -> None:
    problems = found(writer(), robot(critical=critical, ok=ok), age=0.1)
    assert [said in one.what for one in problems] == [True] * bool(said)
