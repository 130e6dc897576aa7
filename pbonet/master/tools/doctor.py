"""Findings about a machine and a domain, each with a remedy (``pbonet doctor``)."""

from __future__ import annotations

import importlib.util
import itertools
import os
import platform
import shutil
import time
from collections import Counter
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec import Struct

import pbonet
from pbonet import shm
from pbonet.errors import ConfigFileError, PbonetError, UnreachableError
from pbonet.master.console import render
from pbonet.master.diagnosis import Finding, Level, keys_of, keys_term, link_verdict
from pbonet.master.subsystem import client_name
from pbonet.versions import REMEDY
from pbonet.xm.net import (
    access_control,
    client_of_router,
    credentials,
    messages as m,
    rpc,
    run_folder,
    session,
    unreachable_reason as out,
)

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Iterator, Mapping, Sequence

    from pbonet.analysis.schedule import Probe

_LEAST_SHM: Final = 64 << 20
"""Bytes of shared memory that a subsystem with a few rings needs."""
_PACKAGES: Final = ("eclipse-zenoh", "numpy", "msgspec", "mcap")
_EXTRAS: Final = {
    "pinocchio": "robot dynamics: pip install 'pbonet[robot]'",
    "ruckig": "online trajectories: pip install 'pbonet[trajectory]'",
    "serial": "serial devices: pip install 'pbonet[devices]'",
}
_WAYS_TIME: Final = 10.0
"""Seconds in which an agent reports, or measures, the ways to all others."""
_AGAIN: Final = 3
"""Agents that measure again, at most."""
_FEW: Final = 6
"""Agents of which each pair has a line."""
_SLOW: Final = 0.05
"""A round trip to an agent of one machine should take no longer, in seconds."""


class Leftover(Struct, frozen=True):
    """An RTPU whose process was killed, according to its state file."""

    domain: str
    rtpu: str


class Neighbour(Struct, frozen=True):
    """An RTPU of another domain on this machine, as its state file tells."""

    domain: str
    rtpu: str
    core: int

    def __str__(self) -> str:
        """Return which one it is."""
        return f"{self.rtpu} of domain {self.domain}"


def examine(
    domain: str,
    *,
    probe: Probe,
    leftovers: Sequence[Leftover] = (),
    neighbours: Sequence[Neighbour] = (),
    connect: Sequence[str] = (),
) -> list[Finding]:
    """Return the findings.

    Args:
        domain: Whose agents are asked.
        probe: The real-time rights of this process.
        leftovers: RTPUs that were killed and not cleaned up after.
        neighbours: RTPUs of other domains on this machine.
        connect: Endpoints of agents on other machines.
    """
    found = [*versions(), *rights(probe), *memory()]
    found += [
        Finding(
            Level.WARN,
            f"RTPU {left.rtpu} of domain {left.domain} was killed and left files",
            "'pbonet doctor --clean' removes them",
        )
        for left in leftovers
    ]
    found += [
        Finding(
            Level.WARN,
            f"no process uses the shared memory {path.name}",
            "'pbonet doctor --clean' removes it",
        )
        for path in abandoned()
    ]
    found += own_keys()
    infos: list[m.AgentInfo] = []
    found += agents(domain, connect, infos)
    return [*found, *cores(infos, probe.cores, neighbours)]


def versions() -> Iterator[Finding]:
    """Check the installed packages."""
    parts = [f"pbonet {pbonet.__version__}", f"Python {platform.python_version()}"]
    parts += [f"{name} {version(name)}" for name in _PACKAGES if _installed(name)]
    kernel = f"{platform.system()} {platform.release()}"
    yield Finding(Level.PASS, f"{', '.join(parts)} on {kernel} ({platform.machine()})")
    for name in _PACKAGES:
        if not _installed(name):
            yield Finding(Level.FAIL, f"{name} is not installed", f"pip install {name}")
    for name, remedy in _EXTRAS.items():
        if importlib.util.find_spec(name) is None:
            yield Finding(Level.WARN, f"{name} is not installed", remedy)


def _installed(name: str) -> bool:
    try:
        version(name)
    except PackageNotFoundError:
        return False
    return True


