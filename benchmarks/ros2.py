"""ROS 2: how late a variable comes to a subscriber and back, beside raw zenoh.

    python -m benchmarks.ros2 [--rounds N] [--seconds S] [--markdown FILE]

Six numbers go out 500 times a second and come back from another process, which answers
each message by one of its own. Contestants take turns within every round.

    pbonet      commit to the table, bridge, zenoh, a node that answers, zenoh, bridge,
                link, the reader behind its wait
    raw zenoh   `put`, a callback that puts, the callback: two processes, with no CDR
                and no table, linked by TCP
"""

from __future__ import annotations

import argparse
import os
import secrets
import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import cast

from benchmarks import rtbench
from benchmarks.tbuf import LOOP, RAW, Program, free_port

MOST = 1.5
"""Goal: the median of the way there and back, in raw zenoh's."""
WARM_UP = 0.5
COUNT = 6
SVAR = f"""
NAME THERE
TYPE double
DESC when it was written
UNITS any
NELEM {COUNT}

EOF
"""
SBS = "SUBSYSTEM b\nSVARFILE b.svar\nRTPU none0\nEOF\n"
TOPICS = f"""
[[publish]]
topic = "/there"
type = "std_msgs/msg/Float64MultiArray"
fields = {{ data = "THERE" }}

[[subscribe]]
topic = "/back"
type = "std_msgs/msg/Float64MultiArray"
link = "back"
fields = ["data[0:{COUNT}]"]
"""
TASK = (
    LOOP
    + """
import threading
from pbonet import tbuf, xm
from pbonet.config import parse_svar
from pbonet.svar import Table
xm.live_on("bench", domain=settings["domain"])
file = parse_svar(settings["svar"])
table = Table.create(settings["domain"] + ".b", file.variables)
local = table.local("task", os.getpid(), outvar=["THERE"])
value = local.array("THERE")
local.claim()
back = tbuf.Reader("ros2:back", ("f8", len(value)))
late = []
def take():
    while True:
        if back.wait(time.monotonic_ns() + 200_000_000) and back.read():
            late.append(time.monotonic_ns() - int(back.value[0]))
threading.Thread(target=take, daemon=True).start()
tell("ready")
period = 0.002
for line in sys.stdin:
    late.clear()
    for _ in paced(float(line)):
        value[0] = time.monotonic_ns()
        local.commit()
    time.sleep(0.2)
    tell(list(late))
table.destroy()
"""
)
BRIDGE = (
    LOOP
    + """
from pathlib import Path
from pbonet.master.subsystem import Subsystem
from pbonet.ros2.bridge import Bridge, Network
from pbonet.ros2.topics_file import read_topics
from pbonet.ros2.repeated_warnings import Warnings
from pbonet.svar import short_slices
short_slices()
folder = Path(settings["folder"])
bridge = Bridge(
    Subsystem(folder / "b.sbs", domain=settings["domain"], watch=True),
    read_topics(folder / "b.toml"),
    Network(listen=f"tcp/127.0.0.1:{settings['port']}"),
    Warnings(lambda text: print(text, file=sys.stderr)),
)
tell("ready")
for line in sys.stdin:
    pass
bridge.close()
"""
)
ECHO = (
    LOOP
    + RAW
    + """
session = zenoh.open(config("connect", settings["port"]))
back = session.declare_publisher(
    settings["back"], congestion_control=zenoh.CongestionControl.DROP
)
def take(sample):
    back.put(sample.payload, attachment=sample.attachment)
session.declare_subscriber(
    settings["there"], zenoh.handlers.Callback(take, indirect=False)
)
tell("ready")
for line in sys.stdin:
    pass
session.close()
"""
)
PUT = (
    LOOP
    + RAW
    + """
late = []
def take(sample):
    data = sample.payload.to_bytes()
    late.append(time.monotonic_ns() - int.from_bytes(data[:8], "little"))
session = zenoh.open(config("listen", settings["port"]))
there = session.declare_publisher(
    "there", congestion_control=zenoh.CongestionControl.DROP
)
session.declare_subscriber("back", zenoh.handlers.Callback(take, indirect=False))
rest = bytes(settings["size"] - 8)
tell("ready")
period = 0.002
for line in sys.stdin:
    late.clear()
    for _ in paced(float(line)):
        there.put(time.monotonic_ns().to_bytes(8, "little") + rest)
    time.sleep(0.2)
    tell(list(late))
session.close()
"""
)


