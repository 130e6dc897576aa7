"""The cause under which a master raises the flag when equation 2 is not met."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pbonet import verify

UNFED = "equation 2: nobody writes "
"""How the cause begins."""
_CAUSE = 100
"""Characters of a cause that the flag has room for."""


def cause(unfed: Iterable[verify.Problem]) -> str:
    """Return the cause for inputs without a writer: which, and whose."""
    named = (f"{' '.join(p.variables)} for {' and '.join(p.tasks)}" for p in unfed)
    text = UNFED + ", ".join(named)
    return text if len(text) <= _CAUSE else f"{text[: _CAUSE - 3]}..."
