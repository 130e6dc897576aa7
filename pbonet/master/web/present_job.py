"""The job that a subsystem runs now, and those of its tasks that do not exist."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import structs

from pbonet.config import Library
from pbonet.errors import PbonetError
from pbonet.master.configuration import Files, Graph, job_graph, with_planned
from pbonet.master.subsystem import find_missing
from pbonet.xm.net import messages as m

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from pbonet.master.subsystem import Subsystem

    Data = dict[str, Any]


class PresentJob:
    """Knows the present job, and draws its tasks that were killed or never spawned.

    Args:
        opened: The files with which the page was opened; their job, if there is one, is
            the present one until another was entered.
        libraries: Folders of modules.
    """

    def __init__(self, opened: Files, libraries: Iterable[str | Path]) -> None:
        self._opened = opened
        self._libraries = [*libraries]
        self._files: Files | None = opened if opened.job is not None else None
        self._standing: m.Standing | None = None
        self._drawn: Graph | None = None

    @property
    def name(self) -> str:
        """The name of the job that was entered last; empty: none is known."""
        return self._standing.name if self._standing else ""

    def ask(self, subsystem: Subsystem) -> bool:
        """Ask the keeper of the table for the present job.

        Returns:
            Whether it is another one than before.

        Raises:
            PbonetError: The keeper does not answer.
        """
        keeper = subsystem.files.sbs.keeper
        found = subsystem.clients.call(keeper, m.Job(), list[m.Standing])
        standing = found[0] if found else None
        if standing == self._standing:
            return False
        self._standing = standing
        self._drawn = None
        self._files = self._read(standing)
        return True

    def _read(self, standing: m.Standing | None) -> Files | None:
        """Return the files of a job; None if they are not on this machine."""
        if standing is None:
            return self._opened if self._opened.job is not None else None
        try:
            return Files(Path(standing.file), Library(self._libraries))
        except PbonetError:
            return None

    def planned(self) -> Graph | None:
        """Return the graph of the present job alone; None if it cannot be drawn."""
        if self._drawn is None and self._files is not None:
            try:
                self._drawn = job_graph(self._files)
            except PbonetError:
                self._files = None  # its files have changed since it was entered
        return self._drawn

    def complete(self, graph: Graph, statuses: Mapping[str, m.RtpuStatus]) -> Data:
        """Return the graph of existing tasks with those of the job that are missing.

        Args:
            graph: That of the existing tasks.
            statuses: By RTPU, of those that answered.

        Returns:
            It as plain values, and why each of these is missing in ``missing``.
        """
        planned, files = self.planned(), self._files
        missing: dict[str, str] = {}
        if planned is not None and files is not None:
            # How long ago would have to be sent again and again.
            ageless = [structs.replace(one, age=0.0) for one in statuses.values()]
            missing = {one.task: one.reason for one in find_missing(files, ageless)}
            whole = with_planned(files, graph, planned)
            # Without any task only the plan's own faults are shown.
            graph = whole if graph.tasks else planned
        data: Data = msgspec.to_builtins(graph)
        return data | {"job": self.name, "missing": missing}
