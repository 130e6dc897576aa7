"""Drives on a CAN bus, against a drive that is scripted from the tables of CiA 402."""

from __future__ import annotations

import itertools
import math
import random
from contextlib import suppress

import can
import numpy as np
import pytest
from scripted_motors import ScriptedDrive

from pbonet import State
from pbonet.errors import MethodError
from pbonet.io.drivers import Entry, database
from pbonet.modules.robot_interfaces.axes_position_sim import AxesPositionSim
from pbonet.modules.robot_interfaces.axes_speed_sim import AxesSpeedSim
from pbonet.modules.robot_interfaces.axes_torque_sim import AxesTorqueSim
from pbonet.modules.robot_interfaces.can_position import CanPosition
from pbonet.modules.robot_interfaces.can_speed import CanSpeed
from pbonet.modules.robot_interfaces.can_torque import CanTorque
from pbonet.outside import Player, Tape, using as recording
from pbonet.testing import Bench

PAIRS = [
    (CanPosition, AxesPositionSim),
    (CanSpeed, AxesSpeedSim),
    (CanTorque, AxesTorqueSim),
]
CHANNELS = (f"bus {k} of a test" for k in itertools.count())


class Rig:
    """Two drives on a bus, and a task that drives them."""

    def __init__(self, module, **told):
        channel = next(CHANNELS)
        self.drives = [
            ScriptedDrive(can.Bus(channel, interface="virtual", rx_queue_size=4096), k)
            for k in (1, 5)
        ]
        entry = Entry(driver="can", address=channel, settings={"interface": "virtual"})
        self.devices = database.using({"can0": entry})
        self.devices.__enter__()
        params = {
            "device": "can0",
            "nodes": (1, 5),
            "counts": (2000.0,),
            "gear": (50.0, -10.0),
            "rated": (0.5,),
            **told,
        }
        self.task = Bench(module, params=params, ndof=2, freq=100, critical=True)

    def run(self, n=1, *, check=True):
        for _ in range(n):
            self.task.step(check=check)
            for one in self.drives:
                one.serve(self.task.clock())
            if self.task.state is not State.ON:
                break

    def start(self, **inputs):
        for name, value in inputs.items():
            setattr(self.task.inputs, name, value)
        self.task.on()
        for _ in range(100):
            self.run()
            if self.task["READY"]:
                return
        raise AssertionError([one.passed for one in self.drives])

    def serve(self, seconds):
        """Let time pass for the drives alone: the task is dead."""
        now = self.task.clock.advance(seconds)
        for one in self.drives:
            one.serve(now)

    def states(self):
        return [one.state for one in self.drives]

    def close(self):
        if self.task.state is not State.NOT_CREATED:
            self.task.kill()
        for one in self.drives:
            one.bus.shutdown()
        self.devices.__exit__(None, None, None)


@pytest.fixture(autouse=True)
def run_dir(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))


@pytest.fixture
def rig():
    made = []

    def one(module=CanSpeed, **told):
        made.append(Rig(module, **told))
        return made[-1]

    yield one
    for each in made:
        each.close()


UP = ["switch on disabled", "ready", "switched on", "enabled"]


@pytest.mark.parametrize(("real", "twin"), PAIRS)
def test_a_twin_has_the_ports_of_the_drives(real, twin):
    found = [
        [(p.kind, p.name, p.shape, p.unit, p.max_age) for p in one.__interface__.ports]
        for one in (real, twin)
    ]
    assert found[0] == found[1]


def test_drives_are_set_up_enabled_step_by_step_and_go_at_a_speed(rig):
    it = rig(CanSpeed, speed=(2.0,))
    assert (it.task["NDOF"], it.task["GEAR"].tolist()) == (2, [50.0, -10.0])
    it.task.on()
    assert it.task.output_age > 0.9, "nothing was measured yet"
    it.task.off()
    it.start(qd_ref=[1.0, 5.0])
    for one in it.drives:
        assert one.passed == UP
        assert one.objects[0x6060, 0] == 9
        assert one.objects[0x1016, 1] == 127 << 16 | 100
    it.run(3)
    turns = [1.0 * 50 / (2 * math.pi), 2.0 * -10 / (2 * math.pi)]
    speeds = [one.values[0x606C] for one in it.drives]
    assert speeds == [round(2000 * one) for one in turns]
    assert it.task["Q^_MEZ"] == pytest.approx([1.0, 2.0], rel=1e-3)
    places = [1000 / 2000 * 2 * math.pi / gear for gear in (50, -10)]
    assert it.task["Q_MEZ"] == pytest.approx(places)
    assert it.task.output_age <= 0.01


def test_heartbeats_that_are_far_apart_hold_no_drive_up(rig):
    it = rig(CanSpeed, beat=10.0)
    it.start(qd_ref=[0.0, 0.0])
    assert it.drives[0].objects[0x1017, 0] == 2500, "ms, longer than it is waited for"


