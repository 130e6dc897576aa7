"""Check files on this machine, without agents.

A ``.job`` is judged as a master would judge it, with the modules of the libraries on
this machine, whose code runs when they are imported; the other files are read, and what
they name is looked up. Without code, all is judged that the files alone say.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import Struct, structs

from pbonet.analysis import legality
from pbonet.analysis.schedule import ASSUMED, CoreShare
from pbonet.config import (
    AgentConfig,
    JobFile,
    JobTask,
    Library,
    Rmod,
    SbsFile,
    SeqFile,
    SvarFile,
    absent,
    info_of,
    read_any,
)
from pbonet.errors import PbonetError
from pbonet.pbo import decode_params

from .saved_profiles import here, unused, with_times
from .subsystem_files import Files

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from pbonet.errors import WireError
    from pbonet.pbo import ModuleInfo


_BY_ITSELF = {
    legality.Code.PORTS,
    legality.Code.PARTS,
    legality.Code.TWO_WRITERS,
    legality.Code.TYPE,
    legality.Code.UNIT,
    legality.Code.SHAPE,
    legality.Code.NO_STABLE,
    legality.Code.NO_METHOD,
    legality.Code.TIMES,
}
"""Checks of an RMOD that need neither the table nor the other tasks."""


_NO_CODE = (
    "no module was imported (--no-code): ports, parameters, units, sizes and methods "
    "are not compared with modules"
)


class Findings(Struct, kw_only=True):
    """The faults of a file."""

    file: str
    kind: str
    about: str = ""
    """The file's content, in one line."""
    rtpus: list[legality.RtpuReport] = []
    """Of a job: what the analysis finds about each RTPU."""
    errors: list[WireError] = []
    warnings: list[str] = []
    notes: list[str] = []
    """Facts to know that are neither wrong nor doubtful."""

    @property
    def legal(self) -> bool:
        """Whether the file may be used."""
        return not self.errors

    def lines(self) -> list[str]:
        """Return the findings as lines for a terminal."""
        lines = legality.report_text(self.rtpus).splitlines()
        lines += [f"ERROR> {PbonetError.from_wire(error)}" for error in self.errors]
        lines += [f"WARNING> {text}" for text in self.warnings]
        lines += [f"NOTE> {text}" for text in self.notes]
        verdict = "legal"
        if self.errors:
            count = len(self.errors)
            verdict = "1 fault" if count == 1 else f"{count} faults"
        return [*lines, f"{self.file}: {self.about or self.kind}: {verdict}"]


def check_file(
    path: str | Path,
    libraries: Iterable[str | Path] = (),
    host: str = "",
    *,
    code: bool = True,
    outside: bool = False,
) -> Findings:
    """Return the faults of a file of any kind.

    Args:
        path: A ``.svar``, ``.rmod``, ``.sbs``, ``.job``, ``.seq`` or ``.toml`` file.
        libraries: Folders with modules beside those that pbonet brings.
        host: The machine whose saved profiles are used; this one if empty.
        code: Import the modules, and compare the files with them.
        outside: Read files outside the folder of `path` if a line names one.
    """
    found = Findings(file=str(path), kind=Path(path).suffix.lstrip(".") or "file")
    library = Library(libraries)
    library.beside = (Path(path).parent,)
    try:
        rmod = Path(path).suffix == ".rmod"
        record = library.read_rmod(path) if rmod else read_any(path)
        host = host or here()
        if isinstance(record, Rmod):
            found.about = f"RMOD {record.name} of module {record.module}"
            _check_rmod(found, record, library, code=code)
        elif isinstance(record, SbsFile):
            rtpus = ", ".join(entry.name for entry in record.rtpus)
            found.about = f"subsystem {record.subsystem} on {rtpus}"
            Files(path, library, outside=outside)  # reads the .svar file, too
        elif isinstance(record, JobFile):
            found.about = f"job {record.name} of {len(record.tasks)} tasks"
            files = Files(path, library, outside=outside, code=code)
            _check_job(found, files, host, code=code)
        elif isinstance(record, SeqFile):
            files = Files(path, library, outside=outside, code=code)
            found = sequence_findings(files, host, code=code, outside=outside)
        elif isinstance(record, AgentConfig):
            found.about = f"agent {record.name or 'without a name'}"
            found.warnings += _not_here(record)
        else:
            found.about = f"table of {len(record.variables)} variables"
        if not code and isinstance(record, Rmod | JobFile | SeqFile):
            found.warnings.append(_NO_CODE)
    except PbonetError as error:
        found.errors.append(error.to_wire())
    return found


