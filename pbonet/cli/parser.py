"""Read the words of a verb as the signature of its function declares them.

A verb is a function whose arguments are keyword-only and annotated. One annotated with
``A[T, Argument()]`` is given by its place, one with ``A[T, Option()]`` by its name.
``T`` is `str`, `int`, `float`, `bool`, `Path`, a `Literal` of words, a list of one of
them, or one of them or None. An option of several words is a list of tuples of `str`.
"""

from __future__ import annotations

import math
import os
import re
from itertools import islice
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated as A,
    Any,
    Literal,
    NamedTuple,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

_NEGATIVE = re.compile(r"-(\.?\d|inf|nan)")
_KINDS = {int: "an integer", float: "a number"}
_METAVARS = {int: "N", float: "NUMBER", Path: "PATH", str: "TEXT"}


class UsageError(Exception):
    """Words that the verb does not take; the program then ends with status 2."""


class Argument(NamedTuple):
    """Arguments that are given by position."""

    help: str
    metavar: str = ""
    least: float | None = None


class Option(NamedTuple):
    """Options, given by name."""

    help: str
    metavar: str = ""
    names: tuple[str, ...] = ()
    """Its names, where they are not the parameter's."""
    env: str = ""
    """The environment variable that stands for it."""
    least: float | None = None
    most: float | None = None
    words: int = 1
    """How many words it takes each time."""


class Parameter(NamedTuple):
    """One argument or option of a verb."""

    name: str
    """The keyword under which the function gets its value."""
    help: str
    metavar: str
    names: tuple[str, ...] = ()
    """An option's names; an argument has none."""
    kind: type = str
    choices: tuple[str, ...] = ()
    many: bool = False
    need: bool = False
    default: Any = None
    env: str = ""
    least: float | None = None
    most: float | None = None
    words: int = 1
    stands_for: str = ""
    """The kind of thing a word names, such as ``task``; completion offers these."""

    @property
    def is_switch(self) -> bool:
        """Whether it is an option without a value."""
        return self.kind is bool

    @property
    def opposite(self) -> str:
        """The name that turns a switch off; empty where it is off by default."""
        on = self.is_switch and self.default is not False
        return f"--no-{self.names[0][2:]}" if on else ""

    @property
    def all_names(self) -> tuple[str, ...]:
        """An option's names, with the one that turns a switch off."""
        return (*self.names, self.opposite) if self.opposite else self.names

    @property
    def label(self) -> str:
        """The name in messages and help."""
        return self.names[0] if self.names else self.metavar

    def value(self, word: str) -> object:
        """Return the value of a word.

        Raises:
            UsageError: It is no such value, or out of range.
        """
        if self.choices and word not in self.choices:
            raise self._wrong(word, f"one of {', '.join(self.choices)}")
        try:
            found = self.kind(word)
        except ValueError:
            raise self._wrong(word, _KINDS[self.kind]) from None
        if isinstance(found, float) and not math.isfinite(found):
            raise self._wrong(word, "a finite number")
        if self.least is not None and not found >= self.least:
            raise self._wrong(word, f"at least {self.least:g}")
        if self.most is not None and not found <= self.most:
            raise self._wrong(word, f"at most {self.most:g}")
        return found

    def _wrong(self, word: str, expected: str) -> UsageError:
        return UsageError(f"{self.label} must be {expected} (got {word!r})")


class Compound(NamedTuple):
    """Several options that make one argument of the function."""

    parts: tuple[Parameter, ...]
    make: Callable[..., object]


class Verb(NamedTuple):
    """A verb: what it takes and what it does."""

    name: str
    help: str
    """The help text: one line, and more after a blank one."""
    examples: tuple[tuple[str, str], ...]
    """Command lines, each with what it is for."""
    parameters: tuple[Parameter, ...]
    run: Callable[..., int | None]
    compounds: Mapping[str, Compound] = {}
    shared: tuple[Parameter, ...] = ()
    """Options that the program acts on, not the function."""

    @property
    def summary(self) -> str:
        """The help text, in one line."""
        return self.help.partition("\n")[0]

    @property
    def arguments(self) -> list[Parameter]:
        """Arguments that are given by position."""
        return [one for one in self.parameters if not one.names]

    @property
    def options(self) -> list[Parameter]:
        """Options, given by name."""
        return [one for one in (*self.parameters, *self.shared) if one.names]

    @property
    def usage(self) -> str:
        """How it is called, in one line."""
        words = [f"pbonet {self.name}"]
        for one in self.arguments:
            word = one.metavar + " ..." * one.many
            words.append(word if one.need else f"[{word}]")
        words += [f"{o.names[0]} {o.metavar}" for o in self.options if o.need]
        return " ".join([*words, "[options]"])

    def call(self, given: dict[str, object]) -> int:
        """Carry it out with values by name, and return the exit status."""
        for one in self.shared:
            given.pop(one.name)
        for name, compound in self.compounds.items():
            parts = {part.name: given.pop(part.name) for part in compound.parts}
            given[name] = compound.make(**parts)
        return self.run(**given) or 0


def verb_of(function: Callable[..., int | None], name: str) -> Verb:
    """Return the verb that a function declares."""
    text, examples = split_help(function.__doc__ or "")
    hints = get_type_hints(function, include_extras=True)
    defaults = function.__kwdefaults__ or {}
    hints.pop("return", None)
    parameters: list[Parameter] = []
    compounds: dict[str, Compound] = {}
    for key, hint in hints.items():
        kind, (about, *_) = get_args(hint)[0], hint.__metadata__
        if isinstance(about, Compound):
            parameters += about.parts
            compounds[key] = about
        else:
            parameters.append(_parameter(key, kind, about, defaults))
    return Verb(name, text, examples, tuple(parameters), function, compounds)


