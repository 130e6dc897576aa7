"""The page of 200 tasks and 500 variables that exist for the server alone."""

from __future__ import annotations

import socket
import threading
import time

import pytest
import uvicorn
from page_kit import chromium, keep_picture, opened
from watching import wait_for

from pbonet.master.web.access import Access, Role
from pbonet.master.web.application import Page
from pbonet.master.web.recorded_questions import RecordedQuestions
from pbonet.master.web.source import Source

TASKS, VARIABLES, RTPUS = 200, 500, 8
HZ = 20.0


def port(variable):
    return {
        "port": variable,
        "variable": variable,
        "constant": False,
        "unit": "rad",
        "shape": [2],
        "type": "double",
    }


def made_graph():
    """Return a graph in which every task writes some variables and reads others."""
    names = [f"V{k}" for k in range(VARIABLES)]
    writer = {name: k % TASKS for k, name in enumerate(names)}
    readers = {
        name: sorted({(writer[name] + 1) % TASKS, (writer[name] + 1 + k % 9) % TASKS})
        for k, name in enumerate(names)
    }
    tasks = [
        {
            "name": f"task{k}",
            "module": f"module{k % 20}",
            "class": "controller",
            "desc": f"task number {k}",
            "rtpu": f"arm{k * RTPUS // TASKS}",
            "freq": 100.0,
            "type": "periodic",
            "crit": "",
            "fallback_of": "",
            "parts": [],
            "devices": [],
            "ins": [port(name) for name in names if k in readers[name]],
            "outs": [port(name) for name in names if writer[name] == k],
            "params": [],
            "rmod_file": "",
        }
        for k in range(TASKS)
    ]
    return {
        "name": "large",
        "job": "large",
        "rtpus": [
            {"name": f"arm{k}", "scheduler": "MUF", "keeper": k == 0}
            for k in range(RTPUS)
        ],
        "tasks": tasks,
        "variables": [
            {
                "name": name,
                "desc": f"variable {name}",
                "unit": "rad",
                "type": "double",
                "shape": [2],
                "n": 2,
                "constant": False,
                "writers": [f"task{writer[name]}"],
                "readers": [f"task{k}" for k in readers[name]],
            }
            for name in names
        ],
        "wires": [
            {
                "variable": name,
                "from": f"task{writer[name]}",
                "to": f"task{k}",
                "constant": False,
            }
            for name in names
            for k in readers[name]
        ],
        "links": [],
        "faults": [],
    }


def states(cycle, tasks=range(TASKS), *, whole=False):
    return {
        "kind": "status",
        "t": time.time(),
        "whole": whole,
        "rtpus": [
            {
                "rtpu": f"arm{k}",
                "backend": "fifo",
                "scheduler": "MUF",
                "illegal": [],
                "silent": False,
                "stalls": 0,
                "load": 0.1,
            }
            for k in range(RTPUS)
        ],
        "tasks": [
            {
                "task": f"task{k}",
                "rtpu": f"arm{k * RTPUS // TASKS}",
                "state": "ERROR" if k == 7 else "ON",
                "signals": ["off"],
                "fields": {"refF": 100.0, "mezF": 99.9, "cycle": cycle, "avgU": 1.0},
                "error": "the sensor is silent" if k == 7 else "",
                "warning": "",
                "waits": "",
                "standby": False,
                "fallback_of": "",
                "restarted": "",
            }
            for k in tasks
        ],
        "gone": [],
    }


class MadeSource(Source):
    """Tells of tasks that nobody runs: all change twice a second, values at 20 Hz."""

    about = {"name": "large", "job": "large", "hz": HZ, "log": None}  # noqa: RUF012
    variables = frozenset(f"V{k}" for k in range(VARIABLES))

    def __init__(self):
        self.wanted = frozenset()
        self._told = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def start(self, told):
        self._told = told
        self._thread.start()

    def close(self):
        self._ended.set()
        self._thread.join()

    def want(self, names):
        self.wanted = frozenset(names)

    def first(self):
        return [
            {"kind": "graph", "graph": made_graph()},
            states(0, whole=True),
            {"kind": "history", "values": {}, "events": []},
            {"kind": "complaints", "texts": []},
        ]

    def history(self, names):
        return [{"kind": "history", "values": {n: {"t": [], "v": []} for n in names}}]

    def _run(self):
        count = 0
        while not self._ended.wait(1.0 / HZ):
            count += 1
            now = time.time()
            value = {"t": now, "v": [count, -count], "writer": "", "age": 0.0}
            values = {name: value | {"stale": False} for name in self.wanted}
            self._told({"kind": "values", "t": now, "values": values})
            if count % 10 == 0:
                self._told(states(count))


@pytest.fixture
def large():
    """A server of the page with that source; its link, and the source."""
    source = MadeSource()
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        number = listening.getsockname()[1]
        access = Access(["127.0.0.1"], number, b"key")
        page = Page(
            source, lambda _: RecordedQuestions(""), access, linked=lambda *_: None
        )
        config = uvicorn.Config(page.app(), log_config=None, ws="websockets-sansio")
        server = uvicorn.Server(config)
        serving = threading.Thread(target=server.run, args=([listening],))
        serving.start()
        yield access.links[Role.OBSERVER], source
        server.should_exit = True
        serving.join()


def test_two_hundred_tasks_are_drawn_folded_and_only_what_is_seen_is_watched(large):
    link, source = large
    with chromium() as browser, opened(browser, link) as page:
        page.locator(".card.small.is-on").nth(150).wait_for()
        assert page.locator(".card.small").count() == TASKS
        assert page.locator(".card.is-error .name").inner_text() == "task7"
        keep_picture(page, "large")
        page.get_by_label("fold arm3").click()
        page.locator(".card.small").nth(TASKS - TASKS // RTPUS - 1).wait_for()
        assert page.locator(".card.small").count() == TASKS - TASKS // RTPUS
        assert "25 ON" in page.locator(".frame.folded .counts").inner_text()
        assert source.wanted == frozenset()
        page.locator("#tab-Variables").click()
        page.get_by_label("filter variables").fill("V49")
        wait_for(lambda: len(source.wanted) == 11, "V49 and V490 to V499 are watched")
        row = page.locator(
            "#panel tr", has=page.get_by_role("button", name="plot V499")
        )
        wait_for(
            lambda: row.locator(".values").inner_text() != "\N{EN DASH}", "a value"
        )
        page.get_by_role("button", name="compact").click()
        page.locator(".card:not(.small)").first.wait_for()
        assert page.locator(".card").count() <= TASKS
