"""MAVLink in one process: both ends on benches, or bytes as they come.

Datagrams on the loopback are there when the call that sends them returns, so a step of
one end is seen by the next step of the other, in virtual time.
"""

from __future__ import annotations

import os
import random
import socket
import tty
from collections.abc import Iterator
from math import cos, inf, nan, pi, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

import pbonet.modules
from pbonet import State
from pbonet.errors import DeviceError, MethodError, ParameterError
from pbonet.io import MavLink, PeerClock, no_devices
from pbonet.io.mavlink_channels import parse_address
from pbonet.io.mavlink_frames import Frame
from pbonet.io.mavlink_messages import Unpacker
from pbonet.io.mavlink_signing import time_stamp
from pbonet.modules.robot_interfaces.mav_vehicle import MavVehicle
from pbonet.modules.subsystem_interfaces.mav_ground import MavGround
from pbonet.modules.subsystem_interfaces.mav_setpoint_att import MavSetpointAtt
from pbonet.modules.subsystem_interfaces.mav_setpoint_pos import MavSetpointPos
from pbonet.modules.subsystem_interfaces.mav_setpoint_vel import MavSetpointVel
from pbonet.modules.teleoperation.mav_command import MavCommand
from pbonet.outside import Player, Tape, use
from pbonet.testing import Bench, FakeClock

MODULES = Path(pbonet.modules.__file__).parent
STEP = 0.01
SPOT = [84.0, 0xDF8, 1.0, 2.0, -3.0, *[0.0] * 8]
OFFBOARD = 6 << 16
MS = 1_000_000


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


WIRES: list[Any] = []


@pytest.fixture(autouse=True)
def _sockets_are_closed() -> Iterator[None]:
    yield
    while WIRES:
        WIRES.pop().socket.close()


