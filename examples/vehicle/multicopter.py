"""A simulated multicopter with its autopilot, for `mav_ground`."""

from math import cos, radians, sin
from typing import Annotated as A

import numpy as np

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._quaternion import (  # noqa: PLC2701 - as pbonet's own modules
    Quaternion,
    matrix_of,
    product,
    quaternion_of,
)

GRAVITY = 9.81
ATTITUDE, POSITION = 82, 84
OFFBOARD, HOLD, LAND = 6 << 16, 4 << 16 | 3 << 24, 4 << 16 | 6 << 24
MISSION = 4 << 16 | 4 << 24
"""PX4's modes."""
INERTIA = np.array((0.03, 0.03, 0.05))
NEAR = 1e-3
"""m above the ground that count as on it."""
LEAN = radians(35.0)
"""The autopilot's largest lean."""
EARTH = 6_371_000.0


class Craft(Params):
    """The craft, and the gains of its autopilot."""

    mass: A[float, param("kg", "mass", gt=0)] = 1.5
    drag: A[float, param("N*s/m", "drag at 1 m/s", ge=0)] = 0.25
    lag: A[float, param("s", "time constant of the motors", gt=0)] = 0.03
    home: A[
        tuple[float, float, float],
        param("none", "latitude and longitude in degrees, altitude in m"),
    ] = (47.397742, 8.545594, 488.0)
    kx: A[float, param("1/s", "gain of position", gt=0)] = 1.5
    kv: A[float, param("1/s", "gain of velocity", gt=0)] = 3.0
    ka: A[float, param("1/s", "gain of attitude", gt=0)] = 10.0
    kr: A[float, param("1/s", "gain of rates", gt=0)] = 25.0


