"""Tell what this machine lacks before anything is installed, with the remedy.

Runs under the system's own Python, before there is a virtual environment, so it uses
the standard library only.
"""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

OLDEST = (3, 11)


def missing() -> list[str]:
    """Return one sentence for each thing that is missing."""
    lacks: list[str] = []
    if sys.version_info < OLDEST:
        lacks.append(
            f"Python {OLDEST[0]}.{OLDEST[1]} or newer is needed, this is "
            f"{sys.version.split()[0]}; run make with PYTHON=/path/to/a/newer/python3"
        )
    if not has_venv():
        lacks.append("the venv module is incomplete; apt-get install python3-venv")
    return lacks + lacks_to_compile()


def lacks_to_compile() -> list[str]:
    """Return one sentence for each thing that the native parts lack to be built."""
    lacks: list[str] = []
    if not has_headers():
        lacks.append("Python's C headers are missing; apt-get install python3-dev")
    named = os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc"
    command = shlex.split(named)
    if shutil.which(command[0]) is None:
        lacks.append(
            f"the C compiler {command[0]} was not found; name another one with "
            "CC, or apt-get install gcc libc6-dev"
        )
    elif not compiles(command):
        lacks.append("the C library's headers are missing; apt-get install libc6-dev")
    return lacks


def has_venv() -> bool:
    """Tell whether a virtual environment with pip can be made."""
    return importlib.util.find_spec("ensurepip") is not None


def has_headers() -> bool:
    """Tell whether this Python's own C headers are there."""
    return (Path(sysconfig.get_path("include")) / "Python.h").exists()


def compiles(command: list[str]) -> bool:
    """Tell whether a compiler, with its first arguments, finds the C library's headers.

    It may be a compiler behind another program, such as ``ccache gcc``.
    """
    done = subprocess.run(
        [*command, "-fsyntax-only", "-x", "c", "-"],
        input=b"#include <stdlib.h>\n",
        capture_output=True,
        check=False,
    )
    return done.returncode == 0


def main() -> int:
    """Print what is missing and return the exit status."""
    lacks = missing()
    for sentence in lacks:
        sys.stderr.write(f"pbonet: {sentence}\n")
    return 1 if lacks else 0


if __name__ == "__main__":
    sys.exit(main())
