"""Equations 1 and 2, constants and their order (Stewart 1994, 3.3.1 and 3.5)."""

import re

import pytest
from msgspec import structs
from verify_parts import configuration, task, texts

from pbonet.analysis import legality
from pbonet.analysis.legality.joins import BY_AGE, CONNECTORS
from pbonet.config.library import Library
from pbonet.config.model import Variable
from pbonet.errors import VerificationError


def test_the_pid_joint_control_of_figure_3_7_is_legal() -> None:
    tasks = (
        task("traj", outvar="Q_REF Q^_REF"),
        task("pid", invar="Q_REF Q^_REF Q_MEZ Q^_MEZ", outvar="T_REF"),
        task("robot", invar="T_REF", outvar="Q_MEZ Q^_MEZ"),
    )
    assert legality.check(configuration(*tasks)) == []


def test_two_writers_and_how_to_join_them() -> None:
    tasks = (
        task("pid", outvar="TAU", alias={"TAU": "T_REF"}),
        task("grav", outvar="T_REF"),
        task("arm", invar="T_REF"),
    )
    (problem,) = legality.check(configuration(*tasks))
    assert legality.as_text(problem) == (
        "grav.rmod: pid and grav both write T_REF (expected one task that writes a "
        "variable (equation 1), got 2: pid.rmod, grav.rmod); turn one off, or join "
        "them: SVARALIAS TAU=T_REF' in pid.rmod, SVARALIAS T_REF=T_REF'' in grav.rmod; "
        "T_REF' T_REF'' beside T_REF in the .svar file; a join connector (join_average "
        "or join_first or join_max or join_min) with SVARALIAS Z1=T_REF', "
        "SVARALIAS Z2=T_REF'', SVARALIAS Z=T_REF"
    )
    assert problem.code == "two-writers"
    assert problem.tasks == ("pid", "grav")
    assert problem.ports == ("TAU", "T_REF")
    assert problem.variables == ("T_REF",)


def test_the_remedy_for_two_writers_is_one() -> None:
    tasks = (
        task("pid", outvar="TAU", alias={"TAU": "T_REF'"}),
        task("grav", outvar="T_REF", alias={"T_REF": "T_REF''"}),
        task(
            "join", invar="A B", outvar="T_REF", alias={"A": "T_REF'", "B": "T_REF''"}
        ),
        task("arm", invar="T_REF"),
    )
    assert legality.check(configuration(*tasks)) == []


def test_names_before_join_connectors_fit_a_table() -> None:
    tasks = [task(f"t{n}", outvar="LONGEST_POSSIBLE"[:15]) for n in range(5)]
    (problem,) = legality.check(configuration(*tasks))
    names = problem.remedy.split("; ")[1].split(" beside")[0].split()
    assert len(set(names)) == 5 + 3
    assert all(len(name) == 15 for name in names)


def test_the_chain_in_the_remedy_for_three_writers_is_one() -> None:
    """What the remedy says is done to the letter, and is legal."""
    tasks = [task(f"t{n}", outvar="X") for n in range(3)]
    (problem,) = legality.check(configuration(*tasks))
    assert "turn all but one off" in problem.remedy
    producers, _, connectors = problem.remedy.split("; ")
    given = re.findall(r"SVARALIAS (\S+)=(\S+) in (\w+)\.rmod", producers)
    joined = [
        task(name, outvar=port, alias={port: variable})
        for port, variable, name in given
    ]
    for number, lines in enumerate(connectors.split(" with ")[1].split(" and ")):
        alias = dict(re.findall(r"SVARALIAS (\w+)=([^,\s]+)", lines))
        joined.append(task(f"j{number}", invar="Z1 Z2", outvar="Z", alias=alias))
    joined.append(task("reader", invar="X"))
    assert len(joined) == 6
    assert legality.check(configuration(*joined)) == []


def test_a_join_connector_of_the_library_is_named_only_where_it_fits() -> None:
    tasks = (task("a", outvar="N", info=None), task("b", outvar="N", info=None))
    counts = Variable(name="N", type="int")
    (problem,) = legality.check(configuration(*tasks, variables=[counts]))
    assert "a join connector (one of your own for its type) with" in problem.remedy


def test_the_join_connectors_that_are_named_are_in_the_library() -> None:
    found = [name for name in Library().modules() if name.startswith("join_")]
    assert tuple(found) == CONNECTORS


def test_an_off_task_writes_nothing() -> None:
    tasks = (task("a", outvar="X"), task("b", outvar="X"))
    assert legality.check(configuration(*tasks, on={"a"})) == []


