"""A combination as a module: it hands every call on to its parts, in their order."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from pbonet.errors import DeclarationError, MethodError
from pbonet.ports import Kind, attribute

from ._bind import assemble, check_sizes
from ._combine import Part, combination, faults, methods, signals
from ._handling import said
from ._object import Interface, PortBasedObject
from ._params import Params, combine_params, combined_field
from ._task import Answer, TaskFailure
from ._timing import Recovery, TimingFailure

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

NOBODY = -1
_GRAVITY = (Answer.ERROR, Answer.OFF, Answer.CONTINUE)
"""Answers of `error`, the one that counts most first."""
_URGENCY = (Recovery.ABORT, Recovery.SKIP, Recovery.CONTINUE)
"""Answers of `timing_failure`, likewise."""
_RAISED = (Exception, SystemExit, TaskFailure)


class PartClass(NamedTuple):
    """A part with its code."""

    part: Part
    cls: type[PortBasedObject[Any]]


class Combined(PortBasedObject[Params], abstract=True):
    """Several modules as one task (Stewart 1994, section 3.8.1).

    Its inputs are those that no part writes, its outputs those that are published.
    `on` and `cycle` run the parts in their order, so that a part sees what those
    before it wrote in the same cycle; `off` and `kill` go the other way.

    Attributes:
        parts: The instances.
    """

    parts: tuple[PortBasedObject[Any], ...]
    __classes__: ClassVar[tuple[PartClass, ...]] = ()

    def __bound__(self) -> None:
        """Make the parts, each with its own parameters and view of the task."""
        cls = type(self)
        own = [
            made.cls.__params__(**{
                field: getattr(self.params, combined_field(number, field))
                for field in made.cls.__params__.__declared__
            })
            for number, made in enumerate(cls.__classes__)
        ]
        self.parts = assemble(self, [(m.part, m.cls) for m in cls.__classes__], own)
        self.task.at = self.place
        self._at = NOBODY
        self._begun = 0
        self._on = [False] * len(self.parts)
        self._failed: list[int] = []
        self._rest: Callable[[int], Answer | None] | None = None
        written = [made.cls.__interface__.methods for made in cls.__classes__]
        self._cycles = [*enumerate(part.cycle for part in self.parts)]
        self._stables = [
            (number, part.stable if "stable" in written[number] else part.cycle)
            for number, part in enumerate(self.parts)
        ]
        self._waiting = next((n for n, w in enumerate(written) if "sync" in w), NOBODY)

    def place(self) -> str:
        """Return the part whose method runs or ran last, empty between methods."""
        if self._at == NOBODY:
            return ""
        name = type(self).__classes__[self._at].part.name
        below = self.parts[self._at]
        inner = below.place() if isinstance(below, Combined) else ""
        return f"{name}.{inner}" if inner else name

    # -- the life of a task -----------------------------------------------------------

    def init(self) -> None:
        """Initialize the parts; constants of a part are available to later parts."""
        for number, part in enumerate(self.parts):
            self._at, self._begun = number, number + 1
            check_sizes(part, Kind.INCONST)
            part.init()
            check_sizes(part, Kind.OUTCONST)
        self._at = NOBODY

    def on(self) -> Answer | None:
        """Turn the parts on; when one cannot start, the others are turned off."""
        return self._all(self._turn_on)

    def _turn_on(self, first: int) -> Answer | None:
        for number in range(first, len(self.parts)):
            self._at = number
            self._on[number] = True
            answer = self.parts[number].on()
            if answer is not None:
                return self._give_up(number, answer)
        return None

    def _give_up(self, number: int, answer: Answer) -> Answer:
        """Turn off the parts that are ON, because a part cannot start."""

        def rest(_: int) -> Answer:
            self._turn_off()
            return answer

        self._on[number], self._rest = False, rest
        return rest(number)

    def cycle(self, dt: float) -> None:
        """Run a cycle of every part."""
        for number, cycle in self._cycles:
            self._at = number
            cycle(dt)
        self._at = NOBODY

    def stable(self, dt: float) -> None:
        """Run `stable` of the parts that have it, and `cycle` of the others."""
        for number, law in self._stables:
            self._at = number
            law(dt)
        self._at = NOBODY

    def off(self) -> None:
        """Turn the parts off, the last one first."""
        self._all(self._turn_off)

    def _all(self, method: Callable[[int], Answer | None]) -> Answer | None:
        """Run a method for all parts; `error` may have to run the rest."""
        self._rest = method
        answer = method(0)
        self._rest = None
        self._at = NOBODY
        return answer

    def _turn_off(self, _: int = 0) -> None:
        """Turn off the parts that are ON, the last one first."""
        for number in reversed(range(len(self.parts))):
            if self._on[number]:
                self._on[number] = False
                self._at = number
                self.parts[number].off()

    def kill(self) -> None:
        """End the parts whose `init` was called, the last one first.

        Raises:
            MethodError: Some of them failed; the others have ended nevertheless.
        """
        failed: list[str] = []
        for number in reversed(range(self._begun)):
            self._at = number
            try:
                self.parts[number].kill()
            except _RAISED as error:
                failed.append(f"{self.place()}: {said(error)}")
        self._begun = 0
        self._at = NOBODY
        if failed:
            raise MethodError("; ".join(failed))

    def sync(self) -> None:
        """Wait as the one part does that has `sync`."""
        if self._waiting != NOBODY:
            self._at = self._waiting
            self.parts[self._at].sync()
            self._at = NOBODY

    def reinit(self) -> None:
        """Let the parts take over new constants, including their own."""
        self._all(self._renew)

    def _renew(self, first: int) -> None:
        for number in range(first, len(self.parts)):
            self._at, part = number, self.parts[number]
            check_sizes(part, Kind.INCONST)
            part.reinit()
            check_sizes(part, Kind.OUTCONST)

    # -- when something fails ---------------------------------------------------------

    def error(self, error: Exception) -> Answer:
        """Call `error` of the failed part; turn off the others unless it continues.

        An error of the whole, such as an output that is refused, is passed to all
        parts, and the most severe answer counts.
        """
        failed = [self._at] if self._at != NOBODY else list(range(len(self.parts)))
        try:
            answers = [self.parts[number].error(error) for number in failed]
            answer = min(answers, key=_gravity)
        except _RAISED:
            self._leave(failed)
            raise
        if answer is not Answer.CONTINUE:
            self._leave(failed)
        return answer

    def __resumed__(self) -> Answer | None:
        """Continue with the parts after the one whose error was corrected.

        If one of them fails, its `error` is called, and then this again.
        """
        number = self._at
        if number == NOBODY:
            return None
        answer = self.parts[number].__resumed__()
        if answer is not None:
            answer = self._give_up(number, answer)
        elif self._rest is not None:
            answer = self._rest(number + 1)
        self._rest, self._at = None, NOBODY
        return answer

    def _leave(self, failed: list[int]) -> None:
        """Turn off the parts that did not fail, whatever fails in that.

        Raises:
            Exception: What the first of them raised.
        """
        self._failed, self._rest = failed, None
        for number in failed:
            self._on[number] = False
        first: BaseException | None = None
        while any(self._on):
            try:
                self._turn_off()
            except _RAISED as error:
                first = first or error
        self._at = NOBODY
        if first is not None:
            raise first

    def clear(self) -> Answer:
        """Ask the parts that failed."""
        for number in self._failed or range(len(self.parts)):
            self._at = number
            answer = self.parts[number].clear()
            if answer is not Answer.OFF:
                return answer
        self._failed = []
        self._at = NOBODY
        return Answer.OFF

    def timing_failure(self, kind: TimingFailure) -> Recovery | None:
        """Ask the part that runs; before the first of them, every part."""
        if self._at != NOBODY:
            return self._late(self._at, kind)
        answers = [
            self._late(number, kind) or Recovery.CONTINUE
            for number in range(len(self.parts))
        ]
        return min(answers, key=_URGENCY.index)

    def _late(self, number: int, kind: TimingFailure) -> Recovery | None:
        made = type(self).__classes__[number]
        if "timing_failure" in made.cls.__interface__.methods:
            return self.parts[number].timing_failure(kind)
        self.task.warn(
            f"timing failure in part {made.part.name}, {kind}: {kind.meaning}"
        )
        return None

    # -- parameters -------------------------------------------------------------------

    def set(self, name: str, value: object) -> None:
        """Hand a changed parameter to its part, which may refuse it."""
        number, field = self._owner(name)
        part = self.parts[number]
        before = part.params
        part.params = type(before)(**{
            one: getattr(self.params, combined_field(number, one))
            for one in before.__declared__
        })
        try:
            part.set(field, value)
        except BaseException:
            part.params = before
            raise

    def get(self, name: str) -> object:
        """Return a parameter as its part gives it."""
        number, field = self._owner(name)
        return self.parts[number].get(field)

    def _owner(self, name: str) -> tuple[int, str]:
        """Return the part of a parameter, and what the part calls it."""
        return next(
            (number, field)
            for number, part in enumerate(self.parts)
            for field in part.params.__declared__
            if combined_field(number, field) == name
        )


def _gravity(answer: object) -> int:
    """Return the rank of an answer; an invalid one comes first."""
    return _GRAVITY.index(answer) if isinstance(answer, Answer) else NOBODY


def combine(
    name: str,
    parts: Sequence[PartClass],
    published: Iterable[str],
    *,
    where: str = "",
) -> type[Combined]:
    """Return the module that several modules are together.

    Args:
        name: What its class is called.
        parts: In the order in which they run.
        published: Variables that it writes to the table; all others that a part
            writes are inner.
        where: The place that errors name.

    Raises:
        DeclarationError: They cannot be combined; see `faults`.
    """
    told, published = [made.part for made in parts], tuple(published)
    for fault in faults(told, published):
        raise fault.error(where or name)
    whole = combination(told, published)
    written = methods(told)
    waiting = [p.name for p in told if "sync" in p.methods]
    if len(waiting) > 1:
        raise DeclarationError(
            f"the parts {' and '.join(waiting)} both write sync",
            where=where or name,
            expected="at most one part that waits for its event",
            remedy="run the others as separate tasks",
        )
    cls: Any = type(name.replace("-", "_"), (Combined,), {"__module__": __name__})
    cls.__classes__ = tuple(parts)
    cls.__interface__ = Interface(whole.ports, written, signals(told))
    cls.__within__ = whole.within
    cls.__params__ = combine_params({
        made.part.name: made.cls.__params__ for made in parts
    })
    for port in whole.ports:
        setattr(cls, port.attr, attribute(port))
    made: type[Combined] = cls
    return made
