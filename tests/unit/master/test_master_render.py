"""What commands give, as it reads on a terminal."""

from __future__ import annotations

import msgspec
import pytest

from pbonet.errors import PbonetError, Severity, StateError
from pbonet.master.console import render
from pbonet.master.console.commands import COMMANDS
from pbonet.master.subsystem.status_fields import DEFAULT, NAMES, Profile
from pbonet.xm.net.messages import Event, ParamValue, VarValue


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "-"),
        (0.0, "0 s"),
        (12.0, "12 s"),
        (0.002, "2 ms"),
        (0.000_271_4, "271 us"),
        (3e-8, "30 ns"),
        (0.9996, "1 s"),
        (1234.5, "1234 s"),
    ],
)
def test_times_get_a_unit_that_suits_them(value, text):
    assert render.seconds(value) == text


LINK = {
    "name": "vision:x",
    "writer": "agent arm0 from eye0",
    "reader": "process 8 of arm",
    "number": 7,
    "age": 0.003,
}
NEW = {
    "name": "arm:y",
    "writer": "process 8 of arm",
    "reader": "",
    "number": 0,
    "age": None,
}


def test_columns_line_up_and_numbers_stand_to_the_right():
    text = render.table(("task", "n"), [["pid", "7"], ["grav_comp", "1024"]])
    assert text.splitlines() == [
        "task          n",
        "pid           7",
        "grav_comp  1024",
    ]


def test_status_has_warning_and_error_below_their_task():
    values = dict.fromkeys(NAMES) | {"rmod": "pid", "state": "ERROR"}
    profiles = [
        Profile(
            task="pid", fields=values, warning="slow", error="q is NaN", timing="1 late"
        ),
        Profile(task="traj", fields=values | {"rmod": "traj", "state": "ON"}),
    ]
    data = {
        "fields": list(DEFAULT),
        "tasks": [msgspec.to_builtins(one) for one in profiles],
        "missing": [],
        "versions": ["no common version of table: a; b"],
        "held": ["arm1 of b does not answer"],
        "rtpus": [
            {
                "rtpu": "arm0",
                "illegal": ["equation 2"],
                "stalls": 0,
                "stalled": 0.0,
                "stall_age": None,
                "tbufs": [LINK],
            },
            {
                "rtpu": "arm1",
                "illegal": ["equation 2", "arm1/pid died"],
                "stalls": 2,
                "stalled": 0.1,
                "stall_age": 3.2,
                "tbufs": [LINK | {"age": 0.004}, LINK | NEW],
            },
        ],
    }
    lines = render.text("status", data).splitlines()
    assert lines[0].split() == list(DEFAULT)
    assert lines[1].startswith("pid ")
    assert lines[2:5] == [
        "WARNING> pid: slow",
        "TIMING> pid: 1 late",
        "ERROR> pid: q is NaN",
    ]
    assert lines[5].startswith("traj ")
    assert lines[6].startswith("VERSIONS> no common version of table: a; b: run the ")
    assert lines[7:] == [
        "HELD> arm1 of b does not answer: end that agent and its RTPU process, or "
        "start it again",
        "ILLEGAL> arm0, arm1: equation 2",
        "ILLEGAL> arm1: arm1/pid died",
        "STALLED> arm1: its core stood still 2 times, 100 ms in all; last 3.2 s ago",
        "LINK> vision:x: written by agent arm0 from eye0, read by process 8 of arm, "
        "record 7, 4 ms old",
        "LINK> arm:y: written by process 8 of arm, read by nobody, record 0, "
        "nothing yet",
    ]
    assert render.text("display", {"variables": []}) == "no variables"
    none = {"fields": ["rmod"], "tasks": [], "missing": [], "versions": [], "rtpus": []}
    assert render.text("status", none) == "no tasks"


@pytest.mark.parametrize(
    ("stalls", "age", "said"),
    [
        (0, None, ""),
        (0, 0.0, "stands still now"),
        (1, 0.0, "stands still now; stood still once, 100 ms in all"),
        (1, None, "stood still once, 100 ms in all"),  # of an agent that knows no age
        (3, 90.0, "stood still 3 times, 100 ms in all; last 90 s ago"),
    ],
)
def test_a_stall_is_told_with_when_it_was(stalls, age, said):
    assert render.stall_text(stalls, 0.1, age) == said


