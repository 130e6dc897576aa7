"""MAVLink modules with other programs at the other end: MAVSDK twice, and MAVProxy."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import mavsdk_grpc as mavsdk
import numpy as np
import pytest
from mavsdk_grpc import telemetry_server
from mavsdk_grpc.action_server import AllowableFlightModes
from mavsdk_grpc.async_plugin_manager import AsyncPluginManager
from mavsdk_grpc.mavlink_direct_server import MavlinkDirectServer, MavlinkMessage
from mavsdk_grpc.mission_raw import MissionItem
from mavsdk_grpc.offboard import PositionNedYaw, VelocityBodyYawspeed
from pymavlink.dialects.v20 import common
from watching import wait_for

import pbonet.modules
from pbonet.modules.subsystem_interfaces.mav_ground import MavGround
from pbonet.testing import Bench

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator

MODULES = Path(pbonet.modules.__file__).parent
CRAFT = MODULES / "robot_interfaces" / "mav_craft.rmod"
PILOTED = MODULES / "subsystem_interfaces" / "mav_piloted.rmod"
PARTS = ("vehicle", "params", "mission", "gimbal", "actuator")
SPOT = [84.0, 3576.0, 1.0, 2.0, -3.0] + 8 * [0.0]
"""A set-point: a position."""
INTERVAL = 511
"""The command that asks for messages of a kind."""
OTHER = 200
"""Another system, which sends heartbeats to the same port in each cycle."""
OFFBOARD, LAND, HOLD = 6 << 16, 4 << 16 | 6 << 24, 4 << 16 | 3 << 24
LIMIT = 60.0


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@contextmanager
def running(bench: Any, each: Callable[[Any], None]) -> Iterator[list[str]]:
    """Step a bench at 100 Hz of real time in a thread; yields what it says."""
    said: list[str] = []
    ends = threading.Event()

    def run() -> None:
        last = time.monotonic()
        while not ends.wait(0.01):
            now = time.monotonic()
            bench.step(now - last)
            last = now
            each(bench)
            said.extend(one.text for one in bench.notices() if one.text)

    bench.on()
    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield said
    finally:
        ends.set()
        thread.join()
        bench.kill()


def mission_text() -> str:
    rows = [
        f"{k} {int(k == 0)} 3 16 {k / 3} 0.1 {-k / 7} 0.25 {47.4 + k * 1e-5:.7f} "
        f"{8.5 - k * 1e-5:.7f} {k / 9} 1"
        for k in range(20)
    ]
    return "\n".join(["QGC WPL 110", *rows, ""])


async def first(stream: AsyncIterator[Any], wanted: Callable[[Any], bool]) -> Any:
    async with asyncio.timeout(LIMIT):
        async for one in stream:
            if wanted(one):
                return one
    return None


async def until(holds: Callable[[], object]) -> None:
    async with asyncio.timeout(LIMIT):
        while not holds():  # noqa: ASYNC110 - a thread makes it true
            await asyncio.sleep(0.01)


@asynccontextmanager
async def client(url: str, *ids: str) -> AsyncIterator[Any]:
    """MAVSDK in a process of its own, which is killed at the end, as `kill -9` does."""
    port = free_port(socket.SOCK_STREAM)
    program = Path(mavsdk.__file__).parent / "bin" / "mavsdk_server"
    words = [program, "-p", str(port), *ids, url]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL)  # noqa: ASYNC220
    try:
        system = mavsdk.System(mavsdk_server_address="127.0.0.1", port=port)
        async with asyncio.timeout(LIMIT):
            await system.connect()
        yield system
    finally:
        process.kill()
        process.wait()


def text_of_eighths() -> str:
    """Return a mission whose numbers are the same after a way through MAVProxy's file.

    It writes six to eight digits behind the point.
    """
    rows = [
        f"{k} {int(k == 0)} 3 16 {k / 8:.8f} 0.12500000 {-k / 8:.8f} 0.25000000 "
        f"{47.4 + k * 1e-5:.8f} {8.5 - k * 1e-5:.8f} {k / 8:.6f} 1"
        for k in range(20)
    ]
    return "\n".join(["QGC WPL 110", *(row.replace(" ", "\t") for row in rows), ""])


def bits(one: Any) -> bytes:
    """Return an item as it travels."""
    numbers = one.param1, one.param2, one.param3, one.param4, one.z
    whole = one.seq, one.frame, one.command, one.autocontinue, one.x, one.y
    return struct.pack("<5f6i", *numbers, *whole)


def follow(air: Any) -> None:
    """Be a vehicle that is at once where and what it is asked to be."""
    out = air.outputs
    air.inputs.armed, air.inputs.in_mode = out.arm, out.mode
    if out.setpoint[0] == 84:
        air.inputs.x = out.setpoint[2:5]


async def set_parameters(station: Any) -> None:
    """Read one of two parameters, set it, and read both."""
    assert await station.param.get_param_float("GAIN") == 1.5
    await station.param.set_param_float("GAIN", 2.25)
    assert await station.param.get_param_float("GAIN") == 2.25
    everything = (await station.param.get_all_params()).float_params
    found = {one.name: one.value for one in everything}
    assert found == {"SPEED_MAX": 3.0, "GAIN": 2.25}


def test_mavsdk_steers_a_subsystem(tmp_path: Path) -> None:
    port = free_port()
    rmod = tmp_path / "piloted.rmod"
    rmod.write_text(
        PILOTED.read_text().replace("EOF", "LOCAL")
        + f"mav_ground.ADDRESS udpout:127.0.0.1:{port}\n"
        + "mav_ground.PARAMS SPEED_MAX=3 GAIN=1.5\nEOF\n"
    )
    at = {"nparam": 2, "lla": [0.8, 0.15, 400.0], "battery": 15.2, "fix": 3}
    air = Bench.of(rmod, {**at, "nrc": 4, "att": [1.0, 0, 0, 0]})

    async def fly(said: list[str]) -> None:
        async with client(f"udpin://127.0.0.1:{port}") as station:
            await steer(station)
        await until(lambda: air.outputs.mode == HOLD)
        assert any("no station for 2.5" in one for one in said)
        assert any("no pilot" in one for one in said)
        assert not air["RC_MEZ"].any()

    async def steer(station: Any) -> None:
        seen = station.telemetry
        await first(station.core.connection_state(), lambda one: one.is_connected)
        await first(seen.attitude_quaternion(), lambda one: one.w == 1.0)
        await first(seen.battery(), lambda one: abs(one.voltage_v - 15.2) < 1e-3)
        at = await first(seen.position(), lambda _: True)
        assert at.latitude_deg == pytest.approx(45.8366236)
        await set_parameters(station)
        assert air.outputs.param.tolist() == [3.0, 2.25]
        await exchange_missions(station)
        stick = station.manual_control.set_manual_control_input
        async with asyncio.timeout(LIMIT):
            while air["RC_MEZ"].tolist() != [-0.25, 0.5, 0.75, 1.0]:
                await stick(0.5, -0.25, 0.75, 1.0)
                await asyncio.sleep(0.05)
        await station.action.arm()
        await first(seen.armed(), bool)
        await station.offboard.set_position_ned(PositionNedYaw(1.0, 2.0, -3.0, 30.0))
        await station.offboard.start()
        await first(seen.flight_mode(), lambda one: str(one) == "OFFBOARD")
        await first(
            seen.position_velocity_ned(),
            lambda one: one.position.down_m == -3.0 and one.position.east_m == 2.0,
        )
        assert air.outputs.setpoint[11] == pytest.approx(0.5235988)
        ahead = VelocityBodyYawspeed(2.0, 0.0, 0.0, 0.0)
        await station.offboard.set_velocity_body(ahead)
        await until(lambda: air.outputs.setpoint[5] == 2.0)  # it points north
        await station.action.land()
        await first(seen.flight_mode(), lambda one: str(one) == "LAND")
        assert air.outputs.mode == LAND
        await station.offboard.start()

    async def exchange_missions(station: Any) -> None:
        given = [
            MissionItem(k, 6, 16, int(k == 0), 1, k / 3, 0.1, -k / 7, 0.25,
                        473977000 + k * 123, 85456000 - k * 321, k / 9, 0)
            for k in range(20)
        ]  # fmt: skip
        await station.mission_raw.upload_mission(given)
        heights = [np.float32(k / 9) for k in range(20)]
        # The vehicle answers before it keeps them.
        await until(
            lambda: [one.z for one in air.module.parts[0]._mission.items] == heights
        )
        got = await station.mission_raw.download_mission()
        assert [bits(one) for one in got] == [bits(one) for one in given]

    with running(air, follow) as said:
        asyncio.run(fly(said))


class Capture:
    """Hears what pbonet sends to the port of a program that was killed."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._parser: Any = common.MAVLink(None)
        self._names: list[str] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def names(self) -> list[str]:
        """Return the names of all messages since the beginning, or since `forget`.

        With a command, its number.
        """
        with suppress(BlockingIOError):
            while data := self._socket.recv(2048):
                messages = self._parser.parse_buffer(data) or []
                ours = [one for one in messages if one.get_srcSystem() != OTHER]
                self._names += [
                    f"{one.get_type()} {getattr(one, 'command', '')}".rstrip()
                    for one in ours
                ]
        return self._names

    def forget(self) -> None:
        self.names().clear()


