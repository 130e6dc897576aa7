"""Special purpose processors: methods, back ends, order, locks, losses, replays."""

from __future__ import annotations

import importlib
import itertools
import math
import os
import re
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from watching import wait_for

from pbonet.errors import SppError
from pbonet.io import no_devices
from pbonet.io.spp import (
    Execution,
    Library,
    Spp,
    SppEntry,
    batches,
    executive_start,
    processors,
    transports,
)
from pbonet.io.spp.channel import Place
from pbonet.outside import Player, Tape, using as recording
from pbonet.pbo import Counted, TaskContext
from pbonet.testing import Bench
from pbonet.xm.ipc import names

KERNELS = Path(__file__).parents[2] / "support" / "spp_kernels.py"
X = np.linspace(-2.0, 2.0, 7)


def gpu(driver):
    return pytest.param(
        driver, "cuda:0", marks=[pytest.mark.gpu, _needs(driver, cuda=True)]
    )


def _needs(package, *, cuda=False):
    """Skip where a back end, or its device, is not there."""
    there = find_spec(package) is not None
    if cuda:
        there = there and Path("/dev/nvidiactl").exists()
    what = f"{package} on CUDA" if cuda else package
    return pytest.mark.skipif(not there, reason=f"{what} is not on this machine")


BACK_ENDS = [
    ("numpy", "cpu"),
    pytest.param("warp", "cpu", marks=_needs("warp")),
    pytest.param("torch", "cpu", marks=_needs("torch")),
    gpu("warp"),
    gpu("torch"),
]


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory):
    """A runtime folder, where Warp keeps compiled kernels, for the whole file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PBONET_RUN_DIR", str(tmp_path_factory.mktemp("run") / "run"))
        yield


@pytest.fixture
def executive():
    """An executive in numpy."""
    with processors.using({"fpa": SppEntry(driver="numpy")}):
        yield
    assert not processors.entries()


@pytest.fixture
def spp(executive):  # noqa: ARG001 - it is used
    made = Spp("fpa", str(KERNELS))
    yield made
    made.finish()


@pytest.mark.parametrize(("driver", "device"), BACK_ENDS)
def test_all_back_ends_compute_the_same(driver, device):
    with processors.using({"fpa": SppEntry(driver=driver, device=device)}):
        spp = Spp("fpa", str(KERNELS))
        assert (spp.back_end, spp.device) == (driver, device)
        x, u, n, update = map(spp.translate, ("x", "u", "n", "update"))
        assert u.value is None
        assert u.age == math.inf
        assert spp.lock()
        spp.write(x, X)
        spp.call(update, 2.0)
        spp.read(u)
        spp.write(x, 2.0 * X)  # the value that was read is that from before
        spp.read(x)
        spp.write(n, 7)
        spp.read(n)
        spp.write(n, 8)  # nor does this change what was read
        assert spp.wait(None)
        np.testing.assert_allclose(u.value, 2.0 * np.tanh(X), rtol=1e-5)
        np.testing.assert_array_equal(x.value, 2.0 * X)
        assert (int(n.value), n.value.shape, u.value.dtype) == (7, (), np.float32)
        assert 0.0 < u.age < 60.0
        spp.release()
        spp.call(update, 1.0)
        spp.read(u)
        assert spp.wait(None)
        np.testing.assert_allclose(u.value, np.tanh(2.0 * X), rtol=1e-5)
        spp.finish()


def test_routines_get_numbers_as_they_are_and_fail_with_file_and_line(spp):
    count = spp.translate("count")
    for whole in (1, 2, 3):
        spp.call(count, whole, True)
    assert spp.wait(None)
    fail, u = map(spp.translate, ("fail", "u"))
    spp.call(fail, 3)
    spp.read(u)
    with pytest.raises(SppError, match="ValueError: not 3") as caught:
        spp.wait(None)
    line = (
        KERNELS.read_text().splitlines().index('    raise ValueError(f"not {number}")')
    )
    assert caught.value.where == f"{KERNELS}:{line + 1}"
    assert u.value is None
    spp.read(u)
    assert spp.wait(None)
    assert u.value is not None


def test_a_full_buffer_refuses_and_counts_and_the_newest_input_is_next(spp):
    nap, x = map(spp.translate, ("nap", "x"))
    spp.call(nap, 0.3)
    assert not spp.wait()
    for value in range(1, 6):
        spp.write(x, np.full(7, float(value)))
        spp.read(x)
        assert not spp.wait()
    assert spp.refused == 4
    assert spp.wait(None)
    assert x.value[0] == 1.0  # the one that waited; then the newest
    spp.write(x, np.full(7, 6.0))
    spp.read(x)
    assert spp.wait(None)
    assert (x.value[0], spp.refused) == (6.0, 4)


@pytest.mark.usefixtures("executive")
def test_clients_are_served_by_priority_then_in_turn():
    first, low, also, high = (
        Spp("fpa", str(KERNELS), priority=rank) for rank in (0, 1, 1, 5)
    )
    first.call(first.translate("nap"), 0.5)
    first.wait()
    for one in (low, also, high):
        one.read(one.translate("u"))
        one.wait()
    stamps = []
    for one in (high, low, also):
        assert one.wait(None)
        stamps.append(one.translate("u").stamp_ns)
    assert stamps == sorted(stamps)
    for one in (first, low, also, high):
        one.finish()


HOLDER = """
import sys, time
from pbonet.io.spp import processors, Spp
from pbonet.io.spp.channel import Executive, Place
executive = Executive(Place(*sys.argv[1:]))
assert executive.lock.p(None)
print("held", flush=True)
time.sleep(600)
"""


def test_a_reserved_processor_runs_no_others_until_the_holder_releases_or_dies(spp):
    other = Spp("fpa", str(KERNELS))
    u = other.translate("u")
    assert spp.lock()
    assert not other.lock()
    other.read(u)
    assert not other.wait(0.2)
    spp.read(spp.translate("u"))
    assert spp.wait(None)  # its own go on
    assert u.value is None
    spp.release()
    assert other.wait(None)
    assert u.value is not None
    home = names.home()
    place = home.domain, home.rtpu, f"fpa.{os.getpid()}"
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, *place], stdout=subprocess.PIPE
    )
    with holder, holder.stdout:
        assert holder.stdout.readline() == b"held\n"
        other.read(u)
        assert not other.wait(0.2)
        holder.kill()
    assert other.wait(None)
    other.finish()


def test_what_cannot_be_is_refused_at_once(spp, tmp_path):
    x, update = map(spp.translate, ("x", "update"))
    with pytest.raises(SppError, match=r"did you mean update\?"):
        spp.translate("updat")
    with pytest.raises(SppError, match="another shape"):
        spp.write(x, X[:3])
    with pytest.raises(SppError, match="another type"):
        spp.write(spp.translate("n"), 0.5)
    with pytest.raises(SppError, match="the batch is too long"):
        any(spp.call(update, 1.0) for _ in range(100_000))
    for text, said in {
        "": "no library of kernels",
        "import nothing_like_it": "ModuleNotFoundError",
        ONLY_WARP: "numpy lacks go",
    }.items():
        (tmp_path / "wrong.py").write_text(text)
        with pytest.raises(SppError, match=said):
            Spp("fpa", str(tmp_path / "wrong.py"))
    with pytest.raises(SppError, match="there is no such library"):
        Spp("fpa", "nowhere.py")
    with pytest.raises(SppError, match=r"\[spp.other\]"):
        Spp("other", str(KERNELS))


ONLY_WARP = """
from pbonet.io.spp import Library
library = Library()
@library.routine("warp")
def go(m): ...
"""


@pytest.mark.parametrize(
    ("name", "more"),
    [("a b", {}), ("local", {}), ("x", {"dtype": "U4"}), ("twice", {})],
)
def test_a_variable_that_cannot_be_is_refused(name, more):
    library = Library()
    library.variable("twice")
    with pytest.raises(SppError, match="cannot be"):
        library.variable(name, 3, **more)


def test_a_back_end_or_device_that_is_not_there_is_refused():
    with pytest.raises(SppError, match="did you mean warp"):
        Library().routine("wrap")
    entry = SppEntry(driver="numpy", device="cuda:0")
    with (
        processors.using({"fpa": entry}),
        pytest.raises(SppError, match="numpy: it computes on the device cpu only"),
    ):
        Spp("fpa", str(KERNELS))


def test_auto_takes_what_the_library_has_and_says_so(tmp_path):
    path = tmp_path / "one.py"
    path.write_text(ONLY_WARP.replace("warp", "numpy"))
    with processors.using({"fpa": SppEntry(device="cpu")}):
        assert Spp("fpa", str(path)).back_end == "numpy"


def use(spp):
    """Use a processor as a module does; return all that it was told."""
    x, u, update, fail = map(spp.translate, ("x", "u", "update", "fail"))
    found = [spp.back_end, spp.lock(), spp.age_of(1) > 0.0]
    for k in range(4):
        spp.write(x, k * X)
        spp.call(update, 1.0)
        got = spp.read(u)
        found += [spp.wait(None), got.value.tolist(), got.stamp_ns, got.age]
    spp.call(fail, 1)
    with pytest.raises(SppError) as caught:
        spp.wait(None)
    spp.release()
    spp.finish()
    return [*found, str(caught.value), spp.starts, spp.refused]


@pytest.mark.usefixtures("executive")
def test_a_replay_has_the_same_answers_and_opens_nothing():
    tape = Tape()
    with recording(tape):
        first = use(Spp("fpa", str(KERNELS)))
    player = Player()
    player.feed(tape.take())
    home = names.home()
    with (
        processors.using({}),
        names.living_on("elsewhere", domain=home.domain),
        no_devices("this is a replay"),
        recording(player),
    ):
        assert use(Spp("fpa", "a_library_that_is_not_there")) == first


def test_in_virtual_time_a_batch_is_done_at_once_by_the_tasks_clock():
    clock = itertools.count(1_000_000_000, 10_000_000)
    task = TaskContext("t", source=Counted(lambda: next(clock)))
    with no_devices("this is a simulation"):
        with pytest.raises(SppError, match=r"task=self\.task"):
            Spp("fpa", str(KERNELS))
        spp = Spp("fpa", str(KERNELS), task=task)
        assert (spp.back_end, spp.device) == ("numpy", "cpu")
        x, u, update = map(spp.translate, ("x", "u", "update"))
        spp.write(x, X)
        spp.call(update, 1.0)
        spp.read(u)
        assert spp.wait()
        assert spp.lock()
    np.testing.assert_allclose(u.value, np.tanh(X), rtol=1e-5)
    assert u.stamp_ns == 1_000_000_000
    assert u.age == pytest.approx(0.01)


def test_a_value_that_is_too_old_raises_the_flag_until_a_newer_one_comes():
    now = [1_000_000_000]
    task = TaskContext("t", source=Counted(lambda: now[0]))
    said = []
    task.on_illegal = lambda _cause, *, up: said.append(up)
    with no_devices("this is a simulation"):
        spp = Spp("fpa", str(KERNELS), task=task, max_age=0.1)
        u = spp.translate("u")
        for seconds, flags in ((0.0, []), (0.05, []), (0.2, [True]), (0.3, [True])):
            now[0] = 1_000_000_000 + round(seconds * 1e9)
            spp.read(u)  # and no batch is handed over
            assert said == flags
        spp.wait()
        spp.read(u)
        assert said == [True, False]


PARENT = """
import sys, time
from pbonet.io.spp import SppEntry, Spp, executive_start, processors
processors.use({"fpa": SppEntry(driver="numpy")}, "")
spp = Spp("fpa", sys.argv[1])
for started in executive_start._started.values():
    print(started.process.pid, flush=True)
