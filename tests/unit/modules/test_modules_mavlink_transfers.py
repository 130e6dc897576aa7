"""Parameters and missions over MAVLink, also where datagrams are lost and late."""

from __future__ import annotations

import heapq
import random
import struct
from math import inf, nan
from pathlib import Path
from typing import Any

import pytest
from test_modules_mavlink import STEP, Wire, free_port, ground, texts

import pbonet.modules
from pbonet.errors import MethodError, ParameterError
from pbonet.io import MavLink
from pbonet.modules._mavlink_mission import Item, Upload, exact, read_mission
from pbonet.modules._mavlink_parameters import ParameterClient
from pbonet.modules.robot_interfaces.mav_mission import MavMission
from pbonet.modules.robot_interfaces.mav_params import MavParams, wishes
from pbonet.modules.subsystem_interfaces.mav_ground import MavGround
from pbonet.testing import Bench, FakeClock

CRAFT = Path(pbonet.modules.__file__).parent / "robot_interfaces" / "mav_craft.rmod"
MISSION = 4 << 16 | 4 << 24


def mission_text(count: int = 20) -> str:
    """Return a mission of a ground station, with values that have no exact decimals."""
    chance = random.Random(1)
    rows = ["QGC WPL 110"]
    for k in range(count):
        p = "\t".join(repr(chance.uniform(-10, 10)) for _ in range(4))
        x, y = 47.3977 + k * 1.23e-5, 8.5456 - k * 3.21e-5
        rows.append(f"{k}\t{int(k == 0)}\t3\t16\t{p}\t{x:.7f}\t{y:.7f}\t{k / 3!r}\t1")
    return "\n".join(rows) + "\n"


class Air:
    """What lies between two ends: 5 % loss, about 200 ms, duplicates, another order."""

    def __init__(self, clock: FakeClock, *, bad: bool = True) -> None:
        self.base, self.craft = Wire(), Wire()
        self.craft.peer = None
        self._clock, self._bad, self._chance = clock, bad, random.Random(5)
        self._late: list[tuple[int, int, bytes, Wire]] = []
        self._number = 0

    def pump(self) -> None:
        now = self._clock()
        for one, other in ((self.base, self.craft), (self.craft, self.base)):
            while True:
                try:
                    data, one.peer = one.socket.recvfrom(4096)
                except BlockingIOError:
                    break
                for _ in range(1 + (self._bad and self._chance.random() < 0.05)):
                    self._number += 1
                    wait = int(self._chance.gauss(2e8, 3e7)) if self._bad else 0
                    if not self._bad or self._chance.random() > 0.05:
                        item = now + wait, self._number, data, other
                        heapq.heappush(self._late, item)
        while self._late and self._late[0][0] <= now:
            _, _, data, to = heapq.heappop(self._late)
            if to.peer:
                to.socket.sendto(data, to.peer)


class Flight:
    """A vehicle's side and a station's, and the air between them."""

    def __init__(self, tmp_path: Path, *, bad: bool, local: str = "") -> None:
        (tmp_path / "plan.waypoints").write_text(mission_text())
        self.clock = FakeClock()
        self.between = Air(self.clock, bad=bad)
        rmod = tmp_path / "craft.rmod"
        rmod.write_text(
            CRAFT.read_text().replace("EOF", "LOCAL")
            + f"mav_vehicle.ADDRESS udpout:127.0.0.1:{self.between.base.port}\n"
            + "mav_vehicle.WAIT 0\nmav_params.WATCH SPEED GAIN\n"
            + f"mav_mission.FILE plan.waypoints\n{local}\nEOF\n"
        )
        self.base = Bench.of(rmod, {"nparam": 2}, library=[tmp_path], clock=self.clock)
        self.air = Bench(
            MavGround,
            {"nparam": 2, "att": [1.0, 0, 0, 0], "lla": [0.827, 0.149, 488.0]},
            params={
                "address": f"udpout:127.0.0.1:{self.between.craft.port}",
                "params": ("SPEED=3", "GAIN=0.5"),
            },
            clock=self.clock,
        )
        self.air.on()
        self.base.on()

    def run(self, holds: Any, seconds: float = 90.0) -> float:
        for k in range(round(seconds / STEP)):
            if holds():
                return k * STEP
            self.base.step(STEP / 2)
            self.between.pump()
            self.air.step(STEP / 2)
            self.between.pump()
        raise AssertionError(f"not within {seconds} s: {texts(self.base)}")

    def close(self) -> None:
        self.base.kill()
        self.air.kill()


