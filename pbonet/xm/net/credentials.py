"""Key folders: the credentials of a session.

A key folder holds three files, ``ca.pem``, ``cert.pem`` and ``key.pem``, and is copied
to a machine as a whole. `pbonet keys` makes it.
"""

from __future__ import annotations

import contextlib
import os
import time
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self, cast

from pbonet.errors import ConfigFileError

if TYPE_CHECKING:
    import ssl
    from collections.abc import Collection

FILES = CA, CERT, KEY = "ca.pem", "cert.pem", "key.pem"
VARIABLE = "PBONET_KEYS"
"""Variable with the key folder of masters and tools."""
_RUN_OUT: Final = 10
_NOT_YET: Final = 9
"""OpenSSL's error numbers for certificates outside their validity period."""
_REVOKED: Final = 48
"""OpenSSL's error number for a name that the authority's certificate excludes."""
SOON: Final = 30 * 86400.0
"""Seconds before its expiry from which an expiring certificate is reported."""


class Role(StrEnum):
    """Permissions of a certificate's holder; see `access_control`."""

    AGENT = "agent"
    """An agent, of whose link no commands are accepted."""
    GATEWAY = "gateway"
    """An agent through which commands may come. Every agent's certificate was one
    before there was the role `AGENT`."""
    MASTER = "master"
    OBSERVER = "observer"

    @property
    def common_name(self) -> str:
        """Return the certificate's common name, which zenoh compares as a whole."""
        return _COMMON_NAMES[self]

    @classmethod
    def of(cls, common_name: str) -> Self | None:
        """Return the role of a certificate; None if pbonet has not made it."""
        return next((one for one in cls if one.common_name == common_name), None)


_COMMON_NAMES: Final = {
    Role.AGENT: "pbonet-robot",
    Role.GATEWAY: "pbonet-agent",
    Role.MASTER: "pbonet-master",
    Role.OBSERVER: "pbonet-observer",
}
AGENTS: Final = (Role.AGENT, Role.GATEWAY)
"""Roles of certificates with which an agent runs."""
MAKE: Final = f"`pbonet keys {'|'.join(Role)} NAME`"
"""The commands that make a key folder."""


def named() -> Path | None:
    """Return the key folder that `PBONET_KEYS` names, if any."""
    name = os.environ.get(VARIABLE, "")
    return Path(name).absolute() if name else None


def check(folder: Path) -> Path:
    """Return `folder` if it is a key folder that this process may read.

    Raises:
        ConfigFileError: A file is missing, or the key is readable by all users.
    """
    for name in FILES:
        try:
            with (folder / name).open("rb"):
                pass
        except OSError as error:
            raise ConfigFileError(
                "this is not a key folder",
                where=str(folder / name),
                expected=f"{CA}, {CERT} and {KEY}",
                got=error.strerror or str(error),
                remedy=f"{MAKE} makes one",
            ) from None
    mode = (folder / KEY).stat().st_mode & 0o077
    if mode & 0o007:
        raise ConfigFileError(
            "all users may read the private key",
            where=str(folder / KEY),
            expected="mode 0600, or 0640 for a group",
            got=f"{mode | 0o600:04o}",
            remedy=f"chmod 600 {folder / KEY}",
        )
    return folder


def left(until: float) -> float:
    """Return the seconds until a time returned by `prove`."""
    return until - time.time()


def days(seconds: float) -> str:
    """Return a remaining time as text."""
    if seconds < 2 * 60:
        return f"{seconds:.0f} seconds"
    if seconds < 2 * 3600:
        return f"{seconds / 60:.0f} minutes"
    if seconds < 2 * 86400:
        return f"{seconds / 3600:.0f} hours"
    return f"{seconds / 86400:.0f} days"


