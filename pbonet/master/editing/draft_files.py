"""The files of a job as they are edited: texts that are not saved yet."""

from __future__ import annotations

import contextlib
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import Struct, structs

from pbonet.config import (
    JobFile,
    JobTask,
    Section,
    SvarFile,
    bundled,
    combines,
    load,
    parse_job,
    parse_rmod,
    parse_svar,
    read_job,
    rewrite_job,
    rewrite_rmod,
    rewrite_svar,
    write_job,
)
from pbonet.errors import ConfigError
from pbonet.master.configuration import Files, Producers, RmodSource
from pbonet.xm.net import check_name

from .saved_files import SavedFiles

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pbonet.config import Library, Rewritten, Rmod, Variable


class Draft(Struct, frozen=True, kw_only=True):
    """One state of the files that are edited."""

    job: JobFile
    """May have no task, which no file can say."""
    table: SvarFile
    texts: dict[Path, str]
    """The job (unless it has no task), the table, and each RMOD that was changed."""
    origins: dict[Path, str]
    """The texts that these were made from, whose comments and layout they keep."""
    renamed: dict[str, str] = {}
    """New names of tasks of the job, by those that the text it was made from has."""
    bare: frozenset[Path] = frozenset()
    """Files that were written as a whole, without the comments they had."""


