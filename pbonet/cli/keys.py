"""``pbonet keys``: certificates of agents, gateways, masters and observers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

from . import options
from .parser import Argument, Option

HELP = "Make and revoke certificates for agents, gateways, masters and observers."

Authority = A[Path, Option("The authority's folder.", "FOLDER", names=("--ca",))]
Name = A[str, Argument("The holder: a machine or a person.")]
Days = A[float, Option("How many days they are valid.", "DAYS", least=0.0)]
Hosts = A[
    list[str] | None,
    Option("A name or address by which others connect to it.", "HOST"),
]
Out = A[Path | None, Option("Where to put them; CA/NAME if left out.", "FOLDER")]
HERE = Path("keys")
LONG = 825.0


def ca(
    *,
    folder: Authority = HERE,
    name: A[str, Option("The name of the laboratory.", "NAME")] = "pbonet",
    json_: options.Json = False,
) -> None:
    """Make a laboratory's certificate authority; keep its ca.key secret.

    Examples:
        Make one in the folder keys:
        pbonet keys ca
        Make one on a stick that stays in the safe:
        pbonet keys ca --ca /media/stick/keys --name robotics
    """
    from pbonet.xm.net import pki

    options.show_files([pki.make_authority(folder, name)], as_data=json_)


def agent(
    *,
    name: Name,
    host: Hosts = None,
    folder: Authority = HERE,
    days: Days = LONG,
    out: Out = None,
    json_: options.Json = False,
) -> None:
    """Make the certificate of a machine with agents; it may not command.

    Examples:
        Make that of a machine with two addresses:
        pbonet keys agent robot1 --host robot1.lab --host 10.0.0.2
        Make one that is valid for a month:
        pbonet keys agent visitor --host 10.0.0.9 --days 30
    """
    from pbonet.xm.net import credentials, pki

    made = pki.issue(
        folder, credentials.Role.AGENT, name, hosts=host or (), days=days, folder=out
    )
    options.show_files([made], as_data=json_)


def gateway(
    *,
    name: Name,
    host: Hosts = None,
    folder: Authority = HERE,
    days: Days = LONG,
    out: Out = None,
    json_: options.Json = False,
) -> None:
    """Make the certificate of an agent that passes commands on.

    Examples:
        Make that of the computer from which robots are commanded:
        pbonet keys gateway desk --host desk.lab --host 10.0.0.1
        Replace the one of an agent that had keys before there were gateways:
        pbonet keys gateway arm-pc --host 10.0.0.2 --out keys/arm-pc-new
    """
    from pbonet.xm.net import credentials, pki

    made = pki.issue(
        folder, credentials.Role.GATEWAY, name, hosts=host or (), days=days, folder=out
    )
    options.show_files([made], as_data=json_)


def master(
    *,
    name: Name,
    folder: Authority = HERE,
    days: Days = LONG,
    out: Out = None,
    json_: options.Json = False,
) -> None:
    """Make the certificate of a master: it may change subsystems.

    Examples:
        Make one:
        pbonet keys master anna
        Make one in the holder's own folder:
        pbonet keys master anna --out ~anna/keys
    """
    from pbonet.xm.net import credentials, pki

    made = pki.issue(folder, credentials.Role.MASTER, name, days=days, folder=out)
    options.show_files([made], as_data=json_)


def observer(
    *,
    name: Name,
    folder: Authority = HERE,
    days: Days = LONG,
    out: Out = None,
    json_: options.Json = False,
) -> None:
    """Make the certificate of an observer: it may only watch.

    Examples:
        Make one:
        pbonet keys observer display1
        Make one for a day's visit:
        pbonet keys observer guest --days 1
    """
    from pbonet.xm.net import credentials, pki

    made = pki.issue(folder, credentials.Role.OBSERVER, name, days=days, folder=out)
    options.show_files([made], as_data=json_)


def revoke(
    *,
    name: A[str, Argument("The holder of the certificates, as `show` prints it.")],
    folder: Authority = HERE,
    json_: options.Json = False,
) -> None:
    """Revoke all certificates of a holder, by a new ca.pem for all.

    Copy it to every machine and person, and restart each agent with SIGHUP: from then
    on it refuses these certificates.

    Examples:
        Revoke those of a robot that was lost:
        pbonet keys revoke robot1
        Revoke those of a person who has left, where the authority is on a stick:
        pbonet keys revoke anna --ca /media/stick/keys
    """
    from pbonet.xm.net import pki

    options.show_files(pki.revoke(folder, name), as_data=json_)


def show(
    *,
    folders: A[list[Path], Argument("Folders of certificates.", "FOLDER")],
    json_: options.Json = False,
) -> None:
    """Show holders of certificates, how long they are valid or revoked.

    Examples:
        Show one:
        pbonet keys show keys/robot1
        Show all that were made here:
        pbonet keys show keys/*/
    """
    from pbonet.xm.net import pki

    found = [pki.read(folder) for folder in folders]
    lines: list[str] = []
    for one in found:
        hosts = f" at {', '.join(one.hosts)}" if one.hosts else ""
        state = f"{one.days:.0f} days left" if one.days > 0 else "EXPIRED"
        state = "REVOKED" if one.revoked else state
        line = f"{one.name}: {one.role.value}{hosts}, until {one.until} ({state})"
        if one.refuses:
            line += f"; refuses {', '.join(one.refuses)}"
        if not one.revocable:
            line += "; of an older version: cannot be revoked, make another"
        lines.append(line)
    options.show("\n".join(lines), found, as_data=json_)


COMMANDS = (ca, agent, gateway, master, observer, revoke, show)
