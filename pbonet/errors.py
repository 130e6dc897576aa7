"""Every exception of pbonet, as one tree, and the events that errors become.

A message has four parts: what happened, where, what was expected and what was got,
and what to do about it. They are kept apart in the exception, so that a prompt, a web
page and a program can each show them in their own way, and so that an error travels
from a task to the master without losing anything.

::

    PbonetError
    ├── ConfigError (ValueError)           a file contains something invalid
    │   └── ConfigFileError                ... or cannot be read at all
    ├── DeclarationError (TypeError)       a module's class body is wrong
    ├── PortError (ValueError)             a port is used in a way it does not allow
    ├── ParameterError (ValueError)        a LOCAL value is unknown or out of bounds
    ├── VerificationError (ValueError)     the configuration would be illegal
    ├── SvarError
    │   ├── SvarLayoutError                another layout or version than expected
    │   ├── SvarDamagedError               not a table, truncated, or overwritten
    │   ├── SvarAccessError (PermissionError)
    │   ├── SvarMissingError (FileNotFoundError)
    │   ├── SvarExistsError (FileExistsError)
    │   ├── SvarFullError (OSError)        no room in the table or in shared memory
    │   ├── SvarOwnerError                 another task writes this variable
    │   └── UnknownVariableError (KeyError)
    ├── XmError                            express mail: semaphores, queues, links
    │   ├── XmNameError (ValueError)       not of the form RTPU:RESOURCE
    │   ├── XmMissingError (FileNotFoundError)
    │   ├── XmExistsError (FileExistsError)
    │   ├── XmAccessError (PermissionError)
    │   ├── XmLayoutError                  another version or other settings
    │   ├── XmDamagedError                 not such an object, or overwritten
    │   ├── XmDestroyedError               it was destroyed
    │   ├── XmFullError (OSError)          no room in shared memory, or too many users
    │   ├── XmQueueFullError               no room in the queue
    │   ├── XmTakenError                   the link already has a writer, or reader
    │   ├── XmLapsedError                  the connection to its machine was lost
    │   └── XmTooLongError (ValueError)    longer than the queue or the buffer
    ├── ModuleLoadError (ImportError)      module code is missing or does not load
    ├── TaskError
    │   ├── StateError                     the signal is not valid in this state
    │   ├── MethodError                    a method of the module raised
    │   ├── TaskDiedError                  the task's process ended
    │   ├── ReconfigError                  an item of a list of signals failed
    │   ├── ConditionError                 a PRE or POST of a job does not hold
    │   └── UnknownTaskError (KeyError)
    ├── NodeError
    │   ├── UnreachableError (ConnectionError)
    │   ├── NoAnswerError (TimeoutError)
    │   ├── DuplicateNameError
    │   ├── ClaimError (PermissionError)   the RTPU belongs to another subsystem
    │   ├── AccessError (PermissionError)  an observer asks for a change
    │   ├── ProtocolError                  a message that cannot be understood
    │   ├── RealTimeError (OSError)        real-time rights refused
    │   └── SeveralError                   several places failed, each with its error
    ├── LogError (ValueError)              not a log, damaged, or too new
    └── DeviceError (OSError)              a device is missing or does not answer
        ├── DeviceTakenError               ... or another task has it
        └── SppError                       ... or a special purpose processor
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING, ClassVar, TypedDict

if TYPE_CHECKING:
    from collections.abc import Iterable


class Severity(IntEnum):
    """How bad an event is; the order is the order of the filters."""

    DEBUG = 10
    INFO = 20
    WARNING = 30
    ERROR = 40
    FATAL = 50


class WireError(TypedDict, total=False):
    """An error in a message: plain text fields, and the code that names its class."""

    code: str
    what: str
    where: str
    expected: str
    got: str
    remedy: str
    debug: str
    parts: list[WireError]


class PbonetError(Exception):
    """Base of everything that pbonet raises.

    Args:
        what: What happened, one sentence without a full stop at its end.
        where: The place: ``file:line:column``, ``machine/task.port`` or the like.
        expected: What would have been right.
        got: What was there instead.
        remedy: What to do.
        debug: File, line and stack of the cause; shown with ``--debug`` only.
    """

    code: ClassVar[str] = "PBONET"

    def __init__(
        self,
        what: str,
        *,
        where: str = "",
        expected: str = "",
        got: str = "",
        remedy: str = "",
        debug: str = "",
    ) -> None:
        super().__init__(what)
        self.what = what
        self.where = where
        self.expected = expected
        self.got = got
        self.remedy = remedy
        self.debug = debug

    def __str__(self) -> str:
        """Return the whole message on one line."""
        text = f"{self.where}: {self.what}" if self.where else self.what
        if self.expected and self.got:
            text += f" (expected {self.expected}, got {self.got})"
        elif self.expected:
            text += f" (expected {self.expected})"
        elif self.got:
            text += f" (got {self.got})"
        return f"{text}; {self.remedy}" if self.remedy else text

    def to_wire(self) -> WireError:
        """Return the error as plain fields, empty ones left out."""
        wire = WireError(code=self.code, what=self.what)
        for key in ("where", "expected", "got", "remedy", "debug"):
            if value := getattr(self, key):
                wire[key] = value
        return wire

    @staticmethod
    def from_wire(wire: WireError) -> PbonetError:
        """Return the exception that `wire` describes; unknown codes give the base."""
        kind = BY_CODE.get(wire.get("code", ""), PbonetError)
        error = kind.__new__(kind)
        if isinstance(error, SeveralError):
            error.errors = tuple(map(PbonetError.from_wire, wire.get("parts", [])))
        PbonetError.__init__(
            error,
            wire.get("what", "unknown error"),
            where=wire.get("where", ""),
            expected=wire.get("expected", ""),
            got=wire.get("got", ""),
            remedy=wire.get("remedy", ""),
            debug=wire.get("debug", ""),
        )
        return error


class ConfigError(PbonetError, ValueError):
    """A configuration file contains something invalid."""

    code = "CONFIG"


class ConfigFileError(ConfigError):
    """A configuration file cannot be read."""

    code = "CONFIG_FILE"


class DeclarationError(PbonetError, TypeError):
    """The body of a module's class is wrong; `where` is ``module.Class.attribute``."""

    code = "DECLARATION"


