"""The keys used on the network; no other file composes keys."""

from __future__ import annotations

ROOT = "pbonet"


def rtpu(domain: str, name: str, leaf: str) -> str:
    """Return an RTPU's key for `leaf`: ``alive``, ``event``, one of `roles.LEAVES`."""
    return f"{ROOT}/{domain}/rtpu/{name}/{leaf}"


def all_rtpus(domain: str, leaf: str) -> str:
    """Return the key expression that matches `leaf` of every RTPU of the domain."""
    return f"{ROOT}/{domain}/rtpu/*/{leaf}"


def master(domain: str, subsystem: str, client: str) -> str:
    """Return the liveliness key of a subsystem's master `client`."""
    return f"{ROOT}/{domain}/sbs/{subsystem}/master/{client}"


def masters(domain: str, subsystem: str) -> str:
    """Return the key expression that matches the tokens of a subsystem's masters."""
    return f"{ROOT}/{domain}/sbs/{subsystem}/master/*"


def master_of(key: str) -> tuple[str, str]:
    """Return subsystem and client of a master's liveliness key."""
    parts = key.split("/")
    return parts[3], parts[5]


def svar(domain: str, subsystem: str, leaf: str, machine: str = "*") -> str:
    """Return a key of a subsystem's table on one machine, or on all.

    Args:
        domain: The domain.
        subsystem: The subsystem of the table.
        leaf: ``here``, ``news``, ``sync`` or ``flush``.
        machine: The machine, as returned by `machine`.
    """
    return f"{ROOT}/{domain}/sbs/{subsystem}/svar/{leaf}/{machine}"


def beat(domain: str, subsystem: str, name: str = "*") -> str:
    """Return the key of an agent's signs of life in a subsystem's group, or of all."""
    return f"{ROOT}/{domain}/sbs/{subsystem}/beat/{name}"


def beat_of(key: str) -> tuple[str, str]:
    """Return subsystem and agent of the key of a sign of life."""
    parts = key.split("/")
    return parts[3], parts[5]


def machine(identity: str) -> str:
    """Return a machine's identity in the form used in keys."""
    return identity.replace("/", "-")


def network(domain: str, portname: str) -> str:
    """Return the key of a master's network interface (section 4.4.2)."""
    return f"{ROOT}/{domain}/net/{portname}"


def network_client(domain: str, portname: str, client: str) -> str:
    """Return the liveliness key of a program that commands through the port."""
    return f"{ROOT}/{domain}/net/{portname}/client/{client}"


def rtpu_name(key: str) -> str:
    """Return the RTPU's name from one of its keys."""
    return key.split("/")[3]


def last(key: str) -> str:
    """Return the last part of a key, such as a master's client name."""
    return key.rsplit("/", 1)[-1]


def customer(domain: str, client: str) -> str:
    """Return the liveliness key of a client of remote resources, or of all clients."""
    return f"{ROOT}/{domain}/xm/client/{client}"


def clock(domain: str, name: str) -> str:
    """Return the key on which an agent publishes its machine's time."""
    return rtpu(domain, name, "clock")


def link(domain: str, name: str, leaf: str, *agents: str) -> str:
    """Return a key of a link between subsystems.

    Args:
        domain: The domain.
        name: The link's full name.
        leaf: ``sink`` and ``source`` are tokens of agents, ``data`` carries records.
        agents: The reader's agent for a sink; the writer's and the reader's otherwise.
    """
    return "/".join((ROOT, domain, "tbuf", name, leaf, *agents))


def all_links(domain: str) -> str:
    """Return the key expression that matches the tokens of all links."""
    return f"{ROOT}/{domain}/tbuf/**"


def link_parts(key: str) -> tuple[str, str, list[str]] | None:
    """Return name, leaf and agents of a link's key; None for other keys."""
    match key.split("/"):
        case [_, _, "tbuf", name, leaf, *agents]:
            return name, leaf, agents
        case _:
            return None
