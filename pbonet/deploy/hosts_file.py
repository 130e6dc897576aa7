"""``HOSTS.toml``: the machines of a laboratory, and what each is to have."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from msgspec import Struct

from pbonet.config import (
    AgentConfig,
    load,
    parse_agent,
    read_agent,
    read_job,
    read_sbs,
    settings_text,
    toml_record,
    toml_table,
)
from pbonet.errors import ConfigError, did_you_mean
from pbonet.xm.net import run_folder

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

KEYS: Final = "/etc/pbonet/keys"
"""The key folder of a machine."""
_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,30}")
_EXTRA: Final = re.compile(r"[a-z0-9][a-z0-9\-]*")


class Host(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A machine, as ``[hosts.NAME]`` declares it."""

    rtpus: dict[str, dict[str, Any] | str] = {}
    """By RTPU: keys of its ``agent.toml``, or the path of such a file."""
    address: str = ""
    """Where ssh reaches it; its name if left out."""
    port: int | None = None
    user: str | None = None
    """The user who logs in: root, or one with sudo; as ssh says if left out."""
    role: Literal["agent", "gateway"] = "agent"
    """The role of its keys."""
    names: tuple[str, ...] = ()
    """Further names and addresses at which others connect to its agents."""
    python: str = "python3"
    """The Python of the machine of which pbonet's environment is made."""


class _File(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    hosts: dict[str, Host]
    authority: str = ""
    wheel: str | tuple[str, ...] = ()
    wheelhouse: str = ""
    extras: tuple[str, ...] = ()
    jobs: tuple[str, ...] = ()
    known_hosts: str = ""
    identity: str = ""


class Machine(Struct, frozen=True, kw_only=True):
    """A machine with all that it is to have."""

    name: str
    host: Host
    configs: dict[str, str]
    """By RTPU, the text of its ``agent.toml``."""
    cores: dict[str, int]
    """By RTPU, the core that it names."""
    domains: tuple[str, ...]
    """The domains of its RTPUs."""

    @property
    def address(self) -> str:
        """Where ssh reaches it."""
        return self.host.address or self.name

    @property
    def reached_at(self) -> tuple[str, ...]:
        """Names and addresses that its certificate has."""
        return tuple(dict.fromkeys((self.address, *self.host.names)))


class HostsFile(Struct, frozen=True, kw_only=True):
    """A ``HOSTS.toml``; paths are found from its folder."""

    path: Path
    machines: list[Machine]
    authority: Path | None
    """The folder of the certificate authority; None: agents have no keys of ours."""
    wheels: list[Path]
    """Wheels of a release of pbonet, for several kinds of machines."""
    wheelhouse: Path | None
    extras: tuple[str, ...]
    jobs: list[Path]
    known_hosts: Path | None
    identity: Path | None
    homes: dict[str, str]
    """The machine of each RTPU, of those too that are not wanted."""


def read_hosts(path: str | Path, only: Sequence[str] = ()) -> HostsFile:
    """Read a ``HOSTS.toml``.

    Args:
        path: The file.
        only: Names of the machines that are wanted; all if empty.

    Raises:
        ConfigFileError: A file cannot be read.
        ConfigError: It says something that cannot be.
    """
    path = Path(path)
    table = toml_table(load(path), str(path))
    remedy = "docs/operations.md lists the keys"
    found = toml_record(table, _File, str(path), remedy=remedy)
    _check(found, path)
    folder = path.absolute().parent

    def at(name: str) -> Path | None:
        return folder / Path(name).expanduser() if name else None

    wheels = (found.wheel,) if isinstance(found.wheel, str) else found.wheel
    authority = at(found.authority)
    machines = [
        _machine(name, host, path, keys=authority is not None)
        for name, host in found.hosts.items()
    ]
    return HostsFile(
        path=path,
        machines=_chosen(machines, only, path),
        homes={rtpu: one.name for one in machines for rtpu in one.configs},
        authority=authority,
        wheels=[folder / Path(name).expanduser() for name in wheels],
        wheelhouse=at(found.wheelhouse),
        extras=tuple(sorted(found.extras)),
        jobs=[folder / Path(name).expanduser() for name in found.jobs],
        known_hosts=at(found.known_hosts),
        identity=at(found.identity),
    )


def _check(found: _File, path: Path) -> None:
    """Refuse values of the right type that cannot be."""
    homes: dict[str, str] = {}
    for name, host in found.hosts.items():
        _check_name(name, path)
        for rtpu in host.rtpus:
            run_folder.check_name("an RTPU", rtpu)
            if rtpu in homes:
                raise ConfigError(
                    f"two hosts have an RTPU {rtpu}",
                    where=f"{path}: {homes[rtpu]}, {name}",
                    expected="names that are unique in the domain",
                    remedy="name one of them differently",
                )
            homes[rtpu] = name
    if not found.hosts:
        raise ConfigError(
            "the file names no host",
            where=str(path),
            expected="[hosts.NAME], and below it what the machine is to have",
            remedy="docs/operations.md has an example",
        )
    for extra in found.extras:
        if not _EXTRA.fullmatch(extra):
            raise ConfigError(
                f"{extra!r} is no extra of pbonet",
                where=f"{path}: extras",
                expected='a name such as "robot"',
                remedy="pyproject.toml lists them",
            )


def _check_name(name: str, path: Path) -> None:
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{name!r} is no name of a host",
            where=f"{path}: hosts",
            expected="letters, digits, and _ . - after the first, at most 31",
            remedy='give it a name, and its address as address = "..."',
        )


