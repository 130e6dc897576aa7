"""Ages that travel with the data, and when a task goes on after an interruption."""

import os

import pytest

from pbonet.config.model import Variable
from pbonet.svar import Action, Flags, Freshness, Table

ME = os.getpid()
MS = 1_000_000
START = 1_000_000_000


@pytest.fixture
def table():
    variables = (
        Variable(name="SENSOR", type="double", maxage=0.05),
        Variable(name="PLAIN", type="double"),
        Variable(name="MIDDLE", type="double"),
        Variable(name="END", type="double"),
    )
    with Table.create(f"fresh{ME}", variables) as made:
        made.virtual = lambda: START
        made.path.unlink()
        yield made


def local(table, name, ins, out, settle=None, **one):
    made = table.local(name, ME, invar=ins, outvar=[out] if out else [])
    made.keep_fresh({table.index(v): Freshness(**one) for v in ins}, settle)
    return made


def step(task, now, cycle=1):
    """Copy in and out at a time; return the flags of the copy."""
    task.virtual_ns = now
    flags = task.copy_in()
    task.commit(now, cycle)
    return flags


def chain(table):
    """Return a sensor, a filter and a controller, all ON."""
    sensor = local(table, "sensor", [], "SENSOR")
    middle = local(table, "middle", ["SENSOR", "PLAIN"], "MIDDLE")
    end = local(table, "end", ["MIDDLE"], "END")
    for one in (sensor, middle, end):
        one.virtual_ns = START
        one.copy_in_on()
        one.claim(START)
    return sensor, middle, end


def test_the_age_of_the_sensor_travels_through_tasks_without_limits(table):
    sensor, middle, end = chain(table)
    sensor.commit(START + 10 * MS, 1)
    step(middle, START + 12 * MS)
    step(end, START + 14 * MS)
    for name in ("MIDDLE", "END"):
        assert table.info(name).time_ns == START + 10 * MS, name
    assert table.info("END").cycle == 1, "the mark is no part of the number"
    step(middle, START + 40 * MS)  # the sensor has stopped, the others have not
    step(end, START + 42 * MS)
    assert table.info("END").time_ns == START + 10 * MS
    assert end.age("MIDDLE") == pytest.approx(0.032)


def test_a_constant_input_is_not_old_data(table):
    table.write("PLAIN", [1.0])
    only = local(table, "only", ["PLAIN"], "MIDDLE")
    only.copy_in_on()
    only.claim(START)
    step(only, START + 10**12)
    assert table.info("MIDDLE").time_ns == START + 10**12


def test_what_was_computed_from_a_value_never_written_is_old(table):
    middle = local(table, "middle", ["SENSOR"], "MIDDLE")
    middle.virtual_ns = START
    middle.copy_in_on()
    middle.claim(START)
    assert table.info("MIDDLE").time_ns == 1
    assert middle.age("SENSOR") == float("inf")


def test_an_input_whose_age_is_not_passed_on(table):
    sensor, _, _ = chain(table)
    task = local(table, "other", ["SENSOR"], "PLAIN", passes=False)
    task.copy_in_on()
    task.claim(START)
    sensor.commit(START, 1)
    step(task, START + 30 * MS)
    assert table.info("PLAIN").time_ns == START + 30 * MS


def test_the_own_time_of_a_module_goes_before_that_of_its_inputs(table):
    chain(table)
    task = local(table, "other", ["SENSOR"], "PLAIN")
    task.copy_in_on()
    task.claim(START, own_ns=START - MS)
    assert table.info("PLAIN").time_ns == START - MS


def test_a_task_that_reads_its_own_output_does_not_grow_old(table):
    task = local(table, "own", ["SENSOR"], "SENSOR")
    task.copy_in_on()
    task.claim(START)
    for i in range(1, 100):
        step(task, START + i * MS)
    assert table.info("SENSOR").time_ns == START + 99 * MS


def test_the_tighter_limit_counts(table):
    sensor = local(table, "sensor", [], "SENSOR")
    sensor.claim(START)
    tight = local(table, "t", ["SENSOR"], None, max_age=0.01)
    loose = local(table, "l", ["SENSOR"], None, max_age=1.0)
    for one, stale in ((tight, True), (loose, False)):
        one.virtual_ns = START + 20 * MS
        assert bool(one.copy_in() & Flags.COPY_STALE) is stale
        assert one.stale("SENSOR") is stale


def test_it_goes_on_when_each_input_has_come_twice_more(table):
    sensor = local(table, "sensor", [], "SENSOR")
    sensor.claim(START)
    robot = local(table, "robot", ["SENSOR"], None, action=Action.STABLE)
    robot.virtual_ns = START
    robot.copy_in_on()
    assert step(robot, START) == 0
    assert step(robot, START + 60 * MS) == Flags.COPY_STALE
    assert robot.action == Action.STABLE
    now = START + 70 * MS
    for come in (1, 2):
        sensor.commit(now, come)
        for _ in range(5):  # a fast reader sees one value many times: it counts once
            now += MS
            assert step(robot, now) == Flags.COPY_SETTLING
            assert robot.action == Action.STABLE
    sensor.commit(now, 3)
    assert step(robot, now + MS) == 0
    assert robot.action == Action.GO_ON


def test_it_goes_on_after_the_declared_time(table):
    sensor = local(table, "sensor", [], "SENSOR")
    sensor.claim(START)
    robot = local(table, "robot", ["SENSOR"], None, 0.02, action=Action.HOLD)
    robot.virtual_ns = START
    robot.copy_in_on()
    step(robot, START)
    assert step(robot, START + 60 * MS) == Flags.COPY_STALE
    seen = []
    for i in range(61, 90):
        sensor.commit(START + i * MS, i)
        seen.append(step(robot, START + i * MS) == Flags.COPY_SETTLING)
    assert seen == [True] * 20 + [False] * 9


def test_inputs_at_their_limit_do_not_make_it_flutter(table):
    sensor = local(table, "sensor", [], "SENSOR")
    sensor.claim(START)
    robot = local(table, "robot", ["SENSOR"], None, action=Action.STABLE)
    robot.virtual_ns = START
    robot.copy_in_on()
    step(robot, START)
    changes, last = 0, robot.action
    for i in range(1, 40):  # each value comes after 60 ms, of which 50 are allowed
        for ms in (5, 59):
            step(robot, START + (60 * i + ms) * MS)
            changes += robot.action != last
            last = robot.action
        sensor.commit(START + 60 * (i + 1) * MS, i)
    assert changes == 1


def test_the_strongest_action_counts(table):
    reader = table.local("r", ME, invar=["SENSOR", "PLAIN"])
    reader.keep_fresh({
        table.index("SENSOR"): Freshness(action=Action.HOLD),
        table.index("PLAIN"): Freshness(0.1, Action.SAFE),
    })
    reader.virtual_ns = START
    reader.copy_in()
    assert reader.action == Action.SAFE


def test_the_age_of_a_chosen_input_alone(table):
    sensor, middle, _ = chain(table)
    sensor.commit(START + 5 * MS, 1)
    step(middle, START + 9 * MS)
    assert middle.stamp_of("SENSOR") == START + 5 * MS
    assert middle.stamp_of("PLAIN") == 0, "it has no limit, so its age does not count"
