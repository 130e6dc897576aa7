"""The files of semaphores, queues, segments and links: open and clean up."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from pbonet import shm
from pbonet.errors import XmAccessError, XmError, XmExistsError, XmFullError

from . import names

if TYPE_CHECKING:
    from .names import Name

FILES = shm.Files("resource", XmExistsError, XmAccessError, XmFullError)


def open_file(name: Name, kind: str) -> tuple[int, int]:
    """Attach to a resource's file; return its descriptor and size.

    Raises:
        XmMissingError: There is no such file.
        XmAccessError: It belongs to another user.
    """
    try:
        return FILES.open(name.path(kind))
    except FileNotFoundError:
        raise names.missing(name, kind) from None


def sweep(rtpu: str, domain: str = "default") -> list[str]:
    """Remove an RTPU's unused files; return the last parts of their names.

    Called when an RTPU ends, or starts after an earlier one was killed.
    """
    swept: list[str] = []
    prefix = shm.own(f"{domain}:{rtpu}:")
    for path in sorted(shm.folder().glob(f"{prefix}*")):
        with contextlib.suppress(XmError):
            if FILES.remove_unused(path):
                swept.append(path.name.removeprefix(prefix))
    return swept
