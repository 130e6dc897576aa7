"""The messages of one channel in numpy arrays, without an object for each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from pbonet.errors import LogError

from . import scan

if TYPE_CHECKING:
    from numpy.typing import NDArray


def gathered(data: bytes, places: NDArray[np.int64], dtype: str) -> NDArray[Any]:
    """Return the numbers at some offsets of a buffer."""
    kind = np.dtype(dtype)
    at = places[:, None] + np.arange(kind.itemsize)
    found: NDArray[Any] = np.frombuffer(data, np.uint8)[at].view(kind).reshape(-1)
    return found


class Rows(Sequence[bytes]):
    """Messages, in the order of the file.

    Args:
        data: All messages, one after the other.
        sizes: Size of each in bytes, shape ``(n,)``.
        times: Time of each in nanoseconds since 1970, shape ``(n,)``.
        places: Place of each among all messages of the file, shape ``(n,)``.
    """

    def __init__(
        self,
        data: bytes,
        sizes: NDArray[np.int64],
        times: NDArray[np.int64],
        places: NDArray[np.int64],
    ) -> None:
        self.data = data
        self.sizes = sizes
        self._starts = np.cumsum(sizes) - sizes
        self.times = times
        self.places = places
        self._firsts: dict[int, NDArray[np.uint8]] = {}

    @classmethod
    def of(
        cls,
        chunk: bytes,
        places: NDArray[np.int64],
        sizes: NDArray[np.int64],
        base: int,
    ) -> Rows:
        """Return the messages with these contents in a chunk.

        Args:
            chunk: The uncompressed chunk.
            places: Offsets of the contents in it, ascending, shape ``(n,)``.
            sizes: Their sizes in bytes, shape ``(n,)``.
            base: Offset of the chunk among those of the file.
        """
        sizes = sizes - scan.MESSAGE_HEAD
        begins = places + scan.MESSAGE_HEAD
        if len(sizes) and (sizes == sizes[0]).all():
            at = begins[:, None] + np.arange(int(sizes[0]))
            data = np.frombuffer(chunk, np.uint8)[at].tobytes()
        else:
            ends = (begins + sizes).tolist()
            pairs = zip(begins.tolist(), ends, strict=True)
            data = b"".join([chunk[begin:end] for begin, end in pairs])
        times = gathered(chunk, places + scan.TIME_AT, "<u8").astype(np.int64)
        return cls(data, sizes, times, places + base)

    @classmethod
    def joined(cls, each: Sequence[Rows]) -> Rows:
        """Return the messages of several parts of a file, given in order."""
        if len(each) == 1:
            return each[0]
        none = np.zeros(0, np.int64)
        return cls(
            b"".join([one.data for one in each]),
            np.concatenate([none, *(one.sizes for one in each)]),
            np.concatenate([none, *(one.times for one in each)]),
            np.concatenate([none, *(one.places for one in each)]),
        )

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.sizes)

    @overload
    def __getitem__(self, index: int) -> bytes: ...
    @overload
    def __getitem__(self, index: slice) -> list[bytes]: ...
    def __getitem__(self, index: int | slice) -> bytes | list[bytes]:
        """Return one message."""
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        begin = self._starts.item(index)
        return self.data[begin : begin + self.sizes.item(index)]

    def all(self) -> list[bytes]:
        """Return the messages as a list."""
        data, begins = self.data, self._starts.tolist()
        ends = (self._starts + self.sizes).tolist()
        return [data[a:b] for a, b in zip(begins, ends, strict=True)]

    def firsts(self, size: int) -> NDArray[np.uint8]:
        """Return the first bytes of each message, shape ``(n, size)``.

        Raises:
            LogError: A message is shorter.
        """
        if size not in self._firsts:
            self._firsts[size] = self._read_firsts(size)
        return self._firsts[size]

    def _read_firsts(self, size: int) -> NDArray[np.uint8]:
        if len(self) and (least := int(self.sizes.min())) < size:
            raise LogError(
                "a record is shorter than its channel's schema says",
                expected=f"at least {size} bytes",
                got=f"{least} bytes",
                remedy="the program that wrote this log is at fault",
            )
        data = np.frombuffer(self.data, np.uint8)
        if len(self) and (self.sizes == self.sizes[0]).all():
            return data.reshape(len(self), -1)[:, :size]
        text, begins = self.data, self._starts.tolist()
        parts = b"".join([text[begin : begin + size] for begin in begins])
        return np.frombuffer(parts, np.uint8).reshape(len(self), size)
