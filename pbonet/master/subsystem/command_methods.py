"""A call for every command of the prompt (Stewart 1994, section 4.4.4).

The autonomous interface mirrors the others: what is a command there is a method of
`Subsystem` here, with the name (a blank becomes ``_``), the arguments and the refusals
of the command table. Commands of the prompt, of scripts and of the network come here
too, so that there is one place in which each is carried out.
"""

from __future__ import annotations

import fnmatch
from typing import TYPE_CHECKING, Any, Protocol, overload

from pbonet.errors import StateError, UnknownVariableError, did_you_mean
from pbonet.xm.net import messages as m

from . import profiling, remote_modules
from .argument_text import check_time, names_of
from .change_transaction import Opened
from .status_fields import Baselines, Profile, columns

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from pbonet.master.configuration import Clock, Files, Picture, Saved
    from pbonet.master.console import Command
    from pbonet.pbo import ModuleInfo

    from .task_signal_inbox import Inbox


class Calls(Opened, Protocol):
    """The part of `Subsystem` that has the commands' own names."""

    files: Files
    clock: Clock
    shown: tuple[str, ...]
    baselines: Baselines
    inbox: Inbox

    @property
    def picture(self) -> Picture:
        """Its tasks as they stood at the last look."""
        ...

    def control(self, task: str, signal: str, arg: str = "") -> m.TaskStatus:
        """Send one signal; see `Subsystem`."""
        ...

    def reconfig(self, item: Sequence[tuple[str, str]]) -> dict[str, str]:
        """Send several signals; see `Subsystem`."""
        ...

    # -- signals ----------------------------------------------------------------------

    def on(self, task: str | Iterable[str], *, text: str = "") -> dict[str, str]:
        """Send ``on`` to a task, or to several as one list judged by its end.

        Args:
            task: The tasks.
            text: For the module of one task, as its ``self.task.arg``.

        Returns:
            The states of the tasks.

        Raises:
            UnknownTaskError: There is no such task.
            StateError: The signal is not valid in a task's state.
            VerificationError: The end would be illegal; nothing was sent.
            ReconfigError: Of several, one failed.
            PbonetError: A method of the module failed.
        """
        return self._signal("on", task, text)

    def off(self, task: str | Iterable[str], *, text: str = "") -> dict[str, str]:
        """Send ``off``; as `on`, and never refused for legality."""
        return self._signal("off", task, text)

    def kill(self, task: str | Iterable[str], *, text: str = "") -> dict[str, str]:
        """Destroy tasks; as `off`."""
        return self._signal("kill", task, text)

    def clear(self, task: str | Iterable[str], *, text: str = "") -> dict[str, str]:
        """Send ``clear`` to tasks in ERROR; as `off`."""
        return self._signal("clear", task, text)

    def reinit(self, task: str | Iterable[str], *, text: str = "") -> dict[str, str]:
        """Have tasks read their constants again; as `off`."""
        return self._signal("reinit", task, text)

    def _signal(
        self, signal: str, task: str | Iterable[str], text: str
    ) -> dict[str, str]:
        tasks = names_of(task)
        if len(tasks) == 1:
            return {tasks[0]: self.control(tasks[0], signal, text).state}
        if not tasks or text:
            raise StateError(
                "a text goes to one task" if text else "no task is named",
                expected=f"{signal} TASK text=..." if text else f"{signal} TASK ...",
                got=f"{len(tasks)} tasks",
                remedy=f"give '{signal}' once for each task",
            )
        return self.reconfig([(name, signal) for name in tasks])

    # -- looking ----------------------------------------------------------------------

    @overload
    def status(self, task: str) -> m.TaskStatus: ...

    @overload
    def status(self, task: list[str] | tuple[str, ...] = ...) -> list[m.TaskStatus]: ...

    @overload
    def status(
        self, task: str | Sequence[str] = ..., *, fields: str | Sequence[str]
    ) -> list[Profile]: ...

    def status(
        self,
        task: str | Sequence[str] = (),
        *,
        fields: str | Sequence[str] | None = None,
    ) -> m.TaskStatus | list[m.TaskStatus] | list[Profile]:
        """Return the status of one task, of several, or of all (`sbsStatus`).

        Args:
            task: One task, or several; none: all.
            fields: Columns of the command ``status``, ``all`` or ``default``, or none
                for those of `status_set`. Then it is what that command shows: counters
                since the last such look of this program.

        Returns:
            Of one task its record, of several a list; counters run from when it was
            turned on.

        Raises:
            UnknownTaskError: There is no such task.
            StateError: There is no such field.
        """
        wanted = names_of(task)
        shown = columns(names_of(fields or ())) or self.shown
        found = [t for t in self.status_all() if not wanted or t.task in wanted]
        for name in wanted:
            self.picture.find(name)
        if fields is not None:
            return [one.only(shown) for one in self.baselines.since(found)]
        if not isinstance(task, str):
            return found
        if not found:
            raise StateError(
                "the task went away while it was looked for",
                where=task,
                remedy="'status' shows which tasks there are",
            )
        return found[0]

    def status_set(self, field: str | Sequence[str] = ()) -> tuple[str, ...]:
        """Choose what `status` shows when it is given no fields; return it.

        Raises:
            StateError: There is no such field.
        """
        self.shown = columns(names_of(field)) or self.shown
        return self.shown

    def status_all(self) -> list[m.TaskStatus]:
        """Return the status of every task of the subsystem (`sbsStatusAll`)."""
        return [task for rtpu in self.rtpu_status() for task in rtpu.tasks]

    def rtpu_status(self) -> list[m.RtpuStatus]:
        """Return the status of every RTPU that answers, and of the tasks there.

        Those that do not answer are told as warnings.

        Raises:
            SeveralError: None answers, of several; of one, its own error.
        """
        return self.crew.refresh(strict=False)

    def events_count(self, task: str | Sequence[str] = ()) -> list[dict[str, Any]]:
        """Return how often each kind of event came, those held back in floods too.

        Args:
            task: Of which tasks; none: all.

        Returns:
            Maps with ``rtpu``, ``task``, ``code`` and ``count``.

        Raises:
            UnknownTaskError: There is no such task.
        """
        wanted = names_of(task)
        rtpus = self.rtpu_status()
        for name in wanted:
            self.picture.find(name)
        return [
            {"rtpu": rtpu.rtpu, "task": name, "code": code, "count": count}
            for rtpu in rtpus
            for name, codes in sorted(rtpu.events.items())
            for code, count in sorted(codes.items())
            if not wanted or name in wanted
        ]

    def profile(self, task: str | Sequence[str] = ()) -> list[m.TaskProfile]:
        """Return the execution profiles of tasks, of all if none is named (6.7).

        Raises:
            UnknownTaskError: There is no such task.
        """
        return profiling.ask(self.crew, names_of(task))

    def profile_save(self, task: str | Sequence[str] = ()) -> list[tuple[Saved, Path]]:
        """Save profiles beside the ``.sbs`` file, for the analysis of later starts.

        Raises:
            UnknownTaskError: There is no such task.
            StateError: One that is named has run too few cycles.
            ConfigFileError: A file cannot be written.
        """
        return profiling.save(self.crew, names_of(task))

    def display(
        self,
        variable: str | Iterable[str] | None = None,
        *,
        task: str | None = None,
        writer: str | None = None,
    ) -> list[m.VarValue]:
        """Return values of variables with their age, writer and unit.

        All are of one instant, unless a value's ``whole`` says that this is not proven.

        Args:
            variable: Names, in which * and ? match; none: all.
            task: Only those of its ports.
            writer: Only those that it writes now.

        Raises:
            UnknownVariableError: The table has no such variable.
            UnknownTaskError: There is no such task.
        """
        known = [one.name for one in self.files.table.variables]
        patterns = names_of(variable or ())
        names = _matching(patterns, known) if patterns else known
        if task:
            ports = self.picture.find(task).variables
            names = [name for name in names if name in ports]
        if not names:
            return []
        request = m.Display(names=names)
        keeper = self.files.sbs.keeper
        values = self.fleet.call(keeper, request, list[m.VarValue])
        values.sort(key=lambda one: names.index(one.name))
        return [one for one in values if writer in {None, _task_of(one.writer)}]

    def module(self, module: str | None = None) -> list[ModuleInfo]:
        """Return what is known about the modules in the agents' libraries.

        Raises:
            ModuleLoadError: No library has such a module, or it does not load.
        """
        return remote_modules.of(self.fleet, module)

    def help(self, command: str | None = None) -> tuple[Command, ...]:
        """Return the table of commands, or one of them.

        Raises:
            NodeError: There is no such command.
        """
        from pbonet.master.console import COMMANDS, find

        return COMMANDS if command is None else (find(command),)

    # -- this program -----------------------------------------------------------------

    def wait(self, seconds: float) -> bool:
        """Let time pass; a stop ends it. Return whether all of it passed.

        Raises:
            StateError: Nobody can wait so long.
        """
        check_time(seconds)
        self.stopped.clear()
        return not self.clock.wait(seconds, self.stopped)


def _task_of(writer: str | None) -> str | None:
    """Return the task's name of a writer, which may be on another machine."""
    if writer is None:
        return None
    from pbonet.svar.mirror import MARK

    return writer.partition(MARK)[0]


def _matching(patterns: list[str], known: list[str]) -> list[str]:
    """Return the names that patterns match, in their order, each once.

    Raises:
        UnknownVariableError: One matches none.
    """
    found: list[str] = []
    for pattern in patterns:
        names = [name for name in known if fnmatch.fnmatchcase(name, pattern)]
        if not names:
            raise UnknownVariableError(
                f"the table has no variable {pattern}",
                remedy=did_you_mean(pattern, known) or "'display' shows them all",
            )
        found += [name for name in names if name not in found]
    return found
