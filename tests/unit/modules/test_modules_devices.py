"""Modules over a logical device and their simulated twins, on a bench."""

from __future__ import annotations

import math
import os
import random
import socket
import struct
import threading
import tty
from pathlib import Path

import numpy as np
import pytest
import smbus2
from device_rigs import Gpio
from watching import wait_for

import pbonet.modules
from pbonet import State, TimingFailure
from pbonet.config import Library
from pbonet.errors import DeviceError, MethodError
from pbonet.io.drivers import Entry, Mode, database, i2c_driver, open_device
from pbonet.io.drivers.device import Device
from pbonet.io.drivers.port_claims import Claim
from pbonet.modules._ft300_frames import Frames
from pbonet.modules.robot_interfaces.linear_actuator import LinearActuator
from pbonet.modules.robot_interfaces.linear_actuator_sim import LinearActuatorSim
from pbonet.modules.sensors.encoder import Encoder
from pbonet.modules.sensors.encoder_sim import EncoderSim
from pbonet.modules.sensors.ft300 import MOST, Ft300
from pbonet.modules.sensors.ft300_sim import Ft300Sim
from pbonet.modules.sensors.linear_sensor import LinearSensor
from pbonet.modules.sensors.linear_sensor_sim import LinearSensorSim
from pbonet.modules.sensors.mpu6050 import Mpu6050
from pbonet.modules.sensors.mpu6050_sim import Mpu6050Sim
from pbonet.modules.teleoperation.joystick import Joystick
from pbonet.modules.teleoperation.joystick_sim import JoystickSim
from pbonet.outside import Player, Tape, using as recording
from pbonet.pbo import decode_params
from pbonet.testing import Bench

G = 9.80665
PAIRS = [
    (LinearSensor, LinearSensorSim),
    (LinearActuator, LinearActuatorSim),
    (Encoder, EncoderSim),
    (Mpu6050, Mpu6050Sim),
    (Ft300, Ft300Sim),
    (Joystick, JoystickSim),
]


@pytest.fixture(autouse=True)
def run_dir(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))


EACH = {"scale", "offset", "safe", "mean", "amplitude", "counts", "gear", "zero"}


def on_bench(module, told, **more):
    """Return a bench; a parameter for each element may be given as one number."""
    params = {
        key: (value,) if key in EACH and isinstance(value, int | float) else value
        for key, value in told.items()
    }
    return Bench(module, params=params, **more)


def shapes(module):
    return [
        (port.kind, port.name, port.shape, port.unit, port.max_age)
        for port in module.__interface__.ports
    ]


@pytest.mark.parametrize(("real", "twin"), PAIRS)
def test_a_twin_has_the_ports_of_the_real_one(real, twin):
    assert shapes(real) == shapes(twin)
    assert real.module_class == twin.module_class


def replayed(run):
    """Return what a run gives, and see that it gives the same without a device."""
    tape = Tape(1 << 20)
    with recording(tape):
        first = run()
    player = Player()
    player.feed(tape.take())
    with database.using({}), recording(player):
        assert run() == first
    return first


RMODS = [
    "linear_sensor", "linear_sensor_sim", "thermometer", "light_sensor", "buttons",
    "modbus_inputs", "linear_actuator", "linear_actuator_sim", "relays",
    "modbus_outputs", "encoder", "encoder_sim", "mpu6050", "mpu6050_sim", "ft300",
    "ft300_sim", "can_position", "can_speed", "can_torque", "dynamixel",
    "axes_position_sim", "axes_speed_sim", "axes_torque_sim", "joystick",
    "joystick_sim",
]  # fmt: skip


@pytest.mark.parametrize("name", RMODS)
def test_the_library_has_an_rmod_that_fits_its_module(name):
    library = Library()
    record = library.read_rmod(library.find_rmod(name))
    loaded = library.load_rmod(record)
    decode_params(loaded.cls, record.settings, where=record.file)
    if loaded.info.module_class == "robot interface":
        assert record.critical
    wanted = {port.name for port in loaded.info.ports}
    ports = (record.inconst, record.outconst, record.invar, record.outvar)
    assert {port for names in ports for port in names} == wanted


