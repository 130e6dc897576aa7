"""A simulation's sensors for a MAVLink autopilot, and what its motors are to do."""

from math import atan2, degrees, isfinite, tau
from typing import Annotated as A, Any

import numpy as np

from pbonet import InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.io import MavLink
from pbonet.modules._mavlink import GCS, Every, Owner
from pbonet.modules._quaternion import matrix_of
from pbonet.modules._values import keep

SIMULATOR = 200
"""Our component id."""
ARMED = 128
GAUSS = 1e4
"""Of a tesla."""
ALL_BUT_AIRSPEED = 0x1BFF
"""Fields of HIL_SENSOR that are sent: all but the differential pressure."""
SEA_LEVEL, LAPSE, WARM = 1013.25, 0.0065, 288.15
"""hPa, K/m and K of the standard atmosphere at the sea."""
EXPONENT = 5.25588
KELVIN = 273.15
THINNEST, DEEPEST = 11_000.0, -1_000.0
"""m between which that holds."""
FIX_3D, SATELLITES, BLUR = 3, 12, 30
"""Of the simulated receiver; BLUR is its uncertainty in cm."""


class Simulation(Params):
    """The link, the rates on it, and the place."""

    address: A[
        str,
        param("none", "tcpin:, udpin:, udpout:, tcp: HOST:PORT, or serial:DEVICE"),
    ]
    vehicle: A[int, param("none", "system id of the autopilot", ge=1, le=255)] = 1
    system: A[int, param("none", "our system id", ge=1, le=255)] = 42
    key: A[str, param("none", "file of the passphrase that signs frames")] = ""
    rate: A[float, param("Hz", "HIL_SENSOR a second", gt=0)] = 250.0
    gps_rate: A[float, param("Hz", "HIL_GPS a second", gt=0)] = 5.0
    silent: A[float, param("s", "older controls count as 0", gt=0)] = 0.5
    lost_after: A[float, param("s", "without a message it is lost", gt=0)] = 2.5
    field: A[
        tuple[float, float, float],
        param("T", "magnetic field there: north, east, down"),
    ] = (21.5e-6, 1.2e-6, 42.7e-6)


