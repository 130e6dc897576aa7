"""Check a ``.seq`` file: its jobs, their order, its signals and its lines."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

from pbonet.analysis import legality
from pbonet.config import (
    Condition,
    EndRepeat,
    Finish,
    Goto,
    Order,
    Place,
    Repeat,
    Step,
    loops,
)
from pbonet.errors import ConfigError, PbonetError, UnknownTaskError, did_you_mean
from pbonet.pbo import PREDEFINED

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from pbonet.config import JobFile, SeqLine, StepEnd
    from pbonet.pbo import ModuleInfo

    from .subsystem_files import Files


class StepJob(NamedTuple):
    """A job of a sequence."""

    file: JobFile
    tasks: tuple[legality.Task, ...] | None
    """Its tasks, as judged; None: it is too faulty for that."""


class SequenceCheck:
    """The faults of a sequence.

    Args:
        files: The files of the subsystem, opened with the sequence.
        judged: Judges the job in a file, and notes its faults.
        module: Describes the module of an RMOD; None: no code is imported.

    Attributes:
        errors: What is wrong.
        problems: What is wrong with conditions.
        warnings: What may go wrong.
        notes: What a reader should know.
    """

    def __init__(
        self,
        files: Files,
        judged: Callable[[str], StepJob],
        module: Callable[[str], ModuleInfo | None],
    ) -> None:
        if files.seq is None:
            raise TypeError(files.path)
        self.errors: list[PbonetError] = []
        self.problems: list[legality.Problem] = []
        self.warnings: list[str] = []
        self.notes: list[str] = []
        self._files = files
        self._seq = files.seq
        self._judged = judged
        self._module = module
        self._jobs: dict[str, StepJob] = {}
        self._modules: dict[str, ModuleInfo | None] = {}
        """The modules of tasks; None: not known."""
        self._around = loops(self._seq)

    def run(self) -> None:
        """Check everything."""
        safe = [self._seq.safe] if self._seq.safe else []
        steps = [*self._seq.steps, *safe]
        for step in steps:
            self._read_job(step)
        for line in self._seq.lines:
            if isinstance(line, Order) and line.command == "spawn":
                self._check_spawn(line)
        for line in self._seq.lines:
            if isinstance(line, Order) and line.command != "spawn":
                self._check_order(line)
            elif isinstance(line, Goto) and line.when is not None:
                self._check_condition(line.when)
        for step in steps:
            self._check_ends(step)
        self._check_fits()
        self._check_flow()

    def gives(self, problem: legality.Problem) -> bool:
        """Return whether what a job lacks is a constant that a SPAWN line brings."""
        given: set[str] = set()
        for line in self._seq.lines:
            if isinstance(line, Order) and line.command == "spawn":
                with suppress(PbonetError):  # reported at the line itself
                    rmod = self._files.rmod(line.words[0]).record
                    given |= {rmod.svar_name(port) for port in rmod.outconst}
        lacks = problem.code is legality.Code.NO_CONSTANT
        return lacks and given.issuperset(problem.variables)

    # -- jobs and tasks ----------------------------------------------------------------

    def _read_job(self, step: Step) -> None:
        if step.job in self._jobs:
            return
        try:
            job = self._jobs[step.job] = self._judged(self._files.step_job(step).file)
        except PbonetError as error:
            self.errors.append(error)
            return
        for one in job.file.tasks:
            self._modules.setdefault(one.rmod, None)
            if one.fallback:
                self._modules.setdefault(one.fallback, None)
        for task in job.tasks or ():
            self._modules[task.name] = task.info

    def _check_spawn(self, line: Order) -> None:
        name, *rtpu = line.words
        known = [entry.name for entry in self._files.sbs.rtpus]
        try:
            self._modules[name] = self._module(name)
            if rtpu and rtpu[0] not in known:
                raise ConfigError(
                    f"SPAWN names {rtpu[0]}, which is no RTPU of the subsystem",
                    expected=" or ".join(known),
                    got=rtpu[0],
                    remedy=did_you_mean(rtpu[0], known) or "name one of these",
                )
        except PbonetError as error:
            error.where = error.where or str(line.place)
            self.errors.append(error)

    def _check_order(self, line: Order) -> None:
        """Check the names in a KILL, SET or WRITE line."""
        try:
            if line.command == "write":
                self._check_write(line)
            elif line.command == "kill":
                for task in line.words:
                    self._must_have(task, line.place)
            else:
                self._check_set(line)
        except PbonetError as error:
            error.where = str(line.place)
            self.errors.append(error)

    def _check_write(self, line: Order) -> None:
        name, *values = line.words
        self._files.must_have(name)
        table = self._files.table.variables
        size = next(one.nelem for one in table if one.name == name)
        if len(values) != size:
            raise ConfigError(
                f"WRITE has {len(values)} numbers for {name}",
                expected=f"{size}, one for each element",
                got=str(len(values)),
                remedy="write one number for each element",
            )

    def _check_set(self, line: Order) -> None:
        task, name, *_ = line.words
        info = self._must_have(task, line.place)
        known = [one.name for one in info.params] if info else [name]
        if name not in known:
            raise ConfigError(
                f"SET names {name}, which is no parameter of {task}",
                expected=" or ".join(known) or "a task with parameters",
                got=name,
                remedy=did_you_mean(name, known) or "name one of these",
            )

    def _must_have(self, task: str, place: Place | None) -> ModuleInfo | None:
        """Return what is known of a task.

        Raises:
            UnknownTaskError: No job has it, and no SPAWN line.
        """
        if task not in self._modules:
            raise UnknownTaskError(
                f"no job of the sequence has a task {task}",
                where=str(place or ""),
                expected="a task of one of the jobs, or of a SPAWN line",
                got=task,
                remedy=did_you_mean(task, self._modules) or "name one of them",
            )
        return self._modules[task]

    # -- ends --------------------------------------------------------------------------

    def _check_condition(self, end: StepEnd) -> None:
        if end.condition:
            table = self._files.table.variables
            one = Condition(end.condition, end.place)
            self.problems += legality.check_conditions([one], table)

    def _check_ends(self, step: Step) -> None:
        for end in step.until:
            self._check_condition(end)
            if end.signal:
                self._check_signal(step, end)
        none = step.seconds is None and step.within is None and not self._seq.within
        if step.until and none:
            self.notes.append(
                f"{step.place}: the step {step.name} waits without a limit for "
                f"{' or '.join(map(str, step.until))} (no WITHIN)"
            )

    def _check_signal(self, step: Step, end: StepEnd) -> None:
        job = self._jobs.get(step.job)
        if job is None or job.tasks is None:
            return
        spawned = {
            line.words[0]
            for line in self._seq.lines
            if isinstance(line, Order) and line.command == "spawn"
        }
        there = {task.name: task.info for task in job.tasks}
        there |= {name: self._modules.get(name) for name in spawned}
        if end.task and end.task not in there:
            self.errors.append(
                UnknownTaskError(
                    f"the job {step.job} has no task {end.task}",
                    where=str(end.place),
                    expected=f"a task of {step.job}, or of a SPAWN line",
                    got=end.task,
                    remedy=did_you_mean(end.task, there) or "name one of them",
                )
            )
            return
        asked = [there[end.task]] if end.task else list(there.values())
        infos = [info for info in asked if info is not None]
        known = [*PREDEFINED, *(one.name for info in infos for one in info.signals)]
        if end.signal not in known and len(infos) == len(asked):
            self.errors.append(
                ConfigError(
                    f"no task of {step.job} has a signal {end.signal}"
                    if not end.task
                    else f"the task {end.task} has no signal {end.signal}",
                    where=str(end.place),
                    expected="one of " + ", ".join(dict.fromkeys(known)),
                    got=end.signal,
                    remedy=did_you_mean(end.signal, known)
                    or "a module declares its own: NAME = UserSignal(0, ...)",
                )
            )

    # -- neighbours --------------------------------------------------------------------

    def _check_fits(self) -> None:
        """Compare POST of each job with PRE of those that may follow it."""
        if self.errors or self.problems:
            return  # conditions that cannot be evaluated cannot be compared
        done: set[tuple[str, str, tuple[StepEnd, ...]]] = set()
        for at, line in enumerate(self._seq.lines):
            if not isinstance(line, Step):
                continue
            for after in self._steps_after(at):
                key = (line.job, after.job, line.until)
                if line.job != after.job and key not in done:
                    done.add(key)
                    self._check_fit(line, after)

    def _check_fit(self, step: Step, after: Step) -> None:
        former, later = self._jobs[step.job].file, self._jobs[after.job].file
        sole = step.until if step.seconds is None else ()
        known = [Condition(one.condition) for one in sole if len(sole) == 1]
        found = legality.fit(
            former.post,
            later.pre,
            self._files.table.variables,
            [one for one in known if one.text],
        )
        pair = f"{step.name} -> {after.name}"
        for post, pre in found.conflicts:
            self.errors.append(
                ConfigError(
                    f"{pair}: POST of {former.name} and PRE of {later.name} can never "
                    f"hold together",
                    where=str(after.place),
                    expected=f"PRE {pre.text} ({pre.place})",
                    got=f"POST {post.text} ({post.place})",
                    remedy="put another step between them, or correct one of them",
                )
            )
        if found.unsaid:
            texts = ", ".join(one.text for one in found.unsaid)
            self.warnings.append(
                f"{after.place}: {pair}: POST of {former.name} does not ensure PRE of "
                f"{later.name}: {texts}; it is asked when the step begins"
            )

    def _steps_after(self, at: int) -> Iterator[Step]:
        """Yield the steps that may follow a step without an error."""
        seen: set[int] = set()
        open_ = list(self._after(at))
        while open_:
            one = open_.pop(0)
            if one in seen or one >= len(self._seq.lines):
                continue
            seen.add(one)
            line = self._seq.lines[one]
            if isinstance(line, Step):
                yield line
            else:
                open_ += self._after(one)

    # -- flow --------------------------------------------------------------------------

    def _after(self, at: int) -> list[int]:
        """Return the lines that may follow a line without an error."""
        line = self._seq.lines[at]
        if isinstance(line, Goto):
            target = self._seq.at(line.step)
            return [target, at + 1] if line.when is not None else [target]
        if isinstance(line, EndRepeat):
            begin = self._around[at][-1]
            forever = not getattr(self._seq.lines[begin], "times", 0)
            return [begin + 1] if forever else [begin + 1, at + 1]
        return [] if isinstance(line, Finish) else [at + 1]

    def _all_after(self, at: int, above: Step | None) -> list[int]:
        """Return the lines that may follow a line, after an error too."""
        line = self._seq.lines[at]
        may_fail = isinstance(line, Step | Order | Goto)
        found = self._after(at)
        if may_fail and above is not None and above.otherwise:
            found.append(self._seq.at(above.otherwise))
        return found

    def _check_flow(self) -> None:
        """Note lines that are never reached, loops without an exit, and no SAFE."""
        lines = self._seq.lines
        after: list[list[int]] = []
        above: Step | None = None
        for at, line in enumerate(lines):
            above = line if isinstance(line, Step) else above
            after.append(self._all_after(at, above))
        reached = _closure([0], lambda at: after[at], len(lines))
        before = False
        for at, line in enumerate(lines):
            lost = at not in reached and not isinstance(line, EndRepeat)
            if lost and (isinstance(line, Step) or not before):
                self.warnings.append(f"{line.place}: {_name(line)} is never reached")
            before = lost
        ending = _ending(after, lines)
        endless = sorted(reached - ending)
        if endless:
            first = lines[endless[0]]
            self.notes.append(
                f"{first.place}: from {_name(first)} on the sequence has no end: it "
                "runs until it is aborted, or until a line fails"
            )
        if self._seq.safe is None:
            self.notes.append(
                f"{self._seq.file}: there is no SAFE job: after an abort, and after an "
                "error that no ELSE takes, the present job stays until it is ended"
            )


def _closure(
    first: Iterable[int], after: Callable[[int], list[int]], size: int
) -> set[int]:
    """Return the lines that are reached from some lines."""
    found: set[int] = set()
    open_ = list(first)
    while open_:
        one = open_.pop()
        if one not in found and one < size:
            found.add(one)
            open_ += after(one)
    return found


def _ending(after: list[list[int]], lines: tuple[SeqLine, ...]) -> set[int]:
    """Return the lines from which the sequence may come to its end."""
    before: dict[int, list[int]] = {}
    for at, found in enumerate(after):
        for one in found:
            before.setdefault(one, []).append(at)
    ends = [at for at, line in enumerate(lines) if isinstance(line, Finish)]
    ends += before.get(len(lines), [])
    return _closure(ends, lambda at: before.get(at, []), len(lines))


def _name(line: SeqLine) -> str:
    if isinstance(line, Step):
        return f"the step {line.name}"
    return "this loop" if isinstance(line, Repeat) else "this line"
