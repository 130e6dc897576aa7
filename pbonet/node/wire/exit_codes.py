"""Exit codes of processes, in words."""

from __future__ import annotations

import signal
from typing import Final

ORPHANED: Final = 256
"""Exit code of a task that outlived its fork server: the real one is unknown."""


def describe_end(code: int) -> str:
    """Return an exit code in words."""
    if code == ORPHANED:
        return "its fork server has ended"
    if code >= 0:
        return f"exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = str(-code)
    words = {
        "SIGSEGV": " (segmentation fault)",
        "SIGKILL": " (killed)",
        "SIGABRT": " (abort)",
        "SIGBUS": " (bus error)",
        "SIGILL": " (illegal instruction)",
        "SIGFPE": " (arithmetic fault in native code)",
        "SIGALRM": " (did not turn itself off in time)",
    }
    return f"signal {name}{words.get(name, '')}"
