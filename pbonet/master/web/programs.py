"""Programs of jobs on the page: read, checked, saved and run (section 4.4.3)."""

from __future__ import annotations

import hashlib
import threading
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
from msgspec import structs

from pbonet.config import SeqFile, load, parse_seq, read_job, rewrite_seq
from pbonet.errors import (
    ConfigError,
    ConfigFileError,
    PbonetError,
    ProtocolError,
    StateError,
    did_you_mean,
)
from pbonet.master.configuration import Files, sequence_findings
from pbonet.master.console import Port
from pbonet.master.editing import SavedFiles
from pbonet.master.subsystem import Sequencer, Subsystem
from pbonet.master.tools import export_program
from pbonet.pbo import PREDEFINED
from pbonet.xm.net import check_name, convert

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pbonet.config import Library
    from pbonet.master.configuration import Place
    from pbonet.master.subsystem import SequenceState

    Data = dict[str, Any]

_END_TIME: Final = 60.0
"""Seconds that a program has to reach its safe job when the server ends."""
STEERING: Final = frozenset({"pause", "resume", "step", "abort"})
"""The requests that wait for no other one."""


class _Given(NamedTuple):
    """A program as a page has it."""

    path: Path
    before: str
    """The text of its file; empty: there is none."""
    text: str
    """The text that its file would have."""
    comments: bool
    """Whether the comments of lines that stay are kept."""

    @property
    def lost(self) -> list[str]:
        """The comments that its file would not have any more."""
        kept = _comments(self.text)
        return [one for one in _comments(self.before) if one not in kept]


class Programs:
    """The ``.seq`` files beside a subsystem's ``.sbs`` file, and the one that runs.

    While one runs, this process is the subsystem's master: verbs and the page's own
    commands go through it. When it has ended the tasks of its last job continue.

    Args:
        path: The ``.sbs``, ``.job`` or ``.seq`` file with which the page was opened.
        place: Where the subsystem is.
        library: The library for modules.
        told: Called with each new state of the program that runs.
    """

    def __init__(
        self,
        path: str | Path,
        place: Place,
        library: Library,
        told: Callable[[Data], None],
    ) -> None:
        self._files = Files(path, library)
        self._opened = Path(path).stem if Path(path).suffix == ".seq" else ""
        self._place = place
        self._library = library
        self._told = told
        self._running: _Run | None = None
        self.does: dict[str, Callable[[Data], Data]] = {
            "list": self._list,
            "open": self._open,
            "check": self._check,
            "save": self._save,
            "export": self._export,
            "run": self._run,
            **{name: partial(self._steer, name) for name in STEERING},
        }

    def do(self, name: str, args: Mapping[str, Any]) -> Data:
        """Carry out one request.

        Args:
            name: ``list open check save export run pause resume step abort``.
            args: ``name`` of the program; and ``seq`` for those that take its content,
                as `pbonet.config.SeqFile` in JSON.

        Returns:
            What was asked for.

        Raises:
            PbonetError: It is refused.
        """
        does = self.does.get(name)
        if does is None:
            raise ProtocolError(
                f"there is nothing to do with a program called {name[:40]}",
                expected=" ".join(self.does),
                remedy=did_you_mean(name, self.does),
            )
        return does(dict(args))

    @property
    def state(self) -> Data | None:
        """The state of the program that runs, or ran last."""
        return self._running.message if self._running else None

    def close(self) -> None:
        """Lead a program that runs to its safe job, and leave the subsystem."""
        if self._running is not None:
            self._running.end()

    # -- files ------------------------------------------------------------------------

    def _list(self, _: Data) -> Data:
        folder = self._files.path.parent
        found = sorted(path.stem for path in folder.glob("*.seq"))
        jobs = [self._job(name) for name in self._files.jobs()]
        tasks = {task for job in jobs for task in job["tasks"]}
        tasks |= {path.stem for path in folder.glob("*.rmod")}
        return {
            "programs": found,
            "opened": self._opened,
            "jobs": jobs,
            "tasks": {name: self._task(name) for name in sorted(tasks)},
            "signals": list(PREDEFINED),
            "variables": [one.name for one in self._files.table.variables],
            "rtpus": [one.name for one in self._files.sbs.rtpus],
            "sbs": self._files.path.name,
        }

    def _job(self, name: str) -> Data:
        """Return what an icon shows of a job; its fault if it cannot be read."""
        data: Data = {"name": name, "desc": "", "pre": [], "post": [], "fault": ""}
        try:
            job = read_job(self._files.path.with_name(f"{name}.job"))
        except PbonetError as error:
            return data | {"tasks": [], "fault": str(error)}
        return data | {
            "desc": job.desc,
            "pre": [one.text for one in job.pre],
            "post": [one.text for one in job.post],
            "tasks": [one.rmod for one in job.tasks],
        }

    def _task(self, name: str) -> Data:
        """Return the own signals and the parameters of a task; none if it is faulty."""
        try:
            info = self._library.load_rmod(self._files.rmod(name).record).info
        except PbonetError:  # a check of a job that has it says so
            return {"signals": [], "params": []}
        return {
            "signals": [one.name for one in info.signals],
            "params": [one.name for one in info.params],
        }

    def _path(self, args: Data) -> Path:
        name = check_name("a program", str(args.get("name", "")))
        return self._files.path.with_name(f"{name}.seq")

    def _open(self, args: Data) -> Data:
        path = self._path(args)
        base = _digest(path)
        return self._judged(Files(path, self._library)) | {"base": base}

    def _judged(self, files: Files) -> Data:
        seq = files.seq
        found = sequence_findings(files)
        return {
            "seq": msgspec.to_builtins(seq),
            "errors": [str(PbonetError.from_wire(error)) for error in found.errors],
            "warnings": found.warnings,
            "notes": found.notes,
            "about": found.about,
        }

    def _seq(self, args: Data) -> tuple[Path, SeqFile]:
        """Return a program as a page has it.

        Raises:
            ProtocolError: It is none.
        """
        path = self._path(args)
        try:
            given = {"file": str(path), "sbs": self._files.path.name}
            seq = convert({**args.get("seq", {}), **given}, SeqFile)
        except (msgspec.ValidationError, TypeError) as error:
            raise ProtocolError(
                "this is no program",
                where=path.name,
                got=str(error)[:200],
                remedy="see docs/web.md for its form",
            ) from None
        return path, seq

    def _given(self, args: Data) -> _Given:
        """Return the file of a program, and its text as the page has it.

        Raises:
            ProtocolError: It is no program.
            ConfigError: No file can say it.
        """
        path, seq = self._seq(args)
        before = load(path) if path.is_file() else ""
        try:
            new = rewrite_seq(before, seq)
        except ConfigError as error:
            cause = error.__cause__  # what a reader of its text would say
            raise (cause if isinstance(cause, ConfigError) else error) from None
        return _Given(path, before, new.text, new.comments)

    def _check(self, args: Data) -> Data:
        path, seq = self._seq(args)
        try:
            given = self._given(args)
        except ConfigError as error:
            return {
                "seq": None,
                "first": _head_lines(seq) + 1,
                "errors": [str(error)],
                "warnings": [],
                "notes": [],
                "about": f"sequence {seq.name} of {len(seq.steps)} steps",
            }
        files = Files(path if path.is_file() else self._files.path, self._library)
        files.seq = parse_seq(given.text, str(path))
        kept = {"text": given.text, "comments": given.comments, "lost": given.lost}
        return self._judged(files) | kept

    def _save(self, args: Data) -> Data:
        given = self._given(args)
        if _digest(given.path) != args.get("base", ""):
            raise ConfigFileError(
                "another program, or another browser, changed the file since it was "
                "opened: nothing is saved",
                where=str(given.path),
                expected="the file as it was read",
                remedy="open the program again and repeat the changes",
            )
        disk = SavedFiles()
        disk.note(given.path)
        written = disk.save({given.path: given.text}, given.path)
        return {
            "written": [str(one) for one in written],
            "comments": given.comments,
            "lost": given.lost,
            "base": _digest(given.path),
        }

    def _export(self, args: Data) -> Data:
        path = self._path(args)
        files = Files(path, self._library)
        if files.seq is None:
            raise AssertionError
        target = path.with_suffix(".py")
        text = export_program.program_text(files.seq, target)
        return {"file": target.name, "text": text}

    # -- the one that runs ------------------------------------------------------------

    def _run(self, args: Data) -> Data:
        if self._running is not None and not self._running.ended:
            raise StateError(
                "a program runs already",
                got=self._running.name,
                remedy="abort it first",
            )
        run = _Run(self._path(args), self._place, self._told)
        if args.get("paused"):
            run.sequencer.pause()
        self._running = run
        run.start()
        return {"state": run.message}

    def _steer(self, what: str, _: Data) -> Data:
        run = self._running
        if run is None or run.ended:
            raise StateError("no program runs", remedy="run one first")
        getattr(run.sequencer, what)()
        return {"state": run.message}


