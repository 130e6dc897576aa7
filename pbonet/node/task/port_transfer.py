"""Interface of the transfer of a task's ports, for the executor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from pbonet.svar import Blamed


class Copies(Protocol):
    """Transfer of a task's ports between the local and the global table.

    Every method may raise a `PbonetError`. Those that return flags return 0 on success;
    the flags in `step_failures.REFUSED` are errors of the task, the others are counted
    by the code that copies.
    """

    @property
    def blamed(self) -> Blamed:
        """Variable and element to which the flags of the last commit refer."""
        ...

    @property
    def action(self) -> int:
        """The action because inputs are too old: a value of `svar.Action`."""
        ...

    def make_new(self) -> None:
        """Let the next commit not inherit the age of an input."""

    def copy_in_consts(self) -> int:
        """Copy the in-consts in; returns flags."""
        ...

    def copy_out_consts(self, now_ns: int = 0) -> int:
        """Copy the out-consts out; returns flags."""
        ...

    def copy_in(self) -> int:
        """Copy the in-vars in; returns flags."""
        ...

    def copy_in_on(self) -> int:
        """Copy the in-vars and the out-vars in; returns flags."""
        ...

    def check_claim(self) -> None:
        """Raise if `claim` would, because another task owns an out-var."""

    def claim(self, now_ns: int = 0, cycle: int = 0, own_ns: int = 0) -> int:
        """Copy the out-vars out and own them, as one event; returns flags.

        Args:
            now_ns: The time.
            cycle: The task's cycle.
            own_ns: The time of the values, if the module gives one.
        """
        ...

    def commit(self, now_ns: int = 0, cycle: int = 0, own_ns: int = 0) -> int:
        """Copy the out-vars out; returns flags. Arguments are those of `claim`."""
        ...

    def was_made_safe(self) -> None:
        """The safe values of the out-vars were committed, in place of a cycle's."""

    def cede(self) -> None:
        """Stop writing the out-vars, and leave them to a successor's claim."""

    def release(self) -> None:
        """Release the out-vars, whose values remain."""