class Wire:
    """A socket of the test, and frames that it packs."""

    def __init__(self, system: int = 1, component: int = 1) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(0.0)
        self.socket.bind(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]
        self.mav: Any = common.MAVLink(None, system, component)
        self.mav.robust_parsing = True
        self.peer: Any = None
        WIRES.append(self)

    def pack(self, message: Any) -> bytes:
        data = bytes(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256
        return data

    def send(self, *messages: Any, to: int = 0) -> None:
        for one in messages:
            data = one if isinstance(one, bytes) else self.pack(one)
            self.socket.sendto(data, ("127.0.0.1", to) if to else self.peer)

    def receive(self) -> list[Any]:
        found: list[Any] = []
        while True:
            try:
                data, self.peer = self.socket.recvfrom(4096)
            except BlockingIOError:
                return found
            found += self.mav.parse_buffer(data) or []

    def names(self) -> list[str]:
        return [one.get_type() for one in self.receive()]

    def beat(self, **more: int) -> Any:
        told = {"type": 2, "autopilot": 12, "base_mode": 1, "custom_mode": 0, **more}
        return self.mav.heartbeat_encode(**told, system_status=3)


@pytest.fixture
def wire() -> Wire:
    return Wire()


def vehicle(port: int, clock: FakeClock | None = None, **params: Any) -> Any:
    told = {"address": f"udpout:127.0.0.1:{port}", "wait": 0.0, **params}
    made = Bench(MavVehicle, params=told, critical=True, clock=clock)
    made.on()
    return made


def ground(port: int, clock: FakeClock | None = None, **params: Any) -> Any:
    told = {
        "address": f"udpin:127.0.0.1:{port}",
        "params": ("SPEED=3", "GAIN=0.5"),
        **params,
    }
    values = {"nparam": 2, "att": [1.0, 0, 0, 0], "lla": [0.8, 0.15, 400.0]}
    made = Bench(MavGround, values, params=told, clock=clock)
    made.on()
    return made


class Pair:
    """A vehicle and its station, and time for both."""

    def __init__(self, **params: Any) -> None:
        port, self.clock = free_port(), FakeClock()
        self.air = ground(port, self.clock, **params)
        self.base = vehicle(port, self.clock)

    def run(self, seconds: float, *, follows: bool = True) -> None:
        for _ in range(round(seconds / STEP)):
            self.base.step(STEP / 2)
            self.air.step(STEP / 2)
            if follows:
                self.air.inputs.armed = self.air.outputs.arm
                self.air.inputs.in_mode = self.air.outputs.mode


@pytest.fixture
def pair() -> Iterator[Pair]:
    made = Pair()
    yield made
    for one in (made.air, made.base):
        if one.state is not State.NOT_CREATED:
            one.kill()


def texts(bench: Any) -> list[str]:
    return [one.text for one in bench.notices() if one.text]


# -- both ends ------------------------------------------------------------------------


def test_telemetry_arrives_in_si_units_and_is_as_old_as_it_is(pair: Pair) -> None:
    air, base = pair.air, pair.base
    half = np.sqrt(0.5)
    air.inputs.att = [half, 0, 0, half]
    air.inputs.rates = [0.1, -0.2, 0.3]
    air.inputs.x, air.inputs.v = [1.5, -2.5, -10.25], [0.5, 0.25, -1.0]
    air.inputs.lla = [radians(47.3977418), radians(-8.5455939), 488.125]
    air.inputs.battery, air.inputs.fix = 15.25, 3
    pair.run(2.5)
    out = base.outputs
    assert out.att == pytest.approx([half, 0, 0, half], abs=1e-6)
    assert out.rates == pytest.approx([0.1, -0.2, 0.3])
    assert out.x == pytest.approx([1.5, -2.5, -10.25])
    assert out.v == pytest.approx([0.5, 0.25, -1.0])
    assert out.lla == pytest.approx([*np.radians([47.3977418, -8.5455939]), 488.125])
    assert (out.battery, out.fix, out.armed, out.mav_sys) == (15.25, 3, 0, 1)
    assert out.age <= 1.0 + STEP
    assert 0.0 < base.output_age <= 0.05 + 2 * STEP, "20 Hz, and what the way takes"


def test_the_age_is_that_of_the_oldest_measurement_that_has_come(wire: Wire) -> None:
    base = vehicle(wire.port)
    base.step(STEP)
    wire.receive()
    attitude = wire.mav.attitude_quaternion_encode(0, 1, 0, 0, 0, 0, 0, 0)
    position = wire.mav.local_position_ned_encode(0, 1, 2, 3, 0, 0, 0)
    place = wire.mav.global_position_int_encode(0, 5 * 10**8, 10**8, 0, 0, 0, 0, 0, 0)

    def age(*messages: Any, steps: int = 1) -> float:
        for _ in range(steps):
            wire.send(wire.beat(), *messages)
            base.step(STEP)
        return float(base.output_age)

    assert age(attitude) > 1.0, "X_MEZ was never measured"
    assert age(position) == pytest.approx(STEP, abs=1e-6)
    assert age(attitude, steps=30) == pytest.approx(30 * STEP, abs=1e-6)
    assert age(attitude, position) == pytest.approx(0.0, abs=1e-6)
    assert age(attitude, position, place) == pytest.approx(0.0, abs=1e-6)
    assert age(attitude, position, steps=50) == pytest.approx(50 * STEP, abs=1e-6)
    base.off()
    base.on()
    assert age(attitude) > 1.0, "the position is that of the time before `off`"
    assert age(attitude, position) > 1.0, "LLA_MEZ is"
    assert age(place) == pytest.approx(STEP, abs=1e-6)
    base.kill()


def test_time_stamps_are_of_the_vehicles_own_clock(wire: Wire) -> None:
    base = vehicle(wire.port)
    base.step(STEP)
    asked = next(m for m in wire.receive() if m.get_type() == "TIMESYNC")
    wire.send(wire.mav.timesync_encode(5_000 * MS, asked.ts1))
    base.step(STEP)
    wire.send(
        wire.beat(),
        wire.mav.attitude_quaternion_encode(4_950, 1, 0, 0, 0, 0, 0, 0),
        wire.mav.local_position_ned_encode(4_950, 1, 2, 3, 0, 0, 0),
    )
    base.step(STEP)
    assert base.output_age == pytest.approx(0.05 + 2 * STEP, abs=1e-6)
    base.kill()


def test_set_points_and_changes_of_commands_go_out(pair: Pair) -> None:
    air, base = pair.air, pair.base
    base.inputs.setpoint = SPOT
    pair.run(2.0)
    assert air.outputs.setpoint == pytest.approx(SPOT)
    assert air.output_age <= 0.05 + STEP
    assert (air.outputs.arm, air.outputs.mode) == (0, 0), "as they were at `on`"
    base.inputs.arm = 1
    base.inputs.mode = OFFBOARD | 3 << 24
    pair.run(0.1)
    assert (air.outputs.arm, air.outputs.mode) == (1, OFFBOARD | 3 << 24)
    pair.run(1.0)
    assert (base.outputs.armed, base.outputs.in_mode) == (1, OFFBOARD | 3 << 24)
    assert texts(base) == []


def test_attitude_set_points_keep_their_mask(pair: Pair) -> None:
    pair.base.inputs.setpoint = [82, 7, 1, 0, 0, 0, 9, 9, 9, 0.5, 0, 0, 0]
    pair.run(1.5)
    got = pair.air.outputs.setpoint
    assert got == pytest.approx([82, 7, 1, 0, 0, 0, 0, 0, 0, 0.5, 0, 0, 0])


@pytest.mark.parametrize(
    ("sender", "system", "component", "ends"),
    [
        (1, 255, 190, True),
        (1, 0, 0, True),
        (1, 254, 190, False),
        (1, 255, 191, False),
        (100, 255, 190, False),
    ],
)
def test_only_answers_to_us_of_the_autopilot_end_a_command(
    wire: Wire, sender: int, system: int, component: int, ends: bool
) -> None:
    base = vehicle(wire.port)
    base.step(STEP)
    wire.receive()
    wire.send(wire.beat())
    base.step(STEP)
    base.inputs.arm = 1
    base.step(STEP, 2)
    wire.receive()
    ack = wire.mav.command_ack_encode(400, 0, 0, 0, system, component)
    wire.send(Wire(1, sender).pack(ack))
    base.step(STEP)
    base.step(0.6)
    asked = [m for m in wire.receive() if getattr(m, "command", 0) == 400]
    assert bool(asked) != ends
    base.kill()


def test_a_flood_of_empty_datagrams_hides_nothing(wire: Wire) -> None:
    base = vehicle(wire.port)
    base.step(STEP)
    wire.receive()
    wire.send(*[b""] * 50, wire.beat(custom_mode=4))
    base.step(STEP)
    assert base.outputs.in_mode == 4
    base.kill()


def test_what_the_vehicle_does_not_follow_is_refused_and_said(pair: Pair) -> None:
    pair.run(1.5)
    pair.base.inputs.arm = 1
    pair.run(2.0, follows=False)
    assert any("command 400 was refused: result 2" in one for one in texts(pair.base))
    assert texts(pair.air) == ["command 400 was not followed"]


# -- loss -----------------------------------------------------------------------------


def test_a_lost_vehicle_gets_no_set_point_until_the_task_is_turned_on_again(
    wire: Wire,
) -> None:
    base = vehicle(wire.port)
    base.inputs.setpoint = SPOT
    base.step(STEP)
    assert "SET_POSITION_TARGET_LOCAL_NED" not in wire.names(), "nobody is there yet"
    for _ in range(150):
        wire.send(wire.beat())
        base.step(STEP)
    sent = wire.names().count("SET_POSITION_TARGET_LOCAL_NED")
    assert sent == pytest.approx(1.5 * 20.0, abs=1)
    cycles = 0
    while not base.illegal:
        wire.receive()
        base.step(STEP)
        cycles += 1
    assert cycles * STEP <= 2.5 + 2 * STEP
    assert any("vehicle 1: no heartbeat for 2.51 s" in one for one in texts(base))
    base.inputs.arm, base.inputs.mode = 1, OFFBOARD
    for k in range(300):
        if k > 100:
            wire.send(wire.beat())  # it is back
        base.illegal = k % 2 == 0  # and whether or not others clear the flag
        base.step(STEP)
    assert base.outputs.age < 0.05
    assert set(wire.names()) == {"HEARTBEAT", "TIMESYNC", "COMMAND_LONG"}
    base.off()
    base.illegal = False
    base.on()
    for _ in range(50):
        wire.send(wire.beat())
        base.step(STEP)
    after = wire.receive()
    assert "SET_POSITION_TARGET_LOCAL_NED" in {one.get_type() for one in after}
    commands = {m.command for m in after if m.get_type() == "COMMAND_LONG"}
    assert commands <= {511}, "arming is asked for again only when it changes again"
    base.kill()


@pytest.mark.parametrize("flag", [False, True])
def test_a_change_while_no_vehicle_is_there_is_never_sent(
    wire: Wire, flag: bool
) -> None:
    base = vehicle(wire.port)
    base.illegal = flag  # the same in `stable`
    base.step(STEP)
    base.inputs.arm, base.inputs.mode = 1, OFFBOARD
    base.step(STEP, 2)
    said = [one for one in texts(base) if "is not there" in one]
    assert len(said) == 2, "ARM_CMD and MODE_CMD, each once"
    base.step(600.0)
    for _ in range(50):
        wire.receive()
        wire.send(wire.beat())
        base.step(STEP)
        asked = [m for m in wire.receive() if m.get_type() == "COMMAND_LONG"]
        assert {m.command for m in asked} <= {511}
    base.inputs.arm = 0
    base.step(STEP, 2)
    assert 400 in {getattr(m, "command", 0) for m in wire.receive()}
    base.kill()


def test_old_set_points_are_not_sent_and_others_not_while_the_flag_is_up(
    wire: Wire,
) -> None:
    base = vehicle(wire.port)
    base.inputs.setpoint = SPOT
    base.ages["setpoint"] = 0.6
    for k in range(200):
        if k == 100:
            base.ages["setpoint"] = 0.0
        base.illegal = k >= 100
        base.step(STEP)
        wire.receive() if k == 0 else None
        wire.send(wire.beat())
    assert "SET_POSITION_TARGET_LOCAL_NED" not in wire.names()
    assert base.outputs.age < 0.05, "telemetry goes on"
    base.illegal = False
    base.step(STEP, 5)
    assert "SET_POSITION_TARGET_LOCAL_NED" in wire.names()
    base.kill()


def test_turning_it_off_and_losing_the_vehicle_disarm_nothing(pair: Pair) -> None:
    pair.base.inputs.arm = 0
    pair.run(1.5)
    pair.base.inputs.arm = 1
    pair.run(1.5)
    pair.base.off()
    for _ in range(400):
        pair.air.step(STEP)
    assert pair.air.outputs.arm == 1
    pair.base.on()
    pair.run(3.0)
    assert pair.air.outputs.arm == 1


@pytest.mark.parametrize(
    ("lost", "mode"), [("hold", 50593792), ("land", 100925440), ("continue", OFFBOARD)]
)
def test_a_vehicle_whose_stations_are_lost_does_what_was_declared(
    lost: str, mode: int
) -> None:
    pair = Pair(lost=lost)
    pair.run(1.2)
    pair.base.inputs.arm, pair.base.inputs.mode = 1, OFFBOARD
    pair.base.inputs.setpoint = SPOT
    pair.run(1.0)
    assert pair.air.outputs.setpoint[0] == 84
    pair.base.off()
    for _ in range(400):
        pair.air.step(STEP)
    assert pair.air.outputs.setpoint[0] == 0
    assert pair.air.outputs.mode == mode
    said = texts(pair.air)
    assert "no set-point for 0.5 s: the vehicle holds" in said
    assert any(f"s: {lost}" in one for one in said if one.startswith("no station"))
    pair.air.kill()
    pair.base.kill()


# -- what comes over the wire ---------------------------------------------------------


def test_noise_is_counted_and_nothing_else(wire: Wire) -> None:
    base = vehicle(wire.port)
    base.step(STEP)
    wire.receive()
    noise = random.Random(7)
    whole = wire.pack(wire.beat())
    for _ in range(1000):
        junk = bytearray(noise.randbytes(1000))
        for at in range(0, 1000, 97):  # so that many look like the beginning of one
            junk[at] = noise.choice((0xFD, 0xFE))
        if noise.random() < 0.5:
            junk[100 : 100 + len(whole)] = whole
            junk[100 + noise.randrange(len(whole))] ^= 1 + noise.randrange(255)
        wire.send(bytes(junk))
        base.step(STEP)
    assert base.state is State.ON
    assert base.outputs.bad[0] >= 1000
    assert base.outputs.bad[1:].tolist() == [0, 0]
    wire.send(wire.beat(custom_mode=77))
    base.step(STEP)
    assert base.outputs.in_mode == 77
    base.kill()


def test_every_kind_of_message_with_odd_values_is_survived(wire: Wire) -> None:
    """Valid frames of all kinds: to the vehicle's side as from a station, and back."""
    air = ground(wire.port + 1 if wire.port < 65535 else wire.port - 1)
    port = int(air.module.params.address.rpartition(":")[2])
    base = vehicle(wire.port)
    base.step(STEP)
    wire.receive()
    chance = random.Random(3)
    station = Wire(255, 190)
    for kind in common.mavlink_map.values():
        for fill in (0x00, 0x7F, 0xFF, None):
            size = kind.unpacker.size
            body = bytes([fill]) * size if fill is not None else chance.randbytes(size)
            for one, to in ((wire, 0), (station, port)):
                message = common.MAVLink_message(kind.id, kind.msgname)
                data = message._pack(one.mav, kind.crc_extra, body)
                one.send(bytes(data), to=to)
        base.step(STEP)
        air.step(STEP)
    assert base.state is air.state is State.ON
    for one in (base, air):
        one.kill()


def test_messages_are_unpacked_as_pymavlink_does() -> None:
    chance, theirs = random.Random(3), common.MAVLink(None)
    one, unpacker = Wire(7, 9), Unpacker(common.mavlink_map)
    compared = 0
    for number, kind in common.mavlink_map.items():
        for old in (False, True):
            payload = chance.randbytes(kind.unpacker.size)
            message = kind.__new__(kind)
            common.MAVLink_message.__init__(message, number, kind.msgname)
            data = message._pack(one.mav, kind.crc_extra, payload, old and number < 256)
            wanted = theirs.decode(bytearray(data))
            got = unpacker.unpack(Frame(number, 7, 9, data))
            assert (got.get_type(), got.get_srcSystem()) == (kind.msgname, 7)
            for name in kind.fieldnames:  # as text, as NaN is no NaN
                assert repr(getattr(got, name)) == repr(getattr(wanted, name)), name
            compared += 1
    assert compared > 300
    with pytest.raises(AttributeError, match="has no field colour"):
        _ = unpacker.unpack(Frame(0, 7, 9, one.pack(one.beat()))).colour


def test_other_systems_are_ignored_counted_and_named(wire: Wire) -> None:
    base = vehicle(wire.port)
    base.step(STEP)
    wire.receive()
    stranger = Wire(7)
    stranger.peer = wire.peer
    wire.send(wire.beat(custom_mode=5))
    frame = stranger.pack(stranger.beat(custom_mode=9))
    for _ in range(3):
        wire.send(frame)  # the same address, another id
        base.step(STEP)
    assert base.outputs.in_mode == 5
    assert base.outputs.bad.tolist() == [0, 0, 3]
    assert [one for one in texts(base) if "system 7" in one] == [
        f"system 7 on {base.module.params.address} is ignored: only system 1 counts "
        "here"
    ]
    base.kill()


def test_a_station_that_is_no_peer_hears_nothing() -> None:
    port = free_port()
    air = ground(port, FakeClock())
    stranger = Wire(1)  # our own id
    stranger.send(stranger.beat(type=6), to=port)
    air.step(STEP, 10)
    assert stranger.names() == []
    station = Wire(255)
    station.send(station.beat(type=6), to=port)
    air.step(STEP, 10)
    assert "ATTITUDE_QUATERNION" in station.names()
    assert stranger.names() == []
    assert any("system 1 on" in one for one in texts(air))
    air.kill()


def test_stations_choose_messages_and_their_rates() -> None:
    port = free_port()
    air, station = ground(port), Wire(255, 190)
    station.send(station.beat(type=6), to=port)
    air.step(STEP)

    def ask(command: int, *values: float) -> list[Any]:
        filled = [*values, *[0.0] * (7 - len(values))]
        station.send(
            station.mav.command_long_encode(1, 1, command, 0, *filled), to=port
        )
        station.receive()
        air.step(STEP)
        return [(m.command, m.result) for m in station.receive()
                if m.get_type() == "COMMAND_ACK"]  # fmt: skip

    assert ask(511, 32, 10_000) == [(511, 0)]
    air.step(STEP, 100)
    names = station.names()
    assert names.count("LOCAL_POSITION_NED") == pytest.approx(100, abs=2)
    assert names.count("ATTITUDE_QUATERNION") == pytest.approx(20, abs=1)
    assert ask(511, 32, -1) == [(511, 0)]
    air.step(STEP, 100)
    assert "LOCAL_POSITION_NED" not in station.names()
    assert ask(511, 0, -1) == [(511, 2)], "heartbeats stay"
    assert ask(511, 12345, 1000) == [(511, 3)]
    assert ask(9999) == [(9999, 3)]
    station.send(
        station.mav.command_long_encode(1, 1, 512, 0, 148, *[0.0] * 6), to=port
    )
    air.step(STEP)
    assert "AUTOPILOT_VERSION" in station.names()
    air.kill()


class Station:
    """A station at `mav_ground`, and its commands."""

    def __init__(self, air: Any, system: int = 255) -> None:
        self.air, self.wire = air, Wire(system, 190)
        self.wire.peer = "127.0.0.1", int(air.module.params.address.rpartition(":")[2])

    def ask(self, command: int, *values: float) -> list[tuple[int, int]]:
        filled = [*values, *[0.0] * (7 - len(values))]
        mav = self.wire.mav
        self.wire.send(mav.command_long_encode(1, 1, command, 0, *filled))
        self.air.step(STEP)
        return self.answers()

    def answers(self) -> list[tuple[int, int]]:
        me = self.wire.mav.srcSystem
        return [(m.command, m.result) for m in self.wire.receive()
                if m.get_type() == "COMMAND_ACK" and m.target_system == me]  # fmt: skip


def test_another_value_replaces_a_command_that_is_not_yet_followed() -> None:
    air = ground(free_port())
    one, other = Station(air), Station(air, 254)
    assert one.ask(400, 1) == []
    assert one.ask(400, 1) == [(400, 5)], "the same again"
    assert other.ask(176, 1, 4, 3) == []
    assert one.ask(400, 0) == [(400, 0)], "disarmed as it is"
    assert air.outputs.arm == 0
    air.inputs.armed = 1  # it had begun to arm
    assert one.ask(400, 0) == []
    air.inputs.armed = 0
    air.step(STEP)
    assert one.answers() == [(400, 0)]
    assert one.ask(176, 1, 4, 6) == []
    assert air.outputs.mode == 100925440
    assert other.answers() == [(176, 2)], "what it asked for is given up"
    air.inputs.in_mode = 100925440
    air.step(STEP)
    assert (one.answers(), other.answers()) == ([(176, 0)], [])
    air.kill()


def test_velocities_ahead_of_the_vehicle_are_turned_and_other_frames_said() -> None:
    air = ground(free_port())
    air.inputs.att = [cos(pi / 4), 0, 0, sin(pi / 4)]  # it points east
    station = Station(air)

    def send(frame: int, mask: int) -> list[float]:
        values = *(7.0,) * 3, 2.0, 1.0, 0.5, *(0.0,) * 3, 0.0, 0.1
        wire = station.wire
        wire.send(
            wire.mav.set_position_target_local_ned_encode(0, 1, 1, frame, mask, *values)
        )
        air.step(STEP)
        found: list[float] = air.outputs.setpoint[5:8].tolist()
        return found

    velocity = 0b010111000111
    north = [2.0, 1.0, 0.5]
    for frame in (8, 12):
        assert send(1, velocity) == north
        assert send(frame, velocity) == pytest.approx([-1.0, 2.0, 0.5])
    assert send(1, velocity) == north
    assert texts(air) == []
    assert send(8, 0b010111111000) == north, "a place that moves with the vehicle"
    assert send(8, velocity | 0b1000) == north, "to the right alone"
    assert send(8, velocity & ~0x400) == north, "a yaw, relative or not"
    air.inputs.att = [nan] * 4
    assert send(8, velocity) == north, "the heading is not known"
    assert texts(air) == ["set-points in this frame, or not finite, do not count"]
    air.kill()


@pytest.mark.parametrize(
    ("command", "values"),
    [
        (400, (nan,)),
        (400, (0.7,)),
        (400, (2.0,)),
        (176, (1, nan, 0)),
        (176, (1, 4, nan)),
        (176, (1, inf, 0)),
        (176, (1, 260, 0)),
        (176, (1, 4.5, 0)),
        (511, (31, nan)),
        (511, (31, inf)),
        (511, (nan, 1000)),
        (512, (nan,)),
        (512, (-inf,)),
    ],
)
def test_commands_with_numbers_that_are_none_are_denied(
    command: int, values: tuple[float, ...]
) -> None:
    air = ground(free_port())
    air.off()
    air.inputs.armed, air.inputs.in_mode = 1, 7
    air.on()
    assert Station(air).ask(command, *values) == [(command, 2)]
    assert air.state is State.ON
    assert (air.outputs.arm, air.outputs.mode) == (1, 7)
    air.kill()


def test_parameters_are_listed_read_and_set() -> None:
    port = free_port()
    air, station = ground(port), Wire(255, 190)

    def values() -> dict[str, float]:
        air.step(STEP)
        return {m.param_id: m.param_value for m in station.receive()
                if m.get_type() == "PARAM_VALUE"}  # fmt: skip

    mav = station.mav
    assert air.outputs.param.tolist() == [3.0, 0.5]
    station.send(mav.param_request_list_encode(1, 1), to=port)
    assert values() == {"SPEED": 3.0, "GAIN": 0.5}
    station.send(mav.param_set_encode(1, 1, b"GAIN", 0.75, 9), to=port)
    assert values() == {"GAIN": 0.75}
    assert air.outputs.param.tolist() == [3.0, 0.75]
    station.send(mav.param_set_encode(1, 1, b"GAIN", nan, 9), to=port)
    assert values() == {"GAIN": 0.75}
    station.send(mav.param_request_read_encode(1, 1, b"SPEED", -1), to=port)
    assert values() == {"SPEED": 3.0}
    station.send(mav.param_request_read_encode(1, 1, b"NONE", -1), to=port)
    assert values() == {}
    air.off()
    air.on()
    assert air.outputs.param.tolist() == [3.0, 0.75], "as the station has set it"
    air.kill()


# -- the link -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("udpin:localhost:14550", ("udpin", "127.0.0.1", 14550, True)),
        ("udpin:10.0.0.1:14550", ("udpin", "10.0.0.1", 14550, False)),
        ("udpout:10.0.0.7:1", ("udpout", "10.0.0.7", 1, False)),
        ("tcp:127.0.0.1:5760", ("tcp", "127.0.0.1", 5760, True)),
        ("tcpin:localhost:4560", ("tcpin", "127.0.0.1", 4560, True)),
        ("serial:/dev/ttyACM0", ("serial", "/dev/ttyACM0", 57600, True)),
        ("serial:/dev/ttyACM0:921600", ("serial", "/dev/ttyACM0", 921600, True)),
    ],
)
def test_addresses(text: str, found: tuple[object, ...]) -> None:
    address = parse_address(text)
    assert (*address, address.private) == found


