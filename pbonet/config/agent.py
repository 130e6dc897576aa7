"""``agent.toml``: what belongs to a machine and not to an application."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, NamedTuple, cast, get_type_hints

import msgspec

from . import words
from .device import DRIVERS, Entry
from .lines import Word, fault, nearest, quote
from .model import AgentConfig, Place
from .reader import decode, load
from .spp import SPP_DRIVERS, SppEntry

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

MAX_GRACE = 3600.0
"""Longest grace in seconds."""
MAX_LIMIT = 1e9
"""Greatest limit of logs, in their unit."""

_MOST_CORES = 4096
_QUEUE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+\-]{0,63}")
_KEY = re.compile(r"(?!.*\*\*\*)[^\s/#?$]+(/[^\s/#?$]+)*")
_ITEM = re.compile(r"\[(\d+)\]")
_SPP_DEVICE = re.compile(r"auto|cpu|cuda(:\d+)?")
_OF_A_PACKAGE = re.compile(r"\w+(\.\w+)*:\w+")
_KINDS = {
    "bool": "a truth value",
    "int": "a whole number",
    "float": "a number",
    "str": "a text in quotes",
    "array": "a list of texts",
    "object": "a table",
}


def read_agent(path: str | Path) -> AgentConfig:
    """Read the ``agent.toml`` at `path`.

    Raises:
        ConfigFileError: It cannot be read.
        ConfigError: It is not TOML, or says something that cannot be.
    """
    return parse_agent(load(path), str(path))


def agent_settings(path: Path | None, told: Mapping[str, Any]) -> AgentConfig:
    """Return an agent's settings: an ``agent.toml``, and what overrides it.

    Args:
        path: The file, read now; None for the defaults.
        told: Keys of the file, and values that take precedence over its own.

    Raises:
        ConfigFileError: It cannot be read.
        ConfigError: It is not TOML, or says something that cannot be.
    """
    begin = AgentConfig() if path is None else read_agent(path)
    return msgspec.structs.replace(begin, **told)


def parse_agent(text: str | bytes, file: str = "agent.toml") -> AgentConfig:
    """Parse the text of an ``agent.toml``; `file` is its name in messages.

    Raises:
        ConfigError: It is not TOML, or says something that cannot be.
    """
    from .toml_text import toml_table  # most agents have no file

    text = decode(text, file) if isinstance(text, bytes) else text
    text = text.removeprefix("\ufeff")
    table = toml_table(text, file)
    known = get_type_hints(AgentConfig)
    if devices := _table(table.get("device")):
        _check_devices(devices, text, file)
    if processors := _table(table.get("spp")):
        _check_processors(processors, text, file)
    _check_keys(table, known, lambda key: _place(text, file, key))
    config = msgspec.convert(table, AgentConfig)
    _check(config, text, file)
    return config


def _check_keys(
    table: Mapping[str, Any], known: Mapping[str, Any], place: Callable[[str], Place]
) -> None:
    """Refuse keys that are unknown, or have values of a wrong type."""
    for key, value in table.items():
        if key not in known:
            raise fault(
                f"unknown key {quote(key)}",
                place(key),
                expected="a key that docs/files.md lists",
                remedy=nearest(key, known) or "remove it",
            )
        try:
            msgspec.convert(value, known[key])
        except msgspec.ValidationError as error:
            raise fault(
                f"the value of {key} is of the wrong type",
                place(key),
                **_expected_and_got(str(error)),
                remedy="see docs/files.md for the keys of agent.toml",
            ) from None


def _check_devices(devices: Mapping[str, Any], text: str, file: str) -> None:
    """Refuse devices that cannot be."""
    for name, table, where in _tables(devices, text, file, ("device", "a device")):
        for key in ("driver", "address"):
            if key not in table:
                raise fault(
                    f"the device {name} has no {key}",
                    where.place,
                    expected=f'{key} = "..."',
                    remedy="add it",
                )
        _check_keys(table, get_type_hints(Entry), where.key)
        _check_device(msgspec.convert(table, Entry), where)


def _check_processors(processors: Mapping[str, Any], text: str, file: str) -> None:
    """Refuse special purpose processors that cannot be."""
    what = "spp", "a special purpose processor"
    for _, table, where in _tables(processors, text, file, what):
        _check_keys(table, get_type_hints(SppEntry), where.key)
        entry = msgspec.convert(table, SppEntry)
        if entry.driver not in SPP_DRIVERS:
            raise fault(
                f"there is no back end {quote(entry.driver)}",
                where.key("driver"),
                expected=" ".join(SPP_DRIVERS),
                remedy=nearest(entry.driver, SPP_DRIVERS) or "correct its name",
            )
        if not _SPP_DEVICE.fullmatch(entry.device):
            raise fault(
                f"there is no device {quote(entry.device)}",
                where.key("device"),
                expected='"auto", "cpu", or "cuda:0" and so on',
                remedy="correct its name",
            )
        for key, least in (("memory", 0.0), ("longest", 1e-3)):
            value: float = getattr(entry, key)
            if not least <= value <= MAX_LIMIT:
                raise fault(
                    f"{key} is out of bounds",
                    where.key(key),
                    expected=f"{least:g} to {MAX_LIMIT:g}",
                    got=f"{value:g}",
                    remedy="correct the value",
                )


def _tables(
    tables: Mapping[str, Any], text: str, file: str, what: tuple[str, str]
) -> Iterator[tuple[str, dict[str, Any], _Header]]:
    """Yield the tables ``[KIND.NAME]`` of one kind, with where each stands.

    Args:
        tables: By name.
        text: The file's text.
        file: Its name.
        what: The kind as in the file, and in words.
    """
    kind, said = what
    for name, value in tables.items():
        where = _header(text, file, name, kind)
        words.label(Word(name, where.place), said)
        if (table := _table(value)) is None:
            raise fault(
                f"{said.replace('a ', 'the ', 1)} {name} is no table",
                where.place,
                expected=f"[{kind}.{name}]",
                remedy=f'write [{kind}.{name}], and below it driver = "..."',
            )
        yield name, table, where


def _check_device(entry: Entry, where: _Header) -> None:
    """Refuse values of the right type that a device cannot have."""
    if entry.driver not in DRIVERS and not _OF_A_PACKAGE.fullmatch(entry.driver):
        raise fault(
            f"there is no driver {quote(entry.driver)}",
            where.key("driver"),
            expected="one that docs/devices.md lists, or package.module:Class",
            remedy=nearest(entry.driver, DRIVERS) or "correct its name",
        )
    if not entry.address.strip():
        raise fault(
            "the address is empty",
            where.key("address"),
            expected="where the device is",
            got=quote(entry.address),
            remedy="name its device file, or HOST:PORT",
        )
    for key in ("first", "ports"):
        value: int = getattr(entry, key)
        if value < 0:
            raise fault(
                f"{key} is below zero",
                where.key(key),
                expected="a whole number from 0",
                got=f"{value}",
                remedy="ports count from 0",
            )
    for key, value in entry.settings.items():
        # Other processes get it as JSON, which has no times, and no numbers like nan.
        if msgspec.json.decode(msgspec.json.encode(value)) != value:
            raise fault(
                f"the value of {key} is of the wrong type",
                where.key(key),
                expected="a text, a finite number, a truth value, or lists and tables "
                "of these",
                got=str(value),
                remedy="write times as texts",
            )


class _Header(NamedTuple):
    """Where a table such as ``[device.NAME]`` stands, and the text of its keys."""

    place: Place
    below: str

    def key(self, name: str) -> Place:
        """Return the place of one of its keys."""
        at = rf"^([ \t]*)[\"']?{re.escape(name)}[\"']?(?=[ \t]*[=.])"
        found = re.search(at, self.below, re.MULTILINE)
        if found is None:
            return self.place
        line = self.place.line + self.below.count("\n", 0, found.start())
        return Place(self.place.file, line, len(found[1]) + 1)


def _header(text: str, file: str, name: str, kind: str) -> _Header:
    """Return where a table ``[KIND.NAME]`` is, or else that of all of its kind."""
    head = rf"\[[ \t]*{kind}[ \t]*\.[ \t]*[\"']?{re.escape(name)}[\"']?[ \t]*"
    found = re.search(rf"^[ \t]*{head}[.\]]", text, re.MULTILINE)
    if found is None:
        return _Header(_place(text, file, kind), "")
    below = text[found.start() :]
    other = re.compile(rf"^[ \t]*(?!{head}\.)\[", re.MULTILINE)
    end = other.search(below, found.end() - found.start())
    line = text.count("\n", 0, found.start()) + 1
    return _Header(Place(file, line), below[: end.start()] if end else below)


def agent_text(config: AgentConfig) -> str:
    """Return an ``agent.toml`` with all settings of an agent, defaults included."""
    return settings_text(msgspec.to_builtins(config))


def settings_text(settings: Mapping[str, Any]) -> str:
    """Return an ``agent.toml`` with some settings, as its reader names them."""
    fields = dict(settings)
    tables: dict[str, dict[str, Any]] = {"events": fields.pop("events", {})}
    for name, entry in fields.pop("device", {}).items():
        device = dict(entry)
        tables[f"device.{name}.settings"] = device.pop("settings", {})
        tables[f"device.{name}"] = device
    for name, processor in fields.pop("spp", {}).items():
        tables[f"spp.{name}"] = processor
    lines = [f"{k} = {_value(v)}" for k, v in fields.items() if v is not None]
    for name, table in sorted(tables.items()):
        if table:
            lines += ["", f"[{name}]", *_pairs(table)]
    return "\n".join([*lines, ""])


def _value(value: object) -> str:
    """Return a value in TOML; strings and numbers are as in JSON."""
    if (table := _table(value)) is not None:
        return f"{{{', '.join(_pairs(table))}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, cast('list[object]', value)))}]"
    return msgspec.json.encode(value).decode()


def _pairs(table: Mapping[str, object]) -> Iterator[str]:
    for key, value in table.items():
        yield f"{_value(key)} = {_value(value)}"


def _table(value: object) -> dict[str, Any] | None:
    """Return the value if it is a table."""
    return cast("dict[str, Any]", value) if isinstance(value, dict) else None


def _place(text: str, file: str, key: str) -> Place:
    """Return the place of a key of the top table."""
    name = re.escape(key)
    pattern = rf"^([ \t]*\[*[ \t]*)[\"']?{name}[\"']?(?=[ \t]*[=.\]])"
    match = re.search(pattern, text, re.MULTILINE)
    if match is None:
        return Place(file, 1)
    return Place(file, text.count("\n", 0, match.start()) + 1, len(match[1]) + 1)


def _expected_and_got(message: str) -> dict[str, str]:
    """Return what msgspec expected and what it got, in words."""
    kinds, _, path = message.partition(" - at ")
    wanted, _, got = kinds.removeprefix("Expected ").partition(", got ")
    item = (
        f"item {match[1]} of the list to be " if (match := _ITEM.search(path)) else ""
    )
    return {"expected": item + _in_words(wanted), "got": _in_words(got)}


def _in_words(kinds: str) -> str:
    names = kinds.replace("`", "").split(" | ")
    return " or ".join(_KINDS.get(name, name) for name in names if name != "null")


def _check(config: AgentConfig, text: str, file: str) -> None:
    """Refuse values of the right type that cannot be."""
    for key in ("name", "domain"):
        value: str | None = getattr(config, key)
        if value is not None:
            what = "an RTPU" if key == "name" else "a domain"
            words.label(Word(value, _place(text, file, key)), what)
    if config.core is not None and not 0 <= config.core < _MOST_CORES:
        raise fault(
            "there is no such core",
            _place(text, file, "core"),
            expected=f"0 to {_MOST_CORES - 1}",
            got=f"{config.core}",
            remedy="cores count from 0; see lscpu",
        )
    if config.core_share is not None and not 0.0 < config.core_share <= 1.0:
        raise fault(
            "core_share is out of bounds",
            _place(text, file, "core_share"),
            expected="above 0, at most 1",
            got=f"{config.core_share:g}",
            remedy="give a share of the core, such as 0.9; leave it out for what the "
            "kernel grants",
        )
    _check_events(config, text, file)
    for key in ("log_mb", "log_minutes", "runs_mb"):
        if not 0.0 <= getattr(config, key) <= MAX_LIMIT:
            raise fault(
                f"{key} is out of bounds",
                _place(text, file, key),
                expected=f"0 to {MAX_LIMIT:g}; 0 for no limit",
                got=f"{getattr(config, key):g}",
                remedy="correct the value",
            )
    if not 0.0 <= config.grace <= MAX_GRACE:
        raise fault(
            "grace is out of bounds",
            _place(text, file, "grace"),
            expected=f"0 to {MAX_GRACE:g} s",
            got=f"{config.grace:g} s",
            remedy="correct the value",
        )


def _check_events(config: AgentConfig, text: str, file: str) -> None:
    for queue, key in config.events.items():
        place = _place(text, file, queue)
        if not _QUEUE.fullmatch(queue):
            raise fault(
                f"{quote(queue)} is not a valid queue name",
                place,
                expected="letters, digits, and _ - . after the first, at most 64",
                got=quote(queue),
                remedy='write for example parts = "cell/camera/part"',
            )
        if not _KEY.fullmatch(key):
            raise fault(
                "this is not a valid key",
                place,
                expected="parts between single slashes; * and ** stand for any",
                got=quote(key),
                remedy='write for example parts = "cell/camera/part"',
            )
