"""Prepares the types of messages before several threads decode them.

msgspec (0.22) prepares a `Struct` at its first decoding, which runs Python code and so
lets other threads run. A thread that decodes into it meanwhile finds it half prepared,
and the process ends with SIGSEGV. Once prepared, a type is safe for all threads.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
from msgspec import Struct

if TYPE_CHECKING:
    from types import ModuleType


def prepare(*modules: ModuleType) -> None:
    """Prepare every `Struct` of the modules; called while one thread imports them."""
    for module in modules:
        for one in vars(module).values():
            if isinstance(one, type) and issubclass(one, Struct):
                msgspec.msgpack.Decoder(one)
