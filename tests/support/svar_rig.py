"""What the hostile tests of the table share: building C tests, forking, two writers.

Two writers own seven variables each. All elements of six of them hold the writer's
counter, the seventh holds the other's counter as seen before the commit. So a reader
can tell a torn group from a whole one, and a cut that never was from one that was.
The C side is tests/native/svar_rig.h.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from pbonet.config.model import Variable

ROOT = Path(__file__).resolve().parents[2]
HEADERS = ROOT / "pbonet" / "svar"
NATIVE = ROOT / "tests" / "native"
WRITERS, VARS = 2, 7
PATIENCE = 30.0


def names(writer: int) -> list[str]:
    return [f"W{writer}V{i}" for i in range(VARS)]


def variables(words: int) -> list[Variable]:
    return [
        Variable(name=name, type="uint64", nelem=1 if name.endswith("V6") else words)
        for writer in range(WRITERS)
        for name in names(writer)
    ]


def run(program, *args: object) -> dict[str, int]:
    """Run a C program; return what it says as JSON."""
    done = subprocess.run(
        [str(program), *map(str, args)],
        capture_output=True,
        text=True,
        check=False,
        timeout=50,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout)


def compiler(*wanted: str) -> str:
    """Return the first C compiler there is; skip the test when there is none."""
    for name in wanted or ("cc", "gcc", "clang"):
        if found := shutil.which(name):
            return found
    pytest.skip(f"no C compiler: {' '.join(wanted)}")
    return ""


def build(
    source: str,
    target: Path,
    *flags: str,
    cc: str = "",
    headers: Path = HEADERS,
) -> Path:
    """Compile a C test strictly and return the program."""
    command = [
        cc or compiler(),
        *("-std=c11", "-O2", "-Wall", "-Wextra", "-Werror", f"-I{headers}", *flags),
        *(str(NATIVE / source), "-o", str(target), "-lpthread"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target


def mutant(
    folder: Path, header: str, right: str, wrong: str, headers: Path = HEADERS
) -> Path:
    """Copy the headers with one line made wrong; return the copy's folder."""
    copy = folder / headers.relative_to(ROOT / "pbonet")
    copy.mkdir(parents=True)
    if headers != HEADERS:
        (folder / HEADERS.name).symlink_to(HEADERS)
    for path in headers.glob("*.h"):
        shutil.copy(path, copy)
    text = (copy / header).read_text()
    assert text.count(right) == 1, f"{header} no longer says {right!r} once"
    (copy / header).write_text(text.replace(right, wrong))
    return copy


def wait_for(condition, what: str, patience: float = PATIENCE) -> None:
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, f"waited {patience} s in vain for {what}"
        time.sleep(0.002)


class Child:
    """A forked process that runs one function and ends without Python's shut-down."""

    def __init__(self, role, *args, core: int | None = None) -> None:
        sys.stdout.flush()
        self.pid = os.fork()
        if self.pid:
            return
        code = 1
        try:
            if core is not None:
                cores = sorted(os.sched_getaffinity(0))
                os.sched_setaffinity(0, {cores[core % len(cores)]})
            role(*args)
            code = 0
        except BaseException:  # noqa: BLE001 - the parent sees the exit code
            import traceback

            traceback.print_exc()
        finally:
            os._exit(code)

    def kill(self, number: int) -> None:
        os.kill(self.pid, number)
        assert self.end() == -number

    def end(self, patience: float = PATIENCE) -> int:
        """Wait for the end and return exit code or negative signal."""
        found: list[int] = []

        def ended() -> bool:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                found.append(os.waitstatus_to_exitcode(status))
            return bool(pid)

        wait_for(ended, f"process {self.pid} to end", patience)
        return found[0]


def fill(local, writer: int, counter: int) -> None:
    """Write the counter into the writer's group, and what it saw of the other."""
    *mine, seen = names(writer)
    for name in mine:
        local.array(name).fill(counter)
    local.array(seen)[0] = local.array(names(1 - writer)[0])[0]


def is_whole(local, writer: int) -> bool:
    first = local.array(names(writer)[0])[0]
    return all((local.array(name) == first).all() for name in names(writer)[:-1])


def is_cut(local) -> bool:
    """Whether an instant can have existed at which both groups were current."""
    counter = [int(local.array(names(w)[0])[0]) for w in range(WRITERS)]
    seen = [int(local.array(names(w)[-1])[0]) for w in range(WRITERS)]
    return seen[0] <= counter[1] and seen[1] <= counter[0]


def counters(words: int):
    """Return `words` shared 64-bit counters that outlive forks."""
    import mmap

    return np.frombuffer(mmap.mmap(-1, 8 * words), np.uint64)
