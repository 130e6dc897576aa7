"""Remote control, gimbal, actuators and HIL; the other end is pymavlink's `mavutil`."""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Iterator
from math import isnan, radians, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_modules_mavlink import STEP, free_port, texts

import pbonet.modules
from pbonet import State
from pbonet.errors import MethodError
from pbonet.io import no_devices
from pbonet.modules.robot_interfaces.mav_actuator import MavActuator
from pbonet.modules.robot_interfaces.mav_gimbal import MavGimbal
from pbonet.modules.subsystem_interfaces.mav_hil import MavHil
from pbonet.modules.teleoperation.mav_rc import MavRc
from pbonet.testing import Bench

os.environ.setdefault("MAVLINK20", "1")  # read when mavutil is imported
from pymavlink import mavutil

MODULES = Path(pbonet.modules.__file__).parent
SIZES = {"nrc": 6, "nact": 2, "npulse": 4}
CONFIGURE, SET = 1001, 187
HALF = sqrt(0.5)
LEVEL = [9.81 * 0.0, 0.0, -9.81]


class Peer:
    """The other end: a connection of mavutil, and what it has received."""

    def __init__(self, address: str, system: int = 1, component: int = 1) -> None:
        self.link: Any = mavutil.mavlink_connection(
            address, source_system=system, source_component=component, dialect="common"
        )
        self.mav: Any = self.link.mav

    def received(self, *kinds: str) -> list[Any]:
        found: list[Any] = []
        while (m := self.link.recv_match(blocking=False)) is not None:
            found.append(m)
        return [m for m in found if not kinds or m.get_type() in kinds]

    def beat(self, kind: int = 2) -> None:
        self.mav.heartbeat_send(kind, 12, 0, 0, 4)


class Both:
    """A task and its peer, a step of 10 ms at a time."""

    def __init__(self, bench: Any, peer: Peer, kind: int = 2) -> None:
        self.base, self.peer, self._kind = bench, peer, kind

    def run(
        self,
        seconds: float,
        *kinds: str,
        each: Callable[[], None] = lambda: None,
        beats: bool = True,
    ) -> list[Any]:
        """Return what the peer received meanwhile."""
        found: list[Any] = []
        for _ in range(round(seconds / STEP)):
            if beats:
                self.peer.beat(self._kind)
            each()
            self.base.step(STEP)
            found += self.peer.received(*kinds)
        return found


@pytest.fixture
def payload(tmp_path: Path) -> Iterator[Both]:
    port = free_port()
    text = (MODULES / "robot_interfaces" / "mav_payload.rmod").read_text()
    rmod = tmp_path / "payload.rmod"
    rmod.write_text(
        text.replace("EOF", "LOCAL")
        + f"mav_vehicle.ADDRESS udpout:127.0.0.1:{port}\nmav_vehicle.WAIT 0\nEOF\n"
    )
    peer = Peer(f"udpin:127.0.0.1:{port}")
    base = Bench.of(rmod, {**SIZES, "mav_gimbal_att": [1.0, 0, 0, 0]})
    base.on()
    base.step(STEP)
    peer.received()
    yield Both(base, peer)
    base.kill()
    peer.link.close()


def pulses(*values: int) -> list[int]:
    return [*values, *[65535] * (18 - len(values))]


# -- the pilot ------------------------------------------------------------------------


def test_channels_of_a_remote_control_are_shares(payload: Both) -> None:
    base, mav = payload.base, payload.peer.mav
    sent = pulses(1000, 1500, 2000, 1750, 65535, 2300)
    assert (base["RC_OK"], base["RC_MEZ"].tolist()) == (0, [0.0] * 6)
    payload.run(0.1, each=lambda: mav.rc_channels_send(0, 6, *sent, 200))
    assert base["RC_MEZ"].tolist() == [-1.0, 0.0, 1.0, 0.5, 0.0, 1.0]
    assert (base["RC_OK"], base["RC_AGE"]) == (1, 0.0)
    assert base["RC_BUTTONS"] == 0


