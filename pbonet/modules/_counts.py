"""Position and speed from the counter of an encoder."""

from math import pi
from typing import TYPE_CHECKING, Annotated as A, Any, NamedTuple, TypeVar

import numpy as np

from pbonet import OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError

from ._values import PerElement, spread

if TYPE_CHECKING:
    from collections.abc import Sequence


class Scale(Params, kw_only=True):
    """The meaning of a count, for each encoder or for all."""

    counts: A[
        PerElement, param("none", "counts of one turn of the encoder; minus reverses")
    ]
    gear: A[PerElement, param("none", "turns of the encoder for one of Q", gt=0)] = (
        1.0,
    )
    zero: A[PerElement, param("rad", "position at count 0, and at the index")] = (0.0,)
    bits: A[int, param("none", "bits after which a counter wraps", ge=2, le=32)] = 32
    lag: A[float, param("s", "time constant of the speed; 0 for none", ge=0)] = 0.0


S = TypeVar("S", bound=Scale)
Whole = np.ndarray[Any, np.dtype[np.int64]]
Flags = np.ndarray[Any, np.dtype[np.bool_]]


class Reading(NamedTuple):
    """The counters and the index inputs in one cycle."""

    places: "Sequence[int]"
    at_index: "Sequence[int]"
    """Not 0 while an encoder is at its index; empty where there is none."""


class Counts(PortBasedObject[S], abstract=True, module_class="sensor"):
    """The law of an encoder; a module says where the counts come from."""

    q: A[Vector, OutVar("Q_MEZ", "n", "rad", "measured position", new=True)]
    qd: A[Vector, OutVar("Q^_MEZ", "n", "rad/s", "measured speed", new=True)]
    homed: A[
        Vector,
        OutVar("HOMED", "n", "none", "1 since the index was passed, else 0", new=True),
    ]

    _at_index: Flags
    _last: Whole | None = None
    """The counters in the last cycle."""

    def init(self) -> None:
        self._forget()
        self._take_scale()
        super().init()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        if name not in {"counts", "gear", "zero", "lag"}:
            raise ParameterError(
                f"parameter {name} is read when the task is created",
                remedy="kill the task and spawn it again",
            )
        self._take_scale()

    def on(self) -> None:
        super().on()
        self.homed[:] = self._homed
        self._rate[:] = self.qd

    def cycle(self, dt: float) -> None:
        counts, index = self._read(dt)
        moved = self._moved(counts)
        if index:
            self._pass_index(index)
        np.multiply(self._per_count, self._total, out=self.q)
        self.q += self._zero
        lag = self.params.lag
        share = dt / (lag + dt) if lag else 1.0
        self._rate += share * (moved * self._per_count / dt - self._rate)
        self.qd[:] = self._rate
        self.homed[:] = self._homed

    def _moved(self, counts: "Sequence[int]") -> Vector:
        """Add what the counters have moved since the last cycle, and return it.

        A counter moves by less than half of its range in a cycle.
        """
        full, half = 1 << self._bits, 1 << (self._bits - 1)
        now = np.array(counts, dtype=np.int64)
        if self._last is None:
            # An absolute encoder has its place at once; an incremental one has 0.
            self._total[:] = (now + half) % full - half
            self._last = now
        moved = (now - self._last + half) % full - half
        self._total += moved
        self._last = now
        return moved.astype(np.float64)

    def _pass_index(self, index: "Sequence[int]") -> None:
        """Make the place where an index input rises the zero, to one cycle's motion."""
        at = np.array(index) != 0
        passed = at & ~self._at_index
        self._total[passed] = 0
        self._homed[passed] = 1.0
        self._at_index = at

    def _forget(self) -> None:
        """Forget where the counters were: they may have begun again at 0."""
        n = len(self.q)
        self._bits = self.params.bits
        self._last = None
        self._total: Whole = np.zeros(n, dtype=np.int64)
        self._homed: Vector = np.zeros(n)
        self._rate: Vector = np.zeros(n)
        self._at_index = np.ones(n, dtype=np.bool_)

    def _read(self, dt: float) -> Reading:
        """Return counts and index inputs."""
        raise NotImplementedError  # abstract: the module and its twin have their own

    def _take_scale(self) -> None:
        k, n = self.params, len(self.q)
        counts, gear = spread(k.counts, n, "counts"), spread(k.gear, n, "gear")
        if not counts.all():
            raise ParameterError(
                "an encoder has 0 counts for a turn",
                expected="its counts, four times its lines with a quadrature counter",
                remedy="see its data sheet",
            )
        self._per_count = 2.0 * pi / (counts * gear)
        self._zero = spread(k.zero, n, "zero")
