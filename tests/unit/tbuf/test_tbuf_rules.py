"""What agents do for a link, and how a record travels."""

import pytest

from pbonet.node.agent.link_rules import IDLE, LinkDuty, LocalUsers, RemoteUsers, duty
from pbonet.xm.net import key_expressions

NOBODY, WRITER = (
    LocalUsers(writer=False, reader=False),
    LocalUsers(writer=True, reader=False),
)
READER, BOTH = (
    LocalUsers(writer=False, reader=True),
    LocalUsers(writer=True, reader=True),
)


def there(sinks=(), sources=()):
    return RemoteUsers(set(sinks), set(sources))


@pytest.mark.parametrize("here", [NOBODY, BOTH])
def test_nothing_is_done_where_nothing_is_missing(here):
    everybody = there({"b", "c"}, {("b", "a")})
    assert duty("a", here, everybody, LinkDuty(serve="b")) == IDLE


def test_a_reader_is_shown_and_served_by_whoever_names_it():
    assert duty("a", READER, there(), IDLE) == LinkDuty(sink=True)
    others = there({"a", "c"}, {("b", "c")})
    assert duty("a", READER, others, IDLE) == LinkDuty(sink=True), (
        "b serves another one"
    )
    mine = there({"a"}, {("b", "a")})
    assert duty("a", READER, mine, IDLE) == LinkDuty(sink=True, take="b")


def test_a_writer_serves_one_sink_and_stays_with_it():
    assert duty("a", WRITER, there({"a"}), IDLE) == IDLE, "its own token is no reader"
    assert duty("a", WRITER, there({"c", "b"}), IDLE) == LinkDuty(serve="b")
    assert duty("a", WRITER, there({"c", "b"}), LinkDuty(serve="c")) == LinkDuty(
        serve="c"
    )
    assert duty("a", WRITER, there({"b"}), LinkDuty(serve="c")) == LinkDuty(serve="b")


def test_of_two_writers_the_first_is_kept():
    two = there({"a"}, {("b", "a"), ("c", "a")})
    assert duty("a", READER, two, IDLE).take == "b"
    assert duty("a", READER, two, LinkDuty(sink=True, take="c")).take == "c"
    gone = there({"a"}, {("b", "a")})
    assert duty("a", READER, gone, LinkDuty(sink=True, take="c")).take == "b"


def test_two_agents_come_together_and_part():
    """The whole handshake, step by step, as tokens would carry it."""
    a = duty("a", WRITER, there(), IDLE)
    b = duty("b", READER, there(), IDLE)
    assert (a, b) == (IDLE, LinkDuty(sink=True))
    a = duty("a", WRITER, there({"b"}), a)
    b = duty("b", READER, there({"b"}, {("a", "b")}), b)
    assert (a, b) == (LinkDuty(serve="b"), LinkDuty(sink=True, take="a"))
    a = duty("a", WRITER, there(), a)
    b = duty("b", READER, there({"b"}), b)
    assert (a, b) == (IDLE, LinkDuty(sink=True)), "the link was cut"


def test_keys_are_taken_apart():
    key = key_expressions.link("d", "vision:x", "source", "a", "b")
    assert key == "pbonet/d/tbuf/vision:x/source/a/b"
    assert key_expressions.link_parts(key) == ("vision:x", "source", ["a", "b"])
    for other in ("pbonet/d/tbuf/x", "pbonet/d/rtpu/a/alive", "x"):
        assert key_expressions.link_parts(other) is None