def test_a_lost_pilot_is_lost_until_the_task_is_turned_on_again(payload: Both) -> None:
    base, mav = payload.base, payload.peer.mav

    def sticks() -> None:
        mav.rc_channels_send(0, 4, *pulses(1900, 1500, 1500, 1500), 200)

    payload.run(0.2, each=sticks)
    assert base["RC_MEZ"][0] == pytest.approx(0.8)
    payload.run(1.1)
    assert (base["RC_OK"], base["RC_MEZ"][0]) == (0, 0.0)
    payload.run(0.5, each=sticks)
    assert (base["RC_OK"], base["RC_MEZ"][0]) == (0, 0.0), "it is back, not cleared"
    assert len([one for one in texts(base) if "no pilot" in one]) == 1
    base.off()
    base.on()
    payload.run(0.2, each=sticks)
    assert (base["RC_OK"], base["RC_MEZ"][0]) == (1, pytest.approx(0.8))
    base.illegal = True
    payload.run(0.1, each=sticks)
    assert (base["RC_OK"], base["RC_MEZ"][0]) == (0, 0.0)
    base.illegal = False
    payload.run(0.1, each=sticks)
    assert (base["RC_OK"], base["RC_MEZ"][0]) == (0, 0.0)


@pytest.fixture
def piloted(tmp_path: Path) -> Iterator[Both]:
    port = free_port()
    text = (MODULES / "subsystem_interfaces" / "mav_piloted.rmod").read_text()
    rmod = tmp_path / "piloted.rmod"
    rmod.write_text(
        text.replace("EOF", "LOCAL")
        + f"mav_ground.ADDRESS udpout:127.0.0.1:{port}\nmav_ground.PARAMS GAIN=1\n"
        + "mav_rc.NEUTRAL 0 0 -1 0 0 0\nEOF\n"
    )
    peer = Peer(f"udpin:127.0.0.1:{port}", 255, 190)
    air = Bench.of(rmod, {"nrc": 6, "nparam": 1, "att": [1.0, 0, 0, 0]})
    air.on()
    air.step(STEP)
    peer.received()
    yield Both(air, peer, kind=6)
    air.kill()
    peer.link.close()


def test_stations_send_sticks_and_pulses(piloted: Both) -> None:
    air, mav = piloted.base, piloted.peer.mav
    assert air["RC_MEZ"].tolist() == [0, 0, -1, 0, 0, 0]
    axes = 500, -250, 1000, 32767, 5, 7, 2, 1000, 300  # buttons2 is 7; t alone is on
    piloted.run(0.1, each=lambda: mav.manual_control_send(1, *axes))
    assert air["RC_MEZ"].tolist() == [-0.25, 0.5, 1.0, 0.0, 0.0, 0.3]
    assert air["RC_BUTTONS"] == 5 | 7 << 16
    piloted.run(0.1, each=lambda: mav.manual_control_send(2, 0, 0, 0, 0, 0))
    assert air["RC_MEZ"][1] == 0.5, "that is for another system"
    channels = [2000, 0, 1000, 65535, 65534, 1250, *[0] * 12]
    piloted.run(0.1, each=lambda: mav.rc_channels_override_send(1, 1, *channels))
    assert air["RC_MEZ"].tolist() == [1.0, 0.0, -1.0, 0.0, 0.0, -0.5]
    piloted.run(2.6, beats=False)
    assert (air["RC_OK"], air["RC_MEZ"].tolist()) == (0, [0, 0, -1, 0, 0, 0])


# -- the gimbal -----------------------------------------------------------------------


def attitudes(found: list[Any]) -> list[Any]:
    return [m for m in found if m.get_type() == "GIMBAL_MANAGER_SET_ATTITUDE"]


def test_a_gimbal_is_asked_for_and_steered(payload: Both) -> None:
    base, mav = payload.base, payload.peer.mav
    base["GIMBAL_DES"] = [2.0, 0.0, 2.0, 0.0]
    found = payload.run(2.05)
    asked = [
        m for m in found if m.get_type() == "COMMAND_LONG" and m.command == CONFIGURE
    ]
    assert [(m.param1, m.param2, m.param3, m.target_system) for m in asked[:1]] == [
        (255.0, 190.0, -1.0, 1)
    ]
    assert len(asked) > 2, "until it is answered"
    assert not attitudes(found), "it is not ours yet"
    mav.command_ack_send(CONFIGURE, 0, 0, 0, 255, 190)
    mav.gimbal_manager_status_send(0, 0, 1, 255, 190, 0, 0)
    found = payload.run(1.0)
    assert base["GIMBAL_OURS"] == 1
    assert not [
        m for m in found if m.get_type() == "COMMAND_LONG" and m.command == CONFIGURE
    ]
    sent = attitudes(found)
    assert len(sent) == pytest.approx(20, abs=1)
    assert sent[0].q == pytest.approx([HALF, 0.0, HALF, 0.0])
    assert sent[0].flags == 4 | 8 | 32
    assert isnan(sent[0].angular_velocity_x)
    mav.gimbal_device_attitude_status_send(
        255, 190, 5, 0, [HALF, 0, 0, HALF], 0.1, 0.2, float("nan"), 0
    )
    payload.run(0.01)
    assert base["GIMBAL_MEZ"] == pytest.approx([HALF, 0, 0, HALF])
    assert base["GIMBAL^_MEZ"].tolist() == [0, 0, 0], "one of them is no number"
    assert base["GIMBAL_AGE"] == 0.0
    payload.run(0.5)
    assert base["GIMBAL_AGE"] == pytest.approx(0.5)


