"""The one place that knows how keys on the network are spelled."""

from __future__ import annotations

ROOT = "pbonet"


def rtpu(domain: str, name: str, leaf: str) -> str:
    """Return an RTPU's key for `leaf`: ``alive``, ``sbs``, ``status`` or ``event``."""
    return f"{ROOT}/{domain}/rtpu/{name}/{leaf}"


def all_rtpus(domain: str, leaf: str) -> str:
    """Return the key expression that matches `leaf` of every RTPU of the domain."""
    return f"{ROOT}/{domain}/rtpu/*/{leaf}"


def master(domain: str, subsystem: str, client: str) -> str:
    """Return the liveliness key of a subsystem's master `client`."""
    return f"{ROOT}/{domain}/sbs/{subsystem}/master/{client}"


def network(domain: str, portname: str) -> str:
    """Return the key on which a master's network interface answers (section 4.4.2)."""
    return f"{ROOT}/{domain}/net/{portname}"


def rtpu_name(key: str) -> str:
    """Return the RTPU's name out of one of its keys."""
    return key.split("/")[3]