def test_a_position_begins_where_the_drives_are_and_moves_at_its_speed(rig):
    it = rig(CanPosition, speed=(0.5,), gear=(1.0,), follow=50.0)
    it.start(q_ref=[100.0, math.pi])
    assert it.drives[0].objects[0x6060, 0] == 8
    begin = it.task["Q_MEZ"].copy()
    assert begin == pytest.approx([math.pi, math.pi], abs=0.02)
    it.run(100)
    assert it.task["Q_MEZ"] - begin == pytest.approx([0.5, 0.0], abs=0.02)
    it.task.inputs.q_ref = [math.pi, math.pi]
    it.run(300)
    assert it.task["Q_MEZ"] == pytest.approx([math.pi, math.pi], abs=2e-3)


def test_a_torque_is_limited_and_measured_at_the_axis(rig):
    it = rig(CanTorque, limit=(10.0, 2.0))
    it.start(t_ref=[5.0, 9.0])
    it.run(3)
    assert it.drives[0].objects[0x6060, 0] == 10
    assert [one.values[0x6077] for one in it.drives] == [200, -400]
    assert it.task["T_MEZ"] == pytest.approx([5.0, 2.0])


def test_drives_that_hold_the_reset_word_of_a_run_before_are_reset_by_its_edge(rig):
    it = rig()
    it.drives[0].state = "fault"
    it.task.on()
    with pytest.raises(MethodError, match="drive 1 has a fault"):
        it.run(100)
    assert it.states()[0] == "fault"
    it.task.clear()
    it.drives[0].control = 0x80
    it.start()
    assert it.drives[0].passed[-4:] == UP


@pytest.mark.parametrize("end", ["stale", "illegal", "off", "swap", "nan", "kill"])
def test_drives_stop_quickly_whatever_ends(rig, end):
    it = rig()
    it.start(qd_ref=[1.0, 1.0])
    if end == "stale":
        it.task.ages["qd_ref"] = 0.2
        it.run()
    elif end == "illegal":
        it.task.illegal = True
        it.run()
    elif end in {"off", "swap"}:
        it.task.off(handover=end == "swap")
    elif end == "nan":
        it.task.inputs.qd_ref = [np.nan, 0.0]
        it.run(check=False)
        assert it.task.state is State.ERROR
    else:
        it.task.kill()
    it.serve(0.01)
    assert it.states() == ["quick stop active"] * 2
    if end not in {"nan", "kill"}:  # whose last cycle remains
        assert it.task["READY"] == 0
    assert [one.values[0x606C] for one in it.drives] == [0, 0]


def test_after_a_stop_the_drives_are_enabled_again(rig):
    it = rig()
    it.start(qd_ref=[1.0, 1.0])
    it.task.ages["qd_ref"] = 0.2
    it.run(10)
    assert it.task["READY"] == 0
    it.task.ages["qd_ref"] = 0.0
    it.run(20)
    assert it.task["READY"] == 1
    assert it.drives[0].passed == [*UP, "quick stop active", *UP]


def test_the_drives_of_a_task_that_died_stop_by_themselves(rig):
    it = rig()
    it.start(qd_ref=[1.0, 1.0])
    it.serve(0.09)
    assert it.states() == ["enabled"] * 2
    it.serve(0.03)
    assert it.states() == ["quick stop active"] * 2


def test_drives_that_are_let_alone_by_off_do_not_miss_the_task(rig):
    it = rig()
    it.start()
    it.task.off()
    it.serve(0.01)
    assert it.drives[0].objects[0x1016, 1] == 0


def silent(it):
    it.drives[1].silent = True


def fault(it):
    it.drives[1].fail(0x7305)


def restart(it):
    it.drives[1].send(0x705, b"\0")


def disabled(it):
    it.drives[1].go("switch on disabled")


def no_data(it):
    it.drives[1].objects[0x1A00, 0] = 0


@pytest.mark.parametrize(
    ("event", "told"),
    [
        (silent, "drive 5 gives no sign of life for 0.1 s"),
        (fault, r"drive 5 has a fault \(error code 7305h\)"),
        (restart, "drive 5 has started again by itself"),
        (disabled, "drive 5 is no longer enabled: its state is switch on disabled"),
        (no_data, "drive 5 sends no position for 0.1 s"),
    ],
)
def test_what_happens_to_one_drive_stops_all(rig, event, told):
    it = rig()
    it.start(qd_ref=[1.0, 1.0])
    event(it)
    with pytest.raises(MethodError, match=told):
        it.run(20)
    it.serve(0.01)
    assert it.drives[0].state == "quick stop active"
    assert it.task.state is State.ERROR


@pytest.mark.parametrize("seed", range(3))
def test_garbage_on_the_bus_ends_in_an_error_or_nowhere(rig, seed):
    """A hundred thousand bytes, in frames that are none of a drive or damaged."""
    chance = random.Random(seed)
    kinds = [0x80, 0x180, 0x280, 0x580, 0x700]
    identities = [kind + node for kind in kinds for node in (1, 5, 9)] + [0x7FF]
    it = rig()
    it.start(qd_ref=[1.0, 1.0])
    for _ in range(125):
        for _ in range(100):
            size = 8 if seed else chance.randrange(9)
            it.drives[0].send(chance.choice(identities), chance.randbytes(size))
        with suppress(MethodError):
            if it.task.state is State.ON:
                it.run()
        it.serve(0.0)
    assert it.task.state in {State.ON, State.ERROR}
    assert np.isfinite(it.task.outputs.q).all()
    it.task.kill()
    it.serve(1.0)
    assert "enabled" not in it.states()


