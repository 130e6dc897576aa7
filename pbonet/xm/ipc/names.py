"""Names of resources, ``RTPU:RESOURCE``, and their files.

A name without a colon is a resource of the RTPU that the process belongs to, so a
module need not know where it runs. Nothing here imports zenoh, because tasks use it.
"""

from __future__ import annotations

import os
import re
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pbonet import shm
from pbonet.errors import UnreachableError, XmMissingError, XmNameError, did_you_mean
from pbonet.xm.net import run_folder

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

NOWHERE = "local"
"""The RTPU of a process that belongs to none."""
_RESOURCE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+\-]{0,63}")


class Home(NamedTuple):
    """The RTPU and domain that a process belongs to."""

    domain: str
    rtpu: str
    priority: Callable[[], int]
    """Default priority of its waits: a task's criticality."""
    subsystem: str = ""
    """Subsystem of a task; empty for other processes."""


class Name(NamedTuple):
    """The parts of a resource's name."""

    domain: str
    rtpu: str
    resource: str

    def __str__(self) -> str:
        """Return the name as ``RTPU:RESOURCE``."""
        return f"{self.rtpu}:{self.resource}"

    def path(self, kind: str) -> Path:
        """Return its file; `kind` is ``sem``, ``queue``, ``shm`` or ``tbuf``."""
        place = ":".join(self)
        return shm.path_of(f"{place}.{kind}")


def _no_priority() -> int:
    return 0


_home = Home(os.environ.get("PBONET_DOMAIN", "default"), NOWHERE, _no_priority)


def live_on(
    rtpu: str,
    *,
    domain: str = "default",
    priority: Callable[[], int] = _no_priority,
    subsystem: str = "",
) -> None:
    """Set the RTPU that this process belongs to; the runtime does so for its tasks.

    Args:
        rtpu: The RTPU of names without a colon.
        domain: The domain of all its names.
        priority: Called when a wait gives no priority.
        subsystem: The subsystem that it belongs to, if any.
    """
    global _home  # noqa: PLW0603 - a process has one home
    run_folder.check_name("an RTPU", rtpu)
    run_folder.check_name("a domain", domain)
    _home = Home(domain, rtpu, priority, subsystem)


@contextmanager
def living_on(rtpu: str, *, domain: str, subsystem: str = "") -> Generator[None]:
    """Set the RTPU of this process within the block, as for a task in a replay."""
    global _home  # noqa: PLW0603 - a process has one home
    before, _home = _home, Home(domain, rtpu, _no_priority, subsystem)
    try:
        yield
    finally:
        _home = before


def home() -> Home:
    """Return the RTPU and domain that this process belongs to."""
    return _home


def find(text: str | Name) -> tuple[Name, bool]:
    """Return the parts of a name, and whether its RTPU is on this machine.

    A name given as `Name` is on this machine.

    Raises:
        XmNameError: `text` is malformed.
    """
    if isinstance(text, Name):
        return text, True
    name = parse(text)
    return name, is_here(name)


def is_here(name: Name) -> bool:
    """Return whether a name's RTPU is on this machine."""
    return name.rtpu in {_home.rtpu, NOWHERE} or name.rtpu in rtpus(name.domain)


def parse(text: str) -> Name:
    """Return the parts of a name; its RTPU may be on any machine.

    Raises:
        XmNameError: `text` is malformed.
    """
    return parse_at(text, _home.rtpu)


def parse_at(text: str, place: str) -> Name:
    """Return the parts of a name; without a colon it belongs to `place`.

    Raises:
        XmNameError: `text` is malformed.
    """
    rtpu, colon, resource = text.rpartition(":")
    rtpu = rtpu if colon else place
    if not _RESOURCE.fullmatch(resource) or not run_folder.NAME.fullmatch(rtpu):
        raise XmNameError(
            "this is not a valid resource name",
            expected="RTPU:RESOURCE, or RESOURCE alone for the task's own RTPU, of "
            "letters, digits, and _ - . after the first",
            got=repr(text[:100]),
            remedy="rename it",
        )
    return Name(_home.domain, rtpu, resource)


def resolve(text: str | Name, *, remedy: str) -> Name:
    """Return the name of a resource that must be on this machine.

    Args:
        text: The name; given as `Name` it is on this machine.
        remedy: What to do if it is on another machine.

    Raises:
        XmNameError: `text` is malformed.
        UnreachableError: Its RTPU is on another machine, or does not exist.
    """
    name, here = find(text)
    if here:
        return name
    raise UnreachableError(
        f"RTPU {name.rtpu} is not on this machine",
        where=str(name),
        expected="an RTPU that runs here, in domain " + name.domain,
        got=f"{', '.join(sorted(rtpus(name.domain))) or 'none'}",
        remedy=did_you_mean(name.rtpu, rtpus(name.domain)) or remedy,
    )


def rtpus(domain: str) -> set[str]:
    """Return the RTPUs of `domain` that run on this machine."""
    here = run_folder.folder() / domain
    names = {path.stem for path in here.glob("*.rtpu")}
    return {name for name in names if run_folder.is_held(here / f"{name}.rtpu")}


def standing(kind: str, domain: str) -> list[str]:
    """Return the names of the resources of a kind that exist on this machine."""
    prefix, suffix = shm.own(f"{domain}:"), f".{kind}"
    try:
        found = os.listdir(shm.folder())  # noqa: PTH208 - three times as fast
    except FileNotFoundError:  # it was removed, with all of them
        return []
    return sorted(
        name.removeprefix(prefix).removesuffix(suffix)
        for name in found
        if name.startswith(prefix) and name.endswith(suffix)
    )


def missing(name: Name, kind: str) -> XmMissingError:
    """Return the error for a resource that does not exist."""
    what = _WORDS[kind]
    there = standing(kind, name.domain)
    return XmMissingError(
        f"there is no such {what}",
        where=str(name),
        got=f"{', '.join(there) or 'none at all'}",
        remedy=did_you_mean(str(name), there) or f"create it; {_MAKER[kind]} does",
    )


_MAKER = {
    "sem": "xm.semaphore(name, initial=...)",
    "queue": "xm.queue(name)",
    "tbuf": "tbuf.Reader(name, dtype)",
    "shm": "xm.segment(name, size)",
}
_WORDS = {"sem": "semaphore", "queue": "queue", "tbuf": "link", "shm": "segment"}