def _machine(name: str, host: Host, path: Path, *, keys: bool) -> Machine:
    texts: dict[str, str] = {}
    cores: dict[str, int] = {}
    domains: dict[str, None] = {}
    for rtpu, said in host.rtpus.items():
        texts[rtpu], config = _config(path, f"hosts.{name}.rtpus.{rtpu}", said, keys)
        domains[config.domain] = None
        if config.core is not None:
            cores[rtpu] = config.core
    if len(set(cores.values())) < len(cores):
        raise ConfigError(
            "two RTPUs of a host have one core",
            where=f"{path}: hosts.{name}",
            got=", ".join(f"{rtpu}: {core}" for rtpu, core in cores.items()),
            remedy="give each a core of its own",
        )
    return Machine(
        name=name, host=host, configs=texts, cores=cores, domains=tuple(domains)
    )


def _config(
    path: Path,
    where: str,
    said: dict[str, Any] | str,
    keys: bool,  # noqa: FBT001
) -> tuple[str, AgentConfig]:
    """Return the text of an ``agent.toml``, and what it says."""
    if isinstance(said, str):
        file = path.absolute().parent / Path(said).expanduser()
        return load(file), read_agent(file)
    settings = {"keys": KEYS, **said} if keys else said
    try:
        text = settings_text(settings)
    except (AttributeError, TypeError, ValueError):
        raise ConfigError(
            "the settings of an RTPU cannot be written as agent.toml",
            where=f"{path}: {where}",
            remedy='see docs/files.md for its keys, or name a file: arm0 = "arm0.toml"',
        ) from None
    return text, parse_agent(text, f"{path}: {where}")


def _chosen(machines: list[Machine], only: Iterable[str], path: Path) -> list[Machine]:
    names = {one.name for one in machines}
    for name in only:
        if name not in names:
            raise ConfigError(
                f"the file has no host {name}",
                where=str(path),
                expected=", ".join(sorted(names)),
                remedy=did_you_mean(name, names) or "name one of these with --host",
            )
    wanted = set(only) or names
    return [one for one in machines if one.name in wanted]


def keepers(jobs: Iterable[Path]) -> set[str]:
    """Return the RTPUs that keep the tables of jobs (``MASTER`` in the .sbs file)."""
    found: set[str] = set()
    for path in jobs:
        found.add(read_sbs(path.parent / read_job(path).sbs).keeper)
    return found
