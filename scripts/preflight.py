"""Tell what this machine lacks before anything is installed, with the remedy.

Runs under the system's own Python, before there is a virtual environment, so it uses
the standard library only.
"""

from __future__ import annotations

import importlib.util
import shutil
import sys
import sysconfig
from pathlib import Path

OLDEST = (3, 11)


def missing() -> list[str]:
    """Return one sentence for each thing that is missing."""
    lacks = []
    if sys.version_info < OLDEST:
        lacks.append(
            f"Python {OLDEST[0]}.{OLDEST[1]} or newer is needed, this is "
            f"{sys.version.split()[0]}; run make with PYTHON=/path/to/a/newer/python3"
        )
    if importlib.util.find_spec("ensurepip") is None:
        lacks.append("the venv module is incomplete; apt-get install python3-venv")
    header = Path(sysconfig.get_path("include")) / "Python.h"
    if not header.exists():
        lacks.append("Python's C headers are missing; apt-get install python3-dev")
    if not any(shutil.which(name) for name in ("cc", "gcc", "clang")):
        lacks.append("no C compiler was found; apt-get install gcc libc6-dev")
    return lacks


def main() -> int:
    """Print what is missing and return the exit status."""
    lacks = missing()
    for sentence in lacks:
        sys.stderr.write(f"pbonet: {sentence}\n")
    return 1 if lacks else 0


if __name__ == "__main__":
    sys.exit(main())
