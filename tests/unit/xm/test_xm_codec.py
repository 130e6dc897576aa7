"""Messages of other protocol versions."""

import msgspec
import pytest

from pbonet.errors import ProtocolError
from pbonet.node.wire import Answers
from pbonet.xm.net import codec, messages as m

NEWER = m.VERSION + 5


def packed(op, **more):
    """Return a request of a later version, with a field that is not known here."""
    fields = {"v": NEWER, "op": op, "id": "x-1", "subsystem": "arm", "colour": "red"}
    return msgspec.msgpack.encode({**fields, **more})


def test_a_stop_of_any_version_is_taken_and_answered_in_that_version():
    request = codec.Codec().request(packed("stop", timeout=1.5, stop_id="s1"))
    assert isinstance(request, m.Stop)
    assert (request.subsystem, request.timeout, request.stop_id) == ("arm", 1.5, "s1")
    answers = Answers("arm0", pytest.fail)
    done = m.Stopped(off=["ctl"], killed=[])
    assert msgspec.msgpack.decode(answers.good(request, done, [])) == {
        "v": NEWER,
        "id": "x-1",
        "ok": True,
        "result": {"off": ["ctl"], "killed": [], "failed": {}},
        "error": None,
        "warnings": [],
    }
    refused = msgspec.msgpack.decode(answers.bad(request, ProtocolError("no")))
    assert (refused["v"], refused["ok"]) == (NEWER, False)


def test_a_hello_of_any_version_is_taken():
    assert isinstance(codec.Codec().request(packed("hello")), m.Hello)


def test_other_requests_of_another_version_are_refused():
    with pytest.raises(ProtocolError, match=f"version {NEWER}") as caught:
        codec.Codec().request(packed("status"))
    assert caught.value.expected == f"version {m.VERSION}"