class DraftFiles(Files):
    """The files of a subsystem, of which those of a draft have its texts.

    Args:
        path: The ``.job`` file, or a ``.sbs`` file for a new job beside it.
        library: The library.
        name: The new job.

    Raises:
        ConfigError: A file is missing or wrong, or the job is there already.
    """

    draft: Draft
    """The state that is shown."""
    first: Draft
    """The state of the files when they were opened."""

    def __init__(self, path: str | Path, library: Library, name: str = "") -> None:
        self.disk = SavedFiles()
        super().__init__(path, library)
        job = self.job or _new_job(self.path, name or self.sbs.subsystem)
        self.job_path, self.svar_path = Path(job.file), Path(self.table.file)
        self._found: dict[str, Section] = {}
        self.disk.note(self.job_path)
        self.disk.note(self.svar_path)
        texts = {self.svar_path: self.table_text}
        if job.tasks:
            texts[self.job_path] = load(self.job_path)
        self.first = Draft(job=job, table=self.table, texts=texts, origins=texts)
        self.show(self.first)

    def show(self, draft: Draft) -> None:
        """Have the texts of a draft from now on."""
        self.draft, self.job, self.table = draft, draft.job, draft.table
        self.table_text = draft.texts[self.svar_path]
        self.__dict__.pop("profiles", None)  # they are compared with the table

    # -- RMODs

    def rmod(self, name: str, freq: float | None = None) -> RmodSource:
        """Return an RMOD, of the draft first; the same text is read once only.

        Raises:
            NodeError: No task can have that name.
            ConfigFileError: There is none of that name.
            ConfigError: Its file is wrong, or its class does not say all.
            ModuleLoadError: The module's code does not load.
        """
        name = check_name("a task", name.removesuffix(".rmod"))
        main, file = self.part(name, freq)
        return _read(bundled(main, self.part), file)

    def part(self, name: str, freq: float | None = None) -> Section:
        """Return the text of an RMOD, of the draft first, and its file.

        Raises:
            ConfigFileError: There is none of that name.
            ConfigError: It is a module whose class does not say all.
            ModuleLoadError: The module's code does not load.
        """
        path = self._draft_of(name)
        if path is not None:
            return Section(self.draft.texts[path], str(path))
        return self._saved(name, freq)

    def _draft_of(self, name: str) -> Path | None:
        """Return the file of an RMOD that the draft has; None: it has none."""
        for folder in dict.fromkeys((self.job_path.parent, self.path.parent)):
            path = folder / f"{name}.rmod"
            if path in self.draft.texts:
                return path
        return None

    def _saved(self, name: str, freq: float | None = None) -> Section:
        """Return the text of an RMOD as it was when it was first read."""
        if name in self._found:
            return self._found[name]
        section = super().part(name, freq)
        if section.file.endswith(".rmod"):
            self._found[name] = section
            if self.is_own(Path(section.file)):
                self.disk.note(Path(section.file))
        return section

    def is_free(self, name: str) -> bool:
        """Return whether no RMOD or module has a name, and no file of the folder."""
        path = self.job_path.with_name(f"{name}.rmod")
        taken = self._draft_of(name) is not None or path.exists()
        return not taken and name not in self.rmods()

    def producers(self) -> Producers:
        """Return, by variable, the RMODs that write it, with those of the draft."""
        return Producers(self.records)

    def records(self) -> dict[str, Rmod]:
        """Return all RMODs by name, those of the draft as they are there."""
        records = dict(self.library.records())
        for path in self.disk.made() - self.draft.texts.keys():
            name = path.stem  # on disk by a save, and not in the draft any more
            records.pop(name, None)
            if name in self._found:
                records[name] = self.rmod(name).record
        for path in self.draft.texts:
            if path.suffix == ".rmod":
                records[path.stem] = self.rmod(path.stem).record
        return records

    def has_rmod(self, name: str) -> bool:
        """Return whether an RMOD of a name is in a file or in the draft."""
        return self._draft_of(name) is not None or self._find(name) is not None

    def other_jobs(self, rmod: Path) -> list[str]:
        """Return the names of other jobs' files that find an RMOD in this file."""
        folders = {rmod.parent}
        if rmod.parent == self.path.parent:  # where the jobs of other folders look, too
            folders.add(self.job_path.parent)
        found: list[str] = []
        for path in sorted(one for place in folders for one in place.glob("*.job")):
            if path == self.job_path:
                continue
            with contextlib.suppress(ConfigError):
                tasks = read_job(path).tasks
                if any(rmod.stem in {one.rmod, one.fallback} for one in tasks):
                    found.append(path.name)
        return found

    def other_jobs_of_table(self) -> list[str]:
        """Return the names of other jobs' files that use the table."""
        found: list[str] = []
        for path in sorted({*self.path.parent.glob("*.job"), *self._beside_job()}):
            with contextlib.suppress(ConfigError):
                system = path.parent / read_job(path).sbs
                if path != self.job_path and system.resolve() == self.path.resolve():
                    found.append(path.name)
        return found

    def _beside_job(self) -> Iterable[Path]:
        return self.job_path.parent.glob("*.job")

    def is_shared(self, record: Rmod) -> bool:
        """Return whether a copy of an RMOD under its name would change other jobs.

        One that stands beside the job already is changed for all of them.
        """
        path = Path(record.file)
        own = self.is_own(path) and path.suffix == ".rmod"
        copy = self.job_path.with_name(f"{record.name}.rmod")
        return not own and bool(self.other_jobs(copy))

    # -- changes of the draft

    def set_job(self, **changes: object) -> None:
        """Change fields of the job.

        Raises:
            ConfigError: No file can say it.
        """
        job = structs.replace(self.draft.job, **changes)
        if not job.tasks:
            texts = {p: t for p, t in self.draft.texts.items() if p != self.job_path}
            self.show(structs.replace(self.draft, job=job, texts=texts))
            return
        origin = self.draft.origins.get(self.job_path, "")
        new = rewrite_job(origin, job, self.draft.renamed)
        draft = self._with(self.job_path, new)
        self.show(structs.replace(draft, job=parse_job(new.text, job.file)))

    def note_new_name(self, task: str, name: str) -> None:
        """Note that a task gets another name, for the line of it in the job."""
        renamed = self.draft.renamed
        first = next((one for one, now in renamed.items() if now == task), task)
        if renamed.get(first, task) != task:
            return  # that line is of another task, which had this name before
        self.show(structs.replace(self.draft, renamed={**renamed, first: name}))

    def set_variables(self, variables: Iterable[Variable]) -> None:
        """Change the variables of the table.

        Raises:
            ConfigError: No file can say it.
        """
        table = structs.replace(self.draft.table, variables=tuple(variables))
        new = rewrite_svar(self.draft.origins[self.svar_path], table)
        draft = self._with(self.svar_path, new)
        self.show(structs.replace(draft, table=parse_svar(new.text, table.file)))

    def set_rmod(self, record: Rmod, name: str = "") -> None:
        """Change an RMOD; one of a library gets a copy beside the job.

        Args:
            record: As it is to be.
            name: Another name: the RMOD is copied.

        Raises:
            ConfigError: No file can say it.
        """
        path = Path(record.file)
        new = name or record.name
        if name or not self.is_own(path) or path.suffix != ".rmod":
            path = self.job_path.with_name(f"{new}.rmod")
        origin = self.draft.origins.get(path)
        if origin is None or name:
            made_by_class = record.file.endswith(".py")
            origin = "" if made_by_class else self.part(record.name).text
            self.disk.note(path)
        made = structs.replace(record, name=new, file=str(path))
        origins = {**self.draft.origins, path: origin}
        draft = self._with(path, rewrite_rmod(origin, made))
        self.show(structs.replace(draft, origins=origins))

    def keep(self, name: str) -> None:
        """Have an RMOD in the draft that is on disk because it was saved here."""
        section = self.part(name)
        path = Path(section.file)
        if path in self.disk.made():
            texts = {**self.draft.texts, path: section.text}
            origins = {**self.draft.origins, path: section.text}
            self.show(structs.replace(self.draft, texts=texts, origins=origins))

    def prune(self) -> None:
        """Leave out new RMODs that no task uses, and those that are as they were."""
        used = self._used()
        texts = {
            path: text
            for path, text in self.draft.texts.items()
            if path.suffix != ".rmod" or not self._needless(path, text, used)
        }
        gone = self.draft.texts.keys() - texts.keys()
        if gone:
            kept = {p: t for p, t in self.draft.origins.items() if p not in gone}
            self.show(structs.replace(self.draft, texts=texts, origins=kept))

    def _needless(self, path: Path, text: str, used: set[str]) -> bool:
        if self.disk.is_new(path) and path.stem not in used:
            return True
        before = self._found.get(path.stem)
        if before is None or (self.disk.is_new(path) and before.file == str(path)):
            return False
        return before.text == text

    def _used(self) -> set[str]:
        """Return the RMODs that the job names, and the parts of these."""
        todo = [
            name
            for task in self.draft.job.tasks
            for name in (task.rmod, task.fallback)
            if name
        ]
        used: set[str] = set()
        while todo:
            name = todo.pop()
            if name not in used:
                used.add(name)
                path = self._draft_of(name)
                todo += combines(self.draft.texts[path]) if path else ()
        return used

    def _with(self, path: Path, new: Rewritten) -> Draft:
        """Return the draft with another text of a file."""
        others = self.draft.bare - {path}
        bare = others if new.comments else others | {path}
        texts = {**self.draft.texts, path: new.text}
        return structs.replace(self.draft, texts=texts, bare=bare)


@lru_cache(maxsize=2048)
def _read(text: str, file: str) -> RmodSource:
    return RmodSource(parse_rmod(text, file), text)


def _new_job(sbs: Path, name: str) -> JobFile:
    """Return a job without tasks, beside its subsystem.

    Raises:
        NodeError: No job can have the name.
        ConfigError: It is there already.
    """
    check_name("a job", name)
    job = JobFile(
        file=str(sbs.with_name(f"{name}.job")),
        name=name,
        desc=f"job {name}",
        sbs=sbs.name,
        tasks=(JobTask(rmod="any"),),
    )
    write_job(job)  # refused if a file cannot say its name
    path = Path(job.file)
    if path.exists():
        raise ConfigError(
            "the job is there already",
            where=str(path),
            expected="the name of a new job",
            remedy="open that one, or choose another name",
        )
    return structs.replace(job, tasks=())
