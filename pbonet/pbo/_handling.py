"""Global error handling: handlers by code and by scope (Stewart 1994, section 8.2)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import StrEnum
from pathlib import Path
from traceback import walk_tb
from typing import TYPE_CHECKING, NamedTuple, Protocol, Self, TypeAlias, cast

from pbonet.errors import MethodError

if TYPE_CHECKING:
    from types import FrameType, TracebackType


class Handling(StrEnum):
    """Answer of a handler of errors (Stewart 1994, section 8.2.1)."""

    ABORT = "abort"
    """The error is not corrected here: the next outer handler is called, and finally
    the module's `error`, whose default leaves the task in ERROR."""
    CONTINUE = "continue"
    """Continue after ``fail()``; after an exception, after the scope."""
    JUMP = "jump"
    """Continue at the mark, which is the end of the scope; for a handler without a
    scope, the end of the method, whose outputs are discarded."""


Code: TypeAlias = int | type[Exception] | None
"""Which errors: a number of ``fail()``, a class of exceptions, or None for all."""
Handler: TypeAlias = Callable[[Exception], Handling | None]
"""Is given the error and says what follows; None is `Handling.CONTINUE`."""
UNNUMBERED = 1
"""The number of an error that was given none."""


class Jump(BaseException):
    """Unwinds to the end of a scope."""

    def __init__(self, scope: ErrorScope) -> None:
        super().__init__("a jump to the end of a scope")
        self.scope = scope


class Kept(NamedTuple):
    """A handler that lives as long as the task."""

    code: Code
    handler: Handler
    part: str
    """Of a combination: the part that gave it, and for which it counts."""


class HasScopes(Protocol):
    """A task, seen from here."""

    scopes: list[ErrorScope]

    def handled(self, error: Exception, handler: Handler) -> Handling:
        """Run a handler, and return what it corrected."""
        ...


class ErrorScope:
    """The scope of a handler; created by `TaskContext.on_error`.

    Attributes:
        error: The error that it has handled; None without an error.
    """

    def __init__(self, task: HasScopes, code: Code, handler: Handler | None) -> None:
        self._task = task
        self._code = code
        self._handler = handler or _jump
        self._spoilt = False
        self.error: Exception | None = None

    def __enter__(self) -> Self:
        """Begin."""
        self.error, self._spoilt = None, False
        self._task.scopes.append(self)
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        error: BaseException | None,
        _trace: TracebackType | None,
    ) -> bool:
        """End; True if an exception was handled and the task continues here."""
        scopes = self._task.scopes
        del scopes[scopes.index(self) :]
        if isinstance(error, Jump):
            return error.scope is self
        if self._spoilt or not isinstance(error, Exception) or not self.covers(error):
            return False
        return self.ask(error) is not Handling.ABORT

    def covers(self, error: Exception) -> bool:
        """Return whether the handler is one for `error`."""
        return covers(self._code, error)

    def ask(self, error: Exception) -> Handling:
        """Run the handler; one that fails is not asked about that."""
        self._spoilt = True
        answer = self._task.handled(error, self._handler)
        self._spoilt = False
        if answer is not Handling.ABORT:
            self.error = error
        return answer


def _jump(_: Exception) -> Handling:
    return Handling.JUMP


def covers(code: Code, error: Exception) -> bool:
    """Return whether an error is one of those that `code` means."""
    if isinstance(code, int):
        return number_of(error) == code
    return code is None or isinstance(error, code)


def number_of(error: Exception) -> int:
    """Return the number of an error."""
    return (error.number if isinstance(error, MethodError) else 0) or UNNUMBERED


def text_of(error: BaseException) -> str:
    """Return the text of an exception, empty where its own ``__str__`` fails.

    For a group, include its members.
    """
    try:
        text = str(error)
    except Exception:  # noqa: BLE001 - a module's exception may do anything
        return ""
    if isinstance(error, BaseExceptionGroup):
        group = cast("BaseExceptionGroup[BaseException]", error)
        text += f": {', '.join(said(one) for one in group.exceptions)}"
    return text


def said(error: BaseException) -> str:
    """Return class and text of an exception."""
    text, name = text_of(error), type(error).__name__
    return f"{name}: {text}" if text else name


def checked(answer: object) -> Handling:
    """Return what a handler answered.

    Raises:
        MethodError: It gave an answer that there is not.
    """
    if answer is None:
        return Handling.CONTINUE
    if isinstance(answer, Handling):
        return answer
    raise MethodError(
        "an error handler returned an invalid answer",
        expected=f"None or {' or '.join(f'Handling.{one.name}' for one in Handling)}",
        got=repr(answer),
    )


_RUNTIME = tuple(
    f"{Path(__file__).parents[1] / name}/" for name in ("pbo", "node", "testing")
)


def place_of(error: BaseException) -> str:
    """Return where a module failed: the innermost line of its own folder.

    A line of numpy, in which it was found out, is not the line that is wrong.
    """
    if isinstance(error, MethodError) and error.place:
        return error.place
    return innermost(
        (frame.f_code.co_filename, line_of(frame, number))
        for frame, number in walk_tb(error.__traceback__)
    )


def innermost(calls: Iterable[tuple[str, str]]) -> str:
    """Return the last line of a module's own folder; that of the first call is it.

    Args:
        calls: File and line of each, the outermost first.
    """
    found, folder = "", None
    for file, line in calls:
        own = not file.startswith(_RUNTIME) and not file.endswith((".pyx", ".pxi"))
        if own and folder in {None, Path(file).parent}:
            folder, found = Path(file).parent, line
    return found


def line_of(frame: FrameType | None, number: int = 0) -> str:
    """Return ``file:line in method`` of a frame."""
    if frame is None:
        return ""
    code = frame.f_code
    return f"{code.co_filename}:{number or frame.f_lineno} in {code.co_name}"
