"""Sets machines up as ``HOSTS.toml`` says: a plan for each, then its steps.

Nothing that is done stops an agent: another release is installed beside the one that
runs, and used by `pbonet upgrade`.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec import Struct

from pbonet.errors import PbonetError

from . import host_facts, host_keys, steps
from .host_reports import Report
from .plan_host import Plan
from .release import fitting
from .ssh import Shell
from .steps import Put, Step

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from .host_keys import HostKeys
    from .hosts_file import HostsFile, Machine
    from .release import Release

AT_ONCE: Final = 8
"""Machines that are worked on at one time."""


_AS_AGENT: Final = (
    *("runuser", "-u", steps.USER, "--", "env", "PBONET_RUN_DIR=/run/pbonet"),
)
"""Runs a command as the agents' user, with the limits that its group has."""


class _Finding(Struct):
    """A line of `pbonet doctor`."""

    level: str
    what: str
    remedy: str = ""


def deploy(
    file: HostsFile,
    releases: Sequence[Release],
    *,
    apply: bool,
    fail_fast: bool = False,
) -> list[Report]:
    """Plan what every machine needs, and do it.

    Args:
        file: The machines.
        releases: What is to be installed: a version, for several kinds of machines;
            none: what is there stays.
        apply: Whether it is done; else it is only planned.
        fail_fast: Work on one machine after the other, and leave the others alone when
            one fails.

    Returns:
        A report of each machine; one that failed does not raise.
    """

    async def one(machine: Machine, report: Report) -> None:
        async with Shell(machine, file) as shell:
            await _set_up(shell, file, releases, report, apply=apply)

    return asyncio.run(each(file.machines, one, fail_fast=fail_fast))


async def each(
    machines: Sequence[Machine],
    work: Callable[[Machine, Report], Awaitable[None]],
    *,
    fail_fast: bool,
) -> list[Report]:
    """Do something with every machine, several at one time; return reports."""
    reports = [Report(host=machine.name) for machine in machines]
    turns = asyncio.Semaphore(1 if fail_fast else AT_ONCE)
    failed = asyncio.Event()

    async def one(machine: Machine, report: Report) -> None:
        async with turns:
            if fail_fast and failed.is_set():
                report.add("host", "waits", "not begun, as another one has failed")
                return
            try:
                await work(machine, report)
            except PbonetError as error:
                report.failed(error)
            if report.state == "failed":
                failed.set()

    await asyncio.gather(*map(one, machines, reports))
    return reports


async def _set_up(
    shell: Shell,
    file: HostsFile,
    releases: Sequence[Release],
    report: Report,
    *,
    apply: bool,
) -> None:
    machine = shell.machine
    keys = _keys(file, machine, apply=apply)
    facts = await host_facts.ask(shell, machine)
    release = fitting(machine, facts, releases)
    plan = Plan(machine, facts, release, keys).steps()
    report.record(plan)
    if apply:
        await carry_out(shell, plan, report)
    if machine.configs and facts.systemd and (apply or report.state == "same"):
        await check(shell, report)


def _keys(file: HostsFile, machine: Machine, *, apply: bool) -> HostKeys | None:
    """Return a machine's keys; those that are lacking are made if it is done."""
    if file.authority is None:
        return None
    keys = host_keys.keys_of(file.authority, machine)
    return host_keys.make(file.authority, machine) if apply and keys.lacks else keys


async def carry_out(shell: Shell, plan: Sequence[Step], report: Report) -> None:
    """Do the steps that are to be done, in their order.

    Raises:
        PbonetError: One failed; the report says which, and those after it are not done.
    """
    try:
        for step in plan:
            if step.state == "change":
                step.state = "failed"
                await act(shell, step)
                step.state = "changed"
    finally:
        report.record(plan)


async def act(shell: Shell, step: Step) -> None:
    """Do what a step says."""
    for action in step.actions:
        if isinstance(action, Put):
            await shell.put(action)
        else:
            await shell.do(action)


async def check(shell: Shell, report: Report) -> None:
    """See that the agents of a machine run, and what `pbonet doctor` finds there."""
    for rtpu in shell.machine.configs:
        unit = steps.unit_of(rtpu)
        done = await shell.run("systemctl", "is-active", unit, check=False)
        if done.status:
            log = await shell.run(
                *("journalctl", "-u", unit, "-t", "pbonet", "-n", "3"),
                *("-o", "cat", "--no-pager"),
                check=False,
            )
            what = f"the agent of {rtpu} is {done.out.strip()}: {log.said or 'no log'}"
            report.add("check", "failed", f"{what}; journalctl -u {unit}")
            return
    await _doctor(shell, report)


async def _doctor(shell: Shell, report: Report) -> None:
    bad: list[str] = []
    others = {*shell.file.homes} - {*shell.machine.configs}
    for domain in shell.machine.domains:
        done = await shell.run(
            *_AS_AGENT,
            *(f"{steps.OPT}/bin/pbonet", "doctor", "--json", "--domain", domain),
            check=False,
        )
        try:
            found = msgspec.json.decode(done.out, type=list[_Finding])
        except msgspec.DecodeError:
            bad.append(f"pbonet doctor failed: {done.said}")
            continue
        bad += [_line(one) for one in found if one.level == "FAIL"]
        lines = [_line(one) for one in found if one.level == "WARN"]
        report.warnings += [one for one in lines if one.partition(":")[0] not in others]
    for line in bad:
        report.add("check", "failed", line)
    if not bad:
        report.add("check", "same", "agents run, and pbonet doctor finds no fault")


def _line(one: _Finding) -> str:
    return f"{one.what}; {one.remedy}" if one.remedy else one.what
