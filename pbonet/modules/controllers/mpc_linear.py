"""Model predictive control of a linear plant, within limits of command and state."""

from importlib import import_module
from math import isfinite
from operator import le
from typing import Annotated as A, Any, Literal

import numpy as np

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.io import from_extra
from pbonet.modules._linear_plant import LinearPlant
from pbonet.modules._values import PerElement, spread
from pbonet.modules._warn_once import WarnOnce

NONE = 1e20
"""A limit that is none."""
EXACT = 1e-9
"""How far a limit may be exceeded, in the units of U and Z."""
SOLVED, SOFTLY, NO_SOLUTION, TOO_LONG = 1, 2, -1, -4
"""Outcomes of daqp."""
_BEYOND = "beyond"
SOFT = 8
"""The mark of a limit that daqp may exceed."""
GIVES = 1e-6
"""How much such a limit gives, so that exceeding it costs a million times the rest."""


class Plan(Params):
    """The plant z' = A z + B u, the weights, the limits, and how far the plan goes."""

    a: A[PerElement, param("mixed", "matrix A, row by row")]
    b: A[PerElement, param("mixed", "matrix B, row by row")]
    q: A[PerElement, param("mixed", "weight of each state", ge=0)]
    r: A[PerElement, param("mixed", "weight of each command", gt=0)]
    lower: A[PerElement, param("none", "smallest command, in the unit of U")]
    upper: A[PerElement, param("none", "largest command, in the unit of U")]
    rate: A[PerElement, param("none", "largest change of U a second", gt=0)]
    z_lower: A[PerElement, param("mixed", "smallest state; -1e20: no limit")] = (-NONE,)
    z_upper: A[PerElement, param("mixed", "largest state; 1e20: no limit")] = (NONE,)
    horizon: A[int, param("cycles", "how far ahead the plan goes", ge=1, le=200)] = 20
    iterations: A[int, param("none", "most steps of each plan", ge=1, le=10000)] = 500
    infeasible: A[
        Literal["least", "error"],
        param("none", "exceed limits of the state that cannot be kept, or ERROR"),
    ] = "least"


