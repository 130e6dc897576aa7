"""The configuration files, read and written (Stewart 1994, sections 3.8, 4.5.1, 5.5).

For each kind there is ``read_x(path)``, ``parse_x(text, file)``, ``write_x(record)``;
the records in between are those of `pbonet.config.model`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pbonet.errors import ConfigFileError

from .agent import agent_text, parse_agent, read_agent
from .bundle import Section, bundled
from .combining import info_of
from .job import parse_job, read_job, write_job
from .model import AgentConfig, JobFile, Rmod, SbsFile, SvarFile
from .needs import Missing, missing_methods
from .rmod import parse_rmod, read_rmod, rmod_name, write_rmod
from .sbs import parse_sbs, read_sbs, write_sbs
from .svar import parse_svar, read_svar, write_svar

__all__ = [
    "Missing",
    "Section",
    "agent_text",
    "bundled",
    "info_of",
    "missing_methods",
    "parse_agent",
    "parse_job",
    "parse_rmod",
    "parse_sbs",
    "parse_svar",
    "read_agent",
    "read_any",
    "read_job",
    "read_rmod",
    "read_sbs",
    "read_svar",
    "rmod_name",
    "write_job",
    "write_rmod",
    "write_sbs",
    "write_svar",
]

Record = SvarFile | Rmod | SbsFile | JobFile | AgentConfig

_READERS: dict[str, Callable[[str | Path], Record]] = {
    ".svar": read_svar,
    ".rmod": read_rmod,
    ".sbs": read_sbs,
    ".job": read_job,
    ".toml": read_agent,
}


def read_any(path: str | Path) -> Record:
    """Return what the file at `path` says; its ending tells the format.

    Raises:
        ConfigFileError: It cannot be read, or its ending is unknown.
        ConfigError: It says something that cannot be.
    """
    reader = _READERS.get(Path(path).suffix)
    if reader is None:
        raise ConfigFileError(
            "the ending of the file's name tells no format",
            where=str(path),
            expected=" or ".join(_READERS),
            got=Path(path).suffix or "no ending",
            remedy="rename the file or name another",
        )
    return reader(path)