async def point_and_grip(craft: Any, base: Any) -> None:
    """MAVSDK's own codec reads our messages, and writes those of a gimbal."""
    at = await AsyncPluginManager.create(host="127.0.0.1", port=craft._port)
    direct = MavlinkDirectServer(at)

    async def sends(name: str, **fields: Any) -> None:
        told = MavlinkMessage(name, 1, 191, 0, 0, json.dumps(fields))
        await direct.send_message(told)

    async def gets(name: str, wanted: Callable[[Any], bool]) -> Any:
        def fits(m: Any) -> bool:
            return wanted(json.loads(m.fields_json))

        return json.loads((await first(direct.message(name), fits)).fields_json)

    base["GIMBAL_DES"] = [1.0, 0.0, 0.0, 0.0]
    asked = await gets("COMMAND_LONG", lambda m: m["command"] == 1001)
    assert (asked["param1"], asked["param2"]) == (255, 190)
    us = {"primary_control_sysid": 255, "primary_control_compid": 190}
    await sends(
        "GIMBAL_MANAGER_STATUS", time_boot_ms=0, flags=0, gimbal_device_id=1,
        secondary_control_sysid=0, secondary_control_compid=0, **us,
    )  # fmt: skip
    point = await gets("GIMBAL_MANAGER_SET_ATTITUDE", lambda _: True)
    assert (point["q"], point["flags"]) == ([1, 0, 0, 0], 4 | 8 | 32)
    base["SETPOINT"] = SPOT
    spot = await gets("SET_POSITION_TARGET_LOCAL_NED", lambda _: True)
    assert (spot["x"], spot["y"], spot["z"], spot["type_mask"]) == (1, 2, -3, 3576)
    base["ACT_DES"] = [0.25, 0.0]
    grip = await gets("COMMAND_LONG", lambda m: m["command"] == 187)
    assert (grip["param1"], grip["param2"]) == (0.25, 0)
    raw = {f"servo{k}_raw": 1000 + k for k in range(1, 17)}
    await sends("SERVO_OUTPUT_RAW", time_usec=0, port=0, **raw)
    await until(lambda: base["PULSE_MEZ"][3] == pytest.approx(1004e-6))


