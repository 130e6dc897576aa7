"""A job on two RTPUs: tasks of different RTPUs are created at once."""

from __future__ import annotations

import contextlib
import os
import textwrap
import threading

import pytest
from watching import wait_for

from pbonet.errors import PbonetError, StateError
from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.xm.net import messages as m

RTPUS = ("arm0", "arm1")
SBS = "SUBSYSTEM pair\nSVARFILE pair.svar\nRTPU arm0\nRTPU arm1\nEOF\n"
JOB = "JOB both\nDESC both\nSBS pair.sbs\nTASK left arm0\nTASK right arm1\nEOF\n"
SVAR = "".join(
    f"NAME {name}\nTYPE double\nDESC written\nUNITS none\nNELEM 1\n\n"
    for name in ("LEFT", "RIGHT")
)
RMOD = """
MODULE {0}
DESC meets the other one
INCONST none
OUTCONST none
INVAR none
OUTVAR {1}
TASKTYPE periodic
FREQ 10
EOF
"""
MEETS = """
    import os
    from typing import Annotated as A
    from pbonet import OutVar, Params, PortBasedObject

    class {0}(PortBasedObject[Params]):
        '''Waits in `init` for the other end of a pipe.'''

        out: A[float, OutVar("{1}", "1", "none", "a number")]

        def init(self) -> None:
            {2}

        def cycle(self, dt: float) -> None:
            self.out = 1.0
"""
READS = 'os.close(os.open("{}", os.O_RDONLY))'
WRITES = 'os.close(os.open("{}", os.O_WRONLY))'
HELD = 'os.read(os.open("{}", os.O_RDONLY), 1)'


class Pair:
    """Two tasks, ``left`` and ``right``, on an RTPU each, and their `init`."""

    def __init__(self, nodes, folder, left, right):
        nodes.agent_processes(*RTPUS)
        folder.mkdir()
        (folder / "pair.sbs").write_text(SBS)
        (folder / "pair.svar").write_text(SVAR + "EOF\n")
        (folder / "both.job").write_text(JOB)
        self._module(nodes, "left", left)
        self._module(nodes, "right", right)
        self.subsystem = Subsystem(
            folder / "both.job",
            domain=nodes.domain,
            libraries=[nodes.library],
            record="off",
            warned=lambda _: None,
        ).open()

    @staticmethod
    def _module(nodes, name, init):
        text = MEETS.format(name.title(), name.upper(), init)
        (nodes.library / f"{name}.py").write_text(textwrap.dedent(text))
        (nodes.library / f"{name}.rmod").write_text(RMOD.format(name, name.upper()))

    def started(self):
        """Begin to start in a thread; return it, and what it raises."""
        failed = []

        def start():
            try:
                self.subsystem.start()
            except PbonetError as error:
                failed.append(error)

        thread = threading.Thread(target=start)
        thread.start()
        return thread, failed

    def tasks(self, rtpu):
        """Return the tasks on an RTPU."""
        status = self.subsystem.clients.call(rtpu, m.Status(), m.RtpuStatus)
        return [task.task for task in status.tasks]


def opened(pipe):
    """Open a pipe when its reader waits; return the descriptor."""
    found = []

    def there():
        with contextlib.suppress(OSError):
            found.append(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK))
        return found

    wait_for(there, "who reads the pipe")
    return found[0]


@pytest.fixture
def pipes(tmp_path):
    found = [tmp_path / "first", tmp_path / "second"]
    for pipe in found:
        os.mkfifo(pipe)
    return found


@pytest.fixture
def made(nodes, tmp_path):
    pairs = []

    def make(left, right):
        pairs.append(Pair(nodes, tmp_path / "pair", left, right))
        return pairs[-1]

    yield make
    for pair in pairs:
        if pair.subsystem.is_open:
            pair.subsystem.detach()


def test_each_init_may_wait_for_the_other(made, pipes):
    pair = made(READS.format(pipes[0]), WRITES.format(pipes[0]))
    found = {one.task: one.state for one in pair.subsystem.start()}
    assert found == {"left": "ON", "right": "ON"}


def test_one_that_fails_undoes_the_other(made, pipes):
    fails = f"{WRITES.format(pipes[0])}; raise ValueError('too hot')"
    pair = made(READS.format(pipes[0]), fails)
    with pytest.raises(PbonetError, match="too hot"):
        pair.subsystem.start()
    assert pair.tasks("arm0") == pair.tasks("arm1") == []


def test_a_stop_meanwhile_leaves_none_of_them(made, pipes):
    pair = made(*map(HELD.format, pipes))
    thread, failed = pair.started()
    ends = [opened(pipe) for pipe in pipes]  # both are in `init`
    pair.subsystem.stopped.set()  # as an interrupt of `run` does
    for end in ends:
        os.close(end)
    thread.join()
    assert [type(error) for error in failed] == [StateError]
    assert "abandoned because of a stop" in str(failed[0])
    assert pair.tasks("arm0") == pair.tasks("arm1") == []


def test_the_death_of_an_agent_meanwhile_leaves_no_task_elsewhere(made, nodes, pipes):
    pair = made(*map(HELD.format, pipes))
    thread, failed = pair.started()
    ends = [opened(pipe) for pipe in pipes]
    nodes.processes["arm1"].kill()
    nodes.processes["arm1"].wait()
    for end in ends:
        os.close(end)
    thread.join()
    assert len(failed) == 1
    assert "arm1" in str(failed[0])
    assert pair.tasks("arm0") == []
