"""Two tasks in a line whose cycles are done in Python, and their log.

The table, the local table, the ring, the executor and the recorder are those of a task;
only the native loop around the cycles is not.
"""

from __future__ import annotations

import contextlib
import zlib

import numpy as np
from adding_module import ADDS

from pbonet.config import parse_rmod
from pbonet.config.library import Library
from pbonet.config.model import Limit, Variable
from pbonet.log import Attached, Did, LogWriter, RunAbout
from pbonet.log.cycle_columns import HEAD_DTYPE
from pbonet.log.groups import pack
from pbonet.log.schema import RECORD
from pbonet.node.ring._ring import Ring
from pbonet.node.task import journal
from pbonet.node.task.executor import Executor
from pbonet.node.task.parameters_in_task import set_param
from pbonet.node.task.task_ports import local_table
from pbonet.node.wire import rtpu_messages
from pbonet.outside import ModuleAnswers, Tape, using
from pbonet.pbo import Counted, TaskContext, bind, decode_params
from pbonet.svar import Table

RMOD = (
    "MODULE adds\nDESC d\nSVARALIAS Z={z}\nSVARALIAS Y={y}\nINCONST N\nOUTCONST none\n"
    "INVAR Z\nOUTVAR Y\nTASKTYPE periodic\nFREQ 100\nLOCAL\ngain 0.75\nEOF\n"
)
VARIABLES = (
    Variable(name="N", type="int", init=(2,)),
    Variable(name="X", type="double", nelem=2, init=(1.0, 2.0)),
    Variable(name="Y0", type="double", nelem=2),
    Variable(
        name="Y1", type="double", nelem=2, limit=Limit.CLIP, min=(0, 0), max=(9, 9)
    ),
    Variable(name="Y0W", type="double"),
    Variable(name="Y1W", type="double"),
)
PERIOD = 10_000_000


class Time:
    """Stands for the slot's time; every look at it is another instant."""

    def __init__(self):
        self.now, self.cycles, self.clock = 0, 0, 1_000_000_000

    def tick(self):
        self.clock += 12_345
        self.now = self.clock
        return self.now

    @contextlib.contextmanager
    def held(self):
        yield self.tick()


class Schedule(Counted):
    """What a module is told of its criticality, and its log."""

    def __init__(self, told, clock):
        self.told, self.true = told, 5
        super().__init__(clock)

    @property
    def crit(self):
        return self.told.now("crit", lambda: self.true, 0)

    @crit.setter
    def crit(self, _):
        pass


class Context(TaskContext):
    """What a module is told of the signals that nobody wants, and its log."""

    true = 0

    @property
    def sigmask(self):
        return self.source.told.now("sigmask", lambda: self.true, 0)

    def _wanted(self, bits):
        return bits & ~self.true  # the slot looks, and nobody is asked