def test_each_module_that_opens_a_device_says_so():
    """A task is bound to the machine that has what such a parameter names."""
    library = Library()
    unsaid = [
        path.stem
        for path in sorted(Path(pbonet.modules.__file__).parent.glob("*/[a-z]*.py"))
        for one in library.load(path.stem).info.params
        if (one.name, one.type) == ("device", "str") and one.names != "device"
    ]
    assert unsaid == ["jtball", "spacemouse"], "whose parameter is a file"


# ------------------------------------------------------------------- linear_sensor


@pytest.fixture
def iio(tmp_path):
    """A thermometer with a sign, two lamps, and a converter to two voltages."""
    files = {"in_temp0_raw": -80, "in_voltage0_raw": 100, "in_voltage1_raw": 40000}
    files |= {"out_voltage0_raw": 0, "out_voltage1_raw": 0}
    for name, value in files.items():
        (tmp_path / name).write_text(f"{value}\n")
    kinds = {"temp": ["temp0"], "light": ["voltage0", "voltage1"]}
    entries = {
        name: Entry(
            driver="iio_adc", address=str(tmp_path), settings={"channels": channels}
        )
        for name, channels in kinds.items()
    }
    entries["dac"] = Entry(
        driver="iio_dac", address=str(tmp_path), settings={"bits": 12}
    )
    with database.using(entries):
        yield tmp_path


@pytest.mark.usefixtures("iio")
def test_a_thermometer_and_light_sensors_have_one_law_and_replay():
    def run():
        told = {"device": "temp", "scale": 0.0625, "offset": 1.0, "signed": True}
        with on_bench(LinearSensor, told, n=1) as one:
            one.on()
            one.step()
            cold = one.outputs.y.tolist()
        told = {"device": "light", "scale": (0.5, 2.0)}
        with on_bench(LinearSensor, told, n=2) as two:
            two.on()
            two.step()
            return cold, two.outputs.y.tolist()

    assert replayed(run) == ([-4.0], [50.0, 80000.0])


def test_a_lost_sensor_is_in_error_and_opened_again_by_on(iio):
    bench = on_bench(LinearSensor, {"device": "temp", "scale": 1.0}, n=1)
    bench.on()
    (iio / "in_temp0_raw").write_text("far too hot\n")
    with pytest.raises(MethodError, match="is no number"):
        bench.step()
    (iio / "in_temp0_raw").write_text("7\n")
    open_device("temp", mode=Mode.READ).close()  # its port is free
    bench.clear()
    bench.on()
    bench.step()
    assert bench.outputs.y == [7.0]
    with pytest.raises(MethodError, match="read when the task is created"):
        bench.set("device", "light")
    bench.set("scale", 2.0)
    bench.step()
    assert bench.outputs.y == [14.0]
    bench.kill()
    with pytest.raises(MethodError, match="a scale is 0"):
        on_bench(LinearSensor, {"device": "temp", "scale": 0.0}, n=1)


def test_the_twin_of_a_sensor_moves_in_the_steps_of_the_converter():
    told = {"scale": 0.5, "offset": 0.25, "mean": 2.0, "amplitude": 3.0, "period": 4.0}
    bench = on_bench(LinearSensorSim, told, n=2, freq=10)
    bench.on()
    found = []
    for _ in range(40):
        bench.step()
        found.append(bench.outputs.y.copy())
    wanted = 2.0 + 3.0 * np.sin(2.0 * math.pi * np.arange(1, 41) / 40)
    assert np.abs(np.array(found)[:, 0] - wanted).max() <= 0.25 + 1e-9
    assert not ((np.array(found) - 0.25) % 0.5).any()


# --------------------------------------------------------- linear_actuator, Modbus


def voltages(folder):
    return [int((folder / f"out_voltage{k}_raw").read_text()) for k in (0, 1)]


OUTLET = {"device": "dac", "scale": (0.01, -0.01), "offset": 10.0, "safe": (20.0, 5.0)}


def outlet(**more):
    told = {**OUTLET, **more}
    return on_bench(LinearActuator, told, u=[12.0, 3.0], critical=True)


