"""Messages are decoded by several threads, none of which may meet a half made type."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
import pytest

import pbonet
from pbonet.xm.net import convert, decoders

LOOK = """
from __future__ import annotations

import sys

import msgspec
from pbonet.node.wire import rtpu_messages as wire


class Fresh(msgspec.Struct):
    x: int


def runs_python(one):
    ran = []
    sys.setprofile(lambda frame, event, arg: ran.append(event))
    msgspec.msgpack.Decoder(one)
    sys.setprofile(None)
    return "call" in ran


assert runs_python(Fresh) and not runs_python(Fresh)
found = [
    one
    for one in vars(wire).values()
    if isinstance(one, type) and issubclass(one, msgspec.Struct)
]
assert len(found) > 20
print([one for one in found if runs_python(one)])
"""


def test_messages_of_a_machine_are_made_before_any_thread_decodes_into_them():
    """What makes them runs Python, and there msgspec lets other threads meet them."""
    done = subprocess.run(
        [sys.executable, "-c", LOOK], check=False, capture_output=True, text=True
    )
    assert (done.stdout.strip(), done.stderr) == ("[]", "")


def test_a_type_is_made_by_one_thread_while_others_wait(monkeypatch):
    real, inside, most = msgspec.msgpack.Decoder, [], []

    def make(kind):
        inside.append(kind)
        most.append(len(inside))
        time.sleep(0.002)  # where msgspec lets other threads run
        made = real(kind)
        inside.remove(kind)
        return made

    monkeypatch.setattr(decoders.msgspec.msgpack, "Decoder", make)
    kinds = [msgspec.defstruct(f"Fresh{n}", [("x", int)]) for n in range(4)]
    together = threading.Barrier(8)

    def ask(kind):
        together.wait()
        return convert({"x": 3}, kind).x

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(ask, kinds * 2)) == [3] * 8
    assert set(most) == {1}


@pytest.mark.parametrize("room", ["master", "xm/net", "node/agent"])
def test_parts_of_messages_are_converted_by_this_file_alone(room):
    """Its lock keeps out threads that meet a type which another one makes."""
    root = Path(pbonet.__file__).parent
    users = [
        str(path.relative_to(root))
        for path in (root / room).rglob("*.py")
        if "msgspec.convert(" in path.read_text()
    ]
    assert users == (["xm/net/decoders.py"] if room == "xm/net" else [])
