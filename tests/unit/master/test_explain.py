"""Chains of causes from scripted facts: one for each cause that the program knows."""

from __future__ import annotations

import ast
import re
import time
from pathlib import Path

import pytest
from msgspec import structs

from pbonet.analysis import legality
from pbonet.analysis.schedule import CoreShare
from pbonet.config import Scheduler
from pbonet.errors import (
    NoAnswerError,
    SeveralError,
    Severity,
    StateError,
    UnreachableError,
)
from pbonet.master import configuration, diagnosis
from pbonet.master.diagnosis import FLAG_CAUSES, REMEDIES, Facts, Gap, asked_by
from pbonet.master.subsystem import Missing
from pbonet.xm.net import (
    AgentInfo,
    CoreTrace,
    CoreUse,
    Event,
    RtpuStatus,
    TaskStatus,
    TbufStatus,
    VarValue,
    messages as m,
)

ROOT = Path(__file__).parents[3]
NOW = 1_000_000.0


def status(task, rtpu="arm0", state="ON", **more):
    """Return the status of a task with 100 cycles at 100 Hz."""
    given = {
        "rmod": task,
        "tid": 9,
        "S": "P",
        "crit": 5,
        "cycle": 100,
        "miss": 0,
        "ref_f": 100.0,
        "mez_f": 100.0,
        "mez_t": 0.01,
        "ptime": 1.0,
        "tot_c": 0.1,
        "tick": 1e-9,
        "min_c": 0.001,
        "max_c": 0.001,
        "last_c": 0.001,
        "warn": 0,
    }
    return TaskStatus(task=task, rtpu=rtpu, state=state, **given | more)


def event(code, text="", task="", rtpu="arm0", at=0.0, **more):
    """Return an event; `at` is in seconds."""
    severity = int(Severity.WARNING)
    return Event(
        n=1,
        time=0,
        wall=NOW + at,
        severity=severity,
        code=code,
        rtpu=rtpu,
        task=task,
        text=text,
        **more,
    )


def port(variable):
    return configuration.GraphPort(
        port=variable,
        variable=variable,
        constant=False,
        unit="",
        shape=[],
        type="double",
    )


def drawn(name, ins=(), outs=(), rtpu="arm0"):
    return configuration.GraphTask(
        name=name,
        module=name,
        class_="",
        desc="",
        rtpu=rtpu,
        freq=100.0,
        type="periodic",
        crit="",
        critical=False,
        fallback_of="",
        parts=[],
        devices=[],
        ins=[port(one) for one in ins],
        outs=[port(one) for one in outs],
        params=[],
        rmod_file="",
    )


def graph(*tasks, faults=(), links=(), job=""):
    names = {p.variable: None for t in tasks for p in (*t.ins, *t.outs)}
    return configuration.Graph(
        name="arm",
        job=job,
        rtpus=[
            configuration.GraphRtpu(name=one, scheduler="MUF", keeper=one == "arm0")
            for one in ("arm0", "arm1")
        ],
        tasks=list(tasks),
        variables=[
            configuration.GraphVariable(
                name=name,
                desc="",
                unit="",
                type="double",
                shape=[],
                n=1,
                constant=False,
                writers=[t.name for t in tasks if name in {p.variable for p in t.outs}],
                readers=[t.name for t in tasks if name in {p.variable for p in t.ins}],
            )
            for name in names
        ],
        wires=[],
        links=list(links),
        faults=list(faults),
    )


TASKS = (
    drawn("sensor", outs=["Q"]),
    drawn("plan", ins=["Q"], outs=["REF"], rtpu="arm1"),
    drawn("pid", ins=["REF"], outs=["T"]),
)
"""A chain over two RTPUs: Q from the sensor, REF from the plan, T from the PID."""


def value(name, writer, age, **more):
    return VarValue(
        name=name, index=0, values=[0.0], units="", writer=writer, age=age, **more
    )


def rtpus(*tasks, illegal=(), **more):
    """Return the status of both RTPUs, with tasks and causes of the flag on arm0."""
    return {
        name: RtpuStatus(
            rtpu=name,
            backend="fifo",
            scheduler="MUF",
            tasks=[one for one in tasks if one.rtpu == name],
            illegal=list(illegal) if name == "arm0" else [],
            **more,
        )
        for name in ("arm0", "arm1")
    }


def facts(*tasks, illegal=(), **more):
    """Return facts of which the named tasks are true, and all variables fresh."""
    there = tasks or (status("sensor"), status("plan", "arm1"), status("pid"))
    given = {
        "subsystem": "arm",
        "graph": graph(*TASKS),
        "rtpus": rtpus(*there, illegal=illegal),
        "keeper": "arm0",
        "values": {
            "Q": value("Q", "arm0/sensor", 0.005),
            "REF": value("REF", "arm1/plan", 0.005),
            "T": value("T", "arm0/pid", 0.005),
        },
        "limits": {"Q": 0.1, "REF": 0.1},
    }
    return Facts(**given | more)


