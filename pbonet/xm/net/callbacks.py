"""Functions that zenoh's own threads call.

They must be short: while one runs, nothing else comes over that link.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import zenoh

from ._threads import stay_known

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")


def direct(
    what: Callable[[T], object], end: Callable[[], object] | None = None
) -> zenoh.handlers.Callback[T]:
    """Let zenoh's own thread call a function, with no change of thread.

    Args:
        what: Is called with each query, sample or reply.
        end: Is called when no more will come.
    """

    def call(given: T) -> None:
        stay_known()
        what(given)

    return zenoh.handlers.Callback(call, end, indirect=False)
