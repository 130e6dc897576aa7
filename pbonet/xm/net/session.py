"""Opens zenoh sessions; this file alone configures zenoh.

Agents run as routers and everything else is a client of some agent, so one agent within
reach is enough to reach all. Agents of one machine find each other in the runtime
folder; others are named, or found by multicast if that is requested. Where machines are
many, agents are clients of routers (`client_of_router`), and where agents of one
machine are many, of the first few of them. There is no
gossip, and the shared-memory transport is off. A client that is lost is noticed within
400 ms by its silence, an agent by its signs of life (`pbonet.node.agent.heartbeat`).

With a key folder every link over a network is mutual TLS and agents enforce access
control (see `credentials` and `access_control`). Without one, an agent that listens
beyond loopback needs `insecure`.

A session must be opened in a process that was started by exec, never after a fork.
"""

from __future__ import annotations

import re
import resource
import time
import zlib
from typing import TYPE_CHECKING, cast

import msgspec
import zenoh

from pbonet.errors import NodeError, UnreachableError

from . import (
    access_control,
    credentials,
    key_expressions,
    run_folder,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

SILENT_MS = 400
"""Milliseconds without a sign of life until an agent or a client is out of sight; less
gave false losses."""
LEASE_MS = 2000
"""Milliseconds for which a silent link between agents is kept. It outlives short
interruptions: a new link takes longer than TCP takes to continue."""
OPEN_MS = 500
"""Milliseconds until an agent that hangs is skipped for the next; zenoh's ten seconds
would keep a master from all others, and from stopping them, and an agent from one whose
link has recovered meanwhile."""
ACCEPT_MS = 1000
"""Milliseconds that an agent gives a new connection for its greeting. The other side
gives up before that."""
ACCEPT_PENDING = 1000
"""Most connections without a greeting; more are closed at once. This leaves room for
agents and masters beside hundreds of connections that say nothing."""
VALUES_PRIORITY = zenoh.Priority.INTERACTIVE_HIGH
"""Of what is outdated by the next one of its kind: table packets and records of links.
In zenoh each priority has a queue of its own for each link. `REAL_TIME`, the only one
before this, is for signs of life alone: in a common queue without room for a packet
they would be dropped like it, and an agent that is busy would seem to be lost."""
BATCHES = 1
"""Batches of such values that may wait for a link. In an interruption a second one
would fill with half a second of old values, which come before all that is new."""
RETRY_MS = 200
"""Longest pause between attempts to reach a lost agent, in milliseconds."""
SCOUTING_PORT = 17000
"""The first of the thousand ports on which domains search for their agents."""
OPEN_TIME = 1.1
"""Seconds for which a client tries to connect."""
BUSY_TIME = 5.0
"""The same for agents of this machine whose processes run: what does not answer for a
second is busy, or its machine is, and a `stop` or `swap` must not fail by that."""
STAND_IN_TIME = 20.0
"""Seconds for which an agent that is a client tries to open its session. On a machine
that is very busy it takes longer to link two sessions of one process than `OPEN_MS`."""
_NOBODY_ANSWERS = "Unable to connect to any"
"""In zenoh's message, when no endpoint of a client has accepted it in time."""
_OPEN_PAUSE = 0.05
_KEYS_REFUSED = (
    " Were both sides' keys made by one authority and not revoked, and is the address"
    " among the agent's hosts (`pbonet keys show`)?"
)
PROTOCOLS = ("tcp", "tls", "udp", "ws", "unixsock-stream")
_HOST_PORT = re.compile(r"([^\s/\[\]:?#]+|\[[^\s/\[\]]+\]):(\d{1,5})([?#].*)?")
_LAST_PORT = 65535
_ROS_LONGEST = 64 << 20
"""Bytes of the longest message of ROS 2 that is received at all."""
CLIENT = "client"
"""Name by which masters and tools make themselves known; see `routed_agent`."""
MOST_RANKS = 1000
"""Agents of greater rank that an agent accepts, counted from its own."""
MOST_SESSIONS = 10_000
"""Most clients and routers of one router; zenoh's own limit is 1,000."""
TOKENS = 100_000
"""Room for liveliness tokens: zenoh's default handler blocks forever beyond 256."""


def is_address(text: str) -> bool:
    """Return whether a text is a host and a port."""
    match = _HOST_PORT.fullmatch(text)
    return match is not None and int(match[2]) <= _LAST_PORT


def check_endpoint(
    endpoint: str, *, insecure: bool = True, key_folder: Path | None = None
) -> str:
    """Return `endpoint` if an agent may use it.

    Raises:
        NodeError: It is malformed, of an unknown protocol, reaches beyond this machine
            without keys or `insecure`, or needs keys that are missing, or the reverse.
    """
    protocol, _, address = endpoint.partition("/")
    local = protocol == "unixsock-stream" and address
    if not local and not (protocol in PROTOCOLS and is_address(address)):
        raise NodeError(
            "this is not an endpoint",
            expected="PROTOCOL/HOST:PORT with one of " + " ".join(PROTOCOLS),
            got=repr(endpoint),
            remedy="for example tcp/127.0.0.1:7447, or tcp/[::1]:7447",
        )
    if protocol == access_control.LOCAL:
        return endpoint
    if protocol == "tls" and key_folder is None:
        raise NodeError(
            "TLS needs keys",
            where=endpoint,
            expected="a key folder",
            got="none",
            remedy=f"name it with --keys or {credentials.VARIABLE}; "
            "`pbonet keys` makes it",
        )
    if protocol != "tls" and key_folder is not None:
        raise NodeError(
            "with keys every link over a network is TLS",
            where=endpoint,
            expected=f"tls/{address}",
            got=protocol,
            remedy="use this endpoint, or no keys",
        )
    if not insecure and key_folder is None and not is_loopback(address):
        raise NodeError(
            "listening beyond this machine is not protected",
            where=endpoint,
            expected="keys, or an address of this machine alone, such as 127.0.0.1",
            remedy=f"make keys with `pbonet keys` and write tls/{address}; or use "
            "--insecure if everyone on that network may control the robot",
        )
    return endpoint


def check_dialled(endpoint: str, *, key_folder: Path | None = None) -> str:
    """Return `endpoint` if a link may be opened to it.

    Raises:
        NodeError: As `check_endpoint`; or it names a host by an IPv6 address over TLS,
            which zenoh cannot compare with a certificate.
    """
    if check_endpoint(endpoint, key_folder=key_folder).startswith("tls/["):
        port = endpoint.rpartition(":")[2]
        raise NodeError(
            "over TLS a host with an IPv6 address can be reached only by its name",
            where=endpoint,
            expected=f"tls/NAME:{port}",
            got="an address",
            remedy="name the host in DNS or /etc/hosts, and in its agent's keys "
            "(`pbonet keys agent ... --host NAME`)",
        )
    return endpoint


def is_loopback(address: str) -> bool:
    """Return whether ``HOST:PORT`` is of this machine alone."""
    host = address.partition("?")[0].partition("#")[0].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    import ipaddress  # only if a host is given

    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def agent(
    places: run_folder.Places,
    *,
    listen: Sequence[str] = (),
    dial: Sequence[str] = (),
    multicast: bool = False,
    key_folder: Path | None = None,
) -> zenoh.Session:
    """Open an agent's session: a router on its socket and on `listen`.

    Args:
        places: The agent's files.
        listen: Endpoints besides its socket.
        dial: Endpoints to which it keeps a link, with retries while one is lost. No
            two agents may dial each other, see `pbonet.xm.net.dialling`.
        multicast: Also find agents of the domain on the same network by multicast.
        key_folder: The agent's keys, if any.

    Raises:
        NodeError: An endpoint cannot be listened on.
        ConfigFileError: The key folder cannot be used.
    """
    listens = [places.endpoint, *listen]
    config = _config(
        mode="router",
        listen={"endpoints": listens},
        connect={"endpoints": list(dial)},
        multicast=_scouting(places.domain) if multicast else None,
        key_folder=key_folder,
    )
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise _not_open(listens, error) from None


def routed_agent(
    places: run_folder.Places,
    north: Sequence[str],
    *,
    rank: int,
    listen: Sequence[str] = (),
    key_folder: Path | None = None,
) -> zenoh.Session:
    """Open the session of an agent that is a client, and has clients of its own.

    It is opened also while nothing answers. Then, and whenever its link is lost, all of
    `north` are tried until one accepts.

    Args:
        places: The agent's files.
        north: Endpoints of which it needs a link to any one, the best first.
        rank: Of the machine's agents, those of a greater rank are accepted.
        listen: Endpoints for masters and tools, besides its socket.
        key_folder: The agent's keys, if any.

    Raises:
        NodeError: An endpoint cannot be listened on.
        ConfigFileError: The key folder cannot be used.
    """
    listens = [places.endpoint, f"unixsock-stream/{places.hub(rank)}", *listen]
    # zenoh opens no client while none of its endpoints answers. A router of this
    # process takes that part until the session is open.
    stand_in = f"unixsock-stream/{places.hub(0)}"
    settings = _settings(
        mode="client",
        listen={"endpoints": listens},
        connect={
            "endpoints": [*north, stand_in],
            "timeout_ms": 0,
            "exit_on_failure": True,
        },
        key_folder=key_folder,
    )
    accepted = [CLIENT, *map(_ranked, range(rank + 1, rank + 1 + MOST_RANKS))]
    settings["region_name"] = _ranked(rank)
    settings["gateway"] = {
        "south": [{"filters": [{"modes": ["client"], "region_names": accepted}]}]
    }
    part = _settings(mode="router", listen={"endpoints": [stand_in]}, connect={})
    begin = time.monotonic()
    while True:
        try:
            with zenoh.open(_packed(part)):
                return zenoh.open(_packed(settings))
        except zenoh.ZError as error:
            busy = _NOBODY_ANSWERS in str(error)
            if not busy or time.monotonic() - begin > STAND_IN_TIME:
                raise _not_open(listens, error) from None


def _ranked(rank: int) -> str:
    return f"agent-{rank}"


def router_settings(
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    key_folder: Path | None = None,
) -> dict[str, object]:
    """Return zenoh's configuration of a router for agents and masters.

    Args:
        listen: Where it accepts agents, masters and other routers.
        connect: Other routers to which it keeps a link. Of two routers only one may
            name the other.
        key_folder: The keys of a gateway, if any.

    Raises:
        ConfigFileError: The key folder cannot be used.
    """
    settings = _settings(
        mode="router",
        listen={"endpoints": list(listen)},
        connect={"endpoints": list(connect)},
        key_folder=key_folder,
        roles=(credentials.Role.GATEWAY,),
    )
    transport = cast("dict[str, dict[str, object]]", settings["transport"])
    transport["unicast"]["max_sessions"] = MOST_SESSIONS
    return settings


def _not_open(listens: Sequence[str], error: Exception) -> NodeError:
    return NodeError(
        "the agent's session cannot be opened",
        where=" ".join(listens),
        got=reason(error),
        remedy="is another program listening there?",
    )


def _scouting(domain: str) -> dict[str, object]:
    """Return the settings by which the agents of one domain only find each other."""
    port = SCOUTING_PORT + zlib.crc32(domain.encode()) % 1000
    return {
        "enabled": True,
        "address": f"224.0.0.224:{port}",
        "autoconnect": {"router": ["router"], "peer": [], "client": []},
        # Of two agents that find each other only one dials.
        "autoconnect_strategy": {"router": {"to_router": "greater-zid"}},
        "listen": True,
    }


def client(
    domain: str = "default",
    *,
    connect: Sequence[str] = (),
    timeout: float = OPEN_TIME,
    local: bool = True,
    key_folder: Path | None = None,
) -> zenoh.Session:
    """Open the session of a master or tool: a client of any agent it can reach.

    Args:
        domain: Agents of this domain on this machine are tried after `connect`.
        connect: Endpoints of other agents.
        timeout: Seconds to keep trying; 0 for one try. Agents that run on this machine
            are given `BUSY_TIME`.
        local: Whether to try agents of this machine.
        key_folder: A key folder; by default the one in `PBONET_KEYS`.

    Raises:
        UnreachableError: No agent can be reached.
        NodeError: An endpoint is malformed, or does not fit the keys.
        ConfigFileError: The key folder cannot be used.
    """
    running, stopped = _local_agents(domain) if local else ([], {})
    if stopped and not (connect or running):
        raise UnreachableError(
            f"every agent of domain {domain} on this machine is stopped",
            where=str(run_folder.folder() / domain),
            got=", ".join(f"{name}: process {pid}" for name, pid in stopped.items()),
            remedy=f"'kill -CONT {' '.join(map(str, stopped.values()))}' resumes them",
        )
    key_folder = key_folder or credentials.named()
    endpoints = [check_dialled(one, key_folder=key_folder) for one in connect]
    # Stopped agents come last: each would cost half a second.
    endpoints += [
        run_folder.Places(domain, name).endpoint for name in (*running, *stopped)
    ]
    if not endpoints:
        raise UnreachableError(
            f"no agent of domain {domain} runs on this machine",
            where=str(run_folder.folder() / domain),
            remedy="start one with `pbonet agent --name NAME`, or name an agent "
            "elsewhere with --connect tcp/HOST:PORT",
        )
    config = _config(
        mode="client",
        # With a time limit zenoh would spend all of it on the first endpoint.
        connect={"endpoints": endpoints, "timeout_ms": 0, "exit_on_failure": True},
        key_folder=key_folder,
        region_name=CLIENT,
    )
    limit = max(timeout, BUSY_TIME) if timeout and running else timeout
    begin = time.monotonic()
    while True:
        try:
            opened = zenoh.open(config)
        except zenoh.ZError as error:
            # The next try takes as long for each agent that does not answer.
            if time.monotonic() - begin + OPEN_MS * 1e-3 < limit:
                time.sleep(_OPEN_PAUSE)
                continue
            got, remedy = reason(error), ""
            if timeout:
                from . import probe_endpoint  # only if there is no answer

                got, remedy = probe_endpoint.reasons(endpoints)
            raise UnreachableError(
                f"no agent of domain {domain} answers",
                where=" ".join(endpoints),
                got=got,
                remedy=remedy + (_KEYS_REFUSED if key_folder else ""),
            ) from None
        if connect:  # else it is a socket of this machine
            from . import so_linger

            so_linger.end(opened)
        return opened


def ros2(
    domain: int, *, router: str = "", listen: str = "", insecure: bool = False
) -> zenoh.Session:
    """Open a session with nodes of ROS 2, which has no link to any agent.

    As rmw_zenoh does, it is a peer that learns of others from a router; or it is that
    router.

    Args:
        domain: The ROS domain.
        router: The endpoint of the router; empty for none.
        listen: Be the router there; empty: be a peer.
        insecure: Listen beyond this machine, too; nothing protects it.

    Raises:
        UnreachableError: The router does not answer.
        NodeError: An endpoint is malformed, or cannot be listened on.
    """
    if listen:
        _check_ros2_router(listen, insecure=insecure)
    settings: dict[str, object] = {
        "mode": "router" if listen else "peer",
        "listen": {"endpoints": [listen or "tcp/127.0.0.1:0"]},
        "connect": {
            "endpoints": [check_endpoint(router)] if router else [],
            "timeout_ms": round(OPEN_TIME * 1000),
            "exit_on_failure": True,
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": True}},
        "timestamping": {"enabled": True},  # the caches of publishers need it
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {"rx": {"max_message_size": _ROS_LONGEST}},
        },
        "access_control": access_control.ros2_rules(domain),
    }
    try:
        return zenoh.open(
            zenoh.Config.from_json5(msgspec.json.encode(settings).decode())
        )
    except zenoh.ZError as error:
        if not router:
            raise NodeError(
                "the router for ROS 2 cannot be opened",
                where=listen,
                got=reason(error),
                remedy="is another router there? --router connects to it",
            ) from None
        raise UnreachableError(
            "no zenoh router for ROS 2 answers",
            where=router,
            got=reason(error),
            remedy="check the address; start one there with `ros2 run rmw_zenoh_cpp "
            "rmw_zenohd`, or be one with --listen tcp/localhost:7447",
        ) from None


def _check_ros2_router(endpoint: str, *, insecure: bool) -> None:
    """Refuse an endpoint that is malformed, or reaches beyond this machine."""
    protocol, _, address = check_endpoint(endpoint).partition("/")
    if not (insecure or protocol == access_control.LOCAL or is_loopback(address)):
        raise NodeError(
            "nodes of ROS 2 authenticate nobody, so listening beyond this machine "
            "is not protected",
            where=endpoint,
            expected="an address of this machine alone, such as tcp/localhost:7447",
            remedy="use --insecure if everyone on that network may read the robot, and "
            "with --control command it",
        )


def _local_agents(domain: str) -> tuple[list[str], dict[str, int]]:
    """Return the agents of this machine: the running ones, and the stopped ones."""
    processes = run_folder.agent_processes(domain)
    stopped = {
        name: pid
        for name, pid in sorted(processes.items())
        if run_folder.is_stopped(pid)
    }
    return sorted(processes.keys() - stopped), stopped


def alive(session: zenoh.Session, key: str, timeout: float = 1.0) -> list[str]:
    """Return the keys of the liveliness tokens that match `key`, sorted and unique.

    Not for a session that subscribes to the same tokens: zenoh 1.10 then occasionally
    misses tokens (24 of 4500 when measured; none without the subscriber).
    """
    replies = session.liveliness().get(
        key, handler=zenoh.handlers.FifoChannel(TOKENS), timeout=timeout
    )
    return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok})