def told(known, *words):
    """Return the explanation as text."""
    return str(diagnosis.explain(known, asked_by(words)))


def old(known, *names):
    """Make variables 2 s old."""
    for name in names:
        known.values[name] = structs.replace(known.values[name], age=2.0, stale=True)
    return known


def agent(name, host="lab1", **more):
    return AgentInfo(
        name=name,
        domain="default",
        host=host,
        machine=host,
        core=1,
        cores=2,
        pid=7,
        rtpu_pid=8,
        **{"backend": "fifo", "version": "0", "python": "3"} | more,
    )


# -- the flag --------------------------------------------------------------------------


EXAMPLES = (
    ("equation 2: no task writes REF for pid", "REF is"),
    ("the input REF of pid is stale", "REF is"),
    ("plan is in ERROR", "task plan on arm1"),
    ("plan has died", "task plan on arm1"),
    ("plan has ended by itself", "task plan on arm1"),
    ("plan was lost with its RTPU process", "task plan on arm1"),
    ("plan hangs in off", "task plan on arm1"),
    ("a reconfiguration takes longer than a cycle", ""),
    ("off plan is done, and no task took over REF", "REF is"),
    (
        "plan gives the constants of pid, which is still ON: no master continues the "
        "exchange",
        "task plan on arm1",
    ),
    ("no agent transfers REF Q from other machines", "REF is"),
    ("the agent gives no sign of life for 2 s (ALONE)", ""),
    ("no sign of life from RTPU arm1 for 2 s (ALONE)", "RTPU arm1"),
    ("host lab2 is unreachable; no task writes REF", "RTPU arm1"),
    ("the table of host lab2 is of version 2, here version 1", "RTPU arm1"),
)
"""A sentence for each cause, as the program makes it, and what it leads to."""


@pytest.mark.parametrize(
    ("cause", "example"), list(zip(FLAG_CAUSES, EXAMPLES, strict=True))
)
def test_each_cause_of_the_flag_has_its_remedy(cause, example):
    sentence, behind = example
    known = facts(illegal=[f"{sentence} (arm0/x)"])
    known.agents = {"arm0": agent("arm0"), "arm1": agent("arm1", "lab2")}
    text = told(known)
    assert text.startswith("the flag of arm is up\n  because " + sentence)
    assert f"do: {cause.remedy}" in text
    assert behind in text.partition("\n")[2].partition("\n")[2]
    assert bool(behind) == bool(cause.subject)