@pytest.mark.parametrize("bad", [False, True])
def test_parameters_and_missions_complete(tmp_path: Path, bad: bool) -> None:
    both = Flight(tmp_path, bad=bad, local="mav_params.WANT GAIN=0.1")
    base, air = both.base, both.air
    both.run(lambda: base["PARAM_LEFT"] == 0 and base["WP_COUNT"] == 20)
    assert base["PARAM"].tolist() == pytest.approx([3.0, 0.1])
    assert air.outputs.param[1] == struct.unpack("<f", struct.pack("<f", 0.1))[0]
    wanted = read_mission(mission_text(), "")
    got = air.module._mission.items
    assert [exact(one) for one in got] == [exact(one) for one in wanted]
    base.set("mav_params.want", "SPEED=2.5")
    both.run(lambda: air.outputs.param[0] == 2.5)
    base.set("mav_params.known", "all")
    both.run(lambda: base["PARAM_LEFT"] == 0)
    assert base.get("mav_params.known") == "GAIN=0.100000001 SPEED=2.5"
    assert texts(base) == []
    both.close()


def test_nothing_is_given_while_the_flag_is_up(tmp_path: Path) -> None:
    both = Flight(tmp_path, bad=False, local="mav_params.WANT GAIN=0.25")
    both.base.illegal = True
    for _ in range(300):
        both.base.step(STEP / 2)
        both.between.pump()
        both.air.step(STEP / 2)
        both.between.pump()
    assert both.air.outputs.param.tolist() == [3.0, 0.5]
    assert both.base["PARAM"].tolist() == [3.0, 0.5], "they are read"
    assert both.air.module._mission.items == []
    both.base.illegal = False
    both.run(lambda: both.base["WP_COUNT"] == 20 and both.air.outputs.param[1] == 0.25)
    both.close()


class Ends:
    """A client of parameters, and a vehicle with one of a type."""

    def __init__(self, kind: int, *, bytewise: bool = False) -> None:
        self.sent: list[Any] = []
        self._kind, self._here = kind, list[Any]()
        self.peer, self.mav, self.send = 1, Wire().mav, self.sent.append
        link: Any = self
        self.client = ParameterClient(link, 1)
        self.client.bytewise = bytewise

    def all_of(self, _: str) -> list[Any]:
        return self._here

    def answer(self, told: float) -> None:
        m = self.mav.param_value_encode(b"N", told, self._kind, 1, 0)
        m._header.srcComponent = 1
        self._here = [m]


@pytest.mark.parametrize(
    ("bytewise", "kind", "value", "sent"),
    [
        (True, 6, 7.0, struct.unpack("<f", struct.pack("<i", 7))[0]),
        (False, 6, 7.4, 7.0),
        (True, 9, 0.25, 0.25),
    ],
)
def test_whole_numbers_travel_as_the_autopilot_has_them(
    bytewise: bool, kind: int, value: float, sent: float
) -> None:
    ends = Ends(kind, bytewise=bytewise)
    client = ends.client
    client.wanted = {"N": value}
    client.run(0)
    assert ends.sent[-1].get_type() == "PARAM_REQUEST_READ"
    ends.answer(0.0)
    client.run(10**9)
    assert ends.sent[-1].get_type() == "PARAM_SET"
    assert ends.sent[-1].param_value == pytest.approx(sent)
    assert client.left == 1
    ends.answer(ends.sent[-1].param_value)
    client.run(2 * 10**9)
    assert client.left == 0