def parameter(name: str, hint: object, default: object = None) -> Parameter:
    """Return the parameter that an annotation declares, for a compound."""
    kind, about = get_args(hint)
    return _parameter(name, kind, about, {name: default})


def split_help(doc: str) -> tuple[str, tuple[tuple[str, str], ...]]:
    """Return the text of a docstring, and its examples: a line and what it is for."""
    text, _, rest = doc.partition("Examples:")
    lines = [line.strip() for line in rest.splitlines() if line.strip()]
    purposes = [line.rstrip(":") + "." for line in lines[::2]]
    found = tuple(zip(lines[1::2], purposes, strict=True))
    return "\n".join(line.strip() for line in text.strip().splitlines()), found


def _parameter(
    name: str, hint: object, about: Argument | Option, defaults: Mapping[str, object]
) -> Parameter:
    kind, choices, many = _kind(hint)
    names: tuple[str, ...] = ()
    if isinstance(about, Option):
        names = about.names or (f"--{name.strip('_').replace('_', '-')}",)
    return Parameter(
        name,
        about.help,
        about.metavar or _metavar(name, kind, choices, option=bool(names)),
        names,
        kind=kind,
        choices=choices,
        many=many,
        need=name not in defaults,
        default=defaults.get(name),
        env=about.env if isinstance(about, Option) else "",
        least=about.least,
        most=about.most if isinstance(about, Option) else None,
        words=about.words if isinstance(about, Option) else 1,
    )


def _kind(
    hint: Any,  # noqa: ANN401 - an annotation
) -> tuple[type, tuple[str, ...], bool]:
    """Return the type of a value, the words it is one of, and whether it is a list."""
    if isinstance(hint, UnionType):
        return _kind(next(one for one in get_args(hint) if one is not NoneType))
    if get_origin(hint) is list:
        kind, choices, _ = _kind(get_args(hint)[0])
        return kind, choices, True
    if get_origin(hint) is A:
        return _kind(get_args(hint)[0])
    if get_origin(hint) is tuple:
        return str, (), False
    if get_origin(hint) is Literal:
        return str, get_args(hint), False
    return hint, (), False


def _metavar(name: str, kind: type, choices: tuple[str, ...], *, option: bool) -> str:
    if not option:
        return name.strip("_").upper()
    return "|".join(choices) or _METAVARS.get(kind, "")


# -- the words of a command line ------------------------------------------------------


def parse(verb: Verb, words: Sequence[str]) -> dict[str, object]:
    """Return a value for every parameter of a verb, by name.

    Raises:
        UsageError: A word is unknown, wrong, missing, or one too many.
    """
    given: dict[str, object] = {}
    plain: list[str] = []
    rest = iter(words)
    for word in rest:
        if word == "--":
            plain += rest
        elif word.startswith("-") and word != "-" and not _NEGATIVE.match(word):
            _take_option(verb, word, rest, given)
        else:
            plain.append(word)
    _take_arguments(verb.arguments, plain, given)
    for one in (*verb.parameters, *verb.shared):
        if one.name not in given:
            given[one.name] = _left_out(one)
        if one.need and given[one.name] is None:
            raise UsageError(f"{one.label} is missing: {one.help}")
    return given


def _take_option(
    verb: Verb, word: str, rest: Iterator[str], given: dict[str, object]
) -> None:
    name, equals, value = word.partition("=")
    if not name.startswith("--") and len(name) > len("-o"):  # -oFILE
        name, equals, value = word[:2], "=", word[2:]
    one = next((o for o in verb.options if name in o.all_names), None)
    if one is None:
        known = [name for o in verb.options for name in o.all_names]
        raise UsageError(f"there is no option {name}{_meant(name, known)}")
    if one.is_switch:
        if equals:
            raise UsageError(f"{name} takes no value (got {value!r})")
        given[one.name] = name in one.names
        return
    words = (value,) if equals else tuple(islice(rest, one.words))
    if len(words) < one.words or not (equals or all(words)):
        need = "a value" if one.words == 1 else f"{one.words} words"
        raise UsageError(f"{name} needs {need}: {name} {one.metavar}")
    found = one.value(words[0]) if one.words == 1 else words
    if one.many:
        values = cast("list[object]", given.setdefault(one.name, []))
        values.append(found)
    else:
        given[one.name] = found


def _take_arguments(
    arguments: Iterable[Parameter], words: list[str], given: dict[str, object]
) -> None:
    for one in arguments:
        if one.many:
            if words:
                given[one.name] = [one.value(word) for word in words]
            words = []
        elif words:
            given[one.name] = one.value(words.pop(0))
    if words:
        raise UsageError(f"one word too many: {words[0]}")


def _left_out(one: Parameter) -> object:
    """Return the value of a parameter that no word gives."""
    text = os.environ.get(one.env, "") if one.env else ""
    if not text:
        return one.default
    if one.many:
        words = text.split(os.pathsep) if one.kind is Path else text.split()
        return [one.value(word) for word in words if word]
    return one.value(text)


def _meant(name: str, known: Iterable[str]) -> str:
    from pbonet.errors import did_you_mean

    meant = did_you_mean(name, known)
    return f"; {meant}" if meant else ""