def rights(probe: Probe) -> Iterator[Finding]:
    """Check real-time permissions and cores."""
    if probe.fifo:
        yield Finding(Level.PASS, f"real time by SCHED_FIFO, kernel {probe.preempt}")
        text = f"real-time tasks may take {probe.share:.1%} of each core"
        yield Finding(Level.PASS, f"{text} ({probe.share_reason})")
    else:
        yield Finding(
            Level.WARN,
            "no SCHED_FIFO: tasks are ranked without real-time guarantees",
            "the next lines explain why",
        )
    for reason in probe.reasons:
        yield Finding(Level.WARN, reason)
    if not probe.lock_memory:
        yield Finding(
            Level.WARN,
            "memory cannot be locked, so a page fault may delay a cycle",
            "raise the memlock limit (ulimit -l unlimited, --ulimit memlock=-1)",
        )
    cores = ", ".join(map(str, probe.cores))
    if len(probe.cores) > 1:
        yield Finding(Level.PASS, f"cores {cores}; {probe.cores[0]} for housekeeping")


def memory() -> Iterator[Finding]:
    """Check shared memory and the runtime folder."""
    folder = shm.folder()
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        yield Finding(Level.FAIL, f"{folder}: {error.strerror}", "mount a tmpfs there")
    else:
        mib = free >> 20
        if free < _LEAST_SHM:
            yield Finding(
                Level.FAIL,
                f"{mib} MiB are free in {folder}",
                "make room, or give the machine more shared memory (--shm-size)",
            )
        else:
            yield Finding(Level.PASS, f"{mib} MiB of shared memory free in {folder}")
    try:
        yield Finding(Level.PASS, f"runtime folder {run_folder.folder()}")
    except PbonetError as error:
        yield Finding(Level.FAIL, error.what, error.remedy)


def abandoned() -> list[Path]:
    """Return shared memory files of this user that no process has mapped.

    None, if a Python of this user does not show what it has mapped: the kernel hides
    that of one that has more rights, such as an agent with a capability. Nor any where
    ``/proc`` shows no processes of others (hidepid), as such a one is then not seen.
    """
    mine = sorted(shm.folder().glob(shm.own("*")))
    used = _mapped(mine)
    return [path for path in mine if str(path) not in used]


def _mapped(paths: Iterable[Path]) -> set[str]:
    """Return which files are mapped by a process of this user, or may be."""
    wanted = {str(path) for path in paths}
    if not os.access("/proc/1/status", os.R_OK):
        return wanted
    used: set[str] = set()
    for maps in Path("/proc").glob("[0-9]*/maps"):
        try:
            text = maps.read_text(encoding="utf-8", errors="replace")
        except PermissionError:
            if _is_own(maps.parent):
                return wanted
            continue
        except OSError:
            continue  # gone
        used |= {path for path in wanted - used if path in text}
    return used


def _is_own(process: Path) -> bool:
    """Return whether a process is a Python of this user, as far as that can be read."""
    try:
        command = (process / "cmdline").read_bytes()
        status = (process / "status").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    uids = next(line for line in status.splitlines() if line.startswith("Uid:"))
    is_python = b"python" in command or b"pbonet" in command
    return is_python and int(uids.split()[2]) == os.geteuid()


