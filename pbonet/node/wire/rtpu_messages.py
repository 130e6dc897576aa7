"""Messages between the processes of one RTPU: msgpack structs and their framing.

Four links, all Unix sockets of one machine and one user:

* agent and RTPU process: a stream socket in the runtime folder, frames of a 4-byte
  length and a body. The agent forwards requests unchanged; the RTPU process answers,
  and sends events and its own state unsolicited.
* RTPU process and another one: on the same socket, one `Order` and its answer.
* RTPU process and fork server: sequenced packets, with file descriptors.
* RTPU process and task: sequenced packets, one message each.

None of this is public: both ends always have the same version, and check it when they
connect.
"""

from __future__ import annotations

import contextlib
import os
import signal
import struct
import sys
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import Struct

from pbonet.config import Entry, SppEntry
from pbonet.errors import NodeError, WireError
from pbonet.xm.net import Call, prepare

from .sanitise_values import of_numpy, readable_tree

if TYPE_CHECKING:
    import asyncio
    import socket

    from pbonet.errors import PbonetError

LENGTH = struct.Struct("<I")
LARGEST_FRAME = 64 << 20
LARGEST_PACKET = 200_000
"""A little less than the kernel's default send buffer."""


class RtpuConfig(Struct, frozen=True, kw_only=True):
    """Settings of an RTPU process, on its command line."""

    domain: str
    name: str
    core: int
    libraries: tuple[str, ...] = ()
    grace: float = 5.0
    backend: str = "auto"
    runs: str = "runs"
    """Folder of the logs, absolute."""
    awake: bool = False
    core_share: float | None = None
    """Share of the core that tasks may use; None: what the kernel grants."""
    devices: dict[str, Entry] = {}
    """I/O devices of the machine by logical name."""
    spps: dict[str, SppEntry] = {}
    """Special purpose processors of the machine by name."""
    ready_fd: int = -1
    """Descriptor to which one `Ready` is written when commands are accepted."""
    agent: int = 0
    """Process id of the agent that starts it."""


DUMP_SIGNAL = signal.SIGQUIT
"""Makes a task write its current stack to its crash file, whatever it is doing."""


class TaskReady(Struct, kw_only=True):
    """A task's description of itself when its `init` is done."""

    module: str
    version: str
    critical_ok: bool
    tells: bool = False
    """Whether it has a handler of timing failures."""
    safe: bytes = b""
    """The out-vars of a cycle that fails in time; empty: SAFE is not given."""
    notes: list[str] = []
    signals: dict[str, int] = {}
    """Names and bits of the module's own signals."""
    info: dict[str, Any] = {}
    """The description of the module, as a `ModuleInfo` is packed."""


class Ready(Struct, kw_only=True):
    """The result of starting an RTPU process or a fork server."""

    error: WireError | None = None


# -- agent to RTPU process ------------------------------------------------------------


class Attach(Struct, tag="attach"):
    """The first message of an agent. Answered by `RtpuInfo`, then events follow."""

    agent_pid: int
    version: str
    grace: float


class Forward(Struct, tag="forward"):
    """A request as received from the network."""

    n: int
    data: bytes
    masters: list[tuple[str, str]] | None = None
    """Subsystem and client of the live masters, if the request needs them."""


class Note(Struct, tag="note"):
    """A remark of the agent, to be numbered as an event."""

    severity: int
    code: str
    text: str
    subsystem: str = ""
    task: str = ""


class Shutdown(Struct, tag="shutdown"):
    """Turn all tasks OFF in order and end."""

    timeout: float


class Arrived(Struct, tag="arrived"):
    """A message from the network for a queue of this RTPU."""

    queue: str
    data: bytes


class Recorder(Struct, tag="recorder", kw_only=True):
    """The state of a recorder."""

    subsystem: str
    run: str = ""
    path: str = ""
    """The log that it writes; empty if none."""
    lost: int = 0
    """Records that could not be written."""
    handed_on: dict[str, int] = {}
    """Records of each task that a recorder after it cannot count: its ring, if it
    stands, says what did not fit it."""


