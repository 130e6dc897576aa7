"""The graph of a job, or of the tasks that run, for ``pbonet graph``."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from pbonet.config import Library
from pbonet.errors import ConfigError, ConfigFileError
from pbonet.master.configuration import Files, graph_svg, job_graph
from pbonet.master.subsystem import Subsystem

if TYPE_CHECKING:
    from pathlib import Path

    from pbonet.master.configuration import Graph, Place


class Drawn(NamedTuple):
    """A graph, and what is drawn with it."""

    graph: Graph
    states: dict[str, str]
    """The state of each task that runs; empty: nothing was asked."""
    warnings: list[str]


def planned(path: Path, place: Place, *, code: bool = True) -> Drawn:
    """Return the graph of a job; no agent is asked.

    Args:
        path: The ``.job`` file.
        place: Has the folders with modules.
        code: Import the modules, whose ports and parameters are then described.

    Raises:
        ConfigError: A file is missing or wrong, or it is no job.
    """
    files = Files(path, Library(place.libraries), code=code)
    if files.job is None:
        raise ConfigError(
            "a subsystem's file names no tasks to draw",
            where=str(path),
            expected="a .job file, or --running for the tasks that exist now",
            remedy="name one of its jobs: " + (", ".join(files.jobs()) or "none yet"),
        )
    return Drawn(job_graph(files, code=code), {}, [])


def running(path: Path, place: Place) -> Drawn:
    """Return the graph of the tasks that exist now.

    Raises:
        PbonetError: A file is wrong, or no agent answers.
    """
    warnings: list[str] = []
    subsystem = Subsystem(
        path,
        **place.arguments,
        kind="graph",
        watch=True,
        partly=True,
        warned=warnings.append,
    )
    with subsystem:
        graph = subsystem.graph()
        states = {member.name: member.state.value for member in subsystem.model}
    return Drawn(graph, states, list(dict.fromkeys(warnings)))


def write_svg(drawn: Drawn, path: Path) -> None:
    """Write the drawing into a file.

    Raises:
        ConfigFileError: It cannot be written.
    """
    try:
        path.write_text(graph_svg.svg(drawn.graph, drawn.states), encoding="utf-8")
    except OSError as error:
        raise ConfigFileError(
            "the drawing cannot be written",
            where=str(path),
            got=error.strerror or str(error),
            remedy="name a folder that is there and writable",
        ) from None