def latencies(rounds: int, seconds: float) -> dict[str, list[float]]:
    """Return the ways there and back in microseconds, by contestant."""
    shm, folder = tempfile.mkdtemp(dir="/dev/shm"), tempfile.mkdtemp()
    env = os.environ | {"PBONET_SHM_DIR": shm}
    domain, port, plain = f"b{secrets.token_hex(3)}", free_port(), free_port()
    for name, text in (("b.svar", SVAR), ("b.sbs", SBS), ("b.toml", TOPICS)):
        (Path(folder) / name).write_text(text)
    key = _keys(folder)
    task = Program(TASK, env, size=0, domain=domain, svar=SVAR)
    raw = Program(PUT, env, size=8 * COUNT, port=plain)
    others = [
        Program(BRIDGE, env, size=0, domain=domain, folder=folder, port=port),
        Program(ECHO, env, size=0, port=port, there=key[0], back=key[1]),
        Program(ECHO, env, size=0, port=plain, there="there", back="back"),
    ]
    found: dict[str, list[float]] = {}
    try:
        for turn in range(rounds + 1):
            for name, source in (("pbonet", task), ("raw zenoh", raw)):
                source.go(WARM_UP if turn == 0 else seconds)
                late = cast("list[int]", source.result())
                if turn:
                    found.setdefault(name, []).extend(ns / 1000 for ns in late)
    finally:
        for program in (*reversed(others), raw, task):
            program.end()
        shutil.rmtree(shm)
        shutil.rmtree(folder)
    return found


def _keys(folder: str) -> tuple[str, str]:
    """Return the keys of both topics."""
    from pbonet.ros2.message_types import MessageTypes
    from pbonet.ros2.topics_file import ARRAY, read_topics
    from pbonet.ros2.wire_format import dds_type

    domain = read_topics(Path(folder) / "b.toml").ros_domain
    rest = f"{dds_type(ARRAY)}/{MessageTypes().hash(ARRAY)}"
    return f"{domain}/there/{rest}", f"{domain}/back/{rest}"


def report(late: dict[str, list[float]], words: str) -> list[str]:
    """Return the table as Markdown."""
    lines = ["# ROS 2", "", f"    {words}", "", f"{rtbench.machine()}.", ""]
    lines += ["| there and back, microseconds | p50 | p99 | messages |"]
    lines += ["|---|---|---|---|"]
    middle: dict[str, float] = {}
    for name, values in late.items():
        cuts = statistics.quantiles(values, n=100)
        middle[name] = cuts[49]
        lines.append(f"| {name} | {cuts[49]:.0f} | {cuts[98]:.0f} | {len(values)} |")
    ratio = middle["pbonet"] / middle["raw zenoh"]
    met = "met" if ratio <= MOST else "NOT met"
    goal = f"- median there and back at most {MOST:g} x raw zenoh: {ratio:.3g}"
    return [*lines, "", f"{goal}, **{met}**"]


def main() -> None:
    """Run the benchmark and print its table; status 3 when the goal is missed."""
    parser = argparse.ArgumentParser(description="ROS 2 beside raw zenoh.")
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--markdown", type=Path, help="also write the table there")
    options = parser.parse_args()
    words = f"python -m benchmarks.ros2 --rounds {options.rounds}"
    words += f" --seconds {options.seconds:g}"
    begun = time.monotonic()
    lines = report(latencies(options.rounds, options.seconds), words)
    print(f"{time.monotonic() - begun:.0f} s", file=sys.stderr)
    rtbench.judge(lines, options.markdown)


if __name__ == "__main__":
    main()
