"""The robot interface of a vehicle that speaks MAVLink, such as PX4 or ArduPilot."""

from collections import deque
from math import cos, radians, sin
from typing import Annotated as A, Any

from pbonet import InVar, OutConst, OutVar, Params, PortBasedObject, Vector, param
from pbonet.io import MavLink, PeerClock
from pbonet.modules._mavlink import (
    GCS,
    Commands,
    Every,
    Owner,
    finite,
    setpoint_message,
)
from pbonet.modules._values import keep

STATION = 190
"""Our component id: that of a ground station."""
ARM, MODE, INTERVAL = 400, 176, 511
"""Commands: arm or disarm, set the mode, set the interval of a message."""
PX4 = 12
WANTED = {
    31: "ATTITUDE_QUATERNION",
    32: "LOCAL_POSITION_NED",
    33: "GLOBAL_POSITION_INT",
}
"""Messages that are asked for, until they come."""
WARNING = 4
"""The severity from which a text of the vehicle is a warning."""
UNKNOWN_MV = 65535
ODD_NS = 60_000_000_000
"""A measurement that is older than this is worth a warning."""
FIXED = {"address", "system", "component", "station", "key", "telemetry", "wait"}
"""Parameters that are read when the task is created."""


class Link(Params):
    """The link, and the rates on it."""

    address: A[str, param("none", "udpin:, udpout:, tcp: HOST:PORT, or serial:DEVICE")]
    system: A[int, param("none", "system id of the vehicle", ge=1, le=255)] = 1
    component: A[int, param("none", "that of its autopilot", ge=1, le=255)] = 1
    station: A[int, param("none", "our own system id", ge=1, le=255)] = 255
    key: A[str, param("none", "file of the passphrase that signs frames")] = ""
    lost_after: A[float, param("s", "without a heartbeat it is lost", gt=0)] = 2.5
    rate: A[float, param("Hz", "set-points a second", ge=2)] = 20.0
    telemetry: A[float, param("Hz", "attitude and position asked for", gt=0)] = 50.0
    wait: A[float, param("s", "longest wait for MAV_TYPE in `init`", ge=0)] = 1.5