async def arm_and_change_mode(craft: Any, base: Any) -> None:
    vehicle = base.module.parts[0]
    asked = vehicle._commands._asked
    base["ARM_CMD"] = 1
    await until(lambda: vehicle._was_armed and 400 not in asked)
    await craft.action_server.set_allowable_flight_modes(
        AllowableFlightModes(*[True] * 7)
    )
    changes = craft.action_server.flight_mode_change()
    changed = asyncio.create_task(first(changes, lambda one: one.name == "OFFBOARD"))
    base["MODE_CMD"] = OFFBOARD >> 16  # it does not say that it is of PX4
    await changed
    await until(lambda: 176 not in asked)


async def hears_nothing_that_moves(base: Any, port: int) -> None:
    """Once a vehicle that was killed is missed, no set-point leaves."""
    with Capture(port) as capture:
        await until(lambda: "SET_POSITION_TARGET_LOCAL_NED" in capture.names())
        await until(lambda: base.illegal)
        assert base["LINK_AGE"] >= 2.5
        capture.forget()
        await until(lambda: capture.names().count("HEARTBEAT") == 3)
        allowed = {"HEARTBEAT", "TIMESYNC", f"COMMAND_LONG {INTERVAL}"}
        assert set(capture.names()) <= allowed


def test_a_subsystem_steers_mavsdk(tmp_path: Path) -> None:
    """Its vehicle's side has the component 191, and begins when it hears a vehicle."""
    port = free_port()
    (tmp_path / "plan.waypoints").write_text(mission_text())
    rmod = tmp_path / "craft.rmod"
    text = CRAFT.read_text().replace(
        "mav_mission\n", "mav_mission mav_gimbal mav_actuator\n"
    )
    text = text.replace("MODE_CMD", "MODE_CMD GIMBAL_DES ACT_DES")
    text = text.replace("WP_COUNT", "WP_COUNT GIMBAL_MEZ GIMBAL_OURS PULSE_MEZ")
    rmod.write_text(
        text.replace("EOF", "LOCAL")
        + f"mav_vehicle.ADDRESS udpout:127.0.0.1:{port}\nmav_vehicle.WAIT 0\n"
        + "mav_params.WATCH SPEED GAIN\nmav_params.WANT GAIN=2.25\n"
        + "mav_mission.FILE plan.waypoints\n"
        + "".join(f"mav_{one}.COMPONENT 191\n" for one in PARTS)
        + "EOF\n"
    )
    sizes = {"nparam": 2, "nact": 2, "npulse": 4}
    base = Bench.of(rmod, sizes, library=[tmp_path])
    parser: Any = common.MAVLink(None, OTHER, 1)
    other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def awake(_: Any) -> None:
        beat = parser.heartbeat_encode(2, 12, 0, 0, 4, 3).pack(parser)
        other.sendto(beat, ("127.0.0.1", port))

    async def fly() -> None:
        ids = "--sysid", "1", "--compid", "1"
        async with client(f"udpin://127.0.0.1:{port}", *ids) as craft:
            await serve(craft)
        await hears_nothing_that_moves(base, port)

    async def serve(craft: Any) -> None:
        given = asyncio.create_task(
            first(craft.mission_raw_server.incoming_mission(), lambda _: True)
        )
        await craft.param_server.provide_param_float("SPEED", 3.0)
        await craft.param_server.provide_param_float("GAIN", 1.5)
        await craft.action_server.set_armable(True, True)
        told = telemetry_server
        place = told.PositionNed(1.0, 2.0, -3.0), told.VelocityNed(0.5, 0.25, -1.0)
        async with asyncio.timeout(LIMIT):  # it sends nothing to ends not yet heard
            while base["X_MEZ"].tolist() != [1.0, 2.0, -3.0] or base["BATT"] != 16.0:
                await craft.telemetry_server.publish_position_velocity_ned(
                    told.PositionVelocityNed(*place)
                )
                await craft.telemetry_server.publish_battery(told.Battery(16.0, 50.0))
                await asyncio.sleep(0.1)
        assert base["X^_MEZ"].tolist() == [0.5, 0.25, -1.0]
        await until(lambda: base["PARAM"].tolist() == [3.0, 2.25])
        assert await craft.param_server.retrieve_param_float("GAIN") == 2.25
        await until(lambda: base["WP_COUNT"] == 20)  # read back, equal to the bit
        given.cancel()
        await point_and_grip(craft, base)
        await arm_and_change_mode(craft, base)

    try:
        with running(base, awake) as said:
            asyncio.run(fly())
    finally:
        other.close()
    refused = [one for one in said if "command 400" in one or "command 176" in one]
    assert refused == [], "they were accepted"


