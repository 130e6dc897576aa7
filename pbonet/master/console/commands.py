"""The command table: every command once, for every interface (Stewart 1994, 4.4.1).

The prompt, scripts, one-shot verbs and the network interface are all made from this
table: a command's name, its arguments, its help, and what it calls on `Subsystem`.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

from pbonet.errors import NodeError, did_you_mean

from . import command_handlers

if TYPE_CHECKING:
    from .command_session import CommandSession

    Given = dict[str, Any]


class Kind(StrEnum):
    """What an argument stands for; completion offers what there is of it."""

    TASK = "task"
    RMOD = "rmod"
    RTPU = "rtpu"
    VARIABLE = "variable"
    MODULE = "module"
    JOB = "job"
    FIELD = "field"
    COMMAND = "command"
    PARAM = "parameter"
    SIGNAL = "signal"
    ITEM = "task:signal"
    WORD = "word"
    NUMBER = "number"
    COUNT = "count"
    SECONDS = "seconds"
    """A number, with ``s`` or ``ms`` behind it if one likes."""
    FLAG = "yes"
    """Yes or no: ``name=yes`` at the prompt, ``--name`` alone else."""


class Use(StrEnum):
    """How often an argument is given, and how."""

    ONE = "one"
    MAYBE = "maybe"
    """One or none; by name too, unless the command takes all words that are left."""
    SOME = "some"
    """One or more: all words that are left."""
    ANY = "any"
    """All words that are left, if any."""
    NAMED = "named"
    """None or one, by name: ``name=value`` at the prompt, ``--name value`` else."""


class Arg(Struct, frozen=True):
    """One argument of a command."""

    name: str
    kind: Kind
    doc: str
    use: Use = Use.ONE
    last: bool = False
    """The task last used stands in where an interface has one."""
    commas: bool = False
    """It is several names in one word, with commas between them."""

    @property
    def need(self) -> bool:
        """Whether it must be there."""
        return self.use in {Use.ONE, Use.SOME}

    @property
    def many(self) -> bool:
        """Whether it takes all words that are left."""
        return self.use in {Use.SOME, Use.ANY}

    @property
    def option(self) -> bool:
        """Whether it is given by name, and only so."""
        return self.use is Use.NAMED


class Scope(StrEnum):
    """Where a command makes sense."""

    EVERYWHERE = "everywhere"
    SESSION = "session"
    """Only where one interface gives several commands: prompt, script, network."""
    PROMPT = "prompt"
    """Only where commands stand in a row: what waits here keeps nobody else waiting."""


class Command(Struct, frozen=True):
    """One command."""

    name: str
    help: str
    args: tuple[Arg, ...] = ()
    run: Callable[[CommandSession, Given], Given] | None = None
    """Carries it out and returns the data to show. None: the method of `Subsystem` of
    its name is called with its arguments."""
    shows: str = ""
    """The name that the method's result has in the data; empty: it is the data."""
    points: str = ""
    """The argument whose last task is the default of the next command."""
    changes: bool = False
    """It needs a master that holds the claim."""
    judged: bool = False
    """It is verified before, and refused if it would be illegal."""
    alone: bool = False
    """Only the RTPU of its task need be asked."""
    scope: Scope = Scope.EVERYWHERE

    @property
    def named(self) -> dict[str, Arg]:
        """The arguments that may be given as ``name=value``."""
        greedy = any(arg.many for arg in self.args)
        return {
            arg.name: arg
            for arg in self.args
            if arg.option or (arg.use is Use.MAYBE and not greedy)
        }

    @property
    def usage(self) -> str:
        """The command line in short, such as ``spawn RMOD [RTPU] [HZ]``."""
        words = [self.name]
        for arg in self.args:
            word = f"{arg.name}={arg.kind}" if arg.option else arg.name.upper()
            word += " ..." if arg.many else ""
            words.append(word if arg.need else f"[{word}]")
        return " ".join(words)


_TASK: Final = Arg("task", Kind.TASK, "the task", Use.MAYBE, last=True)
_TASKS: Final = Arg("task", Kind.TASK, "the tasks", Use.ANY, last=True)
_DRY: Final = Arg(
    "dry_run", Kind.FLAG, "verify, and only show what would be done", Use.NAMED
)
_WAIT: Final = Arg(
    "wait", Kind.SECONDS, "how long its conditions may take to come true", Use.NAMED
)
_TEXT: Final = Arg("text", Kind.WORD, "text for the module", Use.NAMED)

