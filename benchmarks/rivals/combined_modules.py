"""pbonet: the same law many times, as parts of one task (Stewart 1994, 3.8.1)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.testing import Bench

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

MODULE = '''
from typing import Annotated as A
from pbonet import InVar, OutVar, PortBasedObject, Vector

class Lag(PortBasedObject, freq=1000):
    """Follow the input: y += gain * (x - y)."""

    x: A[Vector, InVar("X", "{width}", "rad", "input")]
    y: A[Vector, OutVar("Y", "{width}", "rad", "output")]

    def cycle(self, dt):
        self.y += 0.1 * (self.x - self.y)
'''
PART = """\
MODULE   lag
DESC     one of the chain
SVARALIAS X=X{number}
SVARALIAS Y=X{next}
INCONST  none
OUTCONST none
INVAR    X
OUTVAR   Y
TASKTYPE periodic
FREQ     1000
EOF
"""
WHOLE = """\
COMBINE  {parts}
DESC     a chain of lags
INCONST  none
OUTCONST none
INVAR    X0
OUTVAR   X{count}
TASKTYPE periodic
FREQ     1000
EOF
"""


def chain(count: int, width: int, folder: Path) -> Callable[[], object]:
    """Return a cycle of a task of that many modules, each after the other."""
    (folder / "lag.py").write_text(MODULE.format(width=width), encoding="utf-8")
    names = [f"lag{number}" for number in range(count)]
    for number, name in enumerate(names):
        text = PART.format(number=number, next=number + 1)
        (folder / f"{name}.rmod").write_text(text, encoding="utf-8")
    whole = folder / f"chain{count}.rmod"
    whole.write_text(WHOLE.format(parts=" ".join(names), count=count), encoding="utf-8")
    bench = Bench.of(whole, {"x": 1.0}, library=[folder])
    bench.on()
    return bench.step
