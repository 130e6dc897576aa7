"""Runs of two real tasks in a line that are recorded, for tests of logs."""

from __future__ import annotations

from pathlib import Path

from watching import processes_of, wait_for

from pbonet.log import Log, is_complete
from pbonet.xm.net import messages as m

TEXT = """MODULE adds
DESC adds
SVARALIAS Z={z}
SVARALIAS Y={y}
INCONST N
OUTCONST none
INVAR Z
OUTVAR Y
TASKTYPE periodic
FREQ 250
LOCAL
gain 0.75
EOF
"""


def spawn(master, task, z, y):
    return master.spawn(task, "adds", text=TEXT.format(z=z, y=y))


def record(master, **more):
    """Begin to record; return the path of the log once it is being written."""
    got = master.ask(m.Record(**{"run": "r", "mode": "outputs", **more}), m.Recorded)
    if not more.get("last"):
        wait_for(lambda: master.rtpu_status().log, "the log")
    return Path(got.path)


def finish(master, path):
    """Have the log finished, and return the run."""
    last = Path(master.rtpu_status().log)
    master.ask(m.Record(mode="off"), m.Recorded)
    wait_for(lambda: is_complete(last), "the end of the log")
    return Log(path.parent)


def recorder(nodes):
    """Return the recorder's process id, once there is one."""

    def there():
        found = processes_of("PBONET_RUN_DIR", str(nodes.folder))
        return [
            pid
            for pid, command in found
            if "pbonet.node.recorder.recorder_process" in command
        ]

    return wait_for(there, "a recorder")[0]


def cycles_of(*lives):
    """Return the numbers of the cycles on record."""
    found = []
    for life in lives:
        arrays = life.schema.arrays(life.commits)
        found += arrays["cycle"][arrays["kind"] == 0].tolist()
    return found


def without_a_hole(cycles):
    return len(cycles) > 0 and cycles == list(range(cycles[0], cycles[-1] + 1))


def begin(master, **more):
    """Record X to a to Y0 to b to Y1, both tasks ON."""
    path = record(master, **more)
    spawn(master, "a", "X", "Y0")
    spawn(master, "b", "Y0", "Y1")
    master.on("a")
    master.on("b")
    return path


def end(master, path, tasks=("b", "a")):
    """Kill the tasks, and return the run."""
    for task in tasks:
        master.off(task)
        master.kill(task)
    return finish(master, path)


def exercise(line):
    """Do all that the verification must follow."""
    line.wait_cycles("b", 20)
    line.ask(m.Write(name="X", values=[0.25, -3.0]), m.VarValue)
    line.wait_cycles("b", 20)
    line.ask(m.Set(task="a", name="gain", value="2.5"))
    line.ask(m.Freq(task="b", hz=125.0))
    line.wait_cycles("b", 20)
    line.off("a")
    line.wait_cycles("b", 5)
    line.control("a", "reinit")
    line.on("a", arg="again")
    line.wait_cycles("b", 20)
