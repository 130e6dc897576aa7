"""Offers to put a fault right: what to connect, add or join, as steps to be applied."""

from __future__ import annotations

from difflib import SequenceMatcher
from itertools import count
from typing import TYPE_CHECKING, Any

from msgspec import Struct

from pbonet.analysis.legality import CONNECTORS, Code, Severity, factor
from pbonet.config import numpy_type
from pbonet.errors import PbonetError
from pbonet.master.tools import scaffold_system
from pbonet.ports import Kind

from .fitting_ports import Fitting
from .task_edits import numbered, task_names
from .wiring_edits import free_names

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from pbonet.analysis.legality import Problem, Task
    from pbonet.config import Variable

    from .draft_files import DraftFiles
    from .job_verdict import JobVerdict

_MOST = 3
"""Number of variables that are offered for one port."""
_SIZE = "NDOF"
"""The constant of a connector that is the number of elements."""


class Step(Struct, frozen=True):
    """One change, as `JobEditor.edit` takes it."""

    do: str
    args: dict[str, Any]


class Offer(Struct, frozen=True, kw_only=True):
    """A way to put a fault, or several, right."""

    faults: tuple[int, ...]
    """The places of the faults in the graph's list."""
    kind: str
    """``connect``, ``join``, ``add-task``, ``add-variable`` or another word."""
    text: str
    """The words for a button."""
    steps: tuple[Step, ...]


