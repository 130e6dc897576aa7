"""A master is killed amid a switch: as it spawns, changes constants, or kills."""

from __future__ import annotations

import contextlib
import subprocess
import sys

import pytest
import tool_constants
from watching import causes, states, wait_for

from pbonet.errors import ClaimError
from pbonet.master.subsystem.subsystem import Subsystem

MASTER = """
import sys
from pbonet.master.subsystem import Subsystem
folder, domain, first, second, *libraries = sys.argv[1:]
arm = Subsystem(folder, domain=domain, libraries=libraries, record="off").open()
arm.start(first)
arm.switch(second)
print("the switch was not interrupted")
"""
WAITS = """
    import time
    from pathlib import Path

    from pbonet import Params, PortBasedObject

    class Lingers(PortBasedObject[Params]):
        '''Waits in a method until it may go on.'''

        def {method}(self) -> None:
            Path({begun!r}).touch()
            while not Path({go_on!r}).exists():
                time.sleep(0.005)

        def cycle(self, dt: float) -> None:
            pass
"""
STAY = {"grip": "ON", "weigh": "ON", "hold": "ON"}


@pytest.fixture
def files(nodes, tmp_path):
    """The folder of the tools; job `more` is `grip` with a task `lingers` beside it."""
    folder = tmp_path / "tools"
    tool_constants.write(folder, nodes.library)
    tool_constants.rmod(folder, "lingers", "lingers")
    job = (folder / "grip.job").read_text()
    more = job.replace("JOB grip", "JOB more").replace("EOF", "TASK lingers\nEOF")
    (folder / "more.job").write_text(more)
    return folder


@pytest.fixture
def gate(tmp_path):
    """Files: a method has begun; it may go on."""
    return tmp_path / "begun", tmp_path / "go_on"


@pytest.fixture
def killed(nodes, files, gate):
    """Return a function that kills a master amid its switch from one job to another."""
    opened: list[Subsystem] = []

    def kill(first, second):
        nodes.agent_process("arm0")
        words = [str(files / "tools.sbs"), nodes.domain, first, second]
        master = subprocess.Popen([
            sys.executable,
            "-c",
            MASTER,
            *words,
            str(nodes.library),
        ])
        begun, go_on = gate
        try:
            wait_for(begun.exists, "the method that waits")
        finally:
            master.kill()
            master.wait()
        go_on.touch()
        arm = Subsystem(
            files / "tools.sbs",
            domain=nodes.domain,
            libraries=[nodes.library],
            warned=lambda _text: None,
            record="off",
        )

        def opens():
            with contextlib.suppress(ClaimError):  # its agent has not seen the loss yet
                arm.open()
                return True
            return False

        wait_for(opens, "the end of the killed master's claim")
        opened.append(arm)
        return arm

    yield kill
    for arm in opened:
        arm.finish()


def test_between_the_change_of_constants_and_the_exchange(nodes, gate, killed):
    begun, go_on = map(str, gate)
    weigh = tool_constants.WEIGH.replace(
        "self.weight = 10.0 * self.mass",
        "self.weight = 10.0 * self.mass\n"
        '            if self.task.state == "ON":\n'
        f"                Path({begun!r}).touch()\n"
        f"                while not Path({go_on!r}).exists():\n"
        "                    time.sleep(0.005)",
    ).replace(
        "    from typing",
        "    import time\n    from pathlib import Path\n    from typing",
        1,
    )
    nodes.write_module("weigh", weigh)
    arm = killed("grip", "drill")
    everybody = {"grip": "ON", "drill": "OFF", "weigh": "ON", "hold": "ON"}
    assert states(arm) == everybody
    assert arm.display(["MASS"])[0].writer == "drill"
    said = "drill gives the constants of grip, which is still ON"
    wait_for(lambda: any(said in cause for cause in causes(arm)), "the flag")
    assert any(said in e.text for e in arm.events() if e.code == "ILLEGAL")
    arm.switch("drill")
    assert states(arm) == {"drill": "ON", "weigh": "ON", "hold": "ON"}
    wait_for(lambda: arm.display(["F"])[0].values == [30.0], "the new torque")
    wait_for(lambda: not causes(arm), "a legal configuration")


def waits_in(nodes, gate, method):
    begun, go_on = map(str, gate)
    text = WAITS.format(method=method, begun=begun, go_on=go_on)
    nodes.write_module("lingers", text)


def test_while_it_spawns(nodes, gate, killed):
    waits_in(nodes, gate, "init")
    arm = killed("grip", "more")
    wait_for(lambda: states(arm).get("lingers") == "OFF", "the end of init")
    assert states(arm) == {**STAY, "lingers": "OFF"}
    assert causes(arm) == []
    arm.switch("more")
    assert states(arm) == {**STAY, "lingers": "ON"}


def test_while_it_kills(nodes, gate, killed):
    waits_in(nodes, gate, "kill")
    arm = killed("more", "grip")
    wait_for(lambda: "lingers" not in states(arm), "the end of the task")
    assert states(arm) == STAY
    assert causes(arm) == []
    arm.switch("grip")
    assert states(arm) == STAY
