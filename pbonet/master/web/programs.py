"""Programs of jobs on the page: read, checked, saved and run (section 4.4.3)."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from pbonet.config import SeqFile, load, parse_seq, read_job, rewrite_seq
from pbonet.errors import PbonetError, ProtocolError, StateError, did_you_mean
from pbonet.master.configuration import Files, sequence_findings
from pbonet.master.console import Port
from pbonet.master.editing import SavedFiles
from pbonet.master.subsystem import Sequencer, Subsystem
from pbonet.master.tools import export_program
from pbonet.xm.net import check_name

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pbonet.config import Library, Rewritten
    from pbonet.master.configuration import Place
    from pbonet.master.subsystem import SequenceState

    Data = dict[str, Any]

_END_TIME: Final = 60.0
"""Seconds that a program has to reach its safe job when the server ends."""


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
        self._place = place
        self._library = library
        self._told = told
        self._disk = SavedFiles()
        self._running: _Run | None = None
        self.does: dict[str, Callable[[Data], Data]] = {
            "list": self._list,
            "open": self._open,
            "check": self._check,
            "save": self._save,
            "export": self._export,
            "run": self._run,
            "pause": lambda _: self._steer("pause"),
            "resume": lambda _: self._steer("resume"),
            "step": lambda _: self._steer("step"),
            "abort": lambda _: self._steer("abort"),
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
        return {
            "programs": found,
            "jobs": [self._job(name) for name in self._files.jobs()],
            "sbs": self._files.path.name,
        }

    def _job(self, name: str) -> Data:
        """Return what an icon shows of a job; its fault if it cannot be read."""
        data: Data = {"name": name, "desc": "", "pre": [], "post": [], "fault": ""}
        try:
            job = read_job(self._files.path.with_name(f"{name}.job"))
        except PbonetError as error:
            return data | {"fault": str(error)}
        return data | {
            "desc": job.desc,
            "pre": [one.text for one in job.pre],
            "post": [one.text for one in job.post],
            "tasks": [one.rmod for one in job.tasks],
        }

    def _path(self, args: Data) -> Path:
        name = check_name("a program", str(args.get("name", "")))
        return self._files.path.with_name(f"{name}.seq")

    def _open(self, args: Data) -> Data:
        path = self._path(args)
        files = Files(path, self._library)
        self._disk = SavedFiles()
        self._disk.note(path)
        return self._judged(files)

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

    def _given(self, args: Data) -> tuple[Path, Rewritten]:
        """Return the file of a program, and its text as the page has it.

        Raises:
            ProtocolError: It is no program.
            ConfigError: No file can say it.
        """
        path = self._path(args)
        try:
            given = {"file": str(path), "sbs": self._files.path.name}
            seq = msgspec.convert({**args.get("seq", {}), **given}, SeqFile)
        except (msgspec.ValidationError, TypeError) as error:
            raise ProtocolError(
                "this is no program", where=path.name, got=str(error)[:200]
            ) from None
        self._disk.note(path)
        before = load(path) if path.is_file() else ""
        return path, rewrite_seq(before, seq)

    def _check(self, args: Data) -> Data:
        path, new = self._given(args)
        files = Files(path if path.is_file() else self._files.path, self._library)
        files.seq = parse_seq(new.text, str(path))
        return self._judged(files) | {"text": new.text, "comments": new.comments}

    def _save(self, args: Data) -> Data:
        path, new = self._given(args)
        written = self._disk.save({path: new.text}, path)
        return {"written": [str(one) for one in written], "comments": new.comments}

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

    def _steer(self, what: str) -> Data:
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
        arguments = place.arguments | {"take_over": False, "confirm": None}
        self._subsystem = Subsystem(
            path, **arguments, kind="web-operator", warned=_unsaid
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
        return {"kind": "program", "program": self.name, "state": state}

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def end(self) -> None:
        """Lead it to its safe job, and wait until it is there."""
        if self._thread.is_alive():
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
