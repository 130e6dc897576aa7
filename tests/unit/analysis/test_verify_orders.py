"""Orders of turning on and off, and user priorities from the data flow (6.2.4)."""

from verify_parts import task

from pbonet.analysis import legality


def puma() -> list[legality.Task]:
    """Joint teleoperation of the thesis's Figure 6.10."""
    return [
        task(
            "puma_pidg",
            outconst="NDOF",
            invar="Q_REF Q^_REF T_GRAV",
            outvar="Q_MEZ Q^_MEZ",
            critical=True,
            freq=500,
        ),
        task("grav_comp", inconst="NDOF", invar="Q_MEZ", outvar="T_GRAV", freq=250),
        task("diff", inconst="NDOF", invar="Q_REF", outvar="Q^_REF"),
        task("jtball", inconst="NDOF", outvar="Q_REF", freq=50),
    ]


def test_the_loop_is_opened_in_front_of_the_critical_task() -> None:
    assert legality.flow_order(puma()) == ["jtball", "diff", "puma_pidg", "grav_comp"]
    assert legality.user_priorities(puma()) == {
        "jtball": 4,
        "diff": 3,
        "puma_pidg": 2,
        "grav_comp": 1,
    }


def test_the_producer_has_the_higher_priority_as_in_figure_6_3() -> None:
    tasks = [task("b", invar="X", outvar="Y"), task("a", outvar="X")]
    priorities = legality.user_priorities(tasks)
    assert priorities["a"] > priorities["b"]


def test_without_critical_tasks_the_fastest_comes_first_then_the_name() -> None:
    loop = [
        task("b", invar="X", outvar="Y", freq=100),
        task("a", invar="Z", outvar="X", freq=100),
        task("c", invar="Y", outvar="Z", freq=200),
    ]
    assert legality.flow_order(loop) == ["c", "a", "b"]
    assert legality.flow_order(loop[:2][::-1]) == ["a", "b"]
    even = [task(t.name, invar="X", outvar="X", freq=1) for t in loop]
    assert legality.flow_order(even) == ["a", "b", "c"]


def test_two_loops_through_one_task_are_both_opened() -> None:
    tasks = [
        task("left", invar="Q", outvar="L"),
        task("right", invar="Q", outvar="R"),
        task("arm", invar="L R", outvar="Q", critical=True),
    ]
    assert legality.flow_order(tasks) == ["arm", "left", "right"]


def test_sensors_are_turned_on_first_and_critical_tasks_last() -> None:
    assert legality.on_order(puma()) == ["jtball", "diff", "grav_comp", "puma_pidg"]


def test_a_critical_sensor_is_last_too() -> None:
    tasks = [task("arm", outvar="Q", critical=True), task("log", invar="Q")]
    assert legality.on_order(tasks) == ["log", "arm"]


def test_turning_off_is_the_reverse_unless_a_job_says() -> None:
    assert legality.off_order(puma()) == ["puma_pidg", "grav_comp", "diff", "jtball"]
    assert legality.off_order(puma(), ("jtball", "diff", "not_on")) == [
        "jtball",
        "diff",
        "puma_pidg",
        "grav_comp",
    ]


def test_nothing_is_ordered_as_nothing() -> None:
    assert (
        legality.spawn_order([])
        == legality.on_order([])
        == legality.off_order([])
        == []
    )
    assert legality.user_priorities([]) == {}


def test_an_heir_follows_directly_on_who_it_takes_over_from() -> None:
    """Figures 3.15 and 3.16: one task goes, and two come in its place."""
    ik = task("invkin", invar="X_REF", outvar="Q_REF")
    dls = task("dls", invar="X_REF", outvar="Q^_REF")
    integrator = task("integrator", invar="Q^_REF", outvar="Q_REF")
    robot = task("robot", invar="Q_REF", outvar="Q_MEZ", critical=True)
    assert legality.change_order([ik], [integrator, dls], [robot]) == [
        ("dls", "on"),
        ("invkin", "off"),
        ("integrator", "on"),
    ]
    assert legality.change_order([integrator, dls], [ik], [robot]) == [
        ("integrator", "off"),
        ("invkin", "on"),
        ("dls", "off"),
    ]


def test_all_heirs_of_one_task_come_before_anything_else() -> None:
    old = task("old", outvar="A B")
    news = [task("b", outvar="B"), task("c", outvar="C"), task("a", outvar="A")]
    assert legality.on_order(news) == ["b", "c", "a"]
    items = legality.change_order([old], news)
    assert items == [("old", "off"), ("b", "on"), ("a", "on"), ("c", "on")]


def test_who_has_no_heir_goes_at_the_end_readers_first() -> None:
    going = [task("source", outvar="A"), task("sink", invar="A", outvar="B")]
    items = legality.change_order(going, [task("other", outvar="C")])
    assert items == [("other", "on"), ("sink", "off"), ("source", "off")]
    assert legality.change_order([], []) == []
