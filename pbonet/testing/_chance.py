"""Random numbers from sources that no log has: which a module used, and where.

The functions that give such numbers are replaced while modules are run again. They
give the same numbers, and note the line of the module that asked for them. A generator
that the module has seeded is no such source. Two cases are noted although they could be
left out: ``numpy.random.RandomState(3)``, because numpy asks the system for random
bytes before it uses the seed, and a shared generator that is seeded while the module
loads, because that is done once for several lives of a task.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import os
import random
import sys
import sysconfig
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pbonet.pbo import line_of

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Sequence
    from types import FrameType, ModuleType

_DEVICES: Final = frozenset({"/dev/random", "/dev/urandom"})
_SEEDING: Final = frozenset({"seed", "set_bit_generator", "set_state", "setstate"})
_STDLIB: Final = sysconfig.get_path("stdlib") + os.sep
_NUMPY: Final = str(Path(np.__file__).parent) + os.sep
_PBONET: Final = str(Path(__file__).parents[1]) + os.sep
_MODULES: Final = _PBONET + "modules" + os.sep


class Chance:
    """The first random number of a task or simulation that no log has."""

    def __init__(self) -> None:
        self.first = ""
        """The function or device, and the line; empty: there was no such number."""
        self.seeded: set[str] = set()
        """Shared generators that the module has seeded."""
        self.states: dict[str, Any] = {}
        """Their states while another task runs; each had a process of its own."""

    def loaded_from(self, files: Sequence[str]) -> None:
        """Note the numbers that a module used while it was loaded, maybe long ago."""
        self.first = next(filter(None, map(_watch.at_load.get, files)), "")

    def __str__(self) -> str:
        """Return why outputs may differ; empty: there was no such number."""
        if not self.first:
            return ""
        return (
            f"it uses {self.first}, whose numbers are in no log "
            "(those of self.task.rng are drawn again)"
        )


class _Watch:
    """Notes random numbers for the task that runs now."""

    def __init__(self) -> None:
        self.chance: Chance | None = None
        self.at_load: dict[str, str] = {}
        """By file, the first number that was used while it was loaded."""
        self._generators: dict[str, tuple[Callable[[], Any], Callable[[Any], Any]]] = {}
        """How the state of each shared generator is read and set."""
        self._hooked = False

    @contextmanager
    def sources(self) -> Generator[None]:
        """Replace the functions that give random numbers, in this block."""
        shared: Any = importlib.import_module("numpy.random.mtrand")
        entropy: Any = importlib.import_module("numpy.random.bit_generator")
        self._generators = {
            "random": (random.getstate, random.setstate),
            "numpy.random": (shared.get_state, shared.set_state),
        }
        if not self._hooked:  # a hook stays as long as its process
            sys.addaudithook(self._on_audit)
            self._hooked = True
        with ExitStack() as stack:
            self._replace_shared(stack, "random", random)
            self._replace_shared(stack, "numpy.random", shared, np.random)
            for name, function, *places in (
                ("os.urandom", os.urandom, os, random),
                ("os.getrandom", os.getrandom, os),
                ("numpy.random", entropy.randbits, entropy),
            ):
                _put(stack, function, self._drawing(name, "", function), *places)
            own: Any = random.Random  # noqa: S311 - the class
            _put(stack, own.seed, self._own_seed(own.seed), own)
            yield

    def switch(self, chance: Chance | None) -> Chance | None:
        """Note for another task from now, with its shared generators; return the last.

        A generator that the task has not seeded is left as it is.
        """
        before, self.chance = self.chance, chance
        if before is not None:
            before.states = {
                name: self._generators[name][0]() for name in before.seeded
            }
        for name, state in chance.states.items() if chance is not None else ():
            self._generators[name][1](state)
        return before

    def _replace_shared(
        self, stack: ExitStack, name: str, *modules: ModuleType
    ) -> None:
        """Replace the functions of a generator that a whole process shares."""
        for each, function in list(vars(modules[0]).items()):
            if each.startswith("_") or isinstance(function, type):
                continue
            if callable(function):
                make = self._seeding if each in _SEEDING else self._drawing
                _put(stack, function, make(f"{name}.{each}", name, function), *modules)

    def _drawing(self, name: str, generator: str, function: Any) -> Any:  # noqa: ANN401
        @functools.wraps(function)
        def draw(*args: Any, **more: Any) -> Any:  # noqa: ANN401
            self._draw(name, generator, inspect.currentframe())
            return function(*args, **more)

        return draw

    def _seeding(self, _name: str, generator: str, function: Any) -> Any:  # noqa: ANN401
        @functools.wraps(function)
        def seed(*args: Any, **more: Any) -> Any:  # noqa: ANN401
            if self.chance is not None:
                self.chance.seeded.discard(generator)
                if any(one is not None for one in (*args, *more.values())):
                    self.chance.seeded.add(generator)
            return function(*args, **more)

        return seed

    def _own_seed(self, function: Any) -> Any:  # noqa: ANN401
        """Return the method that seeds a generator of a module's own."""

        @functools.wraps(function)
        def seed(own: random.Random, a: Any = None, version: int = 2) -> None:  # noqa: ANN401
            if a is None:
                self._draw("random.Random", "", inspect.currentframe())
            function(own, a, version)

        return seed

    def _on_audit(self, event: str, args: tuple[Any, ...]) -> None:
        if self.chance is None or event != "open":
            return
        path = os.fsdecode(args[0]) if isinstance(args[0], bytes) else str(args[0])
        if path in _DEVICES:
            self._draw(path, "", inspect.currentframe())

    def _draw(self, source: str, generator: str, frame: FrameType | None) -> None:
        """Note a number, if a module asked for it.

        Args:
            source: The function or device that gives it.
            generator: The shared generator that it belongs to; empty: none.
            frame: Of the function that replaces the one that gives it.
        """
        chance = self.chance
        if chance is not None and (chance.first or generator in chance.seeded):
            return
        called, calls = source, _callers(frame)
        for one in calls:
            file = one.f_code.co_filename
            if _is_library(file):
                called = _name_of(one)
                continue
            if file.startswith(_PBONET) and not file.startswith(_MODULES):
                return  # the runtime's own
            name = source if source in _DEVICES else called
            first = f"{name} at {line_of(one)}"
            if chance is not None:
                chance.first = first
            self._note_load(first, one)
            return

    def _note_load(self, first: str, frame: FrameType | None) -> None:
        """Note a number for each file that is being loaded."""
        while frame is not None:
            if frame.f_code.co_name == "<module>":
                self.at_load.setdefault(frame.f_code.co_filename, first)
            frame = frame.f_back


def _callers(frame: FrameType | None) -> Iterator[FrameType]:
    while frame is not None and (frame := frame.f_back) is not None:
        yield frame


def _is_library(file: str) -> bool:
    if file.startswith(_STDLIB):
        return "-packages" not in file
    return file.startswith(("<frozen ", _NUMPY))


def _name_of(frame: FrameType) -> str:
    name = frame.f_code.co_qualname.removesuffix(".__init__")
    return f"{frame.f_globals.get('__name__', '')}.{name}"


def _put(stack: ExitStack, old: object, new: object, *places: object) -> None:
    """Replace a function wherever it is, until the end of a block."""
    for place in places:
        for name, value in list(vars(place).items()):
            if value is old:
                setattr(place, name, new)
                stack.callback(setattr, place, name, old)


_watch = _Watch()
sources_watched = _watch.sources
"""A context in which `noting` has an effect."""


@contextmanager
def noting(chance: Chance) -> Generator[None]:
    """Note uses of random numbers in this block, within `sources_watched`."""
    before = _watch.switch(chance)
    try:
        yield
    finally:
        _watch.switch(before)
