"""Cycles of a log as columns of numpy, by the schema of their task."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pbonet.errors import LogError

from .rows import Rows
from .schema import CDR, HEAD, HEAD_BYTES, TaskSchema, bytes_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .records import TaskAbout

HEAD_DTYPE: Final = np.dtype([(name, kind) for name, kind, _ in HEAD])


class ReadSchema(TaskSchema):
    """The message format of one task's cycles, to read them.

    Args:
        about: The task.
    """

    def __init__(self, about: TaskAbout) -> None:
        super().__init__(about)
        last, _ = self._places(HEAD_BYTES)
        self._fields = [(one, last[one.name]) for one, _ in self._groups()]

    def cycles(self, messages: Rows) -> Rows:
        """Return the single cycles of messages, each as a message of its own.

        Raises:
            LogError: A message is shorter than its schema says.
        """
        found = self.layout.unfold(messages.data, messages.sizes)
        if found is None:
            raise LogError(
                "a record is shorter than its channel's schema says",
                expected="every field of each of its cycles",
                got="a message that ends before",
                remedy="the program that wrote this log is at fault",
            )
        data = found[0]
        sizes, counts = (np.frombuffer(one, np.int64) for one in found[1:])
        times = np.repeat(messages.times, counts)
        rows = Rows(data, sizes, times, np.repeat(messages.places, counts))
        if len(rows) != len(messages):
            ends = self.heads(rows)["end_ns"]
            last = np.repeat(np.cumsum(counts) - 1, counts)
            rows.times = times + ends - ends[last]
        return rows

    def groups(self, cycles: Rows) -> list[bytes]:
        """Return the group of out-vars of each cycle, as `group` does of one."""
        rows, size = cycles.firsts(self.prefix), self._group.bytes
        out = np.zeros((len(cycles), size), np.uint8)
        for place, count, last, _ in self._pieces:
            first = len(CDR) + last
            out[:, place : place + count] = rows[:, first : first + count]
        text = out.tobytes()
        return [text[n * size : (n + 1) * size] for n in range(len(cycles))]

    def heads(self, messages: Rows) -> dict[str, NDArray[Any]]:
        """Return the columns of `HEAD`, one row per message."""
        return heads(messages.firsts(self.prefix))

    def arrays(self, messages: Rows) -> dict[str, NDArray[Any]]:
        """Return the columns of `HEAD` and the variables, one row per message."""
        rows = messages.firsts(self.prefix)
        found = heads(rows)
        for variable, at in self._fields:
            first = len(CDR) + at
            part = rows[:, first : first + bytes_of(variable)]
            values = np.ascontiguousarray(part).view(np.dtype(variable.dtype))
            found[variable.name] = values
        return found


def heads(rows: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Return the columns of `HEAD` from the first bytes of messages."""
    part = np.ascontiguousarray(rows[:, len(CDR) : len(CDR) + HEAD_BYTES])
    table = part.view(HEAD_DTYPE).reshape(-1)
    return {name: table[name].copy() for name, _, _ in HEAD}


def head(message: bytes) -> Any:  # noqa: ANN401 - numpy.void
    """Return the head of one message, with the fields of `HEAD`."""
    return np.frombuffer(message, HEAD_DTYPE, 1, len(CDR))[0]
