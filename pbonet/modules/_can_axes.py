"""Axes whose motors have drives on a CAN bus, by CANopen and CiA 402."""

from math import pi
from typing import Annotated as A, Any, ClassVar, TypeVar

import numpy as np

from pbonet import Answer, Vector, param
from pbonet.errors import ParameterError
from pbonet.io.drivers import Frame, Mode as Direction, Wait, open_device

from . import _canopen as canopen
from ._axes import Axes, Joints
from ._drive402 import MEASURED, MORE, Bus, Drive, Mode
from ._over_device import NEVER, OverDevice
from ._values import PerElement, spread

AT_ONCE = 256
"""Frames that are read at once."""
_RANGES = {4: 2**31 - 1, 2: 2**15 - 1}
"""The largest target by its bytes."""


class Wires(Joints, kw_only=True):
    """The drives and what their numbers mean, one value for each drive or for all."""

    device: A[str, param("none", "device of agent.toml", device=True)]
    nodes: A[
        tuple[int, ...], param("none", "numbers of the drives on the bus", ge=1, le=126)
    ]
    counts: A[PerElement, param("none", "a drive's position units for one turn", gt=0)]
    rated: A[PerElement, param("N*m", "rated torque of the motor (6076h)", gt=0)]
    rates: A[
        PerElement,
        param("none", "its speed units for one turn a second; 0: as COUNTS", ge=0),
    ] = (0.0,)
    beat: A[float, param("s", "silence after which a side is lost", ge=0.02, le=10)] = (
        0.1
    )
    master: A[int, param("none", "the task's own number on the bus", ge=1, le=127)] = (
        127
    )


W = TypeVar("W", bound=Wires)


class CanAxes(Axes[W], OverDevice[W], abstract=True):
    """The part that speaks with the drives."""

    _mode: ClassVar[Mode]
    _fixed = frozenset({
        *("gear", "device", "nodes", "counts", "rated", "rates", "beat", "master")
    })

    def init(self) -> None:
        k, n = self.params, len(self.q)
        if len(set(k.nodes)) != n or len(k.nodes) != n:
            raise ParameterError(
                "NODES has another number of drives than Q_MEZ has elements",
                expected=f"{n} different numbers",
                got=" ".join(map(str, k.nodes)),
                remedy="name each drive once, in the order of the axes",
            )
        bus = Bus(self._mode, round(1e3 * self.task.period), k.beat, k.master)
        self._drives = [Drive(node, bus) for node in k.nodes]
        kinds = [MEASURED, MORE, canopen.HEARTBEAT]
        kinds += [canopen.SDO_ANSWER, canopen.EMERGENCY]
        self._by_id = {kind + one.node: one for one in self._drives for kind in kinds}
        self._may_reset, self._beaten = False, 0
        super().init()
        self._take_units()

    def on(self) -> None:
        super().on()
        now = self.task.now
        while len(self._device.read(AT_ONCE)) == AT_ONCE:
            pass  # what waited is old
        for one in self._drives:
            one.begin(now, may_reset=self._may_reset)
        self._may_reset, self.ready = False, 0
        self.task.stamp_ns = NEVER

    def cycle(self, dt: float) -> None:
        if self._is_sound():
            self._exchange(dt, run=True)

    def stable(self, dt: float) -> None:
        """Stop the drives quickly; `cycle` enables them again."""
        self._exchange(dt, run=False)

    def off(self) -> None:
        self._device.write([one.leave() for one in self._drives])
        self.ready = 0

    def clear(self) -> Answer:
        """Allow that faults of the drives are reset when the task is turned on."""
        self._may_reset = True
        return Answer.OFF

    def _open(self) -> Any:  # noqa: ANN401 - its class is that of the driver
        device, safe = self.params.device, [one.stop() for one in self._drives]
        return open_device(device, mode=Direction.RW, wait=Wait.NONE, safe=safe)

    def _exchange(self, dt: float, *, run: bool) -> None:
        """Take what the drives have sent, and send what they are to do."""
        now = self.task.now
        self._take_frames(now)
        follow = run and all(one.follows for one in self._drives)
        if follow:
            self._wish(dt)
        else:
            self._rest()
        frames = self._beat(now)
        goals: list[int] = self._targets()
        for one, goal in zip(self._drives, goals, strict=True):
            frames += one.step(now, goal if follow else one.rest(), run=run)
        self._send(frames)
        self.ready = int(follow)
        if faults := [one.fault for one in self._drives if one.fault]:
            self.task.fail("; ".join(faults))

    def _take_frames(self, now: int) -> None:
        is_all = False
        while not is_all:
            frames: list[Frame] = self._device.read(AT_ONCE)
            for frame in frames:
                if drive := self._by_id.get(frame.id):
                    drive.take(frame, now)
            is_all = len(frames) < AT_ONCE
        oldest = min(one.measured_ns for one in self._drives)
        if oldest:
            self.task.stamp_ns = oldest
            for k, one in enumerate(self._drives):
                self.q[k], self.qd[k], self.tau[k] = one.position, one.speed, one.torque
            self.q /= self._per_turn
            self.qd /= self._per_speed
            self.tau /= self._per_torque

    def _beat(self, now: int) -> list[Frame]:
        """Return a sign of life whenever a quarter of the time has passed."""
        if now - self._beaten < self.params.beat * 0.25e9:
            return []
        self._beaten = now
        return [canopen.heartbeat(self.params.master)]

    def _send(self, frames: list[Frame]) -> None:
        done: int = self._device.write(frames)
        if done < len(frames):
            self.task.fail(
                f"the CAN bus took {done} of {len(frames)} frames: it is overloaded or "
                "not connected; lower FREQ, or raise txqueuelen of the interface"
            )

    def _targets(self) -> list[int]:
        """Return the goal in units of the drives."""
        scale = {
            Mode.POSITION: self._per_turn,
            Mode.SPEED: self._per_speed,
            Mode.TORQUE: self._per_torque,
        }[self._mode]
        most = _RANGES[self._mode.value[2]]
        whole: Vector = np.rint(self._goal * scale).clip(-most, most)
        found: list[int] = whole.astype(int).tolist()
        return found

    def _take_units(self) -> None:
        """Note what the drives' units for a radian, a rad/s and a N*m are."""
        k, n = self.params, len(self.q)
        counts, rates = spread(k.counts, n, "counts"), spread(k.rates, n, "rates")
        if not self._gear.all():
            raise ParameterError("a gear is 0", expected="turns of the motor for one")
        self._per_turn = counts * self._gear / (2.0 * pi)
        self._per_speed = np.where(rates, rates, counts) * self._gear / (2.0 * pi)
        self._per_torque = 1000.0 / (spread(k.rated, n, "rated") * self._gear)
