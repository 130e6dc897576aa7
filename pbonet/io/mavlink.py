"""A MAVLink link: frames in and out, polled once a cycle, never waiting.

pymavlink knows the messages; each is unpacked when its values are asked for. What is
read is recorded frame by frame, so a replay of a log gets the same messages without a
link, and without the link's key.
"""

from __future__ import annotations

import struct
from collections import defaultdict
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, cast

from pbonet.errors import DeviceError, ParameterError
from pbonet.outside import Outside

from .mavlink_channels import make_channel, parse_address
from .mavlink_frames import Frame, FrameFinder
from .mavlink_messages import Message, Unpacker
from .mavlink_signing import Signatures, read_key, time_stamp
from .optional_packages import from_extra
from .policy import require_devices

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_COUNTS: Final = struct.Struct("<HH")
"""At the end of a recorded answer: damaged frames, and frames that were refused."""
_MOST: Final = (1 << 16) - 1


class MavLink:
    """One link, with one other end, or several stations.

    Frames count that come from the system `peer`, or from any other than `system` if
    that is 0. Others are ignored and counted. When the link is lost it is opened again
    after `retry` seconds.

    Args:
        address: As for `parse_address`.
        system: Our system id.
        component: Our component id.
        peer: The system id of the other end; 0 for any.
        key: File of the passphrase with which frames are signed; empty for none.
            Frames must be signed unless no other machine can reach the link.
        retry: Seconds between two attempts to open it.
        work: Most reads of one poll.

    Attributes:
        mav: Makes messages: `link.mav.heartbeat_encode(...)` of pymavlink.
        fault: Why there is no link; None while there is one.
        damaged: Frames with a bad check sum, and bytes that belong to none.
        refused: Frames without a valid signature.
        foreign: Frames of other systems, by system id.
        unsent: Frames for which the link had no room.
        alive: Whether the other end is there, and was not lost since its task was
            turned on; the module that owns the link sets it, for the parts after it.

    Raises:
        ParameterError: The address is none, or needs a key.
        DeviceError: pymavlink is not installed, or the key's file is not usable.
    """

    def __init__(
        self,
        address: str,
        system: int,
        component: int,
        *,
        peer: int = 0,
        key: str = "",
        retry: float = 1.0,
        work: int = 256,
    ) -> None:
        with from_extra("mavlink", "MAVLink"):
            self._dialect = import_module("pymavlink.dialects.v20.common")
        self.address = address
        self.system, self.component, self.peer = system, component, peer
        self.fault: DeviceError | None = None
        self.damaged = self.refused = self.unsent = 0
        self.foreign: dict[int, int] = {}
        self.alive = False
        self._retry_ns, self._work = round(retry * 1e9), work
        self._next_try_ns: int | None = None
        self._opened = False
        self._received = defaultdict[int, list[Frame]](list)
        self._outside = Outside(f"MAVLink {address}")
        kinds = self._dialect.mavlink_map
        self._kinds = {one.msgname: number for number, one in kinds.items()}
        self._extras = {n: bytes((one.crc_extra,)) for n, one in kinds.items()}
        self.mav: Any = self._dialect.MAVLink(None, system, component)
        self._unpacker = Unpacker(kinds)
        self._checksum = _checksum_of(self._dialect)
        self._signatures = self._sign(key)
        self._channel = make_channel(parse_address(address))
        self._begin()

    def poll(self, now_ns: int) -> None:
        """Receive what has arrived since the last poll, for `newest` and `all_of`.

        Args:
            now_ns: The time, in nanoseconds of any one clock.
        """
        self._received.clear()
        try:
            if self._opened or self._open(now_ns):
                self._read()
        except OSError as error:  # also a DeviceError
            self._lose(error, now_ns)

    def wait(self, seconds: float) -> None:
        """Wait until something arrives, at most so long; for `init` alone."""
        if self._opened:
            self._outside.ask(self._channel.wait, seconds, default=None)

    def all_of(self, name: str) -> Sequence[Message]:
        """Return the messages of a kind that the last poll received, oldest first."""
        found = self._received.get(self._kinds[name])
        return [self._unpacker.unpack(one) for one in found] if found else ()

    def newest(self, name: str, component: int = 0) -> Message | None:
        """Return the newest message of a kind that the last poll received.

        Args:
            name: The kind.
            component: Its sender's component; 0 for any.
        """
        for one in reversed(self._received.get(self._kinds[name], ())):
            if component in {0, one.component}:
                return self._unpacker.unpack(one)
        return None

    def is_addressed(self, message: Any) -> bool:  # noqa: ANN401
        """Return whether a message is for this end, or for all."""
        return message.target_system in {0, self.system} and (
            message.target_component in {0, self.component}
        )

    def has(self, name: str) -> bool:
        """Return whether the last poll received a message of a kind."""
        return self._kinds[name] in self._received

    def send(self, message: Any) -> None:  # noqa: ANN401
        """Send a message of `mav` if the link is open; without room it is lost."""
        if not self._opened or self._outside.plays:
            return
        data = message.pack(self.mav)
        self.mav.seq = (self.mav.seq + 1) % 256
        try:
            self.unsent += not self._channel.send(data)
        except OSError:  # the next poll says so
            self.unsent += 1

    def close(self) -> None:
        """Let go of the link; the next poll opens it again."""
        self._opened, self._next_try_ns = False, None
        self._channel.close()

    # -- opening and losing -----------------------------------------------------------

    def _sign(self, key: str) -> Signatures | None:
        """Begin to sign, if there is a key; it is not read in a replay.

        Raises:
            ParameterError: The link needs one.
        """
        if not key:
            if not parse_address(self.address).private:
                raise ParameterError(
                    "a MAVLink link that others can reach needs a key",
                    where=self.address,
                    expected="KEY with the file of the passphrase that both ends have",
                    remedy="write KEY FILE, or use a serial line or localhost",
                )
            return None
        if self._outside.plays:
            return None
        signing, begin = self.mav.signing, time_stamp()
        signing.secret_key = secret = read_key(key)
        signing.sign_outgoing, signing.timestamp = True, begin
        return Signatures(secret, begin)

    def _open(self, now_ns: int) -> bool:
        if self._next_try_ns is not None and now_ns < self._next_try_ns:
            return False
        require_devices(self.address)
        self._outside.ask(self._channel.open, default=None)
        self._opened, self.fault = True, None
        self._begin()
        return True

    def _begin(self) -> None:
        """Forget the beginning of a frame that will not be completed."""
        whole = self._channel.whole
        self._finder = FrameFinder(self._extras, self._checksum, whole=whole)

    def _lose(self, error: OSError, now_ns: int) -> None:
        self.close()
        self._next_try_ns = now_ns + self._retry_ns
        if isinstance(error, DeviceError):
            self.fault = error
            return
        self.fault = DeviceError(
            "the MAVLink link is lost",
            where=self.address,
            got=error.strerror or str(error),
            remedy="check that the port is free and the other end runs; "
            f"it is tried again every {self._retry_ns * 1e-9:g} s",
        )

    # -- receiving --------------------------------------------------------------------

    def _read(self) -> None:
        answer = self._outside.ask(self._receive, default=b"")
        if not answer:
            return
        if self._outside.plays:
            self._keep(self._finder.feed(answer[: -_COUNTS.size]), [])
        damaged, refused = _COUNTS.unpack(answer[-_COUNTS.size :])
        self.damaged += damaged
        self.refused += refused

    def _keep(self, frames: Sequence[Frame], whole: list[bytes]) -> bool:
        """Keep the frames that count, and count others; return whether one did.

        The bytes of all are added to `whole`.
        """
        peer, own, found = self.peer, self.system, False
        for frame in frames:
            kind, system, _, data = frame
            whole.append(data)
            if (system == peer) if peer else (system != own):
                self._received[kind].append(frame)
                found = True
            else:
                self.foreign[system] = self.foreign.get(system, 0) + 1
        return found

    def _receive(self) -> bytes:
        """Keep what has arrived; return the valid frames, and the counts of others.

        It is empty when nothing is there.
        """
        reads = self._channel.receive(self._work)
        if not reads:
            return b""
        finder, judge = self._finder, self._signatures
        whole, damaged, refused = list[bytes](), 0, 0
        for data, sender in reads:
            frames = finder.feed(data)
            damaged += finder.damaged
            if judge is not None:
                valid = [
                    f for f in frames if judge.valid(f.data, f.system, f.component)
                ]
                refused, frames = refused + len(frames) - len(valid), valid
            if self._keep(frames, whole):
                self._channel.accept(sender)
        whole.append(_COUNTS.pack(min(damaged, _MOST), min(refused, _MOST)))
        return b"".join(whole)


def _checksum_of(dialect: Any) -> Callable[[bytes], int]:  # noqa: ANN401
    """Return pymavlink's check sum: that of fastcrc, or slower without that package."""
    fast: Any = getattr(dialect, "mcrf4xx", None)
    if fast is not None:
        return cast("Callable[[bytes], int]", fast)

    def slow(data: bytes) -> int:
        return int(dialect.x25crc(data).crc)

    return slow
