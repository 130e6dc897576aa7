"""Certificates of a laboratory: the roles agent, gateway, master and observer.

One authority signs for one laboratory and makes a key folder (see `credentials`) for
each machine and person. A certificate's common name stands for the role, which access
control checks; its organizational unit is the holder's own name, for display.

zenoh takes no list of revoked certificates, but the names that an authority's
certificate excludes bind it and OpenSSL. So each certificate contains a name of its
own, which reaches no host, and the authority revokes it by renewing its own
certificate ``ca.pem`` so that this excludes the name. Its key stays the same, so all
other certificates stay valid.

Needs the package cryptography, which running a robot does not need.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import ipaddress
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.errors import ConfigFileError, NodeError, did_you_mean

try:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError:
    raise NodeError(
        "making certificates needs the package cryptography",
        remedy="pip install 'pbonet[keys]'",
    ) from None

from .credentials import AGENTS, CA, CERT, KEY, MAKE, Role, check

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

AUTHORITY_KEY = "ca.key"
ISSUED = "issued.txt"
"""The authority's list of certificates: own name, role and holder, one in a line."""
YEARS = 10.0
"""Validity of an authority in years."""
DAYS = 825.0
"""Default validity of a certificate in days."""
_EARLY = dt.timedelta(hours=1)
"""Certificates are valid from the past on, because clocks of machines differ."""
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,30}")
_OWN = re.compile(r"[0-9a-f]+\.([0-9a-f]+)\.pbonet\.invalid")
"""A certificate's own name: its serial number, and its holder's name in hexadecimal."""


class Holder(Struct, frozen=True):
    """The holder of a key folder."""

    name: str
    role: Role
    hosts: tuple[str, ...]
    """Addresses at which other machines reach it; for agents only."""
    until: str
    """Last day, as YEAR-MONTH-DAY."""
    days: float
    """Remaining days; negative after expiry."""
    revocable: bool
    """Whether it has a name of its own; those of older versions have none."""
    revoked: bool
    """Whether the authority's certificate beside it excludes it."""
    refuses: tuple[str, ...]
    """Holders of the certificates that the authority's certificate excludes."""


def make_authority(folder: Path, name: str = "pbonet") -> Path:
    """Make the authority that signs a laboratory's certificates.

    Args:
        folder: Folder for ``ca.pem`` and ``ca.key``; made if necessary.
        name: Name of the laboratory, for display.

    Returns:
        The path of ``ca.pem``.

    Raises:
        NodeError: The folder already has an authority.
        ConfigFileError: The folder cannot be written.
    """
    if (folder / AUTHORITY_KEY).exists():
        raise NodeError(
            "this folder already has an authority",
            where=str(folder),
            remedy="all its certificates would be void; name another folder with --ca, "
            "or remove it first",
        )
    key = ec.generate_private_key(ec.SECP256R1())
    now = dt.datetime.now(dt.UTC)
    end = now + dt.timedelta(days=365.25 * YEARS)
    made = _signed_by_itself(key, _subject("pbonet-authority", name), now, end)
    _write(folder, {AUTHORITY_KEY: _private(key), CA: _pem(made), ISSUED: b""})
    return folder / CA


def _signed_by_itself(
    key: ec.EllipticCurvePrivateKey,
    subject: x509.Name,
    now: dt.datetime,
    end: dt.datetime,
    revoked: Iterable[str] = (),
) -> x509.Certificate:
    """Return an authority's certificate, which excludes the names in `revoked`."""
    builder = (
        x509
        .CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLY)
        .not_valid_after(end)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(authority=True), critical=True)
    )
    if excluded := [x509.DNSName(one) for one in sorted(revoked)]:
        builder = builder.add_extension(
            x509.NameConstraints(None, excluded), critical=True
        )
    return builder.sign(key, hashes.SHA256())


def revoke(authority: Path, name: str) -> list[Path]:
    """Revoke all certificates that were made for a holder.

    Every agent and client that has the new ``ca.pem`` refuses them. It is written into
    the authority's folder, and into the key folders that are in it.

    Args:
        authority: The authority's folder.
        name: The holder's own name.

    Returns:
        The files written.

    Raises:
        NodeError: No certificate was made for this holder.
        ConfigFileError: The authority cannot be read, or a file cannot be written.
    """
    signer, key = _load_authority(authority)
    issued = _issued(authority)
    owns = [own for own, holder in issued if holder == name]
    if not owns:
        raise NodeError(
            f"no certificate was made for a holder {name}, so none is revoked",
            where=str(authority / ISSUED),
            got="holders: " + (", ".join(sorted({h for _, h in issued})) or "none"),
            remedy=did_you_mean(name, [holder for _, holder in issued])
            or "certificates of older versions cannot be revoked alone: make another "
            "authority, and new keys for all",
        )
    now, end = dt.datetime.now(dt.UTC), signer.not_valid_after_utc
    revoked = {*_excluded(signer), *owns}
    made = _pem(_signed_by_itself(key, signer.subject, now, end, revoked))
    folders = [authority, *sorted(_folders_of(authority, signer))]
    for folder in folders:
        _write(folder, {CA: made})
    return [folder / CA for folder in folders]