def agents(
    domain: str, connect: Sequence[str], infos: list[m.AgentInfo]
) -> Iterator[Finding]:
    """Ask every agent of the domain, and time it; `infos` takes who answers."""
    try:
        opened = session.client(domain, connect=connect)
    except ConfigFileError:  # told of the keys
        return
    except UnreachableError as error:
        alone = not connect and not run_folder.agent_processes(domain)
        level = Level.PASS if alone else Level.FAIL
        where = "" if alone else f"{error.where}: "
        yield Finding(level, f"{where}{error.what}", error.remedy)
        return
    client = rpc.Client(opened, domain, client_name("doctor"))
    try:
        names = client.rtpus()
        if not names:
            where = f"at {' '.join(connect)}" if connect else "on this machine"
            yield Finding(
                Level.FAIL,
                f"the program at {where} has no agent of domain {domain}",
                "name the domain of its agents with --domain",
            )
        greeted, errors = client.call_all({n: m.Hello() for n in names}, m.AgentInfo)
        silent = [name for name in names if name not in greeted]
        for name, unheard in zip(silent, errors, strict=True):
            yield Finding(Level.FAIL, f"{name}: {unheard.what}", unheard.remedy)
        infos += greeted.values()
        for info in infos:
            yield from _timed(client, info)
        yield from _processors_and_links(client, infos)
        yield from _pairs(client, [info.name for info in infos])
        yield from crowded(infos)
        yield from losses(infos)
        for text in m.mismatched(infos):
            yield Finding(Level.FAIL, text, REMEDY)
        for text in m.held(infos):
            yield Finding(Level.FAIL, text, m.HELD_REMEDY)
    finally:
        client.close()


def _timed(client: rpc.Client, info: m.AgentInfo) -> Iterator[Finding]:
    """Ask an agent that has answered once more, alone, and time it."""
    begin = time.perf_counter()
    try:
        client.call(info.name, m.Hello(), m.AgentInfo)
    except PbonetError as error:
        yield Finding(Level.FAIL, f"{info.name}: {error.what}", error.remedy)
        return
    yield from _agent(info, time.perf_counter() - begin)


def _processors_and_links(
    client: rpc.Client, infos: Sequence[m.AgentInfo]
) -> Iterator[Finding]:
    """Tell special purpose processors, and links between subsystems.

    Agents of one machine see the same links.
    """
    machines = {info.machine: info.name for info in infos}
    asked: dict[str, m.Request] = {info.name: m.Status() for info in infos}
    found, _ = client.call_all(asked, m.RtpuStatus)  # silent agents are reported
    for rtpu, status in sorted(found.items()):
        for link in status.tbufs if rtpu in machines.values() else ():
            text = f"{rtpu}: link {render.link_line(msgspec.to_builtins(link))}"
            yield Finding(*link_verdict(link, text))
        for one in status.spps:
            line = render.processor_line(msgspec.to_builtins(one))
            runs = bool(one.back_end) and not one.error
            yield Finding(
                Level.PASS if runs else Level.WARN,
                f"{rtpu}: processor {line}",
                "" if runs else f"see docs/spp.md and [spp.{one.name}] of agent.toml",
            )


def _pairs(client: rpc.Client, names: Sequence[str]) -> Iterator[Finding]:
    """Prove pairs of agents by the last round trip between the two.

    Agents know these of their partners and of a few others, and how many agents they
    see, so each is asked once and sends nothing. Where something is amiss, agents
    measure again, a few at most: each of these asks all others.
    """
    asked: dict[str, m.Request] = {name: m.Links(measure=False) for name in names}
    reports, errors = client.call_all(asked, m.LinkReport, timeout=_WAYS_TIME)
    for error in errors:
        yield Finding(Level.FAIL, f"{error.where}: {error.what}", error.remedy)
    short = {n: one for n, one in reports.items() if not _sees_all(one, len(reports))}
    few = len(reports) <= _FEW  # who knows all; a pair that is missing is not yet asked
    pairs = _ways(reports, told_all=reports if few else short)
    doubtful = [one for (one, _), way in pairs if way is None or way.error]
    again = [*dict.fromkeys(doubtful)][:_AGAIN]
    measured, _ = client.call_all(
        {name: m.Links() for name in again}, m.LinkReport, timeout=_WAYS_TIME
    )
    reports |= measured
    told_all = [n for n, one in reports.items() if n in measured or one.alive is None]
    yield from _each_pair(_ways(reports, told_all=told_all), len(reports))
    for name, report in short.items():
        if name not in told_all:
            yield Finding(
                Level.WARN,
                f"{name} sees {report.alive} of {len(reports) - 1} other agents",
                "see what is said of others first, then check again",
            )
    for name, report in sorted(reports.items()):
        yield from meshed(name, report)
        for news in report.tables:
            yield Finding(
                Level.WARN if news.lost else Level.PASS,
                f"{name} has {news.commits} commits of {news.subsystem} from "
                f"{news.host}, passed over {news.gaps}, refused {news.refused}"
                + (f", lost {news.lost} packets" if news.lost else ""),
                "its agent was kept from running: see what else runs there"
                if news.lost
                else "",
            )
        for other in report.unseen:
            yield Finding(
                Level.WARN,
                f"{name} has a link to {other}, and does not see it",
                "the agent restores the link within some seconds; check again then",
            )
        for other in report.double:
            yield Finding(
                Level.WARN,
                f"{name} has two links to {other}: cuts elsewhere make them stall",
                "let one of the two name the other with --connect, not both, and "
                "start it again",
            )


