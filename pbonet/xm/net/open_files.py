"""The number of files that a process may have open (``ulimit -n``)."""

from __future__ import annotations

import contextlib
import errno
import resource
from typing import Final

from pbonet.errors import NodeError

LEAST: Final = 64
"""Files that an agent or a master may have to open.

An agent of one task has 35 open, its RTPU process 13 and 6 for each task, a master of
two RTPUs 21; a request takes some more for a moment.
"""
_HOW: Final = (
    "ulimit -Hn, LimitNOFILE= of the service, or nofile in /etc/security/limits.conf"
)
_NONE_LEFT: Final = (errno.EMFILE, errno.ENFILE)


def ensure(where: str) -> None:
    """Let this process, and those it starts, open as many files as they may.

    Args:
        where: The process, for the error.

    Raises:
        NodeError: They are too few even so.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
            soft = hard
    if 0 <= soft < LEAST:
        raise NodeError(
            "too few files may be open at the same time",
            where=where,
            expected=f"at least {LEAST}",
            got=f"a hard limit of {soft}",
            remedy=f"raise it: {_HOW}",
        )


def used_up(where: str, error: Exception) -> NodeError | None:
    """Return the error for an exception that says that no more files can be opened.

    Args:
        where: The process.
        error: The exception; None is returned for any other one.
    """
    if not isinstance(error, OSError) or error.errno not in _NONE_LEFT:
        return None
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return NodeError(
        "no more files can be opened",
        where=where,
        expected=f"at most {soft} at the same time",
        got=str(error),
        remedy=f"use fewer tasks there, or raise the limit: {_HOW}",
    )
