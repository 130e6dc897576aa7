"""Converts values that msgpack cannot encode."""

from __future__ import annotations

import sys
from operator import methodcaller
from typing import cast

UNTOLD = TypeError, ValueError, OverflowError, RecursionError
"""Exceptions of `rtpu_messages.encode` for values that msgpack cannot encode."""


def readable(text: str) -> str:
    r"""Return a text that UTF-8 can encode.

    Python represents bytes of file names that are not UTF-8 as lone surrogates; they
    become escapes as in ``\udcff``.
    """
    return text.encode(errors="backslashreplace").decode()


def readable_tree(tree: object) -> object:
    """Return the result of `msgspec.to_builtins` with each text `readable`."""
    if isinstance(tree, str):
        return readable(tree)
    if isinstance(tree, dict):
        items = cast("dict[object, object]", tree).items()
        return {readable_tree(key): readable_tree(value) for key, value in items}
    if isinstance(tree, list | tuple):
        return [readable_tree(one) for one in cast("list[object]", tree)]
    return tree


def of_numpy(value: object) -> object:
    """Return a number or array of numpy as Python's own.

    Raises:
        TypeError: It is another type, or contains values that no message can.
    """
    np = sys.modules.get("numpy")  # a process without it has no such value
    if np is not None and isinstance(value, np.generic | np.ndarray):
        plain: object = methodcaller("tolist")(value)
        if not isinstance(plain, np.generic | complex):
            return plain
    raise TypeError(f"a {type(value).__name__} cannot be sent")
