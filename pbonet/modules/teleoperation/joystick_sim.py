"""The simulated twin of a joystick."""

from typing import Annotated as A

from pbonet import param
from pbonet.modules._values import PerElement
from pbonet.modules._wave import Wave

from ._joystick_ports import Feel, Sticks


class Push(Feel):
    """How the axes are pushed, and which buttons are held."""

    mean: A[PerElement, param("none", "mean push of each axis, 1 for the full one")] = (
        0.0,
    )
    amplitude: A[PerElement, param("none", "of a sine, in the same unit")] = (0.0,)
    period: A[float, param("s", "of the sine", gt=0)] = 10.0
    held: A[int, param("none", "buttons that are held, one bit each", ge=0)] = 0


class JoystickSim(Sticks[Push]):
    """a = mean + amplitude * sin(2 pi t / period), and AXES as `joystick` makes of it.

    It has the ports of `joystick`, and opens no device: swap the two.
    """

    def init(self) -> None:
        super().init()
        self._take_push()

    def set(self, name: str, value: object) -> None:
        super().set(name, value)
        if name in {"mean", "amplitude", "period"}:
            self._take_push()

    def cycle(self, dt: float) -> None:
        self._show(self._wave.after(dt), self.params.held)

    def _take_push(self) -> None:
        k = self.params
        self._wave = Wave(k.mean, k.amplitude, k.period, self.y.size)
