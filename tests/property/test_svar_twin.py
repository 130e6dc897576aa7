"""The native table and its twin in plain Python, driven in step.

Two tables of the same variables, one of each kind. After every step both have given the
same answers, hold the same values, and their files are equal byte for byte but for the
lock and the times at which causes were raised.
"""

import os
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import plain_table
import pytest
from hypothesis import HealthCheck, assume, settings, strategies as st
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    invariant,
    rule,
    run_state_machine_as_test,
)

from pbonet.config.model import Limit, Variable
from pbonet.svar import _svar, guards, layout

VARIABLES = (
    Variable(name="A", type="double", nelem=3, init=(1.0, 2.0)),
    Variable(name="B", type="float", nelem=5, maxage=3600.0),
    Variable(
        name="C", type="int8", nelem=3, min=(-5,) * 3, max=(5,) * 3, limit=Limit.CLIP
    ),
    Variable(name="D", type="double", min=(-1.0,), max=(1.0,), limit=Limit.ERROR),
    Variable(name="E", type="struct[24]", nelem=2),
    Variable(name="F", type="double", nelem=2, finite=False),
)
N = len(VARIABLES)
NAMED = st.sets(st.integers(0, N - 1))
REGS, DIR = 88, 96  # places in the header
CAUSE = st.sampled_from([b"dead", b"stale"])
RAISER = st.sampled_from([b"one", b"two"])
VALUE = st.sampled_from([0.0, 1.0, -0.5, 3.0, -128.0, 100.0, np.nan, np.inf])


def make(native, folder: Path):
    """Return an arena of one kind and its file."""
    plan = native.Blueprint(
        np.array([layout.var_bytes(v) for v in VARIABLES], np.uint64),
        np.array([round((v.maxage or 0) * 1e9) for v in VARIABLES], np.int64),
        layout.encode(VARIABLES),
        layout.layout_hash(VARIABLES),
        1,
    )
    path = folder / native.__name__.rpartition(".")[2]
    fd = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    os.ftruncate(fd, plan.size)
    arena = native.Arena(fd, plan.size, b"here")
    assert arena.format(plan, layout.initial_values(VARIABLES)) == 0
    assert arena.verify() == 0
    return arena, path


TASKS = [b"task", b"other", b"n" * 70]


class Side:
    """A local table of one kind, as the other half of pbonet.svar.local makes it."""

    def __init__(
        self, native, arena, ins, outs, *, consts=(), keep=False, name=b"task"
    ) -> None:
        self.groups = [layout.group_of(VARIABLES, s) for s in (outs, consts)]
        places, at = {}, 0
        for group in self.groups:
            places |= {i: at + x for i, x in zip(group.indices, group.at, strict=True)}
            at += layout.padded(group.bytes, 64)
        for i in ins - places.keys():
            places[i] = at
            at += layout.var_bytes(VARIABLES[i])
        self.data = np.zeros(max(at, 8), np.uint8)
        staging = np.zeros(max(at, 8), np.uint8) if keep else None
        self.local = native.LocalTable(arena, self.data, staging, N)
        for which, wanted in ((0, ins), (1, ins), (2, ins | outs)):
            chosen = sorted(wanted)
            self.local.set_plan(
                which,
                np.array(chosen, np.uint32),
                np.array([places[i] for i in chosen], np.uint64),
            )
        self.regs = [0, 0]
        self.codes = []
        for which, group in enumerate(self.groups):
            self.local.set_group(
                which,
                np.array(group.indices, np.uint32),
                np.array(group.at, np.uint64),
                places[group.indices[0]] if group.indices else 0,
                group.bytes,
                guards.checks_of(VARIABLES, group),
            )
            if group.indices:
                code = self.local.enter(which, 0, os.getpid(), name)
                self.codes.append(code)
                self.regs[which] = max(code, 0)
        self.places = places

    def put(self, index: int, values: list[float]) -> None:
        variable = VARIABLES[index]
        dtype = np.dtype(variable.dtype)
        at = self.places[index]
        view = self.data[at : at + variable.nelem * dtype.itemsize]
        if dtype.kind == "V":
            view[:] = int(values[0]) % 251 if np.isfinite(values[0]) else 7
        else:
            number = np.resize(np.array(values), variable.nelem)
            if dtype.kind == "i":
                number = np.nan_to_num(number, posinf=9, neginf=-9)
            view.view(dtype)[:] = number

    def state(self):
        return (
            self.codes,
            self.data.tobytes(),
            self.local.flags,
            self.local.counts,
            sorted(self.local.pairs),
            [self.local.owns(which) for which in (0, 1)],
        )


