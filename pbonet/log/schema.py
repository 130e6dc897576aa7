"""Messages of cycles: ``ros2msg`` schemas, and CDR bytes.

A message begins with the fields of `HEAD`, as in a ring's record; then come the
out-vars, then three byte sequences: the (register, number) pairs of the groups that
were copied in, the in-vars if they do not follow from those, and the inputs from
outside. That is its last cycle. The cycles before it follow, with what does not follow
from the last one: times, values and byte sequences.
Foxglove, PlotJuggler and rerun can read this without a plug-in. Older logs have a
message for each cycle, and the oldest no inputs from outside.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from pbonet.errors import LogError
from pbonet.svar import group_of, var_bytes

from ._messages import Layout
from .fields import field_name
from .records import SPAN_NS, Step
from .rows import Rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pbonet.config import Variable

    from .records import TaskAbout

CDR: Final = bytes((0, 1, 0, 0))
"""Little endian."""
HEAD: Final[tuple[tuple[str, str, str], ...]] = (
    ("cycle", "uint64", "cycles since the task was spawned, this one included"),
    ("release_ns", "int64", "release, CLOCK_MONOTONIC"),
    ("start_ns", "int64", "first line of the method"),
    ("end_ns", "int64", "after the commit"),
    ("dt_ns", "int64", "time step passed to the method"),
    ("cpu_ns", "uint64", "CPU time"),
    ("register", "uint64", "register of the commit"),
    ("number", "uint64", "number of the commit in that register"),
    ("lost", "uint64", "records that did not fit the ring, before this one"),
    ("flags", "uint32", "flags of the copies"),
    ("kind", "uint32", "pbonet.log.Step"),
)
HEAD_DTYPE: Final = np.dtype([(name, kind) for name, kind, _ in HEAD])
EARLIER: Final[tuple[tuple[str, str, str], ...]] = (
    ("int64", "release_ns", "release, CLOCK_MONOTONIC"),
    ("int32", "start_ns", "first line of the method, after the release"),
    ("int32", "end_ns", "after the commit, after the start"),
    ("uint32", "cpu_ns", "CPU time"),
)
"""Type, name and description of the first fields of an earlier cycle."""
STABLE: Final = 1 << 31
"""The flag of a cycle in which ``stable`` ran."""
HELD: Final = 1 << 30
"""The flag of a cycle that was skipped because an input was too old."""
SAFE: Final = 1 << 29
"""The flag of a cycle in which the safe values were written."""
RECORD: Final = struct.Struct("<IIIIII")
"""Size, pairs, bytes of out-vars, of inputs, of inputs from outside, and a spare."""
_HEAD_BYTES: Final = HEAD_DTYPE.itemsize
_EARLIER_BYTES: Final = sum(np.dtype(kind).itemsize for kind, _, _ in EARLIER)
_LENGTH: Final = struct.Struct("<I")
COMMITS: Final = frozenset({Step.CYCLE, Step.CLAIM, Step.COMMIT})
"""Kinds of records that are written to a task's channel of cycles."""
_ROS: Final = {
    "f4": "float32",
    "f8": "float64",
    "b1": "bool",
    **{f"{s}{n}": f"{'u' * (s == 'u')}int{8 * n}" for s in "iu" for n in (1, 2, 4, 8)},
}


def _bytes_of(variable: Variable) -> int:
    return np.dtype(variable.dtype).itemsize * variable.nelem


def _unit(variable: Variable) -> int:
    """Return the alignment of an element in CDR."""
    return 1 if _is_struct(variable) else np.dtype(variable.dtype).itemsize


