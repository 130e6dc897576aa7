"""Inputs of a task in each cycle, rebuilt from the commits of all tasks.

A cycle's record names the commits that it read by register and number. If one of them
is in no task's record (initial values, values set by an operator), the record itself
has the inputs.
"""

from __future__ import annotations

import struct
from itertools import count, repeat
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from pbonet.log import unpack
from pbonet.svar import group_of

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from numpy.typing import NDArray

    from pbonet.log import Log, Table, TaskAbout, TaskLife

_PAIR: Final = struct.Struct("<QQ")

Key = tuple[int, int]
"""Register and number of a commit."""


class Piece(NamedTuple):
    """One variable of a commit, and where it goes."""

    to: memoryview
    at: int
    end: int


class Commits:
    """Every commit of a run, by register and number.

    Args:
        log: The run.
        table: Only commits to this table count: others have other numbers.
    """

    fresh = False
    """Whether commits may be other ones than were recorded."""

    def __init__(self, log: Log, table: Table) -> None:
        self._found: dict[Key, tuple[TaskLife, int]] = {}
        for life in log.all_lives():
            if life.table != table:
                continue
            head = life.schema.heads(life.commits)
            keys = zip(head["register"].tolist(), head["number"].tolist(), strict=True)
            self._found.update(zip(keys, zip(repeat(life), count())))  # noqa: B905 - endless

    def find(self, key: Key) -> tuple[TaskLife, bytes, bool] | None:
        """Return a commit's task, its group, and whether that has every variable.

        Returns:
            None when it is not recorded.
        """
        found = self._found.get(key)
        if found is None:
            return None
        life, row = found
        return life, life.groups[row], not life.about.hidden


class Inputs:
    """Brings in-vars into the arrays of a task, cycle by cycle.

    Args:
        about: The task.
        array: Gives the array of a variable by its name.
        commits: Of the whole run.
    """

    def __init__(
        self,
        about: TaskAbout,
        array: Callable[[str], NDArray[Any]],
        commits: Commits,
    ) -> None:
        self._about = about
        self._array = array
        self._commits = commits
        self._read: dict[int, int] = {}
        self._pieces: dict[int, list[Piece]] = {}
        self._hidden: dict[int, str] = {}
        self._unseen = {v.name for v in about.invar if v.name in about.hidden}
        """In-vars that are 0 where inputs are stored."""

    def bring(self, consumed: bytes, stored: bytes) -> str:
        """Bring in what one cycle read.

        Args:
            consumed: Pairs of register and number.
            stored: The in-vars themselves, where the record has them.

        Returns:
            Why that cannot be done; empty when it was.
        """
        if stored:
            unpack(self._about.invar, stored, self._array)
            self._read = dict(_PAIR.iter_unpack(consumed))
            return self._renew() if self._commits.fresh or self._unseen else ""
        read = self._read
        for register, number in _PAIR.iter_unpack(consumed):
            if read.get(register) != number:
                if why := self._apply(register, number):
                    return why
                read[register] = number
        return ""

    def _renew(self) -> str:
        """Use new values in place of stored ones where they exist."""
        unseen = set(self._unseen)
        for register, number in self._read.items():
            if not self._apply(register, number):
                life = self._commits.find((register, number))
                unseen -= {v.name for v in life[0].about.outvar} if life else set()
        return f"{min(unseen)} is not recorded" if unseen else ""

    def _apply(self, register: int, number: int) -> str:
        found = self._commits.find((register, number))
        if found is None:
            return f"commit {number} of register {register} is not recorded"
        life, group, whole = found
        key = id(life)
        pieces = self._pieces.get(key)
        if pieces is None:
            pieces = self._learn(key, life)
        if not whole and key in self._hidden:
            return f"{self._hidden[key]} is not recorded"
        for to, at, end in pieces:
            to[:] = group[at:end]
        return ""

    def _learn(self, key: int, life: TaskLife) -> list[Piece]:
        """Find out which variables of a task are inputs here; return them."""
        outvar = life.about.outvar
        ours = {variable.name for variable in self._about.invar}
        group = group_of(outvar, range(len(outvar)))
        self._pieces[key] = []
        for variable, at in zip(outvar, group.at, strict=True):
            if variable.name not in ours:
                continue
            if variable.name in life.about.hidden:
                self._hidden[key] = variable.name
            to = self._array(variable.name).view(np.uint8).data
            self._pieces[key].append(Piece(to, at, at + len(to)))
        return self._pieces[key]
