"""`Spp`: a special purpose processor as a module sees it."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from pbonet.errors import SppError, did_you_mean
from pbonet.io import devices_allowed
from pbonet.outside import Outside
from pbonet.pbo import Counted
from pbonet.xm.ipc import names

from . import batches
from .kernel_library import Variable, find_file
from .transports import InlineTransport, ProcessTransport

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from pbonet.pbo import TaskContext

    from .transports import Transport

DEPTH: Final = 2
"""Batches that may be under way: one that runs, and one that waits."""


class Routine(NamedTuple):
    """A routine of the library, as `Spp.translate` returns it."""

    which: int
    name: str


class Reading:
    """A variable of the library, as `Spp.translate` returns it, and its last value.

    Attributes:
        value: What `Spp.read` transferred last, read-only; None before the first.
        stamp_ns: When that batch was done, as ``self.task.now``; 0 before the first.
        is_stale: Whether the flag is up because of it.
    """

    __slots__ = ("_spp", "index", "is_stale", "name", "stamp_ns", "value", "variable")

    def __init__(self, spp: Spp, index: int, name: str, variable: Variable) -> None:
        self._spp = spp
        self.index, self.name, self.variable = index, name, variable
        self.value: NDArray[Any] | None = None
        self.stamp_ns = 0
        self.is_stale = False

    @property
    def age(self) -> float:
        """Seconds since then; infinite before the first."""
        return self._spp.age_of(self.stamp_ns)


class Spp:
    """A special purpose processor (Stewart 1994, section 7.4); made in ``init``.

    Its constructor is the method `init` of the thesis: it downloads the library to the
    executive, and starts that if need be. `call`, `write` and `read` only fill a batch,
    and `wait` hands it over; none of them waits without a timeout.

    Args:
        name: As in ``[spp.NAME]`` of the agent's ``agent.toml``.
        library: The library of kernels: a file ``NAME.py`` in a folder of modules, or a
            Python module that is installed.
        task: ``self.task``: its clock is that of stamps and ages. Needed in virtual
            time.
        max_age: Seconds; `read` raises the illegal-configuration flag while the value
            is older, so that critical tasks run ``stable``. 0: never.
        depth: Batches that may be under way; another one is refused and counted.
        priority: The order in which waiting clients are served, higher ones first; by
            default the task's criticality.

    Attributes:
        back_end: "numpy", "warp" or "torch".
        device: Where it runs, such as ``cpu`` or ``cuda:0``.
        refused: Batches that were refused as the executive was too slow.
        starts: How often the executive was started; when this grows, all variables of
            the library are zero again.

    Raises:
        SppError: There is no such processor, it does not run, or the library cannot be
            used on it.
    """

    def __init__(
        self,
        name: str,
        library: str,
        *,
        task: TaskContext | None = None,
        max_age: float = 0.0,
        depth: int = DEPTH,
        priority: int | None = None,
    ) -> None:
        self.name = name
        self.max_age = max_age
        self.refused = 0
        self.starts = 0
        self._task = task
        self._depth = depth
        self._priority = priority
        self._submitted = self._done = 0
        self._left = False
        self._first_ns = 0
        self._error: Exception | None = None
        self._outside = Outside(f"spp {name}")
        self._way: Transport = (
            ProcessTransport(name) if devices_allowed() else InlineTransport(name)
        )
        self._virtual = task is not None and isinstance(task.source, Counted)
        found: dict[str, Any] = self._outside.ask(self._open, library)
        self.back_end: str = found["back_end"]
        self.device: str = found["device"]
        self._routines: list[str] = found["routines"]
        self._variables = {
            str(one): Variable(tuple(shape), np.dtype(kind))
            for one, shape, kind in found["variables"]
        }
        every = list(self._variables.values())
        self._batch = batches.Batch(batches.room_of_batch(every), name)
        self._readings = [
            Reading(self, index, *one)
            for index, one in enumerate(self._variables.items())
        ]
        # The tape gets the room for a result with this second source.
        room = batches.room_of_result(every)
        self._results = Outside(f"spp {name} results", room=room)
        if not self._results.plays:
            self._way.reserve(every, depth)

    def _open(self, library: str) -> dict[str, Any]:
        if isinstance(self._way, InlineTransport) and self._task is None:
            raise SppError(
                "virtual time needs the task's clock",
                where=self.name,
                remedy="write Spp(name, library, task=self.task)",
            )
        folders = self._task.libraries if self._task is not None else ()
        return self._way.open(find_file(library, folders))

    def translate(self, name: str) -> Any:  # noqa: ANN401 - Routine or Reading
        """Return a routine or variable of the library, for the other methods.

        Raises:
            SppError: It has none of that name.
        """
        if name in self._variables:
            return self._readings[list(self._variables).index(name)]
        if name in self._routines:
            return Routine(self._routines.index(name), name)
        known = [*self._variables, *self._routines]
        raise SppError(
            f"the library has neither a variable nor a routine {name}",
            where=self.name,
            expected=" ".join(known),
            remedy=did_you_mean(name, known) or "declare it in the library",
        )

    def write(self, variable: Reading, values: ArrayLike) -> None:
        """Add to the batch: copy values to a variable; they are copied now.

        Raises:
            SppError: They have another shape or type, or the batch is full.
        """
        self._check(variable, Reading)
        about = variable.variable
        try:
            new = np.asarray(values)
        except ValueError as error:
            raise SppError(
                "the values are no array",
                where=f"{self.name}: {variable.name}",
                expected=str(about.shape),
                got=str(error),
                remedy="write the whole variable",
            ) from None
        if new.shape != about.shape:
            raise SppError(
                "the values have another shape than the variable",
                where=f"{self.name}: {variable.name}",
                expected=str(about.shape),
                got=str(new.shape),
                remedy="write the whole variable",
            )
        if new.dtype != about.dtype and not np.can_cast(
            new.dtype, about.dtype, "same_kind"
        ):
            raise SppError(
                "the values have another type than the variable",
                where=f"{self.name}: {variable.name}",
                expected=str(about.dtype),
                got=str(new.dtype),
                remedy="convert them before",
            )
        self._batch.write(variable.index, about, new)

    def call(self, routine: Routine, *numbers: float) -> None:
        """Add to the batch: call a routine with these numbers.

        Raises:
            SppError: The batch is full, or one of them is no number of 64 bits.
        """
        self._check(routine, Routine)
        self._batch.call(routine.which, numbers)

    def read(self, variable: Reading) -> Reading:
        """Add to the batch: copy a variable back. Return its newest value so far.

        Raises:
            SppError: A routine of a batch that is done now has failed.
        """
        self._check(variable, Reading)
        self._batch.read(variable.index)
        self._await(1, 0)
        self._raise()
        if self.max_age:
            self._judge(variable)
        return variable

    def wait(self, timeout: float | None = 0.0) -> bool:
        """End the batch, and hand it to the executive; wait until all are done.

        Args:
            timeout: Seconds to wait at most; 0: not at all; None: without limit.

        Returns:
            Whether all batches are done. A batch is refused, and counted, if as many as
            `depth` are under way then.

        Raises:
            SppError: A routine of a batch that is done now has failed.
        """
        until_ns = None if timeout is None else _deadline(timeout)
        if not self._batch.is_empty:
            self._await(self._depth, until_ns)
            self._submit()
        self._await(1, until_ns)
        self._raise()
        return self._done == self._submitted

    def _await(self, count: int, until_ns: int | None) -> None:
        """Take results until fewer batches than `count` are under way."""
        self._check_here()
        while self._submitted - self._done >= count and self._take(until_ns):
            pass

    def lock(self, timeout: float | None = 0.0) -> bool:
        """Reserve the processor: until `release` only this client's batches run.

        Args:
            timeout: Seconds to wait at most; 0: not at all; None: without limit.

        Returns:
            Whether it is reserved now. What a client holds that dies is freed.
        """
        self._check_here()
        return bool(self._outside.ask(self._lock, timeout, default=True))

    def _lock(self, timeout: float | None) -> bool:
        return self._way.lock(None if timeout is None else _deadline(timeout))

    def release(self) -> None:
        """Give up exclusive use."""
        if not self._left and not self._outside.plays:
            self._way.release()

    def finish(self) -> None:
        """Leave the processor; its other clients go on. What follows is refused."""
        self._left = True
        if not self._outside.plays:
            self._way.close()

    def age_of(self, stamp_ns: int) -> float:
        """Return the seconds since a stamp; infinite if it is 0."""
        if not stamp_ns:
            return math.inf
        if self._task is not None:
            now = self._task.now
        else:
            now = self._outside.ask(time.monotonic_ns)
        return max(0.0, (now - stamp_ns) * 1e-9)

    def _check_here(self) -> None:
        if self._left:
            raise SppError(
                "the processor is not in use",
                where=self.name,
                remedy="make a new Spp after finish()",
            )

    def _check(self, one: object, kind: type) -> None:
        """Refuse what `translate` has not returned for this."""
        if not isinstance(one, kind):
            what = "routine" if kind is Routine else "variable"
            raise SppError(
                f"this is no {what}",
                where=self.name,
                expected=f"what translate() returned for a {what}",
                got=getattr(one, "name", "") or f"{one!r:.40}",
                remedy="call() takes routines; write() and read() take variables",
            )

    # -- batches -----------------------------------------------------------------------

    def _submit(self) -> None:
        if self._submitted - self._done >= self._depth:
            self.refused += 1
            self._batch.clear()
            return
        self._submitted += 1
        batch = self._batch.end(self._submitted)
        if not self._results.plays:
            given = self._priority
            rank = names.home().priority() if given is None else given
            self._way.submit(self._submitted, batch, rank)

    def _raise(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _take(self, until_ns: int | None) -> bool:
        """Take one result; return whether there was one in time."""
        data: bytes | None = self._results.ask(self._receive, until_ns, default=None)
        if data is None:
            return False
        result = batches.unpack_result(data)
        self._done = max(self._done, result.number)
        self.starts = result.starts
        self._error = self._error or result.error
        for index, raw in result.values:
            one = self._readings[index]
            kind = one.variable
            one.value = np.frombuffer(raw, kind.dtype).reshape(kind.shape)
            one.stamp_ns = result.stamp_ns
        return True

    def _receive(self, until_ns: int | None) -> bytes | None:
        data = self._way.receive(until_ns)
        if data is None or not self._virtual or self._task is None:
            return data
        return batches.restamped(data, self._task.now)

    def _judge(self, variable: Reading) -> None:
        """Raise or withdraw the flag by the age of a value."""
        if self._task is None:
            return
        self._first_ns = self._first_ns or self._task.now
        stale = self.age_of(variable.stamp_ns or self._first_ns) > self.max_age
        if stale != variable.is_stale:
            variable.is_stale = stale
            cause = f"spp {self.name}: {variable.name} is too old"
            (self._task.illegal if stale else self._task.legal)(cause)


def _deadline(timeout: float) -> int:
    return time.monotonic_ns() + round(timeout * 1e9) if timeout else 0
