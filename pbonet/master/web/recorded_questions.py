"""Requests of browsers that see a recorded run: `explain` alone answers them."""

from __future__ import annotations

import asyncio
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import msgspec

from pbonet.errors import PbonetError, StateError
from pbonet.master import diagnosis
from pbonet.master.configuration import Place
from pbonet.master.console import convert, find, read

from .orders import (
    MOST_WAITING,
    Done,
    Line,
    Order,
    answered,
    failure,
    progress,
    refusal,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from .access import Role
    from .orders import Wish

    Data = dict[str, Any]


class RecordedQuestions:
    """Explains a recorded run to browsers, one question after the other.

    Args:
        path: The log, or the folder of a run.
    """

    commands = (find("explain"),)
    """The commands that a page can give."""

    def __init__(self, path: str | Path) -> None:
        self._path = path
        self._reading = ThreadPoolExecutor(1, "explain")
        self._asked: set[Future[diagnosis.Explanation]] = set()
        """Questions that are answered, or wait."""

    def close(self) -> None:
        """Answer nothing more."""
        self._reading.shutdown(wait=False, cancel_futures=True)

    @property
    def left(self) -> list[str]:
        """Sentences about what is still being carried out."""
        goes_on = any(one.running() for one in list(self._asked))
        return ["a question about the run was not answered"] if goes_on else []

    def first(self) -> list[Data]:
        """Return the messages for a new browser: none."""
        return []

    async def answer(
        self, request: Wish, _: Role, told: Callable[[Data], None]
    ) -> Data:
        """Explain what a browser asks about; return the answer for it.

        Args:
            request: What it asked for.
            told: Called now and then with how it goes, while the log is read.
        """
        number = request.id
        try:
            words = _words(request)
            async with progress(number, "explain", told):
                found = await self._explained(words)
        except PbonetError as error:
            return refusal(number, str(error))
        except Exception as error:  # noqa: BLE001 - or the browser waits in vain
            return failure(number, error)
        return answered(number, Done(str(found), data=msgspec.to_builtins(found)))

    async def _explained(self, words: Sequence[str]) -> diagnosis.Explanation:
        if len(self._asked) >= MOST_WAITING:
            raise StateError(
                f"{MOST_WAITING} questions wait already",
                remedy="wait for their answers",
            )
        asked = self._reading.submit(diagnosis.answer, self._path, words, Place())
        self._asked.add(asked)
        asked.add_done_callback(self._asked.discard)
        return await asyncio.wrap_future(asked)


def _words(request: Wish) -> list[str]:
    """Return the words of a question.

    Raises:
        PbonetError: It asks for something else, or has arguments that do not fit.
    """
    given: dict[str, Any] | None = None
    if isinstance(request, Line):
        call = read(request.line, lambda _: False)
        given = call.given if call and call.command.name == "explain" else None
    elif isinstance(request, Order) and request.command == "explain":
        given = convert(find("explain"), request.args)
    if given is None or given.get("trace"):
        raise StateError(
            "a recorded run is not steered",
            expected="explain, with what it is asked about",
            remedy="for the rest open the subsystem's file with 'pbonet web'",
        )
    return list(given.get("what") or ())