spp.call(spp.translate("nap"), 600.0)
spp.wait()
time.sleep(600)
"""


def test_an_executive_ends_with_its_program_also_when_both_are_stopped():
    command = [sys.executable, "-c", PARENT, str(KERNELS)]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE)
    with parent, parent.stdout:
        pid = int(parent.stdout.readline())
        os.kill(pid, signal.SIGSTOP)
        parent.kill()
    wait_for(lambda: not Path(f"/proc/{pid}/exe").exists(), "the executive's end")
    left = Place("default", names.NOWHERE, f"fpa.{parent.pid}")
    wait_for(lambda: not left.is_running(), "its lock to be free")
    assert left.clients()
    with processors.using({"fpa": SppEntry(driver="numpy")}):
        Spp("fpa", str(KERNELS)).finish()  # the next program that has one
    assert left.clients() == []
    assert not left.lock().exists()
    assert [one for one in names.standing("shm", "default") if left.name in one] == []


def test_without_an_executive_nothing_waits_that_need_not(monkeypatch):
    monkeypatch.setattr(transports, "_GONE_NS", 100_000_000)
    with processors.using({"fpa": SppEntry(driver="numpy")}):
        spp = Spp("fpa", str(KERNELS))
        u, die = map(spp.translate, ("u", "die"))
        spp.read(u)
        assert spp.wait(None)
        stamp = u.stamp_ns
        spp.call(die)
        (started,) = executive_start._started.values()
        spp.wait()
        started.process.wait()
        for _ in range(5):
            spp.read(u)
            assert not spp.wait()
        assert spp.refused == 4
        assert u.stamp_ns == stamp
        begin = time.monotonic()
        assert not spp.wait(0.01)
        with pytest.raises(SppError, match="was not started again"):
            spp.wait(None)
        assert time.monotonic() > begin


def test_clients_go_on_with_the_next_executive_of_the_name():
    with processors.using({"fpa": SppEntry(driver="numpy", longest=0.2)}):
        spp, idle = (Spp("fpa", str(KERNELS)) for _ in range(2))
        x, nap = map(spp.translate, ("x", "nap"))
        spp.write(x, X)
        assert spp.wait(None)
        assert spp.starts == 1
        spp.call(nap, 600.0)
        spp.wait()
        (place, started), *_ = executive_start._started.items()
        assert started.wait() == -signal.SIGALRM
        spp.read(x)
        spp.wait()
        config = executive_start.ExecutiveConfig(
            place=place, entry=SppEntry(driver="numpy")
        )
        executive_start.ensure(config)
        assert spp.wait(None)
        assert spp.starts == 2
        assert not x.value.any()  # its variables are zero again
        idle.call(idle.translate("nap"), 0.0)
        assert idle.wait(None)
        # Of a client that has gone nothing stays.
        idle.finish()
        spp.finish()
        assert not place.clients()


@pytest.mark.parametrize("number", [np.float32(0.5), np.bool_(True), np.int16(3)])
def test_numbers_of_numpy_are_passed_as_what_they_are(number):
    batch = batches.Batch(5000, "fpa")
    batch.call(0, (number, 1.0))
    ((_, _, data),) = batches.commands(batch.end(1))
    got, _ = batches.arguments(data)
    assert (type(got), got) == (type(number.item()), number.item())


def test_what_is_no_number_or_no_routine_is_refused_and_nothing_is_carried_out(spp):
    fail, x = map(spp.translate, ("fail", "x"))
    for wrong in (2**70, "text", None):
        with pytest.raises(SppError, match="cannot be passed"):
            spp.call(fail, wrong)
    with pytest.raises(SppError, match="this is no routine"):
        spp.call(x, 1.0)
    with pytest.raises(SppError, match="this is no variable"):
        spp.write(fail, 1.0)
    with pytest.raises(SppError, match="no array"):
        spp.write(x, [[1.0], [1.0, 2.0]])
    assert spp.wait(None)


def test_after_finish_each_use_is_refused(spp):
    u = spp.translate("u")
    spp.finish()
    spp.finish()
    spp.release()
    for use_it in (lambda: spp.read(u), spp.wait, spp.lock):
        with pytest.raises(SppError, match="not in use"):
            use_it()


RAISES = r"""
import sys
from pbonet.io.spp import Library
library = Library()
@library.routine("numpy")
def long(m): raise ValueError("\U0001f600" * 1000)
@library.routine("numpy")
def odd(m): raise ValueError("\udc80")
@library.routine("numpy")
def leave(m): sys.exit(3)
"""


@pytest.mark.usefixtures("executive")
def test_no_error_of_a_library_ends_the_executive(tmp_path):
    path = tmp_path / "raises.py"
    path.write_text(RAISES)
    spp = Spp("fpa", str(path))
    for name in ("long", "odd", "leave"):
        spp.call(spp.translate(name))
        with pytest.raises(SppError, match=f"routine {name} of a library"):
            spp.wait(None)
    many = "for i in range(5000): library.variable(f'variable_{i}')"
    for text, said in {
        "raise ValueError('x' * 100_000)": "xxx",
        "raise ValueError('\\udc80')": "udc80",
        "import sys; sys.exit(3)": "SystemExit",
        f"from pbonet.io.spp import Library; library = Library()\n{many}": "too many",
    }.items():
        path.write_text(text)
        with pytest.raises(SppError, match=said):
            Spp("fpa", str(path))
    spp.call(spp.translate("odd"))
    with pytest.raises(SppError, match="udc80"):
        spp.wait(None)
    assert spp.starts == 1


@pytest.mark.usefixtures("spp")
def test_a_fork_of_the_program_leaves_the_executive_to_it():
    (started,) = executive_start._started.values()
    child = os.fork()
    if not child:
        is_open = Path(f"/proc/self/fd/{started._life}").exists()
        os._exit(bool(executive_start._started) or is_open)
    assert os.waitpid(child, 0)[1] == 0


def test_each_variable_has_a_flag_of_its_own():
    now = [1_000_000_000]
    task = TaskContext("t", source=Counted(lambda: now[0]))
    up = set()
    task.on_illegal = lambda cause, *, up: said(cause, is_up=up)

    def said(cause, *, is_up):
        (up.add if is_up else up.discard)(cause)

    with no_devices("this is a simulation"):
        spp = Spp("fpa", str(KERNELS), task=task, max_age=0.1)
        x, u = map(spp.translate, ("x", "u"))
        for is_rare in (True, False, False, True, True):
            now[0] += 90_000_000
            for one in (x, u) if is_rare else (u,):
                spp.read(one)
            spp.wait()
            if is_rare:
                spp.read(x)
            spp.read(u)
            spp.wait()
    assert not up


@_needs("warp")
def test_a_library_needs_no_kernels_of_warp_and_a_fault_of_one_has_its_line(tmp_path):
    execution = Execution(SppEntry(driver="warp", device="cpu"), "fpa")
    path = tmp_path / "without.py"
    path.write_text(ONLY_WARP)
    assert execution.load(str(path)).back_end.name == "warp"
    path = tmp_path / "wrong.py"
    path.write_text(ONLY_WARP + WRONG_KERNEL)
    line = path.read_text().splitlines().index("    x[0] = wp.nothing_like()") + 1
    with pytest.raises(SppError, match=f"{path}:{line}") as caught:
        execution.load(str(path))
    assert caught.value.where == str(path)


WRONG_KERNEL = """
import warp as wp
@wp.kernel
def wrong(x: wp.array(dtype=wp.float32)):
    x[0] = wp.nothing_like()
"""


PAGE = Path(__file__).parents[3] / "docs" / "spp.md"


def test_the_page_runs_as_it_stands(tmp_path, monkeypatch):
    kernels, module, *_ = re.findall(
        r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL
    )
    (tmp_path / "squash_kernels.py").write_text(kernels)
    (tmp_path / "squash.py").write_text(module)
    monkeypatch.syspath_prepend(str(tmp_path))
    squash = importlib.import_module("squash").Squash
    with (
        processors.using({"gpu0": SppEntry(driver="numpy")}),
        Bench(squash, library=[tmp_path], q=X) as bench,
    ):
        bench.on()

        def commanded():
            bench.step()
            return bench["U_REF"].any()

        wait_for(commanded, "a result")
        np.testing.assert_allclose(bench["U_REF"], 2.0 * np.tanh(X), rtol=1e-5)
        assert not bench.illegal