@pytest.mark.parametrize("end", ["stale", "illegal", "off", "swap", "error", "kill"])
def test_an_actuator_gets_its_safe_values_whatever_ends(iio, end):
    bench = outlet()
    bench.on()
    bench.step()
    assert voltages(iio) == [200, 700]
    assert bench.outputs.y == pytest.approx([12.0, 3.0])
    bench.inputs.u = [1e9, 9.876]
    bench.step()
    assert voltages(iio) == [4095, 12]
    assert bench.outputs.y == pytest.approx([50.95, 9.88])
    if end == "stale":
        bench.ages["u"] = 0.2
        bench.step()
    elif end == "illegal":
        bench.illegal = True
        bench.step()
    elif end in {"off", "swap"}:  # a twin that takes over moves nothing
        bench.off(handover=end == "swap")
    elif end == "error":
        bench.inputs.u = [np.nan, 1.0]
        assert bench.step(check=False) is State.ERROR
        open_device("dac", mode=Mode.WRITE, safe=None).close()
    else:
        bench.kill()
    assert voltages(iio) == [1000, 500]
    if end != "kill":
        bench.kill()


@pytest.fixture
def named(iio):
    """The devices are those of a task; a program does not wait for a port."""
    entries = {name: database.entry(name) for name in ("temp", "dac")}
    with database.using(entries, "arm0/x"):
        yield iio


def test_actuators_of_one_device_take_each_others_place(named):
    """The device has its safe values until the next one has opened it."""
    old, new = outlet(), outlet(offset=11.0)
    (notice,) = new.notices()
    assert "it is opened when this task is turned on" in str(notice)
    assert "port 0: arm0/x" in str(notice)
    old.on()
    old.step()
    with pytest.raises(MethodError, match="a port of the device is taken"):
        new.on()
    new.clear()
    old.off(handover=True)
    assert voltages(named) == [1000, 500]
    new.on()
    new.step()
    assert voltages(named) == [100, 800]
    with pytest.raises(MethodError, match="a port of the device is taken"):
        old.on()
    old.clear()
    new.off()
    old.on()
    old.step()
    assert voltages(named) == [200, 700]
    for bench in (new, old):
        bench.kill()
    assert voltages(named) == [1000, 500]


def test_two_tasks_change_places_at_a_device_again_and_again(named):
    old, new = outlet(), outlet(offset=11.0)
    old.on()
    for going, coming, first in ((old, new, 100), (new, old, 200)) * 3:
        going.off(handover=True)
        coming.on()
        coming.step()
        assert voltages(named)[0] == first
    for bench in (old, new):
        bench.kill()


def test_a_successor_that_cannot_open_the_device_leaves_it_to_the_old_one(named):
    old, new = outlet(), outlet()
    old.on()
    old.off(handover=True)
    (named / "out_voltage1_raw").rename(named / "away")
    with pytest.raises(MethodError, match="the device has no such ports"):
        new.on()
    (named / "away").rename(named / "out_voltage1_raw")
    old.on()
    old.step()
    assert voltages(named) == [200, 700]
    new.clear()
    old.off(handover=True)  # for the new one still waits
    new.on()
    new.kill()
    old.kill()


def test_a_task_that_failed_takes_its_device_back_from_its_fallback(named):
    first, second = outlet(), outlet()
    first.on()
    first.inputs.u = [np.nan, 1.0]
    first.step(check=False)
    assert voltages(named) == [1000, 500]
    second.on()
    second.step()
    first.inputs.u = [12.0, 3.0]
    first.clear()
    second.off(handover=True)
    first.on()
    first.step()
    assert voltages(named) == [200, 700]
    for bench in (first, second):
        bench.kill()


def test_a_device_that_refuses_its_safe_values_keeps_its_task(named, monkeypatch):
    """So its guard has it as well; else it would have neither owner nor safe values."""
    old, new = outlet(), outlet()
    old.on()
    old.step()

    def refuses(_self, *, wait=True):
        raise DeviceError(f"it refuses, {wait}")

    with monkeypatch.context() as patch:
        patch.setattr(Device, "write_safe", refuses)
        with pytest.raises(MethodError, match="it refuses, True"):
            old.off(handover=True)
    assert old.state is State.ERROR
    assert voltages(named) == [200, 700]
    with pytest.raises(MethodError, match="a port of the device is taken"):
        new.on()
    old.kill()
    assert voltages(named) == [1000, 500]
    new.clear()
    new.on()
    new.kill()


