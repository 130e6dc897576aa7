"""Steps in which a machine becomes what it is to be, and where files are there."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

from msgspec import Struct

OPT: Final = "/opt/pbonet"
"""The environment in use: a link to a release."""
RELEASES: Final = "/opt/pbonet-releases"
"""The folder of releases, one environment each."""
PREVIOUS: Final = f"{RELEASES}/previous"
"""The release that was in use before: a link."""
COMPLETE: Final = "complete"
"""A file of a release whose installation has come to its end."""
ETC: Final = "/etc/pbonet"
UNITS: Final = "/etc/systemd/system"
UNIT: Final = f"{UNITS}/pbonet-agent@.service"
SYSUSERS: Final = "/etc/sysusers.d/pbonet.conf"
TMPFILES: Final = "/etc/tmpfiles.d/pbonet.conf"
LIMITS: Final = "/etc/security/limits.d/pbonet.conf"
USER: Final = "pbonet"

State = Literal["same", "change", "changed", "waits", "failed"]


class Put(Struct, frozen=True, kw_only=True):
    """Write a file."""

    path: str
    data: bytes
    mode: int = 0o644
    owner: str = "root"
    group: str = ""
    """Its group; empty: the owner's own."""


class Run(Struct, frozen=True):
    """Run a command as root."""

    words: tuple[str, ...]
    must: bool = True
    """Whether a failure is an error; else the check that follows reports it."""
    data: bytes = b""
    """Its standard input."""
    what: str = ""
    """The error of a failure; empty: that this command has failed."""
    remedy: str = ""
    """The remedy then; empty: the one that follows from the command's output."""


class Step(Struct, kw_only=True):
    """One step: what it is about, and what must be done."""

    name: str
    state: State
    """``same``: it is so already; ``waits``: another command does it; ``change``: to be
    done; ``changed``: done; ``failed``."""
    what: str
    diff: str = ""
    """How the text of a file changes."""
    actions: tuple[Put | Run, ...] = ()


class Shown(Struct, frozen=True, kw_only=True):
    """A step as it is printed."""

    name: str
    state: State
    what: str
    diff: str = ""


def unit_of(rtpu: str) -> str:
    """Return the name of an agent's unit."""
    return f"pbonet-agent@{rtpu}.service"


def config_of(rtpu: str) -> str:
    """Return where an agent's configuration is."""
    return f"{ETC}/{rtpu}.toml"


def cores_of(rtpu: str) -> str:
    """Return where the cores are named that an agent and its tasks may use."""
    return f"{UNITS}/{unit_of(rtpu)}.d/cores.conf"


def packaged(name: str) -> str:
    """Return the text of a file that pbonet brings for machines."""
    return (Path(__file__).parent / name).read_text(encoding="utf-8")
