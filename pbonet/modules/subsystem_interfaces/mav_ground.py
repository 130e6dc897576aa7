"""A vehicle on a MAVLink link, for ground stations: pbonet is the vehicle."""

from collections.abc import Callable
from math import asin, atan2, cos, degrees, isfinite, radians, tau
from typing import Annotated as A, Any, Literal, NamedTuple

from pbonet import InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.io import MavLink
from pbonet.modules._mavlink import (
    ACC,
    GCS,
    IN_PROGRESS,
    POSITION,
    YAW,
    YAW_RATE,
    Every,
    Owner,
    V,
    setpoint_of,
)
from pbonet.modules._mavlink_mission import (
    AMSL,
    ENU,
    NED,
    TAKEOFF,
    WAYPOINT,
    Item,
    MissionServer,
)
from pbonet.modules._mavlink_parameters import LONGEST, ParameterServer
from pbonet.modules._values import keep

AUTOPILOT = 1
"""Our component id."""
PX4 = 12
ARM, MODE, LAND, INTERVAL, REQUEST, CAPABILITIES = 400, 176, 21, 511, 512, 520
"""Commands that stations send."""
EARTH = 6_371_000.0
"""Its radius, m."""
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3
CAN = 2 | 4 | 8 | 64 | 128 | 8192
"""Capabilities: floats as parameters, integers in missions and commands, MAVLink 2, and
both kinds of set-points."""
ARMED = 128
PX4_FLAGS = {4: 0x1C, 6: 0x18}
"""Flags of PX4's main modes AUTO and OFFBOARD: stabilized, guided, automatic."""
FASTEST = 1e3
"""Messages of one kind a second that a station may ask for."""
TRIED_NS = 1_000_000_000
"""A command is denied when the vehicle has not followed it by then."""
WARNING, NOTICE = 4, 6
"""The severity of texts to stations."""


class Vehicle(Params):
    """The link, the vehicle, and what it does without stations."""

    address: A[str, param("none", "udpin:, udpout:, tcp: HOST:PORT, or serial:DEVICE")]
    params: A[
        tuple[str, ...],
        param("none", "NAME=VALUE of each parameter that stations may change"),
    ]
    system: A[int, param("none", "our system id", ge=1, le=255)] = 1
    key: A[str, param("none", "file of the passphrase that signs frames")] = ""
    type: A[int, param("none", "MAV_TYPE; 2 is a quadrotor", ge=0, le=255)] = 2
    autopilot: A[int, param("none", "whose modes; 12 is PX4", ge=0, le=255)] = PX4
    rate: A[float, param("Hz", "attitude and position a second", gt=0)] = 20.0
    silent: A[float, param("s", "an older set-point asks for nothing", gt=0)] = 0.5
    lost_after: A[float, param("s", "stations are lost without heartbeat", gt=0)] = 2.5
    lost: A[
        Literal["hold", "land", "continue"],
        param("none", "what an armed vehicle does when all stations are lost"),
    ] = "hold"
    hold_mode: A[int, param("none", "MODE_CMD for that; PX4's hold", ge=0)] = 50593792
    land_mode: A[int, param("none", "MODE_CMD to land; PX4's", ge=0)] = 100925440
    mission_mode: A[int, param("none", "MODE that flies it; PX4's", ge=0)] = 67371008
    reach: A[float, param("m", "from an item that counts as reached", gt=0)] = 1.0


class Pending(NamedTuple):
    """A command that the vehicle has to follow before it is acknowledged."""

    wanted: int
    until_ns: int
    system: int
    component: int


