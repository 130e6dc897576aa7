"""One task by itself: ports, variables, types, units, sizes, CRITICAL, RTPU."""

from typing import Any

import pytest
from msgspec import structs
from verify_parts import configuration, module, port, rtpu, task, texts

from pbonet.analysis import legality
from pbonet.analysis.legality.demands import SERVER_TYPES
from pbonet.config import parse_rmod
from pbonet.config.model import Limit, TaskType, Variable

RMOD = """MODULE mod
DESC a differentiator
SVARALIAS Z=Q
INCONST none
OUTCONST none
INVAR Z
OUTVAR Z^
TASKTYPE periodic
FREQ 100
EOF
"""


def test_a_list_that_is_to_have_no_port_is_written_as_none() -> None:
    info = module(port("outvar", "Y"))
    rmod = parse_rmod(RMOD, "diff.rmod")
    config = configuration(legality.Task(rmod=rmod, info=info, rtpu="arm0"), on=set())
    (text,) = [one for one in texts(config) if "INVAR lists" in one]
    assert text.endswith("; write INVAR none; 'pbonet library mod' shows the ports")


def test_ports_of_file_and_class_are_compared_both_ways() -> None:
    info = module(port("invar", "Z"), port("invar", "W"), port("outvar", "Y"))
    rmod = parse_rmod(RMOD, "diff.rmod")
    config = configuration(legality.Task(rmod=rmod, info=info, rtpu="arm0"), on=set())
    assert texts(config) == [
        "diff.rmod:6:1: INVAR does not list W, an in-var of the module mod (expected Z "
        "W, got Z); add W to INVAR",
        "diff.rmod:7:1: OUTVAR lists Z^, which is not a port of that kind in module "
        "mod "
        "(expected Y, got Z^); take it out; 'pbonet library mod' shows the ports",
        "diff.rmod:7:1: OUTVAR does not list Y, an out-var of the module mod (expected "
        "Y, got Z^); add Y to OUTVAR",
    ]


def test_a_port_in_the_wrong_list() -> None:
    info = module(port("outvar", "Z"))
    config = configuration(task("a", invar="Z", info=info), on=set())
    assert texts(config) == [
        "a.rmod: INVAR lists Z, which is not a port of that kind in module mod "
        "(expected "
        "none, got Z); list it under OUTVAR",
    ]


def test_a_port_that_is_read_and_written_is_to_stand_in_both_lists() -> None:
    info = module(port("invar", "Z"), port("outvar", "Z"))
    config = configuration(task("a", invar="Z", info=info), on=set())
    assert [problem.remedy for problem in legality.check(config)] == ["add Z to OUTVAR"]


@pytest.mark.parametrize("alias", [{}, {"T_GRAVV": "G"}], ids=["plain", "alias"])
def test_a_port_that_is_misspelt_is_told_once_and_first(alias) -> None:
    """Neither as missing, nor as an unknown variable, nor to those who read it."""
    info = module(port("invar", "Q"), port("outvar", "T_GRAV"))
    grav = task("grav", invar="Q", outvar="T_GRAVV", alias=alias, info=info)
    arm = task("arm", invar=alias.get("T_GRAVV", "T_GRAV"), outvar="Q")
    now = configuration(arm, grav)
    table = tuple(one for one in now.svar.variables if one.name != "T_GRAVV")
    now = structs.replace(now, svar=structs.replace(now.svar, variables=table))
    assert texts(now) == [
        "grav.rmod: OUTVAR lists T_GRAVV, which is not a port of that kind in module "
        "mod "
        "(expected T_GRAV, got T_GRAVV); did you mean T_GRAV?"
    ]


def test_a_port_that_is_misspelt_in_the_module_is_told_once() -> None:
    info = module(port("outvar", "T_GRAVV"))
    tasks = (task("arm", invar="T_GRAV"), task("grav", outvar="T_GRAV", info=info))
    assert texts(configuration(*tasks)) == [
        "grav.rmod: OUTVAR lists T_GRAV, which is not a port of that kind in module "
        "mod "
        "(expected T_GRAVV, got T_GRAV); did you mean T_GRAVV?"
    ]


def test_each_port_stands_for_one_that_is_misspelt() -> None:
    info = module(port("invar", "Q_REF"), port("invar", "Q_MEZ"))
    config = configuration(task("a", invar="Q_REFF Q_REEF", info=info), on=set())
    assert [problem.remedy for problem in legality.check(config)] == [
        *["did you mean Q_REF?"] * 2,
        "add Q_MEZ to INVAR",
    ]


