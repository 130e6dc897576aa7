"""Upgrades the machines of a running system, one after the other.

A machine's agents, RTPU processes and tasks are of one release, so its tasks are moved
or turned off, its agents end, the other release is used, and they start. The next
machine is begun when this one is back.
"""

from __future__ import annotations

import asyncio
import json
import time
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from pbonet.errors import NodeError, PbonetError
from pbonet.versions import Range, mismatches

from . import host_facts, running_tasks, set_up_hosts, steps
from .host_reports import Report
from .hosts_file import keepers
from .plan_host import Plan, use
from .release import fitting
from .ssh import Shell

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pbonet.master.configuration import Place

    from .host_facts import Facts
    from .hosts_file import HostsFile, Machine
    from .release import Release
    from .running_tasks import Moves
    from .steps import Step

BACK: Final = 60.0
"""Seconds after which a machine whose agents were started has not come back."""
_EVERY: Final = 0.3
_LAYERS: Final = (
    "import json, pbonet, pbonet.versions as v; "
    "print(json.dumps([pbonet.__version__, v.LAYERS]))"
)


class Turn(Struct, kw_only=True):
    """One machine's turn."""

    machine: Machine
    report: Report
    facts: Facts
    target: str
    """The release that it is to use."""
    version: str
    """The pbonet version of that."""
    now: dict[str, Range]
    """Versions of each layer that it understands now; empty: nothing is installed."""
    then: dict[str, Range]
    todo: list[Step]
    """Steps that install it."""
    exchanged: bool = False
    """Whether the link leads to that release by our doing."""

    @property
    def rtpus(self) -> list[str]:
        """RTPUs whose agents start with the machine, or are to."""
        return list(dict.fromkeys((*self.machine.configs, *self.facts.enabled)))

    @property
    def running(self) -> list[str]:
        """RTPUs whose agents run."""
        return [rtpu for rtpu in self.rtpus if self.facts.serving(rtpu)]

    @property
    def idle(self) -> list[str]:
        """RTPUs whose agents do not run."""
        return [rtpu for rtpu in self.rtpus if not self.facts.serving(rtpu)]

    @property
    def linked(self) -> bool:
        """Whether it uses the release already."""
        return self.facts.current == self.target

    @property
    def done(self) -> bool:
        """Whether its agents run with the release already."""
        return self.linked and not self.idle


def upgrade(
    file: HostsFile,
    releases: Sequence[Release],
    place: Place,
    *,
    apply: bool,
    yes: bool = False,
) -> list[Report]:
    """Have every machine use another release, one after the other.

    Args:
        file: The machines, and the jobs that are started again.
        releases: The release, for several kinds of machines; none: the one that each
            machine used before.
        place: How agents are reached.
        apply: Whether it is done; else it is only planned.
        yes: Whether tasks may be turned off that nothing declares to be.

    Returns:
        Reports of the machines, in their order. After one that fails, none is begun.

    Raises:
        NodeError: Releases that would meet have no version in common, or tasks would be
            turned off.
        PbonetError: A file is wrong, or no agent can be reached.
    """
    return asyncio.run(_Upgrade(file, releases, place, apply=apply, yes=yes).run())