def test_a_gimbal_that_another_station_took_is_left_alone(payload: Both) -> None:
    base, mav = payload.base, payload.peer.mav
    base["GIMBAL_DES"] = [1.0, 0.0, 0.0, 0.0]
    mav.gimbal_manager_status_send(0, 0, 1, 255, 190, 0, 0)
    assert attitudes(payload.run(0.5))
    base.ages["des"] = 0.6
    payload.run(0.05)
    assert not attitudes(payload.run(0.5)), "an old wish"
    base.ages["des"] = 0.0
    assert attitudes(payload.run(0.5))
    mav.gimbal_manager_status_send(0, 0, 1, 250, 190, 0, 0)
    payload.run(0.05)
    mav.gimbal_manager_status_send(0, 0, 1, 255, 190, 0, 0)
    found = payload.run(1.5)
    assert not attitudes(found)
    assert not [
        m for m in found if m.get_type() == "COMMAND_LONG" and m.command == CONFIGURE
    ]
    assert base["GIMBAL_OURS"] == 0
    assert any("system 250 has taken it" in one for one in texts(base))
    base.off()
    base.on()
    payload.run(0.1)
    mav.gimbal_manager_status_send(0, 0, 1, 255, 190, 0, 0)
    assert attitudes(payload.run(0.5))


# -- actuators ------------------------------------------------------------------------


def orders(found: list[Any]) -> list[list[float]]:
    return [
        [m.param1, m.param2, m.param7]
        for m in found
        if m.get_type() == "COMMAND_LONG" and m.command == SET
    ]


def test_changes_of_actuators_go_out_and_pulses_come_in(payload: Both) -> None:
    base, mav = payload.base, payload.peer.mav
    base["ACT_DES"] = [0.5, -0.5]
    assert orders(payload.run(1.0)) == [], "what it is at `on` is not sent"
    base.ages["mav_actuator_des"] = 0.6
    base["ACT_DES"] = [-0.5, -0.5]
    assert orders(payload.run(0.5)) == [], "an old wish"
    base.ages["mav_actuator_des"] = 0.0
    assert orders(payload.run(0.5)) == [], "as at `on`"
    base["ACT_DES"] = [-0.505, -0.5]
    assert orders(payload.run(0.5)) == [], "less than STEP"
    base["ACT_DES"] = [3.0, -0.5]
    sent = payload.run(0.7)
    assert orders(sent) == [[1.0, -0.5, 0.0]] * 2, "again, as it was not answered"
    one = next(m for m in sent if m.get_type() == "COMMAND_LONG" and m.command == SET)
    assert isnan(one.param3), "the others are left as they are"
    mav.command_ack_send(SET, 0, 0, 0, 255, 190)
    assert orders(payload.run(1.0)) == []
    mav.servo_output_raw_send(0, 0, 1000, 1500, 0, 2000, 0, 0, 0, 0)
    payload.run(0.01)
    assert base["PULSE_MEZ"] == pytest.approx([1e-3, 1.5e-3, 0.0, 2e-3])
    assert base["PULSE_AGE"] == 0.0


