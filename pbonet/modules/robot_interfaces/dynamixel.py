"""Dynamixel servos on one line, that go to positions."""

from contextlib import suppress
from math import pi
from typing import Annotated as A, Any

import numpy as np

from pbonet import Vector, param
from pbonet.errors import DeviceError, ParameterError
from pbonet.io.drivers import Mode, Wait, open_device
from pbonet.modules._axes import Follow, Joints, PositionAxes, Speed
from pbonet.modules._over_device import HeardOf
from pbonet.modules._values import PerElement, spread

REV_PER_MIN = 0.229
"""One unit of a servo's speed."""
WATCHDOG_S = 0.02
"""One unit of its watchdog."""
TORQUE_AT, WATCH_AT = 2, 3
"""Cycles after the first measurement in which torque and watchdog are switched on."""


class Servos(Joints, kw_only=True):
    """The servos, and what their numbers mean."""

    device: A[str, param("none", "device of agent.toml", device=True)]
    zero: A[PerElement, param("rad", "position of the axis where a servo shows 0")] = (
        0.0,
    )
    counts: A[PerElement, param("none", "a servo's units for one turn", gt=0)] = (
        4096.0,
    )
    torque: A[
        PerElement, param("N*m", "of the servo for one unit of its current", ge=0)
    ] = (0.0,)
    speed: Speed = (1.0,)
    follow: Follow = 20.0
    hold: A[bool, param("none", "whether servos have torque while it is not ON")] = True
    beat: A[
        float, param("s", "silence after which a servo stops", ge=0.02, le=2.54)
    ] = 0.2
    silent: A[float, param("s", "longest time without a position", gt=0)] = 0.2


class Dynamixel(PositionAxes[Servos], HeardOf[Servos]):
    """r moves by clip(follow * (q_ref - r), -speed, speed) * dt; servos go to r.

    r begins where the servos are. The device is of the driver `dynamixel`, with these
    `registers` of the X series, address and bytes: [98, 1], [64, 1], [116, 4],
    [126, 2], [128, 4], [132, 4]. READY says when the servos have torque and follow.

    While the reference is too old or the configuration is illegal r stays. When the
    task is turned off, also for a twin that takes over, and when it fails, is killed or
    dies, the servos stay at r with their torque, or with HOLD no are limp. A servo
    stops by itself when it hears nothing for BEAT (its bus watchdog). After SILENT
    seconds without a position, and when a servo reports an error, the task ends in
    ERROR.
    """

    _fixed = frozenset({
        *("gear", "device", "zero", "counts", "torque", "hold", "beat", "silent")
    })
    _outputs: tuple[Any, ...] = ()
    """Watchdogs, torques and goals of the servos."""

    def init(self) -> None:
        k, n = self.params, len(self.q)
        super().init()
        if not self._gear.all():
            raise ParameterError("a gear is 0", expected="turns of the servo for one")
        self._zero = spread(k.zero, n, "zero")
        self._per_rad = spread(k.counts, n, "counts") * self._gear / (2.0 * pi)
        self._per_speed = self._gear * 60.0 / (2.0 * pi * REV_PER_MIN)
        self._per_unit = spread(k.torque, n, "torque") * self._gear
        self._begin()

    def on(self) -> None:
        super().on()
        self._begin()

    def cycle(self, dt: float) -> None:
        if not self._is_sound():
            return
        self._sense()
        if self.ready:
            self._wish(dt)
        self._act()

    def stable(self, dt: float) -> None:  # noqa: ARG002 - r stays
        """Let r stay where it is."""
        self._sense()
        self._act()

    def off(self) -> None:
        self.ready = 0

    def _begin(self) -> None:
        """Begin with servos that have to be asked where they are, and switched on."""
        self._knows, self._done, self.ready = False, 0, 0

    def _sense(self) -> None:
        """Take what the servos have measured, if it has come."""
        raw = self._device.read()
        if raw:
            current, speed, place = np.array(raw, dtype=np.float64).reshape(3, -1)
            np.multiply(current, self._per_unit, out=self.tau)
            np.divide(speed, self._per_speed, out=self.qd)
            np.divide(place, self._per_rad, out=self.q)
            self.q += self._zero
            if not self._knows:
                self._rest()
                self._knows = True
        self._note(new=bool(raw))

    def _act(self) -> None:
        """Send r; the servos get torque when they have it, and not before."""
        if not self._knows:
            return
        watchdog, torque, goal = self._outputs
        n = len(self.q)
        if self._done == 0:
            watchdog.write([0] * n)  # one that has stopped its servo refuses goals
        else:
            raw: Vector = np.rint((self._goal - self._zero) * self._per_rad)
            goal.write(raw.astype(int).tolist())
        if self._done == TORQUE_AT:
            torque.write([1] * n)
        elif self._done == WATCH_AT:
            watchdog.write([round(self.params.beat / WATCHDOG_S)] * n)
        elif self._done > WATCH_AT:
            self.ready = 1
        self._done += 1

    def _open(self) -> Any:  # noqa: ANN401 - its class is that of the driver
        name, n = self.params.device, len(self.q)
        limp = None if self.params.hold else [0] * n
        way: dict[str, Any] = {"wait": Wait.NONE, "signed": True}
        try:
            for k, safe in enumerate((None, limp, None)):
                first, last = k * n, (k + 1) * n - 1
                self._outputs += (
                    open_device(name, first, last, mode=Mode.WRITE, safe=safe, **way),
                )
            return open_device(name, 3 * n, 6 * n - 1, mode=Mode.READ, **way)
        except Exception:
            self._close_outputs()
            raise

    def _opened(self) -> list[Any]:
        return [*super()._opened(), *self._outputs]

    def _give_up(self) -> None:
        super()._give_up()
        self._close_outputs()

    def _close_outputs(self) -> None:
        outputs, self._outputs = self._outputs, ()
        for device in outputs:
            with suppress(DeviceError):  # it may be lost
                device.close()

    def _longest(self) -> float:
        return self.params.silent

    def _take_limits(self) -> None:
        self._speed = spread(self.params.speed, len(self.q), "speed")
        self._follow = self.params.follow
