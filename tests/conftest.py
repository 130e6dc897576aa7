"""Isolation for every test, and a kit of real agents for those that want them.

Each test has a shared-memory folder of its own, and none may leave anything in it, nor
a process that was started within it. What checks that is not asked for by name: it is
there for all tests.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import tempfile
from pathlib import Path

import mounting
import pytest
from hypothesis import settings
from watching import clean_folder

settings.register_profile("pbonet", deadline=None)  # no test asserts how long it takes
settings.load_profile("pbonet")

SHM = Path("/dev/shm")  # noqa: S108 - where shared memory is


def pytest_pyfunc_call(pyfuncitem):
    """Run a test that mounts where it may."""
    if pyfuncitem.get_closest_marker("mounts") and mounting.refused():
        mounting.run_elsewhere(pyfuncitem)
        return True
    return None


@pytest.fixture(autouse=True)
def shared_memory(monkeypatch):
    """A shared-memory folder for this test alone, which must be empty behind it."""
    base = SHM if os.access(SHM, os.W_OK) else Path(tempfile.gettempdir())
    folder = base / f"pbonet-test-{secrets.token_hex(4)}"
    folder.mkdir(mode=0o700)
    before = folder.stat().st_mtime_ns
    monkeypatch.setenv("PBONET_SHM_DIR", str(folder))
    yield folder
    if folder.stat().st_mtime_ns == before:
        folder.rmdir()
    else:
        clean_folder(folder, "PBONET_SHM_DIR")


@pytest.fixture(autouse=True)
def own_priority():
    """A real-time priority that a test gives its own process ends with it."""
    yield
    if os.sched_getscheduler(0) != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@pytest.fixture(autouse=True)
def runs(monkeypatch, tmp_path):
    """The folder in which this test's runs are recorded."""
    folder = tmp_path / "runs"
    monkeypatch.setenv("PBONET_RUNS", str(folder))
    return folder


@pytest.fixture(autouse=True)
def state_dir(monkeypatch, tmp_path):
    """The folder for what outlives a restart of this test's machine."""
    folder = tmp_path / "state"
    monkeypatch.setenv("PBONET_STATE_DIR", str(folder))
    return folder


@pytest.fixture
def run_dir(monkeypatch):
    """A runtime folder with a short path, for sockets have little room."""
    folder = Path(tempfile.mkdtemp(prefix="pbonet-", dir="/tmp"))
    monkeypatch.setenv("PBONET_RUN_DIR", str(folder))
    yield folder
    shutil.rmtree(folder)


@pytest.fixture
def call(capsys):
    """Run a command line in this process; return status, output, errors."""

    from pbonet.cli import main

    def run(*argv):
        with pytest.raises(SystemExit) as caught:
            main([str(word) for word in argv])
        told = capsys.readouterr()
        return caught.value.code or 0, told.out, told.err

    return run


@pytest.fixture
def nodes(request, monkeypatch, tmp_path):
    """Real agents in a domain of their own; see `nodekit.Nodes`."""
    from long_limits import be_patient
    from nodekit import Nodes

    if request.node.get_closest_marker("own_limits") is None:
        be_patient(monkeypatch)

    folder = Path(tempfile.mkdtemp(prefix="pbonet-", dir="/tmp"))
    monkeypatch.setenv("PBONET_RUN_DIR", str(folder))
    kit = Nodes(folder, tmp_path)
    try:
        yield kit
    finally:
        try:
            kit.close()
        finally:
            kit.check_folder()


@pytest.fixture
def briefly(monkeypatch):
    """Wait for tasks that hang no longer than needed, within a `with` block."""
    from pbonet.master.subsystem import subsystem_tasks

    @contextlib.contextmanager
    def wait():
        with monkeypatch.context() as short:
            short.setattr(subsystem_tasks, "CONTROL_TIME", 1.0)
            yield

    return wait


@pytest.fixture
def arm(nodes):
    """One agent, arm0, claimed by subsystem arm, its table open."""
    nodes.agent("arm0")
    return nodes.master("arm0", "arm")


@pytest.fixture
def puma(tmp_path):
    """A copy of the PUMA example's files, to be changed at will."""
    example = Path(__file__).parents[1] / "examples" / "puma"
    for name in ("puma.sbs", "puma.svar", "puma.job"):
        shutil.copy(example / name, tmp_path / name)
    return tmp_path / "puma.sbs"