def meshed(name: str, report: m.LinkReport) -> Iterator[Finding]:
    """Warn if an agent has links of its own to agents of many machines."""
    hosts = {way.host for way in report.ways if way.hops == 1}
    if len(hosts) >= client_of_router.MESH:
        yield Finding(
            Level.WARN,
            f"{name} has links to agents of {len(hosts)} other machines: each works "
            "for all",
            f"beyond {client_of_router.MESH} machines start a router (`pbonet router`) "
            "and name it as routers in each agent.toml, instead of connect",
        )


def crowded(infos: Sequence[m.AgentInfo]) -> Iterator[Finding]:
    """Warn of machines on which many agents are linked with each other.

    These are the first few, and those with endpoints of their own. Each dials those
    that were there before it, so the last one dials all; some may have ended since.
    """
    agents = Counter(info.machine for info in infos)
    dialled: Counter[str] = Counter()
    for info in infos:
        here = sum(one.startswith(access_control.LOCAL) for one in info.dials)
        dialled[info.machine] = max(dialled[info.machine], here)
    hosts = {info.machine: info.host for info in infos}
    for machine, before in sorted(dialled.items()):
        count = min(before + 1, agents[machine])
        if count > client_of_router.MESH:
            yield Finding(
                Level.WARN,
                f"{count} agents of {hosts[machine]} are linked each with each",
                "remove listen, connect and multicast from agent.toml of all but one "
                "or two of them: the others reach other machines through these",
            )


_Pairs = list[tuple[tuple[str, str], m.Way | None]]


def _sees_all(report: m.LinkReport, count: int) -> bool:
    """Return whether an agent says that it sees all of so many, with itself."""
    return report.alive is not None and report.alive + 1 >= count


def _ways(reports: Mapping[str, m.LinkReport], *, told_all: Container[str]) -> _Pairs:
    """Return the path between each two agents, as one of the two reports it.

    Args:
        reports: By agent.
        told_all: Agents whose pairs are missing where neither reports a path. Of others
            there are paths of which they report nothing.
    """
    ways = {
        (report.rtpu, way.rtpu): way
        for report in reports.values()
        for way in report.ways
    }
    pairs = itertools.combinations(sorted(reports), 2)
    found = [((a, b), ways.get((a, b)) or ways.get((b, a))) for a, b in pairs]
    return [
        ((a, b), way)
        for (a, b), way in found
        if way is not None or a in told_all or b in told_all
    ]


def _each_pair(pairs: _Pairs, count: int) -> Iterator[Finding]:
    """Tell each pair of few agents; of many, those that fail and one line for all."""
    sound = [way for _, way in pairs if way is not None and not way.error]
    if count > _FEW and sound:
        trips = [way.trip for way in sound]
        apart = max(abs(way.offset) for way in sound)
        text = f"{len(sound)} pairs of {count} agents see each other: round trips "
        text += f"{render.seconds(min(trips))} to {render.seconds(max(trips))}, clocks "
        yield Finding(Level.PASS, f"{text}at most {apart:.6f} s apart")
    for (one, other), way in pairs:
        if count <= _FEW or way is None or way.error:
            yield _pair(one, other, way)


