"""Plain zenoh in a process of its own, beside which others are measured.

It is set up as who knows zenoh does it: callbacks run in zenoh's own threads, which
saves a change of thread, as in pbonet's agents.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any

import zenoh

if TYPE_CHECKING:
    from collections.abc import Generator

PLAIN = """
import json, sys, time, zenoh
config = zenoh.Config.from_json5(sys.argv[1])
session = zenoh.open(config)
def answer(query):
    with query: query.reply(str(query.key_expr), query.payload)
def relay(query):
    done = zenoh.handlers.Callback(
        lambda reply: None, lambda: answer(query), indirect=False)
    session.get("bench/echo", done, payload=query.payload)
if sys.argv[2] in ("echo", "relay"):
    what = {"echo": answer, "relay": relay}[sys.argv[2]]
    handler = zenoh.handlers.Callback(what, indirect=False)
    q = session.declare_queryable("bench/" + sys.argv[2], handler)
    time.sleep(1e6)
rate, seconds = float(sys.argv[3]), float(sys.argv[4])
pub = session.declare_publisher("bench/put")
time.sleep(0.5)
due = time.monotonic()
end = due + seconds
while due < end:
    due += 1 / rate
    time.sleep(max(due - time.monotonic(), 0))
    pub.put(time.monotonic_ns().to_bytes(8, "little") + bytes(40))
"""


@contextlib.contextmanager
def raw(mode: str, *words: str) -> Generator[zenoh.Session, None, None]:
    """Yield a session linked to a process that puts or answers, or to two of them.

    The second one relays: it asks the first one before it answers, as an agent asks
    the other machine's.
    """
    there = {"endpoints": ["tcp/127.0.0.1:17461"]}
    listen: dict[str, Any] = {"mode": "router", "listen": there}
    connect = {"mode": "client", "connect": there}
    off = {
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}},
    }
    roles: list[tuple[str, dict[str, Any]]] = [(mode, listen)]
    if mode == "echo":
        roles.append(("relay", {"mode": "router", "connect": there}))
    processes = [
        subprocess.Popen([
            sys.executable,
            "-c",
            PLAIN,
            json.dumps(config | off),
            role,
            *words,
        ])
        for role, config in roles
    ]
    link = None
    end = time.monotonic() + 10
    while link is None:
        try:
            link = zenoh.open(zenoh.Config.from_json5(json.dumps(connect | off)))
        except zenoh.ZError:
            assert time.monotonic() < end
            time.sleep(0.05)
    try:
        yield link
    finally:
        link.close()  # type: ignore[no-untyped-call]
        for process in processes:
            process.kill()
            process.wait()
