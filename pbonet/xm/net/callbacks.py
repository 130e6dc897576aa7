"""Functions that zenoh's own threads call.

They must be short: while one runs, nothing else is received over that link.
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
    """Return a callback that zenoh's own thread calls, without a change of thread.

    Args:
        what: Called with each query, sample or reply.
        end: Called after the last one.
    """

    def call(given: T) -> None:
        stay_known()
        what(given)

    return zenoh.handlers.Callback(call, end, indirect=False)
