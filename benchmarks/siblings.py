"""What a healthy task of 500 Hz loses beside each module that misbehaves.

A real agent and master. A task of the library runs at 500 Hz under MUF; beside it, one
after the other, modules of ``tests/misbehaving`` are spawned, turned on, left alone for
some seconds, and killed. What the healthy task missed stands in the dispatcher's own
trace; a miss is excused when a C loop above the dispatcher was late at that time (see
`benchmarks.swap`). All have the same criticality. Ends with status 3 when the healthy
task lost a cycle that is not excused.

    python -m benchmarks.siblings [--seconds 3] [--json FILE] [MODULE ...]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import rtbench, swap
from benchmarks.steering import VARIABLE
from pbonet.errors import PbonetError
from pbonet.master import Subsystem
from pbonet.master.subsystem.embedded_agents import Embedded

MODULES = Path(__file__).parents[1] / "tests" / "misbehaving"
RATE = 500.0
BAD = (
    "hangs_in_cycle", "hangs_in_c", "hangs_in_sync", "never_waits", "overruns",
    "blocks_signals", "waits_in_cycle", "leaves_threads", "leaves_children",
    "forks_without_end", "eats_memory", "takes_over", "keeps_views", "prints_a_lot",
    "warns_always", "raises_in_cycle", "segfaults", "dies_by_sigkill",
)  # fmt: skip
SYNCHRONOUS = {"hangs_in_sync", "never_waits"}
HEALTHY = "healthy"
RTPU = "bench0"
RMOD = """\
MODULE    {module}
DESC      of the benchmark
{alias}
INCONST   {inconst}
OUTCONST  none
INVAR     {invar}
OUTVAR    {outvar}
TASKTYPE  {kind}
FREQ      {rate:g}
{more}
EOF
"""


def write_files(folder: Path) -> Path:
    """Write the subsystem; return its ``.sbs`` file."""
    numbers = [VARIABLE.format(name="NDOF", kind="int", units="none", nelem=1)]
    variables = [numbers[0] + "INIT 6\n"]
    variables += [
        VARIABLE.format(name=name, kind="double", units="any", nelem=nelem)
        for name, nelem in (("P", 6), ("V", 6), ("Y", 2), ("Z", 2))
    ]
    files = {
        "b.svar": "\n".join(variables) + "\nEOF\n",
        "b.sbs": f"SUBSYSTEM b\nSVARFILE b.svar\nRTPU {RTPU}\nEOF\n",
        f"{HEALTHY}.rmod": RMOD.format(
            module="sine", alias="SVARALIAS Y=P\nSVARALIAS Y^=V", inconst="NDOF",
            invar="none", outvar="Y Y^", rate=RATE, kind="periodic",
            more="LOCAL\nAMPLITUDE 1\nFREQ 1",
        ),
    }  # fmt: skip
    more = {"leaves_children": f"LOCAL\nPIDS {folder / 'pids'}"}
    for module in BAD:
        reads = module == "keeps_views"
        files[f"{module}.rmod"] = RMOD.format(
            module=module, alias="", inconst="none", invar="Z" if reads else "none",
            outvar="Y", rate=100.0, more=more.get(module, ""),
            kind="synchronous" if module in SYNCHRONOUS else "periodic",
        )  # fmt: skip
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder / "b.sbs"


def beside(
    subsystem: Subsystem, folder: Path, module: str, seconds: float
) -> dict[str, int]:
    """Return what the healthy task lost beside a module, "" for none."""
    watched = swap.Watched(subsystem, folder, [RTPU])
    if module:
        subsystem.spawn(module, RTPU)
        with contextlib.suppress(PbonetError):  # it dies of it
            subsystem.control(module, "on")
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        subsystem.wait(0.02)  # events without end fill the trace in 0.1 s
        watched.look()
    if module:
        with contextlib.suppress(PbonetError):  # it is dead, or its end failed
            subsystem.control(module, "kill")
    return watched.end()


def main() -> None:
    """Measure and report; status 3 when a goal is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("modules", nargs="*", default=BAD, metavar="MODULE")
    asked = parser.parse_args()
    swap.PERIOD, swap.STAY = round(1e9 / RATE), (HEALTHY, HEALTHY)
    found: dict[str, dict[str, int]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["PBONET_RUN_DIR"] = str(folder / "run")
        sbs = write_files(folder)
        with Embedded("default", libraries=[str(MODULES)]) as agents:
            agents.start([RTPU])
            with Subsystem(sbs, warned=lambda _text: None, record="off") as subsystem:
                subsystem.spawn(HEALTHY, RTPU)
                subsystem.control(HEALTHY, "on")
                for module in ("", *asked.modules):
                    counts = beside(subsystem, folder, module, asked.seconds)
                    found[module or "nothing"] = counts
    print(rtbench.machine())
    print(f"{'beside':20} {'releases':>9} {'lost':>5} {'excused':>8} {'untraced':>9}")
    for module, counts in found.items():
        numbers = counts["releases"], counts[swap.LOST], counts[swap.EXCUSED]
        print(f"{module:20} {numbers[0]:9} {numbers[1]:5} {numbers[2]:8} "
              f"{counts['records lost']:9}")  # fmt: skip
    if asked.json:
        asked.json.write_text(json.dumps(found, indent=1), encoding="utf-8")
    if any(counts[swap.LOST] for counts in found.values()):
        sys.exit(3)  # see run.py


if __name__ == "__main__":
    main()
