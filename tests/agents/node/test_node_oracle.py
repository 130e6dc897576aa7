"""Real task processes against the oracle that knows only the thesis's text.

Random signals go to a task that cycles by itself in between, and that now and then is
made to overrun its reserve, which its handler answers by an abort. Its diary, in which
every method notes what it found in its ports, is replayed: every note must be the one
that the oracle expects, in order, and when the task stands still the global table must
hold what the oracle says.
"""

import json
import random
import shutil
from pathlib import Path

import pytest
from oracle_lifecycle import ABORT, MEANWHILE, METHODS, ON, Note, Oracle
from watching import wait_for

from pbonet.errors import MethodError, StateError
from pbonet.xm.net import messages as m

PROBE = Path(__file__).parents[2] / "oracles" / "oracle_probe.py"
SVAR = "".join(
    f"NAME {name}\nTYPE int\nDESC none\nUNITS none\nNELEM 1\nINIT 0\n\n"
    for name in ("C_IN", "C_OUT", "X", "Y")
)
RMOD = """
MODULE oracle_probe
DESC the probe
INCONST C_IN
OUTCONST C_OUT
INVAR X
OUTVAR Y
TASKTYPE periodic
FREQ 100
MAXC 0.005
LOCAL
FOLDER {folder}
EOF
"""
STEPS = 60


class RealTask:
    """A task process that runs the probe, and the oracle beside it."""

    def __init__(self, master, folder):
        self.master, self.folder = master, folder
        self.oracle = Oracle()
        self.old_x = 0
        self.seen = 0
        self.script({})

    def script(self, script):
        """Tell the probe's methods what to do from now on."""
        fresh = self.folder / "fresh.json"
        fresh.write_text(json.dumps(script))
        fresh.rename(self.folder / "script.json")

    def notes(self):
        """Return all notes that were not looked at."""
        path = self.folder / "diary.jsonl"
        lines = path.read_text().splitlines() if path.exists() else []
        return [Note(*json.loads(line)) for line in lines[self.seen :]]

    def write(self, name, value):
        self.master.ask(m.Write(name=name, values=[value]))

    def state(self):
        return self.master.status()["p"].state if self.master.status() else None

    # -- one step ---

    def step(self, signal, script, values):
        """Write the inputs, send a signal, and compare everything with the oracle."""
        c_in, x = values
        self.write("C_IN", c_in)
        self.write("X", x)
        self.oracle.table.c_in = c_in
        new_x = x
        if signal == ABORT:
            self.abort(script, new_x)
            self.compare_table()
            return
        if signal == "cycle":
            self.cycle(script)
        else:
            self.script({k: v for k, v in script.items() if k != "cycle"})
        got = None if signal == "cycle" else self.send(signal)
        notes = self.notes()
        self.seen += len(notes)
        rest = self.replay_cycles(notes, script if signal == "cycle" else {}, new_x)
        self.oracle.table.x = self.old_x = new_x
        if signal != "cycle":
            wanted = self.oracle.send(signal, script)
            assert rest[: len(wanted.notes)] == wanted.notes
            assert got == (wanted.refused, wanted.failed)
            rest = self.replay_cycles(rest[len(wanted.notes) :], {}, new_x)
        assert rest == []
        self.compare_table()

    def abort(self, script, new_x):
        """Have a cycle overrun, change its input meanwhile, and have it aborted."""
        self.script({"cycle": "abort"})
        overruns = self.folder / "overruns"
        wait_for(overruns.exists, "a cycle that overruns")
        *before, cycle = self.notes()
        self.seen += len(before) + 1
        assert self.replay_cycles(before, {}, new_x) == []
        self.oracle.table.x = cycle.x
        wanted = self.oracle.send(ABORT, script)
        self.write("X", cycle.x + MEANWHILE)
        overruns.unlink()
        self.script({k: v for k, v in script.items() if k != "cycle"})
        more = 2 if self.oracle.state == ON else 0
        left = len(wanted.notes) - 1
        wait_for(lambda: len(self.notes()) >= left + more, "what follows an abort")
        wait_for(lambda: self.state() == self.oracle.state, self.oracle.state)
        self.script({})
        notes = self.notes()
        self.seen += len(notes)
        assert [cycle, *notes[:left]] == wanted.notes
        self.old_x = cycle.x + MEANWHILE
        assert self.replay_cycles(notes[left:], {}, self.old_x) == []

    def replay_cycles(self, notes, script, new_x):
        """Take cycles off the notes as long as the oracle is ON; return the rest."""
        while notes and self.oracle.state == ON and notes[0].method == "cycle":
            told = len(notes) > 1 and notes[1].method == "error"
            assert notes[0].x in {self.old_x, new_x}
            if notes[0].x == new_x:
                self.old_x = new_x  # it cannot go back
            self.oracle.table.x = notes[0].x
            wanted = self.oracle.send("cycle", script if told else {})
            assert notes[: len(wanted.notes)] == wanted.notes
            notes = notes[len(wanted.notes) :]
        return notes

    def compare_table(self):
        """Compare what stands in the global table, if the task stands still."""
        if self.oracle.state == ON:
            return
        for name in ("C_OUT", "Y"):
            wanted = getattr(self.oracle.table, name.lower())
            assert self.master.value(name).values == [wanted], name
        found = self.master.status()
        state = found["p"].state if found else "NOT-CREATED"
        assert state == self.oracle.state

    # -- signals ---

    def cycle(self, script):
        """Let a task that is ON cycle, its first ones as told."""
        if self.oracle.state != ON:
            return
        self.script(script)
        count = len(self.notes())
        fails = script.get("cycle") in {"raise", "fail"}
        if fails and script.get("error") != "CONTINUE":
            wait_for(lambda: self.state() != ON, "the state that error answered")
        else:
            wait_for(lambda: len(self.notes()) > count + 3, "cycles as told")
        self.script({})
        if self.state() == ON:
            count = len(self.notes())
            wait_for(lambda: len(self.notes()) > count + 1, "cycles untold")

    def send(self, signal):
        """Send a signal; return whether it was refused, and whether it failed."""
        try:
            self.act(signal)
        except StateError:
            return True, False
        except MethodError:
            return False, True
        return False, False

    def act(self, signal):
        if signal == "spawn":
            text = RMOD.format(folder=self.folder)
            self.master.spawn("p", "oracle_probe", text=text)
        elif self.oracle.state == "NOT-CREATED":
            raise StateError("there is no task")
        elif signal == "set":
            self.master.ask(m.Set(task="p", name="gain", value="2"))
        else:
            self.master.control("p", signal)