@pytest.mark.parametrize(
    "text",
    [
        "",
        "udp:localhost:1",
        "udpin:14550",
        "udpin:localhost:0",
        "tcp:host:5",
        "udpout:localhost:70000",
        "serial:",
        "udpin:localhost:x",
    ],
)
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(ParameterError, match="no address of a MAVLink link"):
        parse_address(text)


@pytest.fixture
def key(tmp_path):
    path = tmp_path / "link.key"
    path.write_text("swordfish\n")
    path.chmod(0o600)
    return path


def test_a_link_that_others_reach_needs_a_key_that_others_cannot_read(key) -> None:
    with pytest.raises(ParameterError, match="needs a key"):
        MavLink("udpin:0.0.0.0:14550", 255, 190)
    MavLink("udpin:0.0.0.0:14550", 255, 190, key=str(key)).close()
    key.chmod(0o644)
    with pytest.raises(DeviceError, match="chmod 600"):
        MavLink("udpin:0.0.0.0:14550", 255, 190, key=str(key))
    key.chmod(0o600)
    key.write_text("\n")
    with pytest.raises(DeviceError, match="it is empty"):
        MavLink("udpin:0.0.0.0:14550", 255, 190, key=str(key))
    with pytest.raises(MethodError, match="needs a key"):
        vehicle(1, address="udpin:0.0.0.0:14550")