def test_an_actuator_is_made_safe_where_nobody_can_say_who_waits(named, monkeypatch):
    def fails(*_):
        raise OSError(37, "No locks available")

    bench = outlet()
    bench.on()
    bench.step()
    monkeypatch.setattr(Claim, "is_wanted", fails)
    with pytest.raises(MethodError, match="No locks available"):
        bench.off()
    assert voltages(named) == [1000, 500]
    bench.kill()


@pytest.mark.parametrize("end", ["error", "kill"])
def test_a_sensor_is_another_tasks_when_the_first_one_fails_or_ends(named, end):
    told = {"device": "temp", "scale": 1.0, "signed": True}
    old, new = (on_bench(LinearSensor, told, n=1) for _ in range(2))
    old.on()
    if end == "error":
        (named / "in_temp0_raw").write_text("far too hot\n")
        old.step(check=False)
        (named / "in_temp0_raw").write_text("7\n")
    else:
        old.kill()
    new.on()
    new.step()
    assert new.outputs.y == [7.0 if end == "error" else -80.0]
    new.kill()


@pytest.mark.usefixtures("named")
def test_a_handover_of_a_device_is_replayed_without_it():
    def run():
        old, new = outlet(), outlet(offset=11.0)
        old.on()
        old.step()
        old.off(handover=True)
        new.on()
        new.step()
        values = new.outputs.y.tolist()
        for bench in (new, old):
            bench.kill()
        return values

    assert replayed(run) == pytest.approx([12.0, 3.0])


def test_relays_and_buttons_are_lines_of_a_chip(monkeypatch, tmp_path):
    """A relay begins with its safe value, also one that is closed then."""
    rig = Gpio(monkeypatch, tmp_path)
    chip = rig.chip
    told = {"device": "x", "scale": 1.0}
    with database.using({"x": rig.entry()}):
        safe = {**told, "safe": (1.0, 0.0), "signed": True}  # one bit has no sign
        relays = on_bench(LinearActuator, safe, u=[0.0, 1.0], critical=True)
        assert chip.values == {2: [1, 1], 3: [0, 0]}, "at the request, and after init"
        relays.on()
        relays.step()
        assert [chip.values[k][-1] for k in (2, 3)] == [0, 1]
        buttons = on_bench(LinearSensor, {**told, "port": 2}, n=2)
        chip.values[4] = [1]
        buttons.on()
        buttons.step()
        assert buttons.outputs.y.tolist() == [1.0, 0.0]
        relays.off()
        assert [chip.values[k][-1] for k in (2, 3)] == [1, 0]
        for bench in (relays, buttons):
            bench.kill()
    assert chip.requests == []


@pytest.mark.usefixtures("iio")
def test_a_safe_value_that_a_port_cannot_have_is_refused():
    with pytest.raises(
        MethodError, match=r"port 1: a safe value is beyond .* got -1500"
    ):
        outlet(safe=(20.0, 25.0))
    open_device("dac", 0, 1, mode=Mode.WRITE, safe=None).close()


def test_the_twin_of_an_actuator_follows_with_its_lag_and_rests_alike():
    told = {"scale": 0.1, "safe": 1.0, "bits": 8, "lag": 0.1}
    bench = on_bench(LinearActuatorSim, told, u=[20.0, 5.04], freq=1000)
    bench.on()
    bench.step(n=100)
    assert bench.outputs.y == pytest.approx([20.0 * 0.632, 5.0 * 0.632], rel=0.01)
    bench.step(n=2000)
    assert bench.outputs.y == pytest.approx([20.0, 5.0])
    bench.inputs.u = [99.0, -3.0]
    bench.step(n=2000)
    assert bench.outputs.y == pytest.approx([25.5, 0.0], abs=1e-6)
    bench.off()
    assert bench.outputs.y.tolist() == [1.0, 1.0]


