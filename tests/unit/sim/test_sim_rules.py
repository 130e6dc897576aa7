"""What a simulation refuses, undoes, and does when modules misbehave."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
from virtual_job import VirtualJob

from pbonet import State
from pbonet.errors import (
    ConfigError,
    MethodError,
    ModuleLoadError,
    NodeError,
    PbonetError,
    UnknownTaskError,
    VerificationError,
)
from pbonet.master.sim.virtual_loop import BEGIN_NS

HEAD = """
from typing import Annotated as A
from pbonet import *


"""

SOURCE = """
class Source(PortBasedObject):
    "Count."
    y: A[float, OutVar("Y", "1", "none", "count")]

    def cycle(self, dt):
        self.y += 1.0
"""

WAITS = """
    def sync(self):
        raise AssertionError("no device is waited for here")
"""

SINK = """
class Sink(PortBasedObject):
    "Remember."
    x: A[float, InVar("Y", "1", "none", "count")]
    z: A[float, OutVar("Z", "1", "none", "count, later")]

    def cycle(self, dt):
        self.z = self.x

    def stable(self, dt):
        self.z = -1.0
"""

SVAR = """
NAME  Y
TYPE  double
DESC  y
UNITS none
NELEM 1
{y}
NAME  Z
TYPE  double
DESC  z
UNITS none
NELEM 1

EOF
"""


class Shop:
    """Writes a subsystem with its modules into a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.limits = ""
        self.rtpus = ["a", "b"]
        (folder / "lib").mkdir()

    def module(self, name: str, code: str, *lines: str, head: str = HEAD) -> None:
        """Write a module, and an RMOD of the same name if lines are given."""
        (self.folder / "lib" / f"{name}.py").write_text(head + dedent(code))
        if lines:
            self.rmod(name, name, *lines)

    def rmod(self, name: str, module: str, *lines: str) -> None:
        """Write an RMOD with ports and timing as given."""
        ports = dict.fromkeys(("INCONST", "OUTCONST", "INVAR", "OUTVAR"), "none")
        rest = []
        for line in lines:
            key, _, value = line.partition(" ")
            if key in ports:
                ports[key] = value
            else:
                rest.append(line)
        text = [f"MODULE {module}", f"DESC {name}"]
        text += [f"{key} {value}" for key, value in ports.items()]
        if not any(line.startswith("TASKTYPE") for line in rest):
            text.append("TASKTYPE periodic")
        (self.folder / f"{name}.rmod").write_text("\n".join([*text, *rest, "EOF\n"]))

    def job(self, *tasks: str) -> VirtualJob:
        """Write job, subsystem and table, and open the job."""
        sbs = ["SUBSYSTEM shop", "SVARFILE shop.svar"]
        sbs += [f"RTPU {name}" for name in self.rtpus]
        (self.folder / "shop.sbs").write_text("\n".join([*sbs, "EOF\n"]))
        (self.folder / "shop.svar").write_text(SVAR.format(y=self.limits))
        lines = ["JOB test", "DESC test", "SBS shop.sbs"]
        lines += [f"TASK {task}" for task in tasks]
        (self.folder / "test.job").write_text("\n".join([*lines, "EOF\n"]))
        return VirtualJob(self.folder / "test.job", [self.folder / "lib"])


@pytest.fixture
def shop(tmp_path: Path) -> Shop:
    shop = Shop(tmp_path)
    shop.module("source", SOURCE, "OUTVAR Y", "FREQ 100")
    shop.module("sink", SINK, "INVAR Y", "OUTVAR Z", "FREQ 100", "CRITICAL")
    return shop


def test_illegal_job_is_refused_before_anything_runs(shop: Shop) -> None:
    simulation = shop.job("sink a")
    with pytest.raises(VerificationError, match=r"ON writes Y.* and source and"):
        simulation.start()
    assert simulation.states() == {}


def test_modules_know_their_criticality(shop: Shop) -> None:
    told = SOURCE.replace("self.y += 1.0", "self.y = float(self.task.crit)")
    shop.module("told", told, "OUTVAR Y", "FREQ 100", "CRIT 7")
    recording = shop.job("told a").run(0.03)
    assert recording.arrays("told")["Y"].ravel().tolist() == [7.0, 7.0, 7.0]