@pytest.fixture(scope="module")
def source():
    """Return every text in the source of the rooms that raise the flag."""
    rooms = ("node/rtpu", "node/mirror", "node/task", "svar", "master/subsystem")
    files = [p for room in rooms for p in (ROOT / "pbonet" / room).rglob("*.py")]
    return "\n".join(
        node.value
        for path in files
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


@pytest.mark.parametrize("cause", FLAG_CAUSES, ids=lambda one: one.sentence)
def test_each_sentence_is_one_of_the_program(cause, source):
    """Without it a sentence that was changed would be taken for a module's own."""
    for part in cause.sentence.split("…"):
        assert part.strip() in source


def test_every_place_that_raises_the_flag_is_known():
    """A new one needs a cause in the catalogue."""
    places = [
        f"{path.relative_to(ROOT / 'pbonet')}: {call}"
        for path in sorted((ROOT / "pbonet").rglob("*.py"))
        for call in re.findall(
            r"(?:raise_illegal|flags\.up|_raise_flag|flags\.handed_over)\(",
            path.read_text("utf-8"),
        )
    ]
    assert len(places) == RAISED, places


RAISED = 21
"""Calls that raise the flag, each with a sentence of the catalogue."""


def test_the_page_of_symptoms_has_the_same_remedies():
    page = (ROOT / "docs" / "symptoms.md").read_text("utf-8")
    for cause in FLAG_CAUSES:
        assert f"| `{cause.sentence}` |" in page, cause.sentence
        (line,) = [
            one for one in page.splitlines() if one.startswith(f"| `{cause.sentence}`")
        ]
        assert line.endswith(f"| {cause.remedy} |")
    assert diagnosis.OWN_TEXT in page


def test_a_text_of_a_module_leads_to_its_events():
    known = facts(illegal=["the gripper is open (arm1/plan)"])
    known.events = [event("WARNING", "no force", "plan", "arm1")]
    text = told(known, "flag")
    assert "because WARNING of arm1/plan" in text
    assert f"do: {diagnosis.OWN_TEXT}" in text


def test_a_flag_that_is_down_has_no_cause():
    found = diagnosis.explain(facts(), asked_by(()))
    assert not found.found
    assert found.what == "the flag of arm is down"


@pytest.mark.parametrize(
    ("tasks", "what"),
    [
        ([], "whether the flag of arm is up is not known"),
        ([status("sensor")], "the flag of arm is down on arm0"),
    ],
)
def test_a_flag_of_rtpus_that_are_away_is_not_said_to_be_down(tasks, what):
    there = {one.rtpu: rtpus(*tasks)[one.rtpu] for one in tasks}
    known = facts(*tasks, rtpus=there)
    known.silent = {"arm1": UnreachableError("gone", remedy="start it").to_wire()}
    assert diagnosis.explain(known, asked_by(())).what == what


def test_a_chain_goes_from_the_flag_to_the_error_upstream():
    failed = status("sensor", state="ERROR", error="cycle failed: no encoder; plug it")
    known = facts(
        failed,
        status("plan", "arm1"),
        status("pid"),
        illegal=["the input REF of pid is stale (arm0/pid)"],
        inherited={"plan": ["Q"], "pid": ["REF"], "sensor": []},
        events=[event("METHOD", "cycle failed: no encoder; plug it", "sensor")],
    )
    text = told(old(known, "Q", "REF"))
    order = ["REF is 2 s", "ages are passed on", "Q is 2 s", "is ERROR", "METHOD of"]
    places = [text.index(part) for part in order]
    assert places == sorted(places)
    assert "do: 'clear sensor' brings it out of ERROR" in text


def test_tasks_in_a_circle_are_explained_once():
    tasks = (drawn("a", ins=["Y"], outs=["X"]), drawn("b", ins=["X"], outs=["Y"]))
    known = facts(
        status("a"),
        status("b"),
        graph=graph(*tasks),
        values={"X": value("X", "arm0/a", 1.0), "Y": value("Y", "arm0/b", 1.0)},
        limits={"X": 0.1, "Y": 0.1},
    )
    assert "X (explained above)" in told(known, "X")


# -- tasks -----------------------------------------------------------------------------


def off(**more):
    return status("plan", "arm1", state="OFF", **more)


@pytest.mark.parametrize(
    ("task", "events", "what", "key"),
    [
        (off(), [], "it was not turned on", "never on"),
        (off(), [event("SPAWNED", "process 7", "plan")], "SPAWNED of", "never on"),
        (off(on_ns=5), [], "before the events", "turned off"),
        (off(), [event("STATE", "turned off", "plan")], "STATE of", "turned off"),
        (
            off(),
            [event("STATE", "after a timing failure it is OFF", "plan")],
            "after a timing failure",
            "off by itself",
        ),
        (off(restarted="spawned again, OFF"), [], "spawned again", "turned off"),
        (off(stands_by=True, fallback_of="pid"), [], "stands by for pid", "stands by"),
    ],
)
def test_each_reason_for_which_a_task_is_off(task, events, what, key):
    text = told(facts(task, events=events), "plan")
    assert text.startswith("task plan on arm1 is OFF\n  because ")
    assert what in text
    assert f"do: {REMEDIES[key]}" in text


def test_what_happened_when_a_task_was_turned_off_is_no_cause():
    late = event("TIMING_FAILURE", "2 deadline", "plan", "arm1")
    ordered = event("STATE", "turned off", "plan", "arm1")
    assert "TIMING" not in told(facts(off(on_ns=1), events=[late, ordered]), "plan")
    itself = event("STATE", "after 'on' it is OFF", "plan", "arm1")
    assert "TIMING" in told(facts(off(on_ns=1), events=[late, itself]), "plan")


def test_a_signal_that_failed_says_what_may_be_done():
    known = facts(
        off(), events=[event("SIGNAL_FAILED", "'on' failed, and it is OFF: no", "plan")]
    )
    assert "do: 'on plan' turns it on, 'kill plan' removes it" in told(known, "plan")


def test_an_error_of_an_old_input_leads_to_the_variable():
    failed = status("pid", state="ERROR", error="the input REF is too old (got 2 s)")
    known = facts(status("sensor"), off(), failed)
    text = told(old(known, "REF"), "pid")
    assert "REF is 2 s old, and may be 0.1 s: stale" in text
    assert "task plan on arm1 is OFF" in text


def test_a_task_that_died_has_its_event():
    dead = status("plan", "arm1", state="NOT-CREATED", error="signal SIGSEGV")
    known = facts(dead, events=[event("TASK_DIED", "lines", "plan", "arm1")])
    text = told(known, "plan")
    assert "because signal SIGSEGV" in text
    assert "TASK_DIED of arm1/plan" in text
    assert f"do: {REMEDIES['died']}" in text


def test_a_task_that_was_never_spawned():
    missing = [Missing("plan", "arm1", "it was not spawned, or was killed")]
    known = facts(status("sensor"), missing=missing)
    text = told(known, "plan")
    assert "task plan on arm1 is NOT-CREATED" in text
    assert "because it was not spawned" in text
    assert f"do: {REMEDIES['not spawned']}" in text


@pytest.mark.parametrize("code", ["NOT_SPAWNED", "SPAWN_FAILED"])
def test_a_task_that_could_not_be_spawned(code):
    known = facts(status("sensor"), events=[event(code, "no module", "plan", "arm1")])
    assert f"{code} of arm1/plan" in told(known, "plan")


def test_the_last_end_of_a_task_is_the_cause():
    events = [
        event("NOT_SPAWNED", "no module", "plan", "arm1", at=-9),
        event("SPAWNED", "process 7", "plan", "arm1", at=-8),
        event("TASK_DIED", "signal SIGSEGV", "plan", "arm1", at=-5),
        event("STOPPED", "2 tasks ended", rtpu="arm1"),
    ]
    text = told(facts(status("sensor"), events=events), "plan")
    assert "STOPPED of arm1" in text
    assert "SIGSEGV" not in text
    assert "NOT_SPAWNED" not in text


def test_a_task_of_an_rtpu_that_is_away():
    known = facts(status("sensor"))
    known.silent = {"arm1": UnreachableError("gone", remedy="start it").to_wire()}
    text = told(known, "plan")
    assert "the state of task plan on arm1 is not known" in text
    assert "RTPU arm1 does not answer" in text
    assert "do: start it" in text


def test_a_task_that_is_on_and_does_not_work():
    busy = status("plan", "arm1", waits="waits for 9 ms", miss=4, warning="hot")
    known = facts(status("sensor", state="OFF"), busy)
    known.events = [event("HANGS", "a cycle does not return", "plan", "arm1")]
    text = told(old(known, "Q"), "plan")
    for part in ("Q is 2 s old", "HANGS of", "waits for 9 ms", "it warns: hot"):
        assert part in text
    assert "plan has missed 4 of 104 cycles" in text


def test_a_task_that_works_is_said_to_since_when_and_with_its_figures():
    works = status("pid", on_ns=2_000_000_000, now=63_500_000_000)
    known = facts(status("sensor"), works, on_since={"pid": NOW})
    found = diagnosis.explain(known, asked_by(["pid"]))
    assert not found.found
    assert found.answered
    clock = time.strftime("%H:%M:%S", time.localtime(NOW))
    assert str(found).splitlines() == [
        "task pid on arm0 is ON",
        f"  nothing is wrong: it is ON since {clock}, for 61.5 s",
        "  100 cycles at 100 Hz (measured: 100 Hz), none missed",
        "  a cycle takes 1 ms of CPU time, at most 1 ms",
        "  read on: `pbonet status` has more figures, `pbonet display` the values",
    ]


def test_what_could_not_be_read_is_not_said_to_be_right():
    text = told(facts(unknown=["the table: gone"]), "pid")
    assert "nothing that was read is wrong: it is ON" in text
    assert text.endswith("not read: the table: gone")


def test_a_periodic_task_that_stands_still_or_whose_cycles_fail_is_not_healthy():
    known = facts(later={"pid": 100}, watched=0.3)
    text = told(known, "pid")
    assert "because pid is ON, and its cycle count stands still at 100" in text
    assert "nothing is wrong" not in text
    known = facts(status("pid", failed=3), events=[event("METHOD", "no force", "pid")])
    text = told(known, "pid")
    assert "because 3 of its cycles failed" in text
    assert "because METHOD of arm0/pid" in text
    assert f"do: {REMEDIES['cycles fail']}" in text


@pytest.mark.parametrize(
    ("words", "figure"),
    [
        ((), "arm0 and arm1 answer, and none has raised it, last withdrawn at"),
        (("start",), "the files are right, the configuration is legal"),
        (("miss", "pid"), "100 cycles at 100 Hz (measured: 100 Hz), none missed"),
        (("REF",), "plan on arm1 writes it at 100 Hz"),
        (("arm1",), "1 of its 1 tasks are ON under MUF, on core 1 of lab2"),
    ],
)
def test_what_is_well_is_said_with_its_figures(words, figure):
    known = facts(events=[event("LEGAL", "no longer: plan is in ERROR")])
    known.agents = {"arm1": agent("arm1", "lab2")}
    text = told(known, *words)
    assert f"\n  nothing is wrong: {figure}" in text
    assert "no cause was found" not in text


def test_an_rtpu_with_a_task_in_error_is_not_said_to_be_right():
    text = told(facts(status("pid", state="ERROR", error="no encoder")), "arm0")
    assert "nothing is wrong" not in text
    assert "because task pid on arm0 is ERROR" in text


def test_nobody_is_said_to_write_a_constant_again_and_again():
    known = facts()
    one = known.graph.variables[0]
    known.graph.variables[0] = structs.replace(one, constant=True)
    writer = (known.values[one.name].writer or "").rpartition("/")[2]
    text = told(known, one.name)
    assert f"nothing is wrong: it is a constant, and has its value, which {writer}" in (
        text
    )
    assert "Hz" not in text


def test_cpu_times_that_were_not_measured_are_not_told():
    text = told(facts(status("pid", tot_c=0.0, max_c=0.0)), "pid")
    assert "100 cycles at 100 Hz" in text
    assert "CPU time" not in text


@pytest.mark.parametrize(
    ("words", "answered"),
    [
        (("miss", "pid", "100"), True),
        (("miss", "pid", "101"), False),
        (("start", "arm"), True),
        (("start", "other"), False),
    ],
)
def test_what_a_recorded_run_does_not_have_is_not_said_to_be_right(words, answered):
    known = facts(recorded={"pid": [range(1, 101)]}, from_log=True)
    assert diagnosis.explain(known, asked_by(words)).answered == answered


def test_of_what_nothing_is_known_nothing_is_said_to_be_right():
    known = facts(rtpus={})
    for words in ((), ("arm1",), ("miss", "pid")):
        assert "nothing is wrong" not in told(known, *words), words


# -- variables -------------------------------------------------------------------------


def test_a_fresh_variable_has_no_cause():
    found = diagnosis.explain(facts(), asked_by(["REF"]))
    assert (found.what, found.found) == (
        "REF is 0.005 s old, and may be 0.1 s: not stale",
        False,
    )


def test_a_variable_whose_writer_stands_still():
    known = old(facts(later={"plan": 100}, watched=0.3), "REF")
    text = told(known, "REF")
    assert "its cycle count stands still at 100" in text
    assert f"do: {REMEDIES['no cycle']}" in text


def test_a_writer_that_is_slow_is_not_taken_for_one_that_stands_still():
    slow = status("plan", "arm1", ref_f=2.0)
    known = facts(status("sensor"), slow, later={"plan": 100}, watched=0.3)
    text = told(old(known, "REF"), "REF")
    assert "stands still" not in text
    assert "plan writes it every 0.5 s, and it may be 0.1 s old" in text
    assert f"do: {REMEDIES['short maxage']}" in text


def test_a_variable_that_no_task_writes_has_the_remedy_of_its_fault():
    fault = configuration.GraphFault(
        text="no task that is ON writes REF; add jtball",
        severity="refuse",
        variables=["REF"],
        remedy="add jtball",
    )
    known = facts(status("pid"), graph=graph(TASKS[2], faults=[fault]))
    known.values["REF"] = value("REF", None, None, stale=True)
    text = told(known, "REF")
    assert "REF was never written" in text
    assert "because no task that is ON writes REF [files]" in text
    assert "do: add jtball" in text


def test_a_variable_without_any_writer():
    known = facts(status("pid"), graph=graph(TASKS[2]))
    known.values["REF"] = value("REF", None, None, stale=True)
    assert f"do: {REMEDIES['unwritten']}" in told(known, "REF")


def test_a_table_that_is_not_open_is_the_cause_and_says_what_to_do():
    """Before a start no table is open; afterwards one that is not was lost."""
    closed = "the table of subsystem 'arm' is not open here"
    known = facts(values={}, closed=closed)
    text = told(known, "Q")
    assert text.splitlines()[0] == "the value of Q could not be read"
    assert f"because {closed}, on arm0, which keeps it: it was lost" in text
    assert f"do: {REMEDIES['table lost']}" in text
    known.rtpus = {name: structs.replace(r, tasks=[]) for name, r in rtpus().items()}
    text = told(known, "Q")
    assert "a start opens it, and no task exists" in text
    assert f"do: {REMEDIES['no table']}" in text
    text = told(facts(values={}, from_log=True), "Q")
    assert "no task that was recorded wrote it" in text
    assert f"do: {REMEDIES['not recorded']}" in text


def test_a_writer_on_a_machine_that_is_away():
    known = facts(status("pid"))
    known.rtpus = {"arm0": rtpus(status("pid"))["arm0"]}
    known.silent = {"arm1": NoAnswerError("silent", remedy="look").to_wire()}
    text = told(old(known, "REF"), "REF")
    assert "RTPU arm1 does not answer" in text
    assert "do: look" in text


def test_a_table_that_cannot_be_read():
    known = facts(values={}, silent={"arm0": NoAnswerError("silent").to_wire()})
    text = told(known, "REF")
    assert "the value of REF could not be read" in text
    assert "RTPU arm0 does not answer" in text


def test_a_link_that_brings_nothing():
    link = configuration.Link(
        name="leg:way", task="plan", variable="REF", direction="in"
    )
    known = facts(graph=graph(*TASKS, links=[link]))
    known.rtpus["arm1"].tbufs = [
        TbufStatus(name="way", writer="", reader="7", number=0)
    ]
    text = told(old(known, "REF"), "REF")
    assert "the link way brings nothing" in text
    assert "do: start the writer of way" in text


# -- RTPUs -----------------------------------------------------------------------------


def test_an_rtpu_that_others_have_lost():
    lost = m.Lost(rtpu="arm1", host="lab2", near=True, ago=30.0)
    known = facts(agents={"arm0": agent("arm0", lost=[lost])})
    known.silent = {"arm1": UnreachableError("no agent", remedy="start it").to_wire()}
    text = told(known, "arm1")
    assert "because no agent [agents]" in text
    assert "arm0 of lab1 has not seen arm1 of lab2 for 30 s" in text
    assert "check the network between lab1 and lab2" in text


def test_what_an_rtpu_that_answers_suffers_from():
    held = "arm1 of lab2 does not answer, and has not carried out the stop of arm"
    known = facts(
        agents={"arm1": agent("arm1", keys_left=-1.0, limits=["timing is soft"])},
        held=[held],
        tables=["arm1 of lab2 takes version 2 of the table, this program 1"],
        events=[
            event("RTPU_DIED", "signal SIGKILL", rtpu="arm1"),
            event("CORE_STALLED", "core 1 stood still", rtpu="arm1"),
            event("CALLS_REFUSED", "rights are gone", rtpu="arm1"),
        ],
    )
    known.rtpus["arm1"].stalls = 3
    text = told(known, "arm1")
    for part in (
        held,
        "arm1 of lab2 takes version 2",
        "keys have expired",
        "timing is soft",
        "RTPU_DIED of arm1",
        "its core stood still 3 times",
        "CORE_STALLED of arm1",
        "CALLS_REFUSED of arm1",
    ):
        assert part in text
    assert m.HELD_REMEDY in text
    assert REMEDIES["stalled"] in text


def test_an_rtpu_that_no_master_uses():
    known = facts(events=[event("STOPPED", "3 tasks ended", rtpu="arm1")])
    known.rtpus["arm1"] = RtpuStatus(rtpu="arm1", backend="", scheduler="", tasks=[])
    text = told(known, "arm1")
    assert "because no master uses it" in text
    assert "STOPPED of arm1" in text, "it was used before"
    assert f"do: {REMEDIES['unclaimed']}" in text


# -- starts ----------------------------------------------------------------------------


def test_each_reason_for_which_a_start_is_refused():
    fault = configuration.GraphFault(
        text="plan and pid both write T; rename one",
        severity="refuse",
        remedy="rename one",
    )
    known = facts(
        planned=graph(*TASKS, job="teleop"),
        start=[fault],
        silent={"arm1": UnreachableError("no agent", remedy="start it").to_wire()},
        masters=["run-lab1-7"],
        held=["arm1 has missed a stop"],
        agents={"arm0": agent("arm0", claims={"leg": 3}, on={"leg": ["walk"]})},
        events=[event("SPAWN_FAILED", "no module", "plan")],
    )
    text = told(known, "start")
    assert text.startswith("the start of teleop would be refused now")
    for part in (
        "because plan and pid both write T [files]",
        "do: rename one",
        "RTPU arm1 does not answer",
        "the master run-lab1-7 has the subsystem",
        "arm1 has missed a stop",
        "leg uses RTPU arm0",
        "SPAWN_FAILED of arm0/plan",
    ):
        assert part in text


def test_a_start_that_would_not_be_refused():
    found = diagnosis.explain(facts(), asked_by(["start"]))
    assert (found.what, found.found) == (
        "the start of arm would not be refused now",
        False,
    )


def test_a_subsystem_that_may_share_an_rtpu_refuses_nothing():
    used = {"arm0": agent("arm0", claims={"arm": 1, "leg": 3}, on={"leg": ["walk"]})}
    text = told(facts(agents=used, shared=["arm0"]), "start")
    assert text.startswith("the start of arm would not be refused now")
    assert "not read: whether leg shares RTPU arm0" in text


@pytest.mark.parametrize("several", [False, True])
def test_an_rtpu_that_is_away_is_told_once(several):
    error = UnreachableError("no agent", where="arm1", remedy="start it")
    whole = SeveralError("the job cannot be assembled", [error, error])
    fault = configuration.GraphFault(
        text=str(whole if several else error), severity="refuse", remedy=""
    )
    known = facts(start=[fault], silent={"arm1": error.to_wire()})
    text = told(known, "start")
    assert text.startswith("the start of arm would be refused now")
    assert text.count("no agent") == 1


def test_what_failed_at_the_last_start_refuses_no_other():
    known = facts(events=[event("SPAWN_FAILED", "no module", "plan")])
    text = told(known, "start")
    assert text.startswith("the start of arm would not be refused now, and something")
    assert "SPAWN_FAILED of arm0/plan" in text


# -- missed cycles ---------------------------------------------------------------------


def report(outlook, *, unknown=()):
    return legality.RtpuReport(
        rtpu="arm0",
        scheduler=Scheduler.MUF,
        outlook=outlook,
        utilization=1.2,
        bound=1.0,
        critical_set=(),
        outside=(),
        guaranteed=(),
        unknown=unknown,
        by_scheduler={},
        transformations=(),
        tasks=(),
        servers=(),
        traffic=0.0,
        core=CoreShare(),
        copy_speed=1.0,
        copy_measured=False,
        write_wait=0.0,
        read_wait=0.0,
    )


@pytest.mark.parametrize(
    ("task", "more", "key"),
    [
        ({"max_c": 0.03}, {}, "too long"),
        ({"waits": "waits for 9 ms"}, {}, "waits"),
        ({"first_c": 0.03}, {}, "first cycle"),
        ({"failures": {"missed deadline": 3}}, {}, "overloaded"),
        ({"faults": 900}, {}, "faults"),
        ({"jitter_max": 0.02}, {}, "late start"),
        ({}, {"events": [event("HANGS", "endless", "pid")]}, "no cycle"),
        ({}, {"reports": [report(legality.Outlook.OVERLOADED)]}, "overloaded"),
        (
            {},
            {"reports": [report(legality.Outlook.ASSUMED, unknown=("pid",))]},
            "unbounded",
        ),
        ({}, {"agents": {"arm0": agent("arm0", backend="park")}}, "soft timing"),
    ],
)
def test_each_cause_of_missed_cycles(task, more, key):
    known = facts(status("pid", miss=3, **task), **more)
    text = told(known, "miss", "pid")
    assert text.startswith("pid has missed 3 of 103 cycles")
    assert f"do: {REMEDIES[key]}" in text


def test_another_task_that_goes_first():
    other = status("sensor", max_c=0.012, crit=1)
    text = told(facts(other, status("pid", miss=3)), "miss", "pid")
    assert "sensor goes first (criticality 1 before 5), and takes up to 12 ms" in text


@pytest.mark.parametrize(
    ("scheduler", "other", "what"),
    [
        ("MUF", {"crit": 9}, ""),
        ("MUF", {"crit": 5}, "sensor goes first when its deadline is earlier"),
        ("RM", {"crit": 1}, ""),
        ("RM", {"crit": 9, "ref_f": 200.0}, "sensor goes first (its rate is higher)"),
        ("EDF", {"crit": 9}, "sensor goes first when its deadline is earlier"),
    ],
)
def test_who_goes_first_is_a_matter_of_the_scheduler(scheduler, other, what):
    known = facts(status("sensor", max_c=0.012, **other), status("pid", miss=3))
    known.rtpus["arm0"].scheduler = scheduler
    text = told(known, "miss", "pid")
    assert what in text if what else "goes first" not in text


def test_what_was_before_a_task_was_turned_on_made_it_miss_nothing():
    events = [event("HANGS", "endless", "pid"), event("CORE_STALLED", "stood still")]
    known = facts(status("pid", miss=3, on_ns=5), events=events)
    known.rtpus["arm0"].stalls = 2
    text = told(known, "miss", "pid")
    assert "HANGS" not in text
    assert "stood still" not in text
    assert "HANGS" not in told(known, "pid")


def test_a_core_that_stood_still():
    known = facts(status("pid", miss=3))
    known.rtpus["arm0"].stalls = 2
    assert f"do: {REMEDIES['stalled']}" in told(known, "miss", "pid")


def test_a_task_without_misses_has_no_cause():
    assert not diagnosis.explain(facts(), asked_by(["miss", "pid"])).found


FOLLOWED = CoreTrace(
    task="pid",
    core=1,
    traced=0.8,
    missed=1,
    wall=NOW + 0.25,
    window=0.02,
    uses=[
        CoreUse(pid=7, name="vision", known=True, seconds=0.0142),
        CoreUse(pid=9, name="pid", known=True, seconds=0.0031),
        CoreUse(pid=77, name="kworker/1:2", seconds=0.0016),
        CoreUse(pid=0, name="swapper/1", seconds=0.0011),
    ],
    times="core 1 in 0.80 s: busy 700 ms",
)


def test_who_had_the_core_stands_first():
    text = told(facts(status("pid", miss=3), trace=FOLLOWED), "miss", "pid")
    first, second, third, remedy, *_ = text.splitlines()
    assert first == "pid has missed 3 of 103 cycles since it is ON"
    assert ".250 on, for 20 ms, it missed 1 release; who had core 1: " in second
    assert second.endswith(
        "vision 14.2 ms, pid 3.1 ms, kworker/1:2 (process 77) 1.6 ms, nobody 1.1 ms "
        "[kernel]"
    )
    assert third == "    because core 1 in 0.80 s: busy 700 ms [kernel]"
    assert remedy == f"    do: {REMEDIES['preempted']}"


@pytest.mark.parametrize(
    ("at", "remedy"),
    [
        (0, "preempted"),
        (1, "too long"),
        (2, "stalled"),
        (3, "waits"),
        (9, "late start"),
    ],
)
def test_the_remedy_is_for_who_had_the_core_longest(at, remedy):
    trace = structs.replace(FOLLOWED, uses=FOLLOWED.uses[at:])
    text = told(facts(status("pid", miss=3), trace=trace), "miss", "pid")
    assert text.splitlines()[3] == f"    do: {REMEDIES[remedy]}"


def test_without_the_kernels_word_its_counts_are_given_and_the_reason():
    trace = structs.replace(FOLLOWED, uses=[], fault="sched_switch: not allowed")
    text = told(facts(status("pid", miss=3), trace=trace), "miss", "pid")
    assert "because what the kernel counts of core 1 in 0.80 s: busy 700 ms" in text
    assert text.endswith("not read: sched_switch: not allowed")
    assert "who had" not in text


def test_no_miss_while_the_core_was_followed():
    trace = structs.replace(FOLLOWED, missed=0, uses=[])
    text = told(facts(status("pid", miss=3), trace=trace), "miss", "pid")
    assert text.startswith(
        "pid has missed 3 of 103 cycles since it is ON, and none in the 0.8 s in which"
    )


@pytest.mark.parametrize(
    ("words", "trace"),
    [(["pid"], 1.0), (["miss", "pid"], 31.0), (["miss", "p", "4"], 1)],
)
def test_a_core_is_followed_for_the_next_miss_only(words, trace):
    with pytest.raises(StateError, match="followed for the next miss"):
        asked_by(words, trace)


def test_a_cycle_of_a_log_has_its_own_causes():
    gaps = [
        Gap(cycle=50, missed=2, at=NOW, longest=0.02, others=(("sensor", 0.009),)),
        Gap(cycle=90, missed=1, at=NOW + 60, longest=0.001),
        Gap(
            cycle=99, missed=1, at=NOW + 90, longest=0.001,
            window=0.01, own=0.001, others=(("sensor", 0.004),),
        ),
    ]  # fmt: skip
    known = facts(gaps={"pid": gaps}, recorded={"pid": [range(1, 101)]}, from_log=True)
    known.events = [event("CORE_STALLED", "core 1 stood still")]
    text = told(known, "miss", "pid", "50")
    assert text.startswith("pid has missed 2 releases before cycle 50")
    assert "the cycle before took 20 ms" in text
    assert "sensor took 9 ms of the core meanwhile" in text
    assert "CORE_STALLED of arm0" in text
    both = told(known, "miss", "pid")
    assert both.startswith("pid has missed 4 cycles in 3 places")
    assert "for 5 of the 10 ms in which pid was ready, no task of its RTPU" in both
    assert f"do: {REMEDIES['late start']}" in both


def test_a_cycle_near_missed_releases_has_none_of_its_own():
    gaps = [Gap(cycle=n, missed=3, at=NOW, longest=0.0) for n in range(10, 90, 5)]
    known = facts(gaps={"pid": gaps}, recorded={"pid": [range(1, 101)]}, from_log=True)
    assert told(known, "miss", "pid", "49") == (
        "pid has missed 0 releases before cycle 49\n"
        "  nothing is wrong: what it has missed was before cycle "
        "25, 30, 35, 40, 45, 50, 55, 60, 65, 70, and 6 more"
    )


def test_a_running_task_has_no_single_cycles():
    with pytest.raises(StateError, match="only a recorded run has the single cycles"):
        told(facts(status("pid", miss=3)), "miss", "pid", "4")


# -- questions -------------------------------------------------------------------------


def test_every_remedy_is_used():
    """A text of the catalogue that nothing gives would be of no use."""
    folder = ROOT / "pbonet" / "master" / "diagnosis"
    source = "\n".join(
        path.read_text("utf-8")
        for path in folder.glob("*.py")
        if path.stem != "known_causes"
    )
    for key in REMEDIES:
        assert f'"{key}"' in source, key


@pytest.mark.parametrize(
    "words", [["miss"], ["miss", "pid", "x"], ["start", "a", "b"], ["a", "b"]]
)
def test_words_that_ask_nothing_are_refused(words):
    with pytest.raises(StateError, match="nothing that can be explained"):
        asked_by(words)


def test_a_name_that_is_unknown_is_refused_with_the_nearest():
    with pytest.raises(StateError, match="did you mean plan"):
        told(facts(), "pln")


def test_what_could_not_be_read_is_said():
    assert "not read: the table: damaged" in told(
        facts(unknown=["the table: damaged"]), "flag"
    )


def test_a_variable_that_is_fresh_but_will_not_stay_so():
    known = facts(status("sensor"), status("plan", "arm1", state="OFF"), status("pid"))
    text = told(known, "REF")
    assert text.startswith("REF is 0.005 s old, and may be 0.1 s: not stale")
    assert "task plan on arm1 is OFF" in text


def test_a_constant_needs_no_task_that_is_on():
    known = facts(status("sensor", state="OFF"))
    one = known.graph.variables[0]
    known.graph.variables[0] = structs.replace(one, constant=True)
    assert not diagnosis.explain(known, asked_by(["Q"])).found


@pytest.mark.parametrize("words", [("elsewhere",), ("miss", "elsewhere")])
def test_an_unknown_name_may_be_on_a_machine_that_does_not_answer(words):
    known = facts(silent={"arm1": UnreachableError("no agent").to_wire()})
    answer = r"that answer have no task.*ask about arm1, which may have it"
    with pytest.raises(StateError, match=answer):
        asked_by(words).resolved(known)