@pytest.mark.parametrize("stays", [False, True])
def test_a_fault_is_reset_once_by_clear_and_on(rig, stays):
    it = rig()
    it.start()
    it.drives[1].fail(0x2310)
    with pytest.raises(MethodError, match="2310h"):
        it.run(5)
    it.drives[1].stays_in_fault = stays
    it.task.clear()
    if not stays:
        it.start()
        assert it.states() == ["enabled"] * 2
        return
    it.task.on()
    with pytest.raises(MethodError, match="not enabled in 3 s: its state is fault"):
        it.run(400)


def test_a_drive_that_fails_again_when_it_is_enabled_is_not_reset_again(rig):
    it = rig()
    it.start()
    it.drives[0].fail(0x2310)
    with pytest.raises(MethodError, match="2310h"):
        it.run(5)
    it.task.clear()
    it.drives[0].fails_in = "ready"
    it.task.on()
    with pytest.raises(MethodError, match="8611h"):
        it.run(400)
    assert it.drives[0].passed[-3:] == ["switch on disabled", "ready", "fault"]


def test_no_drive_moves_before_all_are_enabled(rig):
    it = rig()
    it.drives[1].state = "not ready"
    it.task.inputs.qd_ref = [1.0, 1.0]
    it.task.on()
    it.run(100)
    assert it.states() == ["enabled", "not ready"]
    assert (it.drives[0].values[0x606C], it.task["READY"]) == (0, 0)
    it.drives[1].go("switch on disabled")
    it.run(20)
    assert it.drives[0].values[0x606C] > 0
    assert it.task["READY"] == 1


@pytest.mark.parametrize(
    ("missing", "told"),
    [
        (0x6007, r"drive 1 refuses the object 6007h:0 \(abort code 06020000h\)"),
        (0x6060, "6060h:0"),
    ],
)
def test_a_drive_without_an_object_that_is_needed_is_refused(rig, missing, told):
    it = rig()
    it.drives[0].missing.add(missing)
    it.task.on()
    with pytest.raises(MethodError, match=told):
        it.run(100)


def test_a_drive_that_does_not_answer_is_named(rig):
    it = rig()
    it.drives[1].silent = True
    it.task.on()
    with pytest.raises(MethodError, match=r"drive 5 does not answer .* 1400h:1"):
        it.run(100)


def test_a_bus_that_takes_no_frames_any_more_ends_in_error(rig, monkeypatch):
    """As one whose cable was pulled: the interface is full, and stays so."""
    it = rig()
    it.start(qd_ref=[1.0, 1.0])
    monkeypatch.setattr(it.task.module._device, "_give", lambda _frame: False)
    with pytest.raises(MethodError, match="the CAN bus took 0 of"):
        it.run()
    assert it.task.state is State.ERROR
    it.serve(0.2)
    assert it.states() == ["quick stop active"] * 2


def test_nodes_are_as_many_as_axes():
    told = {"device": "x", "nodes": (3, 3), "counts": (1.0,), "rated": (1.0,)}
    with pytest.raises(MethodError, match="2 different numbers"):
        Bench(CanSpeed, params=told, ndof=2)


def test_a_run_is_replayed_without_a_bus(rig):
    def run(it):
        it.start(qd_ref=[0.5, -0.5])
        it.run(5)
        found = it.task["Q^_MEZ"].tolist(), it.task.clock()
        it.task.off()
        it.task.kill()
        return found

    tape = Tape(1 << 20)
    with recording(tape):
        first = run(rig())
    player = Player()
    player.feed(tape.take())
    with recording(player):
        again = rig()
        with database.using({}):
            assert run(again) == first


def test_the_twins_follow_and_stop():
    one = Bench(AxesPositionSim, params={"speed": (0.5,)}, ndof=1, q=[1.0], q_ref=[9.0])
    two = Bench(AxesSpeedSim, params={"slow": (2.0,)}, ndof=1, critical=True)
    three = Bench(
        AxesTorqueSim,
        params={"inertia": (0.1,), "damping": (0.5,), "limit": (1.0,)},
        ndof=1,
        t_ref=[5.0],
    )
    two.inputs.qd_ref = [0.8]
    for each in (one, two, three):
        each.on()
        each.step(n=100)
    assert one["Q_MEZ"][0] == pytest.approx(1.5, abs=0.02)
    assert one["Q^_MEZ"][0] == pytest.approx(0.5)
    assert two["Q^_MEZ"][0] == pytest.approx(0.8)
    assert three["Q^_MEZ"][0] == pytest.approx(2.0, rel=0.02)
    two.illegal = True
    two.step(n=20)
    assert (two["Q^_MEZ"][0], two["READY"]) == (pytest.approx(0.4), 0)
    two.step(n=40)
    assert two["Q^_MEZ"][0] == 0.0
    one.inputs.q_ref = [np.nan]
    assert one.step(check=False) is State.ERROR
