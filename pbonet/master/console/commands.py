"""The command table: every command once, for every interface (Stewart 1994, 4.4.1).

The prompt, scripts, one-shot verbs and the network interface are all made from this
table: a command's name, its arguments, its help, and what it calls on `Subsystem`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

from pbonet.errors import NodeError, did_you_mean

from . import command_handlers

if TYPE_CHECKING:
    from .session_state import SessionState

    Given = dict[str, Any]


class Kind(StrEnum):
    """The kind of thing that an argument names; completion offers these."""

    TASK = "task"
    RMOD = "rmod"
    RTPU = "rtpu"
    VARIABLE = "variable"
    MODULE = "module"
    CLASS = "class"
    JOB = "job"
    FIELD = "field"
    COMMAND = "command"
    PARAM = "parameter"
    SIGNAL = "signal"
    ITEM = "task:signal"
    WORD = "word"
    NUMBER = "number"
    COUNT = "count"
    QUESTION = "what"
    """A task, a variable or an RTPU, or a word of `explain`."""
    SECONDS = "seconds"
    """A number, optionally followed by ``s`` or ``ms``."""
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
    """The task used last is the default if the interface has one."""
    commas: bool = False
    """It is several names in one word, with commas between them."""

    @property
    def word(self) -> str:
        """Its name for a user; a program writes `name`, as ``class_``."""
        return self.name.rstrip("_")

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
    """Only where commands are sequential, so that a wait delays no other client."""


class Command(Struct, frozen=True):
    """One command."""

    name: str
    help: str
    args: tuple[Arg, ...] = ()
    run: Callable[[SessionState, Given], Given] | None = None
    """Carries it out and returns the data to show. None: the method of `Subsystem` of
    its name is called with its arguments."""
    shows: str = ""
    """The name that the method's result has in the data; empty: it is the data."""
    points: str = ""
    """The argument whose last task becomes the default of the next command."""
    changes: bool = False
    """It needs a master that holds the claim."""
    whole: bool = False
    """Every RTPU must answer, because it starts tasks on all of them."""
    alone: bool = False
    """Only the RTPU of its task need be asked."""
    scope: Scope = Scope.EVERYWHERE
    examples: tuple[tuple[str, str], ...] = ()
    """Lines of the prompt, each with what it does; verbs show them as their own."""

    @property
    def named(self) -> dict[str, Arg]:
        """The arguments that may be given as ``name=value``."""
        greedy = any(arg.many for arg in self.args)
        return {
            arg.word: arg
            for arg in self.args
            if arg.option or (arg.use is Use.MAYBE and not greedy)
        }

    @property
    def usage(self) -> str:
        """The command line in short, such as ``spawn RMOD [RTPU] [HZ]``."""
        words = [self.name]
        for arg in self.args:
            word = f"{arg.word}={arg.kind}" if arg.option else arg.name.upper()
            word += " ..." if arg.many else ""
            words.append(word if arg.need else f"[{word}]")
        return " ".join(words)


_TASK: Final = Arg("task", Kind.TASK, "the task", Use.MAYBE, last=True)
_SEARCH: Final = (
    Arg("text", Kind.MODULE, "a module's name, or words about it", Use.ANY),
    Arg("class_", Kind.CLASS, "its class, or the beginning of it", Use.NAMED),
    Arg("in_", Kind.VARIABLE, "a variable that it reads, or Q_*", Use.NAMED),
    Arg("out", Kind.VARIABLE, "a variable that it writes", Use.NAMED),
    Arg("unit", Kind.WORD, "the unit of that port, or of any", Use.NAMED),
)
_TASKS: Final = Arg("task", Kind.TASK, "the tasks", Use.ANY, last=True)
_JOB: Final = Arg("job", Kind.JOB, "its name; that of the .job file", Use.MAYBE)
_DRY: Final = Arg(
    "dry_run", Kind.FLAG, "verify, and only show what would be done", Use.NAMED
)
_WAIT: Final = Arg(
    "wait", Kind.SECONDS, "how long its conditions may take to become true", Use.NAMED
)
_ABANDON: Final = Arg(
    "abandon", Kind.FLAG, "give the present job up: do not ask its POST", Use.NAMED
)
_TEXT: Final = Arg("text", Kind.WORD, "text for the module", Use.NAMED)


