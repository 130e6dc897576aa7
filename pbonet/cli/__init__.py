"""The command line: one verb a file, no logic.

Errors of pbonet end a verb with status 1 and a message of four parts, wrong usage with
status 2, an interrupt with status 130. ``--json`` gives data, also for an error;
``--debug`` adds the stack to a message.

Each start loads only what its words need: ``--version`` nothing, a verb what it uses.
What it loads stays to its end, so the garbage collector seldom runs.
"""

from __future__ import annotations

import gc
import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


_COLLECT_AFTER = 20_000
"""New objects before the garbage collector runs; the 700 of Python are reached
about thirty times while a verb loads."""


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its status."""
    own_process = argv is None
    words = sys.argv[1:] if argv is None else list(argv)
    if own_process:
        gc.set_threshold(_COLLECT_AFTER)
    _have_streams()
    try:
        status = _run(words)
        sys.stdout.flush()
    except KeyboardInterrupt:
        status = 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 1
    if own_process and "ruckig" not in sys.modules:
        # Else the last collection walks over all that was loaded. It frees what modules
        # in virtual time have; ruckig writes 30 lines about each that is not.
        gc.freeze()
    sys.exit(status)


def _run(words: list[str]) -> int:
    if words == ["--version"]:
        import pbonet

        print(f"pbonet {pbonet.__version__}")
        return 0
    from . import program

    return program.run(words)


def _have_streams() -> None:
    """Have output go nowhere where it was closed, for which Python has None."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
