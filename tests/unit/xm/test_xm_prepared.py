"""Messages are decoded by several threads, none of which may meet a half made type."""

from __future__ import annotations

import subprocess
import sys

LOOK = """
from __future__ import annotations

import sys

import msgspec
from pbonet.master.subsystem import remote_modules as modules
from pbonet.node.wire import rtpu_messages as wire
from pbonet.xm.net import codec, messages
from pbonet.xm.net import file_messages as filing
from pbonet.xm.net import resource_messages as resources


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
    for module in (messages, filing, resources, wire)
    for one in vars(module).values()
    if isinstance(one, type) and issubclass(one, msgspec.Struct)
]
assert len(found) > 50
found.append(modules._answer())
print([one for one in found if runs_python(one)])
"""


def test_a_type_is_made_before_any_thread_decodes_into_it():
    """What makes it runs Python, and there msgspec lets other threads meet it."""
    done = subprocess.run(
        [sys.executable, "-c", LOOK], check=False, capture_output=True, text=True
    )
    assert (done.stdout.strip(), done.stderr) == ("[]", "")
