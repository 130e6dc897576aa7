"""Decides which machine's value of a variable counts.

Each claim of a variable has an *epoch*: one more than that of the newest claim known to
have ended when it was made. A task that takes over in order therefore has a higher
epoch than its predecessor, and all machines agree on the order, whatever order the data
arrives in. Two tasks that claim while their machines do not see each other have the
same epoch, or the task that was unreachable has the lower one and is still alive: its
own machine detects that and reports it, and neither claim counts anywhere until one of
them has ended.

Pure decisions: no table, no network.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

HERE = ""
"""This machine."""


class Claim(NamedTuple):
    """One group's claim of a variable."""

    epoch: int
    live: bool
    uid: int


class Epochs:
    """The claims of all variables known to one machine."""

    def __init__(self) -> None:
        self.own: dict[int, Claim] = {}
        self.ended: dict[int, int] = {}
        self.others: dict[str, dict[int, Claim]] = {}
        self.told: dict[str, frozenset[int]] = {}
        """By machine, the variables for which it reports a conflict with itself."""

    def here(self, seen: Mapping[int, tuple[int, bool]]) -> None:
        """Update this machine's groups: (uid, live) by variable."""
        for variable in self.own.keys() - seen.keys():
            self._end(variable, self.own.pop(variable))
        for variable, (uid, live) in seen.items():
            old = self.own.get(variable)
            if old is not None and (old.uid, old.live) == (uid, live):
                continue
            if old is not None:
                self._end(variable, old)
            goes_on = old is not None and old.uid == uid and not live
            epoch = self.ended.get(variable, 0) + (0 if goes_on else 1)
            self.own[variable] = claim = Claim(epoch, live, uid)
            if not live:
                self._end(variable, claim._replace(live=True))

    def there(
        self,
        machine: str,
        claims: Mapping[int, Claim],
        ended: Iterable[tuple[int, int]] = (),
        fights: Iterable[int] = (),
    ) -> None:
        """Update the groups of another machine."""
        self.others[machine] = dict(claims)
        self.told[machine] = frozenset(fights)
        for variable, epoch in ended:
            self.ended[variable] = max(self.ended.get(variable, 0), epoch)
        for variable, claim in claims.items():
            before = claim.epoch - 1 if claim.live else claim.epoch
            self.ended[variable] = max(self.ended.get(variable, 0), before)

    def forget(self, machine: str) -> None:
        """Forget a machine that is unreachable: its tasks may live and write."""
        self.others.pop(machine, None)
        self.told.pop(machine, None)

    def own_fights(self, equal: Callable[[int, str], bool]) -> list[int]:
        """Return the variables that a task here owns and one elsewhere, too.

        Args:
            equal: Whether a variable is a constant of the same value on both machines.
        """
        return sorted(
            variable
            for variable, mine in self.own.items()
            if mine.live
            and any(
                (claim := claims.get(variable)) is not None
                and claim.live
                and claim.epoch >= mine.epoch
                and not equal(variable, machine)
                for machine, claims in self.others.items()
            )
        )

    def fought_over(self, own: Iterable[int]) -> set[int]:
        """Return the variables without a valid claim; `own` are this machine's."""
        return set(own).union(*self.told.values())

    def winner(self, variable: int) -> str | None:
        """Return the machine whose claim counts; None if there is none."""
        claims = [
            (claim.live, claim.epoch, machine)
            for machine, known in self.others.items()
            if (claim := known.get(variable)) is not None
        ]
        if (mine := self.own.get(variable)) is not None:
            claims.append((mine.live, mine.epoch, HERE))
        if not claims:
            return None
        if mine is not None and mine.live:
            return HERE
        newest = max(claims)[:2]
        return min(claim[2] for claim in claims if claim[:2] == newest)

    def _end(self, variable: int, claim: Claim) -> None:
        if claim.live:
            self.ended[variable] = max(self.ended.get(variable, 0), claim.epoch)
