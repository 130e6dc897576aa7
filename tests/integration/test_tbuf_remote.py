"""Links between two machines: two real agents, each with shared memory of its own."""

import pytest
from tbuf_rig import Pair, flows
from watching import wait_for


@pytest.fixture
def pair():
    """Two machines that are linked by zenoh alone."""
    both = Pair()
    try:
        both.start()
        yield both
    finally:
        both.close()


def test_records_arrive_whole_whoever_comes_first(pair):
    reader = pair.b.reader("vision0:x", "(64,)f8")
    assert reader.look()["new"] is False
    writer = pair.a.writer(dtype="(64,)f8")
    first = flows(reader)
    later = wait_for(
        lambda: (now := reader.look())["number"] > first["number"] + 100 and now,
        "a hundred records more",
    )
    assert later["values"] == [later["number"]], "the newest whole record"
    assert 0 < later["age"] < 5
    writer.kill()