def signed(one: Wire, secret: str, stamp: int) -> bytes:
    import hashlib

    signing = one.mav.signing
    signing.secret_key = hashlib.sha256(secret.encode()).digest()
    signing.sign_outgoing, signing.timestamp = True, stamp
    return one.pack(one.beat(custom_mode=stamp % 1000))


def test_only_frames_with_the_key_count_and_each_once(wire: Wire, key) -> None:
    base = vehicle(wire.port, key=str(key))
    base.step(STEP)
    own = wire.receive()
    assert own
    assert all(one.get_header().incompat_flags & 1 for one in own), "ours are signed"
    now = time_stamp()

    def refused(frame: bytes) -> bool:
        before = base.outputs.bad[1]
        wire.send(frame)
        base.step(STEP)
        return bool(base.outputs.bad[1] == before + 1)

    assert refused(Wire().pack(wire.beat())), "without a signature"
    assert refused(signed(Wire(), "sardine", now + 999_000_000)), "with another key"
    good = signed(Wire(), "swordfish", now + 1)
    assert not refused(good), "what was forged before does not shut it out"
    assert base.outputs.in_mode == (now + 1) % 1000
    assert refused(good), "played again"
    assert refused(signed(Wire(1, 50), "swordfish", now - 7_000_000)), "a minute old"
    base.kill()


