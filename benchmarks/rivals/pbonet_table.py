"""pbonet: one group of variables in the table, checked for NaN and infinity."""

from __future__ import annotations

import os

from benchmarks.rivals.rival import ARRAYS, Reader, Rival, Writer
from pbonet.config.model import Variable
from pbonet.svar import Freshness, Table

NAMES = [f"V{i}" for i in range(ARRAYS)]


class PbonetTable(Rival):
    """`commit` and `copy_in`, as a task's executor calls them."""

    name = "pbonet"

    def __init__(self, length: int, tag: str) -> None:
        super().__init__(length, tag)
        self.table = Table.create(
            tag, [Variable(name=name, type="double", nelem=length) for name in NAMES]
        )

    def writer(self) -> Writer:
        """Claim the variables."""
        table = Table.attach(self.tag)
        local = table.local("writer", os.getpid(), outvar=NAMES)
        local.claim()
        return Writer([local.array(name) for name in NAMES], local.commit)

    def reader(self) -> Reader:
        """Attach to the table."""
        table = Table.attach(self.tag)
        local = table.local("reader", os.getpid(), invar=NAMES)
        local.keep_fresh({table.index(name): Freshness() for name in NAMES})
        arrays = [local.array(name) for name in NAMES]

        def numbers(flags: int) -> list[object]:
            assert not flags, flags
            return list(arrays)

        return Reader(local.copy_in, numbers)  # type: ignore[arg-type]

    def close(self) -> None:
        """Remove the table."""
        self.table.destroy()
