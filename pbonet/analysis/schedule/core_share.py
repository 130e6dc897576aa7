"""The share of a core for its tasks: the 100 % of section 6.2.3 on a real machine.

The thesis's kernel owns its processor. Here another kernel grants a share of a core,
and the dispatcher takes its own time of that, at every release.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Iterable

_LEAST = 1e-9
"""The rest where dispatching alone takes everything: no task fits."""


class CoreShare(Struct, frozen=True, kw_only=True):
    """The share of a core that its tasks may use together."""

    share: float = 1.0
    """Of the core, above 0, at most 1."""
    dispatch: float = 0.0
    """CPU seconds that the dispatcher takes of it for each release."""
    reason: str = "virtual time"
    """Where both figures come from, as a phrase."""

    def left(self, rates: Iterable[float]) -> float:
        """Return the share that is left for tasks, above 0.

        Args:
            rates: How often each of the tasks is released, Hz.
        """
        return max(self.share - self.dispatch * sum(rates), _LEAST)


ASSUMED = CoreShare(
    share=0.95, dispatch=1e-5, reason="assumed: Linux's default, 10 us a release"
)
"""Where no agent says what its core grants."""