class Multicopter(PortBasedObject[Craft], module_class="robot interface"):
    """m v' = m g - T z - drag v, J w' = torque - w x J w, and a cascade that steers it.

    In OFFBOARD it follows SETPOINT; when that asks for nothing it changes to hold. In
    MISSION it follows SETPOINT, too. LAND
    descends and disarms on the ground. It arms and disarms there alone, when ARM_CMD
    changes. PARAM is the largest speed and the speed of landing. Without a fresh
    SETPOINT, and while the configuration is illegal, it holds its place.
    """

    setpoint: A[
        Vector,
        InVar("SETPOINT", "13", "mixed", "what is asked", max_age=1.0, stale="stable"),
    ]
    arm: A[int, InVar("ARM_CMD", "1", "none", "1 arms, 0 disarms")]
    mode: A[int, InVar("MODE_CMD", "1", "none", "mode to set")]
    limits: A[Vector, InVar("PARAM", "2", "any", "largest speed, speed of landing")]
    att: A[Vector, OutVar("ATT_MEZ", "4", "none", "attitude w x y z", new=True)]
    rates: A[Vector, OutVar("ATT^_MEZ", "3", "rad/s", "body rates", new=True)]
    x: A[Vector, OutVar("X_MEZ", "3", "m", "position, NED", new=True)]
    v: A[Vector, OutVar("X^_MEZ", "3", "m/s", "velocity, NED", new=True)]
    lla: A[
        Vector, OutVar("LLA_MEZ", "3", "mixed", "latitude, longitude, rad, m", new=True)
    ]
    in_mode: A[int, OutVar("MODE", "1", "none", "mode it is in", new=True)]
    armed: A[int, OutVar("ARMED", "1", "none", "1 while it is armed", new=True)]
    battery: A[float, OutVar("BATT", "1", "V", "voltage", new=True)]
    fix: A[int, OutVar("GPS_FIX", "1", "none", "3: 3D", new=True)]

    def on(self) -> None:
        """Stand on the ground where the table says, disarmed."""
        self._q: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self.x[2] = 0.0
        self.v[:] = self.rates[:] = 0.0
        self._thrust, self._torque = 0.0, np.zeros(3)
        self._was_arm, self._was_mode = self.arm, self.mode
        self.armed, self.in_mode = 0, HOLD
        self._yaw, self._landed = 0.0, 0.0
        self._place = self.x.copy()
        self.battery, self.fix = 16.8, 3
        self._write()

    def cycle(self, dt: float) -> None:
        """Obey, steer and fly."""
        self._obey(dt)
        self._steer_by_mode()
        self._fly(dt)

    def stable(self, dt: float) -> None:
        """Hold the place, or go on landing."""
        if self.in_mode in {OFFBOARD, MISSION}:
            self._change(HOLD)
        self._steer_by_mode()
        self._fly(dt)

    # -- what is asked ----------------------------------------------------------------

    def _obey(self, dt: float) -> None:
        if self.arm != self._was_arm:
            self._was_arm = self.arm
            if self._on_ground():
                self.armed = int(bool(self.arm))
        asked = bool(self.setpoint[0])
        if self.mode != self._was_mode:
            self._was_mode = self.mode
            if self.mode in {HOLD, LAND, MISSION} or (self.mode == OFFBOARD and asked):
                self._change(self.mode)
        if self.in_mode == OFFBOARD and not asked:
            self._change(HOLD)
        down = self.in_mode == LAND and self._on_ground()
        self._landed = self._landed + dt if down else 0.0
        if self._landed > 1.0:
            self.armed = 0

    def _change(self, mode: int) -> None:
        self.in_mode = mode
        self._place[:] = self.x

    def _on_ground(self) -> bool:
        return bool(self.x[2] >= -NEAR)

    # -- the autopilot ----------------------------------------------------------------

    def _steer_by_mode(self) -> None:
        """Compute the thrust and the torques that are wanted."""
        follows = self.in_mode in {OFFBOARD, MISSION}
        kind = int(self.setpoint[0]) if follows else 0
        if not self.armed:
            self._wanted, self._turn = 0.0, np.zeros(3)
        elif kind == ATTITUDE:
            share = float(self.setpoint[9])
            wanted = self.setpoint[2:6] / np.linalg.norm(self.setpoint[2:6])
            self._wanted = 2.0 * self.params.mass * GRAVITY * share
            self._turn_to(tuple(wanted.tolist()))
        else:
            self._lean_to(self._velocity(kind))

    def _velocity(self, kind: int) -> Vector:
        """Return the velocity that is wanted."""
        speed, landing = self.limits.tolist()
        mask, goal = int(self.setpoint[1]), self._place
        ahead = np.zeros(3)
        if kind == POSITION:
            if not mask & 0x400:
                self._yaw = float(self.setpoint[11])
            ahead = self.setpoint[5:8] if not mask & 0x038 else ahead
            goal = self.setpoint[2:5]
        wanted: Vector = ahead.copy()
        if kind != POSITION or not mask & 0x007:
            wanted += self.params.kx * (goal - self.x)
        if self.in_mode == LAND:
            wanted[2] = landing
        size = float(np.linalg.norm(wanted))
        return wanted * min(1.0, speed / size) if size else wanted

    def _lean_to(self, velocity: Vector) -> None:
        """Compute the thrust and the attitude that bring the craft to a velocity."""
        k = self.params
        push = -k.kv * (velocity - self.v)
        push[2] += GRAVITY
        push[2] = max(push[2], 0.3 * GRAVITY)
        side = float(np.hypot(push[0], push[1]))
        most = push[2] * np.tan(LEAN)
        push[:2] *= min(1.0, most / side) if side else 1.0
        down = push / np.linalg.norm(push)
        ahead = np.array((cos(self._yaw), sin(self._yaw), 0.0))
        right = np.cross(down, ahead)
        right /= np.linalg.norm(right)
        body: Matrix = np.column_stack((np.cross(right, down), right, down)).astype(
            np.float64
        )
        self._wanted = k.mass * float(push @ self._body()[:, 2])
        self._turn_to(quaternion_of(body))

    def _turn_to(self, goal: tuple[float, ...]) -> None:
        k, (w, x, y, z) = self.params, self._q
        e = product((w, -x, -y, -z), (goal[0], goal[1], goal[2], goal[3]))
        error = 2.0 * np.copysign(1.0, e[0]) * np.array(e[1:])
        self._turn = INERTIA * k.kr * (k.ka * error - self.rates)

    # -- the craft --------------------------------------------------------------------

    def _body(self) -> Matrix:
        return matrix_of(self._q)

    def _fly(self, dt: float) -> None:
        k, share = self.params, min(1.0, dt / self.params.lag)
        self._thrust += share * (max(self._wanted, 0.0) - self._thrust)
        self._torque += share * (self._turn - self._torque)
        turning = np.cross(self.rates, INERTIA * self.rates)
        self.rates += dt * (self._torque - turning) / INERTIA
        half = 0.5 * dt * self.rates
        q = np.array(product(self._q, (1.0, *half.tolist())))
        w, x, y, z = (q / np.linalg.norm(q)).tolist()
        self._q = w, x, y, z
        push = -self._thrust * self._body()[:, 2] - k.drag * self.v
        push[2] += k.mass * GRAVITY
        self.v += dt * push / k.mass
        self.x += dt * self.v
        if self.x[2] >= 0.0 and self.v[2] >= 0.0:
            self._touch()
        self._write()

    def _touch(self) -> None:
        """Stand on the ground, level and still."""
        self.x[2] = 0.0
        self.v[:] = self.rates[:] = 0.0
        self._q = (cos(self._yaw / 2), 0.0, 0.0, sin(self._yaw / 2))

    def _write(self) -> None:
        lat, lon, alt = self.params.home
        self.att[:] = self._q
        north, east, down = self.x.tolist()
        self.lla[0] = radians(lat) + north / EARTH
        self.lla[1] = radians(lon) + east / EARTH / cos(radians(lat))
        self.lla[2] = alt - down
