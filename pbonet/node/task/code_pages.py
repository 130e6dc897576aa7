"""Pages with the code that runs a task, which the task copies before its first cycle.

They are shared with the fork server. Python counts references to code, and changes it
when it runs, so a page of it would be copied in the cycle that first has a timing
failure or raises an exception, just when time is short.
"""

from __future__ import annotations

import functools
import gc
import mmap
import sys
from types import CodeType, FunctionType
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

RUNNING: Final = (
    *("pbonet.node.task", "pbonet.outside", "pbonet.pbo", "pbonet.ports"),
    *("pbonet.errors", "contextlib", "enum", "traceback"),
)
"""Packages and modules whose functions are called between a module's methods."""


@functools.cache
def code_pages() -> tuple[tuple[int, int], ...]:
    """Return where the pages begin and end, in ascending order.

    The first call is the fork server's, before it freezes its objects: the collector
    does not name frozen ones. Tasks have them at the same addresses.
    """
    pages: set[int] = set()
    for one in _objects():
        first = id(one) // mmap.PAGESIZE
        size = sys.getsizeof(one) if isinstance(one, CodeType) else 1
        pages.update(range(first, (id(one) + size - 1) // mmap.PAGESIZE + 1))
    begins = sorted(page for page in pages if page - 1 not in pages)
    ends = sorted(page + 1 for page in pages if page + 1 not in pages)
    return tuple(
        (begin * mmap.PAGESIZE, end * mmap.PAGESIZE)
        for begin, end in zip(begins, ends, strict=True)
    )


def _objects() -> Iterator[object]:
    """Yield functions and classes with what they name: all that is counted."""
    for name, module in [*sys.modules.items()]:
        if name.startswith(RUNNING):
            yield from vars(module).values()
    objects: list[object] = gc.get_objects()
    for found in objects:
        if type(found) is FunctionType and str(found.__module__).startswith(RUNNING):
            yield found
            yield from _nested(found.__code__)
        elif issubclass(type(found), type) and str(found.__module__).startswith(
            RUNNING
        ):
            yield found
            yield from vars(found).values()


def _nested(code: CodeType) -> Iterator[object]:
    """Yield a function's code and constants, and those of the functions in it."""
    yield code
    yield code.co_consts
    for constant in code.co_consts:
        yield constant
        if isinstance(constant, CodeType):
            yield from _nested(constant)
