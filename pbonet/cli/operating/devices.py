"""``pbonet devices``: the I/O devices of a domain's machines, and who has them."""

from __future__ import annotations

from pbonet.cli import options


def command(*, agents: options.Agents, json_: options.Json = False) -> None:
    """List the I/O devices of all agents, and the task at each port.

    Devices stand in the agents' agent.toml, as [device.NAME].

    Examples:
        See which task has a device:
        pbonet devices
        The same for a program, over the network:
        pbonet devices --json --connect tcp/10.0.0.2:7447
    """
    from pbonet.master.tools import device_owners

    found, errors = device_owners.ask(agents.domain, agents.connect)
    text = "\n".join(device_owners.lines(found)) or "the agents have no devices"
    warnings = list(map(str, errors))
    options.show_warned(text, {"devices": found}, warnings, as_data=json_)
