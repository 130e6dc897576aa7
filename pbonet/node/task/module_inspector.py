"""Describes modules in a separate process, because loading a module runs its code."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING

import msgspec
from msgspec import Struct

from pbonet.config import Library
from pbonet.errors import PbonetError, WireError
from pbonet.node.wire import process_setup, rtpu_messages
from pbonet.pbo import ModuleInfo

if TYPE_CHECKING:
    from collections.abc import Sequence


class Inspected(Struct):
    """The result of an inspection."""

    modules: list[ModuleInfo]
    errors: list[WireError]


def run(sock_fd: int, spec_fd: int, crash_fd: int, server: int) -> int:
    """Describe the modules of a specification and overwrite it with the result."""
    del sock_fd, crash_fd
    if not process_setup.set_parent_death_signal(signal.SIGKILL, server):
        return 1
    data = os.pread(spec_fd, os.fstat(spec_fd).st_size, 0)
    spec = msgspec.msgpack.decode(data, type=rtpu_messages.InspectSpec)
    found = inspect(Library(spec.libraries), spec.name)
    answer = memoryview(rtpu_messages.encode(found))
    os.ftruncate(spec_fd, 0)
    at = 0
    while at < len(answer):
        at += os.pwrite(spec_fd, answer[at:], at)
    return 0


def inspect(library: Library, name: str | None) -> Inspected:
    """Return the description of one module, or of all."""
    names: Sequence[str] = library.modules() if name is None else [name]
    found = Inspected([], [])
    for one in names:
        try:
            found.modules.append(library.load(one).info)
        except PbonetError as error:
            found.errors.append(error.to_wire())
    return found
