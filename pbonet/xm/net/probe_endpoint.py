"""Finds why an endpoint does not answer, and what to check."""

from __future__ import annotations

import socket
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

TRY_TIME: Final = 0.5
"""Time-out in seconds for an answer of the host."""
_BY_TCP: Final = {"tcp", "tls", "ws"}


def reasons(endpoints: Sequence[str]) -> tuple[str, str]:
    """Return why no session could be opened, and what to do.

    Args:
        endpoints: ``PROTOCOL/HOST:PORT`` each, at least one; all are tried at once.
    """
    with ThreadPoolExecutor(len(endpoints)) as pool:
        found = list(pool.map(_reason, endpoints))
    told = [why for why, _ in found]
    if len(found) > 1:
        told = [f"{one}: {why}" for one, why in zip(endpoints, told, strict=True)]
    return "; ".join(told), "; ".join(dict.fromkeys(remedy for _, remedy in found))


def _reason_here(path: str) -> tuple[str, str]:
    """Return the same for a socket of this machine."""
    with socket.socket(socket.AF_UNIX) as one:
        one.settimeout(TRY_TIME)
        try:
            one.connect(path)
        except (TimeoutError, BlockingIOError):  # too many wait for it already
            pass
        except PermissionError as error:
            return (
                error.strerror or "no access",
                "run this as the user that started the agent, or as root",
            )
        except OSError as error:
            return error.strerror or "no answer", "is an agent running there?"
    return (
        "a process listens there, but does not answer",
        "try again; if that does not help, restart the agent",
    )


def _reason(endpoint: str) -> tuple[str, str]:
    protocol, _, address = endpoint.partition("/")
    if protocol not in _BY_TCP | {"udp"}:
        return _reason_here(address)
    plain = address.partition("?")[0].partition("#")[0]
    host, _, port = plain.rpartition(":")
    host = host.strip("[]")
    remedy = "is an agent running there, and does it listen on that address?"
    try:
        socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        if protocol not in _BY_TCP:
            return "no answer", remedy
        with socket.create_connection((host, int(port)), TRY_TIME):
            return "an open port, but no agent answers there", remedy
    except (socket.gaierror, UnicodeError):
        return (
            f"the host name {host} is unknown",
            "is the name right? If so, use the host's address, or enter the name in "
            "DNS or /etc/hosts",
        )
    except TimeoutError:
        return f"no answer from the host {host} within {TRY_TIME:g} s", remedy
    except OSError as error:
        return f"from {host}: {error.strerror}", remedy