class Block(threading.Thread):
    """A Modbus I/O block with eight inputs and eight relays, over TCP."""

    def __init__(self):
        super().__init__(daemon=True)
        self.server = socket.create_server(("127.0.0.1", 0))
        self.inputs, self.relays, self.writes = 0b1010_0110, 0, 0
        self.answers = True
        self.start()

    def run(self):
        while True:
            try:
                line, _ = self.server.accept()
            except OSError:
                return
            threading.Thread(target=self.serve, args=(line,), daemon=True).start()

    def serve(self, line):
        with line, line.makefile("rwb") as file:
            while head := file.read(7):
                number, _, size, unit = struct.unpack(">HHHB", head)
                answer = self.answer(file.read(size - 1))
                file.write(struct.pack(">HHHB", number, 0, len(answer) + 1, unit))
                file.write(answer)
                if self.answers:
                    file.flush()

    def answer(self, asked):
        code, first, count = struct.unpack_from(">BHH", asked)
        mask = (1 << count) - 1
        if code == 2:
            return bytes((2, 1, self.inputs >> first & mask))
        if code == 5:
            count, mask, values = 1, 1, count >> 8 & 1
        else:
            assert code == 15
            values = asked[6]
        self.relays &= ~(mask << first)
        self.relays |= values << first
        self.writes += 1
        return asked[:5]


@pytest.fixture
def block():
    made = Block()
    address = f"127.0.0.1:{made.server.getsockname()[1]}"
    entries = {
        table: Entry(
            driver="modbus", address=address, settings={"table": table, "timeout": 0.3}
        )
        for table in ("discrete", "coils")
    }
    with database.using(entries):
        yield made
    made.server.close()


def test_a_modbus_block_gives_its_inputs_and_gets_older_until_it_is_silent(block):
    told = {"device": "discrete", "port": 1, "scale": 1.0, "wait": "none"}
    bench = on_bench(LinearSensor, {**told, "silent": 0.5}, n=3, freq=100)
    bench.on()
    assert bench.output_age > 0.9, "nothing was measured yet"

    def reads(wanted):
        bench.step()
        return bench.outputs.y.tolist() == wanted

    wait_for(lambda: reads([1.0, 1.0, 0.0]), "the inputs")
    assert bench.output_age < 0.1
    block.inputs = 0b1000
    wait_for(lambda: reads([0.0, 0.0, 1.0]), "other inputs")
    block.answers = False

    def fails():
        return bench.step(check=False) is State.ERROR

    wait_for(fails, "an error")
    bench.kill()


def test_relays_of_a_modbus_block_rest_when_the_task_is_off(block):
    told = {"device": "coils", "port": 2, "scale": 1.0, "safe": (0.0, 1.0)}
    told["wait"] = "none"
    bench = on_bench(LinearActuator, told, u=[1.0, 0.0])
    for _ in range(2):
        bench.on()

        def switched():
            bench.step()
            return block.relays == 0b0100

        wait_for(switched, "the relays")
        bench.off()
        assert block.relays == 0b1000
        assert bench.outputs.y.tolist() == [0.0, 1.0]
    bench.kill()


# ------------------------------------------------------------------------ encoder

COUNTER = {"device": "counter", "counts": 400, "bits": 8}
STEP = 2.0 * math.pi / 400


@pytest.fixture
def counter(tmp_path):
    """A counter of 8 bits and an index input; a function that sets them."""
    settings = {"channels": ["count0", "index0"], "bits": 16}
    entry = Entry(driver="iio_adc", address=str(tmp_path), settings=settings)

    def show(count, index=0):
        (tmp_path / "in_count0_raw").write_text(f"{count % 256}\n")
        (tmp_path / "in_index0_raw").write_text(f"{index}\n")

    show(0)
    with database.using({"counter": entry}):
        yield show