def test_more_urgent_task_runs_first_at_the_same_instant(shop: Shop) -> None:
    """On one RTPU the producer comes first, as the data flows (section 6.2.4)."""
    simulation = shop.job("sink a", "source a")
    recording = simulation.run(0.1)
    y = recording.arrays("source")["Y"].ravel()
    z = recording.arrays("sink")["Z"].ravel()
    assert y.tolist() == list(range(1, 11))
    assert z.tolist() == y.tolist(), "the sink sees what was written at its instant"


def test_rtpus_have_their_turn_in_the_order_of_the_sbs_file(shop: Shop) -> None:
    for rtpus, seen in ((["a", "b"], [0, 1, 2]), (["b", "a"], [1, 2, 3])):
        shop.rtpus = rtpus
        recording = shop.job("sink a", "source b").run(0.03)
        assert recording.arrays("sink")["Z"].ravel().tolist() == seen


def test_rates_divide_the_time_and_dt_says_so(shop: Shop) -> None:
    shop.module(
        "clock",
        """
        class Clock(PortBasedObject):
            "Add up dt."
            y: A[float, OutVar("Y", "1", "none", "time")]

            def cycle(self, dt):
                self.y += dt
        """,
        "OUTVAR Y",
        "FREQ 30",
    )
    recording = shop.job("clock a FREQ 40").run(2.0)
    arrays = recording.arrays("clock")
    assert len(arrays["cycle"]) == 80
    assert arrays["Y"].ravel() == pytest.approx(np.arange(1, 81) / 40)
    assert np.all(arrays["release_ns"] % 25_000_000 == 0), "on the absolute grid"
    assert arrays["release_ns"][0] > BEGIN_NS


def test_time_may_pass_in_pieces(shop: Shop) -> None:
    whole, pieces = shop.job("source a"), shop.job("source a")
    whole.start()
    whole.wait(0.5)
    pieces.start()
    for _ in range(100):
        pieces.wait(0.005)
    assert pieces.clock.now() == whole.clock.now()
    for name, values in whole.recording.arrays("source").items():
        assert np.array_equal(pieces.recording.arrays("source")[name], values)


STEPS = """
class Steps(PortBasedObject):
    "Tell dt, and warn of the first two."
    y: A[float, OutVar("Y", "1", "none", "dt")]

    def cycle(self, dt):
        self.y = dt
        if self.task.cyclecount < 2:
            self.task.warn(f"cycle {self.task.cyclecount}")
"""


def test_turning_on_again_begins_anew(shop: Shop) -> None:
    shop.module("steps", STEPS, "OUTVAR Y", "FREQ 10")
    simulation = shop.job("steps a")
    simulation.start()
    simulation.wait(1.0)
    for seconds, cycles in ((7.0, 10), (1.0, 10)):
        (status,) = simulation.rtpu_status()[0].tasks
        assert (status.cycle, status.warn) == (cycles, 2)
        assert status.ptime == pytest.approx(1.0)
        assert status.mez_f == pytest.approx(10.0)
        assert status.warning == simulation.events[1].partition(": ")[2]
        simulation.control("steps", "off")
        simulation.wait(seconds)
        (status,) = simulation.rtpu_status()[0].tasks
        assert (status.cycle, status.state) == (cycles, State.OFF)
        assert status.ptime == pytest.approx(1.0), "time stands while it is OFF"
        simulation.control("steps", "on")
        simulation.wait(1.0)
    dts = simulation.recording.arrays("steps")["Y"].ravel()
    assert dts == pytest.approx(np.full(30, 0.1)), "not the time it was OFF"


def test_a_task_that_ends_after_one_cycle_had_its_frequency(shop: Shop) -> None:
    shop.module("steps", STEPS.replace("< 2", "< 0"), "OUTVAR Y", "FREQ 10")
    simulation = shop.job("steps a")
    simulation.start()
    simulation.control("steps", "off")
    simulation.wait(0.075)
    simulation.control("steps", "on")  # 0.025 s before its next release
    simulation.wait(0.03)
    simulation.control("steps", "off")
    (status,) = simulation.rtpu_status()[0].tasks
    assert status.cycle == 1
    assert status.mez_f == pytest.approx(10.0)


