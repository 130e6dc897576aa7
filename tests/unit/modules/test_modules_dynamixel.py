"""Dynamixel servos, by their registers, on a bench."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scripted_motors as servos
from device_rigs import Dynamixel as Rig
from scripted_motors import GOAL, PLACE, SPEED, TORQUE, WATCHDOG, Servos
from watching import wait_for

from pbonet import State
from pbonet.errors import MethodError
from pbonet.io.drivers import Entry, database
from pbonet.modules.robot_interfaces.axes_position_sim import AxesPositionSim
from pbonet.modules.robot_interfaces.dynamixel import Dynamixel
from pbonet.testing import Bench

HALF = 2048


@pytest.fixture
def table(tmp_path, monkeypatch):
    """The registers of two servos in their middle, with a watchdog that has acted."""
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    monkeypatch.setattr(Servos, "silent", False)
    made = [[0, 0] for _ in servos.SIZES]
    made[WATCHDOG], made[GOAL] = [0, 0], [9, 9]
    made[PLACE], made[SPEED] = [HALF, HALF + 1024], [0, 2**32 - 100]
    made[servos.CURRENT] = [200, 2**16 - 100]
    Servos.tables[str(tmp_path)] = made
    entry = Entry(driver="scripted_motors:Servos", address=str(tmp_path))
    with database.using({"servos": entry}):
        yield made


def on_bench(**told):
    params = {"device": "servos", "zero": (-math.pi,), "torque": (0.01,), **told}
    return Bench(Dynamixel, params=params, ndof=2, freq=100, critical=True)


def started(**told):
    bench = on_bench(**told)
    bench.inputs.q_ref = [0.5, math.pi / 2]
    bench.on()
    bench.step(n=20)
    assert bench["READY"] == 1
    return bench


def test_its_twin_has_its_ports():
    assert [
        [(p.kind, p.name, p.shape, p.unit, p.max_age) for p in one.__interface__.ports]
        for one in (Dynamixel,)
    ] == [
        [(p.kind, p.name, p.shape, p.unit, p.max_age) for p in one.__interface__.ports]
        for one in (AxesPositionSim,)
    ]


def test_servos_have_torque_where_they_are_and_then_move_at_their_speed(table):
    bench = on_bench(speed=(1.0,))
    bench.inputs.q_ref = [1.0, math.pi / 2]
    bench.on()
    bench.step()
    assert bench.output_age > 0.9, "nothing was measured yet"
    assert table[TORQUE] == [0, 0]
    bench.step()
    assert bench["Q_MEZ"] == pytest.approx([0.0, math.pi / 2], abs=1e-3)
    assert bench["Q^_MEZ"] == pytest.approx([0, -22.9 * 2 * math.pi / 60])
    assert bench["T_MEZ"] == pytest.approx([2.0, -1.0])
    assert table[GOAL] == [9, 9]
    bench.step()
    assert (table[GOAL], table[TORQUE]) == ([HALF, HALF + 1024], [0, 0])
    bench.step()
    assert (table[TORQUE], table[WATCHDOG], bench["READY"]) == ([1, 1], [0, 0], 0)
    bench.step(n=2)
    assert (table[WATCHDOG], bench["READY"]) == ([10, 10], 1)
    assert table[GOAL] == [HALF, HALF + 1024]
    bench.step(n=50)
    moved = (np.array(table[GOAL]) - HALF) * 2 * math.pi / 4096
    assert moved == pytest.approx([0.5, math.pi / 2], abs=0.02)
    bench.step(n=100)
    assert bench["Q_MEZ"] == pytest.approx([1.0, math.pi / 2], abs=2e-3)


@pytest.mark.parametrize("hold", [True, False])
@pytest.mark.parametrize("end", ["off", "nan", "kill"])
def test_servos_hold_their_place_or_are_limp_whatever_ends(table, end, hold):
    bench = started(hold=hold)
    if end == "off":
        bench.off()
    elif end == "nan":
        bench.inputs.q_ref = [np.nan, 0.0]
        assert bench.step(check=False) is State.ERROR
    else:
        bench.kill()
    assert table[TORQUE] == [int(hold)] * 2
    assert table[GOAL][1] == HALF + 1024


def test_without_a_reference_the_servos_stay(table):
    bench = started(speed=(0.1,))
    bench.ages["q_ref"] = 0.2
    bench.step()
    before = list(table[GOAL])
    bench.step(n=20)
    assert table[GOAL] == before
    bench.ages["q_ref"] = 0.0
    bench.step(n=20)
    assert table[GOAL] != before


def test_silent_servos_end_in_error_and_go_on_after_on(table):
    bench = started()
    Servos.silent = True
    with pytest.raises(MethodError, match=r"has sent nothing for 0.2 s"):
        bench.step(n=40)
    Servos.silent = False
    table[WATCHDOG] = [255, 255]
    bench.clear()
    bench.on()
    bench.step(n=20)
    assert bench["READY"] == 1


def test_servos_that_their_watchdog_stopped_are_freed(table):
    """And were limp: they get no torque before they have a goal."""
    table[WATCHDOG] = [255, 255]
    bench = on_bench()
    bench.inputs.q_ref = [0.0, math.pi / 2]
    bench.on()
    bench.step(n=6)
    assert (bench["READY"], table[WATCHDOG]) == (1, [10, 10])
    assert table[PLACE] == [HALF, HALF + 1024]


@pytest.mark.parametrize("hold", [True, False])
def test_its_registers_reach_servos_over_a_serial_line(monkeypatch, tmp_path, hold):
    """By the driver, with servos that go where they shall when they have torque."""
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    rig = Rig(monkeypatch, tmp_path)
    memory = rig.servos.memory
    for one in memory.values():
        one[98], one[132:136] = 255, HALF.to_bytes(4, "little")
    memory[7][128:132] = (-100).to_bytes(4, "little", signed=True)
    memory[7][126:128] = (-100).to_bytes(2, "little", signed=True)
    registers = [[98, 1], [64, 1], [116, 4], [126, 2], [128, 4], [132, 4]]
    with database.using({"servos": rig.entry(registers=registers)}):
        bench = on_bench(hold=hold, silent=60.0, beat=2.54)
        bench.inputs.q_ref = [0.5, -0.25]
        bench.on()

        def there():
            bench.step()
            for one in memory.values():
                if one[64]:
                    one[132:136] = one[116:120]
            return np.allclose(bench["Q_MEZ"], [0.5, -0.25], atol=2e-3)

        wait_for(there, "the servos where they shall be")
        assert bench["READY"] == 1
        assert [one[98] for one in memory.values()] == [127, 127]
        assert bench["Q^_MEZ"][1] == pytest.approx(-22.9 * 2 * math.pi / 60)
        assert bench["T_MEZ"] == pytest.approx([0.0, -1.0])
        bench.kill()
    wait_for(lambda: [one[64] for one in memory.values()] == [hold] * 2, "the torque")
    rig.close()