def test_a_constant_is_no_variable_for_another_task() -> None:
    tasks = (task("a", outconst="X"), task("b", outvar="X"))
    (problem,) = legality.check(configuration(*tasks))
    assert legality.as_text(problem) == (
        "a.rmod: b and a both write X (expected one task that writes a variable "
        "(equation 1), got 2: b.rmod, a.rmod); rename one by SVARALIAS"
    )


def test_one_output_feeds_many() -> None:
    tasks = (task("a", outvar="X"), task("b", invar="X"), task("c", invar="X"))
    assert legality.check(configuration(*tasks)) == []


def test_an_input_without_writer_names_the_library() -> None:
    tasks = (task("arm", invar="T_GRAV"), task("log", invar="G", alias={"G": "T_GRAV"}))
    config = configuration(*tasks, producers={"T_GRAV": ("grav_comp",)})
    (problem,) = legality.check(config)
    assert legality.as_text(problem) == (
        "arm.rmod: no task that is ON writes T_GRAV, which arm and log read (expected "
        "a task that writes each variable that is read (equation 2)); in the library, "
        "grav_comp does; add it to the configuration"
    )
    assert problem.ports == ("T_GRAV", "G")


def test_inputs_that_one_task_does_not_write_are_told_at_once() -> None:
    tasks = (
        task("arm", invar="X Y Z V"),
        task("log", invar="V"),
        task("a", outvar="X Y Z V"),
    )
    found = legality.check(configuration(*tasks, on={"arm", "log"}))
    assert [(one.what, one.remedy) for one in found] == [
        ("no task that is ON writes X, Y and Z, which arm reads", "turn a on"),
        ("no task that is ON writes V, which arm and log read", "turn a on"),
    ]
    assert [one.variables for one in found] == [("X", "Y", "Z"), ("V",)]


def test_an_input_without_writer_that_stands_but_is_off() -> None:
    tasks = (task("arm", invar="X"), task("a", outvar="X"), task("b", outvar="X"))
    (problem,) = legality.check(configuration(*tasks, on={"arm"}))
    assert problem.remedy == "turn a or b on"


def test_an_input_that_nobody_has() -> None:
    (problem,) = legality.check(configuration(task("arm", invar="X")))
    assert problem.remedy == "add a task that writes X, or rename the port by SVARALIAS"


def test_a_variable_may_be_read_from_a_constant() -> None:
    tasks = (task("a", outconst="X"), task("b", invar="X"))
    assert legality.check(configuration(*tasks)) == []


def test_a_missing_constant() -> None:
    config = configuration(
        task("grav", inconst="DH", outvar="T"), producers={"DH": ("puma", "scara")}
    )
    (problem,) = legality.check(config)
    assert legality.as_text(problem) == (
        "grav.rmod: no task produces the constant DH, which grav needs (expected "
        "an existing task with it as an out-const); in the library, puma and scara "
        "do; add one of them to the configuration, or give it a value by INIT in the "
        ".svar file"
    )


def test_a_constant_that_is_written_as_a_variable() -> None:
    (problem,) = legality.check(
        configuration(task("grav", inconst="DH"), task("arm", outvar="DH"))
    )
    assert problem.got == "arm with it as an out-var"


def test_a_constant_of_the_table_is_told() -> None:
    config = configuration(task("grav", inconst="DH"), init={"DH": (6,)})
    (problem,) = legality.check(config)
    assert problem.severity == "warn"
    assert legality.as_text(problem) == (
        "grav.rmod: no task produces the constant DH, which grav needs; it has the "
        "value of its INIT line; add a task that writes DH, or rename the port by "
        "SVARALIAS"
    )


def test_two_producers_of_a_constant_even_when_off() -> None:
    tasks = (task("puma", outconst="DH"), task("scara", outconst="DH"))
    (problem,) = legality.check(configuration(*tasks, on=set()))
    assert problem.severity is legality.Severity.WARN
    assert legality.as_text(problem) == (
        "scara.rmod: puma and scara both produce the constant DH; they must give it "
        "the same value, because the table refuses another value (expected one value "
        "of a "
        "constant, got puma.rmod, scara.rmod); where values differ, swap one for the "
        "other, kill one of them, or give its constant another name by SVARALIAS"
    )


def test_constants_order_the_spawning() -> None:
    tasks = [
        task("grav", inconst="NDOF DH", outvar="T"),
        task("log"),
        task("tool", inconst="NDOF", outconst="DH"),
        task("puma", outconst="NDOF"),
    ]
    assert legality.spawn_order(tasks) == ["log", "puma", "tool", "grav"]
    assert legality.spawn_steps(tasks) == [["log"], ["puma"], ["tool"], ["grav"]]


