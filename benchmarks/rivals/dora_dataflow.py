"""dora: three Python nodes in one dataflow, each input with the newest value only.

The source keeps time by itself, which costs less than a timer of the daemon.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Generator

NEEDS = ("dora-rs", "dora-rs-cli")
START, END = 90.0, 60.0
"""Seconds within which the nodes run, and end."""
NODES = {
    "source": """
data = np.zeros({width})
due = time.monotonic()
end = due + {seconds}
Path("started").touch()
while due < end:
    due += 1 / {rate}
    time.sleep(max(due - time.monotonic(), 0.0))
    data[1] += 1
    data[0] = time.monotonic_ns()
    node.send_output("there", pa.array(data))
""",
    "middle": """
for event in node:
    if event["type"] == "INPUT":
        node.send_output("there", event["value"])
""",
    "sink": """
seen = []
for event in node:
    if event["type"] == "INPUT":
        data = event["value"].to_numpy()
        seen.append((time.monotonic_ns() - data[0], data[1]))
np.save("seen.npy", seen)
""",
}
HEAD = """\
import os, sys, time
from pathlib import Path
import numpy as np
import pyarrow as pa
from dora import Node
os.chdir(Path(__file__).parent)
node = Node()
"""
FLOW = """\
nodes:
  - {id: source, path: source.py, outputs: [there]}
  - {id: middle, path: middle.py, outputs: [there],
     inputs: {here: {source: source/there, queue_size: 1}}}
  - {id: sink, path: sink.py,
     inputs: {here: {source: middle/there, queue_size: 1}}}
"""


@contextlib.contextmanager
def running(
    folder: Path, rate: int, width: int, seconds: float
) -> Generator[None, None, None]:
    """Run the dataflow; ``seen.npy`` then holds age (ns) and number of each set.

    Args:
        folder: Of its files.
        rate: Sets in a second.
        width: Numbers in a set.
        seconds: How long the source sends.

    Raises:
        RuntimeError: It did not start, or did not come to its end.
    """
    for name, text in NODES.items():
        made = text.format(rate=rate, width=width, seconds=seconds)
        (folder / f"{name}.py").write_text(HEAD + made, encoding="utf-8")
    flow = folder / "flow.yml"
    flow.write_text(FLOW, encoding="utf-8")
    here = str(Path(sys.executable).parent)
    path = os.pathsep.join([here, os.environ.get("PATH", "")])
    command = [shutil.which("dora", path=path) or "dora", "run", str(flow)]
    command += ["--log-level", "error"]
    process = subprocess.Popen(
        command,
        env=os.environ | {"PATH": path},
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        limit = time.monotonic() + START
        while not (folder / "started").exists():
            if process.poll() is not None or time.monotonic() > limit:
                msg = f"dora did not start within {START:g} s"
                raise RuntimeError(msg)
            time.sleep(0.02)
        yield
        try:
            process.wait(seconds + END)
        except subprocess.TimeoutExpired:
            msg = f"dora did not end within {END:g} s"
            raise RuntimeError(msg) from None
        if not (folder / "seen.npy").exists():
            msg = "dora's last node ended without what it had seen"
            raise RuntimeError(msg)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