class Alive(Struct, tag="alive"):
    """A sign of life of the agent, every 0.2 s while a subsystem is named."""

    silences: dict[str, float]
    """Subsystems with the keeper on another machine, and for how many seconds that one
    has not answered. Without this message for ``ALONE`` their flag goes up."""


class TakeOver(Struct, tag="takeover"):
    """Turn a standby ON, because its original on another RTPU is lost."""

    subsystem: str
    standby: str
    why: str


FromAgent = Attach | Forward | Note | Recorder | Shutdown | Arrived | Alive | TakeOver


# -- agent to recorder, and back ------------------------------------------------------


class LogLimits(Struct, frozen=True):
    """Limits of an agent's logs in MB (1e6 bytes) and minutes; 0: no limit."""

    log_mb: float = 0.0
    log_minutes: float = 0.0
    runs_mb: float = 0.0
    """The limit of all logs in the folder of the runs."""


class Recording(Struct, kw_only=True):
    """The plan of a recording; in a memory file of the recorder."""

    domain: str
    rtpu: str
    subsystem: str
    core: int
    folder: str
    """The run's own folder."""
    file: str
    """Name of the log, without ``.mcap``."""
    run: str
    job: str
    mode: str
    tasks: dict[str, str] = {}
    """Modes of single tasks."""
    hidden: list[str] = []
    """Variables that are not recorded."""
    files: dict[str, str] = {}
    """Configuration files: text by name."""
    last: float = 0.0
    """Seconds before an error that are recorded; 0: everything is recorded."""
    limits: LogLimits = LogLimits()
    lost: dict[str, int] = {}
    """Records of each task that recorders before this one have lost: the RTPU process
    keeps this for the next agent's."""
    before: list[Commanded] = []
    """Earlier commands, already answered; the pipe to a recorder is too small for all
    of them at once."""


class Happened(Struct, tag="happened"):
    """A packed event."""

    data: bytes


class Apart(Struct):
    """The offset of another machine's clock from this one's."""

    rtpu: str
    machine: str
    offset_ns: int
    """Nanoseconds by which it is ahead."""
    within_ns: int
    """The uncertainty of the offset."""


class Clocks(Struct, tag="clocks"):
    """The offsets of other machines' clocks from this one's."""

    machine: str
    others: list[Apart]


class Commanded(Struct, tag="commanded"):
    """An answered command, as JSON."""

    subsystem: str
    data: bytes


ToRecorder = Happened | Clocks | Commanded
FromRecorder = Note | Recorder


# -- RTPU process to agent ------------------------------------------------------------


class OpenTable(Struct, frozen=True):
    """A table that an RTPU has open."""

    keep: bool
    """Whether this RTPU keeps it: operators set variables there."""
    keeper: str = ""
    """The RTPU that keeps it."""
    alone: float = 0.0
    """Seconds without its machine after which the flag goes up; 0: never."""


class Standby(Struct, frozen=True, kw_only=True):
    """A task that takes over by itself when its original on another RTPU is lost."""

    subsystem: str
    standby: str
    original: str
    rtpu: str
    """That of the original."""
    takeover: float
    """Seconds without the original."""
    outputs: tuple[str, ...]
    """The variables that the standby writes."""


class RtpuInfo(Struct, tag="info", kw_only=True):
    """Identity of the RTPU process."""

    pid: int
    core: int
    version: str
    backend: str
    limits: list[str]
    claims: dict[str, int]
    share: float = 1.0
    """Share of the core that its tasks may use, as in `AgentInfo`."""
    dispatch: float = 0.0
    share_reason: str = ""
    started_ns: int = 0
    """CLOCK_MONOTONIC at its start."""
    stops: list[str] = []
    """Stop orders that were carried out, the newest last."""
    tables: dict[str, OpenTable] = {}
    """The open tables, by subsystem."""
    recordings: dict[str, Recording] = {}
    """Recordings, by subsystem."""
    standbys: list[Standby] = []
    """Standbys whose originals the agent watches."""