def test_an_encoder_follows_a_counter_that_wraps_in_both_directions(counter):
    bench = on_bench(Encoder, {**COUNTER, "gear": 2.0, "zero": 0.5}, n=1)
    counter(-56)
    bench.on()
    places = [-56, -120, -200, -256, -300, -180, -60, 60, 180, 300]
    for before, place in zip([-56, *places], places, strict=False):
        counter(place)
        bench.step(0.01)
        assert bench["Q_MEZ"][0] == pytest.approx(0.5 + place * STEP / 2.0)
        assert bench["Q^_MEZ"][0] == pytest.approx((place - before) * STEP / 2.0 / 0.01)
    bench.off()
    counter(310)
    bench.on()
    bench.step()
    assert bench["Q_MEZ"][0] == pytest.approx(0.5 + 310 * STEP / 2.0)
    bench.kill()


def test_the_index_is_the_zero_of_an_encoder_that_runs_backwards(counter):
    told = {**COUNTER, "counts": -400, "zero": 1.0, "index": 1, "lag": 0.02}
    bench = on_bench(Encoder, told, n=1)
    counter(50, 1)  # it stands in the index: where in it nobody knows
    bench.on()
    bench.step()
    assert (bench["HOMED"][0], bench["Q_MEZ"][0]) == (0.0, 1.0 - 50 * STEP)
    for count, index in ((60, 0), (90, 1), (95, 1), (100, 0)):
        counter(count, index)
        bench.step(0.01)
    assert bench["HOMED"][0] == 1.0
    assert bench["Q_MEZ"][0] == pytest.approx(1.0 - 10 * STEP)
    assert -1000 * STEP < bench["Q^_MEZ"][0] < -500 * STEP
    with pytest.raises(DeviceError, match="a port of the device is taken"):
        open_device("counter", 1, mode=Mode.READ)
    bench.kill()
    open_device("counter", 0, 1, mode=Mode.READ).close()
    with pytest.raises(MethodError, match="0 counts"):
        on_bench(Encoder, {**COUNTER, "counts": 0}, n=1)


def test_the_twin_of_an_encoder_moves_in_counts_and_passes_its_index():
    told = {"counts": 400, "gear": 3.0, "bits": 8, "amplitude": 4.0, "period": 2.0}
    bench = on_bench(EncoderSim, told, n=1, freq=500)
    bench.on()
    for k in range(1, 1001):
        bench.step()
        wanted = 4.0 * math.sin(2.0 * math.pi * k / 1000)
        turns = (bench["Q_MEZ"][0] - wanted) * 3.0 / (2.0 * math.pi)
        assert abs(turns - round(turns)) < 0.1, "to its motion since the index"
    assert bench["HOMED"][0] == 1.0


# ------------------------------------------------------------------------ mpu6050


class Chip:
    """An MPU-6050 behind smbus2: registers by number, which a transfer counts on."""

    def __init__(self):
        self.registers = {0x75: 0x68, 0x6B: 0x40}
        self.measure((0.0, 0.0, G), (0.0, 0.0, 0.0), 4, 500)
        self.fd, self.lost = 0, False

    def measure(self, acc, gyr, acc_range, gyro_range):
        words = [round(one / (acc_range * G) * 32768) for one in acc]
        words += [0, *(round(math.degrees(one) / gyro_range * 32768) for one in gyr)]
        data = b"\1" + struct.pack(">7h", *words)
        self.registers.update(zip(range(0x3A, 0x49), data, strict=True))

    def open(self, _path):
        pass

    def close(self):
        pass

    def read_byte_data(self, _address, register):
        return self.registers[register]

    def write_byte_data(self, _address, register, value):
        self.registers[register] = value

    def read_i2c_block_data(self, _address, first, count):
        if self.lost:
            raise OSError(121, "Remote I/O error")
        found = [self.registers[register] for register in range(first, first + count)]
        if first == 0x3A:
            self.registers[0x3A] = 0
        return found


@pytest.fixture
def chip(monkeypatch):
    made = Chip()
    monkeypatch.setattr(smbus2, "SMBus", lambda: made)
    monkeypatch.setattr(i2c_driver, "ioctl", lambda *_: 0)
    registers = [0x75, 0x6B, 0x19, 0x1A, 0x1B, 0x1C, *range(0x3A, 0x49)]
    settings = {"registers": registers, "burst": True}
    entry = Entry(driver="i2c", address="/dev/i2c-1:0x68", settings=settings)
    with database.using({"imu": entry}):
        yield made