COMMANDS: Final = (
    Command(
        "check",
        "Judge a job, or the tasks as they stand, without changing anything.",
        (Arg("job", Kind.JOB, "the job", Use.MAYBE),),
        run=command_handlers.check,
    ),
    Command(
        "clear",
        "Send clear to tasks in ERROR.",
        (_TASKS, _TEXT),
        changes=True,
        shows="states",
    ),
    Command(
        "display",
        "Show variables of the table with unit, age and writer.",
        (
            Arg("variable", Kind.VARIABLE, "names; * and ? match", Use.ANY),
            Arg("task", Kind.TASK, "those of its ports", Use.NAMED),
            Arg("writer", Kind.TASK, "those it writes now", Use.NAMED),
        ),
        shows="variables",
    ),
    Command(
        "events",
        "Show what happened lately.",
        (
            Arg("last", Kind.COUNT, "how many", Use.MAYBE),
            Arg(
                "since",
                Kind.WORD,
                "number of the first, or how long ago: 5m",
                Use.NAMED,
            ),
            Arg("task", Kind.TASK, "of one task", Use.NAMED),
            Arg("code", Kind.WORD, "of one code, such as WARNING", Use.NAMED),
            Arg("severity", Kind.WORD, "the least: debug to fatal", Use.NAMED),
        ),
        run=command_handlers.events,
    ),
    Command(
        "events count",
        "Show how often each kind of event came, those held back in floods too.",
        (Arg("task", Kind.TASK, "of which; all if left out", Use.ANY),),
        scope=Scope.SESSION,
        shows="counts",
    ),
    Command(
        "freq",
        "Show or set a task's frequency.",
        (_TASK, Arg("hz", Kind.NUMBER, "new, Hz", Use.MAYBE)),
        changes=True,
        judged=True,
        alone=True,
        shows="hz",
    ),
    Command(
        "get",
        "Show the parameters of a task's module.",
        (_TASK, Arg("param", Kind.PARAM, "which", Use.MAYBE)),
        alone=True,
        shows="params",
    ),
    Command(
        "help",
        "Show the commands, or one of them.",
        (Arg("command", Kind.COMMAND, "which", Use.MAYBE),),
        scope=Scope.SESSION,
        run=command_handlers.help_,
    ),
    Command(
        "kill",
        "Destroy tasks.",
        (_TASKS, _TEXT),
        changes=True,
        shows="states",
    ),
    Command(
        "module",
        "List modules and RMODs, or show one module.",
        (Arg("module", Kind.MODULE, "which", Use.MAYBE),),
        run=command_handlers.module,
    ),
    Command(
        "network",
        "Hand control to a program on the network until it ends.",
        (Arg("portname", Kind.WORD, "the name under which it finds us"),),
        scope=Scope.PROMPT,
        run=command_handlers.network,
    ),
    Command(
        "off",
        "Send off to tasks.",
        (_TASKS, _TEXT),
        changes=True,
        shows="states",
    ),
    Command(
        "on",
        "Send on to tasks.",
        (_TASKS, _TEXT),
        changes=True,
        judged=True,
        shows="states",
    ),
    Command(
        "profile",
        "Show how long cycles take: every figure, and the execution profile.",
        (Arg("task", Kind.TASK, "which; all if left out", Use.ANY),),
        run=command_handlers.profiles,
    ),
    Command(
        "profile save",
        "Save profiles beside the .sbs file, for the analysis of later starts.",
        (Arg("task", Kind.TASK, "which; all if left out", Use.ANY),),
        scope=Scope.SESSION,
        run=command_handlers.profiles_save,
    ),
    Command(
        "quit",
        "End this interface; the next one of the master goes on.",
        scope=Scope.SESSION,
        run=command_handlers.quit_,
    ),
    Command(
        "reconfig",
        "Send several signals in order, judged by their end.",
        (Arg("item", Kind.ITEM, "such as pid:off", Use.SOME),),
        changes=True,
        judged=True,
        shows="states",
        points="item",
    ),
    Command(
        "reinit",
        "Read the constants again and run reinit.",
        (_TASKS, _TEXT),
        changes=True,
        shows="states",
    ),
    Command(
        "set",
        "Show or change parameters of a task's module.",
        (
            _TASK,
            Arg("param", Kind.PARAM, "which; all if left out", Use.MAYBE),
            Arg("value", Kind.WORD, "its new value", Use.ANY),
        ),
        changes=True,
        alone=True,
        shows="params",
    ),
    Command(
        "sigmask",
        "Show or set which signals of tasks nobody wants: names, 'none' or 'unset'.",
        (
            Arg("signal", Kind.SIGNAL, "names; shows the masks if left out", Use.ANY),
            Arg("task", Kind.TASK, "whose; the subsystem's if left out", Use.NAMED),
        ),
        changes=True,
        shows="masks",
    ),
    Command(
        "sigwait",
        "Wait until a task sends a signal, and take it; a stop ends it.",
        (
            Arg("signal", Kind.SIGNAL, "which; any if left out", Use.ANY),
            Arg("task", Kind.TASK, "of these, with commas", Use.NAMED, commas=True),
            Arg("timeout", Kind.SECONDS, "for ever if left out", Use.NAMED),
        ),
        run=command_handlers.sigwait,
    ),
    Command(
        "spawn",
        "Create a task from an RMOD; it is OFF then.",
        (
            Arg("rmod", Kind.RMOD, "the RMOD"),
            Arg("rtpu", Kind.RTPU, "where; as the RMOD says if left out", Use.MAYBE),
            Arg("hz", Kind.NUMBER, "frequency in place of the RMOD's", Use.MAYBE),
        ),
        changes=True,
        judged=True,
        run=command_handlers.spawn,
    ),
    Command(
        "start",
        "Assemble a job: verify, spawn, turn on.",
        (Arg("job", Kind.JOB, "the job", Use.MAYBE), _WAIT),
        changes=True,
        judged=True,
        run=command_handlers.start,
    ),
    Command(
        "status",
        "Show the status of tasks, since the last status.",
        (
            Arg("task", Kind.TASK, "which; all if left out", Use.ANY),
            Arg("fields", Kind.FIELD, "columns, with commas", Use.NAMED),
        ),
        run=command_handlers.status,
    ),
    Command(
        "status set",
        "Choose the columns of status: names, 'all' or 'default'.",
        (Arg("field", Kind.FIELD, "columns; shows them if left out", Use.ANY),),
        scope=Scope.SESSION,
        run=command_handlers.status_set,
    ),
    Command(
        "stop",
        "Turn everything OFF and end it, now.",
    ),
    Command(
        "swap",
        "Put tasks into the place of others; the old ones stay OFF.",
        (
            Arg("old", Kind.TASK, "the tasks that leave, with commas", commas=True),
            Arg(
                "new",
                Kind.RMOD,
                "the tasks or RMODs that come, with commas",
                commas=True,
            ),
            Arg("rtpu", Kind.RTPU, "where to spawn; beside the old ones", Use.NAMED),
            _DRY,
        ),
        changes=True,
        judged=True,
        points="new",
    ),
    Command(
        "switch",
        "Go over to another job; what both have stays ON, the rest is killed.",
        (Arg("job", Kind.JOB, "the job", Use.MAYBE), _DRY, _WAIT),
        changes=True,
        judged=True,
    ),
    Command(
        "wait",
        "Wait before the next command; a stop ends it.",
        (Arg("seconds", Kind.SECONDS, "how long"),),
        scope=Scope.PROMPT,
    ),
    Command(
        "write",
        "Set a variable that no task writes.",
        (
            Arg("variable", Kind.VARIABLE, "its name"),
            Arg("value", Kind.NUMBER, "its elements", Use.SOME),
        ),
        changes=True,
        run=command_handlers.write,
    ),
)

BY_NAME: Final = {command.name: command for command in COMMANDS}


def find(name: str) -> Command:
    """Return a command.

    Raises:
        NodeError: There is none of that name.
    """
    command = BY_NAME.get(name)
    if command is None:
        raise NodeError(
            f"there is no command {name}",
            remedy=did_you_mean(name, BY_NAME) or "see 'help'",
        )
    return command
