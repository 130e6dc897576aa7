"""Lists the semaphores, queues and mailboxes of an RTPU on this machine."""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING

from pbonet.errors import PbonetError, XmError
from pbonet.xm.net import resource_messages as r

from . import names
from ._ipc import Queue, Semaphore
from .mailboxes import PREFIX

if TYPE_CHECKING:
    from collections.abc import Iterator

    from .names import Name

KINDS = ("sem", "queue", "mailbox")


def resources(domain: str, rtpu: str, kind: str) -> list[r.Resource]:
    """Return the resources of a kind that an RTPU has.

    Args:
        domain: The domain.
        rtpu: The RTPU, on this machine.
        kind: One of `KINDS`.

    Raises:
        XmError: There is no such kind.
    """
    if kind not in KINDS:
        raise XmError(
            "resources of this kind are not listed",
            where=rtpu,
            expected=" or ".join(KINDS),
            got=kind[:20],
            remedy="run the same pbonet version on every machine",
        )
    return [_described(name, kind) for name in _standing(domain, rtpu, kind)]


def names_here(kind: str) -> list[str]:
    """Return the names of the resources of a kind on this machine, ``RTPU:NAME``."""
    domain = names.home().domain
    found = names.standing("sem" if kind == "sem" else "queue", domain)
    mark = f":{PREFIX}"
    boxed = kind == "mailbox"
    return [text.replace(mark, ":") for text in found if (mark in text) == boxed]


def _standing(domain: str, rtpu: str, kind: str) -> Iterator[Name]:
    """Yield the names of the files; of a mailbox that of its queue."""
    for text in names.standing("sem" if kind == "sem" else "queue", domain):
        home, _, resource = text.rpartition(":")
        boxed = resource.startswith(PREFIX)
        if home == rtpu and boxed == (kind == "mailbox"):
            yield names.Name(domain, home, resource)


def _described(name: Name, kind: str) -> r.Resource:
    shown = name.resource.removeprefix(PREFIX) if kind == "mailbox" else name.resource
    try:
        with closing(_attached(name, kind)) as thing:
            seen, settings = state_of(thing), settings_of(thing)
        if kind == "mailbox":
            with closing(Semaphore.attach(name)) as place:
                seen.holder = place.holder
    except PbonetError as error:  # damaged, of another user, or gone meanwhile
        return r.Resource(name=shown, kind=kind, error=str(error))
    return r.Resource(name=shown, kind=kind, settings=settings, seen=seen)


def _attached(name: Name, kind: str) -> Semaphore | Queue:
    return Semaphore.attach(name) if kind == "sem" else Queue.attach(name)


def state_of(thing: Semaphore | Queue) -> r.Seen:
    """Return the state of a semaphore or queue."""
    if isinstance(thing, Semaphore):
        return r.Seen(waiting=thing.waiting, value=thing.value, holder=thing.holder)
    return r.Seen(
        waiting=thing.waiting,
        value=len(thing),
        free=thing.free,
        dropped=thing.dropped,
        sent=thing.sent,
    )


def settings_of(thing: Semaphore | Queue) -> dict[str, int]:
    """Return the settings with which a semaphore or queue was made."""
    if isinstance(thing, Semaphore):
        return {"maximum": thing.maximum, "binary": int(thing.binary)}
    return {
        "policy": int(thing.policy),
        "messages": thing.messages,
        "blocks": thing.blocks,
        "block": thing.block,
    }
