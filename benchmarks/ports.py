"""What a module pays for its ports: reads, writes, and ordinary attributes.

Each line is one statement of a method, timed against the same statement on a class
without ports, in turns, so that whatever else the machine does hits both; shown is the
median over the rounds of the cost of one statement, the empty loop taken off.

    python benchmarks/ports.py [--rounds N]
"""

from __future__ import annotations

import argparse
import platform
import statistics
import timeit
from typing import TYPE_CHECKING, Annotated as A, Any

import numpy as np

from pbonet import InVar, OutVar, Params, PortBasedObject, Vector
from pbonet.pbo import TaskContext, bind

if TYPE_CHECKING:
    from collections.abc import Callable

LOOPS = 200_000


class Ported(PortBasedObject):
    """A module with every kind of attribute."""

    q: A[Vector, InVar("Q", "n", "rad", "an array input")]
    tau: A[Vector, OutVar("T", "n", "N*m", "an array output")]
    gain: A[float, InVar("GAIN", "1", "none", "a scalar input")]
    level: A[float, OutVar("LEVEL", "1", "none", "a scalar output")]

    def cycle(self, dt: float) -> None:
        """Do nothing."""


class Plain:
    """The same attributes, none of them a port."""

    def __init__(self) -> None:
        self.q = np.zeros(6)
        self.tau = np.zeros(6)
        self.gain = 1.0
        self.level = 0.0


STATEMENTS = {
    "read an array port": "self.q",
    "write into an array port": "self.tau[:] = x",
    "add to an array port in place": "self.tau += x",
    "read a scalar port": "self.gain",
    "assign to a scalar port": "self.level = 1.0",
    "read any other attribute": "self.other",
    "assign to any other attribute": "self.other = 1.0",
}


def compiled(statement: str) -> Callable[[Any], None]:
    """Return a function that runs `statement` many times on its argument."""
    lines = [
        "def run(self, x=x):",
        f"    for _ in range({LOOPS}):",
        f"        {statement}",
    ]
    names: dict[str, Any] = {"x": np.ones(6)}
    exec("\n".join(lines), names)  # noqa: S102 - the statements above
    run: Callable[[Any], None] = names["run"]
    return run


def cost(run: Callable[[Any], None], subject: object) -> float:
    """Return nanoseconds of one statement, the loop around it included."""
    return timeit.timeit(lambda: run(subject), number=1) / LOOPS * 1e9


def main() -> None:
    """Measure and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=15)
    rounds = parser.parse_args().rounds
    arrays = {
        attr: np.zeros(size)
        for attr, size in (("q", 6), ("tau", 6), ("gain", 1), ("level", 1))
    }
    ported: Any = bind(Ported, Params(), arrays, TaskContext())
    plain: Any = Plain()
    for subject in (ported, plain):
        subject.other = 1.0
    empty = compiled("pass")
    print(f"{platform.processor() or platform.machine()}, {platform.python_version()}")
    print("\n| statement | with ports, ns | without, ns |\n|---|---|---|")
    for name, statement in STATEMENTS.items():
        run = compiled(statement)
        found: list[tuple[float, float]] = []
        for _ in range(rounds):
            loop = cost(empty, plain)
            found.append((cost(run, ported) - loop, cost(run, plain) - loop))
        here, there = (statistics.median(side) for side in zip(*found, strict=True))
        print(f"| {name}: `{statement}` | {here:.0f} | {there:.0f} |")


if __name__ == "__main__":
    main()
