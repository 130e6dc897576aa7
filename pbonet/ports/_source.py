"""The source place of a declaration, and its annotations one by one."""

from __future__ import annotations

import re
import sys
from typing import TYPE_CHECKING, Any

from pbonet.errors import DeclarationError

if TYPE_CHECKING:
    import ast
    from collections.abc import Iterator
    from types import FrameType


def here(depth: int = 1) -> FrameType | None:
    """Return the frame `depth` calls above the caller."""
    # As `inspect` does, which takes long to load.
    frame: FrameType | None = sys._getframe()  # noqa: SLF001 # pyright: ignore[reportPrivateUsage]
    for _ in range(depth + 1):
        frame = frame.f_back if frame else None
    return frame


class Declaring:
    """One class body while its declarations are read.

    Args:
        cls: The class that is being made.
        frame: The frame in which its ``class`` statement runs.
    """

    def __init__(self, cls: type, frame: FrameType | None) -> None:
        self.cls = cls
        self._file = frame.f_code.co_filename if frame else ""
        self._line = frame.f_lineno if frame else 0
        self._globals = frame.f_globals if frame else {}
        self._locals = dict(frame.f_locals) if frame else {}

    def place(self, attr: str = "") -> str:
        """Return ``module.Class.attr (line N)``, or ``(source unknown)`` for N.

        A class without a source of its own brings the places as ``__places__``.
        """
        if places := vars(self.cls).get("__places__"):
            return str(places.get(attr) or places[""])
        outer, _, module = self.cls.__module__.partition(".")
        if not outer.startswith("_") or not module:  # a library's folder has no name
            module = self.cls.__module__
        name = f"{module}.{self.cls.__qualname__}"
        if attr:
            name += f".{attr}"
        line = self._find(attr)
        return f"{name} (line {line})" if line else f"{name} (source unknown)"

    def error(self, attr: str, what: str, **parts: str) -> DeclarationError:
        """Return the error for the declaration of `attr`."""
        return DeclarationError(what, where=self.place(attr), **parts)

    def annotations(self, marks: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
        """Yield every annotation of this class body, strings evaluated.

        A string that cannot be evaluated is no fault unless it is an ``Annotated`` or
        contains one of `marks`: a module may annotate other attributes with names that
        only a type checker knows.
        """
        import inspect  # takes long, and only where a class is declared

        try:
            own = inspect.get_annotations(self.cls)
        except NameError as error:  # Python 3.14 evaluates here
            raise self.error("", str(error), remedy=_RUN_TIME) from None
        names = {**self._locals, **vars(self.cls)}
        for attr, hint in own.items():
            if not isinstance(hint, str):
                yield attr, hint
                continue
            try:
                value = eval(hint, dict(self._globals), names)  # noqa: S307
            except Exception as error:  # noqa: BLE001 - it may be anything
                if _ANNOTATED.search(hint) or any(mark in hint for mark in marks):
                    raise self.error(
                        attr,
                        "the annotation cannot be evaluated",
                        got=f"{type(error).__name__}: {error}",
                        remedy=_RUN_TIME if isinstance(error, NameError) else "",
                    ) from None
            else:
                yield attr, value

    def _find(self, attr: str) -> int:
        """Return the line of `attr` (or of the class) in the source, 0 if unknown."""
        import ast
        import linecache

        linecache.checkcache(self._file)
        lines = linecache.getlines(self._file)
        try:
            tree = ast.parse("".join(lines))
        except (SyntaxError, ValueError):
            return 0
        classes = [
            node
            for node in ast.walk(tree)
            if isinstance(node, ast.ClassDef) and node.name == self.cls.__name__
        ]
        if not classes:
            return 0
        near = min(classes, key=lambda node: abs(node.lineno - self._line))
        for node in near.body:
            if attr and attr in _names(node):
                return node.lineno
        return near.lineno


_ANNOTATED = re.compile(r"\b(A|Annotated)\[")
_RUN_TIME = (
    "correct the name, or import it at run time and not under TYPE_CHECKING only"
)


def _names(node: ast.stmt) -> set[str]:
    """Return the names that a statement of a class body binds."""
    import ast

    if isinstance(node, ast.AnnAssign):
        return {node.target.id} if isinstance(node.target, ast.Name) else set()
    if isinstance(node, ast.Assign):
        return {target.id for target in node.targets if isinstance(target, ast.Name)}
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        return {node.name}
    return set()
