"""The master's files and their contents.

Files travel by content (DESIGN, section 4): the master reads them on its machine and
sends their text. An RMOD is searched for beside the ``.job``, then beside the ``.sbs``,
then in the library.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet import config
from pbonet.config import JobFile, load, parse_sbs, parse_svar, read_job
from pbonet.errors import (
    ConfigError,
    ConfigFileError,
    NodeError,
    UnknownVariableError,
    did_you_mean,
)
from pbonet.xm.net import NAME, check_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from pbonet.config import Library, Rmod, SbsFile, SeqFile, Step, SvarFile

    from .saved_profiles import Store


class RmodSource(Struct, frozen=True):
    """An RMOD with the text it was read from."""

    record: Rmod
    text: str


class Files:
    """The files of one subsystem.

    Args:
        path: The ``.sbs`` file, or a ``.job`` or ``.seq`` file that names it.
        library: The library for RMODs that are beside neither. The folders of these
            files become its first ones.
        outside: Whether SBS and SVARFILE lines may name files outside the folder of
            the first file.
        code: Whether a module without an ``.rmod`` file may be imported.

    Raises:
        ConfigError: One of the files is missing, wrong, or not where it may be.
    """

    def __init__(
        self,
        path: str | Path,
        library: Library,
        *,
        outside: bool = True,
        code: bool = True,
    ) -> None:
        path = Path(path)
        folder = None if outside else path.parent
        self.job: JobFile | None = None
        self.seq: SeqFile | None = None
        first: JobFile | SeqFile | None = None
        if path.suffix == ".job":
            first = self.job = read_job(path)
        elif path.suffix == ".seq":
            first = self.seq = config.read_seq(path)
        if first is not None:
            path = path.parent / first.sbs
            _within(folder, path, first.file, "SBS")
        self.path = path
        self.library = library
        self._code = code
        text = _named(path, first.file, "SBS") if first else load(path)
        self.sbs: SbsFile = parse_sbs(text, str(path))
        svar = path.parent / self.sbs.svarfile
        _within(folder, svar, str(path), "SVARFILE")
        self.table_text = _named(svar, str(path), "SVARFILE")
        self.table: SvarFile = parse_svar(self.table_text, str(svar))
        self._folders: list[Path] = []
        self._search_first_in(path.parent)
        if first is not None:
            self._search_first_in(Path(first.file).parent)

    @cached_property
    def profiles(self) -> Store:
        """Saved profiles of its tasks."""
        from .saved_profiles import Store

        return Store(self.path, self.table)

    def read_job(self, path: str | Path | None = None) -> JobFile:
        """Return a job of this subsystem; its RMODs are searched for beside it first.

        Args:
            path: The file; a name without a folder is searched for beside the ``.sbs``
                too, and ``.job`` may be left out. None means the job that the subsystem
                was opened with.

        Raises:
            ConfigError: It is missing, wrong, of another subsystem, or not named.
        """
        if path is None:
            if self.job is None:
                raise self._no_job()
            return self.job
        job = read_job(self._job_path(Path(path)))
        folder = Path(job.file).parent
        named = (folder / job.sbs).resolve()
        if named != self.path.resolve():
            raise ConfigError(
                "the job is of another subsystem",
                where=job.file,
                expected=f"SBS {self.path.resolve()}, which this master controls",
                got=f"SBS {named}",
                remedy="start it with its own subsystem",
            )
        self._search_first_in(folder)
        return job

    def step_jobs(self) -> dict[str, Path]:
        """Return the file of each job of the sequence, by name.

        Raises:
            ConfigError: One is missing, wrong, or of another subsystem; the error says
                which line names it. Or there is no sequence.
        """
        return {name: Path(job.file) for name, job in self._of_steps().items()}

    def _of_steps(self) -> dict[str, JobFile]:
        """Return the jobs of the sequence, by name."""
        if self.seq is None:
            raise ConfigError(
                "the subsystem has no sequence",
                where=str(self.path),
                expected="a .seq file",
                remedy="open it with one",
            )
        safe = [self.seq.safe] if self.seq.safe else []
        found: dict[str, JobFile] = {}
        for step in (*self.seq.steps, *safe):
            if step.job not in found:
                found[step.job] = self.step_job(step)
        return found

    def step_job(self, step: Step) -> JobFile:
        """Return the job of a step, from beside the sequence, else beside the ``.sbs``.

        Raises:
            ConfigError: It is missing, wrong, or of another subsystem; the error says
                which line names it.
        """
        place = step.place
        folder = Path(place.file).parent if place else self.path.parent
        path = folder / f"{step.job}.job"
        beside = self.path.with_name(path.name)
        path = path if _is_there(path) or not _is_there(beside) else beside
        try:
            return self.read_job(path)
        except ConfigError as error:
            if not _is_there(path):
                known = {one.stem for one in folder.glob("*.job")} | set(self.jobs())
                raise ConfigFileError(
                    f"there is no job {step.job}",
                    where=str(place or ""),
                    expected=f"the file {path.name} beside the sequence",
                    remedy=did_you_mean(step.job, known)
                    or "write it, or name another job",
                ) from None
            error.where = f"{place}: {error.where}" if place else error.where
            raise

    def recorded_job(self) -> JobFile:
        """Return the job that a run records.

        Of a sequence it is one with the tasks and RECORD lines of all its jobs, and the
        tasks of its SPAWN lines.

        Raises:
            ConfigError: One of them is missing, wrong, or of another subsystem.
        """
        if self.seq is None:
            return self.read_job()
        jobs = self._of_steps().values()
        tasks = {task.rmod: task for job in jobs for task in job.tasks}
        for line in self.seq.lines:
            if isinstance(line, config.Order) and line.command == "spawn":
                tasks.setdefault(line.words[0], config.JobTask(rmod=line.words[0]))
        lines = {(r.mode, r.names): r for job in jobs for r in job.record}
        return JobFile(
            file=self.seq.file,
            name=self.seq.name,
            desc=self.seq.desc,
            sbs=self.seq.sbs,
            tasks=tuple(tasks.values()),
            record=tuple(lines.values()),
        )

    def rmod(self, name: str, freq: float | None = None) -> RmodSource:
        """Return the RMOD `name` from its present file, or from its module's class.

        Args:
            name: The RMOD, or a module that has no ``.rmod`` file.
            freq: Hz, for a module whose class has none.

        Raises:
            NodeError: No task can have that name.
            ConfigFileError: There is none of that name.
            ConfigError: Its file is wrong, or its class does not say all.
            ModuleLoadError: The module's code does not load.
        """
        name = check_name("a task", name.removesuffix(".rmod"))
        main, file = self.part(name, freq)
        text = config.bundled(main, self.part)
        return RmodSource(config.parse_rmod(text, file), text)

    def part(self, name: str, freq: float | None = None) -> config.Section:
        """Return the text of an RMOD, such as a part of a combination, and its file.

        Raises:
            ConfigFileError: There is none of that name.
            ConfigError: It is a module whose class does not say all.
            ModuleLoadError: The module's code does not load.
        """
        path = self._find(name)
        if path is not None:
            return config.Section(load(path), str(path))
        if name not in self.library.files():
            raise self._unknown(name, self.rmods())
        if not self._code:
            raise ConfigError(
                f"{name} has no .rmod file, and its module is not imported",
                expected=f"{name}.rmod",
                remedy="leave out --no-code, or write the file",
            )
        return self.library.source(name, freq)

    def rtpu_of(self, name: str) -> str | None:
        """Return the RTPU that an RMOD's file names; None: none, or it has no file.

        Raises:
            ConfigError: Its file is wrong.
        """
        return self.rmod(name).record.rtpu if self._find(name) else None

    def is_own(self, path: Path) -> bool:
        """Return whether a file is beside the subsystem's own, not in a library."""
        return path.parent in self._folders

    def must_have(self, variable: str) -> None:
        """Refuse the name of a variable that the table does not have.

        Raises:
            UnknownVariableError: It has none of that name.
        """
        known = [one.name for one in self.table.variables]
        if variable not in known:
            raise UnknownVariableError(
                f"the table has no variable {variable}",
                where=self.table.file,
                remedy=did_you_mean(variable, known) or "'display' shows them all",
            )

    def rmods(self) -> list[str]:
        """Return the names of RMODs, and of modules without one, sorted."""
        names = {*self.library.rmods(), *self.library.files()}
        return sorted(name for name in names if NAME.fullmatch(name))

    def producers(self) -> Producers:
        """Return, by variable, the RMODs that write it; for remedies in refusals."""
        return Producers(self.library.records)

    def jobs(self) -> list[str]:
        """Return the jobs that are beside the ``.sbs``, sorted."""
        return sorted(path.stem for path in self.path.parent.glob("*.job"))

    def likely_rtpu(self, task: str) -> str:
        """Return the RTPU on which a task is if it was spawned by the files.

        They are the job, the jobs beside the ``.sbs`` file, and the task's RMOD.
        """
        beside = [self.path.with_name(f"{name}.job") for name in self.jobs()]
        jobs = [self.job] if self.job is not None else []
        for path in beside:
            with contextlib.suppress(ConfigError):  # the file of another subsystem, too
                job = read_job(path)
                if (path.parent / job.sbs).resolve() == self.path.resolve():
                    jobs.append(job)
        named = [one.rtpu for job in jobs for one in job.tasks if one.rmod == task]
        originals = [one for job in jobs for one in job.tasks if one.fallback == task]
        for rmod in (task, *(one.rmod for one in originals if not one.rtpu)):
            with contextlib.suppress(NodeError, ConfigError):
                named.append(self.rtpu_of(rmod))
        named += [one.rtpu for one in originals]  # unless it has an RTPU of its own
        rtpus = [entry.name for entry in self.sbs.rtpus]
        return next((rtpu for rtpu in named if rtpu in rtpus), rtpus[0])

    def _no_job(self) -> ConfigError:
        jobs = ", ".join(f"{name}.job" for name in self.jobs())
        if self.seq is not None:
            return ConfigError(
                "a sequence is not a single job",
                where=self.seq.file,
                expected=f"one of its jobs: {', '.join(self.seq.jobs)}",
                remedy=f"name a .job file; 'pbonet run {self.seq.file} --sim' runs the "
                "sequence in virtual time",
            )
        return ConfigError(
            "no job is named",
            where=self.sbs.subsystem,
            expected="the name of a .job file",
            remedy=f"name one of: {jobs}" if jobs else f"write one beside {self.path}",
        )

    def _search_first_in(self, folder: Path) -> None:
        """Make `folder` the first in which RMODs are searched for."""
        self._folders = [folder, *(f for f in self._folders if f != folder)]
        self.library.beside = tuple(self._folders)

    def _job_path(self, path: Path) -> Path:
        if not path.name:
            raise self._no_job()
        wanted = path if path.suffix == ".job" else path.with_name(path.name + ".job")
        beside = self.path.parent / wanted
        if _is_there(wanted) or not _is_there(beside):
            return wanted
        return beside

    def _find(self, name: str) -> Path | None:
        for folder in self._folders:
            path = folder / f"{name}.rmod"
            if path.exists():
                return path
        with contextlib.suppress(ConfigFileError):
            return self.library.find_rmod(name)
        return None

    def _unknown(self, name: str, known: Iterable[str]) -> ConfigFileError:
        places = [str(folder) for folder in self._folders]
        return ConfigFileError(
            f"there is no RMOD {name}",
            expected=f"{name}.rmod, or a module {name}.py, in {' or '.join(places)}, "
            "or in the library",
            remedy=did_you_mean(name, known) or "see 'library' for what there is",
        )