class InStep(RuleBasedStateMachine):
    tasks = Bundle("locals")

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory(dir="/dev/shm")
        self.arenas, self.paths = zip(
            *(make(native, Path(self.folder.name)) for native in (_svar, plain_table)),
            strict=True,
        )
        self.all: list[list[Side]] = []
        self.now = 1000

    def teardown(self) -> None:
        self.folder.cleanup()

    def both(self, do, sides) -> object:
        answers = [do(side) for side in sides]
        assert answers[0] == answers[1]
        return answers[0]

    @rule(target=tasks, ins=NAMED, outs=NAMED, consts=NAMED, keep=st.booleans())
    def task(self, ins, outs, consts, keep):
        assume(len(self.all) < 12)
        consts -= outs
        name = TASKS[len(self.all) % len(TASKS)]
        sides = [
            Side(native, arena, ins, outs, consts=consts, keep=keep, name=name)
            for native, arena in zip((_svar, plain_table), self.arenas, strict=True)
        ]
        self.all.append(sides)
        return sides

    @rule(sides=tasks, data=st.data())
    def fill(self, sides, data):
        places = sorted(sides[0].places)
        assume(places)
        index = data.draw(st.sampled_from(places))
        values = data.draw(st.lists(VALUE, min_size=1, max_size=5))
        for side in sides:
            side.put(index, values)

    @rule(sides=tasks, which=st.sampled_from([0, 1]))
    def take(self, sides, which):
        assume(not sides[0].groups[which].indices or sides[0].regs[which])
        self.now += 1
        self.both(lambda side: side.local.ask(which), sides)
        self.both(lambda side: side.local.take(which, self.now, 5), sides)

    @rule(
        sides=tasks,
        which=st.sampled_from([0, 1]),
        names=st.sets(st.sampled_from(TASKS)),
    )
    def succeed(self, sides, which, names):
        self.both(lambda side: side.local.succeed(which, sorted(names)), sides)

    @rule(sides=tasks, which=st.sampled_from([0, 1]))
    def note_ends(self, sides, which):
        self.both(lambda side: side.local.note_ends(which), sides)

    @rule(sides=tasks)
    def cede(self, sides):
        self.both(lambda side: side.local.cede(), sides)

    @rule(sides=tasks, which=st.sampled_from([0, 1]), leave=st.booleans())
    def give(self, sides, which, leave):
        assume(sides[0].regs[which])
        self.both(lambda side: side.local.give(which, leave), sides)
        if leave:
            for side in sides:
                side.regs[which] = 0

    @rule(sides=tasks)
    def commit(self, sides):
        assume(sides[0].regs[0] or not sides[0].groups[0].indices)
        self.now += 1
        self.both(lambda side: side.local.commit(self.now, self.now), sides)
        self.both(lambda side: side.local.fault, sides)

    @rule(sides=tasks, which=st.sampled_from([0, 1]), data=st.data())
    def write_one(self, sides, which, data):
        n = len(sides[0].groups[which].indices)
        assume(n and sides[0].regs[which])
        i = data.draw(st.integers(0, n - 1))
        self.now += 1
        self.both(lambda side: side.local.write_one(which, i, self.now, 1), sides)

    @rule(sides=tasks, how=st.sampled_from(["copy_in", "copy_in_on", "copy_in_consts"]))
    def copy(self, sides, how):
        self.both(lambda side: getattr(side.local, how)(), sides)

    @rule(sides=tasks, data=st.data())
    def read_one(self, sides, data):
        places = sorted(sides[0].places)
        assume(places)
        index = data.draw(st.sampled_from(places))
        self.both(lambda side: side.local.read_one(index, side.places[index]), sides)

    @rule(index=st.integers(0, N - 1), byte=st.integers(0, 255))
    def operator(self, index, byte):
        self.now += 1
        value = np.full(layout.var_bytes(VARIABLES[index]), byte, np.uint8)
        self.both(lambda arena: arena.set(index, value, self.now), self.arenas)

    @rule(cause=CAUSE, raiser=RAISER)
    def raise_cause(self, cause, raiser):
        self.both(
            lambda arena: arena.raise_illegal(cause, raiser, b"here"), self.arenas
        )

    @rule(cause=st.just(b"") | CAUSE, raiser=RAISER)
    def clear_cause(self, cause, raiser):
        self.both(
            lambda arena: arena.clear_illegal(cause, raiser, b"here"), self.arenas
        )

    @invariant()
    def everything_shown_is_equal(self):
        for sides in self.all:
            self.both(Side.state, sides)
        self.both(lambda arena: arena.registers(), self.arenas)
        self.both(lambda arena: [cause[:3] for cause in arena.causes()], self.arenas)
        for index, variable in enumerate(VARIABLES):
            room = [np.zeros(layout.var_bytes(variable), np.uint8) for _ in range(2)]
            looks = zip(self.arenas, room, strict=True)
            self.both(lambda pair, v=index: pair[0].look(v, pair[1]), list(looks))
            self.both(lambda arena, v=index: arena.written(v), self.arenas)
            assert (room[0] == room[1]).all()

    @invariant()
    def files_are_equal(self):
        native, twin = (path.read_bytes() for path in self.paths)
        regs = struct.unpack_from("<Q", native, REGS)[0]
        assert native[regs:] == twin[regs:], "registers, directory and arena"
        live = struct.unpack_from("<Q", native, 80)[0]
        assert native[:live] == twin[:live], "the static part"
        assert native[live : live + 24] == twin[live : live + 24], "generation, flag"


