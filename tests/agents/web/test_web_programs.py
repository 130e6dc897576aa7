"""Programs of jobs that run by ``pbonet web``, as clients of the socket find them."""

from __future__ import annotations

import json

import pytest
from test_web_server import Server, answer, say, wait

from pbonet.master.configuration import Place
from pbonet.master.subsystem import Subsystem
from pbonet.master.subsystem.sequencer import ENDED

TICK = """
    from typing import Annotated as A
    from pbonet import OutVar, Params, PortBasedObject, param

    class Of(Params):
        end: A[int, param("none", "the highest count", ge=1)] = 1_000_000

    class Tick(PortBasedObject[Of]):
        '''Counts its cycles.'''

        count: A[float, OutVar("COUNT", "1", "none", "cycles since on")]

        def on(self) -> None:
            self.count = 0.0

        def cycle(self, dt: float) -> None:
            self.count = min(self.count + 1, self.params.end)
"""
RMOD = (
    "MODULE tick\nDESC a test\nINCONST none\nOUTCONST none\nINVAR none\n"
    "OUTVAR COUNT\nTASKTYPE periodic\nFREQ 100\nEOF\n"
)
SEQ = """SEQUENCE p
DESC
SBS c.sbs
SAFE rest
STEP work UNTIL (COUNT > 5) WITHIN 60
SET work_tick end 20
STEP more FOR 600
EOF
"""


@pytest.fixture
def server(nodes, tmp_path):
    """The page's server of a subsystem with three jobs of one task each."""
    nodes.write_module("tick", TICK)
    files = {
        "c.svar": "NAME COUNT\nTYPE double\nDESC cycles\nUNITS none\nNELEM 1\n\nEOF\n",
        "c.sbs": "SUBSYSTEM counts\nSVARFILE c.svar\nRTPU arm0\nEOF\n",
        "p.seq": SEQ,
    }
    for name in ("rest", "work", "more"):
        files[f"{name}.job"] = (
            f"JOB {name}\nDESC\nSBS c.sbs\nTASK {name}_tick arm0\nEOF\n"
        )
        files[f"{name}_tick.rmod"] = RMOD
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    nodes.agent("arm0")
    place = Place(domain=nodes.domain, libraries=(str(nodes.library),))
    server = Server(tmp_path / "c.sbs", place, "--library", str(nodes.library))
    yield server
    if server.process.poll() is None:
        assert server.end() == 0
    with Subsystem(
        tmp_path / "c.sbs", domain=nodes.domain, record="off", warned=lambda _: None
    ) as subsystem:
        subsystem.stop()


def program(page, name, number=7, **args):
    """Ask for something to be done with a program; return the answer."""
    say(page, do="program", id=number, program=name, args={"name": "p"} | args)
    return wait(page, "answer", lambda one: one["id"] == number)


def wait_state(server, cookie, **wanted):
    """Return the first state of the program that says all of this, before its end.

    A new browser is told it at once, so that no state is missed.
    """

    def said(state):
        return {key: state[key] for key in wanted} == wanted

    def good(message):
        state = message["state"]
        return said(state) or state["phase"] in ENDED

    with server.connect(cookie) as browser:
        state = wait(browser, "program", good)["state"]
    assert said(state), json.dumps(state)
    return state


def wait_on(server, cookie, task):
    """Wait until a task alone is ON."""
    states = {}

    def alone(message):
        states.update({one["task"]: one["state"] for one in message["tasks"]})
        states.update(dict.fromkeys(message["gone"]))
        return [name for name, state in states.items() if state == "ON"] == [task]

    with server.connect(cookie) as browser:
        wait(browser, "status", alone)


def test_a_program_is_run_paused_stepped_and_aborted_while_commands_are_given(server):
    cookie, looks = server.cookie("operator"), server.cookie("observer")
    with (
        server.connect(cookie, max_queue=None) as page,
        server.connect(looks, max_queue=None) as looker,
    ):
        for what in ("pause", "resume", "step", "abort"):
            assert program(page, what)["text"] == "no program runs; run one first"
        assert program(page, "run", paused=True)["ok"]
        assert wait_state(server, looks, phase="paused", pausing=True)["line"] == 0
        again = program(page, "run")
        assert again["text"] == "a program runs already (got p); abort it first"
        assert not program(looker, "abort")["ok"]
        assert program(page, "step")["ok"]
        assert wait_state(server, looks, phase="paused", line=1)["entered"] == ["work"]
        wait_on(server, looks, "work_tick")
        told = answer(page, "set work_tick end 7")  # by this master, to itself
        assert told["ok"], told["text"]
        assert " 7 " in f"{answer(page, 'get work_tick end')['text']} "
        refused = answer(page, "on work_tick")
        assert "signal on is not valid in state ON" in refused["text"]
        assert program(page, "resume")["ok"]
        waits = wait_state(server, looks, phase="waits", step="more")
        assert (waits["waiting"], waits["pausing"]) == ("600 s", False)
        assert program(page, "abort")["ok"]
        wait_on(server, looks, "rest_tick")
        state = wait_state(server, looks, phase="aborted")
        assert (state["text"], state["safe"], state["errors"]) == ("aborted", True, [])
        assert state["entered"] == ["work", "more", "rest"]
        assert program(page, "run")["ok"]  # another run, of the tasks that are there
        wait_state(server, looks, phase="waits", step="more")
        say(page, do="stop", id=9)
        assert wait(page, "answer", lambda one: one["id"] == 9)["ok"]
        state = wait_state(server, looks, phase="stopped")
        assert state["text"] == "stopped from elsewhere"


def test_a_server_that_ends_leads_its_program_to_the_safe_job(server, nodes, tmp_path):
    cookie = server.cookie("operator")
    with server.connect(cookie) as page:
        assert program(page, "run")["ok"]
    wait_state(server, cookie, phase="waits", step="more")
    assert server.end() == 0
    with Subsystem(
        tmp_path / "c.sbs", domain=nodes.domain, record="off", warned=lambda _: None
    ) as subsystem:
        states = {one.task: one.state for one in subsystem.status_all()}
        subsystem.detach()
    assert [name for name, state in states.items() if state == "ON"] == ["rest_tick"]


def test_a_program_that_cannot_be_run_is_refused(server, tmp_path):
    (tmp_path / "p.seq").write_text(SEQ.replace("more", "nosuch"))
    with server.connect(server.cookie("operator")) as page:
        refused = program(page, "run")
        assert not refused["ok"]
        assert "there is no job nosuch" in refused["text"]
        assert program(page, "abort")["text"] == "no program runs; run one first"