@pytest.mark.parametrize("bytewise", [False, True])
@pytest.mark.parametrize(
    ("kind", "value"),
    [(1, 300), (1, -1), (2, 128), (3, 65536), (4, -32769), (5, -1), (6, 2**31)],
)
def test_a_wish_out_of_its_range_is_dropped_and_said_once(
    bytewise: bool, kind: int, value: float
) -> None:
    ends = Ends(kind, bytewise=bytewise)
    client = ends.client
    client.wanted = {"N": float(value)}
    ends.answer(0.0)
    (said,) = client.run(0)
    assert "parameter N is not set" in said
    assert (client.run(10**9), client.left, client.wanted) == ([], 0, {})
    assert "PARAM_SET" not in [m.get_type() for m in ends.sent]


def test_a_value_that_is_no_number_is_not_taken() -> None:
    ends = Ends(9)
    ends.client.watched = ("N",)
    ends.answer(nan)
    ends.client.run(0)
    assert (ends.client.known, ends.client.left) == ({}, 1)
    whole = Ends(6, bytewise=True)  # -1 has the bytes of a NaN
    whole.answer(nan)
    whole.client.run(0)
    assert "N" in whole.client.known


def test_a_station_writes_reads_and_clears_the_mission() -> None:
    port, station = free_port(), Wire(255, 190)
    air = ground(port)

    def ask(message: Any) -> Any:
        station.send(message, to=port)
        air.step(STEP)
        kinds = {"COUNT", "REQUEST_INT", "ITEM_INT", "ACK"}
        found = [m for m in station.receive() if m.get_type()[8:] in kinds]
        return found[0] if found else None

    mav, items = station.mav, read_mission(mission_text(3), "")
    assert ask(mav.mission_count_encode(1, 1, 501)).type == 4
    asked = ask(mav.mission_count_encode(1, 1, 3))
    for seq in (0, 1, 2):
        assert (asked.get_type(), asked.seq) == ("MISSION_REQUEST_INT", seq)
        asked = ask(mav.mission_item_int_encode(1, 1, seq, *items[seq]))
    assert (asked.get_type(), asked.type) == ("MISSION_ACK", 0)
    assert ask(mav.mission_request_list_encode(1, 1)).count == 3
    assert ask(mav.mission_request_int_encode(1, 1, 2)).seq == 2
    assert ask(mav.mission_request_int_encode(1, 1, 3)).type == 13
    assert ask(mav.mission_count_encode(1, 1, 1)).seq == 0
    air.step(STEP, 2000)  # the station goes away in the middle
    station.receive()
    assert ask(mav.mission_request_list_encode(1, 1)).count == 3
    assert ask(mav.mission_clear_all_encode(1, 1)).type == 0
    assert ask(mav.mission_request_list_encode(1, 1)).count == 0
    air.kill()


def test_a_mission_is_flown_item_by_item() -> None:
    air = ground(free_port())
    text = """QGC WPL 110
0 1 1 22 0 0 0 0 0 0 -3 1
1 0 1 16 0.5 0 0 0 4 0 -3 1
2 0 1 178 0 0 0 0 0 0 0 1
3 0 1 16 0 0 0 0 4 4 -3 1
4 0 1 21 0 0 0 0 0 0 0 1
"""
    air.module._mission.items = read_mission(text, "")
    air.inputs.armed, air.inputs.in_mode = 1, MISSION
    goals: list[list[float]] = []
    for _ in range(400):
        air.step(STEP)
        if air.outputs.mode == 100925440:
            break
        goal = air.outputs.setpoint[2:5].tolist()
        if air.outputs.setpoint[0] and (not goals or goals[-1] != goal):
            goals.append(goal)
        air.inputs.x = air.inputs.x + 0.1 * (air.outputs.setpoint[2:5] - air.inputs.x)
    assert goals[0] == [0.0, 0.0, -3.0]
    assert [4.0, 0.0, -3.0] in goals
    assert goals[-1] == [4.0, 4.0, -3.0]
    assert (air.outputs.mode, air.outputs.item) == (100925440, 4), "it lands"
    air.kill()