def _issued(authority: Path) -> list[tuple[str, str]]:
    """Return own name and holder of each certificate that the authority has made."""
    try:
        lines = (authority / ISSUED).read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:  # an authority of an older version
        return []
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigFileError(
            "the list of certificates cannot be read",
            where=str(authority / ISSUED),
            got=getattr(error, "strerror", "") or str(error),
            remedy="restore it from a copy",
        ) from None
    parts = [line.split() for line in lines]
    return [(part[0], part[2]) for part in parts if len(part) == len(_COLUMNS)]


_COLUMNS = ("own name", "role", "holder")


def _note_issued(authority: Path, own: str, role: Role, name: str) -> None:
    """Add a certificate to the list, before it is made."""
    try:
        with (authority / ISSUED).open("a", encoding="utf-8") as file:
            file.write(f"{own} {role} {name}\n")
    except OSError as error:
        raise ConfigFileError(
            "the list of certificates cannot be written",
            where=str(authority / ISSUED),
            got=error.strerror or str(error),
            remedy="a certificate that is not in it could not be revoked; make the "
            "authority's folder writable",
        ) from None


def _folders_of(authority: Path, signer: x509.Certificate) -> Iterable[Path]:
    """Yield the key folders in the authority's folder that have its certificate."""
    for path in authority.glob(f"*/{CA}"):
        with contextlib.suppress(OSError, ValueError):
            found = x509.load_pem_x509_certificate(path.read_bytes())
            if found.public_key() == signer.public_key():
                yield path.parent


def _excluded(signer: x509.Certificate) -> tuple[str, ...]:
    """Return the own names of the certificates that an authority has revoked."""
    for extension in signer.extensions:
        if isinstance(extension.value, x509.NameConstraints):
            return tuple(
                str(one.value) for one in extension.value.excluded_subtrees or ()
            )
    return ()


def _holder(own: str) -> str:
    """Return the holder in a certificate's own name."""
    match = _OWN.fullmatch(own)
    return bytes.fromhex(match[1]).decode() if match else own


def issue(
    authority: Path,
    role: Role,
    name: str,
    *,
    hosts: Sequence[str] = (),
    days: float = DAYS,
    folder: Path | None = None,
) -> Path:
    """Make a key folder for an agent, a gateway, a master or an observer.

    Args:
        authority: The authority's folder.
        role: The holder's role.
        name: The holder's own name.
        hosts: Names and addresses at which other machines reach an agent.
        days: Validity in days.
        folder: Destination; ``authority/name`` by default.

    Returns:
        The folder.

    Raises:
        NodeError: The name or a host is malformed, an agent has no host, or the folder
            already has keys.
        ConfigFileError: The authority cannot be read, or the folder cannot be written.
    """
    if not _NAME.fullmatch(name):
        raise NodeError(
            "this is not a valid name for the holder of a certificate",
            expected="1 to 31 letters, digits, _, - and ., not - or . first",
            got=repr(name),
            remedy="name the machine or the person, such as arm-pc or anna",
        )
    if role in AGENTS and not hosts:
        raise NodeError(
            f"no machine could reach agent {name}: its certificate would name no host",
            expected="every name and address by which others connect to it",
            remedy=f"for example: pbonet keys {role} {name} --host 10.0.0.2",
        )
    names = [_host(one) for one in hosts]
    folder = folder or authority / name
    if (folder / KEY).exists():
        raise NodeError(
            f"{folder} already has keys",
            remedy="name another folder with --out, or remove it first",
        )
    signer, signer_key = _load_authority(authority)
    key = ec.generate_private_key(ec.SECP256R1())
    serial = x509.random_serial_number()
    own = f"{serial:x}.{name.encode().hex()}.pbonet.invalid"
    _note_issued(authority, own, role, name)
    now = dt.datetime.now(dt.UTC)
    made = (
        x509
        .CertificateBuilder()
        .subject_name(_subject(role.common_name, name))
        .issuer_name(signer.subject)
        .public_key(key.public_key())
        .serial_number(serial)
        .not_valid_before(now - _EARLY)
        .not_valid_after(now + dt.timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(authority=False), critical=True)
        .add_extension(_purposes(role), critical=False)
        .add_extension(
            x509.SubjectAlternativeName([*names, x509.DNSName(own)]), critical=False
        )
        .sign(signer_key, hashes.SHA256())
    )
    _write(folder, {KEY: _private(key), CERT: _pem(made), CA: _pem(signer)})
    return folder


