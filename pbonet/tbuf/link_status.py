"""State of links, read without being an end of any."""

from __future__ import annotations

import contextlib
import time
from typing import TYPE_CHECKING

from pbonet.errors import XmError
from pbonet.xm.ipc import names, shm_object_files
from pbonet.xm.net import TbufStatus

from . import places
from ._tbuf import READER, WRITER, Buffer

if TYPE_CHECKING:
    from collections.abc import Iterable


def seen(domain: str, links: Iterable[str]) -> list[TbufStatus]:
    """Return the state of links on this machine.

    Args:
        domain: Their domain.
        links: Their names; links that no longer exist are left out.
    """
    found: list[TbufStatus] = []
    for text in links:
        with contextlib.suppress(XmError):  # removed meanwhile, or not a link
            found.append(_status_of(text, domain))
    return found


def _status_of(text: str, domain: str) -> TbufStatus:
    place, _, resource = text.partition(":")
    name = names.Name(domain, place, resource)
    fd, size = shm_object_files.open_file(name, places.KIND)
    buffer = Buffer()
    buffer.map(fd, size, str(name.path(places.KIND)))
    try:
        buffer.verify()
        age = (time.monotonic_ns() - buffer.last_ns) * 1e-9
        return TbufStatus(
            name=text,
            writer=_who(buffer, WRITER),
            reader=_who(buffer, READER),
            number=buffer.written,
            age=age if buffer.written else None,
        )
    finally:
        places.leave(buffer)


def _who(buffer: Buffer, role: int) -> str:
    return buffer.who(role) if places.has(buffer.fileno, role) else ""