@pytest.mark.parametrize(
    ("sender", "system", "ends"),
    [(1, 255, True), (1, 0, True), (1, 254, False), (100, 255, False)],
)
def test_only_an_answer_to_us_of_the_vehicle_ends_an_upload(
    sender: int, system: int, ends: bool
) -> None:
    port, wire = free_port(), Wire()
    link = MavLink(f"udpin:127.0.0.1:{port}", 255, 190, peer=1)
    link.poll(1)
    upload = Upload(link, (1, 1), read_mission(mission_text(1), ""), 1)
    mav = wire.mav
    wire.send(mav.mission_request_int_encode(255, 190, 0), to=port)
    link.poll(1)
    upload.run(1)
    ack = mav.mission_ack_encode(system, 190 if system else 0, 0)
    wire.send(Wire(1, sender).pack(ack), to=port)
    link.poll(1)
    upload.run(1)
    assert (upload.result == 0) == ends
    link.close()


HERE = 458366236, 85943669  # 0.8 and 0.15 rad, where `ground` is


def flown(
    frame: int, command: int, place: tuple[int, int], z: float, ages: Any = ()
) -> Any:
    """Return a vehicle in a mission of one item, 5 m above its point of departure."""
    air = ground(free_port())
    air.module._mission.items = [Item(frame, command, 0, 1, 0, 0, 0, nan, *place, z)]
    air.inputs.armed, air.inputs.in_mode = 1, MISSION
    air.inputs.x = [10.0, 20.0, -5.0]
    air.ages.update(dict(ages))
    air.step(STEP)
    return air


@pytest.mark.parametrize(
    ("frame", "command", "place", "z", "goal"),
    [
        (1, 16, (50_000, 60_000), -7.0, (5.0, 6.0, -7.0)),
        (4, 16, (60_000, 50_000), 7.0, (5.0, 6.0, -7.0)),
        (0, 16, HERE, 402.0, (10.0, 20.0, -7.0)),
        (5, 16, HERE, 402.0, (10.0, 20.0, -7.0)),
        (3, 16, HERE, 7.0, (10.0, 20.0, -7.0)),
        (6, 16, HERE, 7.0, (10.0, 20.0, -7.0)),
        (0, 22, HERE, 415.0, (10.0, 20.0, -20.0)),
        (3, 22, (0, 0), 20.0, (10.0, 20.0, -20.0)),
        (1, 22, (0, 0), -20.0, (10.0, 20.0, -20.0)),
    ],
)
def test_items_are_flown_in_their_frames(
    frame: int, command: int, place: tuple[int, int], z: float, goal: tuple[float, ...]
) -> None:
    air = flown(frame, command, place, z)
    assert air.outputs.setpoint[2:5] == pytest.approx(goal, abs=0.05)
    if command == 22:
        air.inputs.x = [11.0, 18.0, -6.0]  # the wind
        air.inputs.lla = [0.8, 0.15, 401.0]
        air.step(STEP)
        assert air.outputs.setpoint[2:5] == pytest.approx(goal, abs=0.05)
    air.kill()


@pytest.mark.parametrize(
    ("frame", "x", "z", "result"),
    [
        (8, 0, 1.0, 2),
        (11, 0, 1.0, 2),
        (2, 0, 1.0, 2),
        (3, 0, nan, 5),
        (3, 0, inf, 5),
        (3, 2_000_000_000, 1.0, 5),
        (3, 450_000_000, 1.0, 0),
        (1, 2_000_000_000, 1.0, 0),
    ],
)
def test_a_mission_that_cannot_be_flown_is_refused(
    frame: int, x: int, z: float, result: int
) -> None:
    port, station = free_port(), Wire(255, 190)
    air, mav = ground(port), station.mav
    last = Item(frame, 16, 0, 1, 0, nan, nan, nan, x, 0, z)
    station.send(mav.mission_count_encode(1, 1, 2), to=port)
    air.step(STEP)
    for seq, item in enumerate((Item(2, 178, 1, 1, nan, 0, 0, 0, 0, 0, nan), last)):
        station.send(mav.mission_item_int_encode(1, 1, seq, *item), to=port)
        air.step(STEP)
    acks = [m.type for m in station.receive() if m.get_type() == "MISSION_ACK"]
    assert acks == [result]
    assert len(air.module._mission.items) == (0 if result else 2)
    air.kill()


