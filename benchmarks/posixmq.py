"""POSIX message queues, which Python's library does not have: a rival, by ctypes."""

from __future__ import annotations

import ctypes
import os
import secrets
from typing import Final

_C = ctypes.CDLL(None, use_errno=True)
_C.mq_open.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_uint, ctypes.c_void_p]
_C.mq_send.argtypes = [ctypes.c_int, ctypes.c_char_p, ctypes.c_size_t, ctypes.c_uint]
_C.mq_receive.argtypes = [
    ctypes.c_int,
    ctypes.c_char_p,
    ctypes.c_size_t,
    ctypes.c_void_p,
]
_C.mq_receive.restype = ctypes.c_ssize_t
_MESSAGES: Final = 10
"""What the kernel gives to anybody."""


class Queue:
    """A queue without a name, for this process and its children.

    Args:
        size: Bytes of the longest message.

    Raises:
        OSError: The kernel has none, or gives none.
    """

    def __init__(self, size: int) -> None:
        name = f"/pbonet-bench-{secrets.token_hex(4)}".encode()
        attributes = (ctypes.c_long * 8)(0, _MESSAGES, size)  # a struct mq_attr
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL
        self._fd: int = _C.mq_open(name, flags, 0o600, ctypes.byref(attributes))
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), "no message queue can be had")
        _C.mq_unlink(name)
        self._room = ctypes.create_string_buffer(size)
        self._size = size

    def send(self, data: bytes) -> None:
        """Put a message in; wait while there is no room."""
        if _C.mq_send(self._fd, data, len(data), 0):
            raise OSError(ctypes.get_errno(), "mq_send")

    def receive(self) -> bytes:
        """Take the oldest message out; wait for one."""
        got = _C.mq_receive(self._fd, self._room, self._size, None)
        if got < 0:
            raise OSError(ctypes.get_errno(), "mq_receive")
        return ctypes.string_at(self._room, got)

    def close(self) -> None:
        """Let go of it."""
        os.close(self._fd)