class Task:
    """A task whose cycles are done here, and recorded as the native loop does it."""

    def __init__(self, table, library, task, text):
        self.task, self.time = task, Time()
        rmod = parse_rmod(text, f"{task}.rmod")
        loaded = library.load_rmod(rmod)
        self.info, self.local = loaded.info, local_table(table, task, rmod)
        spec = rtpu_messages.TaskSpec(
            domain="d",
            rtpu="arm0",
            subsystem="arm",
            task=task,
            core=0,
            slot=0,
            table="t",
            layout="",
            rmod=text,
            rmod_name=f"{task}.rmod",
            freq=100.0,
            ring=f"d.arm.{task}",
            libraries=tuple(map(str, library.folders)),
        )
        self.about = journal.about(
            spec, rmod, self.info, library, table, seed=zlib.crc32(task.encode())
        )
        self.ring = Ring.create(spec.ring)
        self.tape = Tape()
        with using(self.tape):
            self.told = ModuleAnswers()
        self.journal = journal.Journal(
            self.local, self.ring, self.about, self.time, self.tape
        )
        self.source = Schedule(self.told, lambda: self.time.now)
        context = self.context = Context(
            task, freq=100.0, source=self.source, seed=self.about.seed
        )
        arrays = {
            port.attr: self.local.array(rmod.svar_name(port.name))
            for port in self.info.ports
        }
        params = decode_params(loaded.cls, rmod.settings, where="")
        instance = bind(loaded.cls, params, arrays, context)
        self.executor = Executor(instance, self.journal)
        self.records, self.seen = [], ()
        self.do(Did("spawn"), self.executor.spawn)

    def do(self, did, call, *args):
        with using(self.tape), self.journal.doing(did):
            call(*args)
        self.records.append(self.ring.take())

    def signal(self, name):
        if name == "on":
            self.seen = ()
        self.do(Did(name), self.executor.signal, name)

    def hand_over(self):
        """Be turned off as an exchange at the dispatcher does it."""
        with self.journal.doing(Did("off", handover=True, cede=True)):
            self.executor.signal("off", handover=True, cede=True)
        self.records.append(self.ring.take())

    def engage(self, *after):
        """Come on in the place of others."""
        self.local.take_over_from(after)
        self.signal("on")
        self.local.take_over_from([])

    def set(self, value):
        did = Did("set", name="gain", arg=value)
        self.do(did, set_param, self.executor, self.info, "gain", value)

    def cycle(self, *, lost=0):
        self.time.clock += PERIOD
        release = self.time.clock
        self.local.copy_in()
        pairs = self.local.consumed
        # Register 0 is the keeper's: what it holds is on nobody's record.
        keeps = tuple(pair for pair in pairs if pair[0] == 0) or ("new",)
        inputs = b""
        if keeps != self.seen:
            inputs, self.seen = pack(self.about.invar, self.local.array), keeps
        self.source.release = release
        with using(self.tape):
            self.executor.instance.cycle(PERIOD * 1e-9)
        self.source.release = None
        self.source.cyclecount += 1
        self.local.commit(release, 1)
        self.time.cycles += 1
        head = np.zeros(1, HEAD_DTYPE)
        head["cycle"], head["dt_ns"], head["lost"] = self.time.cycles, PERIOD, lost
        for name in ("release_ns", "start_ns", "end_ns"):
            head[name] = release
        head["register"], head["number"] = self.local.out_uid, self.local.out_number
        data = pack(self.about.outvar, self.local.array)
        heard = self.tape.take()
        body = head.tobytes() + data + np.array(pairs, np.uint64).tobytes() + inputs
        sizes = [len(body) + len(heard), len(pairs), len(data), len(inputs)]
        sizes[0] += RECORD.size
        self.records.append(RECORD.pack(*sizes, len(heard), 0) + body + heard)


class Shop:
    """Two tasks in a line, X to a to Y0 to b to Y1, and their log."""

    def __init__(self, folder, code=ADDS, text=RMOD):
        self.folder = folder
        self.code = folder / "adds.py"
        self.code.write_text(code)
        self.table = Table.create("t", VARIABLES)
        library = Library([folder])
        self.a = Task(self.table, library, "a", text.format(z="X", y="Y0"))
        self.b = Task(self.table, library, "b", text.format(z="Y0", y="Y1"))
        self.c = None
        """Another one from X to Y0, where a test has one."""
        self.on()

    def on(self):
        self.a.signal("on")
        self.b.signal("on")

    def cycles(self, count):
        for _ in range(count):
            self.a.cycle()
            self.b.cycle()

    def log(
        self,
        *,
        hidden=(),
        without="",
        attached=True,
        files=(),
        slices=1,
        apart=False,
        **more,
    ):
        """Write what there is, in so many chunks, of each task if apart; return it."""
        named = {"run": "r", "job": "j", "subsystem": "arm", "rtpu": "arm0"}
        about = RunAbout(domain="d", **(named | more))
        path = self.folder / "run.mcap"
        writer = LogWriter(path, about)
        written = []
        for task in self.tasks:
            one = task.about
            each = (one.inconst, one.invar, one.outconst, one.outvar)
            names = {variable.name for variables in each for variable in variables}
            task.about.subsystem = about.subsystem
            task.about.hidden = [name for name in hidden if name in names]
            if task.task != without:
                written.append((writer.add_task(task.about), task.records))
        for n in range(slices):
            for number, records in written:
                begin, end = (len(records) * k // slices for k in (n, n + 1))
                writer.add(number, b"".join(records[begin:end]))
                if apart:
                    writer.flush()
            writer.flush()
        for name, content in dict(files).items():
            writer.attach(Attached(name, content))
        if attached:
            writer.attach(Attached(str(self.code), self.code.read_bytes()))
        writer.close()
        return path

    @property
    def tasks(self):
        return [one for one in (self.a, self.b, self.c) if one]

    def close(self):
        for task in self.tasks:
            task.local.close()
            task.ring.destroy()
        self.table.destroy()


def drive(shop):
    """Do what a run may do."""
    shop.cycles(5)
    shop.table.write("X", [0.25, -3.0])
    shop.cycles(5)
    shop.a.set("2.5")
    shop.cycles(5)
    shop.a.signal("off")
    shop.b.cycle()
    shop.a.signal("reinit")
    shop.a.signal("on")
    shop.cycles(5)
    for task in (shop.b, shop.a):
        task.signal("off")
        task.signal("kill")