class _Upgrade:
    def __init__(
        self,
        file: HostsFile,
        releases: Sequence[Release],
        place: Place,
        *,
        apply: bool,
        yes: bool,
    ) -> None:
        self.file = file
        self.releases = releases
        self.place = place
        self.apply = apply
        self.yes = yes
        self.turns: dict[str, Turn] = {}

    async def run(self) -> list[Report]:
        machines = _ordered(self.file)
        reports = await set_up_hosts.each(machines, self._prepare, fail_fast=False)
        if any(one.state == "failed" for one in reports):
            return reports
        turns = [self.turns[machine.name] for machine in machines]
        _must_understand(turns)
        ahead = [turn for turn in turns if not turn.done]
        moves = await asyncio.to_thread(self._moves, ahead)
        for turn in turns:
            self._report(turn, moves)
        if self.apply:
            running_tasks.must_be_allowed(moves, yes=self.yes)
            if not await self._install(machines, reports):
                return reports
            for turn in ahead:
                if not await self._take(turn):
                    break
        return reports

    async def _prepare(self, machine: Machine, report: Report) -> None:
        """Plan the installation of the release, and read which versions meet."""
        async with Shell(machine, self.file) as shell:
            facts = await host_facts.ask(shell, machine)
            release = fitting(machine, facts, self.releases)
            plan = Plan(machine, facts, release, None)
            plan.check()
            todo = plan.install_steps()
            report.record(todo)
            now = (
                await _layers(shell, steps.OPT)
                if facts.current or facts.folder
                else None
            )
            if release is None:
                if not facts.previous:
                    raise NodeError(
                        "the machine has no earlier release",
                        where=machine.name,
                        remedy="name a wheel to install with --wheel",
                    )
                target = facts.previous
                version, then = await _layers(shell, f"{steps.RELEASES}/{target}")
            else:
                target, version = release.name, release.version
                then = release.layers
        self.turns[machine.name] = Turn(
            machine=machine,
            report=report,
            facts=facts,
            target=target,
            version=version,
            now=now[1] if now else {},
            then=then,
            todo=todo,
        )

    async def _install(self, machines: list[Machine], reports: list[Report]) -> bool:
        """Install the release beside the one in use; return whether all have it."""

        async def one(machine: Machine, report: Report) -> None:
            todo = self.turns[machine.name].todo
            if any(step.state == "change" for step in todo):
                async with Shell(machine, self.file) as shell:
                    await set_up_hosts.carry_out(shell, todo, report)

        done = await set_up_hosts.each(machines, one, fail_fast=False)
        for report, new in zip(reports, done, strict=True):
            report.take(new)
        return all(one.state != "failed" for one in done)

    def _moves(self, turns: list[Turn]) -> dict[str, Moves]:
        """Return what becomes of the tasks that are ON, by machine."""
        rtpus = {t.machine.name: [] if t.linked else t.running for t in turns}
        return running_tasks.moves(rtpus, self.file.homes, self.file.jobs, self.place)

    def _report(self, turn: Turn, moves: Mapping[str, Moves]) -> None:
        report = turn.report
        if turn.done:
            report.add("in use", "same", turn.target)
            return
        for line in moves[turn.machine.name].lines():
            report.add("tasks", "change", line)
        old = turn.facts.current or "that of host-setup.sh"
        agents = f"the agents of {', '.join(turn.rtpus)} end and start"
        what = f"{turn.target} in place of {old}; {agents}"
        if turn.linked:
            what = f"{turn.target}; the agents of {', '.join(turn.idle)} start"
        report.add("in use", "change", what)
        if turn.idle:
            report.warnings.append(
                f"the agents of {', '.join(turn.idle)} do not run, so their tasks are "
                "not known: start their job afterwards (pbonet start)"
            )

    def _still_allowed(self, turn: Turn) -> Moves:
        """Return what becomes of the tasks that are ON now; others had their turn.

        Raises:
            NodeError: One came ON meanwhile, and nothing says that it may end.
            PbonetError: As for `running_tasks.moves`.
        """
        found = self._moves([turn])
        running_tasks.must_be_allowed(found, yes=self.yes)
        moves = found[turn.machine.name]
        told = {step.what for step in turn.report.steps}
        for line in moves.lines():
            if line not in told:
                turn.report.add("tasks", "change", line)
        return moves

    async def _take(self, turn: Turn) -> bool:
        """Take a machine's turn; return whether it is back."""
        report, moves = turn.report, running_tasks.Moves(tasks=[])
        try:
            moves = await asyncio.to_thread(self._still_allowed, turn)
            await asyncio.to_thread(running_tasks.move_away, moves, self.place)
            async with Shell(turn.machine, self.file) as shell:
                await self._exchange(shell, turn)
                await set_up_hosts.check(shell, report)
            if report.state != "failed":
                await asyncio.to_thread(self._come_back, turn, moves)
                report.add("tasks", "changed", moves.back())
        except PbonetError as error:
            report.failed(error)
        report.settle()
        if report.state != "failed":
            return True
        report.warnings.append(
            f"the other machines were not begun; {self._way_on(turn)}"
        )
        report.warnings += moves.left()
        return False

    def _way_on(self, turn: Turn) -> str:
        """Return what to do with a machine that has not come back."""
        name = turn.machine.name
        if turn.linked or turn.exchanged:
            back = f"pbonet upgrade {self.file.path} --back --host {name} --apply"
            return f"'{back}' returns to what {name} used"
        return (
            f"the release of {name} was not exchanged: repeat the upgrade when this is "
            "mended, which starts its agents too"
        )

    async def _exchange(self, shell: Shell, turn: Turn) -> None:
        """Use the release, between the end of the agents and their start."""
        facts = await host_facts.ask(shell, turn.machine)
        if (facts.current, facts.previous) != (turn.facts.current, turn.facts.previous):
            raise NodeError(
                "somebody else has changed the machine meanwhile",
                where=turn.machine.name,
                expected=f"{turn.facts.current or 'no release'} in use",
                got=f"{facts.current or 'none'}, before: {facts.previous or 'none'}",
                remedy="agree on who upgrades, and repeat",
            )
        units = [steps.unit_of(rtpu) for rtpu in turn.rtpus]
        if units and not turn.linked:
            await shell.run("systemctl", "stop", *units)
        for action in use(facts, turn.target):
            await shell.do(action)
        turn.exchanged = True
        if units:
            await shell.run("systemctl", "reset-failed", *units, check=False)
            await shell.run("systemctl", "start", *units, check=False)

    def _come_back(self, turn: Turn, moves: Moves) -> None:
        """Wait until the agents answer in the new version, and give them their tasks.

        Raises:
            NodeError: They do not in time.
            PbonetError: A job could not be started again.
        """
        end = time.monotonic() + BACK
        while lacking := self._lacking(turn):
            if time.monotonic() > end:
                raise NodeError(
                    "the agents do not answer as the new release",
                    where=turn.machine.name,
                    expected=f"{', '.join(turn.rtpus)} with pbonet {turn.version}",
                    got=lacking,
                    remedy="see 'journalctl -u pbonet-agent@NAME' there, and pbonet "
                    "fleet",
                )
            time.sleep(_EVERY)
        running_tasks.move_back(moves, self.place, end)

    def _lacking(self, turn: Turn) -> str:
        found = running_tasks.agents(self.place)
        return "; ".join(
            f"{rtpu}: {found[rtpu].version if rtpu in found else 'no answer'}"
            for rtpu in turn.rtpus
            if rtpu not in found or found[rtpu].version != turn.version
        )