def prove(folder: Path, roles: Collection[Role] = tuple(Role)) -> float:
    """Check that other machines will accept the keys of `folder`.

    Its certificate is verified with its own authority, as other machines will do. A
    session with bad keys would only get no answer.

    Args:
        folder: A key folder.
        roles: The accepted roles.

    Returns:
        The time of its expiry, for `left`.

    Raises:
        ConfigFileError: A file is missing or damaged, the certificate has expired, was
            not signed by the authority, has been revoked, or is for another role.
    """
    import ssl

    check(folder)
    try:
        common, until = _shown(*(folder / name for name in FILES))
    except ssl.SSLCertVerificationError as error:
        raise _refused(folder, error) from None
    except ssl.SSLError as error:
        raise ConfigFileError(
            "the files of this key folder do not belong together",
            where=str(folder),
            expected=f"{CERT}, its {KEY}, and the {CA} that signed it",
            got=error.reason or str(error),
            remedy="copy the whole folder that `pbonet keys` has made",
        ) from None
    role = Role.of(common)
    if role not in roles:
        raise ConfigFileError(
            "these keys are for another role",
            where=str(folder / CERT),
            expected=" or ".join(roles),
            got=role or common,
            remedy=f"`pbonet keys {'|'.join(roles)} NAME` makes the correct ones",
        )
    return until


def role(folder: Path) -> Role | None:
    """Return the role of the keys of `folder`, which are in order (`prove`)."""
    common, _ = _shown(*(folder / name for name in FILES))
    return Role.of(common)


def doubted(folder: Path, host: str, port: int, limit: float = 0.4) -> str:
    """Return why the keys of `folder` and a TLS listener reject each other.

    Args:
        folder: A key folder.
        host: Host of the listener.
        port: Port of the listener.
        limit: Time-out of each answer in seconds.

    Returns:
        A sentence; empty if they accept each other, or there is no answer.
    """
    import socket
    import ssl

    holder = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    holder.check_hostname = False
    try:
        holder.load_verify_locations(folder / CA)
        holder.load_cert_chain(folder / CERT, folder / KEY, password="")
        with (
            socket.create_connection((host, port), limit) as plain,
            holder.wrap_socket(plain) as one,
        ):
            one.recv(1)  # a certificate is refused after the handshake
    except ssl.SSLCertVerificationError as error:
        how = {
            _RUN_OUT: "has expired",
            _NOT_YET: "is not valid yet (check the clocks of both machines)",
            _REVOKED: "has been revoked",
        }
        other = "was not signed by the authority of these keys"
        return f"its certificate {how.get(error.verify_code, other)}"
    except ssl.SSLError as error:
        refused = "ALERT" in (error.reason or "")
        return "it refuses the certificate of these keys" if refused else ""
    except OSError:
        return ""
    return ""


def _shown(ca: Path, cert: Path, key: Path) -> tuple[str, float]:
    """Verify a certificate with its authority; return its common name and expiry."""
    import ssl

    judge = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    judge.verify_mode = ssl.CERT_REQUIRED
    judge.load_verify_locations(ca)
    holder = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    holder.check_hostname = False
    holder.verify_mode = ssl.CERT_NONE  # the judge uses the same certificate
    for context in (judge, holder):
        context.load_cert_chain(cert, key, password="")
    here, there = ssl.MemoryBIO(), ssl.MemoryBIO()
    shows = holder.wrap_bio(here, there)
    sees = judge.wrap_bio(there, here, server_side=True)
    for side in (shows, sees, shows, sees):
        with contextlib.suppress(ssl.SSLWantReadError):
            side.do_handshake()
    found = sees.getpeercert() or {}
    subject = cast("tuple[tuple[tuple[str, str], ...], ...]", found.get("subject", ()))
    until = ssl.cert_time_to_seconds(cast("str", found["notAfter"]))
    names = dict(pair for part in subject for pair in part)
    return names.get("commonName", ""), float(until)


def _refused(folder: Path, error: ssl.SSLCertVerificationError) -> ConfigFileError:
    """Return the error for a certificate that its authority rejects."""
    what, remedy = {
        _RUN_OUT: (
            "the certificate has expired",
            f"{MAKE} makes another",
        ),
        _REVOKED: (
            "the certificate has been revoked",
            f"{MAKE} makes another",
        ),
        _NOT_YET: (
            "the certificate is not valid yet",
            "set the clock of this machine, or of the one that made it",
        ),
    }.get(
        error.verify_code,
        (
            "the certificate was not signed by the authority beside it",
            "copy the whole folder that `pbonet keys` has made",
        ),
    )
    return ConfigFileError(
        what, where=str(folder / CERT), got=error.verify_message, remedy=remedy
    )
