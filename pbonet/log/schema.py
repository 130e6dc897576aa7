"""One message per cycle: ``ros2msg`` schemas, and CDR bytes encoded by hand.

A message begins with the fields of `HEAD`, as in a ring's record; then come the
out-vars, then three byte sequences: the (register, number) pairs of the groups that
were copied in, the in-vars if they do not follow from those, and the inputs from
outside, which older logs lack.
Foxglove, PlotJuggler and rerun can read this without a plug-in.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from pbonet.svar import group_of, var_bytes

from .fields import field_name
from .records import Step

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pbonet.config import Variable

    from .records import TaskAbout
    from .rows import Rows

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
STABLE: Final = 1 << 31
"""The flag of a cycle in which ``stable`` ran."""
HELD: Final = 1 << 30
"""The flag of a cycle that was skipped because an input was too old."""
SAFE: Final = 1 << 29
"""The flag of a cycle in which the safe values were written."""
RECORD: Final = struct.Struct("<IIIIII")
"""Size, pairs, bytes of out-vars, of inputs, of inputs from outside, and a spare."""
_HEAD_BYTES: Final = HEAD_DTYPE.itemsize
_LENGTH: Final = struct.Struct("<I")
_TIMES: Final = struct.Struct("<qqq")
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
        self._fields: list[tuple[Variable, int, int]] = []
        at, plain = _HEAD_BYTES, True
        for variable, place in zip(about.outvar, self._group.at, strict=True):
            if variable in self._shown:
                at = _align(at, _unit(variable))
                self._fields.append((variable, place, at))
                plain = plain and at == _HEAD_BYTES + place
                at += _bytes_of(variable)
        self._end = _align(at, 4)
        self._plain = plain and at == _HEAD_BYTES + self._group.bytes
        self._blanks = _blanks(about)
        self.prefix = len(CDR) + self._end
        """Size of a message before its byte sequences."""

    @property
    def name(self) -> str:
        """The name of the schema."""
        return f"pbonet/{_camel(self.about.subsystem)}{_camel(self.about.task)}"

    def text(self) -> str:
        """Return the ``ros2msg`` definition."""
        lines = [f"{kind} {name}  # {desc}" for name, kind, desc in HEAD]
        for v in self._shown:
            told = f"{v.name} [{v.units}] {_line(v.desc)}"
            lines.append(f"{_ros_type(v)} {field_name(v.name)}  # {told}")
        lines += ["uint8[] consumed  # pairs of register and number, as uint64"]
        lines += ["uint8[] inputs  # in-vars in the format of the table"]
        lines += ["uint8[] heard  # inputs from outside; see pbonet.outside"]
        return "\n".join([*lines, ""])

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

    def encode(self, text: memoryview) -> bytes:
        """Return the message for one record of a ring."""
        _, n_consumed, n_bytes, n_inputs, n_heard, _ = RECORD.unpack_from(text)
        head = RECORD.size + _HEAD_BYTES
        data, pairs = head + n_bytes, head + n_bytes + 16 * n_consumed
        inputs = pairs + n_inputs
        gap = bytes(-n_inputs % 4)
        return b"".join((
            CDR,
            text[RECORD.size : head],
            self._variables(text[head:data]),
            _LENGTH.pack(16 * n_consumed),
            text[data:pairs],
            _LENGTH.pack(n_inputs),
            self._shown_of(Step.CYCLE, text[pairs:inputs]),
            gap,
            _LENGTH.pack(n_heard),
            text[inputs : inputs + n_heard],
        ))

    def encode_step(self, text: memoryview, kind: int) -> bytes:
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

    def _variables(self, data: memoryview) -> memoryview | bytes:
        """Return the group in CDR encoding."""
        if self._plain:
            return data
        out = bytearray(self._end - _HEAD_BYTES)
        for variable, place, at in self._fields:
            size, to = _bytes_of(variable), at - _HEAD_BYTES
            out[to : to + size] = data[place : place + size]
        return bytes(out)

    def group(self, message: bytes) -> bytes:
        """Return the group of out-vars of a message, in the format of a table.

        Variables that are not recorded are 0.
        """
        at = len(CDR) + _HEAD_BYTES
        if self._plain:
            return message[at : at + self._group.bytes]
        out = bytearray(self._group.bytes)
        for variable, place, to in self._fields:
            size, first = _bytes_of(variable), len(CDR) + to
            out[place : place + size] = message[first : first + size]
        return bytes(out)

    def rest(self, message: bytes) -> tuple[bytes, bytes, bytes]:
        """Return pairs, inputs and inputs from outside of a message, as bytes."""
        return _sequences(message, self.prefix)

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


def record_size(text: memoryview, at: int) -> int:
    """Return the size of the record at an offset."""
    return int(_LENGTH.unpack_from(text, at)[0])


def times(text: memoryview) -> tuple[int, int, int]:
    """Return release, end, and kind of a ring's record."""
    release, _, end = _TIMES.unpack_from(text, RECORD.size + 8)
    kind = _LENGTH.unpack_from(text, RECORD.size + _HEAD_BYTES - 4)[0]
    return release, end, kind


def _sequences(message: bytes, at: int) -> tuple[bytes, bytes, bytes]:
    (size,) = _LENGTH.unpack_from(message, at)
    pairs = at + _LENGTH.size
    middle = pairs + size
    (size,) = _LENGTH.unpack_from(message, middle)
    inputs = middle + _LENGTH.size
    end = inputs + size
    last = end + -size % _LENGTH.size + _LENGTH.size
    # An older log ends after the inputs.
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
