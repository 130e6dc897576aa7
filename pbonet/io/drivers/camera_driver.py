"""A camera of Video4Linux: class MEM, driver ``camera``.

The address is the device file, such as ``/dev/video0``. Frames are copied into shared
memory with room for some of them: frame n begins at ``n % slots * size``. The task that
has the camera puts the number of the newest frame into the table; others map the memory
(driver ``file``, the address is ``/dev/shm/`` and the setting `memory`), and use a
frame before `slots` - 1 newer ones have come.

`status("FRAME")` takes the newest frame and returns its number. With `Wait.ALL` it
waits for a frame that is newer than the last one, at most for the setting `timeout`;
with `Wait.NONE` it returns the number of the last one, or -1, where no newer one has
come. Numbers are the camera's: where one is missing, a frame was lost.

No library is needed: these are the requests of ``linux/videodev2.h``. Its tests have a
camera that a test makes up. It was not run with hardware here.
"""

from __future__ import annotations

import errno
import os
import select
import struct
from contextlib import suppress
from fcntl import LOCK_EX, LOCK_NB, flock, ioctl
from mmap import PROT_READ, mmap as mapped
from time import monotonic
from typing import Annotated as A, Any, ClassVar, Final

from msgspec import Meta

from pbonet.errors import DeviceError

from .device import Settings
from .device_classes import MemoryDevice
from .modes import Mode, Wait

SHARED: Final = "/dev/shm"  # noqa: S108 - shared memory is what is meant
S_FMT, REQBUFS, QUERYBUF = 0xC0D05605, 0xC0145608, 0xC0585609
"""Requests: choose a format, ask for buffers, and where a buffer is."""
QBUF, DQBUF, STREAMON, STREAMOFF = 0xC058560F, 0xC0585611, 0x40045612, 0x40045613
"""Requests: give a buffer to the camera, take one, begin and end."""
FORMAT: Final = struct.Struct("@I4x8I168x")
"""Kind; width, height, pixel format, field, bytes of a line, size, colours, and 0."""
BUFFERS: Final = struct.Struct("@5I")
BUFFER: Final = struct.Struct("@5I4xqq16xIIQI12x")
"""Number, kind, bytes, flags, field, seconds, microseconds, sequence, memory, place,
length."""
CAPTURE, MAPPED = 1, 1
"""The kind of all buffers, and of their memory."""
DAMAGED: Final = 0x40
"""The flag of a frame that did not come whole."""
_KERNEL_BUFFERS: Final = 4
_NAME: Final = r"^[A-Za-z0-9_][A-Za-z0-9_.+\-]{0,63}$"


class CameraSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of a camera."""

    width: A[int, Meta(ge=1, le=1 << 15)] = 640
    height: A[int, Meta(ge=1, le=1 << 15)] = 480
    format: A[str, Meta(pattern=r"^[ -~]{4}$")] = "YUYV"
    """Code of the pixels' format, four characters; `v4l2-ctl` lists the camera's."""
    slots: A[int, Meta(ge=2, le=64)] = 4
    """Frames that the shared memory has room for."""
    memory: A[str, Meta(pattern=_NAME)] = "camera"
    """The shared memory's name."""
    timeout: A[float, Meta(gt=0.0)] = 2.0
    """Seconds in which a frame comes, where a call waits."""


