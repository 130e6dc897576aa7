"""The life of real tasks: states, signals, parameters, frequencies, lists."""

import os
from pathlib import Path

import pytest
from nodekit import alive, rmod, wait_gone
from watching import wait_for

from pbonet import Signal
from pbonet.errors import (
    ConfigError,
    DeclarationError,
    MethodError,
    ModuleLoadError,
    ParameterError,
    PbonetError,
    PortError,
    ProtocolError,
    StateError,
    SvarOwnerError,
    TaskError,
    UnknownVariableError,
)
from pbonet.node.ring._ring import Ring
from pbonet.xm.net import messages as m


def diary(path):
    """Return what the methods of `counts` wrote, without times and process ids."""
    return [line.split(maxsplit=2)[2] for line in path.read_text().splitlines()]


def test_life_of_a_task(arm, tmp_path):
    book = tmp_path / "diary"
    status = arm.spawn("a", "counts", local={"DIARY": book})
    assert status.state == "OFF"
    assert alive(status.tid)
    assert arm.on("a").state == "ON"
    arm.wait_cycles("a", 20)
    off = arm.off("a")
    assert off.state == "OFF"
    assert arm.value("Y0").values[0] == off.cycle
    arm.on("a")  # cycles count from here again
    wait_for(lambda: arm.status("a").on_ns > off.on_ns, "the time of the new on")
    assert arm.kill("a").state == "NOT-CREATED"
    assert not alive(status.tid)
    assert arm.status() == {}
    assert diary(book) == ["init", "on", "off False", "on", "off False", "kill"]


def test_status_fields_agree_with_the_kernel(arm):
    spawned = arm.spawn("a", "counts", freq=500.0)
    arm.on("a")
    first = arm.wait_cycles("a", 50)
    last = arm.wait_cycles("a", 200)
    assert last.tid == spawned.tid
    assert (last.S, last.module, last.rmod, last.ref_f) == ("P", "counts", "a", 500.0)
    assert last.cycle - first.cycle >= 200
    fields = Path(f"/proc/{last.tid}/schedstat").read_text().split()
    assert 0 < last.tot_c <= int(fields[0]) * 1e-9
    assert 0 < last.min_c <= last.tot_c / last.cycle <= last.max_c
    assert last.ptime == pytest.approx((last.now - last.on_ns) * 1e-9)
    assert last.mez_f == pytest.approx(last.cycle / last.ptime)

    def counted():
        now = arm.status("a")
        return abs(now.cycle + now.miss - 500.0 * now.ptime) <= 2

    wait_for(counted, "every release to be counted")
    assert sum(last.jitter) >= last.cycle
    assert os.sched_getaffinity(last.tid) == {
        arm.client.call("arm0", m.Hello(), m.AgentInfo).core
    }


def test_memory_of_a_task_is_settled(arm):
    """Faults belong to the start: none comes with the hundredth cycle."""
    arm.spawn("a", "counts", freq=500.0)
    arm.on("a")
    first = arm.wait_cycles("a", 100)
    last = arm.wait_cycles("a", 200)
    assert last.faults == first.faults


def test_a_message_that_is_too_long_leaves_the_task_as_it_was(arm):
    arm.spawn("a", "counts")
    error = arm.refused(TaskError, arm.on, "a", arg="x" * 300_000)
    assert "too long for a task" in error.what
    assert arm.on("a").state == "ON"


def test_invalid_signals_change_nothing(arm):
    arm.spawn("a", "counts")
    invalid = {"OFF": ("off", "clear"), "ON": ("on", "clear"), "ERROR": ("on", "off")}
    for state, wrong in invalid.items():
        if state == "ERROR":
            arm.kill("a")
            arm.spawn("a", "raises_in_on")
            arm.refused(MethodError, arm.on, "a")
        elif state == "ON":
            arm.on("a")
        for one in (*wrong, "dance", "wakeup", "spawn"):
            error = arm.refused(StateError, arm.control, "a", one)
            assert one in str(error)
            assert arm.status("a").state == state


def test_module_may_not_be_ready(arm):
    arm.spawn("a", "holds", invar="X", local={"LEVEL": 1, "READY": "no"})
    assert arm.on("a").state == "OFF"
    arm.ask(m.Set(task="a", name="ready", value="yes"))
    assert arm.on("a").state == "ON"


