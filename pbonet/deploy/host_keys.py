"""The key folders that machines are given; the authority stays with the operator."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from pbonet.errors import ConfigFileError
from pbonet.xm.net import credentials

if TYPE_CHECKING:
    from .hosts_file import Machine

RENEWED: Final = 30.0
"""Days before its expiry at which a certificate is replaced."""


class HostKeys(Struct, frozen=True, kw_only=True):
    """The keys of a machine, as the operator has them."""

    files: dict[str, bytes]
    """By name, ``ca.pem``, ``cert.pem`` and ``key.pem``; none while `lacks`."""
    lacks: str
    """Why a certificate must be made; empty: it is as it should be."""

    def digest(self, name: str) -> str:
        """Return SHA-256 of a file."""
        return hashlib.sha256(self.files[name]).hexdigest()


def keys_of(authority: Path, machine: Machine) -> HostKeys:
    """Return the keys of a machine, read where `pbonet keys` puts them.

    Raises:
        ConfigFileError: There is no authority, or a file cannot be read.
        NodeError: The package cryptography is missing.
    """
    from pbonet.xm.net import pki

    if not (authority / credentials.CA).exists():
        raise ConfigFileError(
            "there is no certificate authority",
            where=str(authority),
            expected=f"{credentials.CA} and ca.key",
            remedy=f"pbonet keys ca --ca {authority}",
        )
    folder = authority / machine.name
    if not (folder / credentials.KEY).exists():
        return HostKeys(files={}, lacks="it has none")
    holder = pki.read(folder)
    lacks = ""
    if holder.revoked:
        lacks = "it was revoked"
    elif holder.days < RENEWED:
        lacks = f"it is valid for {max(holder.days, 0):.0f} days"
    elif holder.role != credentials.Role(machine.host.role):
        lacks = f"it is one of a {holder.role}"
    elif missing := [n for n in machine.reached_at if n not in holder.hosts]:
        lacks = f"it does not name {', '.join(missing)}"
    return HostKeys(
        files={n: (folder / n).read_bytes() for n in credentials.FILES}, lacks=lacks
    )


def make(authority: Path, machine: Machine) -> HostKeys:
    """Make a machine's keys, in place of those that it has.

    Raises:
        ConfigFileError: The authority cannot be read, or a folder cannot be written.
        NodeError: A name or an address is malformed.
    """
    folder = authority / machine.name
    try:
        _renew(authority, machine, folder)
    except OSError as error:
        raise ConfigFileError(
            "the keys of a machine cannot be written",
            where=str(error.filename or folder),
            got=error.strerror or str(error),
            remedy="deploy as the user whose authority it is, and see whether its disk "
            "is full",
        ) from None
    return keys_of(authority, machine)


def _renew(authority: Path, machine: Machine, folder: Path) -> None:
    from pbonet.xm.net import pki

    with tempfile.TemporaryDirectory(dir=authority, prefix=".new-") as made:
        new = Path(made) / "keys"
        pki.issue(
            authority,
            credentials.Role(machine.host.role),
            machine.name,
            hosts=machine.reached_at,
            folder=new,
        )
        folder.mkdir(mode=0o700, exist_ok=True)
        for name in (credentials.KEY, credentials.CERT, credentials.CA):
            shutil.move(new / name, folder / name)
