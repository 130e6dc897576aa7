"""The two ends of a link, as modules and programs use them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pbonet import shm
from pbonet.outside import Outside, active

from . import layout, places
from ._tbuf import READER, WRITER, End, In, Out

if TYPE_CHECKING:
    from typing import Any

    import numpy as np
    from numpy.typing import DTypeLike, NDArray

    from pbonet.xm.ipc import Name


class _Attached(shm.Closeable, End):
    """Base of both ends."""

    name: str
    """The link's full name."""

    def close(self) -> None:
        """Detach (``tbufDetach``); the last user removes the buffer."""
        places.leave(self)

    def destroy(self) -> None:
        """Remove the buffer; its other users get errors (``tbufDestroy``)."""
        if self.outside is not None and self.outside.plays:
            return
        shm.remove_same(Path(self.path), self.fileno)
        self.mark_destroyed()
        self.unmap()

    @property
    def written(self) -> int:
        """The counter of the newest record; 0 before the first."""
        if self.outside is None:
            return super().written
        return self.outside.ask(lambda: super(_Attached, self).written)

    @property
    def last_ns(self) -> int:
        """When the newest record was written; 0 before the first."""
        if self.outside is None:
            return super().last_ns
        return self.outside.ask(lambda: super(_Attached, self).last_ns)

    @property
    def destroyed(self) -> bool:
        """Whether it was destroyed."""
        if self.outside is None:
            return super().destroyed
        return self.outside.ask(lambda: super(_Attached, self).destroyed, default=False)

    def _attach(
        self, name: Name, wanted: np.dtype[Any] | None, role: int
    ) -> tuple[Outside | None, np.dtype[Any]]:
        """Return the recorder of this end, if any, and the buffer's record type."""
        if not active():
            return None, places.attach(name, wanted, role, self)
        outside = Outside(f"link {name}")

        def attach() -> bytes:
            return layout.describe(places.attach(name, wanted, role, self))

        return outside, layout.parse(outside.ask(attach))

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.name}, record {self.number}>"


class Writer(_Attached, Out):
    """The one writer of a link (``tbufCreate`` and ``tbufWrite``, section 5.6.1).

    Fill `value` and call `write`; both may be done in a cycle. The reader may be on
    this machine or on any other that the agents reach.

    Args:
        name: ``NAME``, or ``SUBSYSTEM:NAME`` or ``RTPU:NAME`` with the writer's own
            subsystem or RTPU.
        dtype: Type of a record as a numpy dtype: ``("f8", 6)``, or fields.
        data: An array of that type and shape to send from, instead of `value`.

    Raises:
        XmNameError: The name is malformed, or belongs to another subsystem or RTPU.
        XmTakenError: The link already has a writer.
        XmLayoutError: The reader expects other records.
        XmError: The buffer's file cannot be used.
    """

    def __init__(
        self, name: str, dtype: DTypeLike, *, data: NDArray[Any] | None = None
    ) -> None:
        found = places.name_to_write(name)
        self.name = str(found)
        wanted = layout.as_dtype(dtype)
        outside, kept = self._attach(found, wanted, WRITER)
        own = layout.room(wanted) if data is None else data
        try:
            raw = own if kept == wanted else layout.room(kept)
            self.hold(raw, own, own, outside)
            self.begin()
        except BaseException:
            self.close()
            raise


class Reader(_Attached, In):
    """The one reader of a link (``tbufAttach`` and ``tbufRead``, section 5.6.1).

    `read` copies the newest record into `value`; the writer need not exist yet.

    Args:
        name: ``SUBSYSTEM:NAME`` or ``RTPU:NAME``, with the writer's subsystem or RTPU.
        dtype: Type of a record; None takes the writer's, which must then have been
            started. Values in the other byte order are converted.

    Raises:
        XmNameError: The name is malformed.
        XmTakenError: The link already has a reader.
        XmLayoutError: The writer sends other records.
        XmMissingError: There is no such link yet, and no `dtype` was given.
        XmError: The buffer's file cannot be used.
    """

    def __init__(self, name: str, dtype: DTypeLike | None = None) -> None:
        found = places.name_to_read(name)
        self.name = str(found)
        wanted = None if dtype is None else layout.as_dtype(dtype)
        outside, kept = self._attach(found, wanted, READER)
        raw = layout.room(kept)
        own = raw if wanted is None or wanted == kept else layout.room(wanted)
        value = own[...]
        value.flags.writeable = False
        self.hold(raw, own, value, outside)
