"""Records of agents and of the paths between them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet import versions
from pbonet.versions import LAYERS, UNTOLD, Range

if TYPE_CHECKING:
    from collections.abc import Iterable

HELD_REMEDY = "end that agent and its RTPU process, or start it again"
"""Remedy for a machine in `held`."""


class Lost(Struct, kw_only=True):
    """An agent that another agent has seen and no longer sees."""

    rtpu: str
    host: str
    near: bool
    """Whether the two had a direct link."""
    ago: float
    """Seconds since the first failed attempt to find it."""
    on: dict[str, list[str]] = {}
    """Tasks that were ON when it was last seen, by subsystem; see `AgentInfo`."""


class AgentInfo(Struct, kw_only=True):
    """An agent's identity and abilities."""

    name: str
    domain: str
    host: str
    machine: str
    """Boot identity; equal for processes that share memory."""
    core: int
    cores: int
    pid: int
    rtpu_pid: int
    backend: str
    """``fifo`` or ``park``; the consequences are in `limits`."""
    share: float = 0.0
    """The share of its core that tasks may use; 0: an older agent, which says none."""
    dispatch: float = 0.0
    """CPU seconds that the dispatcher takes of it for each release."""
    share_reason: str = ""
    """Where these two come from."""
    copy_speed: float = 0.0
    """Bytes a second that one of its cores copies, as measured; 0: not measured."""
    limits: list[str] = []
    """Reduced guarantees and their reasons, one sentence each."""
    version: str
    python: str
    protocol: int = 1
    """The newest version of the messages that it takes."""
    versions: dict[str, Range] = {}
    """Versions that it understands of each layer (`pbonet.versions`)."""
    claims: dict[str, int] = {}
    """Subsystems that use the RTPU, and the epoch of each one's claim."""
    libraries: list[str] = []
    names: dict[str, list[str]] = {}
    """Names of things that tasks can open there, by kind such as ``device``; of an
    older agent none are known."""
    zid: str = ""
    """The agent's zenoh identity; new after every start."""
    dials: list[str] = []
    """Endpoints to which it keeps, or tries to open, a link."""
    listens: list[str] = []
    """Endpoints on which it listens, besides the socket of its machine."""
    now_ns: int = 0
    """CLOCK_MONOTONIC of its machine when it answered."""
    keys_left: float | None = None
    """Seconds until its certificate expires; None if it has none."""
    lost: list[Lost] = []
    """Agents that disappeared without announcing their end."""
    on: dict[str, list[str]] = {}
    """Tasks that are ON, for each subsystem that uses the RTPU."""
    rtpu_age: float = 0.0
    """Seconds since the start of the RTPU process."""
    stops: list[str] = []
    """Stop orders that the RTPU has carried out (`Stop.stop_id`), the newest last."""
    due: dict[str, list[tuple[str, str]]] = {}
    """RTPUs that have not carried out stop orders that this agent was given, and the
    identity and the subsystem of each; an empty name: every one."""
    here: list[str] = []
    """RTPUs whose agent or process lives on its machine, with its own."""

    def understands(self, layer: str) -> Range:
        """Return the versions of a layer that it understands."""
        alone = Range(self.protocol, self.protocol) if layer == "commands" else UNTOLD
        return self.versions.get(layer, alone)


class MachineInfo(Struct, kw_only=True):
    """The clock of an agent's machine, and the disk on which its runs are recorded."""

    wall: float
    """Wall-clock time when it answered, seconds since 1970."""
    runs: str
    """The folder of the logs."""
    disk_free: int | None = None
    """Bytes that are free there; None: the folder and those above it are not there."""
    disk_size: int | None = None
    """Bytes of that file system."""


def mismatched(infos: Iterable[AgentInfo]) -> list[str]:
    """Say what these agents, and this program, cannot tell each other, and why."""
    programs = {"this program": {"commands": LAYERS["commands"]}}
    for info in infos:
        told = {layer: info.understands(layer) for layer in LAYERS}
        programs[f"{info.name} of {info.host}"] = told
    return versions.mismatches(programs)


def held(infos: Iterable[AgentInfo]) -> list[str]:
    """Say of which machines nothing is used, as an RTPU there has missed a stop.

    One that has no process any more holds nothing, and one that answers gets the stop.
    """
    infos = list(infos)
    hosts = {name: info.host for info in infos for name in info.here}
    silent = hosts.keys() - {info.name for info in infos}
    found = {
        (rtpu, subsystem or "all subsystems")
        for info in infos
        for rtpu in silent & info.due.keys()
        for _, subsystem in info.due[rtpu]
    }
    return [
        f"{rtpu} of {hosts[rtpu]} does not answer, and has not carried out the stop of "
        f"{subsystem}: until then nothing of {hosts[rtpu]} is used"
        for rtpu, subsystem in sorted(found)
    ]


class Way(Struct, kw_only=True):
    """The path from one agent to another, as measured by round trips."""

    rtpu: str
    host: str = ""
    version: str = ""
    trip: float = 0.0
    """Shortest round trip in seconds."""
    offset: float = 0.0
    """Seconds by which the other machine's monotonic clock is ahead of this one's."""
    spread: float = 0.0
    """Error bound of `offset` in seconds: half of the round trip."""
    hops: int = 0
    """0: the same machine; 1: a direct link; 2: through other agents."""
    error: str = ""
    """Why there was no round trip; empty if there was."""


class TableNews(Struct, kw_only=True):
    """Data from another machine for a subsystem's table."""

    subsystem: str
    host: str
    commits: int
    """Number of groups written to the table."""
    gaps: int
    """Number of commits skipped because newer ones were there."""
    refused: int
    """Number of commits refused by a task of this machine or by a guard."""
    lost: int = 0
    """Number of packets lost because they came too fast for this machine."""


class LinkReport(Struct, kw_only=True):
    """An agent's measurements of the latency to the others."""

    rtpu: str
    ways: list[Way] = []
    tables: list[TableNews] = []
    unseen: list[str] = []
    """Agents to which a link exists but which are not visible; it is opened again."""
    double: list[str] = []
    """Agents to which there are two links, which makes zenoh's routers stall."""
    alive: int | None = None
    """How many other agents it sees; those in `ways` are among them."""


class PortUser(Struct, kw_only=True):
    """The task that has a port of a device."""

    port: int
    task: str
    """``RTPU/TASK``; empty: a program without one."""
    mode: str
    """``NONE``, ``READ``, ``WRITE`` or ``RW``."""
    pid: int


class DeviceFault(Struct, kw_only=True):
    """The last error of a device."""

    text: str
    """The error."""
    task: str
    """``RTPU/TASK`` that had the error; empty: a program without one."""
    age: float
    """Seconds since then."""


class DeviceInfo(Struct, kw_only=True):
    """An I/O device of an agent."""

    name: str
    driver: str
    kind: str
    """Its class, such as ``SIO``; empty for a driver of another package."""
    address: str
    first: int
    """The physical port that is port 0."""
    ports: int
    """Number of ports; 0: as many as the driver finds."""
    users: list[PortUser] = []
    """Its ports that are taken, by tasks of any RTPU of the machine."""
    fault: DeviceFault | None = None
    """The last error of the physical device, of whichever port."""