def test_what_is_lost_is_opened_again_and_said_once(wire: Wire) -> None:
    taken = Wire()
    clock = FakeClock()
    base = vehicle(1, clock, address=f"udpin:127.0.0.1:{taken.port}")
    base.step(STEP, 50)
    assert len(texts(base)) == 1, "no MAVLink link: ... Address already in use"
    taken.socket.close()
    base.step(STEP, 110)
    wire.send(wire.beat(custom_mode=3), to=taken.port)
    base.step(STEP)
    assert base.outputs.in_mode == 3
    base.kill()


def test_a_stream_brings_frames_in_pieces() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        base = vehicle(1, address=f"tcp:127.0.0.1:{port}")
        base.step(STEP)
        other, _ = server.accept()
        with other:
            one = Wire()
            frame = one.pack(one.beat(custom_mode=8))
            for piece in (frame[:7], frame[7:]):
                other.sendall(piece)
                base.step(STEP)
            assert base.outputs.in_mode == 8
            base.step(STEP)
            other.settimeout(5.0)
            assert other.recv(4096)[0] == 0xFD
        base.step(STEP)
        assert any("has closed the connection" in text for text in texts(base))
        one.socket.close()
    base.kill()


def test_a_serial_line_carries_frames() -> None:
    pytest.importorskip("serial")
    master, slave = os.openpty()
    tty.setraw(master)
    name = os.ttyname(slave)
    os.close(slave)
    base = vehicle(1, address=f"serial:{name}:57600")
    one = Wire()
    os.write(master, one.pack(one.beat(custom_mode=6)))
    while base.outputs.in_mode != 6:
        base.step(STEP)
    assert os.read(master, 4096)[0] == 0xFD
    base.kill()
    os.close(master)