class Proxy:
    """MAVProxy on a link, in a folder of its own."""

    def __init__(self, port: int, folder: Path) -> None:
        self._log = folder / "out.log"
        program = Path(sys.executable).with_name("mavproxy.py")
        modules = "--default-modules=mode,param,wp,arm,cmdlong"
        words = [sys.executable, program, f"--master=udpin:127.0.0.1:{port}", modules]
        words += [f"--state-basedir={folder}", f"--logfile={folder / 'x.tlog'}"]
        with self._log.open("w") as out:
            self.process = subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=out, stderr=out, cwd=folder
            )

    def __call__(self, text: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{text}\n".encode())
        self.process.stdin.flush()

    def says(self, text: str) -> bool:
        return text in self._log.read_text(errors="replace")

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


def steered(proxy: Proxy, air: Any) -> bool:
    """Let MAVProxy send a set-point; return whether it has come."""
    proxy("attitude 1 0 0 0 0.5")
    return bool(air.outputs.setpoint[0] == 82 and air.outputs.setpoint[9] == 0.5)


def test_mavproxy_steers_a_subsystem(tmp_path: Path) -> None:
    pytest.importorskip("MAVProxy", reason="pip install --group mavproxy")
    port = free_port()
    air = Bench(
        MavGround,
        {"nparam": 2, "lla": [0.8, 0.15, 400.0], "att": [1.0, 0, 0, 0]},
        params={
            "address": f"udpout:127.0.0.1:{port}",
            "params": ("SPEED_MAX=3", "GAIN=1.5"),
        },
    )
    (tmp_path / "plan.txt").write_text(text_of_eighths())
    with running(air, follow):
        proxy = Proxy(port, tmp_path)
        try:
            wait_for(lambda: proxy.says("Received 2 parameters"), "its parameters")
            proxy("param set GAIN 2.5")
            wait_for(lambda: air.outputs.param[1] == 2.5, "the parameter")
            wait_for(lambda: steered(proxy, air), "an attitude set-point")
            proxy("arm throttle")
            wait_for(lambda: air.outputs.arm == 1, "arming")
            proxy("long DO_SET_MODE 1 4 6")
            wait_for(lambda: air.outputs.mode == LAND, "the mode")
            proxy("wp load plan.txt")
            wait_for(lambda: len(air.module._mission.items) == 20, "the mission")
            proxy("wp save back.txt")
            wait_for(lambda: proxy.says("Saved 20 waypoints to back.txt"), "it again")
            rows, back = (
                [[float(one) for one in row.split()] for row in text.splitlines()[1:]]
                for text in (text_of_eighths(), (tmp_path / "back.txt").read_text())
            )
            assert back == rows
        finally:
            proxy.close()
        wait_for(lambda: air.outputs.age > 2.5, "that it is missed")