class Offers:
    """Finds offers for the faults of one state of a job.

    Args:
        files: The files.
        verdict: What is known about that state.
    """

    def __init__(self, files: DraftFiles, verdict: JobVerdict) -> None:
        self._files, self._verdict = files, verdict
        self._fitting = Fitting(files, verdict)
        self._producers = files.producers()
        self._entries = _missing_entries(files, verdict)

    def all(self) -> list[Offer]:
        """Return the offers, in the order of the faults; each once."""
        by_code: dict[Code, Callable[[Problem], Iterator[tuple[str, str, list[Step]]]]]
        by_code = {
            Code.UNKNOWN_VARIABLE: self._unknown_variable,
            Code.NO_WRITER: self._no_writer,
            Code.NO_CONSTANT: self._no_constant,
            Code.TWO_WRITERS: self._two_writers,
            Code.UNIT: self._unit,
            Code.TYPE: self._misfit,
            Code.SHAPE: self._misfit,
            Code.UNKNOWN_RTPU: self._unknown_rtpu,
            Code.NO_STABLE: self._no_stable,
            Code.UNSAFE_ROBOT: self._unsafe_robot,
            Code.RATE: self._rate,
        }
        found: dict[str, Offer] = {}
        first = self._verdict.first_problem
        for number, problem in enumerate(self._verdict.problems, first):
            find = by_code.get(problem.code)
            for kind, text, steps in find(problem) if find else ():
                same = found.get(text)
                faults = (*same.faults, number) if same else (number,)
                found[text] = Offer(
                    faults=faults, kind=kind, text=text, steps=tuple(steps)
                )
        return list(found.values())

    # -- by kind of fault

    def _unknown_variable(
        self, problem: Problem
    ) -> Iterator[tuple[str, str, list[Step]]]:
        (name,), (task,), (port,) = problem.variables, problem.tasks, problem.ports
        entry = self._entries.get(name)
        if entry is not None:
            what = f"{entry.type}[{entry.nelem}] in {entry.units}"
            yield "add-variable", f"add {name} ({what}) to the table", [_added(entry)]
        if len(self._entries) > 1 and entry is not None:
            steps = [_added(one) for one in self._entries.values()]
            text = f"add all {len(steps)} missing variables to the table"
            yield "add-variable", text, steps
        yield from self._others([(task, port)], name)

    def _no_writer(self, problem: Problem) -> Iterator[tuple[str, str, list[Step]]]:
        for name in problem.variables:
            ends = [
                (task.name, port)
                for task in self._verdict.tasks
                if task.name in problem.tasks
                for port in task.rmod.invar
                if task.rmod.svar_name(port) == name
            ]
            yield from self._others(ends, name)
            yield from self._from_library(name)

    def _no_constant(self, problem: Problem) -> Iterator[tuple[str, str, list[Step]]]:
        (name,), (task,), (port,) = problem.variables, problem.tasks, problem.ports
        yield from self._from_library(name)
        if problem.severity is Severity.WARN:
            return  # it has the value of its INIT line
        yield from self._others([(task, port)], name)
        size = self._fitting.sizes.get(name)
        known = self._fitting.table.get(name)
        if size is not None and known is not None and known.init is None:
            args = {"name": name, "field": "init", "value": [size]}
            text = f"give {name} the value {size} in the table"
            yield "set-variable", text, [Step("set_variable", args)]

    def _two_writers(self, problem: Problem) -> Iterator[tuple[str, str, list[Step]]]:
        (name,) = problem.variables
        if problem.severity is Severity.WARN:
            return  # only while the job is started; another fault has all writers
        writers = [t for t in self._verdict.tasks if t.name in problem.tasks]
        if all(name in task.outputs for task in writers):
            yield from self._joins(name, writers)
        for task in reversed(writers):
            args = {"task": task.name}
            yield "remove-task", f"remove {task.name}", [Step("remove_task", args)]

    def _misfit(self, problem: Problem) -> Iterator[tuple[str, str, list[Step]]]:
        for port, name in zip(problem.ports, problem.variables, strict=False):
            yield from self._others([(problem.tasks[0], port)], name)

    def _unknown_rtpu(self, problem: Problem) -> Iterator[tuple[str, str, list[Step]]]:
        (task,) = problem.tasks
        for rtpu in self._files.sbs.rtpus:
            args = {"task": task, "field": "rtpu", "value": rtpu.name}
            yield "set-field", f"run {task} on {rtpu.name}", [Step("set_field", args)]

    @staticmethod
    def _no_stable(problem: Problem) -> Iterator[tuple[str, str, list[Step]]]:
        (task,) = problem.tasks
        args = {"task": task, "field": "critical", "value": False}
        yield "set-field", f"{task} is not CRITICAL", [Step("set_field", args)]

    def _unsafe_robot(self, problem: Problem) -> Iterator[tuple[str, str, list[Step]]]:
        for name in problem.tasks:
            task = self._verdict.task(name)
            if task and task.info and task.info.critical_ok and not task.rmod.critical:
                args = {"task": name, "field": "critical", "value": True}
                yield "set-field", f"{name} is CRITICAL", [Step("set_field", args)]

    def _rate(self, problem: Problem) -> Iterator[tuple[str, str, list[Step]]]:
        (name,) = problem.tasks
        task = self._verdict.task(name)
        rtpus = {one.name: one for one in self._files.sbs.rtpus}
        if task is None or task.hz is None or task.rtpu not in rtpus:
            return
        rtpu = rtpus[task.rtpu]
        hz = min(max(task.hz, rtpu.minfreq), rtpu.maxfreq)
        args = {"task": name, "field": "freq", "value": hz}
        yield "set-field", f"run {name} at {hz:g} Hz", [Step("set_field", args)]

    def _unit(self, problem: Problem) -> Iterator[tuple[str, str, list[Step]]]:
        """Yield other variables that fit, and a gain that converts."""
        yield from self._misfit(problem)
        if len(problem.ports) == 1:  # else it is a connector's
            (name,), (task,), (port,) = problem.variables, problem.tasks, problem.ports
            yield from self._conversion(task, port, name)

    def _conversion(
        self, task: str, port: str, name: str
    ) -> Iterator[tuple[str, str, list[Step]]]:
        """Yield a gain before an input, from the variable's unit to the port's."""
        side, variable = self._fitting.side(task, port), self._fitting.table.get(name)
        if side is None or variable is None or side.port.kind is not Kind.INVAR:
            return
        by = factor(variable.units, side.port.unit)
        if by is None or numpy_type(variable.type) != "<f8":
            return
        more, size = self._size(variable)
        new = free_names(self._files, name, 1, self._used())[0]
        gain = self._free_tasks("scale", name, 1)[0]
        place = {"rtpu": side.task.rtpu, "freq": side.task.hz}
        added = {"name": new, "nelem": variable.nelem, "units": side.port.unit}
        added["desc"] = f"{variable.desc}, in {side.port.unit}"
        aliases = {"Z": name, "Y": new, **size}
        made = {"module": "gain", "name": gain, "aliases": aliases, **place}
        wired = {"task": task, "port": port, "variable": new}
        yield (
            "convert",
            f"convert {name} by a gain of {by:.6g} before {port} of {task}",
            [
                Step("add_variable", added),
                *more,
                Step("add_task", {**made, "params": {"GAIN": repr(by)}}),
                Step("connect", wired),
            ],
        )

    # -- what they offer

    def _others(
        self, ends: Sequence[tuple[str, str]], name: str
    ) -> Iterator[tuple[str, str, list[Step]]]:
        """Yield other variables that fit all of some ports; like names come first."""
        fitting = [self._fitting_variables(task, port, name) for task, port in ends]
        if not fitting:
            return
        common = sorted(
            fitting[0].intersection(*fitting[1:]),
            key=lambda other: (-SequenceMatcher(None, name, other).ratio(), other),
        )
        for variable in common[:_MOST]:
            steps = [
                Step("connect", {"task": task, "port": port, "variable": variable})
                for task, port in ends
            ]
            told = " and ".join(f"{port} of {task}" for task, port in ends)
            yield "connect", f"connect {told} to {variable} (SVARALIAS)", steps

    def _fitting_variables(self, task: str, port: str, but: str) -> set[str]:
        """Return variables of other tasks that fit a port; no second writer of one."""
        side = self._fitting.side(task, port)
        reads = side is not None and side.port.kind.is_input
        written = {
            name for one in self._verdict.tasks for name in (*one.outputs, *one.gives)
        }
        return {
            fit.variable
            for fit in self._fitting.of(task, port)
            if fit.fits and fit.port and (reads or fit.variable not in written)
        } - {but}

    def _from_library(self, name: str) -> Iterator[tuple[str, str, list[Step]]]:
        there = task_names(self._files)
        for rmod in self._producers.get(name, ()):
            if rmod not in there:
                step = Step("add_task", {"module": rmod})
                yield "add-task", f"add {rmod}, which writes {name}", [step]

    def _joins(
        self, name: str, writers: Sequence[Task]
    ) -> Iterator[tuple[str, str, list[Step]]]:
        """Yield the chains of join connectors after the writers of a variable."""
        variable = self._fitting.table.get(name)
        if variable is None or numpy_type(variable.type) != "<f8":
            return
        links = len(writers) - 1
        names = free_names(self._files, name, 2 * links, self._used())
        before = [Step("copy_variable", {"of": name, "name": new}) for new in names]
        for writer, new in zip(writers, names, strict=False):
            port = writer.port("OUTVAR", name)
            wired = {"task": writer.name, "port": port, "variable": new}
            before.append(Step("connect", wired))
        more, size = self._size(variable)
        inputs, between = names[: links + 1], [*names[links + 1 :], name]
        tasks = self._free_tasks("join", name, links)
        for connector in CONNECTORS:
            chain: list[Step] = []
            first = inputs[0]
            for task, second, out in zip(tasks, inputs[1:], between, strict=True):
                args: dict[str, Any] = {
                    "module": connector,
                    "name": task,
                    "aliases": {"Z1": first, "Z2": second, "Z": out, **size},
                    **self._place(name, writers),
                }
                chain.append(Step("add_task", args))
                first = out
            told = " and ".join(task.name for task in writers)
            text = f"join {told} by {connector} into {name}"
            yield "join", text, [*before, *more, *chain]

    def _size(self, variable: Variable) -> tuple[list[Step], dict[str, str]]:
        """Return steps to have a constant of a size, and the alias for it."""
        size, sizes = variable.nelem, self._fitting.sizes
        known = self._fitting.table.get(_SIZE)
        if known is not None and sizes.get(_SIZE, size) == size:
            return [], {}
        for name, one in sizes.items():
            if one == size:
                return [], {_SIZE: name}
        name = free_names(self._files, f"N_{size}", 1, self._used())[0]
        entry = {"name": name, "type": "int", "init": [size]}
        entry["desc"] = f"number of elements of {variable.name}"
        return [Step("add_variable", entry)], {_SIZE: name}

    def _place(self, variable: str, writers: Sequence[Task]) -> dict[str, Any]:
        """Return where a connector runs, and how often: as its fastest reader."""
        readers = [t for t in self._verdict.tasks if variable in t.inputs]
        near = max(readers or writers, key=lambda task: task.hz or 0.0)
        return {"rtpu": near.rtpu, "freq": near.hz}

    def _free_tasks(self, does: str, variable: str, wanted: int) -> list[str]:
        """Return names of new tasks that do something with a variable."""
        word = "".join(c if c.isalnum() and c.isascii() else "_" for c in variable)
        names = (numbered(f"{does}_{word}", number) for number in count(1))
        taken = task_names(self._files)
        found: list[str] = []
        while len(found) < wanted:
            name = next(names)
            if name not in taken and self._files.is_free(name):
                found.append(name)
        return found

    def _used(self) -> set[str]:
        return {
            name
            for task in self._verdict.tasks
            for name in (*task.inputs, *task.outputs, *task.needs, *task.gives)
        }


def _added(entry: Variable) -> Step:
    args = {
        "name": entry.name,
        "type": entry.type,
        "nelem": entry.nelem,
        "units": entry.units,
        "desc": entry.desc,
        "init": None if entry.init is None else list(entry.init),
    }
    return Step("add_variable", args)


def _missing_entries(files: DraftFiles, verdict: JobVerdict) -> dict[str, Variable]:
    """Return the entries that the table lacks, as the modules' ports declare them.

    One whose size does not follow from the others is left out.
    """
    known = {one.name for one in files.draft.table.variables}
    uses = [
        scaffold_system.Use(task.rmod, task.info)
        for task in verdict.tasks
        if task.info is not None
    ]
    lacking = [use for use in uses if use.ports().keys() - known]
    if not lacking:
        return {}
    for some in (uses, *([use] for use in lacking)):
        try:
            found, _ = scaffold_system.new_svar(
                files.draft.table.file, some, {}, files.draft.table.variables
            )
        except PbonetError:
            continue
        if found.variables:
            return {one.name: one for one in found.variables}
    return {}