class PortError(PbonetError, ValueError):
    """A port is used in a way it does not allow, such as rebinding it."""

    code = "PORT"


class ParameterError(PbonetError, ValueError):
    """A parameter is unknown, of the wrong type, or outside its bounds."""

    code = "PARAMETER"


class VerificationError(PbonetError, ValueError):
    """The configuration would be illegal (Stewart 1994, section 3.3.1)."""

    code = "VERIFICATION"


class SvarError(PbonetError):
    """Something is wrong with a state variable table."""

    code = "SVAR"


class SvarLayoutError(SvarError):
    """The table has another layout, or was made by another version."""

    code = "SVAR_LAYOUT"


class SvarDamagedError(SvarError):
    """The file is not a table, is truncated, or was overwritten."""

    code = "SVAR_DAMAGED"


class SvarAccessError(SvarError, PermissionError):
    """The table belongs to another user."""

    code = "SVAR_ACCESS"


class SvarMissingError(SvarError, FileNotFoundError):
    """There is no such table."""

    code = "SVAR_MISSING"


class SvarExistsError(SvarError, FileExistsError):
    """A table of that name already exists and is in use."""

    code = "SVAR_EXISTS"


class SvarFullError(SvarError, OSError):
    """No room is left in the table or in shared memory."""

    code = "SVAR_FULL"


class SvarOwnerError(SvarError):
    """Another task writes the variable (equation 1 of section 3.3.1)."""

    code = "SVAR_OWNER"


class UnknownVariableError(SvarError, KeyError):
    """The table has no variable of that name."""

    code = "UNKNOWN_VARIABLE"


class XmError(PbonetError):
    """Express mail: something is wrong with a semaphore, a queue, or a link."""

    code = "XM"


class XmNameError(XmError, ValueError):
    """This is not a valid resource name."""

    code = "XM_NAME"


class XmMissingError(XmError, FileNotFoundError):
    """There is no such resource."""

    code = "XM_MISSING"


class XmExistsError(XmError, FileExistsError):
    """A resource of that name already exists and is in use."""

    code = "XM_EXISTS"


class XmAccessError(XmError, PermissionError):
    """The resource's file is not this user's own, or cannot be opened."""

    code = "XM_ACCESS"


class XmLayoutError(XmError):
    """The resource is of another version, or was made with other settings."""

    code = "XM_LAYOUT"


class XmDamagedError(XmError):
    """The file is not such a resource, or was overwritten."""

    code = "XM_DAMAGED"


class XmDestroyedError(XmError):
    """The resource was destroyed."""

    code = "XM_DESTROYED"


class XmFullError(XmError, OSError):
    """There is no room in shared memory, or there are too many users or waiters."""

    code = "XM_FULL"


class XmQueueFullError(XmError):
    """The queue has no room for the message."""

    code = "XM_QUEUE_FULL"


class XmTakenError(XmError):
    """The link already has a writer, or a reader."""

    code = "XM_TAKEN"


class XmLapsedError(XmError):
    """The link to a resource on another machine was lost, with what was held there."""

    code = "XM_LAPSED"


class XmTooLongError(XmError, ValueError):
    """The message is longer than the queue or the destination buffer allows."""

    code = "XM_TOO_LONG"


