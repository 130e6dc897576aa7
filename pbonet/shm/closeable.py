"""Base of objects that `close` releases, directly or at the end of a `with` block."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from types import TracebackType


class Closeable:
    """Closes itself at the end of a `with` block."""

    def close(self) -> None:
        """Release it. Idempotent."""
        raise NotImplementedError  # abstract: each subclass has its own

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close, also after an exception."""
        self.close()