def _not_here(agent: AgentConfig) -> list[str]:
    """Return what of an agent's file this machine, and this folder, does not have."""
    told = absent(agent.libraries)
    if agent.core is not None and agent.core not in os.sched_getaffinity(0):
        cores = " ".join(map(str, sorted(os.sched_getaffinity(0))))
        told.append(f"core {agent.core} cannot be used here (expected one of {cores})")
    return told


def _check_rmod(
    found: Findings, rmod: Rmod, library: Library, *, code: bool = True
) -> None:
    """Compare an RMOD with its module: ports, parameters, CRITICAL."""
    try:
        load = library.load
        info = info_of(rmod, lambda module: load(module).info) if code else None
    except PbonetError as error:
        first = "COMBINE" if rmod.parts else "MODULE"
        error.where = error.where or str(rmod.places[first])
        raise
    task = legality.Task(rmod=rmod, info=info, rtpu="")
    table = SvarFile(file="", defines={}, variables=())
    alone = legality.check(legality.Configuration(svar=table, tasks=(task,)))
    _take(found, [problem for problem in alone if problem.code in _BY_ITSELF])
    if info is None or (rmod.parts and found.errors):
        return  # there is no module to ask for its parameters
    try:
        cls = library.load_rmod(rmod).cls
        decode_params(cls, rmod.settings, where=_local(rmod))
    except PbonetError as error:
        found.errors.append(error.to_wire())


def _local(rmod: Rmod) -> str:
    """Return the place for missing parameters."""
    return str(rmod.places.get("LOCAL", rmod.file))


def planned(
    files: Files, host: str, *, code: bool = True, core: CoreShare = ASSUMED
) -> tuple[legality.Verdict | None, Findings]:
    """Return the verdict on a job, and the faults of its parts.

    Args:
        files: Its files.
        host: The machine whose saved profiles are used.
        code: Import the modules, and compare the files with them.
        core: What tasks may use of each core.

    Returns:
        None instead of the verdict if a part is too faulty for one.
    """
    tasks, found = planned_tasks(files, host, code=code)
    return judged(files, tasks, core=core), found


def judged(
    files: Files,
    tasks: Sequence[legality.Task],
    machines: Mapping[str, str] | None = None,
    *,
    core: CoreShare = ASSUMED,
) -> legality.Verdict | None:
    """Return the verdict on the start of a job; None if its `tasks` are not all.

    Args:
        files: Its files.
        tasks: Its tasks that can be read.
        machines: The machine of each RTPU, where it is known.
        core: What tasks may use of each core.
    """
    if len(tasks) < sum(len(_lines(line)) for line in files.read_job().tasks):
        return None  # else one fault would be reported as many
    empty = legality.Configuration(
        svar=files.table,
        rtpus=files.sbs.rtpus,
        machines=machines or {},
        keeper=files.sbs.keeper,
        alone=files.sbs.alone,
        strict=files.sbs.strict,
        producers=files.producers(),
        core=core,
    )
    return legality.judge(empty, legality.job(tasks))


def planned_tasks(
    files: Files, host: str, *, code: bool = True
) -> tuple[list[legality.Task], Findings]:
    """Return the tasks of a job whose parts can be read, and the faults of the others.

    Args:
        files: Its files.
        host: The machine whose saved profiles are used.
        code: Import the modules, and compare the files with them.
    """
    job = files.read_job()
    found = Findings(file=job.file, kind="job")
    _take(
        found, legality.check_conditions([*job.pre, *job.post], files.table.variables)
    )
    if job.cost:
        _take(found, legality.check_cost(job.cost, files.table.variables))
    tasks: list[legality.Task] = []
    lines = [line for task in job.tasks for line in _lines(task)]
    for wanted, original in lines:
        try:
            rmod = files.rmod(wanted.rmod, wanted.freq).record
            info = _described(rmod, files.library) if code else None
        except PbonetError as error:
            error.where = error.where or str(wanted.place or job.file)
            found.errors.append(error.to_wire())
            continue
        rtpu = wanted.rtpu or rmod.rtpu or files.sbs.rtpus[0].name
        if original:
            home = next((t.rtpu for t in tasks if t.name == original), rtpu)
            rtpu = rmod.rtpu or home
        saved, note = files.profiles.find(rmod, host, info)
        found.warnings += [note] if note else []
        task = legality.Task(
            rmod=rmod,
            info=info,
            rtpu=rtpu,
            freq=wanted.freq,
            job_places=wanted.job_places,
            fallback_of=original,
            takeover=wanted.takeover,
            restart=wanted.restart,
        )
        tasks.append(with_times(task, saved))
    found.warnings += unused(files.profiles, tasks, host)
    return tasks, found


