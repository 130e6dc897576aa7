"""An agent's two ends of a link: one sends records, one receives them.

Both use buffers as tasks do, each as the only reader or writer on its machine; so a
task notices no difference, and none of this runs in a task's process.
"""

from __future__ import annotations

import contextlib
import threading
import time
from typing import TYPE_CHECKING, Any

import zenoh

from pbonet.errors import PbonetError, XmError
from pbonet.node.wire import process_setup
from pbonet.tbuf import READER, WRITER, In, Out, layout, parts, places
from pbonet.xm.net import VALUES_PRIORITY, direct

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from pbonet.node.wire import Clock
    from pbonet.xm.ipc import Name

LOOK_NS = 100_000_000
"""Longest sleep of a sender between checks whether it must end."""
CLOCKS_NS = 200_000_000
"""How long a receiver uses a measurement of the other machine's clock."""


class Sender:
    """Sends every new record of a link; if it falls behind, the newest one.

    Args:
        session: The agent's session.
        name: The link.
        key: The key on which records are sent.
        who: Description of this user in the buffer, for error messages.

    Raises:
        XmError: The buffer has a reader, or cannot be used.
    """

    def __init__(self, session: zenoh.Session, name: Name, key: str, who: str) -> None:
        self._end = In()
        kept = places.attach(name, None, READER, self._end)
        self._end.enter(READER, who)
        raw = layout.room(kept)
        self._end.hold(raw, raw, raw)
        self._publisher = session.declare_publisher(
            key,
            priority=VALUES_PRIORITY,
            congestion_control=zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.BEST_EFFORT,
        )
        self._over = False
        self._thread = threading.Thread(
            target=self._work, name=f"link {name}", daemon=True
        )
        self._thread.start()

    @property
    def works(self) -> bool:
        """Whether records are sent; False after the buffer was destroyed."""
        return self._thread.is_alive()

    def stop(self) -> None:
        """Stop sending, and release the buffer to another reader."""
        self._over = True
        self._thread.join()
        with contextlib.suppress(zenoh.ZError):
            self._publisher.undeclare()  # type: ignore[no-untyped-call]
        places.leave(self._end)

    def _work(self) -> None:
        if process_setup.go_before_others():
            process_setup.send_before_others()
        end = self._end
        with contextlib.suppress(XmError, zenoh.ZError):  # destroyed, or cut off
            while not self._over:
                message = end.message(time.monotonic_ns() + LOOK_NS)
                if message is not None:
                    self._publisher.put(message)  # pyright: ignore[reportUnknownMemberType]


class Receiver:
    """Writes the records of another machine to this one's buffer.

    Args:
        session: The agent's session.
        name: The link.
        key: The key on which records arrive.
        who: Description of this user in the buffer, for error messages.
        clock: Returns the other machine's clock; None if unknown: records are old then.
        refuses: Returns whether records of the other machine are not used.
        misfit: Called once with an error if the records do not fit the reader.

    Raises:
        XmError: The buffer has a writer, or cannot be used.
    """

    def __init__(
        self,
        session: zenoh.Session,
        name: Name,
        key: str,
        *,
        who: str,
        clock: Callable[[], Clock | None],
        refuses: Callable[[], bool],
        misfit: Callable[[Exception], None],
    ) -> None:
        self._end = Out()
        self._name = str(name)
        self._dtype = places.attach(name, None, WRITER, self._end)
        self._end.enter(WRITER, who)
        self._raw = layout.room(self._dtype)
        self._end.hold(self._raw, self._raw, self._raw)
        self._clock, self._refuses = clock, refuses
        self._misfit = misfit
        self._told = False
        self._text = b""
        self._theirs: np.dtype[Any] = self._dtype
        self._over = False
        self._again = 0
        self._behind_ns: int | None = None
        self._error_ns = 0
        self._subscriber = session.declare_subscriber(key, direct(self._take))

    def stop(self) -> None:
        """Stop receiving, and release the buffer to another writer."""
        with contextlib.suppress(zenoh.ZError):
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._over = True  # a record may be about to arrive
        places.leave(self._end)

    def _take(self, sample: zenoh.Sample) -> None:
        """Write a record; runs in zenoh's own thread, for a few microseconds."""
        now = time.monotonic_ns()
        if self._over or self._refuses():
            return
        if now > self._again:
            self._update_clocks(now)
        message = sample.payload.to_bytes()
        try:
            if not self._put(message, now):
                self._turn(message, now)
        except (PbonetError, OverflowError) as error:
            if not self._told:
                self._told = True
                self._misfit(error)

    def _update_clocks(self, now: int) -> None:
        """Update the offset of the clocks; raise this thread's priority."""
        self._again = now + CLOCKS_NS
        clock = self._clock()
        self._behind_ns = None if clock is None else -clock.ahead_ns
        self._error_ns = 0 if clock is None else clock.error_ns
        process_setup.go_before_others()

    def _put(self, message: bytes, now: int, *, turned: bool = False) -> bool:
        where = self._behind_ns, self._error_ns
        return self._end.take(message, now, *where, turned=turned)

    def _turn(self, message: bytes, now: int) -> None:
        """Write a record with another description, such as another byte order."""
        text, data = parts(message)[-2:]
        if text != self._text:
            theirs = layout.parse(text)
            if not layout.same_values(theirs, self._dtype):
                raise layout.refuse(self._name, self._dtype, theirs)
            self._theirs, self._text = theirs, text
        if len(data) == self._raw.nbytes:
            import numpy as np  # loaded already: an end of a link has types

            base, shape = self._theirs.subdtype or (self._theirs, ())
            values: NDArray[Any] = np.frombuffer(data, base).reshape(shape)
            self._raw[...] = values
        self._put(message, now, turned=True)
