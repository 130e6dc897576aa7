"""A terminal on which a page's commands are typed as they stand there."""

from __future__ import annotations

import os
import pty
import shlex
import subprocess
import sys
import threading
from pathlib import Path

from watching import clean_folder, processes_of, wait_for

ROOT = Path(__file__).parents[2]
PATIENCE = 120.0
"""Seconds for one command on a machine that does much else."""


def words_of(block):
    """Return each line of a block as words, without its comment."""
    lines = (shlex.split(line, comments=True) for line in block.splitlines())
    return [words for words in lines if words]


class Desk:
    """A terminal in a folder, with a runtime folder of its own.

    Args:
        folder: Where it keeps what it needs itself.
        cwd: Where its commands run.
    """

    def __init__(self, folder, cwd):
        self.folder, self.cwd = folder, cwd
        self.started = []
        shim = folder / "bin" / "pbonet"
        shim.parent.mkdir()
        python = shlex.quote(sys.executable)
        shim.write_text(f'#!/bin/sh\nexec {python} -m pbonet.cli "$@"\n')
        shim.chmod(0o700)
        (folder / "run").mkdir(mode=0o700)
        self.env = os.environ | {
            "PATH": f"{shim.parent}:{os.environ.get('PATH', os.defpath)}",
            "PBONET_RUN_DIR": str(folder / "run"),
            "PYTHONPATH": str(ROOT),
            "XDG_STATE_HOME": str(folder),
            "COLUMNS": "120",
            "TERM": "xterm",
        }
        self.env.pop("PBONET_DOMAIN", None)

    def call(self, words, *more):
        """Run a command to its end; return what it printed."""
        done = subprocess.run(
            [*words, *more],
            cwd=self.cwd,
            env=self.env,
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
            timeout=PATIENCE,
            check=False,
        )
        assert done.returncode == 0, (words, done.stdout, done.stderr)
        assert "Traceback" not in done.stderr
        return done.stdout

    def begin(self, words):
        """Start a command in the background."""
        process = subprocess.Popen(
            words,
            cwd=self.cwd,
            env=self.env,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.started.append(process)
        return process

    def prompt(self, words, typed):
        """Run a command on a terminal, type there, and return what was seen."""
        master, slave = pty.openpty()
        process = subprocess.Popen(
            words,
            cwd=self.cwd,
            env=self.env,
            stdin=slave,
            stdout=slave,
            stderr=slave,
        )
        self.started.append(process)
        os.close(slave)
        seen = bytearray()

        def look():
            try:
                while data := os.read(master, 4096):
                    seen.extend(data)
                    if b"\x1b[6n" in data:  # it asks where the cursor is
                        os.write(master, b"\x1b[1;1R")
            except OSError:
                return  # the terminal's other end is closed

        reader = threading.Thread(target=look, daemon=True)
        reader.start()
        for wanted, text in typed:
            wait_for(lambda wanted=wanted: wanted in seen, repr(wanted), PATIENCE)
            os.write(master, text)
        assert process.wait(PATIENCE) == 0, seen.decode(errors="replace")
        reader.join(PATIENCE)
        os.close(master)
        return seen.decode(errors="replace")

    def processes(self):
        """Return what runs in its runtime folder."""
        return processes_of("PBONET_RUN_DIR", str(self.folder / "run"))

    def close(self):
        """End what a failed test left, and see that nothing is left."""
        for process in self.started:
            if process.poll() is None:
                process.kill()
            process.communicate()
        clean_folder(self.folder / "run", "PBONET_RUN_DIR")
