"""The desired state of an RTPU, kept by its agent for the loss of the RTPU process.

Of each subsystem the last request of each kind is kept: its claim, how each task was
spawned, set and paired, its recording. Which of the tasks exist and which are ON is
what the RTPU process reports. The same is in a file, for the loss of the machine, with
the stop orders that are carried out and that others have still to carry out.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

import msgspec
from msgspec import Struct

from pbonet.errors import PbonetError, Severity
from pbonet.node.wire import rtpu_messages
from pbonet.xm.net import codec, messages as m, run_folder

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

    from pbonet.node.rtpu import SnapshotChanges, TaskSnapshot

log = logging.getLogger("pbonet.node")

ON: Final = "ON"
"""State of a task that has cycles."""
MOST_STOPS: Final = 64
"""Carried out stop orders that are remembered."""

OfTask: TypeAlias = m.Spawn | m.Set | m.Freq | m.Standby | m.Rank
Kept: TypeAlias = m.Record | m.Job | m.Sigmask | OfTask
_KEPT = (m.Record, m.Job, m.Sigmask, m.Spawn, m.Set, m.Freq, m.Standby, m.Rank)
Stage: TypeAlias = Literal["lost", "waits"]
"""Of a task: it is to be spawned again; it was, and waits to be turned on."""


class Subsystem(Struct, kw_only=True):
    """The desired state of one subsystem."""

    claim: m.Claim
    epoch: int
    requests: list[Kept] = []
    """In the order in which they are given again."""
    on: list[str] = []
    """Tasks that are ON, or were and are not back, in the order in which they came."""
    robots: list[str] = []
    """Tasks that are robot interfaces."""
    stages: dict[str, Stage] = {}
    """Tasks that are not back yet."""
    notes: dict[str, str] = {}
    """Why a task is not there, or not ON as it was."""
    claimed: bool = True
    """Whether the RTPU process knows the claim."""
    others: list[str] = []
    """Other RTPUs that the subsystem uses, as their agents said last."""

    def spawns(self) -> dict[str, m.Spawn]:
        """Return how each task was spawned, in that order."""
        return {
            request.task: request
            for request in self.requests
            if isinstance(request, m.Spawn)
        }

    def of(self, task: str) -> list[Kept]:
        """Return the requests about a task, its spawn first."""
        return [one for one in self.requests if _task_of(one) == task]

    def put(self, request: Kept) -> None:
        """Keep a request in place of the last one of its kind; a spawn replaces all."""
        task, key = _task_of(request), _key(request)
        begins = isinstance(request, m.Spawn)
        self.requests = [
            one
            for one in self.requests
            if _key(one) != key and not (begins and _task_of(one) == task)
        ]
        self.requests.append(request)
        if begins:
            self.clear(task)

    def clear(self, task: str) -> None:
        """Note that a task needs nothing more of its agent."""
        self.stages.pop(task, None)
        self.notes.pop(task, None)

    def stay_off(self, tasks: Collection[str]) -> None:
        """Note that tasks which are lost, or wait, are not to be turned on."""
        self.on = [one for one in self.on if one not in tasks]

    def drop(self, task: str) -> None:
        """Forget a task; why it is not there stays known."""
        self.requests = [one for one in self.requests if _task_of(one) != task]
        self.on = [one for one in self.on if one != task]
        self.stages.pop(task, None)

    def end(self) -> None:
        """Forget all tasks, and what comes with them."""
        self.requests, self.on, self.robots = [], [], []
        self.stages, self.notes = {}, {}


class StopLeft(Struct, kw_only=True):
    """A stop order that other RTPUs have not carried out."""

    id: str
    subsystem: str
    due: list[str]
    machines: dict[str, str]
    tasks: dict[str, list[str]] = {}
    """Tasks to be turned OFF, by RTPU; empty: all tasks are ended."""


class _File(Struct, kw_only=True):
    """The content of the file."""

    machine: str
    """Identity of the machine, new after each boot."""
    subsystems: msgspec.Raw
    """A dict of `Subsystem` by name, which depends on the version of the requests."""
    stops: list[str]
    orders: list[StopLeft]


class DesiredState:
    """The desired state of one RTPU.

    Args:
        path: The file; None: it is not to outlive this agent.
        note: Called with reports for masters.
        mark: What the ids of the agent's own requests begin with.
    """

    def __init__(
        self, path: Path | None, note: Callable[[rtpu_messages.Note], None], mark: str
    ) -> None:
        self._path, self._note, self._mark = path, note, mark
        self.guard = threading.RLock()
        """Held while a request is given again, so that a stop comes before or after."""
        self.subsystems: dict[str, Subsystem] = {}
        self.stops: list[str] = []
        """Stop orders that were carried out, also by RTPU processes before this one."""
        self.orders: list[StopLeft] = []
        self.orders_of: Callable[[], list[StopLeft]] = lambda: self.orders
        """Returns the stop orders that are due elsewhere."""
        self.others_of: Callable[[str], list[str]] = lambda _: []
        """Returns the other RTPUs of a subsystem."""
        self.rebooted = False
        """Whether the file was written before the machine was started."""
        self._live = False
        """Whether reports of the RTPU process are about the present one."""
        self._tasks: list[TaskSnapshot] = []
        self._tombs: set[tuple[str, str]] = set()
        """Tasks that have died, or were lost and not spawned again."""
        self._claims: set[str] | None = None
        self._machine = run_folder.machine()
        """As it was at the start: the folder may be removed meanwhile."""
        self._codec = codec.Codec()
        self._writing = threading.Lock()
        self._failed = ""
        """Why the file could not be written last time."""
        self._dirty = threading.Event()
        self._over = False
        self._thread = threading.Thread(
            target=self._work, name="pbonet state", daemon=True
        )

    # -- start and end -----------------------------------------------------------------

    def load(self) -> str:
        """Read the file; return what is wrong with it, or nothing.

        A file that cannot be read is kept beside, and has no effect.
        """
        if self._path is None:
            return ""
        try:
            found = msgspec.json.decode(self._path.read_bytes(), type=_File)
            self.stops, self.orders = found.stops, found.orders
            self.rebooted = found.machine != self._machine
            self.subsystems = msgspec.json.decode(
                found.subsystems, type=dict[str, Subsystem]
            )
        except (FileNotFoundError, NotADirectoryError):
            return ""
        except (OSError, msgspec.MsgspecError, UnicodeDecodeError) as error:
            aside = self._path.with_suffix(".bad")
            with contextlib.suppress(OSError):
                self._path.replace(aside)
            kept = " (the stops of other RTPUs were read)" if self.orders else ""
            self._dirty.set()
            return (
                f"what this RTPU was to do cannot be read: {self._path}: {error}; no "
                f"task is spawned again{kept}; the file is now {aside}"
            )
        return ""

    def begin(self, *, taken_over: bool) -> None:
        """Believe the reports of the RTPU process from now on.

        Args:
            taken_over: Whether it is the one that had the tasks already.
        """
        with self.guard:
            if not taken_over:
                self._lose()
            self._live = True
            self._settle()
        if self._path is not None and not self._thread.is_alive():
            self._thread.start()

    def lost(self) -> None:
        """Note that the RTPU process is lost, with what it had until now."""
        with self.guard:
            if self._live:
                self._live = False
                self._tasks, self._tombs, self._claims = [], set(), None
                self._lose()
        self.changed()

    def freeze(self) -> None:
        """Believe no report any more: the agent turns everything off."""
        with self.guard:
            self._live = False

    def close(self, *, keep: bool) -> None:
        """End; without `keep` only the stop orders that are due elsewhere are kept."""
        self._over = True
        self._dirty.set()
        if self._thread.is_alive():
            self._thread.join()
        with self.guard:
            if not keep:
                self.subsystems = {}
        self.write()

    def _lose(self) -> None:
        for one in self.subsystems.values():
            one.claimed = False
            one.stages = dict.fromkeys(one.spawns(), "lost")

    # -- what happens ------------------------------------------------------------------

    def done(self, request: m.AnyRequest, data: bytes) -> None:
        """Take in a request that was carried out."""
        if request.id.startswith(self._mark):
            return
        if not isinstance(request, (m.Claim, m.Release, m.CloseTable, m.Stop, *_KEPT)):
            return
        try:
            answer = self._codec.answer(data, request)
        except PbonetError:
            return
        if not answer.ok:
            return
        with self.guard:
            self._take(request, answer)
        if isinstance(request, m.Stop):
            self.write()  # before it is answered: it must outlive the machine
        else:
            self.changed()

    def _take(self, request: m.AnyRequest, answer: m.Answer) -> None:
        match request:
            case m.Claim():
                if not request.probe:
                    self._claimed(request, answer.result["epoch"])
            case m.Release() | m.CloseTable():
                self.subsystems.pop(request.subsystem, None)
            case m.Stop():
                self.ended(request.subsystem)
                self.carried_out(request.stop_id)
            case m.Rank():
                self._ranked(request)
            case _:
                kept = self.subsystems.get(request.subsystem)
                if kept is not None and isinstance(request, _KEPT):
                    kept.put(_again(request))

    def _ranked(self, request: m.Rank) -> None:
        """Keep the ranks of several tasks one by one."""
        kept = self.subsystems.get(request.subsystem)
        if kept is not None:
            spawns = kept.spawns()
            for task, rank in request.tasks.items():
                if task in spawns:
                    kept.put(msgspec.structs.replace(request, tasks={task: rank}))

    def _claimed(self, claim: m.Claim, epoch: int) -> None:
        claim = msgspec.structs.replace(claim, take_over=False)
        kept = self.subsystems.get(claim.subsystem)
        if kept is None:
            self.subsystems[claim.subsystem] = Subsystem(claim=claim, epoch=epoch)
            return
        if not claim.svar:
            for name in ("svar", "svar_name", "keep", "keeper", "alone"):
                setattr(claim, name, getattr(kept.claim, name))
        if epoch != kept.epoch:  # what another master starts is not disturbed
            kept.stay_off(kept.stages)
        kept.claim, kept.epoch = claim, epoch

    def ended(self, subsystem: str) -> None:
        """Take in a stop; empty: of every subsystem. Its tasks are not given again."""
        with self.guard:
            for name, kept in self.subsystems.items():
                if subsystem in {"", name}:
                    kept.end()

    def replaced(self, subsystem: str, tasks: Collection[str]) -> None:
        """Take in that others are in the place of tasks: these are not turned on."""
        with self.guard:
            kept = self.subsystems.get(subsystem)
            if kept is not None:
                kept.stay_off(tasks)

    def carried_out(self, stop_id: str) -> None:
        """Remember a stop order that was carried out."""
        if stop_id and stop_id not in self.stops:
            self.stops = [*self.stops[1 - MOST_STOPS :], stop_id]

    def learn(self, news: SnapshotChanges) -> None:
        """Take in a report of the RTPU process."""
        with self.guard:
            if news.tasks is not None:
                self._tasks = news.tasks
            if news.tombs is not None:
                self._tombs = {(subsystem, one.task) for subsystem, one in news.tombs}
            if news.claims is not None:
                self._claims = {entry.subsystem for entry in news.claims}
            if self._live and (news.tasks, news.tombs, news.claims) != (None,) * 3:
                self._settle()

    def _settle(self) -> None:
        """Bring what is kept in line with the tasks that there are."""
        before = [(len(one.requests), one.on) for one in self.subsystems.values()]
        for name, kept in list(self.subsystems.items()):
            if self._claims is None:
                continue
            if kept.claimed and name not in self._claims:
                del self.subsystems[name]
                continue
            tasks = {one.task: one for one in self._tasks if one.subsystem == name}
            for task in kept.spawns():
                if task not in tasks and kept.stages.get(task) != "lost":
                    kept.drop(task)
            _note_states(kept, tasks)
            for task in kept.notes.keys() - tasks.keys() - kept.stages.keys():
                if kept.claimed and (name, task) not in self._tombs:
                    del kept.notes[task]
        if before != [(len(one.requests), one.on) for one in self.subsystems.values()]:
            self.changed()

    def note_lost(self, text: str) -> None:
        """Note why tasks are not there that are to be spawned again."""
        with self.guard:
            for kept in self.subsystems.values():
                lost = [task for task, stage in kept.stages.items() if stage == "lost"]
                kept.notes |= dict.fromkeys(lost, text)

    def exists(self, subsystem: str, task: str) -> bool:
        """Return whether the RTPU process has a task, by its last report."""
        with self.guard:
            return any(
                (one.subsystem, one.task) == (subsystem, task) for one in self._tasks
            )

    def notes(self, subsystem: str) -> dict[str, str]:
        """Return what was done for lost tasks; empty name: of all subsystems."""
        with self.guard:
            return {
                task: text
                for name, kept in self.subsystems.items()
                if subsystem in {"", name}
                for task, text in kept.notes.items()
            }

    # -- the file ----------------------------------------------------------------------

    def changed(self) -> None:
        """Let the file be written again, soon."""
        self._dirty.set()

    def _work(self) -> None:
        while not self._over:
            self._dirty.wait()
            self._dirty.clear()
            if not self._over:
                self.write()

    def write(self) -> None:
        """Write the file, whole or not at all; with nothing to say there is none.

        Where it cannot be written the one from before goes, too: it may say that a task
        is to be ON which was stopped since.
        """
        if self._path is None:
            return
        with self._writing:
            before = self._failed
            self._failed = self._try_to_write(self._path, self._content())
            if self._failed and not before:
                log.error("%s", self._failed)
                error = int(Severity.ERROR)
                note = rtpu_messages.Note(error, "STATE_NOT_KEPT", self._failed)
                self._note(note)

    def _try_to_write(self, path: Path, data: bytes) -> str:
        """Write or remove the file; return why what it says is not true then."""
        try:
            try:
                _write(path, data)
            except OSError:
                _remove(path)  # this may make the room that was missing
                _write(path, data)
        except OSError as error:
            with contextlib.suppress(OSError):
                _remove(path)
            text = (
                "what this RTPU is to do cannot be kept for a restart of the machine: "
                f"{path}: {error.strerror or error}; set PBONET_STATE_DIR to a folder "
                "of your own, or make room there"
            )
            if path.exists():
                text += f"; remove {path}, else what it says comes back"
            return text
        return ""

    def warned(self, data: bytes) -> bytes:
        """Return the packed answer to a stop with a warning if that is not kept."""
        with self._writing:
            failed = self._failed
        if not failed:
            return data
        answer = msgspec.msgpack.decode(data, type=m.Answer)
        answer.warnings.append(failed)
        return self._codec.pack(answer)

    def _content(self) -> bytes:
        with self.guard:
            for name, kept in self.subsystems.items():
                kept.others = self.others_of(name) or kept.others
            subsystems = {n: k for n, k in self.subsystems.items() if k.spawns()}
            self.orders = self.orders_of()
            if not (subsystems or self.orders):
                return b""
            return msgspec.json.encode(
                _File(
                    machine=self._machine,
                    subsystems=msgspec.Raw(msgspec.json.encode(subsystems)),
                    stops=self.stops,
                    orders=self.orders,
                )
            )


def _write(path: Path, data: bytes) -> None:
    """Write a file and wait until it is on the disk; without data there is none."""
    if not data:
        _remove(path)
        with contextlib.suppress(OSError):  # others' files are there
            path.parent.rmdir()
        return
    fresh = path.with_suffix(".new")
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
    try:
        fd = os.open(fresh, flags, 0o600)
    except FileNotFoundError:  # no folder, or another agent has removed it
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        _synchronize(path.parent.parent)
        fd = os.open(fresh, flags, 0o600)
    with os.fdopen(fd, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(fd)
    fresh.replace(path)
    _synchronize(path.parent)


def _remove(path: Path) -> None:
    """Remove a file, and what is left of writing it, for good."""
    for one in (path.with_suffix(".new"), path):
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            one.unlink()
            _synchronize(path.parent)


def _synchronize(folder: Path) -> None:
    """Wait until the names of a folder are on the disk."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _note_states(kept: Subsystem, tasks: dict[str, TaskSnapshot]) -> None:
    """Take in which tasks are ON, and which are robot interfaces."""
    on = [task for task, one in tasks.items() if one.state == ON]
    kept.on = [t for t in kept.on if t in on or t in kept.stages]
    kept.on += [task for task in on if task not in kept.on]
    for task in on:
        kept.clear(task)
    robots = [task for task, one in tasks.items() if one.robot_interface]
    kept.robots = [*robots, *(t for t in kept.robots if t not in tasks)]


def _task_of(request: Kept) -> str:
    """Return the task that a request is about; empty: the whole subsystem."""
    if isinstance(request, m.Rank):
        return next(iter(request.tasks))
    return "" if isinstance(request, m.Record | m.Job) else request.task


def _again(request: Kept) -> Kept:
    """Return a request as it is given again, without the note of its first time."""
    if isinstance(request, m.Job):
        return msgspec.structs.replace(request, note="")
    return request


def _key(request: Kept) -> tuple[str, ...]:
    """Return what a later request must have in common to replace this one."""
    name = request.name if isinstance(request, m.Set) else ""
    return type(request).__name__, _task_of(request), name


def path_of(domain: str, rtpu: str) -> Path:
    """Return the file of an RTPU in the state folder."""
    return run_folder.state_folder() / domain / f"{rtpu}.json"
