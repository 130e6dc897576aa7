"""Saved execution profiles: measured execution times, kept for later starts.

A profile stands in ``profiles/HOST/RMOD.json`` beside the ``.sbs`` file: a time is
valid on the machine where it was measured. It names the module, its version, and a
digest of the configuration that the module had; where one of them is another today, the
profile is reported and not used (Stewart 1994, section 6.7).
"""

from __future__ import annotations

import os
from collections import Counter
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import msgspec
from msgspec import Struct, structs

from pbonet.analysis import legality
from pbonet.analysis.schedule import BINS, Profile, effective_time
from pbonet.errors import ConfigFileError, StateError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from pbonet.config import Rmod, SvarFile
    from pbonet.pbo import ModuleInfo
    from pbonet.xm.net import TaskProfile

FOLDER = "profiles"
ENOUGH = 100
"""Cycles from which on a profile says something."""
FORMAT = 1
RUNS = 16
"""Number of runs kept separately; older ones are combined."""
Bins: TypeAlias = tuple[tuple[int, int], ...]


class Run(Struct, frozen=True, kw_only=True):
    """Measured execution times of one process of a task; seconds."""

    tid: int
    """The process; 0 for several runs joined."""
    when: str
    cycles: int
    least: float
    most: float
    mean: float
    bins: Bins

    def continues(self, earlier: Run) -> bool:
        """Return whether this is a later profile of the same process."""
        now = dict(self.bins)
        return self.tid == earlier.tid != 0 and all(
            now.get(index, 0) >= count for index, count in earlier.bins
        )


def joined(runs: Sequence[Run]) -> Run:
    """Combine several runs: extremes, sums, the mean of all cycles."""
    bins: Counter[int] = Counter()
    for run in runs:
        bins.update(dict(run.bins))
    cycles = sum(run.cycles for run in runs)
    return Run(
        tid=runs[0].tid if len(runs) == 1 else 0,
        when=runs[-1].when,
        cycles=cycles,
        least=min(run.least for run in runs),
        most=max(run.most for run in runs),
        mean=sum(run.mean * run.cycles for run in runs) / cycles,
        bins=tuple(sorted(bins.items())),
    )


class Saved(Struct, frozen=True, kw_only=True):
    """One saved profile; times in seconds."""

    format: int = FORMAT
    rmod: str
    module: str
    version: str
    """Hash of the module's source."""
    setup: str
    """Digest of what the module was configured with; see `setup_of`."""
    host: str
    rtpu: str
    when: str
    """When it was saved, for people."""
    hz: float
    cycles: int
    least: float
    most: float
    mean: float
    bins: Bins
    """Bins of `pbonet.analysis.schedule.histogram` and how many cycles each counts."""
    runs: tuple[Run, ...] = ()
    """The runs that the figures above are joined from, in the order of saving."""

    def behind(self, earlier: Saved) -> Saved:
        """Return this profile of one run together with those saved before."""
        runs = list(earlier.runs or [_run_of(earlier)])
        if self.runs[0].continues(runs[-1]):
            runs.pop()
        runs += self.runs
        if len(runs) > RUNS:
            runs[:2] = [joined(runs[:2])]
        every = structs.asdict(joined(runs))
        del every["tid"]
        return structs.replace(self, runs=tuple(runs), **every)

    @property
    def profile(self) -> Profile:
        """The execution profile Psi(t)."""
        return profile_of(self.bins, self.most)


def _run_of(saved: Saved) -> Run:
    """Return the only run of a profile that names none."""
    names = {*Run.__struct_fields__} - {"tid"}
    return Run(tid=0, **{name: getattr(saved, name) for name in names})


@lru_cache(maxsize=256)
def profile_of(bins: tuple[tuple[int, int], ...], most: float) -> Profile:
    """Return the execution profile that bins and the longest cycle give.

    Raises:
        ValueError: Nothing was counted, or a bin is none.
    """
    counts = [0] * BINS
    for index, count in bins:
        if not 0 <= index < BINS or count < 0:
            msg = f"there is no bin {index} with {count} cycles"
            raise ValueError(msg)
        counts[index] = count
    return effective_time.from_histogram(counts, worst_ns=round(most * 1e9))


def here() -> str:
    """Return this machine's name as its agents report it."""
    return os.uname().nodename


def setup_of(rmod: Rmod, table: SvarFile) -> str:
    """Return a digest of all that decides how long a module's cycle takes.

    That is the module, its parameters, and the types and sizes of its variables; not
    how often it runs and what is declared about its times.
    """
    sizes = {v.name: (v.type, v.nelem) for v in table.variables}
    ports = (*rmod.inconst, *rmod.outconst, *rmod.invar, *rmod.outvar)
    what = (
        rmod.module,
        sorted((key, line.words) for key, line in rmod.settings.items()),
        sorted((port, sizes.get(rmod.svar_name(port))) for port in ports),
    )
    import hashlib  # only where profiles are saved

    return hashlib.sha256(msgspec.json.encode(what)).hexdigest()[:16]