def _align(size: int, unit: int) -> int:
    return -(-size // unit) * unit


class TaskSchema:
    """The message format of one task's cycles.

    Args:
        about: The task.
    """

    def __init__(self, about: TaskAbout) -> None:
        self.about = about
        self._group = group_of(about.outvar, range(len(about.outvar)))
        self._shown = [v for v in about.outvar if v.name not in about.hidden]
        last, end = self._places(_HEAD_BYTES)
        earlier, earlier_end = self._places(_EARLIER_BYTES)
        self._fields = [(one, place, last[one.name]) for one, place in self._groups()]
        self._blanks = _blanks(about)
        pieces = [
            (place, _bytes_of(one), last[one.name], earlier[one.name])
            for one, place in self._groups()
        ]
        blanks = self._blanks.get(Step.CYCLE, [])
        self._pieces = _joined(pieces)
        self.layout = Layout(self._pieces, blanks, end, earlier_end)
        self.prefix = len(CDR) + end
        """Size of a message before its byte sequences."""

    def _groups(self) -> list[tuple[Variable, int]]:
        """Return the variables that are recorded, with their places in the group."""
        pairs = zip(self.about.outvar, self._group.at, strict=True)
        return [(one, place) for one, place in pairs if one in self._shown]

    def _places(self, at: int) -> tuple[dict[str, int], int]:
        """Return the variables' places in a cycle after some bytes, and its end."""
        found: dict[str, int] = {}
        for variable in self._shown:
            found[variable.name] = at = _align(at, _unit(variable))
            at += _bytes_of(variable)
        return found, _align(at, 4)

    @property
    def name(self) -> str:
        """The name of the schema."""
        return f"pbonet/{_camel(self.about.subsystem)}{_camel(self.about.task)}"

    def text(self) -> str:
        """Return the ``ros2msg`` definition."""
        variables = [
            f"{_ros_type(v)} {field_name(v.name)}  # {told}"
            for v in self._shown
            for told in [f"{v.name} [{v.units}] {_line(v.desc)}"]
        ]
        rest = [
            "uint8[] inputs  # in-vars in the format of the table",
            "uint8[] heard  # inputs from outside; see pbonet.outside",
        ]
        return "\n".join([
            *(f"{kind} {name}  # {desc}" for name, kind, desc in HEAD),
            *variables,
            "uint8[] consumed  # pairs of register and number, as uint64",
            *rest,
            f"{self.name}Before[] cycles_before  # the oldest first; what one does not "
            "say is as here, and cycle and number rise by 1",
            "=" * 80,
            f"MSG: {self.name}Before",
            *(f"{kind} {name}  # {desc}" for kind, name, desc in EARLIER),
            *variables,
            "uint8[] consumed  # none: as in the last cycle, each number less by 1 for "
            "each cycle between",
            *rest,
            "",
        ])

    def metadata(self) -> dict[str, str]:
        """Return the metadata of the channel."""
        fields = {
            field_name(v.name): {
                "variable": v.name,
                "units": v.units,
                "description": v.desc,
                "type": v.type,
            }
            for v in self._shown
        }
        return {
            "task": self.about.task,
            "rtpu": self.about.rtpu,
            "module": self.about.module,
            "fields": msgspec.json.encode(fields).decode(),
            "about": msgspec.json.encode(self.about).decode(),
        }

    def encode(self, records: bytes) -> list[tuple[int, int, int, int, bytes]]:
        """Return the messages of a ring's records, in their order.

        Returns:
            The kind of each, how many records it has, release and end of the last one,
            and the message.

        Raises:
            NodeError: The records are damaged.
        """
        return [
            (kind, count, release, end, data)
            if kind in COMMITS
            else (kind, count, release, end, self._encode_step(memoryview(data), kind))
            for kind, count, release, end, data in self.layout.fold(records, SPAN_NS)
        ]

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

    def _encode_step(self, text: memoryview, kind: int) -> bytes:
        """Return the message for a record between cycles."""
        n_bytes = RECORD.unpack_from(text)[2]
        head = RECORD.size + _HEAD_BYTES
        return b"".join((
            CDR,
            text[RECORD.size : head],
            _LENGTH.pack(n_bytes),
            self._shown_of(kind, text[head : head + n_bytes]),
        ))

    def _shown_of(self, kind: int, data: memoryview) -> memoryview | bytes:
        """Return copied values with zeros for the variables that are not recorded."""
        places = self._blanks.get(kind)
        if not places or not data:
            return data
        out = bytearray(data)
        for first, size in places:
            out[first : first + size] = bytes(len(out[first : first + size]))
        return bytes(out)

    def group(self, message: bytes) -> bytes:
        """Return the group of out-vars of a cycle, in the format of a table.

        Variables that are not recorded are 0.
        """
        out = bytearray(self._group.bytes)
        for place, size, last, _ in self._pieces:
            first = len(CDR) + last
            out[place : place + size] = message[first : first + size]
        return bytes(out)

    def groups(self, cycles: Rows) -> list[bytes]:
        """Return the group of out-vars of each cycle, as `group` does of one."""
        rows, size = cycles.firsts(self.prefix), self._group.bytes
        out = np.zeros((len(cycles), size), np.uint8)
        for place, count, last, _ in self._pieces:
            first = len(CDR) + last
            out[:, place : place + count] = rows[:, first : first + count]
        text = out.tobytes()
        return [text[n * size : (n + 1) * size] for n in range(len(cycles))]

    def rest(self, message: bytes) -> tuple[bytes, bytes, bytes]:
        """Return pairs, inputs and inputs from outside of a message, as bytes."""
        return _sequences(message, self.prefix)

    def heads(self, messages: Rows) -> dict[str, NDArray[Any]]:
        """Return the columns of `HEAD`, one row per message."""
        return heads(messages.firsts(self.prefix))

    def arrays(self, messages: Rows) -> dict[str, NDArray[Any]]:
        """Return the columns of `HEAD` and the variables, one row per message."""
        rows = messages.firsts(self.prefix)
        found = heads(rows)
        for variable, _, at in self._fields:
            first = len(CDR) + at
            part = rows[:, first : first + _bytes_of(variable)]
            values = np.ascontiguousarray(part).view(np.dtype(variable.dtype))
            found[variable.name] = values
        return found


class StepSchema:
    """The format of a task's other records: the head, and the data as bytes."""

    NAME: Final = "pbonet/Step"
    PREFIX: Final = len(CDR) + _HEAD_BYTES

    @staticmethod
    def text() -> str:
        """Return the ``ros2msg`` definition."""
        lines = [f"{kind} {name}  # {desc}" for name, kind, desc in HEAD]
        return "\n".join([*lines, "uint8[] data  # by kind; see pbonet.log.Step", ""])

    @staticmethod
    def data(message: bytes) -> bytes:
        """Return the data of a message."""
        at = StepSchema.PREFIX + _LENGTH.size
        return message[at:]


def heads(rows: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Return the columns of `HEAD` from the first bytes of messages."""
    part = np.ascontiguousarray(rows[:, len(CDR) : len(CDR) + _HEAD_BYTES])
    table = part.view(HEAD_DTYPE).reshape(-1)
    return {name: table[name].copy() for name, _, _ in HEAD}


def head(message: bytes) -> Any:  # noqa: ANN401 - numpy.void
    """Return the head of one message, with the fields of `HEAD`."""
    return np.frombuffer(message, HEAD_DTYPE, 1, len(CDR))[0]


def _sequences(message: bytes, at: int) -> tuple[bytes, bytes, bytes]:
    (size,) = _LENGTH.unpack_from(message, at)
    pairs = at + _LENGTH.size
    middle = pairs + size
    (size,) = _LENGTH.unpack_from(message, middle)
    inputs = middle + _LENGTH.size
    end = inputs + size
    last = end + -size % _LENGTH.size + _LENGTH.size
    return message[pairs:middle], message[inputs:end], message[last:]


def _blanks(about: TaskAbout) -> dict[int, list[tuple[int, int]]]:
    """Return the places of variables that are not recorded, by kind of copy."""
    copied = {
        Step.CYCLE: about.invar,
        Step.VARS_IN: about.invar,
        Step.ON_IN: [*about.invar, *about.outvar],
        Step.CONSTS_IN: about.inconst,
        Step.CONSTS_OUT: about.outconst,
    }
    found: dict[int, list[tuple[int, int]]] = {}
    for kind, variables in copied.items():
        at = 0
        for variable in variables:
            if variable.name in about.hidden:
                found.setdefault(int(kind), []).append((at, var_bytes(variable)))
            at += var_bytes(variable)
    return found


def _joined(
    pieces: list[tuple[int, int, int, int]],
) -> list[tuple[int, int, int, int]]:
    """Return pieces of memory, with those that follow one another everywhere as one."""
    found: list[tuple[int, int, int, int]] = []
    for piece in pieces:
        place, size, last, earlier = piece
        if found:
            before = found[-1]
            behind = tuple(at + before[1] for at in (before[0], *before[2:]))
            if behind == (place, last, earlier):
                found[-1] = (before[0], before[1] + size, *before[2:])
                continue
        found.append(piece)
    return found


def _is_struct(variable: Variable) -> bool:
    return variable.dtype.startswith("V")


def _ros_type(variable: Variable) -> str:
    if _is_struct(variable):
        return f"uint8[{_bytes_of(variable)}]"
    kind = _ROS[variable.dtype.lstrip("<")]
    return kind if variable.nelem == 1 else f"{kind}[{variable.nelem}]"


def _line(text: str) -> str:
    return " ".join(text.split())


def _camel(text: str) -> str:
    """Return a name in the form of a ROS type name."""
    parts = "".join(c if c.isalnum() else " " for c in text).split()
    return "".join(part[:1].upper() + part[1:] for part in parts) or "X"