def test_failed_init_undoes_everything(shop: Shop) -> None:
    shop.module(
        "broken",
        """
        class Broken(PortBasedObject):
            "Fail."
            z: A[float, OutVar("Z", "1", "none", "nothing")]

            def init(self):
                raise RuntimeError("no such thing")

            def cycle(self, dt): ...
        """,
        "OUTVAR Z",
        "FREQ 10",
    )
    simulation = shop.job("source a", "broken a")
    with pytest.raises(MethodError, match="RuntimeError: no such thing"):
        simulation.start()
    assert simulation.states() == {}


FRAGILE = """
class Fragile(PortBasedObject):
    "Count, and fail at five."
    y: A[float, OutVar("Y", "1", "none", "count")]

    def cycle(self, dt):
        self.y += 1.0
        {what}
"""


@pytest.mark.parametrize(
    "what",
    [
        "assert self.y != 5.0, 'five'",
        "self.y = float('nan') if self.y == 5.0 else self.y",
        "1 / (self.y - 5.0)",
    ],
)
def test_error_in_a_cycle_stops_that_task_and_makes_critical_ones_stable(
    shop: Shop, what: str
) -> None:
    shop.module("fragile", FRAGILE.format(what=what), "OUTVAR Y", "FREQ 100")
    simulation = shop.job("fragile a", "sink b")
    simulation.start()
    simulation.wait(0.2)
    assert simulation.states() == {"fragile": State.ERROR, "sink": State.ON}
    assert simulation.recording.arrays("fragile")["Y"].ravel().tolist() == [1, 2, 3, 4]
    assert simulation.table.read("Y").tolist() == [4.0], "the last good value stands"
    z = simulation.recording.arrays("sink")["Z"].ravel()
    assert z.tolist() == [1.0, 2.0, 3.0, 4.0] + [-1.0] * 16
    assert any("fragile" in event for event in simulation.events)

    assert simulation.control("fragile", "clear").state == "OFF"
    simulation.table.write("Y", [10.0])  # an operator removes the cause
    simulation.control("fragile", "on")
    assert not simulation.table.illegal
    simulation.wait(0.02)
    assert simulation.table.read("Z").tolist() == [12.0]
    simulation.stop()
    assert simulation.states() == {}


def test_module_turns_itself_off_and_can_be_turned_on_again(shop: Shop) -> None:
    shop.module(
        "goal",
        """
        class Goal(PortBasedObject):
            "Count to three."
            y: A[float, OutVar("Y", "1", "none", "count")]

            def cycle(self, dt):
                self.y += 1.0
                if self.y % 3.0 == 0.0:
                    self.task.signal(Signal.OFF, "there")
        """,
        "OUTVAR Y",
        "FREQ 10",
    )
    simulation = shop.job("goal a")
    simulation.start()
    simulation.wait(2.0)
    assert simulation.states() == {"goal": State.OFF}
    assert simulation.table.read("Y").tolist() == [3.0]
    assert simulation.events == ["0.300 s goal: OFF: there"]
    simulation.control("goal", "on")
    simulation.wait(2.0)
    assert simulation.table.read("Y").tolist() == [6.0]
    cycles = simulation.recording.arrays("goal")["cycle"].tolist()
    assert cycles == [1, 2, 3, 1, 2, 3], "counted since it was turned on"
    simulation.stop()


@pytest.mark.parametrize(
    ("limits", "state", "last"),
    [
        ("MIN 0\nMAX 3\nLIMIT clip", State.ON, 3.0),
        ("MIN 0\nMAX 3\nLIMIT error", State.ERROR, 3.0),
        ("MIN 0\nMAX 3", State.ON, 10.0),
    ],
)
def test_limits_of_variables_hold(
    shop: Shop, limits: str, state: State, last: float
) -> None:
    shop.limits = limits
    simulation = shop.job("source a")
    simulation.start()
    simulation.wait(0.1)
    assert simulation.states() == {"source": state}
    assert simulation.table.read("Y").tolist() == [last]
    simulation.stop()


@pytest.mark.parametrize(("finite", "state"), [("no", State.ON), ("yes", State.ERROR)])
def test_nan_is_outside_of_no_limit_but_finite_judges_it(
    shop: Shop, finite: str, state: State
) -> None:
    shop.limits = f"MIN 0\nMAX 3\nLIMIT error\nFINITE {finite}"
    shop.module(
        "nan", SOURCE.replace("+= 1.0", "= float('nan')"), "OUTVAR Y", "FREQ 100"
    )
    simulation = shop.job("nan a")
    simulation.start()
    simulation.wait(0.1)
    assert simulation.states() == {"nan": state}
    assert np.isnan(simulation.table.read("Y")).all() == (finite == "no")