def test_parameters_change_between_two_cycles(arm):
    arm.spawn("a", "holds", invar="X", local={"LEVEL": 1})
    arm.on("a")
    got = arm.ask(m.Get(task="a"), list[m.ParamValue])
    assert [(one.name, one.value) for one in got] == [("level", 1.0), ("ready", True)]
    assert got[0].bounds
    new = arm.ask(m.Set(task="a", name="LEVEL", value="2.5"), list[m.ParamValue])
    assert new[0].value == 2.5
    arm.wait_cycles("a", 2)
    assert arm.value("Y0").values == [2.5, 1.0]
    arm.refused(ParameterError, arm.ask, m.Set(task="a", name="level", value="11"))
    arm.refused(ParameterError, arm.ask, m.Set(task="a", name="level", value="much"))
    arm.refused(ParameterError, arm.ask, m.Set(task="a", name="lever", value="1"))
    arm.refused(ParameterError, arm.ask, m.Get(task="a", name="lever"))
    arm.refused(MethodError, arm.ask, m.Set(task="a", name="level", value="9"))
    assert arm.ask(m.Get(task="a", name="level"), list[m.ParamValue])[0].value == 2.5
    assert arm.status("a").state == "ON"


def test_module_knows_its_criticality_and_rate_as_they_are(nodes, arm):
    nodes.write_module(
        "knows",
        """
        from typing import Annotated as A
        from pbonet import OutVar, PortBasedObject, Vector

        class Knows(PortBasedObject):
            y: A[Vector, OutVar("Y", "2", "none", "criticality, rate")]

            def cycle(self, dt):
                self.y[:] = self.task.crit, self.task.freq
        """,
    )
    arm.spawn("a", "knows", freq=200.0)
    arm.on("a")
    crit = arm.status("a").crit
    assert crit == 5  # it fits, as the only one
    wait_for(lambda: arm.value("Y0").values == [crit, 200.0], "what it is told")
    arm.ask(m.Rank(tasks={"a": (1, 0)}))
    arm.ask(m.Freq(task="a", hz=100.0), float)
    wait_for(lambda: arm.value("Y0").values == [1.0, 100.0], "what it is told then")


def test_frequency_changes_while_it_runs(arm):
    arm.spawn("a", "counts", freq=100.0)
    arm.on("a")
    assert arm.ask(m.Freq(task="a"), float) == 100.0
    assert arm.ask(m.Freq(task="a", hz=400.0), float) == 400.0
    first = arm.wait_cycles("a", 1)

    def rate():
        last = arm.wait_cycles("a", 100)
        releases = last.cycle + last.miss - first.cycle - first.miss
        return releases * 1e9 / (last.now - first.now)

    wait_for(lambda: rate() == pytest.approx(400.0, rel=0.05), "400 Hz")
    for wrong in (0.0, -1.0, 1e9, float("nan"), float("inf")):
        arm.refused(ParameterError, arm.ask, m.Freq(task="a", hz=wrong))
    assert arm.status("a").ref_f == 400.0


def test_spawn_may_override_the_frequency(arm):
    request = m.Spawn(task="a", rmod=rmod("counts"), rmod_name="a.rmod", freq=50.0)
    assert arm.ask(request, m.TaskStatus).ref_f == 50.0


def test_one_writer_for_a_variable(arm):
    arm.spawn("a", "counts", out="Y0")
    arm.spawn("b", "counts", out="Y0")
    arm.on("a")
    error = arm.refused(SvarOwnerError, arm.on, "b")
    assert "a" in error.got
    assert arm.status("b").state == "OFF"
    arm.off("a")
    assert arm.on("b").state == "ON"


def test_list_of_signals(arm, tmp_path):
    book = tmp_path / "diary"
    arm.spawn("a", "counts", out="Y0", local={"DIARY": book})
    arm.spawn("b", "counts", out="Y0")
    arm.on("a")
    items = [("a", "off"), ("b", "on"), ("a", "on"), ("b", "off")]
    done = arm.ask(m.Reconfig(items=items), m.Reconfigured)
    assert done.done == 2
    assert done.states == {"a": "OFF", "b": "ON"}
    assert done.error["code"] == "SVAR_OWNER"
    assert diary(book)[-1] == "off True"  # b took its output over
    arm.ask(m.Reconfig(items=[("b", "off"), ("a", "on"), ("a", "off")]))
    assert diary(book)[-1] == "off False"