def _described(rmod: Rmod, library: Library) -> ModuleInfo:
    """Import the module of an RMOD, decode its parameters, and describe it."""
    loaded = library.load_rmod(rmod)
    decode_params(loaded.cls, rmod.settings, where=_local(rmod))
    return loaded.info


def _lines(task: JobTask) -> list[tuple[JobTask, str]]:
    """Return what a TASK line makes: its task, and perhaps a standby for that."""
    made = [(structs.replace(task, takeover=0.0), "")]
    if task.fallback is not None:
        standby = JobTask(
            rmod=task.fallback,
            takeover=task.takeover,
            restart=task.restart,
            place=task.place,
        )
        made.append((standby, task.rmod))
    return made


def _check_job(found: Findings, files: Files, host: str, *, code: bool = True) -> None:
    """Judge a job as its start would be judged."""
    verdict, parts = planned(files, host, code=code)
    found.errors += parts.errors
    found.warnings += parts.warnings
    if verdict is not None:
        found.rtpus = legality.report(verdict.after)
        _take(found, verdict.problems)


def sequence_findings(
    files: Files, host: str = "", *, code: bool = True, outside: bool = False
) -> Findings:
    """Return the faults of a sequence: of its jobs, and of how they follow each other.

    Args:
        files: The files of the subsystem, with the sequence.
        host: The machine whose saved profiles are used; this one if empty.
        code: Import the modules, and compare the files with them.
        outside: Read files outside the sequence's folder if a line names one.
    """
    seq = files.seq
    if seq is None:
        raise TypeError(files.path)
    about = f"sequence {seq.name} of {len(seq.steps)} steps"
    found = Findings(file=seq.file, kind="seq", about=about)
    _check_sequence(found, files, host or here(), code=code, outside=outside)
    return found


def _check_sequence(
    found: Findings, files: Files, host: str, *, code: bool, outside: bool
) -> None:
    from .check_sequence import SequenceCheck, StepJob

    def judged(path: str) -> StepJob:
        mine = Files(path, files.library, outside=outside, code=code)
        verdict, parts = planned(mine, host, code=code)
        found.errors += [one for one in parts.errors if one not in found.errors]
        found.warnings += [t for t in parts.warnings if t not in found.warnings]
        tasks: Sequence[legality.Task] = ()
        if verdict is not None:
            problems = Findings(file=path, kind="job")
            _take(problems, [p for p in verdict.problems if not check.gives(p)])
            found.errors += [e for e in problems.errors if e not in found.errors]
            told = set(found.warnings)
            found.warnings += [t for t in problems.warnings if t not in told]
            tasks = verdict.after.tasks
        return StepJob(mine.read_job(), tuple(tasks) if verdict else None)

    def module(name: str) -> ModuleInfo | None:
        rmod = files.rmod(name).record
        return _described(rmod, files.library) if code else None

    check = SequenceCheck(files, judged, module)
    check.run()
    found.errors += [one.to_wire() for one in check.errors]
    found.errors += [legality.as_error([one]).to_wire() for one in check.problems]
    found.warnings += check.warnings
    found.notes += check.notes


def _take(found: Findings, problems: Sequence[legality.Problem]) -> None:
    for problem in problems:
        if problem.severity is legality.Severity.REFUSE:
            found.errors.append(legality.as_error([problem]).to_wire())
        else:
            found.warnings.append(legality.as_text(problem))