class _Run:
    """A program while it runs.

    Args:
        path: The ``.seq`` file.
        place: Where the subsystem is.
        told: Called with each new state.

    Raises:
        PbonetError: A file is wrong, or the subsystem has another master.
    """

    def __init__(self, path: Path, place: Place, told: Callable[[Data], None]) -> None:
        self.name = path.stem
        self.ended = False
        self._tell = told
        place = structs.replace(place, take_over=False, confirm=None)
        self._subsystem = Subsystem(
            path, **place.arguments, kind="web-operator", warned=_unsaid
        )
        self._subsystem.open()
        try:
            self._port = Port(
                self._subsystem, self._subsystem.name, handover=False, told=_unsaid
            )
            self.sequencer = Sequencer(self._subsystem, told=self._send_state)
            self._port.open()
        except BaseException:
            self._subsystem.detach()
            raise
        self._thread = threading.Thread(target=self._run, name="program", daemon=True)

    @property
    def message(self) -> Data:
        """Its state as a message for browsers."""
        state = msgspec.to_builtins(self.sequencer.state)
        if state["since"]:
            state["since"] += time.time() - self._subsystem.clock.now()  # Unix time
        return {"kind": "program", "program": self.name, "state": state}

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def end(self) -> None:
        """Lead it to its safe job, and wait until it is there."""
        if not self._thread.is_alive():
            return
        if not self.sequencer.state.safe:  # a second abort would end the way there
            self.sequencer.abort("the page's server ends")
        self._thread.join(_END_TIME)

    def _send_state(self, _: SequenceState) -> None:
        self._tell(self.message)

    def _run(self) -> None:
        try:
            self.sequencer.run()
        except PbonetError:
            pass  # the last state says it
        finally:
            self.ended = True
            self._port.close()
            self._subsystem.detach()
            self._tell(self.message)


def _unsaid(_: str) -> None:
    """Leave out a warning: the state of the program says what went wrong."""


def _digest(path: Path) -> str:
    """Return what tells one content of a file from another; empty: it is not there."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def _comments(text: str) -> list[str]:
    found = [line.partition("#")[2].strip() for line in text.splitlines()]
    return [one for one in found if one]


def _head_lines(seq: SeqFile) -> int:
    """Return how many lines a newly written file has before the program's own."""
    return 3 + sum((seq.safe is not None, bool(seq.wait), seq.within is not None))