def test_native_and_twin_stay_in_step():
    run_state_machine_as_test(
        InStep,
        settings=settings(
            max_examples=150,
            stateful_step_count=40,
            deadline=None,
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
        ),
    )


@pytest.mark.parametrize("first", [_svar, plain_table])
def test_each_reads_what_the_other_made(first, tmp_path):
    """One file, mapped by both at once."""
    second = plain_table if first is _svar else _svar
    arena, path = make(first, tmp_path)
    fd = os.open(path, os.O_RDWR)
    other = second.Arena(fd, path.stat().st_size, b"there")
    assert other.verify() == 0
    assert other.text == arena.text
    writer = Side(first, arena, set(), {0, 1})
    reader = Side(second, other, {0, 1, 5}, set())
    for value in range(1, 20):
        writer.put(0, [value])
        if value == 1:
            assert writer.local.take(0, value, value) == (0, 0)
        else:
            assert writer.local.commit(value, value) == 0
        reader.local.copy_in()
        at = reader.places[0]
        assert reader.data[at : at + 24].view(np.float64).tolist() == [value] * 3
    assert other.look(0, np.zeros(24, np.uint8)) == arena.look(
        0, np.zeros(24, np.uint8)
    )


def test_the_twin_passes_the_unit_tests_of_the_native_one():
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-m", "pytest", "-v", "-x", "-p", "no:cacheprovider"]
    tests = [
        str(root / "tests" / "unit" / "svar" / f"test_svar_{n}.py")
        for n in ("flag", "guards", "local", "single", "table")
    ]
    done = subprocess.run(
        [*command, "-p", "use_plain_table", *tests],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root / "tests" / "oracles")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    assert "table: plain_table.arena" in done.stdout
