"""``pbonet web``: where the page is served, with which keys, and its links."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import os
import signal
import socket
import ssl
import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from pbonet.errors import ConfigFileError, NodeError
from pbonet.master.console import render
from pbonet.xm.net import credentials

from .access import Access, KeyFile, Role
from .orders import Orders, Steered
from .recorded_questions import RecordedQuestions
from .recorded_run import RecordedRun
from .watcher import Watcher

if TYPE_CHECKING:
    from collections.abc import Callable

    import uvicorn

    from pbonet.master.configuration import Place


class Served(msgspec.Struct, frozen=True, kw_only=True):
    """Where and how the page is served."""

    host: str = "127.0.0.1"
    """The address to listen at."""
    port: int = 8080
    """0 for any that is free."""
    names: tuple[str, ...] = ()
    """Further names by which browsers call the server."""
    tls: Path | None = None
    """The folder with ``cert.pem`` and ``key.pem``; None: no TLS."""
    observe: bool = False
    """Only observers: no browser can steer."""
    hz: float = 20.0
    """How often a second watched values are read."""


def serve(
    path: str | Path, place: Place, served: Served, *, as_data: bool = False
) -> None:
    """Serve the page of a subsystem, or of a recorded run, until interrupted.

    Args:
        path: The ``.sbs`` file, or a ``.job`` file that names it; or a log, or the
            folder of a run.
        place: Where the subsystem is.
        served: Where and how.
        as_data: Print the links as JSON.

    Raises:
        PbonetError: A file is wrong, a package is missing, the address is taken, or it
            is beyond this machine and there is no TLS.
    """
    uvicorn_, application, connections = _packages()
    context = _tls(served)
    recorded = _is_log(Path(path))
    source = RecordedRun(path) if recorded else Watcher(path, place, hz=served.hz)
    name = source.about["name"]
    listening = _listen(served)
    port = listening.getsockname()[1]
    key = KeyFile(place.domain, name, port)
    looks = recorded or served.observe or _only_looks()
    roles = (Role.OBSERVER,) if looks else tuple(Role)
    access = Access(
        _hosts(served), port, key.read(), roles=roles, secure=context is not None
    )

    def orders(told: Callable[[dict[str, Any]], None]) -> Orders | RecordedQuestions:
        if not isinstance(source, Watcher):
            return RecordedQuestions(path)
        steered = Steered(path, name, place)
        return Orders(steered, source.knows, source.refresh_soon, told)

    page = application.Page(source, orders, access, linked=_say_link(as_data=as_data))
    if not (application.DIST / "index.html").is_file():
        render.print_error(render.warning(application.NOT_BUILT.strip()))
    _say_links(access.links, as_data=as_data)
    config = uvicorn_.Config(
        page.app(),
        log_config=None,
        access_log=False,
        http=connections.Connection,
        ws="websockets-sansio",
        ws_max_size=application.LONGEST,
        ws_per_message_deflate=False,
        server_header=False,
        proxy_headers=False,
        limit_concurrency=200,
        timeout_graceful_shutdown=1,
    )
    config.load()
    connections.leave_out_junk()
    config.ssl = context
    asyncio.run(_until_interrupted(uvicorn_.Server(config), listening))
    key.remove()
    _leave(page.left)


async def _until_interrupted(server: uvicorn.Server, listening: socket.socket) -> None:
    """Run a server until this process gets a signal to end."""

    def end() -> None:
        server.should_exit = True

    loop = asyncio.get_running_loop()
    for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(one, end)
    # Its own handlers would end the process before it has cleaned up.
    server.capture_signals = contextlib.nullcontext  # type: ignore[assignment]
    await server.serve(sockets=[listening])


def _leave(left: list[str]) -> None:
    """End this process now if something is left, whose threads would keep it."""
    if not left:
        return
    for one in left:
        render.print_error(render.warning(one))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def _is_log(path: Path) -> bool:
    """Return whether a path is a recorded run: a log, or a folder with some."""
    return path.suffix == ".mcap" or path.is_dir()


def _packages() -> tuple[Any, Any, Any]:
    """Return uvicorn, the application that it runs, and its connections.

    Raises:
        NodeError: A package is not installed.
    """
    try:
        import_module("websockets")
        uvicorn_ = import_module("uvicorn")
        from . import application, connections
    except ImportError as error:
        raise NodeError(
            "the packages of the web page are not installed",
            expected="starlette, uvicorn and websockets",
            got=f"no {error.name}",
            remedy='pip install "pbonet[web]"',
        ) from None
    return uvicorn_, application, connections


def _tls(served: Served) -> ssl.SSLContext | None:
    """Return the TLS context; None where everything stays on this machine.

    Raises:
        NodeError: The address is beyond this machine, and there are no keys.
        ConfigFileError: The keys cannot be used.
    """
    if served.tls is None:
        if not _is_loopback(served.host):
            raise NodeError(
                "serving the page beyond this machine needs TLS",
                where=f"--host {served.host}",
                expected="an address of this machine alone, such as 127.0.0.1",
                remedy="name a folder with cert.pem and key.pem by --tls, or serve "
                "127.0.0.1 and forward the port by `ssh -L 8080:127.0.0.1:8080 HOST`",
            )
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        cert, own = (served.tls / one for one in ("cert.pem", "key.pem"))
        context.load_cert_chain(cert, own)
    except (OSError, ssl.SSLError) as error:
        raise ConfigFileError(
            "the keys for TLS cannot be used",
            where=str(served.tls),
            expected="cert.pem and its key.pem",
            got=str(error),
            remedy="'pbonet keys' makes such a folder, or your own authority does",
        ) from None
    return context


def _listen(served: Served) -> socket.socket:
    """Return a socket that listens.

    Raises:
        NodeError: The address cannot be had.
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(
            served.host, served.port, type=socket.SOCK_STREAM
        )[0]
        made = socket.socket(family, socket.SOCK_STREAM)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(address)
        made.listen()
    except OSError as error:
        raise NodeError(
            "the page cannot be served there",
            where=f"{served.host}:{served.port}",
            got=error.strerror or str(error),
            remedy="choose another --port; 0 takes one that is free",
        ) from None
    return made


def _hosts(served: Served) -> list[str]:
    """Return the names by which browsers call the server, the one of links first."""
    local = ["127.0.0.1", "localhost", "::1"] if _is_loopback(served.host) else []
    anywhere = served.host in {"0.0.0.0", "::"}  # noqa: S104 - compared, not bound
    own = [socket.gethostname()] if anywhere else [served.host]
    return list(dict.fromkeys([*served.names, *own, *local]))


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _only_looks() -> bool:
    """Return whether this program's keys are an observer's."""
    folder = credentials.named()
    if folder is None:
        return False
    with contextlib.suppress(ConfigFileError):
        credentials.prove(folder, (credentials.Role.OBSERVER,))
        return True
    return False


def _say_links(links: dict[Role, str], *, as_data: bool) -> None:
    if as_data:
        data = {str(role): link for role, link in links.items()}
        text = msgspec.json.encode(data).decode()
    else:
        text = "\n".join(f"{role:9} {link}" for role, link in links.items())
        text += "\nEach link works once; the next one is printed when it was used."
    render.print_line(text)


def _say_link(*, as_data: bool) -> Callable[[Role, str], None]:
    """Return what says the next link of a role, when the one before was used."""

    def say(role: Role, link: str) -> None:
        _say_links({role: link}, as_data=as_data)

    return say
