"""The graph of a recorded run, from the files that are attached to its log."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from pbonet.config import Library
from pbonet.errors import LogError, PbonetError

from .subsystem_files import Files
from .subsystem_graph import job_graph

if TYPE_CHECKING:
    from pbonet.log import Log

    Data = dict[str, Any]


def recorded_graph(log: Log) -> tuple[Data, dict[str, float | None]]:
    """Return the graph of a run, and the MAXAGE of variables, from attached files.

    It has the tasks of all its jobs, and those that were spawned without one.

    Raises:
        LogError: They are missing, or wrong.
    """
    files = {Path(name).name: one.data for name, one in log.attached.items()}
    jobs = [name for name in files if name.endswith(".job")]
    systems = [name for name in files if name.endswith(".sbs")]
    if not jobs and not systems:
        raise LogError(
            "the log has no files from which its graph could be drawn",
            where=str(log.path),
            expected="a .job or .sbs file attached to it, as `run` and `start` do",
            remedy="plot it by `pbonet log plot`",
        )
    with tempfile.TemporaryDirectory(prefix="pbonet-") as name:
        folder = Path(name)
        for file, data in files.items():
            if file not in {"", ".."}:
                (folder / file).write_bytes(data)
        try:
            maxages: dict[str, float | None] = {}
            graphs = [_drawn(folder / one, maxages) for one in jobs or systems[:1]]
            graph = _joined([one for one in graphs if one["name"] == graphs[0]["name"]])
            rest = _without_job(log, graph, folder)
            if rest is not None and systems:
                graph = _joined([graph, _drawn(rest, maxages)]) | {"job": graph["job"]}
        except PbonetError as error:
            raise LogError(
                "its graph cannot be drawn from the files in the log",
                where=str(log.path),
                got=str(error).replace(f"{folder}/", ""),
                remedy="if the log is damaged, 'pbonet log recover' repairs it; "
                "'pbonet log plot' needs no files",
            ) from None
    return graph, maxages


def _drawn(path: Path, maxages: dict[str, float | None]) -> Data:
    """Return the graph of a job; add the MAXAGE of its variables to `maxages`."""
    found = Files(path, Library(()))
    maxages.update((one.name, one.maxage) for one in found.table.variables)
    graph: Data = msgspec.to_builtins(job_graph(found, code=False))
    return graph


def _without_job(log: Log, graph: Data, folder: Path) -> Path | None:
    """Write a job of the tasks that are in none; None: there are no such tasks."""
    drawn = {one["name"] for one in graph["tasks"]}
    lines: list[str] = []
    for task in log.tasks:
        about = log.lives(task)[-1].about
        if about.subsystem == graph["name"] and about.task not in drawn:
            (folder / f"{about.task}.rmod").write_text(about.rmod, "utf-8")
            lines.append(f"TASK {about.task} {about.rtpu}")
    if not lines:
        return None
    systems = (one.name for one in folder.glob("*.sbs"))
    path = folder / "without-job.job"
    head = ["JOB without-job", "DESC", f"SBS {next(systems, '')}"]
    path.write_text("\n".join([*head, *lines, "EOF", ""]), "utf-8")
    return path


def _joined(graphs: list[Data]) -> Data:
    """Return one graph with the tasks, variables and wires of several."""
    joined: Data = {
        **graphs[0],
        "job": ", ".join(one["job"] for one in graphs if one["job"]),
    }
    tasks = {task["name"]: task for one in graphs for task in one["tasks"]}
    variables: dict[str, Data] = {}
    for variable in (each for one in graphs for each in one["variables"]):
        known = variables.setdefault(variable["name"], {**variable})
        for side in ("writers", "readers"):
            known[side] = list(dict.fromkeys([*known[side], *variable[side]]))
    joined |= {"tasks": list(tasks.values()), "variables": list(variables.values())}
    for part in ("wires", "links", "faults"):
        found: list[Data] = []
        for each in (each for one in graphs for each in one[part]):
            if each not in found:
                found.append(each)
        joined[part] = found
    return joined
