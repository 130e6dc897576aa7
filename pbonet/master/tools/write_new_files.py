"""Writes new files, and replaces old ones only on request."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from pbonet.config import (
    Library,
    load,
    parse_svar,
    read_sbs,
    read_svar,
    write_job,
    write_sbs,
    write_svar,
)
from pbonet.errors import ConfigError, ConfigFileError
from pbonet.ports import Kind

from . import scaffold_system
from .scaffold import in_own_tree, scaffold
from .scaffold_port import read_port

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

_KINDS = {
    "inconst": Kind.INCONST,
    "outconst": Kind.OUTCONST,
    "in": Kind.INVAR,
    "out": Kind.OUTVAR,
}

_HZ = 100.0
"""Frequency that a new job gives a task of which neither file nor class has one."""


def new_module(
    name: str,
    ports: Mapping[str, Sequence[str]],
    *,
    svar: Path | None = None,
    desc: str = "",
    freq: float = 100.0,
    timing_failure: bool = False,
    in_c: bool = False,
    folder: Path,
    force: bool = False,
) -> list[Path]:
    """Write a module, its RMOD and its test (Stewart 1994, section 3.7).

    Args:
        name: The module's name.
        ports: Lists of ports under ``inconst outconst in out``, each spelled
            ``NAME[:SHAPE[:UNIT[:TYPE]]]``.
        svar: A file that knows what is left out.
        desc: What the module does.
        freq: Its default frequency in Hz.
        timing_failure: Whether it has a handler of timing failures.
        in_c: Whether it is written in C, with a Makefile; one of the same text that
            stands there stays.
        folder: Where to write.
        force: Write over files that stand there.

    Returns:
        The files.

    Raises:
        ConfigError: The name or a port is wrong, or a file exists there already.
    """
    table = read_svar(svar) if svar is not None else None
    wanted = [
        read_port(text, kind, table)
        for key, kind in _KINDS.items()
        for text in ports.get(key, ())
    ]
    texts = scaffold(
        name,
        wanted,
        desc=desc,
        freq=freq,
        svar=table,
        timing_failure=timing_failure,
        own_tree=in_own_tree(folder),
        in_c=in_c,
    )
    makefile = folder / "Makefile"
    if in_c and makefile.is_file() and makefile.read_text() == texts["Makefile"]:
        del texts["Makefile"]
    return write_files(
        {folder / file: text for file, text in texts.items()}, force=force
    )


def new_svar(
    name: str,
    rmods: Sequence[str],
    *,
    sizes: Sequence[str] = (),
    libraries: Sequence[str | Path] = (),
    folder: Path,
    add: bool = False,
    force: bool = False,
) -> tuple[list[Path], list[str]]:
    """Write a table with every variable that these tasks read and write.

    Args:
        name: The file's name, without its ending.
        rmods: The tasks, by RMODs or modules in the folder or in the libraries.
        sizes: What no port says, as ``NAME=NUMBER``.
        libraries: Folders of modules.
        folder: Where to write.
        add: Add the variables that an existing file lacks; the rest of it stays.
        force: Write over a file that stands there.

    Returns:
        The file, and what is to be said of it.

    Raises:
        PbonetError: An RMOD or a module is missing or wrong, a size is not known, or a
            file stands there already, or not.
    """
    path = folder / f"{_plain(name, '.svar')}.svar"
    before = load(path) if add else ""
    there = parse_svar(before, str(path)).variables if add else ()
    table, told = scaffold_system.new_svar(
        path.name,
        _uses(rmods, [folder, *libraries]),
        scaffold_system.read_sizes(sizes),
        there,
    )
    if not table.variables:
        return [], [f"{path} has every variable of these tasks", *told]
    text = write_svar(table)
    if add:
        text = _joined(before, text)
        parse_svar(text, str(path))
    remedy = "use --add to add what it lacks, or --force to replace it"
    return write_files({path: text}, force=force or add, remedy=remedy), told


def _joined(first: str, second: str) -> str:
    """Return two texts of one format as one; the first ends before its EOF."""
    lines = first.splitlines(keepends=True)
    last = max(i for i, line in enumerate(lines) if line.split()[:1] == ["EOF"])
    return f"{''.join(lines[:last]).rstrip()}\n\n{second}"


def new_job(
    name: str,
    rmods: Sequence[str],
    *,
    sbs: Path | None = None,
    sizes: Sequence[str] = (),
    desc: str = "",
    libraries: Sequence[str | Path] = (),
    folder: Path,
    force: bool = False,
) -> tuple[list[Path], list[str]]:
    """Write a job of these tasks; without a subsystem, that and its table too.

    Args:
        name: The job's name.
        rmods: Its tasks, by RMODs or modules in the folder or in the libraries.
        sbs: The subsystem's file.
        sizes: As for `new_svar`.
        desc: What the job does.
        libraries: Folders of modules.
        folder: Where to write.
        force: Write over files that stand there.

    Returns:
        The files, and what is to be said of them.

    Raises:
        PbonetError: As for `new_svar`, or the subsystem's file cannot be read.
    """
    name = _plain(name, ".job")
    uses = _uses(rmods, [folder, *libraries])
    told: list[str] = []
    texts: dict[str, str] = {}
    if sbs is not None:
        read_sbs(sbs)
        place = os.path.relpath(sbs, folder)
    else:
        table, told = scaffold_system.new_svar(
            f"{name}.svar", uses, scaffold_system.read_sizes(sizes)
        )
        system = scaffold_system.new_sbs(f"{name}.sbs", name, table.file)
        texts = {table.file: write_svar(table), system.file: write_sbs(system)}
        place = system.file
    job = scaffold_system.new_job(f"{name}.job", name, place, uses, desc)
    texts[job.file] = write_job(job)
    return write_files(
        {folder / file: text for file, text in texts.items()}, force=force
    ), told


def _plain(name: str, ending: str) -> str:
    """Return the name of a file without its ending.

    Raises:
        ConfigError: It would be a file of another folder.
    """
    plain = name.removesuffix(ending)
    if not plain or plain.startswith(".") or "/" in plain:
        raise ConfigError(
            "this is not a valid name for a file",
            expected=f"such as arm, for arm{ending}",
            got=f"'{name}'",
            remedy="name the folder by --folder",
        )
    return plain


def _uses(
    rmods: Sequence[str], folders: Sequence[str | Path]
) -> list[scaffold_system.Use]:
    library = Library(folders)
    records = [library.record(name, _HZ) for name in rmods]
    return [scaffold_system.Use(one, library.load_rmod(one).info) for one in records]


def write_files(
    paths: Mapping[Path, str],
    *,
    force: bool,
    remedy: str = "choose another name or folder, or use --force",
) -> list[Path]:
    """Write files.

    Args:
        paths: Their texts.
        force: Replace those that exist.
        remedy: What to do about one that exists.

    Returns:
        The files.

    Raises:
        ConfigFileError: One stands there already, or cannot be written.
    """
    standing = [path for path in paths if path.exists()]
    if standing and not force:
        raise ConfigFileError(
            "a file exists there already",
            where=str(standing[0]),
            remedy=remedy,
        )
    for path, text in paths.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        except OSError as error:
            raise ConfigFileError(
                "the file cannot be written",
                where=str(path),
                got=error.strerror or str(error),
                remedy="choose another folder by --folder, or correct its permissions",
            ) from None
    return list(paths)