class Answered(Struct, tag="answered"):
    """The packed answer to a forwarded request."""

    n: int
    data: bytes


class Published(Struct, tag="published"):
    """A packed event for the network."""

    data: bytes


class Ending(Struct, tag="ending"):
    """The RTPU process ends, all tasks are OFF; the reason is for display."""

    reason: str


class Called(Struct, tag="called"):
    """Tasks have ended whose successors are on other machines."""

    subsystem: str
    calls: list[Call]


FromRtpu = RtpuInfo | Answered | Published | Called | Ending


# -- RTPU process to another one of its machine ---------------------------------------


class Order(Struct, tag="order", frozen=True):
    """A signal that a module sends to a task which its own RTPU does not have."""

    subsystem: str
    task: str
    signal: str


class Obeyed(Struct, frozen=True, kw_only=True):
    """The answer to an `Order`."""

    here: bool
    """Whether the RTPU has the task; else nothing was done."""
    error: WireError | None = None
    """Why the signal was refused, or failed."""


ToRtpu = FromAgent | Order


# -- RTPU process and fork server -----------------------------------------------------


class Fork(Struct, tag="fork"):
    """Fork a task; its socket, output, and two memory files come with the message."""

    n: int
    kind: str
    """``task`` or ``inspect``."""
    title: str


class Forked(Struct, tag="forked"):
    """A child was forked, or could not be."""

    n: int
    pid: int
    error: str = ""


class Exited(Struct, tag="exited"):
    """A child ended, with its status as returned by `os.waitstatus_to_exitcode`."""

    pid: int
    code: int


FromForkServer = Forked | Exited


# -- RTPU process to task -------------------------------------------------------------


class Signal(Struct, tag="signal"):
    """A lifecycle signal, valid in the state that the RTPU process knows."""

    n: int
    signal: str
    arg: str = ""
    handover: bool = False
    cede: bool = False
    """For ``off``: it keeps the out-vars until successors take them over."""
    calls: list[Call] = []
    """For ``off``: how the task engages its successors. If one is no longer a standby,
    the ``off`` fails before it begins."""
    replaces: list[str] = []
    """For ``reinit``: tasks that it replaces, and whose constants it takes over."""
    then: Prepare | None = None
    """For ``off``: the tasks for which it becomes a standby when it is OFF."""


class Prepare(Struct, tag="prepare"):
    """Stand by, OFF, until the dispatcher engages the task; without a time limit."""

    n: int
    after: list[str]
    """Tasks whose out-vars it then takes over; empty: it is no longer a standby."""
    owners: list[str] = []
    """Tasks that own these variables before those do."""
    far: list[str] = []
    """Predecessors on other machines. They have released the variables when the task
    is engaged; it does not take them from a task that owns them again."""


class Calls(Struct, tag="calls"):
    """Find successors on other cores, which the next ``off`` engages; this is slow."""

    n: int
    calls: list[Call]


class Disown(Struct, tag="disown"):
    """Release out-vars that were ceded and that no task has taken."""

    n: int


class SetParam(Struct, tag="set"):
    """Change a parameter between two cycles."""

    n: int
    name: str
    value: str


class GetParam(Struct, tag="get"):
    """Get one parameter, or all."""

    n: int
    name: str | None = None


class SetFreq(Struct, tag="freq"):
    """Change the frequency between two cycles."""

    n: int
    hz: float


ToTask = Signal | Prepare | Calls | Disown | SetParam | GetParam | SetFreq


# -- task to RTPU process -------------------------------------------------------------


class Done(Struct, tag="done", kw_only=True):
    """The answer to a message, and the state after it; ``n`` 0 answers the spawn."""

    n: int
    state: str
    result: Any = None
    error: WireError | None = None
    errnum: int = 0
    """The number of an error of the module."""
    place: str = ""
    """Where it happened in the module's code."""
    lost: dict[str, int] = {}
    """Number of notices dropped for lack of room since the last message, by code."""


