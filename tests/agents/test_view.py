"""A running subsystem as a viewer sees it that speaks Foxglove's protocol."""

from __future__ import annotations

import json
import signal
import struct
import subprocess
import sys

import pytest
from websockets.sync.client import connect

from pbonet.master.subsystem.subsystem import Subsystem

LEVEL = """
    from typing import Annotated as A
    from pbonet import OutVar, Params, PortBasedObject, Vector, param

    class Of(Params):
        value: A[float, param("m", "the level")] = 1.5

    class Level(PortBasedObject[Of]):
        '''A level that is set.'''

        level: A[Vector, OutVar("LEVEL", "2", "m", "level and twice that")]

        def cycle(self, dt: float) -> None:
            self.level[:] = self.params.value, 2 * self.params.value
"""
SVAR = "NAME LEVEL\nTYPE double\nDESC a level\nUNITS m\nNELEM 2\n\nEOF\n"
RMOD = (
    "MODULE level\nDESC a test\nINCONST none\nOUTCONST none\nINVAR none\n"
    "OUTVAR LEVEL\nTASKTYPE periodic\nFREQ 100\nEOF\n"
)


@pytest.fixture
def levels(nodes, tmp_path):
    """A subsystem with one task that is ON."""
    nodes.write_module("level", LEVEL)
    for name, text in (
        ("l.svar", SVAR),
        ("l.sbs", "SUBSYSTEM levels\nSVARFILE l.svar\nRTPU arm0\nEOF\n"),
        ("level.rmod", RMOD),
    ):
        (tmp_path / name).write_text(text)
    nodes.agent("arm0")
    with Subsystem(tmp_path / "l.sbs", domain=nodes.domain, record="off") as levels:
        levels.spawn("level")
        levels.control("level", "on")
        yield levels


def command(levels, *words):
    file = str(levels.files.path)
    begin = [sys.executable, "-m", "pbonet.cli", "view", file, "--domain"]
    return [*begin, levels.domain, *words]


class Watcher:
    """A client of the protocol: advertised channels by topic, messages by topic."""

    def __init__(self, socket):
        self.socket = socket
        self.info = json.loads(socket.recv())
        self.channels = {}
        self.topics = {}

    def take(self):
        data = self.socket.recv(timeout=60)
        if isinstance(data, str):
            for one in json.loads(data).get("channels", []):
                self.channels[one["topic"]] = one
            return None, None
        kind, number, _ = struct.unpack_from("<BIQ", data)
        assert kind == 1
        return self.topics[number], json.loads(data[13:])

    def subscribe(self, topic):
        while topic not in self.channels:
            self.take()
        number = len(self.topics) + 1
        self.topics[number] = topic
        one = {"id": number, "channelId": self.channels[topic]["id"]}
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": [one]}))

    def wait(self, topic, good):
        """Return the first message of a topic that is good."""
        while True:
            of, message = self.take()
            if of == topic and good(message):
                return message


def test_a_viewer_sees_values_states_and_events(levels) -> None:
    with subprocess.Popen(
        command(levels, "--port", "0", "--json"), stdout=subprocess.PIPE, text=True
    ) as server:
        told = json.loads(server.stdout.readline())
        assert told["link"].startswith("https://app.foxglove.dev")
        assert told["url"].startswith("ws://127.0.0.1:")
        with connect(told["url"], subprotocols=["foxglove.sdk.v1"]) as socket:
            watcher = Watcher(socket)
            assert watcher.info["name"] == "pbonet levels"
            watcher.subscribe("levels/LEVEL")
            channel = watcher.channels["levels/LEVEL"]
            assert channel["metadata"] == {"units": "m"}
            assert "a level [m]" in channel["schema"]
            first = watcher.wait("levels/LEVEL", lambda one: one["cycle"] > 0)
            assert (first["value"], first["writer"]) == ([1.5, 3.0], "level")
            watcher.subscribe("levels/events")
            watcher.subscribe("levels/tasks/level")
            watcher.wait("levels/tasks/level", lambda one: one["cycle"] > 0)
            levels.set("level", "value", "-2")  # both subscriptions stand by now
            watcher.wait("levels/LEVEL", lambda one: one["value"] == [-2.0, -4.0])
            event = watcher.wait(
                "levels/events", lambda one: one["event"]["code"] == "SET"
            )
            assert event["name"] == "levels/level"
            state = watcher.wait("levels/tasks/level", lambda one: one["cycle"] > 5)
            assert (state["state"], state["ref_f"]) == ("ON", 100.0)
            levels.control("level", "off")
            watcher.wait("levels/tasks/level", lambda one: one["state"] == "OFF")
        server.send_signal(signal.SIGINT)
        server.communicate(timeout=60)
    assert server.returncode == 0


def test_nothing_is_served_beyond_this_machine_unless_told(levels) -> None:
    done = subprocess.run(
        command(levels, "--host", "0.0.0.0", "--port", "0"),  # noqa: S104
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "listening beyond this machine is not protected" in done.stderr