def test_two_rmods_of_one_module_have_two_lives(shop: Shop) -> None:
    shop.rmod("other", "source", "SVARALIAS Y=Z", "OUTVAR Y", "FREQ 50")
    text = (shop.folder / "other.rmod").read_text()
    head, alias = text.split("SVARALIAS Y=Z\n")
    first, second, *rest = head.splitlines()
    lines = [first, second, "SVARALIAS Y=Z", *rest, alias]
    (shop.folder / "other.rmod").write_text("\n".join(lines))
    recording = shop.job("source a", "other a").run(1.0)
    assert recording.arrays("source")["Y"][-1] == 100.0
    assert recording.arrays("other")["Z"][-1] == 50.0


def test_synchronous_task_runs_at_its_rate(shop: Shop) -> None:
    shop.module("device", SOURCE + WAITS)
    shop.rmod("timed", "device", "OUTVAR Y", "TASKTYPE synchronous", "FREQ 20")
    assert len(shop.job("timed a").run(1.0).arrays("timed")["cycle"]) == 20


def test_what_cannot_be_simulated_says_so(shop: Shop) -> None:
    lines = ["TASKTYPE sporadic", "FREQ 10", "CAPACITY 0.01"]
    shop.module("server", SOURCE + WAITS, "OUTVAR Y", *lines)
    with pytest.raises(NodeError, match="a sporadic task cannot be simulated"):
        shop.job("server a").start()
    shop.rmod("lost", "nowhere", "OUTVAR Y", "FREQ 10")
    with pytest.raises(ModuleLoadError, match="no module nowhere"):
        shop.job("lost a").start()
    with pytest.raises(PbonetError, match="shop has no RTPU c"):
        shop.job("source c").start()
    with pytest.raises(ConfigError, match="no RMOD nothing"):
        shop.job("nothing a").start()
    with pytest.raises(UnknownTaskError, match="no task sink"):
        shop.job("source a").control("sink", "on")


def test_off_follows_the_job_s_order(
    shop: Shop, capsys: pytest.CaptureFixture[str]
) -> None:
    talkative = """
    class Talker(PortBasedObject):
        "Say goodbye."
        {port}

        def cycle(self, dt): ...

        def off(self):
            print("off", self.task.name)

        def kill(self):
            print("kill", self.task.name)
    """
    shop.module(
        "first",
        talkative.format(port='y: A[float, OutVar("Y", "1", "none", "y")]'),
        "OUTVAR Y",
        "FREQ 10",
    )
    shop.module(
        "second",
        talkative.format(port='z: A[float, OutVar("Z", "1", "none", "z")]'),
        "OUTVAR Z",
        "FREQ 10",
    )
    simulation = shop.job("first a", "second a")
    path = shop.folder / "test.job"
    path.write_text(path.read_text().replace("EOF", "OFF second first\nEOF"))
    simulation = VirtualJob(path, [shop.folder / "lib"])
    simulation.run(0.5)
    out = capsys.readouterr().out.split("\n")
    assert out[:4] == ["off second", "off first", "kill second", "kill first"]


STALE = """
class Stale(PortBasedObject):
    "Tell whether the input is old."
    x: A[float, InVar("Y", "1", "none", "count")]
    z: A[float, OutVar("Z", "1", "none", "1 when it is stale")]

    def cycle(self, dt):
        self.z = float(self.task.stale("x"))
"""


def test_inputs_grow_old_in_virtual_time(shop: Shop) -> None:
    shop.module("stale", STALE, "INVAR Y", "OUTVAR Z", "FREQ 100")
    for limits, seen in (("MAXAGE 0.035", [0.0] * 13 + [1.0] * 7), ("", [0.0] * 20)):
        shop.limits = limits
        simulation = shop.job("source a", "stale a")
        simulation.start()
        simulation.wait(0.1)
        simulation.control("source", "off")  # which writes once more
        simulation.wait(0.1)
        z = simulation.recording.arrays("stale")["Z"].ravel()
        assert z.tolist() == seen
