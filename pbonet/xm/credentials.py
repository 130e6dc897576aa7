"""Key folders: with what a session proves who it is.

A key folder holds three files, ``ca.pem``, ``cert.pem`` and ``key.pem``; it is what one
copies to a machine. `pbonet keys` makes it.
"""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path

from pbonet.errors import ConfigFileError

FILES = CA, CERT, KEY = "ca.pem", "cert.pem", "key.pem"
VARIABLE = "PBONET_KEYS"
"""Names the key folder of masters and tools."""


class Role(StrEnum):
    """What a certificate lets its holder do."""

    AGENT = "agent"
    MASTER = "master"
    OBSERVER = "observer"

    @property
    def common_name(self) -> str:
        """Return the certificate's common name."""
        return f"pbonet-{self.value}"


def named() -> Path | None:
    """Return the key folder that the environment names."""
    name = os.environ.get(VARIABLE, "")
    return Path(name).absolute() if name else None


def check(folder: Path) -> Path:
    """Return `folder` if it is a key folder that this process may read.

    Raises:
        ConfigFileError: A file is missing, or everybody may read the key.
    """
    for name in FILES:
        try:
            with (folder / name).open("rb"):
                pass
        except OSError as error:
            raise ConfigFileError(
                "this is no key folder",
                where=str(folder / name),
                expected=f"{CA}, {CERT} and {KEY}",
                got=error.strerror or str(error),
                remedy="`pbonet keys agent|master|observer NAME` makes one",
            ) from None
    mode = (folder / KEY).stat().st_mode & 0o077
    if mode & 0o007:
        raise ConfigFileError(
            "everybody may read the private key",
            where=str(folder / KEY),
            expected="mode 0600, or 0640 for a group",
            got=f"{mode | 0o600:04o}",
            remedy=f"chmod 600 {folder / KEY}",
        )
    return folder