def rtpus(session: zenoh.Session, domain: str, timeout: float = 1.0) -> list[str]:
    """Return the names of the RTPUs of `domain` that are alive, sorted."""
    found = alive(session, key_expressions.all_rtpus(domain, "alive"), timeout)
    return [key_expressions.rtpu_name(key) for key in found]


def _config(
    *,
    mode: str,
    connect: Mapping[str, object],
    listen: Mapping[str, object] | None = None,
    multicast: Mapping[str, object] | None = None,
    key_folder: Path | None = None,
    region_name: str = "",
) -> zenoh.Config:
    settings = _settings(
        mode=mode,
        connect=connect,
        listen=listen,
        multicast=multicast,
        key_folder=key_folder,
    )
    if region_name:
        settings["region_name"] = region_name
    return _packed(settings)


def _packed(settings: Mapping[str, object]) -> zenoh.Config:
    return zenoh.Config.from_json5(msgspec.json.encode(settings).decode())


def _settings(
    *,
    mode: str,
    connect: Mapping[str, object],
    listen: Mapping[str, object] | None = None,
    multicast: Mapping[str, object] | None = None,
    key_folder: Path | None = None,
    roles: tuple[credentials.Role, ...] = (),
) -> dict[str, object]:
    retry = {
        "period_init_ms": 100,
        "period_max_ms": RETRY_MS,
        "period_increase_factor": 2,
    }
    settings: dict[str, object] = {
        "mode": mode,
        "connect": {**connect, "retry": retry},
        "scouting": {
            "delay": 0,  # otherwise half a second at every start, without use
            "multicast": multicast or {"enabled": False},
            "gossip": {"enabled": False},
        },
        "transport": {
            "shared_memory": {"enabled": False},
            "unicast": {
                "open_timeout": OPEN_MS,
                "accept_timeout": ACCEPT_MS,
                "accept_pending": _accept_pending(),
            },
            "link": {
                "tx": {
                    "lease": LEASE_MS if listen else SILENT_MS,
                    "keep_alive": 4,
                    "queue": {"size": {"interactive_high": BATCHES}},
                },
                **(_tls(key_folder) if key_folder else {}),
            },
        },
        "queries_default_timeout": 2000,
    }
    if key_folder:
        usual = credentials.AGENTS if listen else tuple(credentials.Role)
        credentials.prove(key_folder, roles or usual)
    if listen is not None:
        settings["listen"] = listen
        if key_folder:
            settings["access_control"] = access_control.rules()
    return settings


def _accept_pending() -> int:
    """Return how many silent connections are kept; they take a file each."""
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return max(1, min(ACCEPT_PENDING, files // 4))


def _tls(folder: Path) -> dict[str, object]:
    """Return the settings of TLS links with the keys of `folder`, and no others."""
    ca, cert, key = (str(folder / name) for name in credentials.FILES)
    return {
        "protocols": ["tls", access_control.LOCAL],
        "tls": {
            "root_ca_certificate": ca,
            "enable_mtls": True,
            "listen_certificate": cert,
            "listen_private_key": key,
            "connect_certificate": cert,
            "connect_private_key": key,
            "close_link_on_expiration": True,
        },
    }


def reason(error: Exception) -> str:
    """Return the first line of zenoh's error, without the place in its sources."""
    text = str(error) or type(error).__name__
    return re.sub(r"\s+at \S+\.rs:\d+\.?", "", text.splitlines()[0])
