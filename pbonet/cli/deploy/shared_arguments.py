"""Arguments that verbs for machines over ssh have in common."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated as A

from pbonet.cli.parser import Argument, Option

if TYPE_CHECKING:
    from pbonet.deploy import HostsFile, Release

Hosts = A[Path, Argument("The file of machines (docs/operations.md).", "HOSTS.toml")]
Host = A[list[str] | None, Option("Only this machine of the file.", "NAME")]
Apply = A[bool, Option("Do it; else the plan is printed and nothing is done.")]
Wheel = A[
    list[Path] | None,
    Option("The wheel of pbonet that is installed; one for each processor.", "FILE"),
]
Wheelhouse = A[
    Path | None,
    Option("Wheels of all that it needs, for machines without internet.", "FOLDER"),
]
Build = A[bool, Option("Build the wheel of this checkout, into wheels/.")]


def releases_of(
    file: HostsFile, wheels: list[Path] | None, wheelhouse: Path | None, *, build: bool
) -> list[Release]:
    """Return the release that the words or the file name, by kinds of machines."""
    from pbonet import deploy

    if build:
        made = deploy.built(file.path.absolute().parent / "wheels")
        wheels = [made, *(wheels or ())]
    found = wheels or file.wheels
    return deploy.releases_of(found, file.extras, wheelhouse or file.wheelhouse)


def needed_releases(
    file: HostsFile, wheels: list[Path] | None, wheelhouse: Path | None, *, build: bool
) -> list[Release]:
    """Return the release that the words or the file name, by kinds of machines.

    Raises:
        ConfigError: They name none.
    """
    from pbonet.errors import ConfigError

    found = releases_of(file, wheels, wheelhouse, build=build)
    if not found:
        raise ConfigError(
            "no release is named",
            where=str(file.path),
            remedy='name its wheel with --wheel or as wheel = "...", build it with '
            "--build, or return to the one before with --back",
        )
    return found
