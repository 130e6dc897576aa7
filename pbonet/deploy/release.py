"""Releases of pbonet: a wheel, those of what it needs, and a name made of all."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

import pbonet
from pbonet.errors import ConfigError, ConfigFileError, NodeError
from pbonet.versions import Range

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from .host_facts import Facts
    from .hosts_file import Machine

_WHEEL: Final = re.compile(
    r"pbonet-(?P<version>[^-]+)(-\d[^-]*)?-(?P<python>[^-]+)-[^-]+-(?P<platform>[^-]+)"
    r"\.whl"
)
_PLATFORM: Final = re.compile(r"(?:many|musl)?linux(?:\d+|_\d+_\d+)?_(\w+)")
_CPYTHON: Final = re.compile(r"cp3(\d+)")
_ANY: Final = "any"
"""The platform of a wheel that fits every processor."""
UNPACKED: Final = 4
"""Bytes on disk of an installed wheel's byte; compressed ones have 2.5 to 4."""
BY_PIP: Final = 600 << 20
"""Bytes that an environment needs whose packages pip fetches."""


class Release(Struct, frozen=True, kw_only=True):
    """A release that is installed."""

    wheel: Path
    version: str
    python: str
    """The Python of its wheel, such as ``3.11``."""
    machine: str
    """The processor of its wheel, such as ``x86_64``."""
    extras: tuple[str, ...]
    wheelhouse: tuple[Path, ...]
    """Wheels of what it needs; empty: pip on the machine fetches them."""
    digest: str

    @property
    def name(self) -> str:
        """Its folder's name on a machine."""
        return f"{self.version}-{self.digest}"

    @property
    def requirement(self) -> str:
        """The wheel as pip takes it, with the extras."""
        extras = f"[{','.join(self.extras)}]" if self.extras else ""
        return f"{self.wheel.name}{extras}"

    @property
    def layers(self) -> dict[str, Range]:
        """Versions of each layer that it understands."""
        with zipfile.ZipFile(self.wheel) as archive:
            text = archive.read("pbonet/versions.py").decode()
        module: dict[str, Any] = {"__name__": "versions"}
        exec(compile(text, "versions.py", "exec"), module)  # noqa: S102 - it is to run
        return {name: Range(*found) for name, found in module["LAYERS"].items()}

    @property
    def size(self) -> int:
        """Bytes that it takes on a machine's disk, about."""
        if not self.wheelhouse:
            return BY_PIP
        packed = sum(path.stat().st_size for path in (self.wheel, *self.wheelhouse))
        return UNPACKED * packed


def releases_of(
    wheels: Sequence[Path], extras: Iterable[str] = (), wheelhouse: Path | None = None
) -> list[Release]:
    """Return the releases that wheels are: one version, for several kinds of machines.

    Args:
        wheels: Wheels of pbonet.
        extras: Extras of pbonet that are installed with it.
        wheelhouse: A folder with the wheels of all that they need.

    Raises:
        ConfigFileError: A file is missing, or is no wheel of pbonet.
        ConfigError: They differ in version, or two are for one kind of machine.
    """
    found = [release_of(wheel, extras, wheelhouse) for wheel in wheels]
    if len({one.version for one in found}) > 1:
        raise ConfigError(
            "the wheels are of several versions",
            expected="wheels of one version, each for another kind of machine",
            got=", ".join(one.wheel.name for one in found),
            remedy="name those of one version; machines that are to have another one "
            "are chosen with --host",
        )
    if len({(one.python, one.machine) for one in found}) < len(found):
        raise ConfigError(
            "two wheels are for one kind of machine",
            expected="each for another Python or processor",
            got=", ".join(one.wheel.name for one in found),
            remedy="leave one of them out",
        )
    return found


def fitting(
    machine: Machine, facts: Facts, releases: Iterable[Release]
) -> Release | None:
    """Return the release that fits a machine's Python and processor.

    Args:
        machine: The machine.
        facts: What it has.
        releases: One version, for several kinds of machines; none: nothing is
            installed.

    Raises:
        NodeError: None of them fits.
    """
    every = list(releases)
    if not every:
        return None
    same = [one for one in every if one.machine == facts.machine]
    python = ".".join(map(str, facts.python))
    for one in same:
        if one.python == python:
            return one
    named = ", ".join(one.wheel.name for one in same or every)
    if same:
        raise NodeError(
            f"the machine's {machine.host.python} is Python {python}",
            where=machine.name,
            expected=f"Python {' or '.join(one.python for one in same)}, for {named}",
            remedy='name another one of the machine as python = "...", or give a wheel '
            "that was built for it with a further --wheel",
        )
    raise NodeError(
        f"the machine's processor is {facts.machine}",
        where=machine.name,
        expected=f"{' or '.join(one.machine for one in every)}, for {named}",
        remedy="give a wheel that was built on such a machine with a further --wheel",
    )


