"""Print what pbonet needs beside itself, a line for each package.

    python scripts/requirements.py [EXTRA ...]

So the packages can be installed while the native parts are compiled.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"


def requirements(extras: list[str]) -> list[str]:
    """Return the packages that pbonet and extras need.

    Raises:
        KeyError: There is no such extra.
    """
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    optional = project["optional-dependencies"]
    found: list[str] = [*project["dependencies"]]
    for name in extras:
        found += optional[name]
    return found


if __name__ == "__main__":
    print("\n".join(requirements(sys.argv[1:])))