class MavGround(PortBasedObject[Vehicle], module_class="subsystem interface"):
    """Telemetry to ground stations, and their set-points and commands into the table.

    Units and axes as of `mav_vehicle`, whose ports these are seen from the other end: a
    vehicle's controller reads SETPOINT, ARM_CMD and MODE_CMD. SETPOINT has the time of
    arrival; without a new one for SILENT its kind is 0, which asks for nothing. Targets
    are local (NED); velocities may also be in the frame of the body, and are turned by
    the heading that the vehicle has at their arrival. A
    command is accepted when ARMED or MODE is as it says, and denied after 1 s; another
    value takes the place of one that is not yet followed. PARAM are numbers that
    stations change by their names in PARAMS. When no station was heard for LOST_AFTER
    and ARMED is 1, MODE_CMD becomes HOLD_MODE or LAND_MODE, as LOST says.

    Telemetry has the time at which its inputs were measured.

    It keeps a mission. While MODE is MISSION_MODE and ARMED is 1, SETPOINT is the place
    of its item WP_NOW, with the age of the position; its kind is 0 while that is older
    than SILENT. Waypoints are held for the time that they say, a take-off rises where
    it begins; both are in a frame NED, ENU, or with degrees and a height above the sea
    or the point of departure, and a mission with others is refused. Landing makes
    MODE_CMD LAND_MODE, other items are passed over, and after the last one MODE_CMD is
    HOLD_MODE.
    """

    att: A[Vector, InVar("ATT_MEZ", "4", "none", "attitude w x y z")]
    rates: A[Vector, InVar("ATT^_MEZ", "3", "rad/s", "body rates")]
    x: A[Vector, InVar("X_MEZ", "3", "m", "position, NED")]
    v: A[Vector, InVar("X^_MEZ", "3", "m/s", "velocity, NED")]
    lla: A[Vector, InVar("LLA_MEZ", "3", "mixed", "latitude, longitude rad, m")]
    in_mode: A[int, InVar("MODE", "1", "none", "mode that it is in")]
    armed: A[int, InVar("ARMED", "1", "none", "1 while it is armed")]
    battery: A[float, InVar("BATT", "1", "V", "voltage of its battery")]
    fix: A[int, InVar("GPS_FIX", "1", "none", "2: 2D, 3: 3D and better")]
    setpoint: A[
        Vector,
        OutVar("SETPOINT", "13", "mixed", "kind, mask, eleven values", new=True),
    ]
    arm: A[int, OutVar("ARM_CMD", "1", "none", "1 arms, 0 disarms", new=True)]
    mode: A[int, OutVar("MODE_CMD", "1", "none", "mode to set", new=True)]
    param: A[Vector, OutVar("PARAM", "nparam", "any", "parameters", new=True)]
    item: A[int, OutVar("WP_NOW", "1", "none", "item of the mission", new=True)]
    age: A[float, OutVar("LINK_AGE", "1", "s", "since a station's heartbeat", new=True)]
    bad: A[
        Vector,
        OutVar("LINK_BAD", "3", "none", "damaged, refused, foreign frames", new=True),
    ]

    def init(self) -> None:
        k = self.params
        names, values = self._take_parameters()
        link = MavLink(k.address, k.system, AUTOPILOT, key=k.key)
        self._owner, self._link = Owner(self.task, link), link
        self._owner.poll()  # what is wrong is said at once
        self._boot_ns = self.task.now
        self._parameters = ParameterServer(link, names, values)
        self._mission = MissionServer(link, self._note)
        self._kinds: dict[int, Callable[[], Any]] = {
            0: self._heartbeat,
            1: self._status,
            24: self._gps,
            30: self._angles,
            31: self._attitude,
            32: self._local,
            33: self._global,
            42: self._current,
            148: self._version,
        }
        self._streams = {number: Every(rate) for number, rate in self._rates().items()}

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"address", "params", "system", "key", "rate"})

    def on(self) -> None:
        self._pending: dict[int, Pending] = {}
        self._heard_ns = self._asked_ns = 0
        self._began_ns = self.task.now
        self._lost = self._link.alive = False
        self._reached_ns = 0
        self._flown: Item | None = None
        self._start = 0.0, 0.0
        self._blind = self._refused = False
        self.setpoint[:] = 0.0
        self.arm, self.mode = self.armed, self.in_mode  # nothing is asked for yet
        self.param[:] = self._parameters.values

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the clock tells
        now = self.task.now
        self._owner.poll()
        self._mission.run(now, self._is_for_us)
        if self.armed and self.in_mode == self.params.mission_mode:
            self._fly_mission(now)
        else:
            self._flown = None
            self._take_setpoint(now)
        self.item = self._mission.current
        self._take_commands(now)
        self._take_link(now)
        for change in self._parameters.run():
            self._note(f"parameter {change}")
        self.param[:] = self._parameters.values
        for number, every in self._streams.items():
            if every.due(now):
                self._link.send(self._kinds[number]())
        self._owner.count(self.bad)
        self.task.stamp_ns = self._asked_ns if self.setpoint[0] else now

    def off(self) -> None:
        if not self.task.handover:
            self.setpoint[:] = 0.0

    def kill(self) -> None:
        if link := getattr(self, "_link", None):
            link.close()

    # -- what stations want -----------------------------------------------------------

    def _take_setpoint(self, now: int) -> None:
        link = self._link
        for kind in ("SET_POSITION_TARGET_LOCAL_NED", "SET_ATTITUDE_TARGET"):
            m = link.newest(kind)
            if m is None or not self._is_for_us(m):
                continue
            if setpoint_of(m, self.setpoint, _angles(self.att)[2]):
                self._asked_ns = now
            elif not self._refused:
                self._refused = True
                self._say("set-points in this frame, or not finite, do not count")
        if self.setpoint[0] and now - self._asked_ns > self.params.silent * 1e9:
            self.setpoint[:] = 0.0
            self._say(f"no set-point for {self.params.silent:g} s: the vehicle holds")

    def _take_commands(self, now: int) -> None:
        link = self._link
        for m in link.all_of("SET_MODE"):
            if m.target_system == self.params.system:
                self.mode = m.custom_mode & 0x7FFFFFFF
        for kind in ("COMMAND_LONG", "COMMAND_INT"):
            for m in link.all_of(kind):
                if self._is_for_us(m):
                    self._take_command(m, now)
        for command, one in list(self._pending.items()):
            if one.wanted == (
                int(bool(self.armed)) if command == ARM else self.in_mode
            ):
                self._answer(command, ACCEPTED, one.system, one.component)
            elif now > one.until_ns:
                self._answer(command, DENIED, one.system, one.component)

    def _take_command(self, m: Any, now: int) -> None:  # noqa: ANN401
        sender = m.get_srcSystem(), m.get_srcComponent()
        result = UNSUPPORTED
        if m.command in {ARM, MODE, LAND}:
            wanted = self._wanted_by(m)
            if wanted is not None:
                self._follow(m.command, wanted, sender, now)
                return
            result = DENIED
        elif m.command in {INTERVAL, REQUEST, CAPABILITIES}:
            result = self._take_request(m)
        self._acknowledge(m.command, result, *sender)

    def _follow(
        self, command: int, wanted: int, sender: tuple[int, int], now: int
    ) -> None:
        """Ask the vehicle for it, in place of another value that is pending."""
        old = self._pending.get(command)
        if old is not None and old.wanted == wanted:  # sent again until it is answered
            self._acknowledge(command, IN_PROGRESS, *sender)
            return
        if old is not None and (old.system, old.component) != sender:
            self._acknowledge(command, DENIED, old.system, old.component)
        if command == ARM:
            self.arm = wanted
        else:
            self.mode = wanted
        self._pending[command] = Pending(wanted, now + TRIED_NS, *sender)

    def _wanted_by(self, m: Any) -> int | None:  # noqa: ANN401
        """Return what ARM_CMD or MODE_CMD becomes; None: the command asks for none."""
        if m.command == ARM:
            return _whole(m.param1, 1)
        if m.command == LAND:
            return self.params.land_mode
        if self.params.autopilot != PX4:
            return _whole(m.param2, 0x7FFFFFFF)
        main, sub = _whole(m.param2, 0xFF), _whole(m.param3, 0x7F)
        return None if main is None or sub is None else main << 16 | sub << 24

    def _take_request(self, m: Any) -> int:  # noqa: ANN401
        """Send a message once, or change its rate; return the result."""
        number = 148 if m.command == CAPABILITIES else _whole(m.param1, 0xFFFFFF)
        if number is None or (m.command == INTERVAL and not isfinite(m.param2)):
            return DENIED
        if number not in self._kinds:
            return UNSUPPORTED
        if m.command != INTERVAL:
            self._link.send(self._kinds[number]())
            return ACCEPTED
        if number == 0:
            return DENIED  # without heartbeats the vehicle would be lost
        if m.param2 < 0:
            self._streams.pop(number, None)
        elif m.param2 == 0:
            usual = self._rates().get(number)
            self._streams.update({number: Every(usual)} if usual else {})
        else:
            self._streams[number] = Every(min(1e6 / m.param2, FASTEST))
        return ACCEPTED

    def _answer(self, command: int, result: int, system: int, component: int) -> None:
        del self._pending[command]
        self._acknowledge(command, result, system, component)
        if result == DENIED:
            self._say(f"command {command} was not followed")

    def _acknowledge(
        self, command: int, result: int, system: int, component: int
    ) -> None:
        self._link.send(
            self._link.mav.command_ack_encode(command, result, 0, 0, system, component)
        )

    def _is_for_us(self, m: Any) -> bool:  # noqa: ANN401
        return m.target_system in {0, self.params.system}

    def _take_link(self, now: int) -> None:
        """Answer for the time, and judge whether a station is there."""
        link, k = self._link, self.params
        for m in link.all_of("TIMESYNC"):
            if not m.tc1:
                link.send(link.mav.timesync_encode(now - self._boot_ns, m.ts1))
        if any(m.type == GCS for m in link.all_of("HEARTBEAT")):
            self._heard_ns, self._lost = now, False
        self.age = (now - (self._heard_ns or self._began_ns)) * 1e-9
        if self._heard_ns and not self._lost and self.age > k.lost_after:
            self._lost = True
            if self.armed and k.lost != "continue":
                self.mode = k.hold_mode if k.lost == "hold" else k.land_mode
            self._say(f"no station for {self.age:.3g} s: {k.lost}")
        link.alive = bool(self._heard_ns) and not self._lost

    # -- the mission ------------------------------------------------------------------

    def _fly_mission(self, now: int) -> None:
        """Make SETPOINT of the present item, and go on when it is reached."""
        mission = self._mission
        if mission.current >= len(mission.items):
            self.mode = self.params.hold_mode
            return
        one = mission.items[mission.current]
        if one.command == LAND:
            self.mode = self.params.land_mode
            return
        if one.command not in {WAYPOINT, TAKEOFF}:
            self._pass_item()
            return
        if not self._sees(one, now):
            return
        if one is not self._flown:
            self._flown, self._reached_ns = one, 0
            self._start = float(self.x[0]), float(self.x[1])
        goal = self._place_of(one)
        self.setpoint[:] = 0.0
        self.setpoint[0], self.setpoint[1] = POSITION, V | ACC | YAW | YAW_RATE
        self.setpoint[2:5] = goal
        far = sum((a - b) ** 2 for a, b in zip(goal, self.x.tolist(), strict=True))
        if far > self.params.reach**2:
            self._reached_ns = 0
            return
        self._reached_ns = self._reached_ns or now
        hold = one.p1 if one.command == WAYPOINT else 0.0  # of a take-off, the pitch
        if now - self._reached_ns >= hold * 1e9:
            self._pass_item()

    def _pass_item(self) -> None:
        mission, link = self._mission, self._link
        link.send(link.mav.mission_item_reached_encode(mission.current))
        mission.current += 1
        self._flown = None

    def _sees(self, one: Item, now: int) -> bool:
        """Return whether the position that an item needs is new; else ask for nothing.

        Its age is that of the set-point.
        """
        ports = ("x",) if one.frame in {NED, ENU} else ("x", "lla")
        age = max(map(self.task.age, ports))
        old = age > self.params.silent or any(map(self.task.stale, ports))
        if old:
            self.setpoint[:] = 0.0
            if not self._blind:
                self._say(f"the position is {age:.3g} s old: the vehicle holds")
        else:
            self._asked_ns = now - round(age * 1e9)
        self._blind = old
        return not old

    def _place_of(self, one: Item) -> tuple[float, float, float]:
        """Return the place of an item, NED."""
        x, y = one.x * 1e-4, one.y * 1e-4
        if one.frame == NED:
            north, east, down = x, y, one.z
        elif one.frame == ENU:
            north, east, down = y, x, -one.z
        else:
            lat, lon, alt = self.lla.tolist()
            north = self.x[0] + EARTH * (radians(one.x * 1e-7) - lat)
            east = self.x[1] + EARTH * cos(lat) * (radians(one.y * 1e-7) - lon)
            above = self.x[2] + alt if one.frame in AMSL else 0.0
            down = above - one.z  # else above the point of departure
        if one.command == TAKEOFF:
            north, east = self._start
        return float(north), float(east), float(down)

    # -- what stations see ------------------------------------------------------------

    def _rates(self) -> dict[int, float]:
        """Return the messages that are sent unasked, and how many a second."""
        rate = self.params.rate
        return {
            0: 1.0,
            1: 1.0,
            24: 5.0,
            31: rate,
            30: rate,
            32: rate,
            33: rate,
            42: 1.0,
        }

    def _say(self, text: str) -> None:
        """Warn of something here, and at the stations."""
        self.task.warn(text)
        self._note(text, WARNING)

    def _note(self, text: str, severity: int = NOTICE) -> None:
        """Say something at the stations."""
        self._link.send(self._link.mav.statustext_encode(severity, text.encode()[:50]))

    def _boot_ms(self, *ports: str) -> int:
        """Return when the oldest of some inputs was measured, since the boot."""
        up_ns = self.task.now - self._boot_ns
        age = max(map(self.task.age, ports))
        return (up_ns - round(min(age * 1e9, up_ns))) // 1_000_000 & 0xFFFFFFFF

    def _heartbeat(self) -> Any:  # noqa: ANN401
        k = self.params
        base, status = (ARMED | 1, 4) if self.armed else (1, 3)
        if k.autopilot == PX4:  # as its own heartbeats have them, beside the mode
            base |= PX4_FLAGS.get(self.in_mode >> 16 & 0xFF, 0)
        return self._link.mav.heartbeat_encode(
            k.type, k.autopilot, base, self.in_mode, status, 3
        )

    def _status(self) -> Any:  # noqa: ANN401
        volts = min(max(round(self.battery * 1e3), 0), 65534)
        sensors = 0x3F  # gyroscopes to GPS: what the telemetry is made of
        return self._link.mav.sys_status_encode(
            *(sensors, sensors, sensors, 0, volts, -1, -1), *(0, 0, 0, 0, 0, 0)
        )

    def _gps(self) -> Any:  # noqa: ANN401
        lat, lon, alt = _degrees(self.lla)
        north, east, _ = self.v.tolist()
        speed = round(100.0 * (north * north + east * east) ** 0.5)
        course = round(degrees(atan2(east, north) % tau) * 100) % 36000
        return self._link.mav.gps_raw_int_encode(
            self._boot_ms("lla", "v") * 1000, self.fix, lat, lon, alt, 65535, 65535,
            min(speed, 65534), course, 255,
        )  # fmt: skip

    def _attitude(self) -> Any:  # noqa: ANN401
        return self._link.mav.attitude_quaternion_encode(
            self._boot_ms("att", "rates"), *self.att.tolist(), *self.rates.tolist()
        )

    def _angles(self) -> Any:  # noqa: ANN401
        return self._link.mav.attitude_encode(
            self._boot_ms("att", "rates"), *_angles(self.att), *self.rates.tolist()
        )

    def _local(self) -> Any:  # noqa: ANN401
        return self._link.mav.local_position_ned_encode(
            self._boot_ms("x", "v"), *self.x.tolist(), *self.v.tolist()
        )

    def _global(self) -> Any:  # noqa: ANN401
        lat, lon, alt = _degrees(self.lla)
        speeds = [
            min(max(round(100.0 * one), -32767), 32767) for one in self.v.tolist()
        ]
        heading = round(degrees(_angles(self.att)[2] % tau) * 100) % 36000
        above = round(-1e3 * float(self.x[2]))
        return self._link.mav.global_position_int_encode(
            self._boot_ms("lla", "x", "v", "att"),
            lat,
            lon,
            alt,
            above,
            *speeds,
            heading,
        )

    def _current(self) -> Any:  # noqa: ANN401
        return self._link.mav.mission_current_encode(self._mission.current)

    def _version(self) -> Any:  # noqa: ANN401
        none = bytes(8)
        return self._link.mav.autopilot_version_encode(
            CAN, 0, 0, 0, 0, none, none, none, 0, 0, self.params.system
        )

    def _take_parameters(self) -> tuple[list[str], list[float]]:
        """Return names and values of PARAMS.

        Raises:
            ParameterError: One is not NAME=VALUE, or there is another number of them.
        """
        names, values = list[str](), list[float]()
        for text in self.params.params:
            name, _, value = text.partition("=")
            try:
                values.append(float(value))
            except ValueError:
                values.append(float("nan"))
            names.append(name)
            if not 0 < len(name) <= LONGEST or values[-1] != values[-1]:
                raise ParameterError(
                    "this is no parameter of a vehicle",
                    expected=f"NAME=VALUE, with a name of at most {LONGEST} characters",
                    got=text,
                    remedy="correct it, as in SPEED_MAX=3.0",
                )
        if len(names) != len(self.param):
            raise ParameterError(
                "PARAMS has another number of parameters than PARAM has elements",
                expected=f"{len(self.param)} of NAME=VALUE",
                got=str(len(names)),
                remedy="change NELEM of the variable, or PARAMS",
            )
        return names, values


def _whole(value: float, most: int) -> int | None:
    """Return a number of a command; None: it is not whole, or out of range."""
    return int(value) if 0 <= value <= most and value == int(value) else None


def _degrees(lla: Vector) -> tuple[int, int, int]:
    """Return latitude and longitude in 1e-7 degrees, and altitude in mm."""
    lat, lon, alt = lla.tolist()
    return round(degrees(lat) * 1e7), round(degrees(lon) * 1e7), round(alt * 1e3)


def _angles(q: Vector) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of an attitude."""
    w, x, y, z = q.tolist()
    roll = atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = asin(min(max(2 * (w * y - z * x), -1.0), 1.0))
    return roll, pitch, atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