class ModuleLoadError(PbonetError, ImportError):
    """The code of a module is missing or does not load."""

    code = "MODULE_LOAD"


class TaskError(PbonetError):
    """Something is wrong with a task."""

    code = "TASK"


class StateError(TaskError):
    """The signal is not valid in the task's state (section 4.5.3)."""

    code = "STATE"


class MethodError(TaskError):
    """A method of the module raised an exception.

    `number` is the number that the module passed to ``fail()``, 1 for other errors of
    methods, 0 for any other; `place` is the line, ``file:line in method``, which
    messages append to `what`.
    """

    code = "METHOD"
    number: int = 0
    place: str = ""

    def to_wire(self) -> WireError:
        """Return the error as plain fields."""
        what = f"{self.what} ({self.place})" if self.place else self.what
        return {**super().to_wire(), "what": what}


class TaskDiedError(TaskError):
    """The task's process ended without being asked to."""

    code = "TASK_DIED"


class ReconfigError(TaskError):
    """An item of a list of signals failed (section 4.4.4).

    `done` items were carried out, the item after them failed, `rest` (which begins
    with it) was not. The item's own error is in ``__cause__``.
    """

    code = "RECONFIG"
    done: int = 0
    rest: tuple[tuple[str, str], ...] = ()


class ConditionError(TaskError):
    """A PRE or POST condition of a job does not hold; nothing was changed."""

    code = "CONDITION"


class UnknownTaskError(TaskError, KeyError):
    """The subsystem has no task of that name."""

    code = "UNKNOWN_TASK"


class NodeError(PbonetError):
    """Something is wrong with an agent or an RTPU."""

    code = "NODE"


class UnreachableError(NodeError, ConnectionError):
    """No agent of that name can be reached."""

    code = "UNREACHABLE"


class NoAnswerError(NodeError, TimeoutError):
    """The agent is alive but did not answer in time."""

    code = "NO_ANSWER"


class DuplicateNameError(NodeError):
    """The name is taken."""

    code = "DUPLICATE_NAME"


class ClaimError(NodeError, PermissionError):
    """The RTPU belongs to another subsystem or another master."""

    code = "CLAIM"


class AccessError(NodeError, PermissionError):
    """The client may read, but not change, the state."""

    code = "ACCESS"


class ProtocolError(NodeError):
    """A message is malformed or of another version."""

    code = "PROTOCOL"


class RealTimeError(NodeError, OSError):
    """The kernel refused a real-time right."""

    code = "REAL_TIME"


class SeveralError(NodeError):
    """Several places failed in one operation; `errors` holds the error of each.

    The same errors are in ``__cause__``, as an `ExceptionGroup`.
    """

    code = "SEVERAL"

    def __init__(
        self, what: str, errors: Iterable[PbonetError], *, remedy: str = ""
    ) -> None:
        super().__init__(what, remedy=remedy)
        self.errors = tuple(errors)
        self.__cause__ = ExceptionGroup(what, self.errors)

    def __str__(self) -> str:
        """Return a tree: what happened, then one line for each place."""
        lines = [super().__str__()]
        for error in self.errors:
            mark = "`-- " if error is self.errors[-1] else "|-- "
            rest = "    " if error is self.errors[-1] else "|   "
            lines.append(mark + f"\n{rest}".join(str(error).splitlines()))
        return "\n".join(lines)

    def to_wire(self) -> WireError:
        """Return the error as plain fields, with those of each place."""
        wire = super().to_wire()
        wire["parts"] = [error.to_wire() for error in self.errors]
        return wire


class LogError(PbonetError, ValueError):
    """A log cannot be written or is damaged or too new, or a file is not a log."""

    code = "LOG"


class DeviceError(PbonetError, OSError):
    """A device is missing, refuses, or does not answer."""

    code = "DEVICE"


class DeviceTakenError(DeviceError):
    """Another task has a port of a device; this one waits for it."""

    code = "DEVICE_TAKEN"


class SppError(DeviceError):
    """A special purpose processor is missing, or a routine of it has failed."""

    code = "SPP"


def _tree(kind: type[PbonetError]) -> Iterable[type[PbonetError]]:
    yield kind
    for below in kind.__subclasses__():
        yield from _tree(below)


BY_CODE = {kind.code: kind for kind in _tree(PbonetError)}  # for `from_wire`


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return ``did you mean NAME?`` for the nearest known name, or an empty string.

    Names that begin with the word go before others.
    """
    import difflib  # only where something is wrong

    names = list(known)
    near = difflib.get_close_matches(word, names, n=len(names) or 1)
    near.sort(key=lambda name: not name.startswith(word))
    return f"did you mean {near[0]}?" if near else ""
