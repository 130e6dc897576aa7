"""A host with a dispatcher and tasks in real processes, steered over a pipe.

Run as a script it *is* the host: it forks a task server while it has one thread, then
opens the core table and starts its dispatcher. Tasks are forked by the server, as in a
node; what each does in its cycle is one of the `BODIES`.
"""

from __future__ import annotations

import array
import contextlib
import gc
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import msgspec
import numpy as np

from pbonet.node.rt import _rt

CORE = max(os.sched_getaffinity(0))
MS = 1_000_000
NOBODY = 65534


# ---- what a task does ---------------------------------------------------------------
def burn(ns: int) -> None:
    end = time.thread_time_ns() + ns
    while time.thread_time_ns() < end:
        pass


def idle(_task, **_):
    return lambda _dt: None


def busy(_task, ns):
    return lambda _dt: burn(ns)


def first_long(_task, first_ns, ns):
    count = iter(range(1 << 30))
    return lambda _dt: burn(ns if next(count) else first_ns)


def matmul(_task, size):
    a = np.random.default_rng(1).random((size, size))
    out = np.empty_like(a)
    return lambda _dt: np.matmul(a, a, out=out)


def overrun(_task, every, ns):
    count = iter(range(1, 1 << 30))
    return lambda _dt: burn(ns) if next(count) % every == 0 else None


def random_busy(_task, seed, most_ns):
    pick = np.random.default_rng(seed).random
    return lambda _dt: burn(int(pick() ** 3 * most_ns))


def hang(_task):
    def cycle(_dt):
        while True:
            pass

    return cycle


def sleeps(_task, ns):
    return lambda _dt: time.sleep(ns * 1e-9)


def stamps(task, ns):
    """Note the time again and again while computing; the host reads the notes."""

    def cycle(_dt):
        end = time.thread_time_ns() + ns
        while time.thread_time_ns() < end:
            task.notes.append(time.monotonic_ns())

    return cycle


BODIES = {
    f.__name__: f
    for f in (
        idle,
        busy,
        first_long,
        matmul,
        overrun,
        random_busy,
        hang,
        sleeps,
        stamps,
    )
}


class Task:
    """A task's process, from its fork to its end."""

    def __init__(self, order: dict) -> None:
        parent = os.getppid()
        _rt.orphan_guard(signal.SIGUSR1, parent)
        self.table = _rt.CoreTable(order["core"], member=False)
        self.slot = _rt.Slot(self.table, order["slot"])
        _rt.pin(order["core"])
        _rt.set_timer_slack()
        if order.get("settled"):
            _rt.lock_memory()
            _rt.populate_pages()
            _rt.prefault_stack()
        self.ring = _rt.Ring.attach(order["ring"])
        self.order = order
        self.notes = array.array("q")
        self.dts: list[float] = []
        self.levels: list[int] = []

    def run(self) -> int:
        cycle = BODIES[self.order["body"]](self, **self.order["args"])
        if self.order.get("dts"):
            cycle = self._with_dt(cycle)
        gc.collect()
        gc.freeze()
        gc.disable()
        commands = self.order.get("commands", 1)
        while True:
            why = self.slot.run(cycle, None, ring=self.ring)
            self.levels.append(os.sched_getparam(0).sched_priority)
            if why == _rt.ORPHAN:
                self.slot.disarm()
                return 3
            commands -= 1
            if commands == 0:
                self.slot.disarm()
                self._leave_notes()
                return 0
            if self.order.get("off_on"):
                self.slot.disarm()
                time.sleep(self.order["off_on"])

    def _with_dt(self, cycle):
        def noting(dt):
            self.dts.append(dt)
            cycle(dt)

        return noting

    def _leave_notes(self) -> None:
        Path(self.order["notes"]).write_text(
            json.dumps({
                "notes": list(self.notes), "dts": self.dts, "levels": self.levels,
            })
        )  # fmt: skip


