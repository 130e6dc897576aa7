"""The keys on which requests are made, by what they change.

An RTPU answers on three keys: ``sbs`` accepts every request, ``mail`` those about
semaphores, queues, mailboxes and files, which tasks make themselves, and ``status``
those that change nothing. Access control is by key (see `access_control`), so an
observer reaches only the last one, and an agent the last two.
"""

from __future__ import annotations

import functools

from pbonet.errors import AccessError

from . import messages as m
from .resource_messages import XmRequest

LEAVES = ("sbs", "mail", "status")
_LOOKING = {
    *("hello", "links", "devices", "machine", "get", "profile", "display"),
    *("modules", "events", "xm_stat", "xm_list", "xm_read", "xm_overview"),
}
"""The ``op`` of requests that change nothing."""
_BY_FIELDS = {"sigmask", "job", "status", "freq"}
"""The ``op`` of requests that change something or nothing, as their fields say."""


def only_looks(request: m.Request) -> bool:
    """Return whether the request changes nothing."""
    op = request.__struct_config__.tag
    if op not in _BY_FIELDS:
        return op in _LOOKING
    if isinstance(request, m.Sigmask | m.Job):
        return not request.changes
    if isinstance(request, m.Status):
        return not request.reset
    return isinstance(request, m.Freq) and request.hz is None


def leaf(request: m.Request) -> str:
    """Return the last part of the key on which the request is made."""
    if only_looks(request):
        return "status"
    return "mail" if _is_mail(type(request)) else "sbs"


@functools.cache
def _is_mail(kind: type[m.Request]) -> bool:
    """Return whether requests of a class are about semaphores, queues and the like."""
    return issubclass(kind, XmRequest)


def check(request: m.Request, key: str) -> None:
    """Refuse a request on a key for requests that change less.

    Args:
        request: The request.
        key: The key expression of the query.

    Raises:
        AccessError: The request is not allowed on that key.
    """
    asked = key.rpartition("/")[2]
    if asked != "sbs" and asked != leaf(request) and not only_looks(request):
        raise AccessError(
            "this key accepts only requests that change nothing",
            where=key,
            expected="hello, links, devices, machine, status without reset, profile, "
            "display, modules, events, get, reading files, lists of resources, and "
            "freq, sigmask and job without changes",
            got=type(request).__name__.lower(),
            remedy="commands go to the key that ends in sbs, with a master's keys; "
            "requests of tasks to the one that ends in mail",
        )
