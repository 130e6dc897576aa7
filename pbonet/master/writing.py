"""Writing new files, never over old ones unless told to."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.config import read_svar
from pbonet.errors import ConfigFileError
from pbonet.master.newport import read_port
from pbonet.master.scaffold import in_own_tree, scaffold
from pbonet.ports import Kind

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

_KINDS = {
    "inconst": Kind.INCONST,
    "outconst": Kind.OUTCONST,
    "in": Kind.INVAR,
    "out": Kind.OUTVAR,
}


def new_module(
    name: str,
    ports: Mapping[str, Sequence[str]],
    *,
    svar: Path | None = None,
    desc: str = "",
    freq: float = 100.0,
    timing_failure: bool = False,
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
        folder: Where to write.
        force: Write over files that stand there.

    Returns:
        The files.

    Raises:
        ConfigError: The name or a port is wrong, or a file stands there already.
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
    )
    paths = {folder / file: text for file, text in texts.items()}
    standing = [path for path in paths if path.exists()]
    if standing and not force:
        raise ConfigFileError(
            "a file stands there already",
            where=str(standing[0]),
            remedy="choose another name or folder, or say --force",
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
