"""Reads a configuration file of any kind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pbonet.errors import ConfigFileError

from .agent import read_agent
from .job import read_job
from .model import AgentConfig, JobFile, Rmod, SbsFile, SeqFile, SvarFile
from .reader import similar_file
from .rmod import read_rmod
from .sbs import read_sbs
from .svar import read_svar

Record = SvarFile | Rmod | SbsFile | JobFile | SeqFile | AgentConfig


def _read_seq(path: str | Path) -> SeqFile:
    from .seq import read_seq  # it is loaded where there is a sequence

    return read_seq(path)


_READERS: dict[str, Callable[[str | Path], Record]] = {
    ".svar": read_svar,
    ".rmod": read_rmod,
    ".sbs": read_sbs,
    ".job": read_job,
    ".seq": _read_seq,
    ".toml": read_agent,
}


def read_any(path: str | Path) -> Record:
    """Return the content of the file at `path`; its ending gives the format.

    Raises:
        ConfigFileError: It cannot be read, or its ending is unknown.
        ConfigError: It says something that cannot be.
    """
    reader = _READERS.get(Path(path).suffix)
    if reader is None:
        raise ConfigFileError(
            "the file name has no known ending",
            where=str(path),
            expected=" or ".join(_READERS),
            got=Path(path).suffix or "no ending",
            remedy=similar_file(Path(path)) or "rename the file or name another",
        )
    return reader(path)