def test_events_of_a_module(arm):
    arm.spawn("a", "talks")
    arm.on("a")
    event = arm.wait_event("WARNING", "a")
    assert (event.text, event.cycle) == ("the fifth cycle", 4)
    wait_for(lambda: len(arm.events("SIGNAL", "a")) == 3, "three signals")
    found = [(e.bits, e.text, e.cycle) for e in arm.events("SIGNAL", "a")]
    assert found == [
        (Signal.FINISH, "FINISH: ten", 9),
        (1 << 10, "HALFWAY", 14),
        (Signal.OFF, "OFF: twenty is enough", 19),
    ]
    wait_for(lambda: arm.status("a").state == "OFF", "it turns itself off")
    status = arm.status("a")
    assert (status.warn, status.warning, status.cycle) == (1, "the fifth cycle", 20)
    arm.on("a")
    wait_for(lambda: arm.status("a").state == "OFF", "it turns itself off again")
    assert arm.status("a").warn == 1  # not 2: it counts from the last `on`


def test_every_cycle_is_in_the_ring(arm):
    status = arm.spawn("a", "counts")
    ring = Ring.attach(status.ring)
    arm.on("a")
    arm.wait_cycles("a", 20)
    off = arm.off("a")
    cycles = [record.cycle for record in ring.drain() if not record.kind]
    assert len(cycles) == off.cycle
    assert cycles == list(range(cycles[0], cycles[0] + len(cycles)))
    ring.close()
    arm.kill("a")
    assert not Path(ring.path).exists()


def test_stable_runs_while_the_configuration_is_illegal(arm):
    arm.spawn("a", "holds", invar="X", local={"LEVEL": 1}, critical=True)
    arm.on("a")
    wait_for(lambda: arm.value("Y0").values == [1.0, 1.0], "cycle")
    arm.ask(m.Flag(cause="a test", up=True))
    wait_for(lambda: arm.value("Y0").values == [-1.0, 1.0], "stable")
    arm.ask(m.Flag(cause="a test", up=False))
    wait_for(lambda: arm.value("Y0").values == [1.0, 1.0], "cycle again")


@pytest.mark.parametrize(
    ("level", "said"),
    [
        (6, "an output is not a finite number: Y0[0]"),
        (7, "ValueError: seven is not stable"),
        (8, "eight is not stable"),
    ],
)
def test_a_failure_of_stable_names_it(arm, level, said):
    arm.spawn("a", "holds", invar="X", local={"LEVEL": level}, critical=True)
    arm.on("a")
    wait_for(lambda: arm.value("Y0").values == [float(level), 1.0], "cycle")
    arm.ask(m.Flag(cause="a test", up=True))
    text = arm.wait_event("METHOD", "a").text
    assert text.startswith("a.stable: ")
    assert said in text


def test_many_tasks_at_once(arm):
    names = [f"t{i}" for i in range(8)]
    for i, name in enumerate(names):
        arm.spawn(name, "counts", out=f"Y{i}", freq=100.0 + 10 * i)
    for name in names:
        arm.on(name)
    for name in names:
        arm.wait_cycles(name, 10)
    assert {one.state for one in arm.status().values()} == {"ON"}
    pids = [one.tid for one in arm.status().values()]
    stopped = arm.stop(order=["t3"])
    assert stopped.off == ["t3", "t7", "t6", "t5", "t4", "t2", "t1", "t0"]
    assert stopped.killed == []
    wait_gone(pids)
    assert arm.status() == {}


def test_ranks_follow_what_is_on(arm):
    """`a` and `b` do not fit on the core together; what is OFF takes no share of it."""
    for name, out, freq, maxc in (("a", "Y0", 100.0, 0.009), ("b", "Y1", 50.0, 0.008)):
        text = rmod("counts", out, freq).replace("EOF", f"MAXC {maxc}\nEOF")
        arm.spawn(name, "counts", text=text)

    def crits():
        return {name: one.crit for name, one in arm.status().items()}

    assert crits() == {"a": 5, "b": 3}
    arm.on("b")
    assert crits() == {"a": 5, "b": 5}
    arm.on("a")
    assert crits() == {"a": 5, "b": 3}
    arm.off("a")
    assert crits()["b"] == 5


# -- what cannot be spawned ---


def test_name_is_taken(arm):
    arm.spawn("a", "counts")
    arm.refused(StateError, arm.spawn, "a", "counts")


def test_unknown_module(arm):
    error = arm.refused(ModuleLoadError, arm.spawn, "a", "count")
    assert error.what == "the library has no module count"
    assert error.remedy == "did you mean counts?"
    assert arm.status() == {}


def test_module_outside_the_library(arm):
    for name in ("os", "counts.py", "x/../counts", "_private"):
        text = rmod("counts").replace("MODULE counts", f"MODULE {name}")
        with pytest.raises((ModuleLoadError, ConfigError)):
            arm.spawn("a", "counts", text=text)


