"""Records of agents and of the ways between them."""

from __future__ import annotations

from msgspec import Struct


class Lost(Struct, kw_only=True):
    """Another agent that an agent has seen, and sees no more."""

    rtpu: str
    host: str
    near: bool
    """Whether a link of its own stood between the two."""
    ago: float
    """Seconds since it was looked for in vain for the first time."""


class AgentInfo(Struct, kw_only=True):
    """An agent's identity and abilities."""

    name: str
    domain: str
    host: str
    machine: str
    """Boot identity: equal for processes that share memory."""
    core: int
    cores: int
    pid: int
    rtpu_pid: int
    backend: str
    """``fifo`` or ``park``; what it means is in `limits`."""
    limits: list[str] = []
    """Reduced guarantees and their reasons, one sentence each."""
    version: str
    python: str
    claims: dict[str, int] = {}
    """Subsystems that use the RTPU, and the epoch of each."""
    libraries: list[str] = []
    zid: str = ""
    """The agent's zenoh identity; a new one with every start."""
    dials: list[str] = []
    """Endpoints that it keeps a link to, or tries to."""
    listens: list[str] = []
    """Endpoints that it listens on, beside the socket of its machine."""
    now_ns: int = 0
    """CLOCK_MONOTONIC of its machine when it answered."""
    keys_left: float | None = None
    """Seconds that its keys are good for; None if it has none."""
    lost: list[Lost] = []
    """Agents that disappeared without announcing their end."""


class Way(Struct, kw_only=True):
    """The way from one agent to another, as round trips have measured it."""

    rtpu: str
    host: str = ""
    version: str = ""
    trip: float = 0.0
    """Seconds of the shortest round trip."""
    offset: float = 0.0
    """Seconds by which the other machine's monotonic clock is ahead of this one's."""
    spread: float = 0.0
    """Seconds by which `offset` may be wrong: half of the round trip."""
    hops: int = 0
    """0: the same machine; 1: a link of its own; 2: by way of other agents."""
    error: str = ""
    """Why there was no round trip; empty when there was."""


class TableNews(Struct, kw_only=True):
    """Data from another machine for a subsystem's table."""

    subsystem: str
    host: str
    commits: int
    """Groups that are, or were, in the table."""
    gaps: int
    """Commits that were passed over, because newer ones were there."""
    refused: int
    """Commits that a task of this machine or a guard kept out."""
    lost: int = 0
    """Packets that came faster than this machine could take them."""


class LinkReport(Struct, kw_only=True):
    """An agent's measurements of the latency to the others."""

    rtpu: str
    ways: list[Way] = []
    tables: list[TableNews] = []
    unseen: list[str] = []
    """Agents to which a link stands, and that are not seen by it: it is made anew."""
    double: list[str] = []
    """Agents to which two links stand, which makes zenoh's routers stall."""
