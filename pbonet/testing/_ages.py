"""Ages of the inputs on a bench, and what a module does while one is too old.

The rules are those of a task's local table (``pbonet/svar/fresh.h``), in virtual time.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pbonet.ports import Kind
from pbonet.svar import Action

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pbonet.ports import Port

_RENEWALS = 2


class InputAges:
    """Ages of a module's in-vars.

    Args:
        ports: The module's ports.
        default: The action where a port names none.
        stale: The action of the RMOD, which goes before those of the ports.
        settle: Seconds that inputs must have been fresh before the module goes on;
            None: two cycles, since on a bench each input comes once a cycle.

    Attributes:
        given: Age in seconds by attribute; 0 where none is given.
        old: In-vars, by attribute, that are too old whatever their age.
        action: What runs in place of `cycle`.
        worst: The first in-var that was too old.
        output: The age of the last outputs in seconds.
    """

    def __init__(
        self,
        ports: Iterable[Port],
        *,
        default: Action = Action.GO_ON,
        stale: str = "",
        settle: float | None = None,
    ) -> None:
        ports = tuple(ports)
        self._ports = {p.attr: p for p in ports if p.kind is Kind.INVAR}
        self._new = all(p.new for p in ports if p.kind is Kind.OUTVAR)
        self._default, self._stale, self._settle = default, stale, settle
        self.given: dict[str, float] = {}
        self.old: set[str] = set()
        self.action = Action.GO_ON
        self.worst = ""
        self.output = 0.0
        self._fresh_for: float | None = None
        self._cycles = 0
        self._begun = False

    def age(self, attr: str) -> float:
        """Return the age of an in-var in seconds."""
        return self.given.get(attr, math.inf if attr in self.old else 0.0)

    def limit(self, attr: str) -> float | None:
        """Return the limit of an in-var in seconds; None: it has none."""
        return self._ports[attr].max_age

    def is_stale(self, attr: str) -> bool:
        """Return whether an in-var is too old."""
        limit = self.limit(attr)
        return attr in self.old or (limit is not None and self.age(attr) > limit)

    def turned_on(self) -> None:
        """Forget what was too old before."""
        self.action, self._fresh_for, self._begun = Action.GO_ON, None, False

    def judge(self, dt: float) -> None:
        """Judge the inputs of one cycle.

        Args:
            dt: Seconds since the last one.
        """
        too_old = [attr for attr in self._ports if self.is_stale(attr)]
        counted = [
            self.age(attr)
            for attr, port in self._ports.items()
            if not (port.feedback or self._new) and self._is_limited(attr)
        ]
        self.output = max(counted, default=0.0)
        if too_old:
            self.worst, self._fresh_for = too_old[0], None
            self.action = max(map(self._action, too_old))
        elif self.action and self._begun:
            self._go_on(dt)
        else:
            self.action, self._begun = Action.GO_ON, True

    def _is_limited(self, attr: str) -> bool:
        """Return whether the age of an in-var counts: it has a limit, or was given."""
        return self.limit(attr) is not None or attr in {*self.old, *self.given}

    def _action(self, attr: str) -> Action:
        name = self._stale or self._ports[attr].stale
        return Action[name.upper()] if name else self._default

    def _go_on(self, dt: float) -> None:
        """Count the time since all inputs are fresh."""
        if self._fresh_for is None:
            self._fresh_for, self._cycles = 0.0, 0
        else:
            self._fresh_for += dt
            self._cycles += 1
        if self._settle is None:
            settled = self._cycles >= _RENEWALS
        else:
            settled = self._fresh_for >= self._settle
        if settled:
            self.action = Action.GO_ON