def _named(path: Path, by: str, keyword: str) -> str:
    """Return the text of a file that a line of another one names.

    Raises:
        ConfigFileError: It cannot be read; the error says which line names it.
    """
    try:
        return load(path)
    except ConfigFileError as error:
        error.where = f"{_line_of(by, keyword)}: {error.where}"
        raise


def _line_of(file: str, keyword: str) -> str:
    """Return the place of the first line of a keyword in a file."""
    for number, line in enumerate(load(file).splitlines(), 1):
        if line.split()[:1] == [keyword]:
            return f"{file}:{number}"
    return file


def _within(folder: Path | None, path: Path, by: str, keyword: str) -> None:
    """Refuse a file outside a folder; None allows all.

    Raises:
        ConfigFileError: It is outside, by its name or by a symbolic link.
    """
    if folder is None or path.resolve().is_relative_to(folder.resolve()):
        return
    raise ConfigFileError(
        f"{keyword} names a file outside the folder of the file that is checked",
        where=_line_of(by, keyword),
        expected=f"a file in {folder.resolve()}",
        got=str(path.resolve()),
        remedy="--allow-outside reads it nevertheless",
    )


def _is_there(path: Path) -> bool:
    """Return whether a file is there; a name that no file can have is none."""
    try:
        return path.is_file()
    except OSError:
        return False


class Producers(Mapping[str, tuple[str, ...]]):
    """The RMODs that write each variable, read from all files when one is asked for.

    No module's code runs for this, so that none can harm the master.

    Args:
        read: Returns all RMODs by name.
    """

    def __init__(self, read: Callable[[], Mapping[str, Rmod]]) -> None:
        self._read = read

    @cached_property
    def _found(self) -> dict[str, tuple[str, ...]]:
        records = self._read()
        return config.producers({n: r for n, r in records.items() if NAME.fullmatch(n)})

    def __getitem__(self, variable: str) -> tuple[str, ...]:
        return self._found[variable]

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)