def test_an_imu_is_set_up_read_in_one_transfer_and_replayed(chip):
    told = {"device": "imu", "gyro_bias": (0.1, 0.0, 0.0), "acc_bias": (0.0, 0.2, 0.0)}

    def run():
        bench = on_bench(Mpu6050, {**told, "filter": "94"}, freq=200)
        bench.on()
        chip.measure((1.0, -2.0, 9.0), (0.5, -1.5, 8.0), 4, 500)
        bench.step()
        found = bench.outputs.acc.tolist(), bench.outputs.gyr.tolist()
        bench.kill()
        return found

    acc, gyr = replayed(run)
    setup = [chip.registers[one] for one in (0x6B, 0x19, 0x1A, 0x1B, 0x1C)]
    assert setup == [1, 4, 2, 1 << 3, 1 << 3]
    assert acc == pytest.approx([1.0, -2.2, 9.0], abs=1e-3)
    assert gyr == pytest.approx([0.4, -1.5, 8.0], abs=3e-4)


def test_an_imu_without_new_values_gets_older_and_ends_in_error(chip):
    bench = on_bench(Mpu6050, {"device": "imu", "silent": 0.05}, freq=100)
    bench.on()
    bench.step()
    assert bench.output_age == 0.0
    chip.registers[0x3F] = 0  # which the chip is about to write
    bench.step(n=4)
    assert bench.output_age == pytest.approx(0.04)
    assert bench.outputs.acc[2] == pytest.approx(G, abs=1e-3)
    with pytest.raises(MethodError, match="has sent nothing for"):
        bench.step(n=3)
    chip.registers[0x3A] = 1
    bench.clear()
    bench.on()
    bench.step()
    chip.lost = True
    with pytest.raises(MethodError, match="the device is gone"):
        bench.step()
    chip.lost, chip.registers[0x75] = False, 0x70
    bench.clear()
    with pytest.raises(MethodError, match="the chip is no MPU-6050"):
        bench.on()
    bench.kill()


def test_the_twin_of_an_imu_stands_upright_and_turns():
    told = {"gyro_bias": (0.1, 0.0, 0.0), "amplitude": (0.0, 0.0, 0.5), "period": 4.0}
    bench = on_bench(Mpu6050Sim, told, freq=100)
    bench.on()
    bench.step(n=100)
    assert bench.outputs.acc == pytest.approx([0.0, 0.0, G], abs=1e-3)
    assert bench.outputs.gyr == pytest.approx([0.0, 0.0, 0.5], abs=3e-4)


# -------------------------------------------------------------------------- ft300


def checksum(data):
    """CRC-16/MODBUS by polynomial division: bit by bit, as its definition has it."""
    value = 0xFFFF
    for bit in (byte >> k & 1 for byte in data for k in range(8)):
        value, out = value >> 1, value & 1
        value ^= 0xA001 * (out ^ bit)
    return struct.pack("<H", value)


def frame(*wrench):
    body = b"\x20\x4e" + struct.pack("<6h", *wrench)
    return body + checksum(body)


@pytest.fixture
def line():
    """The sensor's end of a line."""
    master, slave = os.openpty()
    tty.setraw(master)
    entry = Entry(driver="serial", address=os.ttyname(slave), settings={"baud": 19200})
    with database.using({"force": entry}):
        yield master
    os.close(master)
    os.close(slave)


def ft300():
    return on_bench(Ft300, {"device": "force"}, freq=110, handler=30)


def cycled(bench):
    bench.sync()
    bench.step()
    return np.round(bench.outputs.f, 6).tolist()


ONE, TWO = (-1234, 5, 30000, -7, 8, -32768), (1, 2, 3, 4, 5, 6)
WRENCH_ONE = [-12.34, 0.05, 300.0, -0.007, 0.008, -32.768]
WRENCH_TWO = [0.01, 0.02, 0.03, 0.004, 0.005, 0.006]