def read(folder: Path) -> Holder:
    """Return the holder of a key folder.

    Raises:
        ConfigFileError: A file is missing, or is not a certificate of pbonet.
    """
    check(folder)
    try:
        found = x509.load_pem_x509_certificate((folder / CERT).read_bytes())
        signer = x509.load_pem_x509_certificate((folder / CA).read_bytes())
        role = _role(found)
    except ValueError as error:
        raise ConfigFileError(
            "this is not a certificate of pbonet",
            where=str(folder / CERT),
            got=str(error),
            remedy=f"{MAKE} makes one",
        ) from None
    names: tuple[str, ...] = ()
    for extension in found.extensions:
        if isinstance(extension.value, x509.SubjectAlternativeName):
            names = tuple(str(one.value) for one in extension.value)
    owns = [one for one in names if _OWN.fullmatch(one)]
    excluded = _excluded(signer)
    until = found.not_valid_after_utc
    left = (until - dt.datetime.now(dt.UTC)).total_seconds() / 86400
    name = _attribute(found, NameOID.ORGANIZATIONAL_UNIT_NAME)
    return Holder(
        name=name,
        role=role,
        hosts=tuple(one for one in names if one not in owns),
        until=f"{until:%Y-%m-%d}",
        days=left,
        revocable=bool(owns),
        revoked=not set(owns).isdisjoint(excluded),
        refuses=tuple(sorted({_holder(one) for one in excluded})),
    )


def _subject(common: str, unit: str) -> x509.Name:
    return x509.Name([
        x509.NameAttribute(NameOID.COMMON_NAME, common),
        x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, unit),
    ])


def _attribute(found: x509.Certificate, oid: x509.ObjectIdentifier) -> str:
    values = found.subject.get_attributes_for_oid(oid)
    if not values:
        raise ValueError(f"its subject has no {oid._name}")  # noqa: SLF001
    return str(values[0].value)


def _role(found: x509.Certificate) -> Role:
    common = _attribute(found, NameOID.COMMON_NAME)
    role = Role.of(common)
    if role is None:
        raise ValueError(f"its common name is {common}")
    return role


def _usage(*, authority: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=authority,
        crl_sign=authority,
        encipher_only=False,
        decipher_only=False,
    )


def _purposes(role: Role) -> x509.ExtendedKeyUsage:
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if role in AGENTS:
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
    return x509.ExtendedKeyUsage(purposes)


def _host(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        pass
    try:
        return x509.DNSName(text)
    except ValueError as error:
        raise NodeError(
            "this is not a host",
            expected="a name such as arm.lab, or an address",
            got=repr(text),
            remedy=str(error),
        ) from None


def _load_authority(
    folder: Path,
) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    try:
        made = x509.load_pem_x509_certificate((folder / CA).read_bytes())
        text = (folder / AUTHORITY_KEY).read_bytes()
        key = serialization.load_pem_private_key(text, None)
    except OSError as error:
        raise ConfigFileError(
            "there is no authority",
            where=str(error.filename or folder),
            got=error.strerror or str(error),
            remedy=f"make one: pbonet keys ca --ca {folder}",
        ) from None
    except ValueError as error:
        raise ConfigFileError(
            "the authority's files are damaged",
            where=str(folder),
            got=str(error).splitlines()[0],
            remedy="restore them from a copy",
        ) from None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise ConfigFileError(
            "the authority's key is of another kind",
            where=str(folder / AUTHORITY_KEY),
            expected="a key that `pbonet keys ca` made",
            remedy=f"make an authority: pbonet keys ca --ca {folder}",
        )
    return made, key


def _private(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def _pem(made: x509.Certificate) -> bytes:
    return made.public_bytes(serialization.Encoding.PEM)


def _write(folder: Path, files: dict[str, bytes]) -> None:
    """Write files, of which only their owner may read keys, as wholes, keys first."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        for name, data in files.items():
            mode = 0o600 if name.endswith("key.pem") or name == AUTHORITY_KEY else 0o644
            part = folder / f".{name}.part"
            part.unlink(missing_ok=True)
            fd = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
            with os.fdopen(fd, "wb") as file:
                file.write(data)
            part.replace(folder / name)
    except OSError as error:
        raise ConfigFileError(
            "the keys cannot be written",
            where=str(error.filename or folder),
            got=error.strerror or str(error),
            remedy="name a folder of your own with --out or --ca",
        ) from None