def release_of(
    wheel: Path, extras: Iterable[str] = (), wheelhouse: Path | None = None
) -> Release:
    """Return the release that a wheel is.

    Args:
        wheel: The wheel of pbonet.
        extras: Extras of pbonet that are installed with it.
        wheelhouse: A folder with the wheels of all that it needs; those for other
            processors are left out.

    Raises:
        ConfigFileError: A file is missing, or is no wheel of pbonet.
    """
    found = _WHEEL.fullmatch(wheel.name)
    python = _CPYTHON.fullmatch(found["python"]) if found else None
    if found is None or python is None:
        raise ConfigFileError(
            "this is not a wheel of pbonet",
            where=str(wheel),
            expected="a name such as pbonet-0.2.0-cp311-cp311-linux_x86_64.whl",
            remedy="build one with --build, or pip wheel --no-deps FOLDER",
        )
    extras = tuple(sorted(extras))
    processor = _processor(found["platform"])
    others = () if wheelhouse is None else _needed(wheelhouse, processor, wheel)
    record = [_record(wheel), *extras, *map(_record, others)]
    return Release(
        wheel=wheel,
        version=found["version"],
        python=f"3.{python[1]}",
        machine=processor,
        extras=extras,
        wheelhouse=others,
        digest=hashlib.sha256("\n".join(record).encode()).hexdigest()[:8],
    )


def _needed(wheelhouse: Path, processor: str, wheel: Path) -> tuple[Path, ...]:
    """Return the wheels of a folder that a machine with that processor may need."""
    every = sorted(wheelhouse.glob("*.whl"))
    platforms = {path: path.stem.rpartition("-")[2].split(".") for path in every}
    found = [
        path
        for path in every
        if any(_processor(one) in {_ANY, processor} for one in platforms[path])
    ]
    if not found:
        raise ConfigFileError(
            "the folder has no wheels",
            where=str(wheelhouse),
            expected=f"the wheels of all that pbonet needs, for {processor}",
            remedy=f"pip download --dest {wheelhouse} {wheel}, on a machine like those "
            "that get them",
        )
    return tuple(found)


def _processor(platform: str) -> str:
    """Return the processor in a wheel's platform, such as ``manylinux_2_17_x86_64``."""
    found = _PLATFORM.match(platform)
    return found[1] if found else platform


def _record(wheel: Path) -> str:
    """Return the list of files and their digests in a wheel.

    Two wheels of one source have the same, whatever the times in them.
    """
    try:
        with zipfile.ZipFile(wheel) as archive:
            name = next(n for n in archive.namelist() if n.endswith("/RECORD"))
            return archive.read(name).decode()
    except (OSError, StopIteration, zipfile.BadZipFile) as error:
        raise ConfigFileError(
            "the wheel cannot be read",
            where=str(wheel),
            got=getattr(error, "strerror", "") or str(error),
            remedy="build one with --build, or pip wheel --no-deps FOLDER",
        ) from None


def built(folder: Path) -> Path:
    """Build a wheel of the checkout that this pbonet runs from; return it.

    Args:
        folder: Where it is put.

    Raises:
        NodeError: This pbonet runs from no checkout, or the build failed.
    """
    source = Path(pbonet.__file__).parents[1]
    if not (source / "pyproject.toml").exists():
        raise NodeError(
            "this pbonet was installed, and has no source to build a wheel of",
            where=str(source),
            remedy="name a wheel with --wheel",
        )
    folder.mkdir(parents=True, exist_ok=True)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps"]
    with tempfile.TemporaryDirectory(dir=folder, prefix=".new-") as new:
        # In the checkout's own build folder are files that it has no more.
        settings = Path(new) / "setup.cfg"
        settings.write_text(f"[build]\nbuild_base = {Path(new).absolute() / 'build'}\n")
        done = subprocess.run(
            [*pip, "--wheel-dir", new, str(source)],
            check=False,
            capture_output=True,
            text=True,
            env={**os.environ, "DIST_EXTRA_CONFIG": str(settings.absolute())},
        )
        made = [*Path(new).glob("pbonet-*.whl")]
        if done.returncode or not made:
            lines = done.stderr.strip().splitlines()
            raise NodeError(
                "the wheel could not be built",
                where=str(source),
                got=lines[-1] if lines else f"status {done.returncode}",
                remedy=f"see what pip says: pip wheel --no-deps {source}",
            )
        return made[0].replace(folder / made[0].name)
