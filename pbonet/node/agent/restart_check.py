"""Checks whether an agent may restart in place of the current one (SIGHUP).

Its RTPU process continues meanwhile, for some seconds. So everything that could prevent
the next agent from taking it over is checked before this one ends.
"""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pbonet.errors import NodeError
from pbonet.node.metrics import check_address
from pbonet.xm.net import access_control, credentials, session

from . import link_watchdog
from .file_server import FileServer

if TYPE_CHECKING:
    from pbonet.config import AgentConfig

_STAYS: Final = "put it back, or end the agent and start it again: its tasks turn OFF"
_THE_PROCESS: Final = ("libraries", "runs", "awake", "core_share", "device", "spp")
"""Settings with which an RTPU process is started, and which it keeps."""
LATER: Final = "%s: a change of %s takes effect when the RTPU process is restarted"
"""The report of a change that `kept` has found."""


def check(old: AgentConfig, new: AgentConfig, core: int) -> None:
    """Refuse a configuration with which the RTPU process could not be taken over.

    Args:
        old: The agent's configuration.
        new: The configuration after a restart.
        core: The core of its RTPU process.

    Raises:
        PbonetError: It would be another RTPU, its keys are not valid, or something in
            the configuration cannot be used.
    """
    for what, is_, to_be in (
        ("name", old.name, new.name),
        ("domain", old.domain, new.domain),
        ("core", core, core if new.core is None else new.core),
    ):
        if is_ != to_be:
            raise NodeError(
                f"an RTPU that keeps running keeps its {what}",
                where=old.name or "",
                expected=f"{what} {is_}",
                got=f"{to_be}",
                remedy=_STAYS,
            )
    keys = Path(new.keys) if new.keys else None
    for endpoint in new.listen:
        session.check_endpoint(endpoint, insecure=new.insecure, key_folder=keys)
    if new.metrics is not None:
        check_address(new.metrics, keys)
    for endpoint in new.connect:
        session.check_dialled(endpoint, key_folder=keys)
    if keys is not None:
        credentials.prove(keys, credentials.AGENTS)
    FileServer(new.files, old.name or "")
    ours = {_address(endpoint)[1] for endpoint in old.listen}
    for endpoint in new.listen:
        if _address(endpoint)[1] not in ours:  # own ports are released before
            _try(endpoint)


def kept(old: AgentConfig, new: AgentConfig) -> list[str]:
    """Return the changes that take effect only when the RTPU process restarts."""
    return [one for one in _THE_PROCESS if getattr(old, one) != getattr(new, one)]


def _address(endpoint: str) -> tuple[str, str]:
    """Return the host and the port of an endpoint."""
    host, _, port = link_watchdog.inside(endpoint).rpartition(":")
    return host.strip("[]"), port


def _try(endpoint: str) -> None:
    """Refuse an endpoint that cannot be listened on now."""
    protocol = endpoint.partition("/")[0]
    if protocol == access_control.LOCAL:
        return
    host, port = _address(endpoint)
    kind = socket.SOCK_DGRAM if protocol == "udp" else socket.SOCK_STREAM
    try:
        found = socket.getaddrinfo(host, int(port), type=kind)[0]
        with contextlib.closing(socket.socket(*found[:3])) as one:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            one.bind(found[4])
    except (OSError, UnicodeError) as error:
        raise NodeError(
            "the endpoint cannot be listened on",
            where=endpoint,
            got=getattr(error, "strerror", "") or str(error),
            remedy="name an address of this machine, and a free port",
        ) from None