def test_variables_of_a_port_that_the_module_does_not_have_are_not_asked_for() -> None:
    now = configuration(task("a", invar="A", info=module()), on=set())
    now = structs.replace(now, svar=structs.replace(now.svar, variables=()))
    assert [problem.code for problem in legality.check(now)] == [legality.Code.PORTS]


def test_an_unknown_class_is_not_judged() -> None:
    config = configuration(task("a", outvar="X", critical=True, info=None))
    assert texts(config) == []


def test_a_variable_that_the_table_does_not_have() -> None:
    one = task("a", invar="Z", outvar="FORCE", alias={"Z": "Q_MEZZ"})
    config = legality.Configuration(
        svar=configuration(task("b", outvar="Q_MEZ")).svar, tasks=(one,)
    )
    assert texts(config) == [
        "a.rmod: task a uses the variable Q_MEZZ for its port Z, which the table does "
        "not have (expected a variable of the .svar file, got Q_MEZZ); did you mean "
        "Q_MEZ? Else add Q_MEZZ to the .svar file, or rename the port by SVARALIAS",
        "a.rmod: task a uses the variable FORCE, which the table does not have "
        "(expected a variable of the .svar file, got FORCE); add FORCE to the .svar "
        "file, or rename the port by SVARALIAS",
    ]


@pytest.mark.parametrize(
    ("kind", "shape", "fitting", "other", "wanted"),
    [
        ("float", "1", ["float", "double", "float32"], "int", "a floating type"),
        ("int", "1", ["int", "byte", "uint64"], "double", "an integer type"),
        ("bool", "1", ["bool"], "byte", "bool"),
        ("float64[]", "1,1", ["double", "float64"], "float", "double"),
        ("int32[]", "1,1", ["int", "int32"], "unsigned", "int32"),
    ],
)
def test_the_type_behind_a_port(kind, shape, fitting, other, wanted) -> None:
    one = task("a", outvar="X", info=module(port("outvar", "X", shape, type=kind)))
    for name in fitting:
        fine = Variable(name="X", type=name)
        assert texts(configuration(one, variables=[fine])) == []
    wrong = Variable(name="X", type=other)
    assert texts(configuration(one, variables=[wrong])) == [
        f"a.rmod: the port X of task a cannot hold the variable X (expected {wanted}, "
        f"got {other} (the .svar file)); correct the variable's TYPE or connect "
        "another one"
    ]


def test_units_differ() -> None:
    one = task("a", outvar="X", info=module(port("outvar", "X", unit="rad/s")))
    for units in ("rad/s", "radians/seconds", "any"):
        variable = Variable(name="X", type="double", units=units)
        assert texts(configuration(one, variables=[variable])) == []
    variable = Variable(name="X", type="double", units="deg/s")
    assert texts(configuration(one, variables=[variable])) == [
        "a.rmod: the port X of task a and the variable X have different units "
        "(expected rad/s, got deg/s (the .svar file)); 1 deg/s is 0.0174533 rad/s; "
        "correct UNITS, or insert a module that converts"
    ]
    variable = Variable(name="X", type="double", units="N*m")
    assert legality.check(configuration(one, variables=[variable]))[0].remedy == (
        "correct UNITS, or insert a module that converts"
    )


def test_a_generic_port_goes_with_every_unit() -> None:
    one = task("a", outvar="X", info=module(port("outvar", "X", unit="any")))
    variable = Variable(name="X", type="double", units="furlong/fortnight")
    assert texts(configuration(one, variables=[variable])) == []


def sized(name: str, nelem: int) -> Variable:
    return Variable(name=name, type="double", nelem=nelem)


def test_the_ports_of_one_task_disagree_about_a_size() -> None:
    info = module(port("invar", "Q", "n"), port("outvar", "T", "n"))
    one = task("pid", invar="Q", outvar="T", info=info)
    config = configuration(one, variables=[sized("Q", 6), sized("T", 7)], on=set())
    (problem,) = legality.check(config)
    assert (problem.code, problem.tasks) == ("shape", ("pid",))
    assert problem.where == "pid.rmod: pid"
    assert "port t (T)" in problem.what
    assert "6" in problem.expected
    assert "7" in problem.got
    assert problem.remedy


