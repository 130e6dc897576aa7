"""A job being edited: each change is judged, can be taken back, and saved on request.

It needs no agent, no network and no page; a page or a test drives it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import msgspec

from pbonet.analysis.legality import same_unit
from pbonet.config import Library, Search, meaning
from pbonet.errors import ConfigError, PbonetError, did_you_mean

from .draft_files import Draft, DraftFiles
from .fitting_ports import Fit, Fitting
from .job_verdict import JobVerdict, judge_job
from .module_palette import ModulePalette
from .simulated_run import DraftSimulation, SimulatedRun
from .steps import make_step
from .task_edits import JOB_FIELDS, RMOD_FIELDS, find_line, record_of, task_names
from .undo_history import History
from .wiring_offers import Offer, Offers, Step

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from pbonet.config import SvarFile

    from .saved_files import FileChange

State = dict[str, Any]
"""A state of the editor as plain values, ready for JSON."""


class JobEditor:
    """A job being edited.

    Args:
        path: The ``.job`` file; or a ``.sbs`` file, for a new job beside it.
        libraries: Folders of modules beside those that pbonet brings.
        name: The new job; by default that of the subsystem.
        like: An editor of jobs in the same folders, whose modules are described.
        host: The machine whose measured execution times count; this one if empty.

    Raises:
        ConfigError: A file is missing or wrong, or the new job is there already.
    """

    def __init__(
        self,
        path: str | Path,
        libraries: Iterable[str | Path] = (),
        *,
        name: str = "",
        like: JobEditor | None = None,
        host: str = "",
    ) -> None:
        self._libraries = list(libraries)
        self._host = host
        self.files = DraftFiles(path, Library(self._libraries), name)
        described = like.modules if like else None
        self.modules: ModulePalette = ModulePalette(
            self.files, self._libraries, described
        )
        self._history: History[Draft] = History(self.files.draft)
        self._judged: tuple[Draft, JobVerdict] | None = None
        self._offered: tuple[Draft, list[Offer]] | None = None
        self._load_tools()

    def _load_tools(self) -> None:
        """Have at hand what the first change would wait for: units, and the library."""
        same_unit("rad/s", "radians/second")
        len(self.files.producers())

    # -- what there is

    @property
    def verdict(self) -> JobVerdict:
        """The verdict on the present state."""
        if self._judged is None or self._judged[0] is not self.files.draft:
            self._judged = self.files.draft, judge_job(self.files, self._host)
        return self._judged[1]

    def state(self) -> State:
        """Return all that a page shows, as plain values.

        ``graph`` is that of `pbonet.master.configuration.Graph`; ``settings`` has the
        fields of each task's form, ``table`` those of each variable, ``about`` those of
        the job.
        """
        verdict = self.verdict
        return {
            "file": str(self.files.job_path),
            "graph": msgspec.to_builtins(verdict.graph),
            "legal": verdict.legal,
            "errors": verdict.errors,
            "warnings": verdict.warnings,
            "timing": verdict.timing(),
            "settings": {name: self._settings(name) for name in task_names(self.files)},
            "table": self._table(),
            "about": self._about(),
            "off_order": list(self.files.draft.job.off_order),
            "offers": msgspec.to_builtins(self.offers()),
            "undo": self._history.undo_label,
            "redo": self._history.redo_label,
            "unsaved": [str(path) for path in self._unsaved()],
        }

    def offers(self) -> list[Offer]:
        """Return what would put the faults of the graph right; see `apply`."""
        draft = self.files.draft
        if self._offered is None or self._offered[0] is not draft:
            self._offered = draft, Offers(self.files, self.verdict).all()
        return self._offered[1]

    def palette(
        self,
        *words: str,
        module_class: str = "",
        reads: str = "",
        writes: str = "",
        unit: str = "",
    ) -> list[State]:
        """Return the modules that can be added, with their ports and RMODs.

        The first call takes a second, because another process describes all modules.

        Args:
            words: Words that the description has, or the name of one module.
            module_class: Its class in the library, or the beginning of it.
            reads: A variable that it can read.
            writes: A variable that it can write.
            unit: The unit of such a port.

        Raises:
            ModuleLoadError: None fits, or they cannot be described.
            ConfigError: There is no such class.
        """
        return self.modules.find(
            Search(text=words, class_=module_class, in_=reads, out=writes, unit=unit)
        )

    def fitting(self, task: str, port: str) -> list[Fit]:
        """Return the ports and variables that fit a port, and why the others do not.

        Args:
            task: The task.
            port: The port's name in the module.

        Raises:
            UnknownTaskError: There is no such task.
            ConfigError: It has no such port, or its module cannot be read.
        """
        find_line(self.files, task)
        fitting = Fitting(self.files, self.verdict)
        if fitting.side(task, port) is None:
            known = self.verdict.task(task)
            ports = (
                [one.name for one in known.info.ports] if known and known.info else []
            )
            raise ConfigError(
                f"{task} has no port {port}"
                if known
                else f"the module of {task} cannot be read",
                where=self.files.draft.job.file,
                expected=" or ".join(ports),
                got=port,
                remedy=did_you_mean(port, ports) or "see the faults of the task",
            )
        return fitting.of(task, port)

    # -- changes

    def edit(self, do: str, **args: Any) -> State:  # noqa: ANN401 - as the change takes it
        """Make one change by its name; see the methods below for the names.

        Returns:
            The new state.

        Raises:
            PbonetError: It is refused, and nothing is changed.
        """
        return self._edit(_label(do, args), [Step(do, args)])

    def apply(self, offer: Offer) -> State:
        """Do what an offer says; it is taken back as one change."""
        return self._edit(offer.text, offer.steps)

    def _edit(self, label: str, steps: Iterable[Step]) -> State:
        before = self.files.draft
        try:
            for step in steps:
                make_step(self.files, step.do, step.args)
            self.files.prune()
        except BaseException:
            self.files.show(before)
            raise
        if self.files.draft != before:
            self._history.add(label, self.files.draft)
        return self.state()

    def add_task(
        self,
        module: str,
        *,
        name: str = "",
        rtpu: str | None = None,
        freq: float | None = None,
        params: dict[str, str] | None = None,
        aliases: dict[str, str] | None = None,
    ) -> State:
        """Add a task; its ports are connected by their names.

        Args:
            module: An RMOD of the library or of the job's folder, or a module.
            name: The task's name; by default that of the RMOD, with a number if taken.
            rtpu: The RTPU; by default that of the RMOD, else the first.
            freq: Hz; by default that of the RMOD.
            params: Parameters that differ, as LOCAL lines have them.
            aliases: Variables of ports, by the port's name.
        """
        return self.edit(
            "add_task",
            module=module,
            name=name,
            rtpu=rtpu,
            freq=freq,
            params=params,
            aliases=aliases,
        )

    def remove_task(self, task: str) -> State:
        """Remove a task with its fallback; or, of a standby, the fallback alone."""
        return self.edit("remove_task", task=task)

    def rename_task(self, task: str, name: str) -> State:
        """Give a task another name: its RMOD is copied under that name."""
        return self.edit("rename_task", task=task, name=name)

    def set_field(self, task: str, field: str, value: object) -> State:
        """Change a setting of a task: ``rtpu freq critical crit maxc`` and so on.

        Times are in seconds, as in files. None is the default.
        """
        return self.edit("set_field", task=task, field=field, value=value)

    def set_parameter(self, task: str, name: str, value: str | None) -> State:
        """Change a parameter, as a LOCAL line has it; None: its default."""
        return self.edit("set_parameter", task=task, name=name, value=value)

    def set_fallback(
        self, task: str, fallback: str | None, *, takeover: float = 0.0
    ) -> State:
        """Have an RMOD stand by for a task; None: nothing does."""
        return self.edit(
            "set_fallback", task=task, fallback=fallback, takeover=takeover
        )

    def set_off_order(self, tasks: Sequence[str]) -> State:
        """Say in which order tasks are turned off; none: the reverse of turning on."""
        return self.edit("set_off_order", tasks=list(tasks))

    def set_job(
        self,
        *,
        name: str | None = None,
        desc: str | None = None,
        pre: list[str] | None = None,
        post: list[str] | None = None,
    ) -> State:
        """Change the job's name, description or conditions; None: as it is."""
        return self.edit("set_job", name=name, desc=desc, pre=pre, post=post)

    def connect(self, task: str, port: str, variable: str) -> State:
        """Connect a port to a variable."""
        return self.edit("connect", task=task, port=port, variable=variable)

    def connect_ports(self, task: str, port: str, other: str, other_port: str) -> State:
        """Connect an output and an input: the input gets the output's variable."""
        return self.edit(
            "connect_ports", task=task, port=port, other=other, other_port=other_port
        )

    def disconnect(self, task: str, port: str) -> State:
        """Connect a port to a variable that no other task has."""
        return self.edit("disconnect", task=task, port=port)

    def add_variable(
        self,
        name: str,
        *,
        type: str = "double",  # noqa: A002 - as the file's keyword
        nelem: int = 1,
        units: str = "none",
        desc: str = "",
        init: list[float] | None = None,
    ) -> State:
        """Add an entry to the table."""
        return self.edit(
            "add_variable",
            name=name,
            type=type,
            nelem=nelem,
            units=units,
            desc=desc,
            init=init,
        )

    def set_variable(self, name: str, field: str, value: object) -> State:
        """Change an entry of the table: ``units nelem init maxage`` and so on."""
        return self.edit("set_variable", name=name, field=field, value=value)

    def remove_variable(self, name: str) -> State:
        """Remove an entry of the table that no task uses."""
        return self.edit("remove_variable", name=name)

    def undo(self) -> State:
        """Take the last change back; nothing if there is none."""
        self._history.undo()
        self.files.show(self._history.now)
        return self.state()

    def redo(self) -> State:
        """Make the change again that was taken back; nothing if there is none."""
        self._history.redo()
        self.files.show(self._history.now)
        return self.state()

    # -- files and runs

    def changes(self) -> list[FileChange]:
        """Return what `save` would write, with diffs; nothing is written."""
        return self.files.disk.described(self.files.draft.texts, self._notes())

    def save(self) -> list[Path]:
        """Write the files that differ; see `SavedFiles.save`.

        Returns:
            The files that were written or removed.

        Raises:
            ConfigError: The job has no task.
            ConfigFileError: Another program has changed a file, or one cannot be
                written.
        """
        if not self.files.draft.job.tasks:
            raise ConfigError(
                "a job without tasks cannot be saved",
                where=self.files.draft.job.file,
                expected="at least one TASK line",
                remedy="add a task first",
            )
        return self.files.disk.save(self.files.draft.texts, self.files.job_path)

    def simulate(
        self,
        seconds: float,
        variables: Sequence[str] = (),
        *,
        limit: float = 60.0,
        conditions: bool = True,
    ) -> SimulatedRun:
        """Run the present state in virtual time, in another process.

        Args:
            seconds: How much virtual time passes.
            variables: Those whose values are returned.
            limit: Seconds that it may take at most.
            conditions: Whether PRE and POST are judged; a job in the middle of a
                program may have a PRE that no start fulfils.

        Raises:
            ConfigError: The job has no task, or the time is none.
        """
        run = self.simulation(seconds, conditions=conditions)
        return run.run(variables, limit=limit)

    def simulation(self, seconds: float, *, conditions: bool = True) -> DraftSimulation:
        """Return the present state ready to be run in virtual time.

        It can be run in another thread, while this editor is used further.

        Args:
            seconds: How much virtual time passes.
            conditions: Whether PRE and POST are judged.

        Raises:
            ConfigError: The job has no task, or the time is none.
        """
        return DraftSimulation(
            self.files, seconds, conditions=conditions, libraries=self._libraries
        )

    # -- parts of them

    def _unsaved(self) -> list[Path]:
        return [*self.files.disk.changes(self.files.draft.texts)]

    def _settings(self, task: str) -> State:
        """Return the fields of a task's form; few if its RMOD cannot be read."""
        line, standby = find_line(self.files, task)
        found: State = {"takeover": line.takeover, "restart": line.restart}
        found["fallback"] = None if standby else line.fallback
        try:
            record = record_of(self.files, task)
        except PbonetError as error:
            return {**found, "error": str(error)}
        found |= {name: getattr(record, name) for name in RMOD_FIELDS}
        for name in JOB_FIELDS[:2]:
            said = None if standby else getattr(line, name)
            found[name] = getattr(record, name) if said is None else said
        found["safe_at"] = " ".join(record.safe_at)
        found["module"] = record.module
        lines = record.local.items()
        found["local"] = {name: " ".join(line.words) for name, line in lines}
        return cast("State", msgspec.to_builtins(found))

    def _table(self) -> State:
        """Return the fields of each variable's form."""
        found: State = {}
        for one in self.files.draft.table.variables:
            about = msgspec.json.decode(msgspec.json.encode(one), type=State)
            about.pop("place")
            found[one.name] = about
        return found

    def _about(self) -> State:
        """Return the fields of the job's form."""
        job = self.files.draft.job
        conditions = {"pre": job.pre, "post": job.post}
        texts = {key: [one.text for one in every] for key, every in conditions.items()}
        return {"name": job.name, "desc": job.desc, **texts}

    def _notes(self) -> dict[Path, list[str]]:
        """Return what is to be said of files that are written."""
        draft = self.files.draft
        notes: dict[Path, list[str]] = {
            path: ["its comments are lost: all of it is rewritten"]
            for path in draft.bare
        }
        changed = _changed(self.files.first.table, draft.table)
        if changed and (users := self.files.other_jobs_of_table()):
            text = f"it changes {', '.join(changed)} for {', '.join(users)} too"
            notes.setdefault(self.files.svar_path, []).append(text)
        for path in draft.texts:
            if path.suffix == ".rmod" and (users := self.files.other_jobs(path)):
                text = f"it changes {path.stem} for {', '.join(users)} too"
                notes.setdefault(path, []).append(text)
        return notes


def _changed(before: SvarFile, after: SvarFile) -> list[str]:
    """Return the variables that are not there any more, or are others."""
    now = {one.name: meaning(one) for one in after.variables}
    return [one.name for one in before.variables if now.get(one.name) != meaning(one)]


def _label(do: str, args: State) -> str:
    """Return a change in words, such as ``set field of pid: maxc``."""
    about = args.get("task") or args.get("module") or args.get("name") or ""
    detail = args.get("field") or args.get("port") or ""
    words = " ".join(part for part in (do.replace("_", " "), str(about)) if part)
    return f"{words}: {detail}" if detail else words
