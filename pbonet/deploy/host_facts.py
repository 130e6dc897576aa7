"""Facts about a machine: asked once, by a program that is sent there."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec import Struct

from pbonet.errors import NodeError
from pbonet.xm.net import credentials

from . import steps
from .hosts_file import KEYS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from .hosts_file import Machine
    from .ssh import Shell

_COMMAND: Final = 127
"""The status of a shell whose command is missing."""


class File(Struct, frozen=True):
    """A file of a machine."""

    digest: str
    """SHA-256 of its content."""
    mode: int
    owner: str
    text: str
    """Its content; empty for private keys."""
    written: float = 0.0
    """When, in seconds since 1970."""


class Unit(Struct, frozen=True):
    """A unit of systemd."""

    state: str
    """``active``, ``inactive``, ``failed`` and so on."""
    enabled: bool
    since: float = 0.0
    """When it was started or reloaded, or ended; seconds since 1970."""
    unread: bool = False
    """Whether systemd has not read its files since they were written."""


class Facts(Struct, frozen=True, kw_only=True):
    """A machine as it is."""

    hostname: str
    machine: str
    """Its processor, such as ``x86_64``."""
    python: tuple[int, int]
    venv: bool
    """Whether its Python can make environments."""
    systemctl: bool
    systemd: bool
    """Whether systemd runs it."""
    groups: list[str] | None
    """Groups of the user pbonet; None: there is no such user."""
    files: dict[str, File | None]
    secrets: dict[str, File | None]
    run_folder: bool
    folder: bool
    """Whether ``/opt/pbonet`` is a folder, as host-setup.sh makes it."""
    current: str
    """The release in use; empty: none."""
    previous: str
    releases: list[str]
    free: int
    """Bytes in ``/opt``."""
    units: dict[str, Unit]
    enabled: list[str]
    """RTPUs whose agents start with the machine."""
    online: list[int]
    isolated: list[int]

    def running(self, rtpu: str) -> bool:
        """Return whether an agent runs, or is being started."""
        unit = self.units.get(steps.unit_of(rtpu))
        return unit is not None and unit.state in {"active", "activating", "reloading"}

    def serving(self, rtpu: str) -> bool:
        """Return whether an agent has started, and runs."""
        unit = self.units.get(steps.unit_of(rtpu))
        return unit is not None and unit.state in {"active", "reloading"}

    def behind(self, rtpu: str, paths: Iterable[str]) -> bool:
        """Return whether an agent has not read files since they were written."""
        unit = self.units.get(steps.unit_of(rtpu))
        found = [self.files.get(path) or self.secrets.get(path) for path in paths]
        return unit is not None and any(f and f.written > unit.since for f in found)

    def text(self, path: str) -> str | None:
        """Return the text of a file; None if there is none."""
        found = self.files.get(path)
        return None if found is None else found.text


def paths_of(machine: Machine) -> list[str]:
    """Return the files of a machine that deploy writes, without private keys."""
    fixed = (steps.SYSUSERS, steps.TMPFILES, steps.LIMITS, steps.UNIT)
    own = [
        f(rtpu) for rtpu in machine.configs for f in (steps.config_of, steps.cores_of)
    ]
    return [*fixed, *own, f"{KEYS}/{credentials.CA}", f"{KEYS}/{credentials.CERT}"]


async def ask(shell: Shell, machine: Machine) -> Facts:
    """Return what a machine has.

    Raises:
        NodeError: It has no suitable Python, or its answer makes no sense.
        UnreachableError: The connection was lost.
    """
    program = steps.packaged("print_facts.py").encode()
    lists = (
        paths_of(machine),
        [f"{KEYS}/{credentials.KEY}"],
        [steps.unit_of(rtpu) for rtpu in machine.configs],
    )
    python = machine.host.python
    words = (python, "-", *map(json.dumps, lists))
    done = await shell.run(*words, data=program, check=False)
    if done.status == _COMMAND or "not found" in done.err:
        raise NodeError(
            f"the machine has no {python}",
            where=machine.name,
            expected="Python 3.11 or newer",
            remedy="apt-get install python3 python3-venv there, or name its Python: "
            'python = "/usr/local/bin/python3.12"',
        )
    try:
        return msgspec.json.decode(done.out, type=Facts)
    except msgspec.DecodeError:
        raise NodeError(
            f"{python} could not tell what the machine has",
            where=machine.name,
            got=done.said,
            remedy="name a Python that works there as python in the file of hosts",
        ) from None