def test_a_replay_gets_the_same_without_the_link_or_its_key(wire: Wire, key) -> None:
    def run(base: Any, live: bool) -> list[list[float]]:
        rows = []
        for k in range(60):
            if live and k == 1:
                wire.receive()
            if live and k > 1:
                wire.send(signed(Wire(), "swordfish", time_stamp()))
                x = wire.mav.local_position_ned_encode(k, k, 2, 3, 0, 0, 0)
                wire.mav.signing = Wire().mav.signing
                wire.send(x, b"noise" * k)
            base.step(STEP)
            out = base.outputs
            rows.append([*out.x, out.in_mode, out.age, *out.bad, base.output_age])
        return rows

    tape = Tape()
    use(tape)
    try:
        base = vehicle(wire.port, key=str(key))
        live = run(base, live=True)
        base.kill()
    finally:
        use(None)
    assert live[-1][5] > 50, "frames without a signature"
    key.unlink()
    wire.socket.close()
    player = Player()
    player.feed(tape.take())
    use(player)
    try:
        again = vehicle(wire.port, key=str(key))
        assert run(again, live=False) == live
    finally:
        use(None)


def test_in_a_simulation_nothing_is_opened() -> None:
    with no_devices("this is a simulation"):
        base = vehicle(free_port())
        base.step(STEP, 10)
    assert base.state is State.ON
    assert any("this is a simulation" in text for text in texts(base))