class Notice(Struct, tag="notice", kw_only=True):
    """An unsolicited report of the task."""

    severity: int
    code: str
    text: str
    cycle: int = 0
    bits: int = 0
    """Signals that the module sent, as bits of `pbonet.Signal`."""
    errnum: int = 0
    """The number that the module gave the error or warning."""
    place: str = ""
    """Where it happened in the module's code."""
    lost: dict[str, int] = {}
    """Number of notices dropped for lack of room before this one, by code."""
    order: tuple[str, str] | None = None
    """Another task of the machine, and the signal that the module sends to it."""
    state: str = ""
    error: WireError | None = None


FromTask = Done | Notice


class TaskSpec(Struct, kw_only=True):
    """The specification of a task; in a memory file, as it may be long."""

    domain: str
    rtpu: str
    subsystem: str
    task: str
    core: int
    slot: int
    table: str
    layout: str
    rmod: str
    rmod_name: str
    freq: float
    ring: str
    libraries: tuple[str, ...]
    replaces: list[str] = []
    """Tasks that it replaces, and whose constants it takes over."""
    devices: dict[str, Entry] = {}
    """I/O devices that it can open."""
    spps: dict[str, SppEntry] = {}
    """Special purpose processors that it can use."""


class InspectSpec(Struct, kw_only=True):
    """The modules that an inspector must describe."""

    libraries: tuple[str, ...]
    name: str | None = None


def encode(message: Struct) -> bytes:
    """Return `message` as msgpack bytes.

    Values from a module may contain numpy's numbers and arrays, which are encoded as
    Python's, and texts that are not valid Unicode; see `sanitise_values.readable`.

    Raises:
        TypeError: A value cannot be encoded; `UNTOLD` lists all such exceptions.
    """
    try:
        return msgspec.msgpack.encode(message, enc_hook=of_numpy)
    except UnicodeEncodeError:
        tree = msgspec.to_builtins(message, builtin_types=[bytes], enc_hook=of_numpy)
        return msgspec.msgpack.encode(readable_tree(tree))


def report_ready(fd: int, error: PbonetError | None = None) -> None:
    """Report through a pipe that a process has started, or why it has not.

    Args:
        fd: The pipe, which is closed afterwards; -1 for none.
        error: What went wrong.
    """
    if fd >= 0:
        with contextlib.suppress(OSError):
            os.write(fd, encode(Ready(error=error.to_wire() if error else None)))
            os.close(fd)


def frame(message: Struct) -> bytes:
    """Return `message` with its length before it."""
    return framed(encode(message))


def framed(body: bytes) -> bytes:
    """Return a packed message with its length before it."""
    return LENGTH.pack(len(body)) + body


async def read_frame(reader: asyncio.StreamReader) -> bytes:
    """Return the body of the next frame.

    Raises:
        asyncio.IncompleteReadError: The other side has closed.
        NodeError: The length is impossible.
    """
    (length,) = LENGTH.unpack(await reader.readexactly(LENGTH.size))
    return await reader.readexactly(_checked(length))


def receive_frame(sock: socket.socket) -> bytes:
    """Return the body of the next frame of a blocking socket, b"" at its end.

    Raises:
        NodeError: The length is impossible.
        OSError: The link broke.
    """
    head = _receive_exactly(sock, LENGTH.size)
    if not head:
        return b""
    (length,) = LENGTH.unpack(head)
    return _receive_exactly(sock, _checked(length))


def _receive_exactly(sock: socket.socket, count: int) -> bytes:
    got = bytearray()
    while len(got) < count:
        part = sock.recv(count - len(got))
        if not part:
            return b""
        got += part
    return bytes(got)


def _checked(length: int) -> int:
    if length > LARGEST_FRAME:
        raise NodeError(
            "a frame between agent and RTPU process is too long",
            expected=f"at most {LARGEST_FRAME} bytes",
            got=f"{length} bytes",
            remedy="run the same pbonet version in both; end the older",
        )
    return length


prepare(sys.modules[__name__])
