"""A router's configuration: zenoh's file, or pbonet's settings, and what overrides it.

`show` gives the same to `zenohd`.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, cast

import msgspec
import zenoh

from pbonet.errors import ConfigError, ConfigFileError, NodeError
from pbonet.xm.net import access_control, session

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

KINDS = (".json5", ".json", ".yaml", ".yml")
"""Kinds of files that zenoh reads."""
_AT = re.compile(r"line: (\d+), column: (\d+)|--> (\d+):(\d+)")
_MESSAGE = re.compile(r'msg: "(.*?)", location|= (.*)')


def read(
    path: Path | None = None,
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    key_folder: Path | None = None,
    insecure: bool = False,
) -> zenoh.Config:
    """Return the configuration of a router.

    Args:
        path: Zenoh's configuration file. What it leaves out is as zenoh has it; without
            a file everything is as agents need it.
        listen: Endpoints that replace those of the file.
        connect: Endpoints of other routers that replace those of the file.
        key_folder: The keys of a gateway, which replace those of the file; pbonet's
            access control then replaces that of the file.
        insecure: Whether everybody may connect who reaches an endpoint.

    Raises:
        ConfigFileError: The file or the key folder cannot be read.
        ConfigError: The file says something that cannot be.
        NodeError: An endpoint is malformed, or is not protected; or there is none.
    """
    named = [session.check_endpoint(one, key_folder=key_folder) for one in listen]
    dialled = [session.check_dialled(one, key_folder=key_folder) for one in connect]
    own = session.router_settings(listen=named, connect=dialled, key_folder=key_folder)
    if path is None:
        config = zenoh.Config.from_json5(msgspec.json.encode(own).decode())
    else:
        config = _from_file(path)
        _override(config, own, named, dialled, key_folder)
    _check(config, str(path or "pbonet router"), insecure=insecure)
    return config


def show(config: zenoh.Config) -> str:
    """Return a configuration as a file that `zenohd --config` and `read` take.

    What is as zenoh has it by itself is left out.
    """
    told, usual = (msgspec.json.decode(str(one)) for one in (config, zenoh.Config()))
    text = msgspec.json.encode(_differing(told, usual))
    return msgspec.json.format(text, indent=2).decode() + "\n"


def endpoints(config: zenoh.Config, what: str) -> list[str]:
    """Return the endpoints on which a router listens, or which it dials.

    Args:
        config: The configuration.
        what: ``listen`` or ``connect``.
    """
    told = _get(config, f"{what}/endpoints")
    if isinstance(told, dict):  # by mode
        told = cast("dict[str, Any]", told).get("router")
    found: list[str] = []
    for one in cast("list[Any]", told or []):
        found += [one] if isinstance(one, str) else one.get("locators", [])
    return found


def _from_file(path: Path) -> zenoh.Config:
    if path.suffix not in KINDS:
        raise ConfigFileError(
            "this is not the name of a configuration of zenoh",
            where=str(path),
            expected="a file " + ", ".join(KINDS),
            got=path.suffix or "no suffix",
            remedy="rename it; `pbonet router --show` prints one",
        )
    try:
        path.read_bytes()
        return zenoh.Config.from_file(str(path))
    except OSError as error:
        raise ConfigFileError(
            "the file cannot be read",
            where=str(path),
            got=error.strerror or str(error),
            remedy="name another one, or give its user the right to read it",
        ) from None
    except zenoh.ZError as error:
        raise _malformed(path, str(error)) from None


def _malformed(path: Path, text: str) -> ConfigError:
    """Return zenoh's complaint about a file with its place."""
    place, message = _AT.search(text), _MESSAGE.search(text)
    where = str(path)
    if place is not None:
        line, column = [one for one in place.groups() if one is not None]
        where = f"{path}:{line}:{column}"
    said = next((one for one in message.groups() if one), "") if message else ""
    return ConfigError(
        "zenoh does not understand this configuration",
        where=where,
        got=session.reason(Exception(said or text)),
        remedy="zenoh's DEFAULT_CONFIG.json5 explains every key; "
        "`pbonet router --show` prints a whole one",
    )


def _override(
    config: zenoh.Config,
    own: dict[str, object],
    listen: Sequence[str],
    connect: Sequence[str],
    key_folder: Path | None,
) -> None:
    given: dict[str, object] = {"mode": "router"}
    if listen:
        given["listen/endpoints"] = list(listen)
    if connect:
        given["connect/endpoints"] = list(connect)
    if key_folder is not None:
        link = cast("Any", own["transport"])["link"]
        given["transport/link/tls"] = link["tls"]
        given["transport/link/protocols"] = link["protocols"]
        given["access_control"] = own["access_control"]
    for key, value in given.items():
        text = msgspec.json.encode(value).decode()
        config.insert_json5(key, text)  # pyright: ignore[reportUnknownMemberType]


def _check(config: zenoh.Config, where: str, *, insecure: bool) -> None:
    listens = endpoints(config, "listen")
    if not listens:
        raise NodeError(
            "a router listens somewhere",
            where=where,
            expected="an endpoint",
            got="none",
            remedy="for example --listen tls/0.0.0.0:7447 with --keys FOLDER",
        )
    if plugins := _get(config, "plugins"):
        raise ConfigError(
            "pbonet router has no plugins",
            where=where,
            expected="no plugins",
            got=", ".join(cast("dict[str, Any]", plugins)),
            remedy="remove `plugins`, or run zenohd with this file",
        )
    for one in listens:
        if not (insecure or _is_local(one) or _is_protected(config, one)):
            raise NodeError(
                "a router that others reach is not protected",
                where=one,
                expected="tls/ with mutual TLS and access control",
                got=one.partition("/")[0],
                remedy="give it the keys of a gateway (`pbonet keys gateway`) with "
                "--keys; or use --insecure if everyone on that network may control "
                "the robots",
            )


def _is_local(endpoint: str) -> bool:
    protocol, _, address = endpoint.partition("/")
    return protocol == access_control.LOCAL or session.is_loopback(address)


def _is_protected(config: zenoh.Config, endpoint: str) -> bool:
    """Return whether the other side must have a certificate, and has a role by it."""
    return (
        endpoint.startswith("tls/")
        and _get(config, "transport/link/tls/enable_mtls") is True
        and _get(config, "access_control/enabled") is True
    )


def _get(config: zenoh.Config, key: str) -> Any:  # noqa: ANN401 - JSON
    return msgspec.json.decode(config.get_json(key))


def _differing(told: dict[str, Any], usual: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of one object that another one has otherwise."""
    found: dict[str, Any] = {}
    for key, value in told.items():
        other = usual.get(key)
        if isinstance(value, dict) and isinstance(other, dict):
            inner = _differing(
                cast("dict[str, Any]", value), cast("dict[str, Any]", other)
            )
            if inner:
                found[key] = inner
        elif value not in (other, None):
            found[key] = value
    return found
