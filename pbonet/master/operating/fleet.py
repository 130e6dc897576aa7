"""All machines and subsystems of a domain, as their agents tell (``pbonet fleet``).

Every agent is asked for the same few things, all agents at once: so those that do not
answer cost one time limit together.
"""

from __future__ import annotations

import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from pbonet.config import read_sbs
from pbonet.errors import NodeError, PbonetError
from pbonet.master.console import render
from pbonet.master.subsystem import client_name
from pbonet.pbo import State
from pbonet.versions import REMEDY
from pbonet.xm.net import (
    credentials,
    messages as m,
    rpc,
    session,
    unreachable_reason,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

_GIB: Final = 1 << 30
_LOW: Final = 1 * _GIB
"""Free bytes below which a disk is said to be nearly full."""
_APART: Final = 1.0
"""Seconds by which the wall clocks of two machines may differ."""
_AT_ONCE: Final = 256
"""Requests that wait for their answers at one time."""
LAYER: Final = "commands"
"""The layer whose versions are shown as those of the protocol."""


_MACHINE: Final = (
    *("machine", "RTPUs", "pbonet", "protocol", "keys", "free", "clock"),
)
_SUBSYSTEM: Final = ("subsystem", "RTPUs", "tasks", "flag")
"""Heads of the two tables."""


class Rtpu(Struct, frozen=True, kw_only=True):
    """One RTPU."""

    name: str
    core: int
    backend: str
    claims: list[str]
    """The subsystems that use it."""


class Machine(Struct, frozen=True, kw_only=True):
    """One machine."""

    host: str
    rtpus: list[Rtpu]
    versions: list[str]
    """Of pbonet; several where its agents differ."""
    protocol: str
    python: str
    keys_left: float | None
    """Seconds until the first certificate expires; None: it has none."""
    disk_free: int | None
    """Bytes, where runs are recorded; None: not known."""
    runs: str
    clock: float | None
    """Seconds by which its wall clock is ahead of this one's; None: not known."""
    within: float
    """Error bound of that."""


class Subsystem(Struct, frozen=True, kw_only=True):
    """One subsystem."""

    name: str
    rtpus: list[str]
    tasks: dict[str, int]
    """How many tasks are in each state."""
    flag: list[str]
    """Causes for which the illegal-configuration flag is up."""
    unknown: list[str]
    """RTPUs that did not give their status."""


class Away(Struct, frozen=True, kw_only=True):
    """An RTPU that cannot be reached."""

    rtpu: str
    host: str
    what: str
    remedy: str


class Fleet(Struct, frozen=True, kw_only=True):
    """A domain."""

    domain: str
    machines: list[Machine]
    subsystems: list[Subsystem]
    away: list[Away]
    warnings: list[str]


class _Told(Struct):
    """The answers of one agent."""

    info: m.AgentInfo
    machine: m.MachineInfo | None = None
    clock: float = 0.0
    within: float = 0.0


def ask(domain: str, connect: Sequence[str], files: Sequence[Path] = ()) -> Fleet:
    """Return the machines and subsystems of a domain.

    Args:
        domain: Whose agents are asked.
        connect: Endpoints of agents on other machines.
        files: ``.sbs`` files whose RTPUs should be there.

    Raises:
        UnreachableError: No agent can be reached.
        NodeError: The domain has no agent.
        ConfigError: A file is wrong.
    """
    systems = [read_sbs(path) for path in files]
    expected = {entry.name for system in systems for entry in system.rtpus}
    opened = session.client(domain, connect=connect)
    client = rpc.Client(opened, domain, client_name("fleet"))
    try:
        names = client.rtpus()
        if not names:
            raise NodeError(
                "there is no agent",
                where=f"domain {domain}",
                remedy="name the domain of its agents with --domain",
            )
        told, errors = _ask_all(client, names)
        infos = [one.info for one in told.values()]
        subsystems = _subsystems(client, infos)
    finally:
        client.close()
    return Fleet(
        domain=domain,
        machines=_machines(told),
        subsystems=subsystems,
        away=[*_away(infos, names, errors, expected, domain)],
        warnings=[*_warnings(told)],
    )


def _ask_all(
    client: rpc.Client, names: Sequence[str]
) -> tuple[dict[str, _Told], dict[str, PbonetError]]:
    """Ask all agents at once who they are, then for their clocks and disks."""
    infos, failed = client.call_all({one: m.Hello() for one in names}, m.AgentInfo)
    silent = [name for name in names if name not in infos]
    told = {name: _Told(info) for name, info in infos.items()}
    with ThreadPoolExecutor(min(max(len(told), 1), _AT_ONCE)) as pool:
        list(pool.map(partial(_time, client), told, told.values()))
    return told, dict(zip(silent, failed, strict=True))


def _time(client: rpc.Client, name: str, told: _Told) -> None:
    """Ask for a machine's clock and disk; one of an older version has no answer."""
    begin = time.time()
    try:
        told.machine = client.call(name, m.Machine(), m.MachineInfo)
    except PbonetError:
        return
    end = time.time()
    told.clock = told.machine.wall - (begin + end) / 2
    told.within = (end - begin) / 2


def _machines(told: Mapping[str, _Told]) -> list[Machine]:
    groups: dict[str, list[_Told]] = {}
    for one in told.values():
        groups.setdefault(one.info.machine, []).append(one)
    found = [_machine(some) for some in groups.values()]
    return sorted(found, key=lambda machine: (machine.host, machine.rtpus[0].name))


def _machine(told: list[_Told]) -> Machine:
    infos = [one.info for one in told]
    known = [(one, one.machine) for one in told if one.machine is not None]
    clocks = sorted((one.within, one.clock) for one, _ in known)
    disks = [(at.disk_free, at.runs) for _, at in known if at.disk_free is not None]
    keys = [info.keys_left for info in infos if info.keys_left is not None]
    free, runs = min(disks, default=(None, known[0][1].runs if known else ""))
    return Machine(
        host=infos[0].host,
        rtpus=[
            Rtpu(
                name=info.name,
                core=info.core,
                backend=info.backend,
                claims=sorted(info.claims),
            )
            for info in sorted(infos, key=lambda info: info.name)
        ],
        versions=sorted({info.version for info in infos}),
        protocol=", ".join(sorted({str(info.understands(LAYER)) for info in infos})),
        python=infos[0].python,
        keys_left=min(keys, default=None),
        disk_free=free,
        runs=runs,
        clock=clocks[0][1] if clocks else None,
        within=clocks[0][0] if clocks else 0.0,
    )


def _subsystems(client: rpc.Client, infos: Sequence[m.AgentInfo]) -> list[Subsystem]:
    """Ask each RTPU for the state of each subsystem that uses it, all at once.

    So those that do not answer cost one time limit together, however many subsystems
    they have.
    """
    pairs = sorted((name, info.name) for info in infos for name in info.claims)
    with ThreadPoolExecutor(min(max(len(pairs), 1), _AT_ONCE)) as pool:
        answers = dict(
            zip(pairs, pool.map(partial(_status, client), pairs), strict=True)
        )
    users: dict[str, list[str]] = {}
    for name, rtpu in pairs:
        users.setdefault(name, []).append(rtpu)
    return [
        _subsystem(name, {rtpu: answers[name, rtpu] for rtpu in rtpus})
        for name, rtpus in users.items()
    ]


def _status(client: rpc.Client, pair: tuple[str, str]) -> m.RtpuStatus | None:
    """Return a subsystem's status on an RTPU; None: it does not answer."""
    subsystem, rtpu = pair
    try:
        return client.call(rtpu, m.Status(subsystem=subsystem), m.RtpuStatus)
    except PbonetError:
        return None


def _subsystem(name: str, answers: Mapping[str, m.RtpuStatus | None]) -> Subsystem:
    statuses = [one for one in answers.values() if one is not None]
    states = Counter(str(task.state) for one in statuses for task in one.tasks)
    causes = dict.fromkeys(cause for one in statuses for cause in one.illegal)
    return Subsystem(
        name=name,
        rtpus=[*answers],
        tasks=dict(states),
        flag=[*causes],
        unknown=[rtpu for rtpu, one in answers.items() if one is None],
    )


def _away(
    infos: Sequence[m.AgentInfo],
    names: Sequence[str],
    errors: Mapping[str, PbonetError],
    expected: set[str],
    domain: str,
) -> Iterator[Away]:
    """Yield the RTPUs that do not answer, that others have lost, or are expected."""
    for name, error in errors.items():
        remedy, error.remedy = error.remedy, ""
        yield Away(rtpu=name, host="", what=str(error), remedy=remedy)
    lost = {one.rtpu: one.host for info in infos for one in info.lost}
    for name in sorted(({*lost} | expected) - {*names}):
        found = unreachable_reason.first(name, infos)
        if found is not None:
            what = unreachable_reason.loss(*found)
            remedy = unreachable_reason.remedy(*found)
        else:
            error = unreachable_reason.unreachable(name, domain, list(names))
            what, remedy = f"{name}: {error.what}", error.remedy
        yield Away(rtpu=name, host=lost.get(name, ""), what=what, remedy=remedy)


def _warnings(told: Mapping[str, _Told]) -> Iterator[str]:
    """Yield what an operator should mend."""
    infos = [one.info for one in told.values()]
    yield from (f"{text}; {REMEDY}" for text in m.mismatched(infos))
    yield from (f"{text}; {m.HELD_REMEDY}" for text in m.held(infos))
    for machine in _machines(told):
        if machine.disk_free is not None and machine.disk_free < _LOW:
            yield (
                f"{machine.host}: {_size(machine.disk_free)} are free for runs in "
                f"{machine.runs}; remove old ones, or set runs_mb in agent.toml"
            )
        if machine.clock is not None and abs(machine.clock) > _APART + machine.within:
            yield (
                f"{machine.host}: its clock is {machine.clock:+.1f} s off this "
                "machine's; synchronize both (chrony, NTP, PTP)"
            )


def _size(count: int | None) -> str:
    return "?" if count is None else f"{count / _GIB:.1f} GiB"


def text(fleet: Fleet) -> str:
    """Return a domain as tables of machines and subsystems, and what is amiss."""
    lines = [render.table(_MACHINE, [[*_row(one)] for one in fleet.machines])]
    if fleet.subsystems:
        rows = [[*_state(one)] for one in fleet.subsystems]
        lines += ["", render.table(_SUBSYSTEM, rows)]
        lines += [
            f"ILLEGAL> {one.name}: {cause}"
            for one in fleet.subsystems
            for cause in one.flag
        ]
    lines += [f"AWAY> {one.what}; {one.remedy}" for one in fleet.away]
    lines += [f"WARNING> {one}" for one in fleet.warnings]
    return "\n".join(lines)


def _row(machine: Machine) -> Iterator[str]:
    yield machine.host
    yield ", ".join(one.name for one in machine.rtpus)
    yield ", ".join(machine.versions)
    yield machine.protocol.removeprefix("version ")
    left = machine.keys_left
    yield "-" if left is None else "expired" if left <= 0 else credentials.days(left)
    yield _size(machine.disk_free)
    clock = machine.clock
    yield "?" if clock is None else f"{clock:+.3f} s"


def _state(one: Subsystem) -> Iterator[str]:
    yield one.name
    rtpus = [f"{name}?" if name in one.unknown else name for name in one.rtpus]
    yield ", ".join(rtpus)
    order = [state for state in State if state in one.tasks]
    yield ", ".join(f"{one.tasks[state]} {state}" for state in order) or "none"
    yield "UP" if one.flag else "?" if len(one.unknown) == len(rtpus) else "down"
