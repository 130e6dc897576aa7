"""An agent's two kinds of ends of a link: records go out, and come in.

Both use buffers as tasks do, each as the one reader or the one writer on its machine;
so a task notices no difference, and nothing of it runs in a task's process.
"""

from __future__ import annotations

import contextlib
import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import zenoh

from pbonet.errors import PbonetError, ProtocolError, XmError
from pbonet.tbuf import layout, places
from pbonet.tbuf.native import READER, WRITER, In, Out

from . import linkwire

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from pbonet.xm.names import Name

LOOK_NS = 100_000_000
"""How long a sender sleeps at most before it looks whether it shall end."""


class Sender:
    """Sends every new record of a link; of those it comes too late for, the newest.

    Args:
        session: The agent's.
        name: The link.
        key: Where records go.
        who: What the buffer notes, for messages.

    Raises:
        XmError: The buffer has a reader, or cannot be used.
    """

    def __init__(self, session: zenoh.Session, name: Name, key: str, who: str) -> None:
        self._end = In()
        kept = places.attach(name, None, READER, self._end)
        self._end.enter(READER, who)
        raw = layout.room(kept)
        self._end.hold(raw, raw, raw)
        self._text = self._end.text
        self._publisher = session.declare_publisher(
            key,
            priority=zenoh.Priority.REAL_TIME,
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
        """Whether records are sent: not when the buffer was destroyed."""
        return self._thread.is_alive()

    def stop(self) -> None:
        """Send no more, and let another reader have the buffer."""
        self._over = True
        self._thread.join()
        with contextlib.suppress(zenoh.ZError):
            self._publisher.undeclare()  # type: ignore[no-untyped-call]
        places.leave(self._end)

    def _work(self) -> None:
        end = self._end
        with contextlib.suppress(XmError, zenoh.ZError):  # destroyed, or cut off
            while not self._over:
                if end.read():
                    self._send(end)
                else:
                    end.wait(time.monotonic_ns() + LOOK_NS)

    def _send(self, end: In) -> None:
        packet = linkwire.Packet(
            end.number,
            end.source,
            end.stamp_ns,
            end.age_ns() or 0,
            self._text,
            end.data(),
        )
        self._publisher.put(linkwire.pack(packet))  # pyright: ignore[reportUnknownMemberType]


class Receiver:
    """Puts the records of another machine into this one's buffer.

    Args:
        session: The agent's.
        name: The link.
        key: Where records come from.
        who: What the buffer notes, for messages.
        offset: Returns nanoseconds from the other machine's clock to this one's; None
            while they are not known.
        misfit: Called once with an error if the records are not what the reader wants.

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
        offset: Callable[[], int | None],
        misfit: Callable[[Exception], None],
    ) -> None:
        self._end = Out()
        self._name = str(name)
        self._dtype = places.attach(name, None, WRITER, self._end)
        self._end.enter(WRITER, who)
        self._raw = layout.room(self._dtype)
        self._end.hold(self._raw, self._raw, self._raw)
        self._bytes = self._raw.reshape(-1).view(np.uint8).data
        self._offset = offset
        self._misfit = misfit
        self._told = False
        self._text, self._same = self._end.text, True
        self._theirs: np.dtype[Any] = self._dtype
        self._guard = threading.Lock()
        self._subscriber = session.declare_subscriber(
            key, zenoh.handlers.Callback(self._take, indirect=False)
        )

    def stop(self) -> None:
        """Take no more, and let another writer have the buffer."""
        with contextlib.suppress(zenoh.ZError):
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        with self._guard:  # a record may be on its way in
            places.leave(self._end)

    def _take(self, sample: zenoh.Sample) -> None:
        """Take a record; runs in zenoh's own thread, for a few microseconds."""
        now = time.monotonic_ns()
        try:
            packet = linkwire.unpack(sample.payload.to_bytes())
            with self._guard:
                self._store(packet, now)
        except (PbonetError, OverflowError) as error:
            if not self._told:
                self._told = True
                self._misfit(error)

    def _store(self, packet: linkwire.Packet, now: int) -> None:
        if self._end.fileno < 0:
            return
        if packet.text != self._text:
            self._learn(packet.text)
        if len(packet.data) != self._raw.nbytes:
            raise ProtocolError(
                "the record is cut short",
                where=self._name,
                remedy="run the same pbonet version on every machine",
            )
        self._fill(packet.data)
        written = written_ns(now, packet.stamp_ns, packet.age_ns, self._offset())
        self._end.put(packet.number, packet.source, written, packet.stamp_ns)

    def _learn(self, text: bytes) -> None:
        """Take note of what records look like from now on."""
        theirs = layout.parse(text)
        if not layout.same_values(theirs, self._dtype):
            raise layout.refuse(self._name, self._dtype, theirs)
        self._theirs, self._same = theirs, theirs == self._dtype
        self._text = text

    def _fill(self, data: bytes) -> None:
        if self._same:
            self._bytes[:] = data
        else:
            base, shape = self._theirs.subdtype or (self._theirs, ())
            values: NDArray[Any] = np.frombuffer(data, base).reshape(shape)
            self._raw[...] = values


def written_ns(now: int, stamp_ns: int, age_ns: int, offset: int | None) -> int:
    """Return when a record that arrives now was written, by this machine's clock.

    The age at sending is exact, and the way here is not in it. The measured offset of
    the clocks has the way in it and an error; it cannot make a record younger than it
    was when it was sent.
    """
    sent = now - age_ns
    return sent if offset is None else min(sent, stamp_ns + offset)
