"""pbonet: three tasks of 1 kHz on one RTPU, of a real agent.

Tasks of one rate on one RTPU run in the order of their data flow.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import TYPE_CHECKING

from pbonet.master import Subsystem
from pbonet.master.subsystem.embedded_agents import Embedded

if TYPE_CHECKING:
    from collections.abc import Generator

HEAD = """\
import time
from pathlib import Path
from typing import Annotated as A
import numpy as np
from pbonet import InVar, OutVar, PortBasedObject, Vector
"""
MODULES = {
    "source": '''
class Source(PortBasedObject, freq={rate}):
    """Write when the cycle began, and its number."""

    there: A[Vector, OutVar("A", "{width}", "any", "time and numbers")]

    def cycle(self, dt):
        self.there[1] += 1
        self.there[0] = time.monotonic_ns()
''',
    "middle": '''
class Middle(PortBasedObject, freq={rate}):
    """Pass on what comes."""

    here: A[Vector, InVar("A", "{width}", "any", "time and numbers")]
    there: A[Vector, OutVar("B", "{width}", "any", "time and numbers")]

    def cycle(self, dt):
        self.there[:] = self.here
''',
    "sink": '''
class Sink(PortBasedObject, freq={rate}):
    """Note how old each new set is."""

    here: A[Vector, InVar("B", "{width}", "any", "time and numbers")]

    def on(self):
        self.seen, self.last = [], 0.0

    def cycle(self, dt):
        if self.here[1] != self.last:
            self.last = self.here[1]
            self.seen.append((time.monotonic_ns() - self.here[0], self.last))

    def off(self):
        np.save(Path("{folder}") / "seen.npy", self.seen)
''',
}
VARIABLE = (
    "NAME {name}\nTYPE double\nDESC time and numbers\nUNITS any\nNELEM {width}\n\n"
)
SBS = "SUBSYSTEM rivals\nSVARFILE rivals.svar\nRTPU rival0\nEOF\n"
JOB = "JOB rivals\nDESC three tasks\nSBS rivals.sbs\n{tasks}EOF\n"


def write_files(folder: Path, rate: int, width: int) -> None:
    """Write modules, table, subsystem and job."""
    for name, text in MODULES.items():
        made = text.format(rate=rate, width=width, folder=folder)
        (folder / f"{name}.py").write_text(HEAD + made, encoding="utf-8")
    table = "".join(VARIABLE.format(name=name, width=width) for name in "AB")
    tasks = "".join(f"TASK {name} rival0\n" for name in MODULES)
    for name, text in (
        ("rivals.svar", table + "EOF\n"),
        ("rivals.sbs", SBS),
        ("rivals.job", JOB.format(tasks=tasks)),
    ):
        (folder / name).write_text(text, encoding="utf-8")


@contextlib.contextmanager
def running(
    folder: Path, rate: int, width: int, seconds: float
) -> Generator[None, None, None]:
    """Run the pipeline; ``seen.npy`` then holds age (ns) and number of each set."""
    del seconds  # it runs until it is turned off
    write_files(folder, rate, width)
    os.environ["PBONET_RUN_DIR"] = str(folder / "run")
    with Embedded("rivals", libraries=[str(folder)]) as agents:
        agents.start(["rival0"])
        made = Subsystem(
            folder / "rivals.job",
            domain="rivals",
            libraries=[folder],
            warned=lambda _text: None,
            record="off",
        )
        with made as subsystem:
            subsystem.start()
            yield
            subsystem.stop()
