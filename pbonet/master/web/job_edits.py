"""The job that is edited on the page: one for all browsers (section 4.4.3)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec

from pbonet.errors import ConfigError, ProtocolError, did_you_mean
from pbonet.master.configuration import Files
from pbonet.master.editing import EDITS, JobEditor, Offer
from pbonet.xm.net import check_name, convert

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pbonet.config import Library
    from pbonet.master.editing import DraftSimulation

    Data = dict[str, Any]

_SIMULATED: Final = 20.0
"""Seconds of virtual time that a page may have simulated at once."""
_LIMIT: Final = 60.0
"""Seconds that it may take."""
BESIDE: Final = ("simulate", "cancel")
"""Edits that keep no others waiting, and are no business of `JobEdits.do`."""
_SEARCHED: Final = {
    "class": "module_class",
    "in": "reads",
    "out": "writes",
    "unit": "unit",
}
"""Arguments of a search, and what `JobEditor.palette` calls them."""


class JobEdits:
    """Carries out the edits that browsers ask for, one after the other.

    Args:
        path: The ``.sbs`` or ``.job`` file with which the page was opened.
        library: The library for modules.
        told: Called with each new state of the editor.
    """

    def __init__(
        self, path: str | Path, library: Library, told: Callable[[Data], None]
    ) -> None:
        self._files = Files(path, library)
        self._library = library
        self._told = told
        self._editor: JobEditor | None = None
        self._does: dict[str, Callable[[Data], Data]] = {
            "open": self._open,
            "apply": self._apply,
            "undo": lambda _: self._now.undo(),
            "redo": lambda _: self._now.redo(),
            "palette": self._palette,
            "fitting": self._fitting,
            "changes": self._changes,
            "save": self._save,
        }
        self._simulations: list[DraftSimulation] = []
        """The ones that run or wait."""

    def do(self, name: str, args: Mapping[str, Any]) -> Data:
        """Carry out one edit, or answer a question about the job.

        Args:
            name: ``open apply undo redo palette fitting changes save``, or a change of
                `pbonet.master.editing.JobEditor.edit`.
            args: Its arguments.

        Returns:
            The new state as ``state``, or what was asked for.

        Raises:
            PbonetError: It is refused, and nothing is changed.
        """
        given = dict(args)
        if name in EDITS:
            return self._shown(self._edit(name, given))
        does = self._does.get(name)
        if does is None:
            known = [*self._does, *BESIDE, *EDITS]
            raise ProtocolError(
                f"there is no edit {name[:40]}",
                expected=" ".join(known),
                remedy=did_you_mean(name, known),
            )
        result = does(given)
        changes = name in {"open", "apply", "undo", "redo"}
        return self._shown(result) if changes else result

    @property
    def _now(self) -> JobEditor:
        if self._editor is None:
            self._open({})
        if self._editor is None:
            raise AssertionError
        return self._editor

    def _shown(self, state: Data) -> Data:
        self._told({"kind": "editor", "state": state})
        return {"state": state}

    def _edit(self, name: str, args: Data) -> Data:
        try:
            return self._now.edit(name, **args)
        except TypeError as error:
            raise ProtocolError(
                f"the arguments of {name} are wrong",
                got=str(error)[:200],
                remedy="see docs/assembling.md",
            ) from None

    def _open(self, args: Data) -> Data:
        """Open a job beside the ``.sbs`` file; one that is not there begins empty.

        Without a name it is the one that is open, with its changes. If none is, it is
        the one with which the page was opened, if any, else the first there is, else a
        new one of the subsystem's name.
        """
        if self._editor is not None and not args.get("job"):
            return self._editor.state() | {"jobs": self._files.jobs()}
        name = str(args.get("job") or self._default())
        check_name("a job", name)
        path = self._beside(name)
        folders = [*self._library.folders]
        if path.is_file():
            self._editor = JobEditor(path, folders, like=self._editor)
        else:
            self._editor = JobEditor(
                self._files.path, folders, name=name, like=self._editor
            )
        return self._editor.state() | {"jobs": self._files.jobs()}

    def _beside(self, name: str) -> Path:
        job = self._files.job
        if job is not None and Path(job.file).stem == name:
            return Path(job.file)
        return self._files.path.with_name(f"{name}.job")

    def _default(self) -> str:
        if self._files.job is not None:
            return Path(self._files.job.file).stem
        return next(iter(self._files.jobs()), self._files.sbs.subsystem)

    def _apply(self, args: Data) -> Data:
        try:
            offer = convert(args.get("offer"), Offer)
        except msgspec.ValidationError as error:
            raise ProtocolError(
                "this is no offer",
                got=str(error)[:200],
                remedy="send one of the state's offers as it is",
            ) from None
        return self._now.apply(offer)

    def _palette(self, args: Data) -> Data:
        """Search the library as the command of that name does, without any agent."""
        words = str(args.get("text", "")).split()
        wanted = {key: str(args.get(key, "")) for key in _SEARCHED}
        named = {_SEARCHED[key]: text for key, text in wanted.items()}
        return {"modules": self._now.palette(*words, **named)}

    def _fitting(self, args: Data) -> Data:
        task, port = str(args.get("task", "")), str(args.get("port", ""))
        return {"fits": msgspec.to_builtins(self._now.fitting(task, port))}

    def _changes(self, _: Data) -> Data:
        return {"changes": msgspec.to_builtins(self._now.changes())}

    def _save(self, _: Data) -> Data:
        written = [str(path) for path in self._now.save()]
        state = self._now.state() | {"jobs": self._files.jobs()}
        return self._shown(state) | {"written": written}

    def simulation(self, args: Mapping[str, Any]) -> Callable[[], Data]:
        """Return what runs the present state in virtual time, in any thread.

        Args:
            args: ``seconds``, and ``variables`` whose values are returned.

        Raises:
            PbonetError: It is refused.
        """
        seconds, names = args.get("seconds", 2.0), args.get("variables", [])
        if not isinstance(seconds, int | float) or not 0 < seconds <= _SIMULATED:
            raise ConfigError(
                "that much time is not simulated on a page",
                expected=f"more than 0 and at most {_SIMULATED:g} s",
                got=str(seconds)[:40],
                remedy="'pbonet run FILE.job --sim' has no such limit",
            )
        if not isinstance(names, list):
            raise ProtocolError(
                "the variables to record are no list",
                got=str(names)[:40],
                remedy="send a list of their names",
            )
        wanted = [str(name) for name in cast("list[object]", names)]
        simulation = self._now.simulation(float(seconds))
        self._simulations.append(simulation)

        def run() -> Data:
            try:
                result = simulation.run(wanted, limit=_LIMIT)
            finally:
                self._simulations.remove(simulation)
            return {"run": msgspec.to_builtins(result)}

        return run

    def cancel(self) -> None:
        """End all simulations, from any thread."""
        for simulation in [*self._simulations]:
            simulation.cancel()
