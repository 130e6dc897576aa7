"""A command session: one interface to a subsystem takes command lines, gives replies.

Each interface has a session of its own: its default RMOD, its columns of `status`, and
what it has seen (Stewart 1994, section 4.4.1). Nothing here prints or reads.
"""

from __future__ import annotations

import math
import shlex
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec
from msgspec import Struct

from pbonet.errors import (
    ClaimError,
    NodeError,
    StateError,
    UnknownTaskError,
    did_you_mean,
)
from pbonet.master.subsystem import collected, is_sequence, sequence

from .commands import BY_NAME, Arg, Command, Kind, Scope, find
from .session_state import SessionState

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


_LONGEST: Final = 1000
"""Characters of a word; a longer one is no name and no number."""


class Reply(Struct, frozen=True, kw_only=True):
    """The result of a command."""

    command: str
    data: dict[str, Any]
    warnings: list[str] = []


class Call(Struct, frozen=True):
    """A command with its arguments, ready to be carried out."""

    command: Command
    given: dict[str, Any]

    @property
    def changes(self) -> bool:
        """Whether it will change the subsystem; some commands can also only show."""
        if self.command.name == "freq":
            return self.given.get("hz") is not None
        if self.command.name == "sigmask":
            return bool(self.given.get("signal"))
        if self.command.name == "set":
            return bool(self.given.get("value"))
        return self.command.changes and not self.given.get("dry_run")

    @property
    def task(self) -> str:
        """The task whose RTPU alone is asked; empty if other RTPUs matter, too."""
        return self.given.get("task") or "" if self.command.alone else ""

    @property
    def words(self) -> dict[str, Any]:
        """The arguments that are not empty, as `convert` takes them from a message."""
        return {
            arg.name: self._words(arg, value)
            for arg in self.command.args
            if (value := self.given.get(arg.name)) not in (None, [])
        }

    @staticmethod
    def _words(arg: Arg, value: Any) -> Any:  # noqa: ANN401 - by its kind
        if arg.commas:
            return ",".join(value)
        if arg.kind is Kind.ITEM:
            return [":".join(one) for one in value]
        return value


