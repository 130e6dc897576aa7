"""What is refused of requests about heirs before anybody acts on it."""

import msgspec
import pytest

from pbonet.errors import ProtocolError
from pbonet.node.rt import _rt
from pbonet.xm.net import messages as m
from pbonet.xm.net.codec import Codec

CALL = {
    "successor": "b",
    "outputs": ["Y0"],
    "core": 1023,
    "slot": _rt.SLOTS - 1,
    "life": 2**32 - 1,
    "ticket": 2**31 - 1,
    "caller": 31,
}
NUMBERS = ("core", "slot", "life", "ticket", "caller")


def reconfig(**wrong):
    request = {"v": m.VERSION, "op": "reconfig", "items": [["a", "off"]]}
    request["calls"] = {"a": [CALL | wrong]}
    return msgspec.msgpack.encode(request)


def heirs(count):
    after = {"b": [f"a{k}" for k in range(count)]}
    return Codec().pack(m.Successors(after=after))


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_of_calls_fit_where_they_are_used(name):
    codec = Codec()
    for good in (0, CALL[name]):
        (call,) = codec.request(reconfig(**{name: good})).calls["a"]
        assert getattr(call, name) == good
    for wrong in (-1, CALL[name] + 1, 2**40):
        with pytest.raises(ProtocolError, match=rf"calls\[\.\.\.\]\[0\]\.{name}"):
            codec.request(reconfig(**{name: wrong}))


def test_an_heir_waits_for_so_many_at_most():
    codec = Codec()
    assert len(codec.request(heirs(m.MOST_CALLERS)).after["b"]) == 32
    with pytest.raises(ProtocolError, match="length <= 32") as caught:
        codec.request(heirs(m.MOST_CALLERS + 1))
    assert "$.after" in str(caught.value)