def test_after_a_loss_neither_gimbal_nor_actuators_move(payload: Both) -> None:
    base, mav = payload.base, payload.peer.mav
    base["GIMBAL_DES"], base["ACT_DES"] = [1.0, 0, 0, 0], [0.0, 0.0]
    mav.gimbal_manager_status_send(0, 0, 1, 255, 190, 0, 0)
    payload.run(0.5)
    base["ACT_DES"] = [0.5, 0.0]
    assert orders(payload.run(0.1)) == [[0.5, 0.0, 0.0]]
    payload.run(2.6, beats=False)
    assert base.illegal
    base["ACT_DES"] = [0.9, 0.0]
    mav.gimbal_manager_status_send(0, 0, 1, 255, 190, 0, 0)
    base.illegal = False  # also in a task that is not CRITICAL
    after = payload.run(2.0)
    assert not attitudes(after)
    asked = {m.command for m in after if m.get_type() == "COMMAND_LONG"}
    assert not asked & {SET, CONFIGURE}
    assert base["LINK_AGE"] < 1.0
    base.off()
    base.on()
    mav.gimbal_manager_status_send(0, 0, 1, 255, 190, 0, 0)
    again = payload.run(1.0)
    assert attitudes(again)
    assert orders(again) == [], "it does not change"
    base["ACT_DES"] = [-0.9, 0.0]
    assert orders(payload.run(0.1)) == [[pytest.approx(-0.9), 0.0, 0.0]]


# -- hardware in the loop -------------------------------------------------------------


@pytest.fixture
def loop() -> Iterator[Both]:
    """An autopilot that connects to the simulation, as PX4 does."""
    port = free_port()
    base = Bench(
        MavHil,
        {
            "nact": 4,
            "acc": [0.1, -0.2, -9.8],
            "rates": [0.01, 0.02, 0.03],
            "att": [HALF, 0, 0, HALF],
            "v": [3.0, -4.0, 0.5],
            "lla": [radians(47.397742), radians(8.545594), 488.0],
        },
        params={"address": f"tcpin:127.0.0.1:{port}", "rate": 50.0},
        critical=True,
    )
    base.on()
    base.step(STEP)
    peer = Peer(f"tcp:127.0.0.1:{port}")
    base.step(STEP)
    yield Both(base, peer)
    base.kill()
    peer.link.close()


def controls(peer: Peer, *values: float, armed: bool = True) -> None:
    filled = [*values, *[0.0] * (16 - len(values))]
    peer.mav.hil_actuator_controls_send(0, filled, 128 if armed else 0, 0)


def until_heard(both: Both, kind: str) -> list[Any]:
    """Step until something of a kind has come: a stream needs more than a step."""
    while not (found := both.run(STEP, kind)):
        pass
    return found


