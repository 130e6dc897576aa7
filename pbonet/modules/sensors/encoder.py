"""Encoders: position and speed from the counters of a device."""

from typing import Annotated as A, Any

from pbonet import param
from pbonet.io.drivers import Mode, open_device
from pbonet.modules._counts import Counts, Reading, Scale
from pbonet.modules._over_device import OverDevice


class Place(Scale, kw_only=True):
    """Where the encoders are connected, and what their counts mean."""

    device: A[str, param("none", "device of agent.toml", device=True)]
    port: A[int, param("none", "port of the first counter", ge=0)] = 0
    index: A[
        int, param("none", "port of the first index input; minus 1 for none", ge=-1)
    ] = -1


class Encoder(Counts[Place], OverDevice[Place]):
    """q = zero + 2 pi * count / (counts * gear), and qd its change in a cycle.

    A counter that wraps is followed as long as it moves by less than half of its range
    in a cycle; the range is that of the port, or of BITS if that is less. The first
    reading is the position, as of an absolute encoder. With INDEX, the place where the
    index input becomes 1 is ZERO, as exact as the motion of one cycle, and HOMED says
    that it was passed. Off and on again, the task goes on from where it was; after the
    device was lost, or another task's, it begins again.
    """

    def _open(self) -> Any:  # noqa: ANN401 - its class is that of the driver
        k, more = self.params, len(self.q) - 1
        self._forget()
        device = open_device(k.device, k.port, k.port + more, mode=Mode.READ)
        self._bits = min(k.bits, device.status("PORTSIZE", k.port))
        if k.index >= 0:
            try:
                self._index = open_device(
                    k.device, k.index, k.index + more, mode=Mode.READ
                )
            except Exception:
                device.close()
                raise
        return device

    def _opened(self) -> list[Any]:
        index = self._index
        return [*super()._opened(), *([] if index is None else [index])]

    def _give_up(self) -> None:
        super()._give_up()
        self._forget_index()

    def _forget_index(self) -> None:
        index, self._index = self._index, None
        if index is not None:
            index.close()

    def _read(self, dt: float) -> Reading:  # noqa: ARG002 - what is there now
        index = self._index
        return Reading(self._device.read(), () if index is None else index.read())

    _index: Any = None