def test_tasks_disagree_about_a_constant() -> None:
    """NDOF is one variable, so it is one size for everybody."""
    count = Variable(name="NDOF", type="int")

    def user(name: str, variable: str, constant: str = "NDOF") -> legality.Task:
        info = module(
            port("inconst", constant, type="int", attr="ndof"),
            port("outvar", variable, "ndof"),
        )
        alias = {} if constant == "NDOF" else {constant: "NDOF"}
        return task(name, inconst=constant, outvar=variable, info=info, alias=alias)

    arm = task(
        "arm", outconst="NDOF", info=module(port("outconst", "NDOF", type="int"))
    )
    tasks = (arm, user("a", "Q"), user("b", "T"), user("c", "X", "N"))
    table = [count, sized("Q", 6), sized("T", 6), sized("X", 7)]
    assert texts(configuration(*tasks, variables=table)) == [
        "NDOF: the constant NDOF cannot be the size of all its users (expected 6 as "
        "for a and b, got 7 for c); give the variables of these tasks the same NELEM, "
        "or connect one of them to another constant by SVARALIAS"
    ]
    table[-1] = sized("X", 6)
    assert texts(configuration(*tasks, variables=table)) == []


def test_a_free_name_is_each_tasks_own() -> None:
    first = task("a", outvar="Q", info=module(port("outvar", "Q", "n")))
    second = task("b", outvar="T", info=module(port("outvar", "T", "n")))
    table = [sized("Q", 6), sized("T", 7)]
    assert texts(configuration(first, second, variables=table)) == []


def test_a_constant_from_the_table_must_fit_too() -> None:
    info = module(port("inconst", "NDOF", type="int"), port("outvar", "Q", "ndof"))
    one = task("a", inconst="NDOF", outvar="Q", info=info)
    table = [Variable(name="NDOF", type="int", init=(7,)), sized("Q", 6)]
    problems = legality.check(configuration(one, variables=table))
    assert [problem.code for problem in problems] == ["shape", "no-constant"]
    assert "port q (Q)" in problems[0].what
    assert "7" in problems[0].expected
    assert "6" in problems[0].got


def test_critical_needs_stable() -> None:
    info = module(port("outvar", "X"), critical_ok=False)
    assert texts(configuration(task("a", outvar="X", info=info))) == []
    config = configuration(task("a", outvar="X", info=info, critical=True))
    assert texts(config) == [
        "a.rmod: task a is CRITICAL, but its module mod has no stable() (expected a "
        "module that says what it does while the configuration is illegal); write "
        "stable(self, dt) in mod, or take CRITICAL out"
    ]


@pytest.mark.parametrize(
    "tasktype", [kind for kind in TaskType if kind is not TaskType.PERIODIC]
)
def test_a_task_that_the_clock_does_not_time_needs_sync(tasktype: TaskType) -> None:
    given = {"capacity": 0.001} if tasktype in SERVER_TYPES else {}
    info = module(port("outvar", "X"), methods=("cycle",))
    one = task("a", outvar="X", info=info, tasktype=tasktype, **given)
    assert texts(configuration(one)) == [
        f"a.rmod: module mod has no sync(), which TASKTYPE {tasktype} counts on "
        "(expected def sync(self) in mod); write there how the task waits for its "
        "event, or make it periodic"
    ]
    one = task("a", outvar="X", tasktype=tasktype, **given)
    assert texts(configuration(one)) == []


def test_a_handler_needs_its_method() -> None:
    info = module(port("outvar", "X"), methods=("cycle",))
    assert texts(configuration(task("a", outvar="X", handler=6))) == []
    assert texts(configuration(task("a", outvar="X", info=info, handler=6))) == [
        "a.rmod: module mod has no timing_failure(), which HANDLER 6 counts on "
        "(expected def timing_failure(self, kind) in mod); implement the reaction "
        "there, or take HANDLER out of the .rmod file"
    ]