def test_variables_show_writer_age_and_unit():
    variable = VarValue(
        name="Q_MEZ",
        index=0,
        values=[0.5, -1.25e-7],
        units="rad",
        writer="pidg",
        age=0.0012,
        stale=True,
    )
    data = {"variables": [msgspec.to_builtins(variable)]}
    row = render.text("display", data).splitlines()[1]
    assert row.split() == [
        "Q_MEZ",
        "pidg",
        "stale",
        "1.2",
        "ms",
        "rad",
        "0.5",
        "-1.25e-07",
    ]


def test_long_variables_are_shortened():
    assert render.values([1.0] * 24).endswith("... (24)")
    assert render.values([1, 2]) == "1 2"
    assert render.values("sine") == "sine"


def test_parameters_show_unit_and_bounds():
    param = ParamValue(
        name="kp", value=[1.5], type="float", unit="N*m/rad", doc="gain", bounds=">= 0"
    )
    text = render.text("get", {"task": "pid", "params": [msgspec.to_builtins(param)]})
    assert text.splitlines()[1].split() == ["kp", "1.5", "N*m/rad", ">=", "0", "gain"]
    assert render.text("get", {"task": "t", "params": []}) == "t has no parameters"


def test_events_have_their_place_and_cycle():
    event = Event(
        n=1,
        time=0,
        wall=0.25,
        severity=int(Severity.WARNING),
        code="TIMING",
        rtpu="arm0",
        task="pid",
        cycle=5311,
        text="late",
    )
    line = render.event(event)
    assert line.endswith(".250 WARNING arm0/pid TIMING cycle=5311 late")
    assert render.text("events", {"events": []}) == "no events"


def test_errors_show_their_stack_only_when_asked():
    error = StateError("no", where="arm0", remedy="wait", debug="line 3")
    assert render.error(error) == "ERROR> arm0: no; wait"
    assert render.error(error, debug=True).splitlines()[-1] == "line 3"


def test_check_says_legal_or_why_not():
    good = {"legal": True, "warnings": ["slow"], "rtpus": []}
    assert render.text("check", good) == "WARNING> slow\nlegal"
    bad = {"legal": False, "error": PbonetError("two writers").to_wire()}
    assert render.text("check", {**good, **bad, "warnings": []}) == "ERROR> two writers"


def test_stop_says_what_was_forced():
    data = {"off": ["a", "b"], "killed": ["c"]}
    assert render.text("stop", data) == "turned off: a b; ended by force: c"
    assert render.text("stop", {"off": [], "killed": []}) == "nothing was ON"


def test_signals_and_masks():
    sent = {"task": "arm", "signal": "FINISH", "count": 1, "rtpu": "arm0"}
    assert render.text("sigwait", {"sent": sent}) == "arm FINISH"
    text = render.text("sigwait", {"sent": sent | {"count": 3}})
    assert text == "arm FINISH (3 times)"
    assert render.text("sigmask", {"masks": {}}) == "no signal is masked"
    text = render.text("sigmask", {"masks": {"": ["OFF"], "arm": []}})
    assert text.splitlines()[1:] == ["(subsystem)  OFF", "arm          none"]


def test_a_change_of_configuration_shows_its_steps_and_its_end():
    data = {
        "stays": ["arm"],
        "spawns": {"soft": "arm0"},
        "items": [["pid", "off"], ["soft", "on"]],
        "kills": ["pid"],
        "replaces": {"soft": ["pid", "grip"]},
        "conditions": ["POST of reach holds: HELD"],
        "states": {"pid": "NOT-CREATED", "soft": "ON"},
    }
    assert render.text("switch", data).splitlines() == [
        "POST of reach holds: HELD",
        "spawn soft on arm0",
        "soft gives the constants of pid, grip",
        "off pid",
        "on soft",
        "kill pid",
        "stays ON: arm",
        "pid NOT-CREATED  soft ON",
    ]
    nothing = {"stays": [], "spawns": {}, "items": [], "kills": [], "states": {}}
    nothing |= {"conditions": [], "replaces": {}}
    assert render.text("swap", nothing) == "nothing to do\nstays ON: nothing"


def test_commands_without_a_form_of_their_own_show_states():
    shown = {"display", "write", "get", "set", "library", "check", "freq", "stop"}
    shown |= {
        "profile",
        "profile save",
        "status",
        "status set",
        "swap",
        "switch",
        "events",
        "events count",
        "explain",
        "help",
        "sigmask",
        "sigwait",
        "network",
        "quit",
        "wait",
    }
    for command in COMMANDS:
        if command.name not in shown:
            assert render.text(command.name, {"states": {"pid": "ON"}}) == "pid ON"