def test_modules_without_an_owner_of_a_link_say_so() -> None:
    from pbonet import TaskContext
    from pbonet.modules._mavlink import link_of

    with pytest.raises(DeviceError, match="combine it with mav_vehicle"):
        link_of(TaskContext())


def test_the_clock_of_the_other_end() -> None:
    clock = PeerClock()
    assert clock.ours(123, 1000) == 1000, "unknown: now"
    clock.learn(10_000 * MS, 1_000 * MS, 1_040 * MS)
    assert clock.ours(10_050 * MS, 1_100 * MS) == 1_050 * MS
    clock.learn(10_100 * MS, 1_090 * MS, 1_095 * MS)  # a shorter way
    assert clock.ours(10_100 * MS, 1_200 * MS) == 1_090 * MS
    assert clock.ours(20_000 * MS, 1_200 * MS) == 1_200 * MS, "never in the future"
    clock.learn(10 * MS, 2_000 * MS, 2_010 * MS)  # it has started again
    assert clock.ours(15 * MS, 2_020 * MS) == 2_005 * MS


@pytest.mark.parametrize("age_s", [1, 59, 61, 300, 100_000])
def test_what_is_old_by_a_known_clock_stays_old(age_s: int) -> None:
    clock = PeerClock()
    clock.learn(10**15, 10**9, 10**9)
    now = 200 * 10**9
    assert clock.ours(10**15 - 10**9 + now - age_s * 10**9, now) == now - age_s * 10**9


