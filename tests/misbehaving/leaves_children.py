"""Leaves processes of its own: forked, started, and one that hides in a new session."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param

SLEEPS = [sys.executable, "-c", "import time; time.sleep(600)"]


class Notes(Params):
    """Where the ids of the processes are written."""

    pids: A[str, param("none", "file of process ids")] = ""


class LeavesChildren(PortBasedObject[Notes]):
    """Counts its cycles; the copy that `fork` makes comes back from `init` too."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def init(self) -> None:
        children = [
            os.fork(),
            subprocess.Popen(SLEEPS).pid,
            subprocess.Popen(SLEEPS, start_new_session=True).pid,
        ]
        if children[0]:
            text = "".join(f"{pid}\n" for pid in children[1:])
            Path(self.params.pids).write_text(text, encoding="utf-8")

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        if self.y[0] == 3.0 and (pid := os.fork()):
            with Path(self.params.pids).open("a", encoding="utf-8") as file:
                file.write(f"{pid}\n")
