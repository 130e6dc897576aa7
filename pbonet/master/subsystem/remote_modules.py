"""Modules in the agents' libraries: descriptions, asked for over the network."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.config import no_module
from pbonet.errors import ModuleLoadError
from pbonet.xm.net import messages as m, rpc

if TYPE_CHECKING:
    from pbonet.config import Library
    from pbonet.pbo import ModuleInfo

    from .rtpu_clients import RtpuClients

_LOAD_TIME = 10.0
"""Seconds in which an agent imports and describes the modules of its libraries."""


def _answer() -> type[list[ModuleInfo]]:
    """Return the type of an answer; it is loaded with numpy, so only where needed."""
    from pbonet.pbo import ModuleInfo

    return list[ModuleInfo]


def on(clients: RtpuClients, library: Library, rtpu: str, module: str) -> ModuleInfo:
    """Return the description of a module in an RTPU's library.

    Args:
        clients: The agents.
        library: The master's own, which says what to do where the agent lacks one.
        rtpu: Whose library.
        module: Its name.

    Raises:
        ModuleLoadError: The library has no such module, or it does not load.
    """
    request = m.Modules(name=module)
    try:
        found = clients.call(rtpu, request, _answer(), timeout=_LOAD_TIME)
    except ModuleLoadError as error:
        if error.what == no_module(module):
            error.remedy = library.for_agent(module, rtpu) or error.remedy
        raise
    if not found:
        raise ModuleLoadError(
            no_module(module),
            where=rtpu,
            remedy=library.for_agent(module, rtpu)
            or "see 'library', or name its folder in agent.toml",
        )
    return found[0]


def of(clients: RtpuClients) -> list[ModuleInfo]:
    """Return the modules of all libraries of a subsystem, each version once.

    Raises:
        SeveralError: Several agents do not answer; of one, its own error.
    """
    results, errors = clients.each(
        lambda _: m.Modules(name=None), _answer(), timeout=_LOAD_TIME
    )
    if errors:
        rpc.raise_all(f"{len(errors)} RTPUs do not describe their modules", errors)
    found = {(i.name, i.version): i for infos in results.values() for i in infos}
    return [found[key] for key in sorted(found)]
