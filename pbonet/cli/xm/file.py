"""``pbonet file``: files in the folders that agents declare."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Argument, Option

HELP = "List, copy and remove files in the folders that agents declare."

Far = A[str, Argument("RTPU/PATH, in the folder that its agent declares.", "RTPU/PATH")]
Recursive = A[
    bool, Option("A folder with all that is in it.", names=("--recursive", "-r"))
]


def ls(
    *,
    path: A[
        str, Argument("RTPU/PATH; the RTPUs themselves if left out.", "RTPU/PATH")
    ] = "",
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """List a folder of a machine: type, size, when changed.

    Examples:
        Show which RTPUs are there:
        pbonet file ls
        Show the logs of one machine:
        pbonet file ls arm1/logs
    """
    import msgspec

    from pbonet.master.console import render
    from pbonet.master.tools import remote_files

    found = remote_files.entries(path, reach)
    rows = [(one.type, str(one.size), one.changed or "-", one.name) for one in found]
    text = render.table(("type", "bytes", "changed", "name"), rows) if rows else ""
    options.show(text, {"entries": msgspec.to_builtins(found)}, as_data=json_)


def put(
    *,
    file: A[Path, Argument("The file or folder on this machine.")],
    path: Far,
    recursive: Recursive = False,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """Copy a file to a machine; it appears there as a whole.

    A file of that name is replaced. If PATH is a folder, or ends with /, the file goes
    into it.

    Examples:
        Send a map:
        pbonet file put floor.npy arm1/maps/floor.npy
        Send a folder of them:
        pbonet file put maps arm1/maps --recursive
    """
    from pbonet.master.tools import remote_files

    to = remote_files.put(file, path, reach, recursive=recursive)
    options.show(to, {"file": to}, as_data=json_)


def get(
    *,
    path: Far,
    file: A[Path, Argument("Where it goes; the current folder if left out.")] = Path(),
    recursive: Recursive = False,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """Copy a file from a machine; it appears here as a whole.

    A file of that name is replaced. If FILE is a folder, the file goes into it.

    Examples:
        Fetch a log into the current folder:
        pbonet file get arm1/logs/run.mcap
        Fetch a folder:
        pbonet file get arm1/logs ./logs --recursive
    """
    from pbonet.master.tools import remote_files

    to = str(remote_files.get(path, file, reach, recursive=recursive))
    options.show(to, {"file": to}, as_data=json_)


def rm(
    *,
    path: Far,
    recursive: Recursive = False,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """Remove a file, a link, or an empty folder.

    The target of a link is never removed.

    Examples:
        Remove an old log:
        pbonet file rm arm1/logs/run.mcap
        Remove a folder with all that is in it:
        pbonet file rm arm1/logs/old --recursive
    """
    from pbonet.master.tools import remote_files

    remote_files.remove(path, reach, recursive=recursive)
    options.show("", {"path": path}, as_data=json_)


COMMANDS = (ls, put, get, rm)
