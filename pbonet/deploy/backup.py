"""Copies of what machines are configured by, and how it is put back.

A backup is a folder. It has the file of hosts and the jobs, and a folder for each
machine with its files as they stand there. Private keys are not copied: the authority's
folder has them, and `pbonet deploy` gives them again.
"""

from __future__ import annotations

import asyncio
import difflib
import hashlib
import shutil
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated as A, Final

import msgspec
from msgspec import Meta, Struct

from pbonet.errors import ConfigFileError, NodeError
from pbonet.xm.net import credentials

from . import set_up_hosts, steps
from .host_reports import Report
from .hosts_file import KEYS
from .print_config_files import PATTERNS
from .ssh import Shell
from .steps import Put, Run, Step

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from .hosts_file import HostsFile, Machine

MANIFEST: Final = "backup.json"
FORMAT: Final = 1
HOSTS: Final = "hosts.toml"
_KEY: Final = f"{KEYS}/{credentials.KEY}"
_EMPTY: Final = hashlib.sha256(b"").hexdigest()
_JOB_FILES: Final = {".job", ".sbs", ".svar", ".rmod", ".seq", ".toml", ".py"}


class Copied(Struct, frozen=True, kw_only=True):
    """A file of a machine."""

    path: str
    mode: A[int, Meta(ge=0, le=0o7777)]
    owner: str
    """The user; a number where the machine has no name for it."""
    digest: str
    group: str = ""
    """The group; empty, in backups of earlier releases: the user's own."""


class Content(Copied, frozen=True, kw_only=True):
    """The same, with what is in it; empty for private keys."""

    data: bytes

    @property
    def secret(self) -> bool:
        """Whether its content was kept back, as it has a private key."""
        return not self.data and self.digest != _EMPTY


class Told(Struct, frozen=True, kw_only=True):
    """A machine's files, agents and release."""

    files: list[Content]
    enabled: list[str]
    release: str


class Saved(Struct, frozen=True, kw_only=True):
    """The list of what a machine's folder has."""

    format: int
    files: list[Copied]
    enabled: list[str]
    """RTPUs whose agents start with the machine."""
    release: str
    """The release that was in use."""


def save(file: HostsFile, folder: Path) -> list[Report]:
    """Copy what every machine is configured by, with the jobs.

    Args:
        file: The machines.
        folder: A new or empty folder.

    Returns:
        A report of each machine; one that failed does not raise.

    Raises:
        ConfigFileError: The folder has files, or cannot be written.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise ConfigFileError(
                "the folder is not empty",
                where=str(folder),
                remedy="name a new folder for each backup",
            )
        shutil.copy(file.path, folder / HOSTS)
        for job in file.jobs:
            _save_job(job, folder / "jobs" / job.parent.name)
    except OSError as error:
        raise ConfigFileError(
            "the backup cannot be written",
            where=str(folder),
            got=error.strerror or str(error),
            remedy="name a folder in which you may write, with room",
        ) from None

    async def one(machine: Machine, report: Report) -> None:
        async with Shell(machine, file) as shell:
            told = await _collect(shell)
        _write(folder / machine.name, told)
        secret = [one.path for one in told.files if one.secret]
        count = len(told.files) - len(secret)
        report.add("backup", "changed", f"{count} files, release {told.release or '-'}")
        report.warnings += [
            f"{path} has a private key, and is not in the backup"
            for path in secret
            if path != _KEY
        ]

    return asyncio.run(set_up_hosts.each(file.machines, one, fail_fast=False))


def restore(file: HostsFile, folder: Path, *, apply: bool) -> list[Report]:
    """Give machines back what a backup has.

    Args:
        file: The machines.
        folder: The backup.
        apply: Whether it is done; else it is only planned.

    Returns:
        A report of each machine; one that failed does not raise.
    """

    async def one(machine: Machine, report: Report) -> None:
        saved = _read(folder / machine.name)
        async with Shell(machine, file) as shell:
            told = await _collect(shell)
            plan = [*_plan(folder / machine.name, saved, told)]
            report.record(plan)
            if apply:
                await set_up_hosts.carry_out(shell, plan, report)
            if saved.release != told.release:
                report.warnings.append(
                    f"the backup was made with release {saved.release or '-'}, and "
                    f"{told.release or 'none'} is in use: see pbonet upgrade"
                )

    return asyncio.run(set_up_hosts.each(file.machines, one, fail_fast=False))


async def _collect(shell: Shell) -> Told:
    python = shell.machine.host.python
    program = steps.packaged("print_config_files.py")
    done = await shell.run(python, "-", data=program.encode())
    try:
        told = msgspec.json.decode(done.out, type=Told)
    except msgspec.DecodeError:
        told = None
    if told is None or not all(_is_plain(one.path) for one in told.files):
        raise NodeError(
            f"{python} could not tell which files the machine has",
            where=shell.machine.name,
            got=done.said,
            remedy="name a Python that works there as python in the file of hosts",
        )
    return told


def _is_plain(path: str) -> bool:
    """Return whether a path is one of those that a machine is configured by.

    A machine in wrong hands could name one that leads out of the backup's folder, and
    a backup in wrong hands one of any file of the machine.
    """
    return any(PurePosixPath(path).match(f"/{one}") for one in PATTERNS)


def _save_job(job: Path, folder: Path) -> None:
    """Copy a job with the files beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in sorted(job.parent.iterdir()):
        if path.suffix in _JOB_FILES and path.is_file():
            shutil.copy(path, folder / path.name)