def test_a_vehicle_that_starts_again_is_old_until_it_answers(wire: Wire) -> None:
    base = vehicle(wire.port)

    def age(clock_ms: int, boot_ms: int, *, answers: bool, component: int = 1) -> float:
        for m in wire.receive():
            if m.get_type() == "TIMESYNC" and m.tc1 == 0 and answers:
                one = Wire(1, component)
                wire.send(one.pack(one.mav.timesync_encode(clock_ms * MS, m.ts1)))
        wire.send(
            wire.beat(),
            wire.mav.attitude_quaternion_encode(boot_ms, 1, 0, 0, 0, 0, 0, 0),
            wire.mav.local_position_ned_encode(boot_ms, 1, 2, 3, 0, 0, 0),
        )
        base.step(STEP)
        return float(base.output_age)

    base.step(STEP)
    assert age(100_000, 100_000, answers=True) < 0.05
    assert age(0, 1_000, answers=False) > 1.0, "it has started again"
    assert [one for one in texts(base) if "by its own clock" in one]
    base.step(1.0)
    assert age(2_000, 2_000, answers=True) < 0.05
    base.step(1.0)
    old = age(33_000, 3_010, answers=True, component=191)
    assert old < 0.1, "the clock of a camera is none of the autopilot's"
    wire.send(wire.mav.timesync_encode(30_000 * MS, 1))  # nobody has asked for it
    base.step(STEP)
    assert age(0, 3_030, answers=False) < 0.1
    base.kill()


# -- set-points and commands ----------------------------------------------------------


def test_a_position_a_velocity_and_an_attitude_become_set_points() -> None:
    pos = Bench(MavSetpointPos, x_des=[1.0, 2.0, -3.0])
    pos.on()
    pos.step()
    assert pos.outputs.setpoint.tolist() == [84, 0xDF8, 1, 2, -3, *[0] * 8]
    pos.set("yaw", pi / 2)
    pos.set("heading", "fixed")
    pos.step()
    assert pos.outputs.setpoint.tolist() == [84, 0x9F8, 1, 2, -3, *[0] * 6, pi / 2, 0]
    pos.off()
    assert not pos.outputs.setpoint.any()
    vel = Bench(
        MavSetpointVel, v_des=[1.0, 2.0, -3.0], params={"heading": "fixed", "yaw": 0.5}
    )
    vel.on()
    vel.step()
    assert vel.outputs.setpoint.tolist() == [
        84, 0x9C7, 0, 0, 0, 1, 2, -3, 0, 0, 0, 0.5, 0
    ]  # fmt: skip
    vel.off()
    assert not vel.outputs.setpoint.any()
    att = Bench(MavSetpointAtt, att_des=[1.0, 0, 0, 0], thr=1.5)
    att.on()
    att.step()
    assert att.outputs.setpoint.tolist() == [82, 7, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0]
    att.off()
    assert not att.outputs.setpoint.any()


def test_commands_are_given_when_they_are_said() -> None:
    one = Bench(MavCommand, params={"arm": 0, "mode": 5}, arm=1, mode=7)
    one.on()
    one.step()
    assert (one.outputs.arm, one.outputs.mode) == (1, 7), "a new task commands nothing"
    one.set("mode", 9)
    one.step()
    assert (one.outputs.arm, one.outputs.mode) == (1, 9)
    one.set("arm", 0)
    one.step()
    assert (one.outputs.arm, one.outputs.mode) == (0, 9)


@pytest.mark.parametrize(
    "name", sorted(path.stem for path in MODULES.glob("*/mav_*.rmod"))
)
def test_every_rmod_is_one(name: str) -> None:
    from pbonet.config import Library

    (path,) = MODULES.glob(f"*/{name}.rmod")
    assert Library().read_rmod(path).name == name
