"""The two tasks of Figure 6.3 as a job: a samples a sine, b puts it out."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

VARIABLE = "NAME {}\nTYPE double\nDESC {}\nUNITS none\nNELEM 1\n\n"
SINE = '''
import math
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject


class Sine(PortBasedObject):
    """50 sin 10 t."""

    s: A[float, OutVar("S", "1", "none", "the sensor's value")]

    def on(self) -> None:
        self.begin = self.task.now
        self.s = 0.0

    def cycle(self, dt: float) -> None:
        self.s = 50.0 * math.sin(10.0 * (self.task.now - self.begin) * 1e-9)
'''
HANDS_ON = '''
from typing import Annotated as A

from pbonet import InVar, OutVar, PortBasedObject


class HandsOn(PortBasedObject):
    """v = u."""

    u: A[float, InVar("U", "1", "none", "in")]
    v: A[float, OutVar("V", "1", "none", "out")]

    def on(self) -> None:
        self.v = 0.0

    def cycle(self, dt: float) -> None:
        self.v = self.u
'''
RMOD = """MODULE {module}
DESC {name}
{aliases}INCONST none
OUTCONST none
INVAR {reads}
OUTVAR {writes}
TASKTYPE periodic
FREQ {hz}
MAXC {maxc}
CRIT {crit}
RTPU {rtpu}
EOF
"""


def chain_job(folder: Path, *, a_first: bool = True) -> Path:
    """Write the job; the sensor is on an RTPU of its own and takes nearly no time."""
    names = {"S": "the sensor", "X": "from a to b", "Y": "the output"}
    table = "".join(VARIABLE.format(*pair) for pair in names.items())
    (folder / "chain.svar").write_text(f"{table}EOF\n")
    (folder / "chain.sbs").write_text(
        "SUBSYSTEM chain\nSVARFILE chain.svar\nRTPU world\nRTPU arm\nEOF\n"
    )
    (folder / "sine.py").write_text(SINE)
    (folder / "hands_on.py").write_text(HANDS_ON)
    common = {"module": "hands_on", "reads": "U", "writes": "V", "hz": 20}
    common |= {"maxc": 0.005, "rtpu": "arm"}
    alias = "SVARALIAS U={}\nSVARALIAS V={}\n"
    rows = {
        "sense": {"module": "sine", "aliases": "", "reads": "none", "writes": "S"}
        | {"hz": 1000, "maxc": 0.00001, "crit": 5, "rtpu": "world"},
        "a": common | {"aliases": alias.format("S", "X"), "crit": 5 + a_first},
        "b": common | {"aliases": alias.format("X", "Y"), "crit": 6 - a_first},
    }
    for name, row in rows.items():
        (folder / f"{name}.rmod").write_text(RMOD.format(name=name, **row))
    job = folder / "chain.job"
    job.write_text(
        "JOB chain\nDESC Figure 6.3\nSBS chain.sbs\nCOST mean(Y - S)\n"
        "TASK sense\nTASK a  # samples\nTASK b\nEOF\n"
    )
    return job
