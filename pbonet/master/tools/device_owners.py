"""The I/O devices of all agents of a domain, and the tasks that have them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from pbonet.errors import NodeError, PbonetError
from pbonet.master.subsystem import client_name
from pbonet.xm.net import messages as m, rpc, session

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


def ask(
    domain: str, connect: Sequence[str]
) -> tuple[list[dict[str, Any]], list[PbonetError]]:
    """Return the devices, and the errors of agents that did not tell theirs.

    Each device is a `DeviceInfo` as data, with the RTPU and the host that has it.

    Raises:
        UnreachableError: No agent can be reached.
        NodeError: The domain has no agent.
    """
    opened = session.client(domain, connect=connect)
    client = rpc.Client(opened, domain, client_name("devices"))
    try:
        rtpus = client.rtpus()
        if not rtpus:
            raise NodeError(
                "there is no agent",
                where=f"domain {domain}",
                remedy="name the domain of its agents with --domain",
            )
        infos, _ = client.call_all({one: m.Hello() for one in rtpus}, m.AgentInfo)
        found, errors = client.call_all(
            {one: m.Devices() for one in rtpus}, list[m.DeviceInfo]
        )
    finally:
        client.close()
    hosts = {name: info.host for name, info in infos.items()}
    return [
        {"rtpu": rtpu, "host": hosts.get(rtpu, ""), **msgspec.to_builtins(device)}
        for rtpu, devices in sorted(found.items())
        for device in devices
    ], errors


def lines(devices: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines that show devices."""
    for one in devices:
        count = f", {one['ports']} ports" if one["ports"] else ""
        yield (
            f"{one['rtpu']} ({one['host']}) {one['name']}: {one['kind'] or 'class ?'}, "
            f"{one['driver']} {one['address']}{count}"
        )
        for user in one["users"]:
            who = user["task"] or "a program"
            yield f"  port {user['port']}: {user['mode']} {who}, process {user['pid']}"
        if fault := one.get("fault"):
            who = fault["task"] or "a program"
            yield f"  last error, {fault['age']:.0f} s ago, {who}: {fault['text']}"