def _help(_: SessionState, given: Given) -> Given:
    """Show the commands."""
    name: str | None = given.get("command")
    return {"commands": described(COMMANDS if name is None else (find(name),))}


def described(commands: Iterable[Command]) -> list[Given]:
    """Return commands as data: names, arguments, and what they do."""
    return [
        {
            "name": command.name,
            "usage": command.usage,
            "help": command.help,
            "changes": command.changes,
            "examples": [list(example) for example in command.examples],
            "args": [
                {
                    "name": arg.word,
                    "kind": str(arg.kind),
                    "doc": arg.doc,
                    "use": str(arg.use),
                    "last": arg.last,
                }
                for arg in command.args
            ],
        }
        for command in commands
    ]


COMMANDS: Final = (
    Command(
        "check",
        "Check a job, or the tasks that exist now, without changing anything.",
        (_JOB,),
        run=command_handlers.check,
    ),
    Command(
        "clear",
        "Bring tasks out of ERROR; they are OFF then.",
        (_TASKS, _TEXT),
        changes=True,
        examples=(
            ("clear puma_pidg", "Clear a task whose cause of error is gone."),
            ("clear cam1 cam2 text=new", "Clear two, with a text for their module."),
        ),
        shows="states",
    ),
    Command(
        "display",
        "Show the values of shared variables, with unit, age and writer.",
        (
            Arg(
                "variable",
                Kind.VARIABLE,
                "names, * and ? match any text; all if left out",
                Use.ANY,
            ),
            Arg("task", Kind.TASK, "only variables of this task's ports", Use.NAMED),
            Arg("writer", Kind.TASK, "only variables it writes now", Use.NAMED),
        ),
        shows="variables",
    ),
    Command(
        "events",
        "Show the latest events of tasks and RTPUs.",
        (
            Arg("last", Kind.COUNT, "how many of the newest", Use.MAYBE),
            Arg(
                "since",
                Kind.WORD,
                "from this number on, or from so long ago: 30s, 5m, 2h",
                Use.NAMED,
            ),
            Arg("task", Kind.TASK, "only events of this task", Use.NAMED),
            Arg("code", Kind.WORD, "only this kind, such as WARNING", Use.NAMED),
            Arg(
                "severity",
                Kind.WORD,
                "this and worse: debug, info, warning, error or fatal",
                Use.NAMED,
            ),
        ),
        run=command_handlers.events,
    ),
    Command(
        "events count",
        "Show how often each kind of event occurred, suppressed ones included.",
        (Arg("task", Kind.TASK, "which tasks; all if left out", Use.ANY),),
        scope=Scope.SESSION,
        shows="counts",
    ),
    Command(
        "explain",
        "Explain why something is as it is: the causes, and what to do.",
        (
            Arg(
                "what",
                Kind.QUESTION,
                "flag, a task, a variable, an RTPU, start [JOB], miss TASK [CYCLE]",
                Use.ANY,
            ),
            Arg(
                "trace",
                Kind.SECONDS,
                "of a miss: wait at most so long for the next; show what had the core",
                Use.NAMED,
            ),
        ),
        run=command_handlers.explain,
        examples=(
            ("explain", "Explain why the illegal-configuration flag is up."),
            ("explain Q_REF", "Explain why a variable is stale."),
            ("explain start teleop", "Explain why a job would not start."),
            ("explain miss jttrace trace=5", "See who has the core in its next miss."),
        ),
    ),
    Command(
        "freq",
        "Show or set the frequency of a task.",
        (_TASK, Arg("hz", Kind.NUMBER, "the new frequency, Hz", Use.MAYBE)),
        changes=True,
        examples=(
            ("freq puma_pidg", "Show it."),
            ("freq puma_pidg 500", "Run it at 500 Hz if deadlines can be met."),
        ),
        shows="hz",
        alone=True,
    ),
    Command(
        "get",
        "Show the parameters of a task.",
        (_TASK, Arg("param", Kind.PARAM, "which", Use.MAYBE)),
        examples=(
            ("get puma_pidg", "Show all of them."),
            ("get puma_pidg kd", "Show one."),
        ),
        shows="params",
        alone=True,
    ),
    Command(
        "help",
        "Show the commands, or explain one.",
        (Arg("command", Kind.COMMAND, "which", Use.MAYBE),),
        scope=Scope.SESSION,
        run=_help,
    ),
    Command(
        "kill",
        "Destroy tasks; one that is ON is turned off first.",
        (_TASKS, _TEXT),
        changes=True,
        examples=(
            ("kill jttrace", "Destroy one task."),
            ("kill cam1 cam2", "Destroy two, in this order."),
        ),
        shows="states",
    ),
    Command(
        "library",
        "Find modules by class, port, unit and text; show one in full.",
        _SEARCH,
        run=command_handlers.library,
        examples=(
            ("library joint_pid", "Show ports and parameters of one module."),
            ("library class=kin out=Q_REF unit=rad", "Find those for a purpose."),
        ),
    ),
    Command(
        "module",
        "List modules, or show one: the thesis's name of library.",
        _SEARCH,
        scope=Scope.PROMPT,
        run=command_handlers.library,
    ),
    Command(
        "network",
        "Hand control to a program on the network until it ends.",
        (Arg("portname", Kind.WORD, "the name by which the program connects"),),
        scope=Scope.PROMPT,
        run=command_handlers.network,
    ),
    Command(
        "off",
        "Turn tasks off: they exist, and run no cycles.",
        (_TASKS, _TEXT),
        changes=True,
        examples=(
            ("off jttrace", "Turn one task off."),
            ("off jttrace puma_pidg", "Turn two off, in this order."),
        ),
        shows="states",
    ),
    Command(
        "on",
        "Turn tasks on: they run their cycles.",
        (_TASKS, _TEXT),
        changes=True,
        examples=(
            ("on puma_pidg", "Turn one task on."),
            ("on cam1 cam2 puma_pidg", "Turn three on, in this order."),
        ),
        shows="states",
    ),
    Command(
        "profile",
        "Show how long the cycles of tasks take, and how late they start.",
        (Arg("task", Kind.TASK, "which ones; all if left out", Use.ANY),),
        run=command_handlers.profiles,
    ),
    Command(
        "profile save",
        "Save the profiles beside the .sbs file, for the analysis of later starts.",
        (Arg("task", Kind.TASK, "which ones; all if left out", Use.ANY),),
        scope=Scope.SESSION,
        run=command_handlers.profiles_save,
    ),
    Command(
        "quit",
        "End this interface; the master continues with its next one.",
        scope=Scope.SESSION,
        run=command_handlers.quit_,
    ),
    Command(
        "reconfig",
        "Send several signals in order, verified as one change.",
        (Arg("item", Kind.ITEM, "a task and a signal, such as pid:off", Use.SOME),),
        changes=True,
        examples=(
            ("reconfig pid_a:off pid_b:on", "Turn one task off and another on."),
            ("reconfig trace:off trace:kill", "Turn a task off and destroy it."),
        ),
        shows="states",
        points="item",
    ),
    Command(
        "reinit",
        "Have tasks read their constants again, without turning them off.",
        (_TASKS, _TEXT),
        changes=True,
        examples=(
            ("reinit forward_kin", "Have one task read them."),
            ("reinit forward_kin text=tool2", "The same, with a text for its module."),
        ),
        shows="states",
    ),
    Command(
        "set",
        "Show or change the parameters of a task.",
        (
            _TASK,
            Arg("param", Kind.PARAM, "which ones; all if left out", Use.MAYBE),
            Arg("value", Kind.WORD, "its new value", Use.ANY),
        ),
        changes=True,
        examples=(
            ("set puma_pidg kd", "Show one parameter."),
            ("set gain2 gain -1.5", "Change one between two cycles."),
        ),
        shows="params",
        alone=True,
    ),
    Command(
        "sigmask",
        "Show or set which signals to ignore: names, 'none' or 'unset'.",
        (
            Arg("signal", Kind.SIGNAL, "names; shows masks if left out", Use.ANY),
            Arg("task", Kind.TASK, "one task; all if left out", Use.NAMED),
        ),
        changes=True,
        examples=(
            ("sigmask WARNING", "Ignore the warnings of all tasks."),
            ("sigmask none task=camera", "Ignore no signal of one task."),
        ),
        shows="masks",
    ),
    Command(
        "sigwait",
        "Wait until a task sends a signal, and take it; stop ends it.",
        (
            Arg("signal", Kind.SIGNAL, "names; any if left out", Use.ANY),
            Arg(
                "task",
                Kind.TASK,
                "only these tasks, separated by commas",
                Use.NAMED,
                commas=True,
            ),
            Arg("timeout", Kind.SECONDS, "the longest wait", Use.NAMED),
        ),
        examples=(
            ("sigwait", "Wait for any signal."),
            ("sigwait FINISH ERROR timeout=10", "Wait 10 s at most, for two."),
        ),
        run=command_handlers.sigwait,
    ),
    Command(
        "spawn",
        "Create a task from an .rmod (module configuration); it is OFF.",
        (
            Arg("rmod", Kind.RMOD, "the .rmod file: its name, without ending"),
            Arg(
                "rtpu",
                Kind.RTPU,
                "RTPU (executor); that of the .rmod if left out",
                Use.MAYBE,
            ),
            Arg(
                "hz", Kind.NUMBER, "frequency; that of the .rmod if left out", Use.MAYBE
            ),
            Arg(
                "keep",
                Kind.FLAG,
                "keep a task that is there with the same settings",
                Use.NAMED,
            ),
        ),
        changes=True,
        examples=(
            ("spawn jttrace", "Create it on the RTPU that its file names."),
            ("spawn jttrace arm1 25", "Create it on RTPU arm1, at 25 Hz."),
        ),
        run=command_handlers.spawn,
    ),
    Command(
        "start",
        "Create the tasks of a job and turn them on, on running RTPUs.",
        (_JOB, _WAIT),
        changes=True,
        whole=True,
        examples=(
            ("start teleop", "Verify and start the job in teleop.job."),
            ("start wait=5", "Wait up to 5 s for its conditions."),
        ),
        run=command_handlers.start,
    ),
    Command(
        "status",
        "Show the state and the timing of tasks.",
        (
            Arg("task", Kind.TASK, "which ones; all if left out", Use.ANY),
            Arg("fields", Kind.FIELD, "columns, separated by commas", Use.NAMED),
            Arg("reset", Kind.FLAG, "then restart minC, maxC, minU, maxU", Use.NAMED),
        ),
        examples=(
            ("status", "Show all tasks."),
            ("status reset=yes", "Show them; the next extremes are of new cycles."),
            ("status jttrace fields=state,refF,mezF", "Show three columns of one."),
        ),
        run=command_handlers.status,
    ),
    Command(
        "status set",
        "Choose the columns of status: names, 'all' or 'default'.",
        (Arg("field", Kind.FIELD, "columns; without any they are listed", Use.ANY),),
        scope=Scope.SESSION,
        run=command_handlers.status_set,
    ),
    Command(
        "stop",
        "Turn all tasks off and end them, now.",
    ),
    Command(
        "swap",
        "Replace tasks by others between two cycles; the old ones stay, OFF.",
        (
            Arg(
                "old",
                Kind.TASK,
                "the tasks to replace, separated by commas",
                commas=True,
            ),
            Arg("new", Kind.RMOD, "tasks or .rmods, separated by commas", commas=True),
            Arg(
                "rtpu",
                Kind.RTPU,
                "the RTPU of new tasks; that of the old ones if left out",
                Use.NAMED,
            ),
            _DRY,
        ),
        changes=True,
        examples=(
            ("swap pid_a pid_b", "Replace one controller by another."),
            ("swap pid_a pid_b dry_run=yes", "Only show what would be done."),
        ),
        points="new",
    ),
    Command(
        "switch",
        "Change to another job; tasks that both have stay ON.",
        (_JOB, _DRY, _WAIT, _ABANDON),
        changes=True,
        whole=True,
        examples=(
            ("switch grasp", "Change to the job in grasp.job."),
            ("switch grasp wait=2 dry_run=yes", "Only show what would be done."),
        ),
    ),
    Command(
        "wait",
        "Wait before the next command; 'stop' ends the wait.",
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
        examples=(
            ("write T_REF 0.5 -1.5 2", "Set the elements of an array."),
            ("write MODE 3", "Set a single value."),
        ),
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