class CommandSession(SessionState):
    """Takes commands for one interface, and carries them out."""

    @property
    def prompt(self) -> str:
        """The prompt of section 4.4.1: subsystem and default RMOD."""
        return f"SBS {self.subsystem.name}<{self.default}> "

    def read(self, line: str) -> Call | None:
        """Parse a command line; None for a blank line or a comment.

        Raises:
            PbonetError: The line is wrong.
        """
        return read(line, self._knows)

    def execute(self, line: str) -> Reply | None:
        """Carry out one command line; None for a blank line or a comment.

        Raises:
            PbonetError: The line is wrong, or the command failed.
        """
        call = self.read(line)
        return None if call is None else self.perform(call)

    def call(self, name: str, args: Mapping[str, object]) -> Reply:
        """Carry out a command with arguments by name.

        Raises:
            PbonetError: An argument is wrong, or the command failed.
        """
        command = find(name)
        return self.perform(Call(command, convert(command, args)))

    def perform(self, call: Call) -> Reply:
        """Carry out a command.

        Raises:
            PbonetError: It failed.
        """
        command = call.command
        if command.scope is Scope.PROMPT and self.hand_over is None:
            raise StateError(
                f"{command.name} is not available here",
                remedy="it is for the prompt and for scripts",
            )
        if call.changes and self.subsystem.watch:
            raise ClaimError(
                f"{command.name} changes the subsystem, which is open for reading only",
                where=self.subsystem.name,
                remedy="give it at the prompt of 'pbonet prompt', or as a verb",
            )
        try:
            with collected() as warnings:
                given = self._with_default(command, call.given)
                run = command.run
                data = run(self, given) if run else self._pass_on(command, given)
        finally:
            if self.default and self.default not in self.subsystem.model:
                self.default = ""  # it was killed, or never there
        return Reply(command=command.name, data=data, warnings=warnings)

    def _pass_on(self, command: Command, given: dict[str, Any]) -> dict[str, Any]:
        """Call the method that has the command's name; return its result as data."""
        method = getattr(self.subsystem, command.name.replace(" ", "_"))
        result: Any = msgspec.to_builtins(method(**given))
        if names := given.get(command.points, []):
            self.default = names[-1] if isinstance(names[-1], str) else names[-1][0]
        if not command.shows:
            return cast("dict[str, Any]", result) if isinstance(result, dict) else {}
        one = [arg.name for arg in command.args if arg.last and not arg.many]
        return {name: given[name] for name in one} | {command.shows: result}

    def _with_default(self, command: Command, given: dict[str, Any]) -> dict[str, Any]:
        """Return the arguments that are not empty, with the tasks a command is for.

        The default is used if no task is named; a named task becomes the default.

        Raises:
            UnknownTaskError: A task must be named, and there is no default.
        """
        given = {name: word for name, word in given.items() if word not in (None, [])}
        for arg in command.args:
            if not arg.last:
                continue
            named = given.get(arg.name) or self.default
            if not named:  # the next word may have been meant as one
                raise self._no_task(next(iter(given.values()), ""))
            names = dict.fromkeys([named] if isinstance(named, str) else named)
            given[arg.name] = [*names] if arg.many else named
            self.default = [*names][-1]
        return {arg.name: given[arg.name] for arg in command.args if arg.name in given}

    def _no_task(self, word: object) -> UnknownTaskError:
        """Return the error for a command that needs a task and has none."""
        text = word if isinstance(word, str) else ""
        known = self.subsystem.model.names
        return UnknownTaskError(
            f"the subsystem has no task {text}" if text else "no task is named",
            got="tasks: " + (", ".join(known) or "none"),
            remedy=did_you_mean(text, known) or "name one, or 'spawn' one first",
        )

    def _knows(self, task: str) -> bool:
        return task in self.subsystem.model


def read(line: str, knows: Callable[[str], bool]) -> Call | None:
    """Parse a command line; None for a blank line or a comment.

    Args:
        line: The line.
        knows: Tells whether the subsystem has a task of a name.

    Raises:
        PbonetError: The line is wrong.
    """
    try:
        words = shlex.split(line, comments=True)
    except ValueError as error:
        raise StateError(
            "the line is not understood", got=str(error), remedy="close the quotes"
        ) from None
    if not words:
        return None
    command, words = split_name(words)
    return Call(command, bind(command, words, knows))


def split_name(words: list[str]) -> tuple[Command, list[str]]:
    """Return the command that the first word or two name, and the other words.

    Raises:
        NodeError: There is no such command.
    """
    if len(words[0]) > _LONGEST:
        raise NodeError(
            f"there is no command of {len(words[0])} characters", remedy="see 'help'"
        )
    both = " ".join(words[:2])
    if both in BY_NAME:
        return BY_NAME[both], words[2:]
    return find(words[0]), words[1:]


def bind(
    command: Command, words: list[str], knows: Callable[[str], bool]
) -> dict[str, Any]:
    """Return a command's arguments from the words of its line.

    A task that may be left out is there when the word names one, or when there would
    be words too many otherwise. What may be left out can be given by name too, so that
    ``spawn diff hz=40`` leaves the RTPU to the RMOD.

    Args:
        command: The command.
        words: The words after its name.
        knows: Tells whether the subsystem has a task of a name.

    Raises:
        StateError: Words are missing, too many, or wrong.
    """
    given: dict[str, Any] = {}
    named = command.named
    plain: list[str] = []
    for word in words:
        name, equals, value = word.partition("=")
        if equals and name in named:
            arg = named[name]
            given[arg.name] = _value(command, arg, value)
        else:
            plain.append(word)
    places = [a for a in command.args if not a.option and a.name not in given]
    while places:
        arg = places.pop(0)
        if arg.many:
            given[arg.name] = [_value(command, arg, word) for word in plain]
            plain = []
        elif plain and not _left_out(arg, plain, places, knows):
            given[arg.name] = _value(command, arg, plain.pop(0))
    if plain:
        raise _usage(command, f"one word too many: {plain[0]}")
    _must_be_complete(command, given)
    return given