def _pair(one: str, other: str, way: m.Way | None) -> Finding:
    """Return the findings about the connection between two agents."""
    if way is None:
        return Finding(
            Level.FAIL,
            f"{one} - {other}: they do not see each other",
            "let one of them --connect to the other, or both to a third",
        )
    if way.error:
        return Finding(
            Level.FAIL,
            f"{one} - {other}: {way.error}",
            "a link that was lost is restored within some seconds: check again; if it "
            f"is not, restart {other} (kill -HUP, docs/hosts.md)",
        )
    text = f"{one} - {other}: round trip {render.seconds(way.trip)}"
    if way.hops:
        text += (
            f", clocks {way.offset:+.6f} s apart within {render.seconds(way.spread)}"
        )
    if way.hops > 1:
        text += ", by way of another agent"
    return Finding(Level.PASS, text)


def losses(infos: Sequence[m.AgentInfo]) -> Iterator[Finding]:
    """Report which machines no longer see each other, and since when."""
    for info in infos:
        for lost, more in out.grouped(info.lost):
            behind = ", ".join(f"{one.rtpu} of {one.host}" for one in more)
            yield Finding(
                Level.WARN,
                out.loss(info, lost) + (f", and with it {behind}" if behind else ""),
                out.remedy(info, lost),
            )


def _agent(info: m.AgentInfo, passed: float) -> Iterator[Finding]:
    text = f"{info.name}: core {info.core} of {info.host}, {info.backend}"
    text += f", answers in {render.seconds(passed)}"
    slow = info.machine == run_folder.machine() and passed > _SLOW
    yield Finding(
        Level.WARN if slow else Level.PASS,
        text,
        "the machine is overloaded" if slow else "",
    )
    for limit in info.limits:
        yield Finding(Level.WARN, f"{info.name}: {limit}")
    if info.keys_left is not None:
        yield keys_of(info, info.keys_left)
    if info.version != pbonet.__version__:
        yield Finding(
            Level.WARN,
            f"{info.name} runs pbonet {info.version}, this is {pbonet.__version__}",
            REMEDY,
        )


def own_keys() -> Iterator[Finding]:
    """Check the key folder that the environment names."""
    folder = credentials.named()
    if folder is None:
        return
    try:
        left = credentials.left(credentials.prove(folder))
    except PbonetError as error:
        yield Finding(Level.FAIL, f"{error.where}: {error.what}", error.remedy)
    else:
        remedy = "make others with `pbonet keys master|observer`"
        yield keys_term(f"your keys in {folder}", left, remedy)


def cores(
    infos: Sequence[m.AgentInfo],
    allowed: Sequence[int],
    neighbours: Sequence[Neighbour] = (),
) -> Iterator[Finding]:
    """Check that RTPUs have cores of their own, and leave one to housekeeping."""
    for one in neighbours:
        yield Finding(Level.PASS, f"{one} has core {one.core} of this machine")
    yield from _shared(infos, neighbours)
    here = [info for info in infos if info.machine == run_folder.machine()]
    used = {info.core for info in here} | {one.core for one in neighbours}
    if used and not set(allowed) - used:
        yield Finding(
            Level.WARN,
            "RTPUs own every core of this machine; none is left for housekeeping",
            "let RTPUs share a core (pbonet agent --core)",
        )


def _shared(
    infos: Sequence[m.AgentInfo], neighbours: Sequence[Neighbour]
) -> Iterator[Finding]:
    """Tell RTPUs on one core: the analysis takes each for the owner of its core."""
    owners: dict[tuple[str, int], list[str]] = {}
    hosts = {run_folder.machine(): "this machine"}
    for info in infos:
        owners.setdefault((info.machine, info.core), []).append(info.name)
        hosts[info.machine] = info.host
    for one in neighbours:
        owners.setdefault((run_folder.machine(), one.core), []).append(str(one))
    for (machine, core), sharers in owners.items():
        if len(sharers) > 1:
            yield Finding(
                Level.WARN,
                f"{', '.join(sorted(sharers))} share core {core} of {hosts[machine]}; "
                "`pbonet check` judges each as the owner of a core",
                "add their utilizations up, or give each a core of its own "
                "(pbonet agent --core)",
            )


def clean() -> list[str]:
    """Remove unused shared memory; return the names of what was removed."""
    removed: list[str] = []
    for path in abandoned():
        path.unlink(missing_ok=True)
        removed.append(path.name)
    return removed