def random_step(rng, state):
    """Return a signal, mostly a valid one, and what the methods do."""
    likely = {
        "NOT-CREATED": ["spawn"],
        "OFF": ["on", "on", "on", "kill", "reinit", "set"],
        "ON": ["cycle", "cycle", ABORT, ABORT, "off", "kill", "reinit", "set"],
        "ERROR": ["clear", "clear", "kill", "reinit", "set"],
    }[state]
    anything = ["spawn", "on", "cycle", "off", "kill", "clear", "reinit", "set"]
    signal = rng.choice(likely if rng.random() < 0.8 else anything)
    script = {}
    if rng.random() < 0.4:
        for method in METHODS:
            if rng.random() < 0.5:
                script[method] = rng.choice(["raise", "fail"])
        script["error"] = rng.choice(["OFF", "CONTINUE", "ERROR", "raise"])
    elif rng.random() < 0.2:
        script["on"] = rng.choice(["OFF", "ERROR", "CONTINUE"])
        script["clear"] = rng.choice(["OFF", "ERROR", "CONTINUE"])
    return signal, script


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_random_signals(nodes, tmp_path, seed):
    rng = random.Random(seed)
    shutil.copy(PROBE, nodes.library)
    nodes.agent("arm0")
    master = nodes.master("arm0", "arm", table=False)
    master.open_table(SVAR + "EOF\n")
    task = RealTask(master, tmp_path)
    for number in range(STEPS):
        signal, script = random_step(rng, task.oracle.state)
        step = (number, task.oracle.state, signal, script)
        try:
            task.step(signal, script, (rng.randrange(1, 99), rng.randrange(1, 99)))
        except AssertionError as error:
            raise AssertionError(f"step {step}: {error}") from error
