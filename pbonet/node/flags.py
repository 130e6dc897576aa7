"""An RTPU's entries in the illegal-configuration flag (Stewart 1994, section 3.10).

An entry stands while a task that others may depend on is in ERROR or dead, or while a
reconfiguration takes longer than a cycle. It goes when the task recovers, is killed or
spawned again, or when all it wrote is written by others.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from pbonet.errors import SvarError, SvarFullError

if TYPE_CHECKING:
    from collections.abc import Collection

    from .tables import Tables


class Flags:
    """What one RTPU has raised.

    Args:
        rtpu: Its name.
        tables: The tables that have the flags.
    """

    def __init__(self, rtpu: str, tables: Tables) -> None:
        self._rtpu = rtpu
        self._tables = tables
        self._outputs: dict[tuple[str, str], Collection[str]] = {}
        self._refused: dict[tuple[str, str], str] = {}
        """Causes for which there was no room; raised again when others have gone."""

    def up(
        self, subsystem: str, name: str, cause: str, outputs: Collection[str] = ()
    ) -> None:
        """Raise an entry.

        Args:
            subsystem: Whose flag.
            name: Who it is about: a task, or what the RTPU does.
            cause: Why.
            outputs: Variables that nobody writes now; the entry goes when all of them
                are written again.
        """
        opened = self._tables.sound(subsystem)
        if opened is None:
            return
        if outputs:
            self._outputs[subsystem, name] = outputs
        self._refused.pop((subsystem, name), None)
        try:
            opened.table.raise_illegal(cause, self._raiser(name))
        except SvarFullError:  # other causes hold the flag up meanwhile
            self._refused[subsystem, name] = cause
        except SvarError:
            pass  # the table is gone, and with it the flag

    def down(self, subsystem: str, name: str) -> None:
        """Withdraw an entry; harmless when there is none."""
        self._outputs.pop((subsystem, name), None)
        self._refused.pop((subsystem, name), None)
        opened = self._tables.sound(subsystem)
        if opened is not None:
            with contextlib.suppress(SvarError):
                opened.table.clear_illegal(self._raiser(name))

    def relieve(self) -> None:
        """Withdraw entries for outputs that others write now; raise refused ones."""
        for (subsystem, name), cause in list(self._refused.items()):
            self.up(subsystem, name, cause)
        for (subsystem, name), outputs in list(self._outputs.items()):
            opened = self._tables.sound(subsystem)
            if opened is None:
                del self._outputs[subsystem, name]
            elif all(opened.table.info(output).owner for output in outputs):
                self.down(subsystem, name)

    def _raiser(self, name: str) -> str:
        return f"{self._rtpu}/{name}"