def test_a_mission_is_as_old_as_its_position() -> None:
    air = flown(1, 16, (0, 0), -3.0, {"x": 0.3, "lla": 9.0})
    assert air.outputs.setpoint[0] == 84, "a place in NED needs no LLA_MEZ"
    assert air.output_age == pytest.approx(0.3, abs=1e-6)
    air.ages["x"] = 0.6
    air.step(STEP, 5)
    assert not air.outputs.setpoint.any()
    assert texts(air) == ["the position is 0.6 s old: the vehicle holds"]
    air.ages["x"] = 0.0
    air.step(STEP)
    assert air.outputs.setpoint[0] == 84
    air.kill()
    air = flown(3, 16, HERE, 3.0, {"lla": 0.6})
    assert not air.outputs.setpoint.any()
    air.kill()


def test_telemetry_has_the_time_of_the_oldest_input() -> None:
    port, station = free_port(), Wire(255, 190)
    air = ground(port)
    station.send(station.beat(type=6), to=port)
    air.step(1.0)
    air.ages.update(x=0.25, rates=0.5, lla=0.75)
    station.receive()
    air.step(1.0)
    got = {m.get_type(): m for m in station.receive()}
    assert got["LOCAL_POSITION_NED"].time_boot_ms == pytest.approx(1750, abs=1)
    assert got["ATTITUDE_QUATERNION"].time_boot_ms == pytest.approx(1500, abs=1)
    assert got["ATTITUDE"].time_boot_ms == pytest.approx(1500, abs=1)
    assert got["GLOBAL_POSITION_INT"].time_boot_ms == pytest.approx(1250, abs=1)
    assert got["GPS_RAW_INT"].time_usec == pytest.approx(1_250_000, abs=1000)
    air.ages["x"] = 1e9  # never, or long before the boot
    air.step(1.0)
    got = {m.get_type(): m for m in station.receive()}
    assert got["LOCAL_POSITION_NED"].time_boot_ms == 0
    air.kill()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "waypoints\n",
        "QGC WPL 110\n",
        "QGC WPL 110\n0 1 3 16 0\n",
        "QGC WPL 110\n0 1 x 16 0 0 0 0 0 0 0 1\n",
        "QGC WPL 110\n" + "0 1 3 16 0 0 0 0 0 0 0 1\n" * 501,
    ],
)
def test_what_is_no_mission_is_refused(text: str) -> None:
    with pytest.raises(ParameterError, match="this is no mission"):
        read_mission(text, "plan.waypoints")


def test_wishes_are_names_and_values() -> None:
    assert wishes("A=1 B=2.5") == {"A": 1.0, "B": 2.5}
    for text in (
        "A",
        "=1",
        "A=x",
        "A_NAME_THAT_IS_LONG=1",
        "A=nan",
        "A=-inf",
        "A=1e40",
    ):
        with pytest.raises(ParameterError, match="sets no parameter"):
            wishes(text)


def test_a_watched_name_is_one_that_a_parameter_can_have() -> None:
    """Another one would never be read, and `left` never be 0."""
    with pytest.raises(MethodError, match="at most 16 characters, got MPC_XY_VEL_M"):
        Bench(
            MavParams,
            {"system": 1, "nparam": 1},
            params={"watch": ("MPC_XY_VEL_MAXIMUM",)},
        )


@pytest.mark.parametrize("module", [MavParams, MavMission])
def test_parts_need_the_owner_of_the_link(module: Any) -> None:
    params = {"watch": ("A",)} if module is MavParams else {}
    values = {"nparam": 1} if module is MavParams else {}
    with pytest.raises(MethodError, match="combine it with mav_vehicle"):
        Bench(module, {"system": 1, **values}, params=params)