def _write(folder: Path, told: Told) -> None:
    for one in told.files:
        if one.data:
            path = folder / one.path.lstrip("/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(one.data)
    files = [
        Copied(path=f.path, mode=f.mode, owner=f.owner, digest=f.digest, group=f.group)
        for f in told.files
        if f.path == _KEY or not f.secret
    ]
    saved = Saved(
        format=FORMAT, files=files, enabled=told.enabled, release=told.release
    )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MANIFEST).write_bytes(msgspec.json.format(msgspec.json.encode(saved)))


def _read(folder: Path) -> Saved:
    path = folder / MANIFEST
    try:
        found = msgspec.json.decode(path.read_bytes(), type=Saved)
    except (OSError, msgspec.DecodeError) as error:
        raise ConfigFileError(
            "the backup has nothing of this machine",
            where=str(path),
            got=getattr(error, "strerror", "") or str(error),
            remedy="name the folder that pbonet backup has made, or the machines that "
            "it has with --host",
        ) from None
    if found.format != FORMAT:
        raise ConfigFileError(
            "the backup has another format",
            where=str(path),
            expected=str(FORMAT),
            got=str(found.format),
            remedy="restore it with the pbonet that made it",
        )
    for one in found.files:
        if not _is_plain(one.path):
            raise ConfigFileError(
                "the backup names a file that no machine is configured by",
                where=str(path),
                expected=", ".join(f"/{pattern}" for pattern in PATTERNS),
                got=one.path,
                remedy="restore another backup: this list was changed",
            )
    return found


def _saved_data(folder: Path, one: Copied) -> bytes:
    """Return what a file of the backup has, if it is what was saved."""
    path = folder / one.path.lstrip("/")
    try:
        data = b"" if one.digest == _EMPTY else path.read_bytes()
    except OSError as error:
        data, got = None, error.strerror or str(error)
    else:
        got = "another content"
    if data is None or hashlib.sha256(data).hexdigest() != one.digest:
        raise ConfigFileError(
            "a file of the backup is not as it was saved",
            where=str(path),
            expected=f"SHA-256 {one.digest}",
            got=got,
            remedy="restore another backup; a configuration is changed in the file of "
            "hosts, by pbonet deploy",
        )
    return data


def _plan(folder: Path, saved: Saved, told: Told) -> Iterator[Step]:
    """Yield what gives a machine its files back."""
    there = {one.path: one for one in told.files}
    was = {one.path: one for one in saved.files}
    certificates = {f"{KEYS}/{name}" for name in (credentials.CERT, credentials.CA)}
    other_key = _KEY in was and (
        _KEY not in there or there[_KEY].digest != was[_KEY].digest
    )
    again: set[str] = set()
    units = False
    for one in saved.files:
        if one.path == _KEY:
            continue
        if one.path in certificates and other_key:
            what = f"{one.path} belongs to other keys: 'pbonet deploy' gives new ones"
            yield Step(name="keys", state="waits", what=what)
            continue
        step = _file_step(folder, one, there.get(one.path))
        yield step
        if step.state == "change":
            units |= one.path.startswith(steps.UNITS)
            again |= _rtpus_of(one.path, saved.enabled)
    yield from _follow(again, saved.enabled, told.enabled, units=units)


def _file_step(folder: Path, one: Copied, there: Content | None) -> Step:
    put = Put(
        path=one.path,
        data=_saved_data(folder, one),
        mode=one.mode,
        owner=one.owner,
        group=one.group,
    )
    changed = "" if there is None else _rights_changed(put, there)
    if there is not None and there.digest == one.digest and not changed:
        return Step(name="file", state="same", what=one.path)
    what = f"{one.path}: {changed}" if changed else one.path
    before = b"" if there is None else there.data
    lines = difflib.unified_diff(
        before.decode("utf-8", "replace").splitlines(),
        put.data.decode("utf-8", "replace").splitlines(),
        one.path,
        one.path,
        lineterm="",
        n=1,
    )
    diff = "" if there is None else "\n".join(lines)
    return Step(name="file", state="change", what=what, diff=diff, actions=(put,))


def _rights_changed(put: Put, there: Copied) -> str:
    """Return how a file's rights change; empty: they are as they were."""
    was = f"{there.owner}:{there.group} {there.mode:04o}"
    group = put.group or there.group
    new = f"{put.owner}:{group} {put.mode:04o}"
    return "" if was == new else f"{was} becomes {new}"


def _rtpus_of(path: str, rtpus: Sequence[str]) -> set[str]:
    """Return the RTPUs whose agents are configured by a file."""
    if path.startswith(f"{KEYS}/"):
        return {*rtpus}
    return {rtpu for rtpu in rtpus if path == steps.config_of(rtpu)}


def _follow(
    again: set[str], enabled: Sequence[str], there: Sequence[str], *, units: bool
) -> Iterator[Step]:
    if units:
        run = (Run(("systemctl", "daemon-reload")),)
        yield Step(name="unit", state="change", what="systemd reads units", actions=run)
    for rtpu in enabled:
        unit = steps.unit_of(rtpu)
        if rtpu not in there:
            what = f"the agent of {rtpu} is enabled and started"
            run = (Run(("systemctl", "enable", "--now", unit)),)
        elif rtpu in again:
            what = f"the agent of {rtpu} reads its configuration again; tasks go on"
            run = (Run(("systemctl", "reload-or-restart", unit)),)
        else:
            continue
        yield Step(name="service", state="change", what=what, actions=run)
