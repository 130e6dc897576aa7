"""Whatever is sent to an agent's keys: it answers, stays small, and its tasks go on."""

import math
import random
from pathlib import Path
from typing import get_args

import msgspec
import pytest
import zenoh
from watching import wait_for

from pbonet.errors import PbonetError
from pbonet.svar import Table
from pbonet.xm.net import AnyMessage, codec, key_expressions, messages as m

KINDS = get_args(AnyMessage)
SLOW = {m.Modules, m.Links}
"""Take seconds each when they are understood; once is enough."""
ODD = [
    *(None, True, -1, 1 << 63, -(1 << 63), math.nan, math.inf, 1e308, 0),
    *("", "\0", "../..", "x" * 5000, b"", b"\0" * 5000, [], {}, [[]] * 50, {"a": {}}),
]
BLUNT = [
    *(b"", b"\0", b"\xc1", b"\x91" * 200_000, b"\x81\xa1v" * 100_000),
    *(b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff"),
    *(b"\xdb\xff\xff\xff\xff", b"\x85\xa1v\x01\xa2op\xa5spawn", b"\x80", b"\x01"),
    msgspec.msgpack.encode({"v": 1, "op": "xm_put", "data": bytes((1 << 20) + 1)}),
    msgspec.msgpack.encode({"v": 1 << 63, "op": "hello"}),
    msgspec.msgpack.encode({"v": 1, "op": ["hello"], "id": {"a": 1}}),
]
MOST = 96 << 20
"""Bytes by which a process may grow."""


def requests(rng):
    """Give packed requests, each wrong in its own way, or right by chance."""
    yield from BLUNT
    yield from (rng.randbytes(rng.randrange(1, 200)) for _ in range(60))
    for kind in KINDS:
        fields = [field.name for field in msgspec.structs.fields(kind)]
        plain = dict.fromkeys(fields, 1) | {"v": 1, "op": kind.__struct_config__.tag}
        plain |= {"id": f"f{rng.random()}", "client": "fuzz", "subsystem": "s"}
        for _ in range(2 if kind in SLOW else 14):
            odd = {
                name: rng.choice(ODD)
                for name in rng.sample(fields, rng.randrange(1, len(fields) + 1))
                if name != "v"
            }
            whole = msgspec.msgpack.encode(plain | odd)
            yield whole
            yield whole[: rng.randrange(len(whole))]
            torn = bytearray(whole)
            for _ in range(3):
                torn[rng.randrange(len(torn))] = rng.randrange(256)
            yield bytes(torn)


def stops_all(data):
    """Tell whether a request is by chance a good one that ends every task."""
    try:
        request = codec.Codec().request(data)
    except PbonetError:
        return False
    return isinstance(request, m.Stop) and not request.subsystem


def size(pid):
    """Return the bytes of a process's memory."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * 4096


@pytest.mark.timeout(180)
def test_an_agent_outlives_what_is_sent_to_it(nodes, tmp_path):
    files = tmp_path / "files"
    files.mkdir()
    nodes.agent_process("arm0", files=str(files))
    client = nodes.client()
    arm = nodes.master("arm0", "arm")
    arm.spawn("a", "counts")
    task = arm.on("a")
    table = Table.attach(f"{nodes.domain}.arm")
    before = client.call("arm0", m.Hello(), m.AgentInfo)
    grown = {pid: size(pid) for pid in (before.pid, before.rtpu_pid)}
    leaves = ["sbs", "mail", "status", "clock", "alive", "event"]
    other = [
        key_expressions.svar(nodes.domain, "s", leaf)
        for leaf in ("news", "sync", "flush")
    ]
    other.append(key_expressions.link(nodes.domain, "arm0:x", "data", "arm0", "arm1"))
    ended, sent = [], 0
    rng = random.Random(5)
    for number, data in enumerate(requests(rng)):
        if stops_all(data):
            continue
        leaf = leaves[0] if number % 3 else rng.choice(leaves)
        nodes.session.get(
            key_expressions.rtpu(nodes.domain, "arm0", leaf),
            zenoh.handlers.Callback(
                lambda _: None, lambda n=number: ended.append(n), indirect=False
            ),
            payload=data,
            timeout=60.0,
        )
        sent += 1
        if number % 5 == 0:
            nodes.session.put(rng.choice(other).replace("*", "x"), data)
        if number % 100 == 0:  # its values stand in memory, whatever the agent does
            last = table.info("Y0").cycle
            wait_for(lambda: table.info("Y0").cycle > last + 1, "a cycle")  # noqa: B023
        wait_for(lambda: sent - len(ended) < 100, "answers", 60.0)  # noqa: B023
    wait_for(lambda: len(ended) == sent, "all answers", 60.0)
    after = client.call("arm0", m.Hello(), m.AgentInfo)
    assert (after.pid, after.rtpu_pid) == (before.pid, before.rtpu_pid)
    assert list(arm.status()) == ["a"]
    assert (arm.status("a").state, arm.status("a").tid) == ("ON", task.tid)
    table.close()
    for pid, was in grown.items():
        assert size(pid) - was < MOST