def _ordered(file: HostsFile) -> list[Machine]:
    """Return the machines in their order: the keeper's and gateways come last."""
    kept = keepers(file.jobs)

    def late(machine: Machine) -> tuple[bool, bool]:
        return bool(kept & {*machine.configs}), machine.host.role == "gateway"

    return sorted(file.machines, key=late)


def _must_understand(turns: list[Turn]) -> None:
    """Raise if releases that meet on the way have no version in common."""
    for number in range(len(turns) + 1):
        meet = {
            turn.machine.name: turn.then if n < number else turn.now
            for n, turn in enumerate(turns)
        }
        running = {turn.machine.name for turn in turns if turn.running}
        found = mismatches({name: meet[name] for name in meet if name in running})
        if found:
            raise NodeError(
                "the releases cannot work with each other on the way",
                where=f"when {turns[number - 1].machine.name} is upgraded"
                if number
                else "now",
                got="; ".join(found),
                remedy="go by a release that understands both (CHANGELOG.md names "
                "those that dropped a version), or stop the system first: pbonet stop",
            )


async def _layers(shell: Shell, folder: str) -> tuple[str, dict[str, Range]]:
    """Return the version of an installed release, and what it understands."""
    done = await shell.run(f"{folder}/bin/python", "-c", _LAYERS)
    version, layers = json.loads(done.out)
    return version, {name: Range(*both) for name, both in layers.items()}