class CameraDevice(MemoryDevice):
    """The frames of one camera."""

    can = Mode.READ
    waits = frozenset({Wait.ALL, Wait.NONE})
    settings_type: ClassVar[type[Settings]] = CameraSettings
    can_trunc_lsb = False

    def connect(self) -> None:
        """Choose the format and start the camera; see `Device.connect`."""
        self._fd = self._shared_fd = -1
        self._buffers: list[mapped] = []
        self._memory: mapped | None = None
        self._number, self._stamp_ns, self._length = -1, 0, 0
        try:
            self._fd = os.open(
                self.entry.address, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC
            )
            self._choose()
            if self.opening.mode is not Mode.NONE:
                self._share()
                self._start()
        except OSError as error:
            self.disconnect()
            raise self._unusable(error) from None

    def disconnect(self) -> None:
        """Stop the camera and remove the shared memory."""
        if self._buffers:
            with suppress(OSError):
                ioctl(self._fd, STREAMOFF, struct.pack("@i", CAPTURE))
        for one in (*self._buffers, *([self._memory] if self._memory else [])):
            with suppress(BufferError):  # the module still holds a view
                one.close()
        if self._shared_fd >= 0:
            os.unlink(self._path())  # noqa: PTH108
        for fd in (self._fd, self._shared_fd):
            if fd >= 0:
                os.close(fd)
        self._fd = self._shared_fd = -1
        self._buffers, self._memory = [], None

    def status(self, command: str, port: int = 0) -> Any:  # noqa: ANN401
        """Return what is known of the camera.

        ``FRAME`` takes the newest frame and gives its number, ``STAMP`` the
        nanoseconds of the kernel's monotonic clock at which it was taken, ``FORMAT``
        width, height, bytes of a line, and bytes of a slot.
        """
        if command == "FRAME":
            self.require(Mode.READ)
            return self.ask(self._newest, default=-1)
        if command == "STAMP":
            return self.ask(lambda: self._stamp_ns, default=0)
        if command == "FORMAT":
            return tuple(self.ask(lambda: list(self._format), default=()))
        return super().status(command, port)

    def read(self, count: int, at: int = 0) -> bytes:
        """Return bytes of the newest frame; see `MemoryDevice.read`.

        It is the frame that `status("FRAME")` took.
        """
        self.require(Mode.READ)
        data: bytes = self.ask(self._read, count, at, default=b"")
        return data

    def _read(self, count: int, at: int) -> bytes:
        if not 0 <= at <= at + count <= self._length:
            raise DeviceError(
                "the frame has no such bytes",
                where=f"{self.name} ({self.entry.address})",
                expected=f"up to {self._length}, in the frame that FRAME took",
                got=f"{at} to {at + count - 1}",
                remedy='call status("FRAME") before; see status("FORMAT")',
            )
        begin = self._number % self.settings.slots * self._size + at
        return self._shared()[begin : begin + count]

    def write(self, data: bytes, at: int = 0) -> int:
        """Refuse to write into frames.

        Raises:
            DeviceError: Always; a camera is not open for it.
        """
        del data, at
        self.require(Mode.WRITE)
        return 0

    def mmap(self) -> memoryview:
        """Return the shared memory with all slots; see `MemoryDevice.mmap`."""
        self.require(Mode.READ)
        if self.outside.plays:
            raise DeviceError(
                "frames that are mapped are in no log",
                where=self.name,
                remedy="take them with read() where a run must replay",
            )
        return memoryview(self._shared()).toreadonly()

    def _shared(self) -> mapped:
        if self._memory is None:
            raise OSError(errno.ENODEV, "the camera is closed")
        return self._memory

    def _choose(self) -> None:
        """Set the format.

        Raises:
            OSError: The camera has not this one.
        """
        k = self.settings
        code = int.from_bytes(k.format.encode("ascii"), "little")
        data = bytearray(FORMAT.pack(CAPTURE, k.width, k.height, code, 0, 0, 0, 0, 0))
        ioctl(self._fd, S_FMT, data)
        _, width, height, has, _, line, size, _, _ = FORMAT.unpack(data)
        if (width, height, has) != (k.width, k.height, code) or not size:
            name = has.to_bytes(4, "little").decode("ascii", "replace")
            raise OSError(errno.EINVAL, f"it offers {width} x {height} {name}")
        self._size = size
        self._format = width, height, line, size

    def _share(self) -> None:
        """Make the shared memory.

        Raises:
            OSError: It cannot be made.
        """
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
        fd = os.open(self._path(), flags, 0o600)
        try:
            flock(fd, LOCK_EX | LOCK_NB)
        except OSError as error:
            os.close(fd)
            told = f"another camera has the memory {self.settings.memory}"
            raise OSError(error.errno, told) from None
        self._shared_fd = fd
        os.ftruncate(self._shared_fd, self._size * self.settings.slots)
        self._memory = mapped(self._shared_fd, self._size * self.settings.slots)

    def _start(self) -> None:
        """Map the kernel's buffers and let the camera fill them.

        Raises:
            OSError: It does not.
        """
        asked = bytearray(BUFFERS.pack(_KERNEL_BUFFERS, CAPTURE, MAPPED, 0, 0))
        ioctl(self._fd, REQBUFS, asked)
        for number in range(BUFFERS.unpack(asked)[0]):
            data = _buffer(number)
            ioctl(self._fd, QUERYBUF, data)
            *_, place, length = BUFFER.unpack(data)
            self._buffers.append(mapped(self._fd, length, prot=PROT_READ, offset=place))
            ioctl(self._fd, QBUF, _buffer(number))
        ioctl(self._fd, STREAMON, struct.pack("@i", CAPTURE))

    def _newest(self) -> int:
        """Copy the newest frame; return its number.

        Raises:
            DeviceError: It waits, and none comes.
            OSError: The camera is gone.
        """
        ends = monotonic() + self.settings.timeout
        while not self._take() and self.opening.wait is Wait.ALL:
            left = ends - monotonic()
            if left <= 0:
                raise DeviceError(
                    "the camera gives no frame",
                    where=f"{self.name} ({self.entry.address})",
                    expected=f"one within {self.settings.timeout:g} s",
                    got="none",
                    remedy="check its cable and exposure; a slower one needs a longer "
                    "timeout in agent.toml",
                )
            select.select([self._fd], [], [], left)
        return self._number

    def _take(self) -> bool:
        """Copy the newest frame that has come; return whether there was one."""
        last: tuple[int, int, int, int] | None = None
        for _ in self._buffers:
            data = _buffer(0)
            try:
                ioctl(self._fd, DQBUF, data)
            except BlockingIOError:
                break
            number, _, used, flags, _, sec, usec, sequence, *_ = BUFFER.unpack(data)
            if not flags & DAMAGED:
                if last is not None:
                    ioctl(self._fd, QBUF, _buffer(last[0]))
                stamp_ns = sec * 1_000_000_000 + usec * 1000
                last = number, min(used, self._size), sequence, stamp_ns
            else:
                ioctl(self._fd, QBUF, _buffer(number))
        if last is None:
            return False
        number, self._length, self._number, self._stamp_ns = last
        begin = self._number % self.settings.slots * self._size
        frame = memoryview(self._buffers[number])[: self._length]
        self._shared()[begin : begin + self._length] = frame
        frame.release()
        ioctl(self._fd, QBUF, _buffer(number))
        return True

    def _path(self) -> str:
        return os.path.join(SHARED, self.settings.memory)  # noqa: PTH118

    def _unusable(self, error: OSError) -> DeviceError:
        return DeviceError(
            "the camera cannot be started",
            where=f"{self.name} ({self.entry.address})",
            expected="a device file of a camera that has this format",
            got=error.strerror or str(error),
            remedy="`v4l2-ctl --list-devices` lists the cameras, --list-formats-ext "
            "their formats; end other programs that have it",
        )


def _buffer(number: int) -> bytearray:
    """Return what names a buffer in a request."""
    return bytearray(BUFFER.pack(number, CAPTURE, 0, 0, 0, 0, 0, 0, MAPPED, 0, 0))