def test_a_force_sensor_is_started_timed_by_its_frames_and_stopped(line):
    assert checksum(b"123456789") == struct.pack("<H", 0x4B37)

    said = b""

    def run():
        nonlocal said
        bench = ft300()
        real = not bench.module._device.outside.plays
        bench.on()
        found = []
        for one in (ONE, TWO):
            if real:
                os.write(line, frame(*one))
            found.append(cycled(bench))
        bench.off()
        while real and len(said.lstrip(b"\xff")) < 11 + 50:
            said += os.read(line, 4096)
        bench.kill()
        return found

    assert replayed(run) == [WRENCH_ONE, WRENCH_TWO]
    said = said.lstrip(b"\xff")  # a task that is not ON has ended the stream before
    assert said[:9] == b"\x09\x10\x01\x9a\x00\x01\x02\x02\x00"
    assert checksum(said[:9]) == said[9:11]
    assert said[11:] == b"\xff" * 50


@pytest.mark.parametrize(
    "before",
    [
        frame(*TWO)[5:],
        frame(*TWO)[:9],
        b"\x20",
        b"\x20\x4e",
        b"\x20\x20\x4e\x20\x4e",
        bytes(range(256)) * 2,
        frame(*TWO)[:-1] + b"\0",
        frame(*TWO)[:8] + b"\x20\x4e" + frame(*TWO)[10:],
    ],
)
def test_a_force_sensor_finds_its_frames_again_behind_damage(line, before):
    bench = ft300()
    bench.on()
    data = before + frame(*ONE)
    for k in range(0, len(data), 7):
        os.write(line, data[k : k + 7])
    assert cycled(bench) == WRENCH_ONE
    bench.kill()


@pytest.mark.parametrize("piece", [1, 7, 15, 16, 17])
def test_frames_are_found_in_whatever_pieces_they_come(piece):
    frames = Frames()
    data = b"\x20" + frame(*ONE) + frame(*TWO)[3:] + frame(*TWO) + b"\x20\x4e\1"
    found = [frames.newest(data[k : k + piece]) for k in range(0, len(data), piece)]
    assert [one for one in found if one] == [ONE, TWO]
    assert frames.damaged == 1 + 13


def test_frames_are_found_behind_garbage():
    frames = Frames()
    many = random.Random(1).randbytes(100_000)
    for k in range(0, len(many), 500):
        assert frames.newest(many[k : k + 500]) is None
    assert frames.newest(frame(*ONE)) in {None, ONE}, "the end may be half a frame"
    assert frames.newest(frame(*TWO)) == TWO


def test_of_a_force_sensor_that_is_faster_the_newest_frame_counts(line):
    bench = ft300()
    bench.on()
    os.write(line, frame(*TWO) * 20 + frame(*ONE))
    assert cycled(bench) == WRENCH_ONE
    # More than a task that was held takes at once is too old.
    os.write(line, frame(*TWO) * (MOST // 16) + frame(*ONE))
    assert cycled(bench) == WRENCH_ONE
    os.write(line, frame(*TWO))
    assert cycled(bench) == WRENCH_TWO
    bench.kill()


def test_a_silent_force_sensor_ends_in_error_after_its_time(line):
    bench = ft300()
    bench.on()
    os.write(line, frame(*ONE))
    cycled(bench)
    bench.module._waits = True  # as in `sync`, which a real failure interrupts
    for _ in range(5):
        bench.timing_failure(TimingFailure.DEADLINE)
    assert bench.state is State.ON
    with pytest.raises(MethodError, match="has sent no frame for"):
        bench.timing_failure(TimingFailure.DEADLINE)
    assert bench.state is State.ERROR
    bench.clear()
    bench.on()
    os.write(line, frame(*TWO))
    assert cycled(bench) == WRENCH_TWO
    bench.kill()


def test_the_twin_of_a_force_sensor_bears_its_load_in_steps():
    bench = on_bench(Ft300Sim, {"mean": (1.004, 0, 0, 0.0016, 0, 0)})
    bench.on()
    bench.step()
    assert bench.outputs.f == pytest.approx([1.0, 0, 0, 0.002, 0, 0])