class MavVehicle(PortBasedObject[Link], module_class="robot interface"):
    """Telemetry of the vehicle out, set-points and commands to it in; SI units, NED.

    ARM_CMD and MODE_CMD are sent when they change while the task is ON, until the
    vehicle answers; what they are at `on` is not sent. A change while the vehicle is
    not there is not sent later either, and a warning says so. SETPOINT is sent RATE
    times a second while it is fresh. Without a heartbeat for LOST_AFTER the vehicle is
    lost: the illegal-configuration flag is up, and no set-point, ARM_CMD or MODE_CMD is
    sent until the task is turned off and on again, also when the vehicle is back; its
    autopilot does what it is set to without set-points. Nothing here disarms by itself.
    In `stable`, telemetry goes on and no set-points are sent.

    The outputs have the time at which the vehicle measured attitude, position and, once
    it has come, LLA_MEZ, the oldest of them, by its own clock (TIMESYNC); before it
    answers, that of arrival. They are too old for any limit until attitude and position
    have come since `on`. MODE and ARMED come with the heartbeat, so LINK_AGE is their
    age; BATT and GPS_FIX have none of their own.
    """

    mav_type: A[int, OutConst("MAV_TYPE", "1", "none", "type of the vehicle, or 0")]
    mav_sys: A[int, OutConst("MAV_SYS", "1", "none", "its system id")]
    setpoint: A[
        Vector,
        InVar("SETPOINT", "13", "mixed", "kind, mask, eleven values", max_age=0.5),
    ]
    arm: A[int, InVar("ARM_CMD", "1", "none", "1 arms, 0 disarms, when it changes")]
    mode: A[int, InVar("MODE_CMD", "1", "none", "mode to set, when it changes")]
    att: A[Vector, OutVar("ATT_MEZ", "4", "none", "attitude w x y z", new=True)]
    rates: A[Vector, OutVar("ATT^_MEZ", "3", "rad/s", "body rates", new=True)]
    x: A[Vector, OutVar("X_MEZ", "3", "m", "position, NED", new=True)]
    v: A[Vector, OutVar("X^_MEZ", "3", "m/s", "velocity, NED", new=True)]
    lla: A[
        Vector,
        OutVar("LLA_MEZ", "3", "mixed", "latitude, longitude rad, m", new=True),
    ]
    in_mode: A[int, OutVar("MODE", "1", "none", "custom mode it is in", new=True)]
    armed: A[int, OutVar("ARMED", "1", "none", "1 while it is armed", new=True)]
    battery: A[float, OutVar("BATT", "1", "V", "voltage of its battery", new=True)]
    fix: A[int, OutVar("GPS_FIX", "1", "none", "2: 2D, 3: 3D and better", new=True)]
    age: A[float, OutVar("LINK_AGE", "1", "s", "since the last heartbeat", new=True)]
    bad: A[
        Vector,
        OutVar("LINK_BAD", "3", "none", "damaged, refused, foreign frames", new=True),
    ]

    def init(self) -> None:
        k = self.params
        link = MavLink(k.address, k.station, STATION, peer=k.system, key=k.key)
        self._owner, self._link = Owner(self.task, link), link
        self._owner.poll()  # what is wrong is said at once
        self._clock, self._commands = PeerClock(), Commands()
        self._asked_ns = deque[int](maxlen=2)  # an answer takes a second at most
        self._beat, self._sync = Every(1.0), Every(1.0)
        self._setpoints = Every(k.rate)
        self._autopilot = 0
        self.mav_sys = k.system
        self.mav_type = self._wait_for_type()

    def reinit(self) -> None:
        self.mav_type = self._wait_for_type()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, FIXED)
        self._setpoints = Every(self.params.rate)

    def on(self) -> None:
        self._lost = self._link.alive = False
        self._heard_ns = 0
        self._began_ns = self.task.now
        self._stamps: dict[str, int] = {}
        self._needed = {"attitude", "position"}
        if self.lla.any():  # it came before, and is old until it comes again
            self._needed.add("global")
        self._quaternions = self._says_old = False
        self._missing = set(WANTED)
        self._was_armed, self._was_mode = self.arm, self.mode
        self._commands.clear()
        self.task.stamp_ns = 1  # older than any limit until something has come

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the clock tells
        self._exchange()
        self._send_changes()
        if self._lost or not self._heard_ns:
            return
        if not self.task.stale("setpoint") and self._setpoints.due(self.task.now):
            message = setpoint_message(
                self._link, self.params.component, self.setpoint, self._boot_ms()
            )
            if message is not None:
                self._link.send(message)

    def stable(self, dt: float) -> None:  # noqa: ARG002
        """Go on without set-points."""
        self._exchange()
        self._send_changes()

    def kill(self) -> None:
        if link := getattr(self, "_link", None):
            link.close()

    def _exchange(self) -> None:
        """Receive, send what keeps the link up, and judge whether it is."""
        now, link = self.task.now, self._link
        self._owner.poll()
        self._take_heartbeat(now)
        self._keep_up(now)
        self._take_telemetry(now)
        self._take_status()
        for problem in self._commands.run(link, now):
            self.task.warn(f"vehicle {self.params.system}: {problem}")
        self._owner.count(self.bad)
        self.age = (now - (self._heard_ns or self._began_ns)) * 1e-9
        if self._heard_ns and not self._lost and self.age > self.params.lost_after:
            self._lost = True
            self._commands.clear()
            self.task.illegal(
                f"vehicle {self.params.system}: no heartbeat for {self.age:.3g} s"
            )
        link.alive = bool(self._heard_ns) and not self._lost
        if self._needed <= self._stamps.keys():
            self.task.stamp_ns = max(min(self._stamps.values()), 1)

    def _take_heartbeat(self, now: int) -> None:
        for beat in self._link.all_of("HEARTBEAT"):
            if beat.type == GCS or beat.get_srcComponent() != self.params.component:
                continue
            self._heard_ns = now
            self._autopilot = beat.autopilot
            self.in_mode = beat.custom_mode & 0x7FFFFFFF
            self.armed = int(bool(beat.base_mode & 128))

    def _take_telemetry(self, now: int) -> None:
        if (m := self._newest("ATTITUDE_QUATERNION")) is not None:
            self._take_attitude(m, (m.q1, m.q2, m.q3, m.q4), now)
        elif (m := self._newest("ATTITUDE")) is not None and (not self._quaternions):
            self._take_attitude(m, _quaternion(m.roll, m.pitch, m.yaw), now)
        if (m := self._newest("LOCAL_POSITION_NED")) is not None and finite(
            m.x, m.y, m.z, m.vx, m.vy, m.vz
        ):
            self.x[:] = m.x, m.y, m.z
            self.v[:] = m.vx, m.vy, m.vz
            self._stamps["position"] = self._time_of(m, now)
        if (m := self._newest("GLOBAL_POSITION_INT")) is not None:
            self.lla[:] = radians(m.lat * 1e-7), radians(m.lon * 1e-7), m.alt * 1e-3
            self._stamps["global"] = self._time_of(m, now)
            self._needed.add("global")

    def _take_attitude(self, m: Any, q: tuple[float, ...], now: int) -> None:  # noqa: ANN401
        rates = m.rollspeed, m.pitchspeed, m.yawspeed
        if finite(*q, *rates):
            self.att[:], self.rates[:] = q, rates
            self._quaternions |= m.get_type() == "ATTITUDE_QUATERNION"
            self._stamps["attitude"] = self._time_of(m, now)

    def _newest(self, name: str) -> Any:  # noqa: ANN401
        """Return the newest message of a kind that the autopilot itself has sent."""
        return self._link.newest(name, self.params.component)

    def _take_status(self) -> None:
        m = self._newest("SYS_STATUS")
        if m is not None and m.voltage_battery != UNKNOWN_MV:
            self.battery = m.voltage_battery * 1e-3
        elif (m := self._newest("BATTERY_STATUS")) is not None:
            self.battery = sum(one for one in m.voltages if one != UNKNOWN_MV) * 1e-3
        if (m := self._newest("GPS_RAW_INT")) is not None:
            self.fix = m.fix_type
        for m in self._link.all_of("STATUSTEXT"):
            if m.severity <= WARNING:
                self.task.warn(f"vehicle {self.params.system}: {_text(m.text)}")

    def _keep_up(self, now: int) -> None:
        """Send heartbeats, and ask for the time and answer with it."""
        link, mav = self._link, self._link.mav
        if self._beat.due(now):
            link.send(mav.heartbeat_encode(GCS, 8, 0, 0, 4, 3))
        if self._missing:
            self._missing -= {n for n in self._missing if link.has(WANTED[n])}
        if self._sync.due(now):
            link.send(mav.timesync_encode(0, now))
            self._asked_ns.append(now)
            for number in self._missing if self._heard_ns else ():
                gap_us = 1e6 / self.params.telemetry
                link.send(self._command(INTERVAL, number, gap_us))
        for m in link.all_of("TIMESYNC"):
            if not m.tc1:
                link.send(mav.timesync_encode(now, m.ts1))
            elif m.get_srcComponent() == self.params.component and (
                m.ts1 in self._asked_ns
            ):
                self._asked_ns.remove(m.ts1)
                self._clock.learn(m.tc1, m.ts1, now)

    def _send_changes(self) -> None:
        """Send ARM_CMD and MODE_CMD where they have changed."""
        if self.arm != self._was_armed:
            self._was_armed = self.arm
            self._ask("ARM_CMD", ARM, float(bool(self.arm)))
        if self.mode != self._was_mode:
            self._was_mode = self.mode
            if self._autopilot == PX4:  # its main mode, then the mode within that
                values = self.mode >> 16 & 0xFF, self.mode >> 24
                self._ask("MODE_CMD", MODE, 1.0, *values)
            else:
                self._ask("MODE_CMD", MODE, 1.0, self.mode)

    def _ask(self, variable: str, command: int, *values: float) -> None:
        """Send a command; one for a vehicle that is not there is not kept for later."""
        if self._heard_ns and not self._lost:
            self._commands.ask(self._command(command, *values), self.task.now)
            return
        self.task.warn(
            f"vehicle {self.params.system} is not there: the change of {variable} is "
            "not sent, also later; change it again when LINK_AGE is small"
        )

    def _command(self, command: int, *values: float) -> Any:  # noqa: ANN401
        filled = [*values, *[0.0] * (7 - len(values))]
        return self._link.mav.command_long_encode(
            self.params.system, self.params.component, command, 0, *filled
        )

    def _time_of(self, m: Any, now: int) -> int:  # noqa: ANN401
        ours = self._clock.ours(m.time_boot_ms * 1_000_000, now)
        if now - ours > ODD_NS and not self._says_old:
            self._says_old = True
            self.task.warn(
                f"vehicle {self.params.system}: what it measures is "
                f"{(now - ours) * 1e-9:.3g} s old by its own clock (TIMESYNC); it has "
                "started again, or its times are of another clock"
            )
        return ours

    def _boot_ms(self) -> int:
        return self.task.now // 1_000_000 & 0xFFFFFFFF

    def _wait_for_type(self) -> int:
        """Return the type of the vehicle when it is heard soon, else what was known."""
        link, steps = self._link, 10
        for _ in range(steps if self.params.wait else 0):
            link.poll(self.task.now)
            for m in link.all_of("HEARTBEAT"):
                if m.type != GCS and m.get_srcComponent() == self.params.component:
                    return int(m.type)
            if link.fault is not None:
                break
            link.send(link.mav.heartbeat_encode(GCS, 8, 0, 0, 4, 3))
            link.wait(self.params.wait / steps)
        return self.mav_type


def _quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, ...]:
    """Return the attitude of angles: about z, then y, then x."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (cos(a / 2), sin(a / 2)) for a in (roll, pitch, yaw)
    )
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _text(text: str | bytes) -> str:
    plain = text.decode("utf-8", "replace") if isinstance(text, bytes) else text
    return plain.rstrip("\0")
