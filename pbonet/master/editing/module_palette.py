"""The modules that can be added to a job, as the command `library` shows them."""

from __future__ import annotations

import subprocess
import sys
from functools import cached_property
from typing import TYPE_CHECKING, Any

import msgspec

from pbonet.config import Search, search
from pbonet.errors import ModuleLoadError, PbonetError, WireError
from pbonet.pbo import ModuleInfo

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from .draft_files import DraftFiles

LIMIT = 120.0
"""Seconds that describing all modules may take."""


class _Described(msgspec.Struct):
    """The output of the command."""

    modules: list[ModuleInfo] = []
    error: WireError | None = None


class ModulePalette:
    """The modules of the library and of the job's folder.

    The code of all of them runs when they are described, so another process does that,
    once.

    Args:
        files: The job's files.
        libraries: Folders of modules.
        like: The palette of another job in the same folders: its modules are these.
    """

    def __init__(
        self,
        files: DraftFiles,
        libraries: Iterable[str | Path],
        like: ModulePalette | None = None,
    ) -> None:
        self._files = files
        self._libraries = list(libraries)
        self._like = like

    def find(self, wanted: Search) -> list[dict[str, Any]]:
        """Return the modules that fit a search, as plain values.

        Raises:
            ModuleLoadError: None fits, or they cannot be described.
            ConfigError: There is no such class.
        """
        found = search(self.infos, self._files.records(), wanted)
        return [one.data for one in found]

    @cached_property
    def infos(self) -> list[ModuleInfo]:
        """All modules, described when they are first asked for."""
        if self._like is not None:
            return self._like.infos
        folder = self._files.job_path.parent
        command = [sys.executable, "-P", "-m", "pbonet.cli", "library", "--json"]
        for one in (self._files.path.parent.absolute(), *self._libraries):
            command += ["--library", str(one)]
        try:
            done = subprocess.run(
                command,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=LIMIT,
                check=False,
            )
            told = msgspec.json.decode(done.stdout, type=_Described)
        except (subprocess.TimeoutExpired, msgspec.DecodeError) as error:
            raise ModuleLoadError(
                "the modules of the library cannot be described",
                where=str(folder),
                got=str(error),
                remedy="`pbonet library` there shows which module is at fault",
            ) from None
        if told.error is not None:
            raise PbonetError.from_wire(told.error)
        return told.modules
