"""Asks an inspector what modules the libraries hold."""

from __future__ import annotations

import asyncio
import signal
from typing import TYPE_CHECKING

import msgspec

from pbonet.errors import ModuleLoadError, PbonetError

from . import wire
from .inspector import Inspected

if TYPE_CHECKING:
    from pbonet.pbo import ModuleInfo

    from .spawner import Child
    from .state import Rtpu

PATIENCE = 8.0
"""Seconds: the code of every module in the libraries is run."""


async def modules(rtpu: Rtpu, name: str | None) -> tuple[list[ModuleInfo], list[str]]:
    """Return descriptions, and a warning for each module that does not load.

    Raises:
        PbonetError: The one module that was asked for does not load.
    """
    spec = wire.InspectSpec(libraries=rtpu.config.libraries, name=name)
    child = await rtpu.spawner.fork("inspect", "inspector", spec)
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
        code = await asyncio.wait_for(asyncio.shield(child.exited), PATIENCE)
    except TimeoutError:
        raise ModuleLoadError(
            f"loading {what} does not come to an end",
            got=f"no result after {PATIENCE:g} s",
            remedy="look for code at the top of a module that waits",
            debug=child.crash_text(),
        ) from None
    if code != 0:
        from .tasks import describe_end

        raise ModuleLoadError(
            f"loading {what} ended the process: {describe_end(code)}",
            remedy="look for native code that a module imports",
            debug=child.crash_text(),
        )
    return msgspec.msgpack.decode(child.result(), type=Inspected)
