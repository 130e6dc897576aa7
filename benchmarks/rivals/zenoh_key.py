"""Raw zenoh: express puts over TCP on the loopback, a ring of one at the reader.

Shared memory of zenoh was slower than TCP for sets of at most 12 kB.
"""

from __future__ import annotations

import json
import socket
import time
from typing import Any

import numpy as np

from benchmarks.rivals.rival import Reader, Rival, Writer, alone, load

OFF = {
    "mode": "peer",
    "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "transport": {"shared_memory": {"enabled": False}},
}


class ZenohKey(Rival):
    """`put` and `try_recv`."""

    name = "raw zenoh"

    def __init__(self, length: int, tag: str) -> None:
        super().__init__(length, tag)
        with socket.socket() as found:
            found.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{found.getsockname()[1]}"

    def _open(self, side: str) -> tuple[Any, Any]:
        zenoh = load("zenoh")
        settings = OFF | {side: {"endpoints": [self.endpoint]}}
        if side == "connect":
            settings["listen"] = {"endpoints": []}
        return zenoh, zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))

    def writer(self) -> Writer:
        """Declare a publisher."""
        zenoh, session = self._open("listen")
        own = np.zeros(self.floats)
        publisher = session.declare_publisher(
            f"{self.tag}/set",
            express=True,
            congestion_control=zenoh.CongestionControl.DROP,
        )
        put, pack = publisher.put, own.tobytes

        def publish(keep: object = session) -> None:  # noqa: ARG001
            put(pack())

        return Writer([own], publish)

    def reader(self) -> Reader:
        """Declare a subscriber."""
        zenoh, session = self._open("connect")
        ring = session.declare_subscriber(
            f"{self.tag}/set", zenoh.handlers.RingChannel(1)
        )
        time.sleep(0.2)  # until the writer knows of it
        receive, wait, frombuffer = ring.try_recv, ring.recv, np.frombuffer

        def take(keep: object = session) -> object:  # noqa: ARG001
            sample = receive()
            if sample is None:
                return None
            return frombuffer(sample.payload.to_bytes())

        def wake() -> object:
            return frombuffer(wait().payload.to_bytes())

        return Reader(take, alone, wake)
