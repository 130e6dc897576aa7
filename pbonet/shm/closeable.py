"""Base of what is released by `close`, by hand or at the end of a `with` block."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from types import TracebackType


class Closeable:
    """Closes itself at the end of a `with` block."""

    def close(self) -> None:
        """Release it; a second call does no harm."""
        raise NotImplementedError  # abstract: everything that closes has its own

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close, whatever happened."""
        self.close()