def test_syntax_error_names_file_and_line(arm, nodes):
    path = nodes.write_module("broken", "import math\n\ndef f(:\n    pass\n")
    error = arm.refused(ModuleLoadError, arm.spawn, "a", "broken")
    assert error.where.endswith(f"{path}:3")
    assert "def f(:" in error.got


def test_error_on_import_names_file_and_line(arm, nodes):
    path = nodes.write_module("broken", "import math\nmath.tau.unknown\n")
    error = arm.refused(ModuleLoadError, arm.spawn, "a", "broken")
    assert error.where.endswith(f"{path}:2")


def test_wrong_declaration_names_the_line(arm, nodes):
    nodes.write_module(
        "broken",
        """
        from pbonet import PortBasedObject

        class Broken(PortBasedObject):
            def cycle(self) -> None:
                pass
        """,
    )
    error = arm.refused(DeclarationError, arm.spawn, "a", "broken")
    assert "cycle" in str(error)


def test_changed_module_is_loaded_anew(arm, nodes):
    text = """
        from typing import Annotated as A
        from pbonet import OutVar, PortBasedObject, Vector

        class Says(PortBasedObject):
            y: A[Vector, OutVar("Y", "2", "none", "what it says")]

            def cycle(self, dt: float) -> None:
                self.y[:] = {}
        """
    versions = []
    for number in (1.0, 2.0):
        nodes.write_module("says", text.format(number))
        versions.append(arm.spawn("a", "says").version)
        arm.on("a")
        wait_for(lambda: arm.value("Y0").values == [number] * 2, "its value")  # noqa: B023
        arm.kill("a")
    assert versions[0] != versions[1]


def test_wrong_rmod_names_the_place(arm):
    error = arm.refused(ConfigError, arm.spawn, "a", "x", text="MODULES counts\nEOF\n")
    assert error.where == "arm0/a.rmod:1:1"
    assert "MODULE" in str(error)


def test_ports_that_disagree_are_refused_both_ways(arm):
    error = arm.refused(PortError, arm.spawn, "a", "counts", invar="X")
    assert "module counts has no in-var Z" in error.what
    error = arm.refused(PortError, arm.spawn, "a", "holds", local={"LEVEL": 1})
    assert "does not list in-var Z" in error.what


def test_unknown_variable_and_parameter(arm):
    error = arm.refused(UnknownVariableError, arm.spawn, "a", "counts", out="Y9")
    assert "Y9" in str(error)
    error = arm.refused(
        ParameterError, arm.spawn, "a", "holds", invar="X", local={"LEVEL": 11}
    )
    assert error.where == "arm0/a.rmod:12:1"
    arm.refused(ParameterError, arm.spawn, "a", "holds", invar="X")


def test_critical_needs_stable(arm):
    arm.refused(DeclarationError, arm.spawn, "a", "counts", critical=True)


def test_a_handler_needs_its_method(arm):
    text = rmod("counts").replace("FREQ 200", "FREQ 200\nHANDLER 6")
    error = arm.refused(DeclarationError, arm.spawn, "a", "counts", text=text)
    assert error.what == (
        "module counts has no timing_failure(), which HANDLER 6 counts on"
    )
    assert error.where == "arm0/a.rmod:10:1"
    assert error.expected.startswith("def timing_failure(self, kind) in /")
    assert error.remedy.endswith("or take HANDLER out of the .rmod file")


def test_a_task_that_the_clock_does_not_time_says_how_it_waits(arm):
    text = rmod("counts").replace("periodic", "synchronous")
    error = arm.refused(DeclarationError, arm.spawn, "a", "counts", text=text)
    assert error.what == (
        "module counts has no sync(), which TASKTYPE synchronous counts on"
    )
    assert error.where == "arm0/a.rmod:8:1"
    assert error.expected.startswith("def sync(self) in /")


def test_nothing_is_left_of_a_spawn_that_failed(arm, nodes, shared_memory):
    before = sorted(path.name for path in shared_memory.iterdir())
    for module in ("raises_in_init", "count", "segfaults_in_init"):
        with pytest.raises(PbonetError):
            arm.spawn("a", module, out="Y0" if module != "segfaults_in_init" else "")
    assert sorted(path.name for path in shared_memory.iterdir()) == before
    assert nodes.state("arm0").tasks == []
    assert arm.status() == {}
    assert arm.spawn("a", "counts").state == "OFF"


@pytest.mark.parametrize("limit", [-1.0, 1e9, float("nan")])
def test_time_limits_are_checked(arm, limit):
    arm.spawn("a", "counts")
    request = m.Control(task="a", signal="on", timeout=limit)
    arm.refused(ProtocolError, arm.ask, request)
    assert arm.status("a").state == "OFF"