def test_safe_values_at_a_failure_need_one_of_each_out_var() -> None:
    """Not of some: the dispatcher writes all of them, as one set."""
    info = module(port("outvar", "X"))
    assert texts(configuration(task("a", outvar="X", info=info))) == []
    one = task("a", outvar="X", info=info, safe_at=("deadline", "maxexec"), maxc=0.001)
    assert texts(configuration(one)) == [
        "a.rmod: module mod has nothing to write at SAFE deadline maxexec (expected a "
        "safe value of X: OutVar(..., safe=0.0) in mod); write it there, or take SAFE "
        "out of the .rmod file"
    ]


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ({"safe_at": ("deadline",)}, []),
        ({"safe_at": ("maxexec",), "maxc": 0.001}, []),
        ({"safe_at": ("minexec",), "minc": 0.001}, []),
        (
            {"safe_at": ("deadline", "maxexec")},
            [
                "a.rmod: SAFE maxexec does nothing without MAXC (expected MAXC and "
                "seconds); write MAXC, or take maxexec out of SAFE"
            ],
        ),
        (
            {"safe_at": ("minexec",)},
            [
                "a.rmod: SAFE minexec does nothing without MINC (expected MINC and "
                "seconds); write MINC, or take minexec out of SAFE"
            ],
        ),
        (
            {"safe_at": ("deadline",), "tasktype": TaskType.BACKGROUND, "freq": None},
            [
                "a.rmod: SAFE does nothing with TASKTYPE background, which has no "
                "deadline (expected TASKTYPE periodic or synchronous); choose one of "
                "them, or take SAFE out of the .rmod file"
            ],
        ),
    ],
)
def test_safe_values_are_for_failures_that_can_come(
    given: dict[str, Any], found: list[str]
) -> None:
    info = module(port("outvar", "X", safe=(0.0,)))
    assert texts(configuration(task("a", outvar="X", info=info, **given))) == found


@pytest.mark.parametrize(
    ("safe", "limit", "good"),
    [
        ((0.0,), "error", False),
        ((0.0,), "clip", False),
        ((0.0,), "none", True),
        ((1.5,), "error", True),
        ((1.0, 2.0), "error", True),
        ((1.0, 2.5), "error", False),
    ],
)
def test_safe_values_must_be_within_the_limits(
    safe: tuple[float, ...], limit: str, good: bool
) -> None:
    """Nobody judges them when the dispatcher writes them."""
    info = module(port("outvar", "X", shape="2", safe=safe))
    table = Variable(name="X", type="double", nelem=2, min=(1.0, 1.0), max=(2.0, 2.0))
    table = structs.replace(table, limit=Limit(limit))
    one = task("a", outvar="X", info=info, safe_at=("deadline",))
    found = texts(configuration(one, variables=[table]))
    assert found == (
        []
        if good
        else [
            "a.rmod: the safe value of X in mod is outside the limits of X (expected "
            f"(1.0, 1.0) to (2.0, 2.0), got {safe}); write a safe value within them, "
            "or other limits in the .svar file"
        ]
    )


def test_an_rtpu_that_the_subsystem_does_not_have() -> None:
    rtpus = [rtpu("arm0"), rtpu("arm1")]
    assert texts(configuration(task("a", rtpu="arm1"), rtpus=rtpus)) == []
    assert texts(configuration(task("a", rtpu="arm2"), rtpus=rtpus)) == [
        "a.rmod: task a is to run on arm2, which the subsystem does not have (expected "
        "arm0 or arm1, got arm2); did you mean arm1?"
    ]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("rad/s", "radians/seconds"),
        ("rad/s^2", "rad / s**2"),
        ("N*m", "newton * meter"),
        ("N*m", "Nm"),
        ("N*m", "kg*m^2/s^2"),
        ("N*m/(rad*s)", "N*m/rad/s"),
        ("none", "dimensionless"),
        ("1/s", "Hz"),
        ("degC", "celsius"),
        ("counts  per turn", "counts per turn"),
        ("mixed", "mixed"),
        ("any", "whatever"),
    ],
)
def test_the_same_unit(one: str, other: str) -> None:
    assert legality.same_unit(one, other)
    assert legality.same_unit(other, one)


@pytest.mark.parametrize(
    ("one", "other", "conversion"),
    [
        ("deg", "rad", "1 deg is 0.0174533 rad"),
        ("m", "mm", "1 m is 1000 mm"),
        ("rpm", "rad/s", "1 rpm is 0.10472 rad/s"),
        ("rad", "none", ""),
        ("degC", "K", ""),
        ("N*m", "N", ""),
        ("counts per turn", "counts", ""),
        ("rad", "mixed", ""),
        ("9^9^9^9", "s", ""),
        ("s^1e9", "s", ""),
        ("(" * 90, "s", ""),
        ("__import__('os')", "s", ""),
    ],
)
def test_different_units(one: str, other: str, conversion: str) -> None:
    assert not legality.same_unit(one, other)
    assert not legality.same_unit(other, one)
    assert legality.conversion(one, other) == conversion
