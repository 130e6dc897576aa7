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
Wheel = A[Path | None, Option("The wheel of pbonet that is installed.", "FILE")]
Wheelhouse = A[
    Path | None,
    Option("Wheels of all that it needs, for machines without internet.", "FOLDER"),
]
Build = A[bool, Option("Build the wheel of this checkout, into wheels/.")]


def release_of(
    file: HostsFile, wheel: Path | None, wheelhouse: Path | None, *, build: bool
) -> Release | None:
    """Return the release that the words and the file name; None if they name none."""
    from pbonet import deploy

    if build:
        wheel = deploy.built(file.path.absolute().parent / "wheels")
    found = wheel or file.wheel
    if found is None:
        return None
    return deploy.release_of(found, file.extras, wheelhouse or file.wheelhouse)


def needed_release(
    file: HostsFile, wheel: Path | None, wheelhouse: Path | None, *, build: bool
) -> Release:
    """Return the release that the words and the file name.

    Raises:
        ConfigError: They name none.
    """
    from pbonet.errors import ConfigError

    found = release_of(file, wheel, wheelhouse, build=build)
    if found is None:
        raise ConfigError(
            "no release is named",
            where=str(file.path),
            remedy='name its wheel with --wheel or as wheel = "...", build it with '
            "--build, or return to the one before with --back",
        )
    return found