def _left_out(
    arg: Arg, words: list[str], rest: list[Arg], knows: Callable[[str], bool]
) -> bool:
    """Return whether the next word is something other than the optional task."""
    if arg.kind is not Kind.TASK or arg.need or not rest:
        return False
    room = any(one.many for one in rest) or len(words) <= len(rest)
    return room and not knows(words[0])


def convert(command: Command, args: Mapping[str, object]) -> dict[str, Any]:
    """Return a command's arguments from the map in a message.

    Raises:
        StateError: An argument is unknown, missing, or of the wrong type.
    """
    known = {arg.word: arg for arg in command.args}
    known |= {arg.name: arg for arg in command.args}
    given: dict[str, Any] = {}
    for name, value in args.items():
        arg = known.get(name)
        if arg is None:
            raise StateError(
                f"{command.name} has no argument {name}",
                expected=command.usage,
                remedy=did_you_mean(name, known),
            )
        if value is None:
            continue
        found = [_value(command, arg, _word(one)) for one in sequence(value)]
        if not arg.many and len(found) != 1:
            raise _usage(command, f"{name} is one value")
        given[arg.name] = found if arg.many else found[0]
    _must_be_complete(command, given)
    return given


def _word(value: object) -> str:
    """Return a value of a message as the word it would be on a command line."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if is_sequence(value):
        return ":".join(map(str, value))
    return str(value)


def _must_be_complete(command: Command, given: dict[str, Any]) -> None:
    for arg in command.args:
        if arg.need and not given.get(arg.name):
            raise _usage(command, f"{arg.name.upper()} is missing")


def _value(command: Command, arg: Arg, word: str) -> Any:  # noqa: ANN401 - by its kind
    """Return the value of a word."""
    if len(word) > _LONGEST:
        raise _usage(command, f"{arg.name.upper()} has {len(word)} characters")
    if arg.kind in {Kind.NUMBER, Kind.COUNT, Kind.SECONDS}:
        return _number(command, arg, word)
    if arg.kind is Kind.FLAG:
        if word not in {"yes", "no"}:
            raise _usage(command, f"{arg.word} is yes or no, not {word}")
        return word == "yes"
    if arg.kind is Kind.ITEM:
        task, colon, signal = word.partition(":")
        if not colon or not task or not signal:
            raise _usage(command, f"no TASK:SIGNAL, such as pid:off: {word}")
        return (task, signal)
    if arg.kind is not Kind.WORD and not word:
        raise _usage(command, f"{arg.name.upper()} is empty")
    return [name for name in word.split(",") if name] if arg.commas else word


def _number(command: Command, arg: Arg, word: str) -> float | int:
    unit = 1.0
    if arg.kind is Kind.SECONDS:
        unit = 1e-3 if word.endswith("ms") else 1.0
        word = word.removesuffix("s").removesuffix("m") or word
    try:
        number = int(word) if arg.kind is Kind.COUNT else unit * float(word)
    except ValueError:
        raise _usage(command, f"{arg.name.upper()} is not a number: {word}") from None
    if not math.isfinite(number):
        raise _usage(command, f"{arg.name.upper()} is not finite: {word}")
    if arg.kind is Kind.COUNT and number < 0:
        raise _usage(command, f"{arg.name.upper()} is below 0: {word}")
    return number


def _usage(command: Command, what: str) -> StateError:
    return StateError(
        f"{command.name}: {what}",
        expected=command.usage,
        remedy=f"'help {command.name}' explains it",
    )
