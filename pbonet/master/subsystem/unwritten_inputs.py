"""A master's part in inputs without a writer (equation 2): warnings, the flag."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.analysis import legality
from pbonet.xm.net import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

UNFED = "equation 2: no task writes "
"""How the cause begins under which the flag is up."""
_CAUSE = 100
"""Characters of a cause that the flag has room for."""


class UnwrittenInputs:
    """Warnings given about a subsystem's inputs without a writer.

    Args:
        ask: Has the keeper of the table raise or withdraw an entry; returns the present
            causes.
        say: Called with problems that stand, to warn of those not reported yet.
    """

    def __init__(
        self,
        ask: Callable[[m.Flag], list[str]],
        say: Callable[[Sequence[legality.Problem]], None],
    ) -> None:
        self._ask = ask
        self._say = say
        self._causes: set[str] = set()  # that this subsystem's masters have raised

    def seen(self, causes: Iterable[str]) -> None:
        """Take note of the present causes, as RTPUs tell them."""
        self._causes = {
            cause.partition(" (")[0]  # the rest names who raised it
            for cause in causes
            if cause.startswith(UNFED)
        }

    def settle(self, problems: Sequence[legality.Problem]) -> None:
        """Raise the flag for these inputs and no others; report new ones.

        They are those that the master knows. The keeper sees the writers in the table,
        and may know of a fallback that was turned on since: then nothing is reported.

        Args:
            problems: All of them have the code NO_WRITER.

        Raises:
            PbonetError: The keeper does not do it.
        """
        said: Sequence[legality.Problem] = problems
        try:
            if not self._flag(problems):
                said = []
        finally:
            self._say(said)

    def _flag(self, problems: Sequence[legality.Problem]) -> bool:
        """Bring the flag in line; return whether it is up for these problems.

        It does not go down in between. An entry that was up at the last check is raised
        again: its keeper may have withdrawn it since.
        """
        cause = _cause(problems) if problems else ""
        standing: list[str] = []
        if problems:
            names = [name for problem in problems for name in problem.variables]
            standing = self._ask(m.Flag(cause=cause, up=True, unwritten=names))
        for old in self._causes - {cause}:
            self._ask(m.Flag(cause=old, up=False))
        self._causes = {cause} if problems else set()
        return any(one.partition(" (")[0] == cause for one in standing)


def _cause(unwritten: Iterable[legality.Problem]) -> str:
    """Return the cause of the flag for inputs without a writer, with their readers."""
    named = (f"{' '.join(p.variables)} for {' and '.join(p.tasks)}" for p in unwritten)
    text = UNFED + ", ".join(named)
    return text if len(text) <= _CAUSE else f"{text[: _CAUSE - 3]}..."
