"""What is unsafe is a warning, and refused with STRICT."""

import pytest
from msgspec import structs
from verify_parts import configuration, module, port, task

from pbonet.analysis import legality
from pbonet.config.model import SvarFile, Variable

CODES = (legality.Code.NO_LIMIT, legality.Code.UNSAFE_ROBOT, legality.Code.RESTART)
APART = {"arm0": "one", "arm1": "other"}


def limits(**ages: float | None) -> SvarFile:
    variables = tuple(
        Variable(name=name, type="double", maxage=age) for name, age in ages.items()
    )
    return SvarFile(file="t.svar", defines={}, variables=variables)


def found(*tasks: legality.Task, age=None, strict=False, machines=APART, on=None):
    now = structs.replace(
        configuration(*tasks, on=on),
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
        module(port("invar", "U")),
        module_class="robot interface",
        robot_interface=True,
        critical_ok=ok,
    )
    made = task("arm", invar="U", info=info, rtpu="arm1")
    return structs.replace(made, rmod=structs.replace(made.rmod, critical=critical))


def guessed(one: legality.Task) -> legality.Task:
    """Return a robot interface whose module does not say that it is one."""
    return structs.replace(one, info=structs.replace(one.info, module_class=""))


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


def test_a_robot_interface_need_not_say_that_it_is_one() -> None:
    (one,) = found(writer(), guessed(robot(critical=False, ok=True)), age=0.1)
    assert one.what == (
        "arm is a robot interface (it reads variables, uses an output device of "
        "pbonet.io, and has no class) and not CRITICAL, so it acts while the "
        "configuration is illegal"
    )
    assert one.remedy.endswith(', or module_class="..." in mod if it moves nothing')


@pytest.mark.parametrize("restart", ["never", "off", "on"])
@pytest.mark.parametrize("says", [True, False])
def test_a_robot_interface_never_comes_on_unasked(restart, says) -> None:
    arm = structs.replace(robot(critical=True, ok=True), restart=restart)
    problems = found(writer(), arm if says else guessed(arm), age=0.1, strict=True)
    assert len(problems) == (restart == "on")
    for one in problems:
        assert one.severity is legality.Severity.WARN
        assert one.what.startswith("arm has RESTART on and is a robot interface")
        assert ("module_class" in one.remedy) is not says


def test_any_other_task_may_come_on_again() -> None:
    again = structs.replace(reader(max_age=0.1), restart="on")
    assert found(writer(), again) == []


@pytest.mark.parametrize("age", [None, 0.1])
def test_an_input_that_only_programs_write_is_refused(age) -> None:
    """Equation 2 is stricter than a warning, whether or not there is a limit."""
    now = structs.replace(configuration(reader()), svar=limits(U=age, Q=None))
    (one,) = [one for one in legality.check(now) if "no task" in one.what]
    assert (one.code, one.severity) == (
        legality.Code.NO_WRITER,
        legality.Severity.REFUSE,
    )


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize(
    ("critical", "said"),
    [
        (False, "spare is a robot interface and not CRITICAL"),
        (True, ""),
    ],
)
def test_a_standby_is_judged_before_it_is_on(critical, said, strict) -> None:
    """As if it were in its original's place already; TAKEOVER asks nobody."""
    arm = robot(critical=True, ok=True)
    made = robot(critical=critical, ok=True)
    rmod = structs.replace(made.rmod, module="spare")
    spare = structs.replace(made, rmod=rmod, task="spare", fallback_of=arm.name)
    problems = found(writer(), arm, spare, age=0.1, strict=strict, on={"src", "arm"})
    assert [said in one.what for one in problems] == [True] * bool(said)
    for one in problems:
        assert one.what.endswith(", once spare is in the place of arm")
        refused = legality.Severity.REFUSE
        assert (one.severity is refused) == strict


def test_the_inputs_of_a_standby_need_a_limit_too() -> None:
    """The original's do not: it is on the machine of what it reads."""
    near = structs.replace(reader(), rtpu="arm1")
    spare = structs.replace(reader(), task="spare", fallback_of="ctl")
    (one,) = found(writer(), near, spare, on={"src", "ctl"})
    assert one.what == (
        "spare reads U, which comes from src on another machine (arm1), whatever its "
        "age, once spare is in the place of ctl"
    )