# ---- the task server ----------------------------------------------------------------
def serve(lines, answers) -> None:
    """Fork tasks on request; single-threaded for good."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for line in lines:
        order = json.loads(line)
        if "wait" in order:
            _, status = os.waitpid(order["wait"], 0)
            answer = os.waitstatus_to_exitcode(status)
        else:
            answer = os.fork()
            if answer == 0:
                code = 99
                try:
                    code = Task(order).run()
                except BaseException as error:  # noqa: BLE001 - told to the host
                    sys.stderr.write(f"task {order['body']}: {error!r}\n")
                finally:
                    sys.stderr.flush()
                    os._exit(code)
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


# ---- the host -----------------------------------------------------------------------
class HostProcess:
    """Commands of the host; each method is one."""

    def __init__(self, core: int, backend: str) -> None:
        to_server, from_host = os.pipe()
        to_host, from_server = os.pipe()
        host = os.getpid()
        self.server = os.fork()
        if self.server == 0:
            os.close(from_host)
            os.close(to_host)
            _rt.orphan_guard(signal.SIGUSR2, host)
            signal.signal(signal.SIGUSR2, signal.SIG_DFL)
            serve(os.fdopen(to_server), os.fdopen(from_server, "w"))
            os._exit(0)
        os.close(to_server)
        os.close(from_server)
        self.orders = os.fdopen(from_host, "w")
        self.answers = os.fdopen(to_host)
        self.core = core
        self.table = _rt.CoreTable(core)
        self.dispatcher = _rt.Dispatcher(self.table, backend)
        self.dispatcher.start()
        self.rings: dict[int, _rt.Ring] = {}
        self.since = self.lost = 0
        self.taken: list[tuple] = []
        self.taking = threading.Lock()

    def _ask(self, order: dict):
        self.orders.write(json.dumps(order) + "\n")
        self.orders.flush()
        return json.loads(self.answers.readline())

    def spawn(self, body, args, notes, settings, **order):
        slot = self.table.alloc(f"host{os.getpid()}", body)
        self.table.configure(slot, **settings)
        name = f"rig{os.getpid()}.{slot}"
        if slot not in self.rings:
            self.rings[slot] = _rt.Ring.create(name, 1 << 22)
        order |= {"body": body, "args": args, "slot": slot, "core": self.core}
        pid = self._ask(order | {"ring": name, "notes": notes})
        self.table.configure(slot, pid=pid)
        return slot, pid

    def wait(self, pid):
        return self._ask({"wait": pid})

    def configure(self, slot, **settings):
        self.table.configure(slot, **settings)

    def request(self, slot):
        self.table.request(slot)

    def free(self, slot):
        self.table.died(slot)
        self.table.free(slot)

    def slots(self):
        return self.table.slots()

    def status(self, slot):
        return json.loads(msgspec.json.encode(self.table.snapshot(slot)))

    def core_status(self):
        return json.loads(msgspec.json.encode(self.table.status()))

    def leading(self):
        return self.dispatcher.leading

    def backend(self):
        return self.dispatcher.backend

    def drain(self, slot):
        return [
            (r.cycle, r.release_ns, r.start_ns, r.end_ns, r.cpu_ns)
            for r in self.rings[slot].drain()
        ]

    def trace(self):
        self.since, lost, records = self.table.trace(self.since)
        return lost, [(r.kind, r.slot, r.arg, r.a, r.b) for r in records]

    def follow(self):
        """Take the trace from here on, whatever keeps the test from looking."""

        def take():
            while True:
                with self.taking:
                    self._take()
                time.sleep(0.02)

        threading.Thread(target=take, daemon=True).start()

    def _take(self):
        lost, records = self.trace()
        self.lost += lost
        self.taken += records

    def followed(self):
        """Return what was taken since the last call."""
        with self.taking:
            self._take()
            found, self.taken = self.taken, []
        assert not self.lost
        return found

    def stop_dispatcher(self):
        self.dispatcher.stop()

    def end(self):
        self.dispatcher.stop()
        for ring in self.rings.values():
            ring.destroy()
        self.table.close()


def host_main(core: int, backend: str, uid: int) -> None:
    if uid != os.geteuid():
        os.setgroups([])
        os.setgid(uid)
        os.setuid(uid)
    host = HostProcess(core, backend)
    print(json.dumps("ready"), flush=True)
    for line in sys.stdin:
        name, kwargs = json.loads(line)
        print(json.dumps(getattr(host, name)(**kwargs)), flush=True)
        if name == "end":
            return


# ---- the test's side ----------------------------------------------------------------
class Host:
    """A host process, seen from a test."""

    def __init__(
        self, folder: Path, backend: str = "auto", core: int = CORE, uid: int = -1
    ) -> None:
        self.folder = folder
        self.count = 0
        uid = os.geteuid() if uid < 0 else uid
        self.process = subprocess.Popen(
            [sys.executable, __file__, str(core), backend, str(uid)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            cwd=Path(__file__).parents[2],
            env=os.environ | {
                "PYTHONPATH": str(Path(__file__).parents[2]),
                "PBONET_SHM_DIR": str(folder),
                "OPENBLAS_NUM_THREADS": "1",
            },
            text=True,
        )  # fmt: skip
        assert self._answer() == "ready"

    def _answer(self):
        ready, _, _ = select.select([self.process.stdout], [], [], 120)
        assert ready, "the host does not answer"
        line = self.process.stdout.readline()
        assert line, f"the host ended with {self.process.wait()}"
        return json.loads(line)

    def __getattr__(self, name):
        def call(**kwargs):
            self.process.stdin.write(json.dumps([name, kwargs]) + "\n")
            self.process.stdin.flush()
            return self._answer()

        return call

    def spawn(self, body, args=None, *, order=None, **settings):
        self.count += 1
        path = self.folder / f"notes{self.process.pid}.{self.count}"
        slot, pid = self.__getattr__("spawn")(
            body=body, args=args or {}, notes=str(path), settings=settings,
            **(order or {}),
        )  # fmt: skip
        return Spawned(self, slot, pid, path)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def close(self) -> None:
        """End in order when the host still answers, else by force."""
        if self.process.poll() is None:
            try:
                self.__getattr__("end")()
                self.process.stdin.close()
                self.process.wait(60)
            except (AssertionError, OSError, subprocess.TimeoutExpired):
                self.kill()
        self.process.stdout.close()
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()


class Spawned:
    """A task of a host."""

    def __init__(self, host: Host, slot: int, pid: int, path: Path) -> None:
        self.host, self.slot, self.pid, self.path = host, slot, pid, path

    def status(self) -> dict:
        return self.host.status(slot=self.slot)

    def until(self, key: str, value: int, seconds: float = 60.0) -> dict:
        return until(
            lambda: (s := self.status())[key] >= value and s,
            f"{key} of slot {self.slot} reaches {value}",
            seconds,
        )

    def request(self) -> None:
        self.host.request(slot=self.slot)

    def end(self) -> dict:
        """Ask the task to end; return its notes."""
        self.request()
        code = self.host.wait(pid=self.pid)
        assert code == 0, f"the task ended with {code}"
        return json.loads(self.path.read_text())

    def records(self) -> list[tuple[int, int, int, int, int]]:
        return [tuple(r) for r in self.host.drain(slot=self.slot)]


def until(condition, what: str, seconds: float = 60.0):
    """Wait for a condition, with a bound that only a failure meets."""
    end = time.monotonic() + seconds
    while not (result := condition()):
        assert time.monotonic() < end, f"not in {seconds} s: {what}"
        time.sleep(0.005)
    return result


def exists(pid: int) -> bool:
    """Tell whether a process lives (a zombie does not)."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return text.rsplit(")", 1)[1].split()[0] not in "ZX"


def cpu_ns(pid: int) -> int:
    """The kernel's own figure of a process's main thread."""
    return int(Path(f"/proc/{pid}/task/{pid}/schedstat").read_text().split()[0])


if __name__ == "__main__":
    host_main(int(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