def test_sensors_are_those_of_the_simulation(loop: Both) -> None:
    sensor = until_heard(loop, "HIL_SENSOR")[-1]
    assert [sensor.xacc, sensor.yacc, sensor.zacc] == pytest.approx([0.1, -0.2, -9.8])
    assert [sensor.xgyro, sensor.ygyro, sensor.zgyro] == pytest.approx([
        0.01,
        0.02,
        0.03,
    ])
    # east of the body is north of the world: the field (0.215, 0.012, 0.427) G turns
    field = [sensor.xmag, sensor.ymag, sensor.zmag]
    assert field == pytest.approx([0.012, -0.215, 0.427], abs=1e-6)
    assert sensor.abs_pressure == pytest.approx(955.98, abs=0.05), "ISA at 488 m"
    assert sensor.temperature == pytest.approx(15.0 - 0.0065 * 488)
    assert sensor.fields_updated == 0x1BFF
    place = until_heard(loop, "HIL_GPS")[-1]
    assert (place.lat, place.lon, place.alt) == (473977420, 85455940, 488000)
    assert (place.vn, place.ve, place.vd, place.vel) == (300, -400, 50, 500)
    assert place.cog == 30687
    loop.base.ages["acc"] = 0.05
    late = loop.base.clock()
    old = until_heard(loop, "HIL_SENSOR")[-1]
    assert old.time_usec == pytest.approx(late // 1000 - 50_000, abs=25_000)
    loop.base.stale = {"lla"}
    loop.run(0.2)
    assert not loop.run(0.5, "HIL_SENSOR", "HIL_GPS"), "never a stale value"


def test_controls_count_while_armed_and_fresh(loop: Both) -> None:
    base, peer = loop.base, loop.peer

    def until(each: Callable[[], None], holds: Callable[[], bool]) -> None:
        while not holds():
            loop.run(STEP, each=each)

    nan = float("nan")
    until(
        lambda: controls(peer, 0.5, -2.0, nan, 0.25), lambda: bool(base.outputs.armed)
    )
    assert base.outputs.act.tolist() == [0.5, -1.0, 0.0, 0.25]
    assert base.output_age <= STEP
    loop.run(0.6)
    assert (base.outputs.armed, base.outputs.act.any()) == (0, False), "silent"
    until(lambda: controls(peer, 0.5), lambda: base.outputs.act[0] == 0.5)
    until(lambda: controls(peer, 0.5, armed=False), lambda: not base.outputs.act.any())
    until(lambda: controls(peer, 0.5), lambda: base.outputs.act[0] == 0.5)
    loop.run(2.7, beats=False)
    assert base.illegal
    assert any("autopilot 1: no message for 2.5" in one for one in texts(base))
    base.illegal = False  # also in a task that is not CRITICAL
    loop.run(1.0, each=lambda: controls(peer, 0.5))
    assert base.outputs.age < 0.1, "it is back"
    assert not base.outputs.act.any(), "and moves nothing before it is cleared"
    base.off()
    base.on()
    until(lambda: controls(peer, 0.5), lambda: base.outputs.act[0] == 0.5)


def test_an_autopilot_may_connect_again(loop: Both) -> None:
    until_heard(loop, "HIL_SENSOR")
    address = loop.peer.link.address
    loop.peer.link.close()
    while not any("has closed the connection" in one for one in texts(loop.base)):
        loop.base.step(STEP)
    loop.base.step(STEP, 110)
    loop.peer.link = mavutil.mavlink_connection(address, dialect="common")
    assert until_heard(loop, "HIL_SENSOR")


# -- all ------------------------------------------------------------------------------


@pytest.mark.parametrize("module", [MavRc, MavGimbal, MavActuator])
def test_they_are_parts_of_a_task_that_owns_a_link(module: Any) -> None:
    sizes = {"nrc": 4} if module is MavRc else {"system": 1}
    sizes |= {"nact": 2, "npulse": 4} if module is MavActuator else {}
    with pytest.raises(MethodError, match="combine it with mav_vehicle"):
        Bench(module, sizes)


def test_every_kind_of_message_with_odd_values_is_survived(
    payload: Both, piloted: Both, loop: Both
) -> None:
    chance = random.Random(4)
    for kind in mavutil.mavlink.mavlink_map.values():
        for fill in (0x00, 0x7F, 0xFF, None):
            size = kind.unpacker.size
            body = bytes([fill]) * size if fill is not None else chance.randbytes(size)
            for one in (payload, piloted, loop):
                message = mavutil.mavlink.MAVLink_message(kind.id, kind.msgname)
                mav = one.peer.mav
                one.peer.link.write(message._pack(mav, kind.crc_extra, body))
        for one in (payload, piloted, loop):
            one.base.step(STEP)
            one.peer.received()
    for one in (payload, piloted, loop):
        assert one.base.state is State.ON


def test_a_command_sets_six_actuators(tmp_path: Path) -> None:
    text = (MODULES / "robot_interfaces" / "mav_payload.rmod").read_text()
    rmod = tmp_path / "payload.rmod"
    address = f"mav_vehicle.ADDRESS udpout:127.0.0.1:{free_port()}"
    rmod.write_text(
        f"{text.replace('EOF', 'LOCAL')}{address}\nmav_vehicle.WAIT 0\nEOF\n"
    )
    with pytest.raises(MethodError, match="too many actuators"):
        Bench.of(rmod, {**SIZES, "nact": 7})


def test_in_a_simulation_nothing_is_opened(tmp_path: Path) -> None:
    text = (MODULES / "robot_interfaces" / "mav_payload.rmod").read_text()
    rmod = tmp_path / "payload.rmod"
    address = "mav_vehicle.ADDRESS udpin:127.0.0.1:14550"
    rmod.write_text(f"{text.replace('EOF', 'LOCAL')}{address}\nEOF\n")
    hil = {"address": "tcpin:127.0.0.1:4560"}
    with no_devices("this is a simulation"):
        for base, moves in (
            (Bench(MavHil, {"nact": 4}, params=hil), "ACT_CMD"),
            (Bench.of(rmod, SIZES), "RC_MEZ"),
        ):
            base.on()
            base.step(STEP, 10)
            assert base.state is State.ON
            assert any("this is a simulation" in text for text in texts(base))
            assert not np.any(base[moves])
            base.kill()