class Store:
    """The saved profiles of a subsystem.

    Args:
        sbs: Its ``.sbs`` file; the folder is beside it.
        table: Its table, for the sizes of variables.
    """

    def __init__(self, sbs: Path, table: SvarFile) -> None:
        self.folder = sbs.parent / FOLDER
        self._table = table

    def hosts(self, rmod: str) -> list[str]:
        """Return the machines on which an RMOD was measured, sorted."""
        return sorted(p.parent.name for p in self.folder.glob(f"*/{rmod}.json"))

    def measured(self) -> dict[str, list[str]]:
        """Return the RMODs that were measured, by machine."""
        found: dict[str, list[str]] = {}
        for path in sorted(self.folder.glob("*/*.json")):
            found.setdefault(path.parent.name, []).append(path.stem)
        return found

    def find(
        self, rmod: Rmod, host: str, info: ModuleInfo | None
    ) -> tuple[Saved | None, str]:
        """Return the profile of an RMOD on a machine, and the message about it.

        Args:
            rmod: The RMOD as it is today.
            host: The machine.
            info: Its present module; None if that is not known.
        """
        path = self.folder / host / f"{rmod.name}.json"
        if not path.is_file():
            return None, ""
        try:
            saved = read(path)
        except ConfigFileError as error:
            return None, f"{error}; it is not used"
        change = ""
        if saved.setup != setup_of(rmod, self._table):
            change = "with another module, other parameters or other variables"
        elif info is not None and saved.version != info.version:
            change = f"with version {saved.version} of its module, now {info.version}"
        if change:
            return None, (
                f"{path}: {rmod.name} was measured {change}; the profile is not used, "
                "measure again"
            )
        return saved, ""

    def keep(
        self, found: TaskProfile, rmod: Rmod, *, host: str, when: str
    ) -> tuple[Saved, Path]:
        """Add a task's profile to the saved one; return the result and its file.

        Runs of the same module with the same configuration on the same machine count
        together. A later profile of a process replaces an earlier one.

        Raises:
            StateError: It has counted too few cycles.
            ConfigFileError: The file cannot be written.
        """
        saved = self.saved(found, rmod, host=host, when=when)
        path = self.folder / host / f"{rmod.name}.json"
        earlier, _ = self.find(rmod, host, None)
        if earlier is not None and earlier.version == saved.version:
            saved = saved.behind(earlier)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            new = path.with_suffix(".new")
            data = msgspec.json.encode(saved)
            new.write_bytes(msgspec.json.format(data, indent=1) + b"\n")
            new.replace(path)
        except OSError as error:
            raise ConfigFileError(
                f"the profile of {rmod.name} cannot be saved",
                where=str(path),
                got=error.strerror or str(error),
                remedy="make the folder writable",
            ) from None
        return saved, path

    def saved(self, found: TaskProfile, rmod: Rmod, *, host: str, when: str) -> Saved:
        """Return what would be saved of a task's profile.

        Raises:
            StateError: It has counted too few cycles.
        """
        status = found.status
        cycles = sum(count for _, count in found.cpu)
        if cycles < ENOUGH:
            raise StateError(
                f"{status.task} has not run long enough to be measured",
                where=f"{status.rtpu}/{status.task}",
                expected=f"at least {ENOUGH} cycles since it was spawned",
                got=f"{cycles} cycles",
                remedy="let it run longer",
            )
        run = Run(
            tid=status.tid,
            when=when,
            cycles=cycles,
            least=found.least,
            most=found.most,
            mean=status.tot_c / status.cycle if status.cycle else 0.0,
            bins=tuple(found.cpu),
        )
        return Saved(
            rmod=rmod.name,
            module=status.module,
            version=status.version,
            setup=setup_of(rmod, self._table),
            host=host,
            rtpu=status.rtpu,
            when=when,
            hz=status.ref_f,
            cycles=run.cycles,
            least=run.least,
            most=run.most,
            mean=run.mean,
            bins=run.bins,
            runs=(run,),
        )


def read(path: Path) -> Saved:
    """Return a saved profile.

    Raises:
        ConfigFileError: It cannot be read, or is none.
    """
    try:
        saved = msgspec.json.decode(path.read_bytes(), type=Saved)
        if saved.format != FORMAT:
            msg = f"format {saved.format}, this pbonet knows {FORMAT}"
            raise ValueError(msg)  # noqa: TRY301 - told as all that is wrong with it
        _ = saved.profile
    except (OSError, ValueError) as error:
        raise ConfigFileError(
            "this is not a saved profile",
            where=str(path),
            got=str(error),
            remedy="remove it, or save it again by 'pbonet profile --save'",
        ) from None
    return saved


def with_times(task: legality.Task, saved: Saved | None) -> legality.Task:
    """Return a task with its measured times; the RMOD's own times take precedence."""
    if saved is None:
        return task
    return structs.replace(
        task, minc=saved.least, maxc=saved.most, profile=saved.profile
    )


def unused(store: Store, tasks: Iterable[legality.Task], host: str) -> list[str]:
    """Return the note about profiles measured on other machines only."""
    found: dict[str, list[str]] = {}
    for task in tasks:
        if task.worst is None:
            for other in store.hosts(task.rmod.name):
                if other != host:
                    found.setdefault(other, []).append(task.name)
    return [_elsewhere(names, other, host) for other, names in found.items()]


def _elsewhere(names: Sequence[str], other: str, host: str) -> str:
    return (
        f"{', '.join(names)} was measured on {other} and not on {host}; '--host "
        f"{other}' judges with those times"
    )
