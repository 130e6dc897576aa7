"""Access to the page, and as what: links, cookies, hosts, and rates.

A link has a token that works once. It is changed into a signed cookie, which no script
of a page can read and no page of another origin can send. The key that signs cookies
is a file in the runtime folder: a server that was killed and started again knows its
browsers; one that ended in order has removed the file, so that its cookies are void.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import time
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from pbonet.xm.net import run_folder

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

COOKIE_TIME: Final = 12 * 3600.0
"""Seconds after which a browser needs a new link."""


class Role(StrEnum):
    """The rights of a browser."""

    OPERATOR = "operator"
    """It may give every command."""
    OBSERVER = "observer"
    """It may give commands that change nothing."""


class Access:
    """Decides what a browser may do.

    Args:
        hosts: Names and addresses by which browsers may call the server.
        port: The server's port.
        key: Signs cookies.
        roles: The roles for which there are links.
        secure: Whether browsers use TLS.
        clock: Returns the time in seconds since 1970.
    """

    def __init__(
        self,
        hosts: Iterable[str],
        port: int,
        key: bytes,
        *,
        roles: Iterable[Role] = tuple(Role),
        secure: bool = False,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self.scheme = "https" if secure else "http"
        self.secure = secure
        self.cookie = f"pbonet-{port}"
        """The cookie's name; browsers do not keep the ports of one host apart."""
        names = [f"[{one}]" if ":" in one else one for one in hosts]
        self._hosts = {f"{one}:{port}".lower() for one in names}
        usual = 443 if secure else 80
        if port == usual:
            self._hosts |= {one.lower() for one in names}
        self._url = f"{self.scheme}://{names[0]}:{port}/"
        self._key = key
        self._clock = clock
        self._tokens: dict[str, Role] = {}
        self._links: dict[Role, str] = {}
        for role in roles:
            self.renew(role)

    @property
    def links(self) -> dict[Role, str]:
        """The link for each role; it works once."""
        return dict(self._links)

    def renew(self, role: Role) -> str:
        """Return a new link for a role; the one before works no more."""
        self._tokens = {t: one for t, one in self._tokens.items() if one is not role}
        token = secrets.token_urlsafe(24)
        self._tokens[token] = role
        self._links[role] = f"{self._url}?token={token}"
        return self._links[role]

    def use(self, token: str) -> Role | None:
        """Return the role that a link's token gives, which is void from then on."""
        found = next((t for t in self._tokens if _are_equal(t, token)), None)
        return self._tokens.pop(found) if found is not None else None

    def sign(self, role: Role) -> str:
        """Return the value of a cookie that gives a role for some hours."""
        until = round(self._clock() + COOKIE_TIME)
        text = f"{role}.{until}.{secrets.token_urlsafe(12)}"
        return f"{text}.{self._signature(text)}"

    def role(self, cookie: str) -> Role | None:
        """Return the role that a cookie gives; None: none."""
        text, _, signature = cookie.rpartition(".")
        if not _are_equal(signature, self._signature(text)):
            return None
        role, until, _ = text.split(".", 2)
        found = Role(role)
        known = found in self._links
        return found if known and self._clock() < float(until) else None

    def _signature(self, text: str) -> str:
        data = text.encode(errors="replace")
        return hmac.new(self._key, data, hashlib.sha256).hexdigest()

    def is_host(self, host: str) -> bool:
        """Return whether a browser may call the server by this ``Host``."""
        return host.lower() in self._hosts

    def is_origin(self, origin: str) -> bool:
        """Return whether a page of this ``Origin`` may use the server."""
        scheme, _, host = origin.partition("://")
        return scheme == self.scheme and self.is_host(host)


def _are_equal(one: str, other: str) -> bool:
    """Compare two texts in a time that tells nothing of them."""
    return hmac.compare_digest(
        one.encode(errors="replace"), other.encode(errors="replace")
    )


class Rate:
    """Limits how often something is done: `per_second` in the mean, a burst at once."""

    def __init__(
        self,
        per_second: float,
        burst: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._per_second = per_second
        self._burst = float(burst)
        self._left = float(burst)
        self._clock = clock
        self._last = clock()

    def allows(self) -> bool:
        """Count one more; return whether it is within the limit."""
        now = self._clock()
        gained = (now - self._last) * self._per_second
        self._left = min(self._burst, self._left + gained)
        self._last = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


class KeyFile:
    """The file with the key that signs the cookies of one subsystem's page.

    Args:
        domain: The subsystem's domain.
        subsystem: Its name.
        port: The server's port.
    """

    def __init__(self, domain: str, subsystem: str, port: int) -> None:
        folder = run_folder.folder() / domain
        folder.mkdir(mode=0o700, exist_ok=True)
        self.path: Path = folder / f"{subsystem}.{port}.web"

    def read(self) -> bytes:
        """Return the key; a new one if there is none."""
        try:
            key = self.path.read_bytes()
        except FileNotFoundError:
            key = b""
        if len(key) == _KEY_BYTES:
            return key
        key = secrets.token_bytes(_KEY_BYTES)
        self.path.unlink(missing_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
        with os.fdopen(os.open(self.path, flags, 0o600), "wb") as file:
            file.write(key)
        return key

    def remove(self) -> None:
        """Make the key's cookies void."""
        self.path.unlink(missing_ok=True)


_KEY_BYTES: Final = 32