class MavHil(PortBasedObject[Simulation], module_class="subsystem interface"):
    """HIL_SENSOR, HIL_GPS of a simulated vehicle; ACT_CMD = the autopilot's controls.

    An autopilot (PX4 in HIL or SITL) flies the vehicle that another module simulates,
    such as MuJoCo's. It sees ACC and the rates as they are, FIELD in the body's axes,
    and the pressure of the standard atmosphere; latitude, longitude, altitude and
    velocity by the satellites. All have the time at which they were measured. While an
    input is stale, nothing is sent.

    ACT_CMD are HIL_ACTUATOR_CONTROLS within -1 and 1 while the autopilot is armed, else
    0, and 0 is what is not finite. Without new ones for SILENT it is 0. Without any
    message of the autopilot for LOST_AFTER it is lost: the illegal-configuration flag
    is up, and ACT_CMD stays 0 until the task is turned off and on again, also when the
    autopilot is back. ACT_CMD has the time of its arrival. In `stable`, sensors go on
    and ACT_CMD is 0.
    """

    acc: A[
        Vector,
        InVar("ACC", "3", "m/s^2", "what an accelerometer measures", max_age=0.1),
    ]
    rates: A[Vector, InVar("ATT^_MEZ", "3", "rad/s", "body rates", max_age=0.1)]
    att: A[Vector, InVar("ATT_MEZ", "4", "none", "attitude w x y z", max_age=0.1)]
    v: A[Vector, InVar("X^_MEZ", "3", "m/s", "velocity, NED", max_age=0.1)]
    lla: A[
        Vector,
        InVar("LLA_MEZ", "3", "mixed", "latitude, longitude rad, m", max_age=0.1),
    ]
    act: A[Vector, OutVar("ACT_CMD", "nact", "none", "controls, -1 to 1", new=True)]
    armed: A[int, OutVar("ACT_ARMED", "1", "none", "1 while it is armed", new=True)]
    age: A[float, OutVar("LINK_AGE", "1", "s", "since its last message", new=True)]
    bad: A[
        Vector,
        OutVar("LINK_BAD", "3", "none", "damaged, refused, foreign frames", new=True),
    ]

    def init(self) -> None:
        k = self.params
        link = MavLink(k.address, k.system, SIMULATOR, peer=k.vehicle, key=k.key)
        self._owner, self._link = Owner(self.task, link), link
        self._owner.poll()  # what is wrong is said at once
        self._renew()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"address", "system", "vehicle", "key"})
        self._renew()

    def on(self) -> None:
        self._lost = self._link.alive = False
        self._heard_ns = self._moved_ns = 0
        self._began_ns = self.task.now
        self._rest()

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the clock tells
        self._exchange()
        now = self.task.now
        if (m := self._link.newest("HIL_ACTUATOR_CONTROLS")) is not None:
            self._moved_ns = now
            self.armed = int(bool(m.mode & ARMED))
            controls = m.controls[: len(self.act)] if self.armed else ()
            self.act[:] = 0.0
            for k, value in enumerate(controls):
                self.act[k] = min(max(value, -1.0), 1.0) if isfinite(value) else 0.0
        silent = now - self._moved_ns > self.params.silent * 1e9
        if self._lost or silent:
            if self.armed and not self._lost:
                self.task.warn(
                    f"autopilot {self.params.vehicle}: no controls for "
                    f"{self.params.silent:g} s: ACT_CMD is 0"
                )
            self._rest()
        else:
            self.task.stamp_ns = self._moved_ns

    def stable(self, dt: float) -> None:  # noqa: ARG002
        """Go on with sensors alone."""
        self._exchange()
        self._rest()

    def off(self) -> None:
        if not self.task.handover:
            self._rest()

    def kill(self) -> None:
        if link := getattr(self, "_link", None):
            link.close()

    def _renew(self) -> None:
        k = self.params
        self._beat = Every(1.0)
        self._sensors, self._places = Every(k.rate), Every(k.gps_rate)
        self._field = np.array(k.field) * GAUSS

    def _rest(self) -> None:
        self.act[:] = 0.0
        self.armed = 0
        self.task.stamp_ns = self.task.now

    def _exchange(self) -> None:
        """Receive, send what was measured, and judge whether the autopilot is there."""
        now, link = self.task.now, self._link
        self._owner.poll()
        if self._beat.due(now):
            link.send(link.mav.heartbeat_encode(GCS, 8, 0, 0, 4, 3))
        if link.has("HEARTBEAT") or link.has("HIL_ACTUATOR_CONTROLS"):
            self._heard_ns = now
        self.age = (now - (self._heard_ns or self._began_ns)) * 1e-9
        if self._heard_ns and not self._lost and self.age > self.params.lost_after:
            self._lost = True
            self.task.illegal(
                f"autopilot {self.params.vehicle}: no message for {self.age:.3g} s"
            )
        link.alive = bool(self._heard_ns) and not self._lost
        self._send_measurements(now)
        self._owner.count(self.bad)

    def _send_measurements(self, now: int) -> None:
        ports = "acc", "rates", "att", "v", "lla"
        if any(map(self.task.stale, ports)):
            return
        if self._sensors.due(now):
            self._link.send(self._sensor_message(self._time_of("acc", "rates", "att")))
        if self._places.due(now):
            self._link.send(self._place_message(self._time_of("v", "lla")))

    def _time_of(self, *ports: str) -> int:
        """Return when the oldest of some inputs was measured, in microseconds."""
        age_ns = round(max(map(self.task.age, ports)) * 1e9)
        return max(self.task.now - age_ns, 0) // 1000

    def _sensor_message(self, time_us: int) -> Any:  # noqa: ANN401
        w, x, y, z = self.att.tolist()
        field = self._field @ matrix_of((w, x, y, z))  # into the body's axes
        height = min(max(float(self.lla[2]), DEEPEST), THINNEST)
        warmth = WARM - LAPSE * height
        pressure = SEA_LEVEL * (warmth / WARM) ** EXPONENT
        return self._link.mav.hil_sensor_encode(
            time_us, *self.acc.tolist(), *self.rates.tolist(), *field.tolist(),
            pressure, 0.0, height, warmth - KELVIN, ALL_BUT_AIRSPEED,
        )  # fmt: skip

    def _place_message(self, time_us: int) -> Any:  # noqa: ANN401
        lat, lon, alt = self.lla.tolist()
        north, east, down = self.v.tolist()
        speeds = [_whole(100.0 * one, 32767) for one in (north, east, down)]
        speed = min(round(100.0 * (north * north + east * east) ** 0.5), 65534)
        course = round(degrees(atan2(east, north) % tau) * 100) % 36000
        return self._link.mav.hil_gps_encode(
            time_us, FIX_3D, round(degrees(lat) * 1e7), round(degrees(lon) * 1e7),
            round(alt * 1e3), BLUR, BLUR, speed, *speeds, course, SATELLITES,
        )  # fmt: skip


def _whole(value: float, most: int) -> int:
    return min(max(round(value), -most), most)
