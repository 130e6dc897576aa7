"""Asks an inspector which modules the libraries hold."""

from __future__ import annotations

import asyncio
import signal
from typing import TYPE_CHECKING

import msgspec

from pbonet.errors import ModuleLoadError, PbonetError, ProtocolError
from pbonet.node.task import Inspected
from pbonet.node.wire import process_setup, rtpu_messages

if TYPE_CHECKING:
    from pbonet.pbo import ModuleInfo

    from .fork_client import Child
    from .rtpu_state import Rtpu

    Found = tuple[list[ModuleInfo], list[str]]

WAITING = 16
"""Names that are asked for and wait for an inspector."""
PATIENCE = 8.0
"""Seconds: the code of every module in the libraries is run."""


class ModuleInspection:
    """Serves inspection requests, one after the other.

    An inspector runs the code of all modules, so many at once would hold up everything
    else on the machine. Equal requests that come before it begins get the same answer.

    Args:
        rtpu: The RTPU that has the libraries.
    """

    def __init__(self, rtpu: Rtpu) -> None:
        self._rtpu = rtpu
        self._turn = asyncio.Lock()
        self._waiting: dict[str | None, asyncio.Task[Found]] = {}

    async def modules(self, name: str | None) -> Found:
        """Return descriptions, and a warning for each module that does not load.

        Raises:
            PbonetError: The one module that was asked for does not load, or too many
                are asked for.
        """
        task = self._waiting.get(name)
        if task is None:
            if len(self._waiting) >= WAITING:
                raise ProtocolError(
                    "too many modules are asked for",
                    expected=f"at most {WAITING} at a time",
                    remedy="wait for answers before sending more requests",
                )
            task = self._waiting[name] = asyncio.create_task(self._next(name))
        return await asyncio.shield(task)

    async def _next(self, name: str | None) -> Found:
        async with self._turn:
            del self._waiting[name]  # requests from now on may mean other files
            return await self._inspect(name)

    async def _inspect(self, name: str | None) -> Found:
        spec = rtpu_messages.InspectSpec(
            libraries=self._rtpu.config.libraries, name=name
        )
        child = await self._rtpu.spawner.fork("inspect", "inspector", spec)
        try:
            found = await _result(child, name)
        finally:
            child.send_signal(signal.SIGKILL)
            await child.exited
            child.close()
        if name is not None and found.errors:
            raise PbonetError.from_wire(found.errors[0])
        return found.modules, [str(PbonetError.from_wire(e)) for e in found.errors]


async def _result(child: Child, name: str | None) -> Inspected:
    what = f"module {name}" if name else "the modules of the libraries"
    try:
        async with asyncio.timeout(PATIENCE):
            code = await asyncio.shield(child.exited)
    except TimeoutError:
        raise ModuleLoadError(
            f"loading {what} does not finish",
            got=f"no result after {PATIENCE:g} s",
            remedy="check for code at the top of a module that waits",
            debug=child.crash_text(),
        ) from None
    if code != 0:
        raise ModuleLoadError(
            f"loading {what} ended the process: {process_setup.describe_end(code)}",
            remedy="check native code that a module imports",
            debug=child.crash_text(),
        )
    return msgspec.msgpack.decode(child.result(), type=Inspected)
