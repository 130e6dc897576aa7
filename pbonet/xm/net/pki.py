"""Certificates of a laboratory: the roles agent, master and observer.

One authority signs for one laboratory and makes a key folder (see `credentials`) for
each machine and person. A certificate's common name is the role, which access control
checks; its organizational unit is the holder's own name, for display.

Needs the package cryptography, which running a robot does not need.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.errors import ConfigFileError, NodeError

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

from .credentials import CA, CERT, KEY, Role, check

if TYPE_CHECKING:
    from collections.abc import Sequence

AUTHORITY_KEY = "ca.key"
YEARS = 10.0
"""Validity of an authority in years."""
DAYS = 825.0
"""Default validity of a certificate in days."""
_EARLY = dt.timedelta(hours=1)
"""Certificates are valid from the past on, because clocks of machines differ."""
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,30}")


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
    subject = _subject("pbonet-authority", name)
    now = dt.datetime.now(dt.UTC)
    made = (
        x509
        .CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLY)
        .not_valid_after(now + dt.timedelta(days=365.25 * YEARS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(authority=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    _write(folder, {AUTHORITY_KEY: _private(key), CA: _pem(made)})
    return folder / CA


def issue(
    authority: Path,
    role: Role,
    name: str,
    *,
    hosts: Sequence[str] = (),
    days: float = DAYS,
    folder: Path | None = None,
) -> Path:
    """Make a key folder for an agent, a master or an observer.

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
    if role is Role.AGENT and not hosts:
        raise NodeError(
            f"no machine could reach agent {name}: its certificate would name no host",
            expected="every name and address by which others connect to it",
            remedy=f"for example: pbonet keys agent {name} --host 10.0.0.2",
        )
    folder = folder or authority / name
    if (folder / KEY).exists():
        raise NodeError(
            f"{folder} already has keys",
            remedy="name another folder with --out, or remove it first",
        )
    signer, signer_key = _load_authority(authority)
    key = ec.generate_private_key(ec.SECP256R1())
    now = dt.datetime.now(dt.UTC)
    builder = (
        x509
        .CertificateBuilder()
        .subject_name(_subject(role.common_name, name))
        .issuer_name(signer.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLY)
        .not_valid_after(now + dt.timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(authority=False), critical=True)
        .add_extension(_purposes(role), critical=False)
    )
    if hosts:
        names = x509.SubjectAlternativeName([_host(one) for one in hosts])
        builder = builder.add_extension(names, critical=False)
    made = builder.sign(signer_key, hashes.SHA256())
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
        role = Role(_attribute(found, NameOID.COMMON_NAME).removeprefix("pbonet-"))
    except ValueError as error:
        raise ConfigFileError(
            "this is not a certificate of pbonet",
            where=str(folder / CERT),
            got=str(error),
            remedy="`pbonet keys agent|master|observer NAME` makes one",
        ) from None
    hosts: tuple[str, ...] = ()
    for extension in found.extensions:
        if isinstance(extension.value, x509.SubjectAlternativeName):
            hosts = tuple(str(one.value) for one in extension.value)
    until = found.not_valid_after_utc
    left = (until - dt.datetime.now(dt.UTC)).total_seconds() / 86400
    name = _attribute(found, NameOID.ORGANIZATIONAL_UNIT_NAME)
    return Holder(name, role, hosts, f"{until:%Y-%m-%d}", left)


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
    if role is Role.AGENT:
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
    """Write files that only their owner may read, keys first."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        for name, data in files.items():
            mode = 0o644 if name.endswith("ca.pem") or name == CERT else 0o600
            fd = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode)
            with os.fdopen(fd, "wb") as file:
                file.write(data)
    except OSError as error:
        raise ConfigFileError(
            "the keys cannot be written",
            where=str(error.filename or folder),
            got=error.strerror or str(error),
            remedy="name a folder of your own with --out or --ca",
        ) from None