def test_tasks_of_different_rtpus_are_spawned_at_once_unless_constants_forbid() -> None:
    tasks = [
        task("puma", outconst="NDOF", rtpu="arm0"),
        task("grav", inconst="NDOF", rtpu="arm1"),
        task("log", rtpu="arm1"),
        task("ball", rtpu="arm2"),
        task("trace", rtpu="arm0"),
    ]
    assert legality.spawn_order(tasks) == ["puma", "grav", "log", "ball", "trace"]
    steps = [["puma", "ball"], ["grav", "trace"], ["log"]]
    assert legality.spawn_steps(tasks) == steps, "the order of an RTPU stays"


def test_a_circle_of_constants_is_drawn() -> None:
    tasks = (
        task("a", inconst="C", outconst="A"),
        task("b", inconst="A", outconst="B1 B2"),
        task("c", inconst="B1 B2", outconst="C"),
        task("d", inconst="C"),
    )
    (problem,) = legality.check(configuration(*tasks, on=set()))
    assert legality.as_text(problem) == (
        "a.rmod: the tasks wait for each other's constants (expected constants that "
        "flow from task to task without a circle, got a --A--> b --B1, B2--> c --C--> "
        "a); give one of them its constant by LOCAL or from another task"
    )
    with pytest.raises(VerificationError) as caught:
        legality.spawn_order(tasks)
    assert str(caught.value) == (
        "a: the tasks wait for each other's constants (got a --A--> b --B1, B2--> c "
        "--C--> a); give one of them its constant by LOCAL or from another task"
    )


def test_a_task_that_waits_for_itself() -> None:
    (problem,) = legality.check(configuration(task("a", inconst="C", outconst="C")))
    assert problem.what == "task a waits for its own constant"
    assert problem.got == "a --C--> a"


def test_several_faults_are_one_error() -> None:
    tasks = (task("a", outvar="X"), task("b", outvar="X", invar="Y"))
    problems = legality.check(configuration(*tasks))
    error = legality.as_error(problems)
    first, second = texts(configuration(*tasks))
    assert str(error) == (
        f"2 faults make the configuration illegal:\n1. {first}\n2. {second}"
    )
    assert str(legality.as_error(problems[:1])) == first


def first_of(*variables, **alias):
    """A join_first of X1 and X2, in a table with these variables."""
    names = {"Z1": "X1", "Z2": "X2", "Z": "X"} | alias
    one = task("join", invar="Z1 Z2", outvar="Z", alias=names)
    one = structs.replace(one, rmod=structs.replace(one.rmod, module=BY_AGE))
    others = (task("a", outvar="X1"), task("b", outvar="X2"))
    return configuration(one, *others, variables=variables)


def test_what_goes_by_age_needs_a_variable_that_grows_old() -> None:
    (problem,) = legality.check(first_of())
    assert problem.severity is legality.Severity.WARN
    assert legality.as_text(problem) == (
        "join.rmod: X1 has no MAXAGE, so join considers it valid even when no task "
        "writes it any more, and never falls back for that; write MAXAGE and seconds "
        "under NAME X1 in the .svar file"
    )
    assert (problem.tasks, problem.variables) == (("join",), ("X1",))


def test_with_a_maxage_or_another_connector_there_is_nothing_to_say() -> None:
    aged = Variable(name="X1", type="double", maxage=0.1)
    assert legality.check(first_of(aged)) == []
    config = first_of()
    (one, *others) = config.tasks
    one = structs.replace(one, rmod=structs.replace(one.rmod, module="join_max"))
    assert legality.check(structs.replace(config, tasks=(one, *others))) == []


def joining(*units: str) -> list[str]:
    """Return what is said of a connector of X1, X2 and X with these units."""
    variables = [
        Variable(name=name, type="double", units=unit, maxage=1.0)
        for name, unit in zip(("X1", "X2", "X"), units, strict=True)
    ]
    config = first_of(*variables)
    tasks = [structs.replace(one, info=None) for one in config.tasks]
    return texts(structs.replace(config, tasks=tuple(tasks)))


def test_a_connector_joins_variables_of_one_unit() -> None:
    assert joining("rad", "radians", "any") == []
    (told,) = joining("deg", "rad", "rad")
    assert told == (
        "join.rmod: join joins variables of different units (expected one unit for Z1, "
        "Z2, Z, got Z1=X1 in deg, Z2=X2 in rad, Z=X in rad); 1 rad is 57.2958 deg; "
        "correct UNITS, or insert a gain that converts"
    )
    (told,) = joining("any", "rad", "m")
    assert "got Z2=X2 in rad, Z=X in m); correct UNITS" in told
