"""Packs the answers to requests, including every kind of failure."""

from __future__ import annotations

import traceback
from typing import TYPE_CHECKING

from pbonet.errors import NodeError, PbonetError, StateError, SvarFullError
from pbonet.xm.net import codec, messages as m, open_files

if TYPE_CHECKING:
    from collections.abc import Callable

_DISK_FULL = 28


class Answers:
    """Packs results and failures.

    Args:
        rtpu: The RTPU that answers.
        report: Called with the text of an exception that is not an error of pbonet.
    """

    def __init__(self, rtpu: str, report: Callable[[str], None]) -> None:
        self._rtpu, self._report = rtpu, report
        self._codec = codec.Codec()

    def good(self, request: m.Request, result: object, warnings: list[str]) -> bytes:
        """Return the answer with a result.

        Raises:
            NodeError: It is too long.
        """
        answer = m.Answer(
            v=request.v, id=request.id, ok=True, result=result, warnings=warnings
        )
        data = self._codec.pack(answer)
        if len(data) > codec.Codec.MAX_BYTES:
            raise NodeError(
                "the answer is too long",
                expected=f"at most {codec.Codec.MAX_BYTES} bytes",
                got=f"{len(data)} bytes",
                remedy="ask for less at once, by name",
            )
        return data

    def bad(self, request: m.Request, error: Exception) -> bytes:
        """Return the answer with an error; foreign exceptions are reported."""
        if not isinstance(error, PbonetError):
            error = self._fault(request, error)
        return self._codec.pack(codec.failure(error, request.id, request.v))

    def _fault(self, request: m.Request, error: Exception) -> PbonetError:
        """Return the error for an exception that is not an error of pbonet."""
        if isinstance(error, OSError) and error.errno == _DISK_FULL:
            return SvarFullError(
                "no room is left in shared memory",
                where=self._rtpu,
                got=str(error),
                remedy="free space in /dev/shm, or enlarge it",
            )
        if limited := open_files.used_up(self._rtpu, error):
            return limited
        op = type(request).__name__
        text = f"{op} failed inside pbonet: {type(error).__name__}: {error}"
        trace = "".join(traceback.format_exception(error))
        self._report(f"{text}\n{trace}")
        return NodeError(
            text,
            where=self._rtpu,
            remedy="report it, with the agent's events",
            debug=trace,
        )


def being_stopped(rtpu: str, subsystem: str) -> StateError:
    """Return the error for a request to a subsystem that is being stopped."""
    return StateError(
        f"subsystem {subsystem} is being stopped",
        where=rtpu,
        remedy="wait until the stop is done",
    )