class MpcLinear(PortBasedObject[Plan], module_class="controller"):
    """u = first of the u_k that make the sum of e_k' Q e_k + u_k' R u_k least.

    The error e = z - z_ref goes on as e_(k+1) = A e_k + B u_k, sampled at the task's
    rate, as if z_ref moved on like the plant without a command. The sum has HORIZON
    cycles, and after them that of the best gain without limits (Mayne et al. 2000,
    section 3.7.4). So u is that of `lqr`, which has the same ports, as long as no limit
    counts. Limits are LOWER and UPPER of u, RATE of its change, and Z_LOWER and Z_UPPER
    of z. A command that begins beyond its limits returns to them at RATE.

    The quadratic program is solved by daqp, a dual active-set method (Arnström,
    Bemporad and Axehill 2022), from the last solution on, in at most ITERATIONS steps.
    LOWER, UPPER and RATE are always kept. When no command keeps the limits of the state
    as well, say after a knock, INFEASIBLE least plans again, in as many steps again, so
    that they are exceeded as little as possible within the HORIZON, which is best
    longer than U takes from LOWER to UPPER; a warning names the state. INFEASIBLE error
    ends the task in ERROR then. It also ends so, and U gets old, when no plan is found
    in time or an input is not finite. In its first cycle the module keeps the U that is
    there, and then changes it by RATE at most.
    """

    z_ref: A[Vector, InVar("Z_REF", "n", "mixed", "reference state")]
    z: A[Vector, InVar("Z_MEZ", "n", "mixed", "measured or estimated state")]
    u: A[Vector, OutVar("U", "m", "any", "command")]

    def init(self) -> None:
        self._dt, self._inside = 0.0, False
        self._take_plan()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_plan()

    def on(self) -> None:
        self._begins, self._told = True, WarnOnce(self.task)

    def cycle(self, dt: float) -> None:
        if self._begins:
            self._begins = False
            return
        error = self.z - self.z_ref
        if not all(map(isfinite, error.tolist())):
            self.task.fail(self._not_finite())
        self._limit(dt)
        pull = self._pull @ error
        plan, outcome = self._solve(self._program, pull)
        if outcome == NO_SOLUTION and self.params.infeasible == "least":
            plan, outcome = self._solve(self._soft, pull)
        if outcome == SOLVED:
            self._told.clear()
        elif outcome != SOFTLY:
            self.task.fail(self._why(outcome))
        else:
            self._warn_beyond(plan)
        self.u[:] = plan[: len(self.u)]

    def _solve(self, program: Any, pull: Vector) -> tuple[Vector, int]:  # noqa: ANN401
        """Return the commands of a program within the limits of now and the outcome."""
        program.update(f=pull, bupper=self._high, blower=self._low)
        plan, _, outcome, _ = program.solve()
        return plan, outcome

    def _limit(self, dt: float) -> None:
        """Set the limits of the program that are others in this cycle."""
        k, m, u = self._count, len(self.u), self.u
        if dt != self._dt:
            self._dt, self._change = dt, self._rate * dt
            self._high[k : 2 * k].reshape(-1, m)[:] = self._change
            np.negative(self._high[k : 2 * k], out=self._low[k : 2 * k])
        np.subtract(u, self._change, out=self._first_low)
        np.add(u, self._change, out=self._first_high)
        inside = all(map(le, self._lower_list, values := u.tolist())) and all(
            map(le, values, self._upper_list)
        )
        if not (inside and self._inside):
            self._inside = inside
            reach = self._steps * self._change
            np.minimum(self._lower, u + reach, out=self._low[:k].reshape(-1, m))
            np.maximum(self._upper, u - reach, out=self._high[:k].reshape(-1, m))
        if self._bounded.size:
            rest = self._free @ self.z
            np.subtract(self._z_low, rest, out=self._low[2 * k :])
            np.subtract(self._z_high, rest, out=self._high[2 * k :])

    def _not_finite(self) -> str:
        names = {"Z_MEZ": self.z, "Z_REF": self.z_ref}
        bad = [
            f"{name}[{int(np.argmin(np.isfinite(values)))}]"
            for name, values in names.items()
            if not np.isfinite(values).all()
        ]
        return f"{' and '.join(bad) or 'Z_MEZ - Z_REF'} is not finite"

    def _why(self, outcome: int) -> str:
        """Return why there is no plan."""
        if outcome == TOO_LONG:
            return f"no plan was found in {self.params.iterations} steps: ITERATIONS"
        if outcome == NO_SOLUTION and self._bounded.size:
            state, text = self._worst(np.tile(self.u, self.params.horizon))
            return f"no command keeps Z[{state}] {text} with this U"
        return f"daqp found no plan, outcome {outcome}"

    def _warn_beyond(self, plan: Vector) -> None:
        """Warn of the state that a plan leaves furthest outside, once."""
        if not self._told.of(_BEYOND):
            state, text = self._worst(plan)
            self._told.warn(_BEYOND, f"no command keeps Z[{state}] {text} at best")

    def _worst(self, plan: Vector) -> tuple[int, str]:
        """Return the state that leaves its limits furthest, and how far it gets."""
        states = self._free @ self.z + self._forced @ plan
        beyond = np.maximum(self._z_low - states, states - self._z_high)
        worst = int(np.argmax(beyond))
        step, place = divmod(worst, self._bounded.size)
        return int(self._bounded[place]), (
            f"within {self._z_low[worst]:g} to {self._z_high[worst]:g}: after "
            f"{step + 1} cycle{'s' * (step > 0)} it is {states[worst]:g}"
        )

    # -- when the task is created, or a parameter is set ------------------------------

    def _take_plan(self) -> None:
        k, n, m = self.params, len(self.z), len(self.u)
        plant = LinearPlant(
            a=k.a, b=k.b, q=k.q, r=k.r, n=n, m=m, dt=1.0 / self.task.freq
        )
        self._lower, self._upper = (
            spread(k.lower, m, "lower"),
            spread(k.upper, m, "upper"),
        )
        self._rate = spread(k.rate, m, "rate")
        if not (self._lower < self._upper).all():
            raise ParameterError(
                "the limits leave no room",
                expected="LOWER below UPPER",
                got=f"LOWER {k.lower}, UPPER {k.upper}",
                remedy="correct them",
            )
        self._steps = np.arange(1.0, k.horizon + 1.0)[:, None]
        self._count = k.horizon * m
        free, forced = predict(plant.a, plant.b, k.horizon)
        weight = np.kron(np.eye(k.horizon), plant.q)
        weight[-n:, -n:] = plant.cost
        self._pull: Matrix = forced.T @ weight @ free
        square = forced.T @ weight @ forced + np.kron(np.eye(k.horizon), plant.r)
        self._limit_states(free, forced)
        self._low = np.empty(2 * self._count + self._z_low.size)
        self._high = np.empty_like(self._low)
        self._first_low = self._low[self._count : self._count + m]
        self._first_high = self._high[self._count : self._count + m]
        self._lower_list, self._upper_list = self._lower.tolist(), self._upper.tolist()
        self._dt, self._inside = 0.0, False
        change = np.eye(self._count) - np.eye(self._count, k=-m)
        self._make(square, np.vstack((change, self._forced)))

    def _limit_states(self, free: Matrix, forced: Matrix) -> None:
        """Take the rows of the states that have a limit."""
        k, n = self.params, len(self.z)
        low = spread(k.z_lower, n, "z_lower")
        high = spread(k.z_upper, n, "z_upper")
        if not (low < high).all():
            raise ParameterError(
                "the limits of the state leave no room",
                expected="Z_LOWER below Z_UPPER",
                got=f"Z_LOWER {k.z_lower}, Z_UPPER {k.z_upper}",
                remedy="correct them",
            )
        self._bounded = np.flatnonzero((low > -NONE) | (high < NONE))
        rows = (np.arange(k.horizon)[:, None] * n + self._bounded).ravel()
        self._free, self._forced = free[rows], forced[rows]
        self._z_low = np.tile(low[self._bounded], k.horizon)
        self._z_high = np.tile(high[self._bounded], k.horizon)

    def _make(self, square: Matrix, rows: Matrix) -> None:
        """Set both quadratic programs up; first come the limits of the commands."""
        with from_extra("mpc", "model predictive control"):
            daqp: Any = import_module("daqp")
        none = np.full(self._count + len(rows), NONE)
        sense = np.zeros(len(none), dtype=np.int32)
        self._program, self._soft = daqp.Model(), daqp.Model()
        for program in self._program, self._soft:
            program.settings = {
                "iter_limit": self.params.iterations, "primal_tol": EXACT,
                "rho_soft": GIVES,
            }  # fmt: skip
            program.setup(square, np.zeros(self._count), rows, none, -none, sense)
            sense[2 * self._count :] = SOFT


def predict(a: Matrix, b: Matrix, horizon: int) -> tuple[Matrix, Matrix]:
    """Return what the state and the commands contribute to the next states.

    Args:
        a: Of one cycle, [n, n].
        b: Of one cycle, [n, m].
        horizon: Cycles.

    Returns:
        Matrices of n rows for each cycle: [horizon n, n] and [horizon n, horizon m].
    """
    n, m = b.shape
    free = np.empty((horizon * n, n))
    forced = np.zeros((horizon * n, horizon * m))
    power, answer = np.eye(n), np.empty((horizon * n, m))
    for k in range(horizon):
        rows = slice(k * n, (k + 1) * n)
        answer[rows] = power @ b
        power = a @ power
        free[rows] = power
    for k in range(horizon):
        forced[k * n :, k * m : (k + 1) * m] = answer[: (horizon - k) * n]
    return free, forced
