"""pbonet beside iceoryx2, dora, CycloneDDS, raw zenoh, Drake and a lock, in one run.

    python -m benchmarks.rivals [--only QUESTION ...] [--rounds N] [--seconds S]
        [--packages FOLDER] [--markdown FILE]

A rival that is not installed is skipped, by its name. `pip install --group rivals`
installs them all; in a folder by itself with `--target FOLDER`, then named by
`--packages FOLDER`. Status 3: a goal was missed.
"""

from __future__ import annotations

import argparse
import os
import site
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks import rtbench

if TYPE_CHECKING:
    from collections.abc import Iterable

QUESTIONS = ("sets", "pipeline", "modules")
PACKAGES = ("numpy", "eclipse-zenoh", "iceoryx2", "cyclonedds", "dora-rs", "drake")
BLOCK, RUN = 0.3, 3.0
"""Seconds of one block of the sets, and of one run of a pipeline."""


def main() -> None:
    """Measure, print, and judge."""
    parser = argparse.ArgumentParser(description="pbonet beside its rivals.")
    parser.add_argument("--only", nargs="+", choices=QUESTIONS, default=QUESTIONS)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=1.0, help="a factor of time")
    parser.add_argument("--packages", type=Path, help="a folder with rivals")
    parser.add_argument("--markdown", type=Path, help="also write the tables there")
    options = parser.parse_args()
    if options.packages:
        use(options.packages)
    lines, verdicts = measure(options.only, options.rounds, options.seconds)
    print("\n".join(lines))
    if options.markdown:
        text = "\n".join([*lines, *verdicts])
        options.markdown.write_text(text + "\n", encoding="utf-8")
    rtbench.judge(verdicts)


def use(folder: Path) -> None:
    """Find packages in a folder too, here and in the processes of rivals."""
    site.addsitedir(str(folder))
    paths = [str(folder.absolute()), os.environ.get("PYTHONPATH", "")]
    os.environ["PYTHONPATH"] = os.pathsep.join(path for path in paths if path)
    scripts = str(folder.absolute() / "bin")
    os.environ["PATH"] = os.pathsep.join([scripts, os.environ.get("PATH", "")])


def measure(
    questions: Iterable[str], rounds: int, factor: float
) -> tuple[list[str], list[str]]:
    """Return the tables and the verdicts of these questions."""
    from benchmarks.rivals import (
        modules_in_one_process,
        pipeline_of_three,
        report,
        sets_between_processes,
    )

    lines = [f"{rtbench.machine()}; {report.versions(PACKAGES)}.", ""]
    verdicts: list[str] = []
    if "sets" in questions:
        sets = sets_between_processes.measure(rounds, BLOCK * factor, tell)
        lines += report.sets(sets)
        verdicts += report.goals_of_sets(sets)
    if "pipeline" in questions:
        runs = pipeline_of_three.measure(rounds, RUN * factor, tell)
        lines += report.pipelines(runs)
        verdicts += report.goals_of_pipelines(runs)
    if "modules" in questions:
        each = modules_in_one_process.measure(rounds, tell)
        lines += report.inner_modules(each)
        verdicts += report.goals_of_modules(each)
    return lines, verdicts


def tell(text: str) -> None:
    """Print a line at once, beside the tables."""
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
