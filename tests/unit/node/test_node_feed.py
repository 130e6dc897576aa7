"""What a slow, full or ended reader is told, and what is counted."""

from __future__ import annotations

import os
import threading

import pytest
from watching import wait_for

from pbonet.node.agent import recorder_pipe as feeding
from pbonet.node.agent.recorder_pipe import RecorderPipe

FRAME = bytes(50_000)


class Reader:
    """A pipe that is read when a test says so."""

    def __init__(self) -> None:
        self.fd, self.to = os.pipe()

    def take(self, size: int) -> bytes:
        found = b""
        while len(found) < size and (part := os.read(self.fd, size - len(found))):
            found += part
        return found


@pytest.fixture
def reader():
    made = Reader()
    yield made
    os.close(made.fd)


def settled() -> None:
    """Wait until every thread that feeds has ended."""
    wait_for(
        lambda: all(one.name != "pbonet feed" for one in threading.enumerate()),
        "the feeding to end",
    )


def test_more_than_a_pipe_takes_arrives_in_order(reader) -> None:
    unfit: list[int] = []
    feed = RecorderPipe(unfit.append, lambda: None)
    feed.begin(reader.to)
    frames = [bytes([n]) * 50_000 for n in range(20)]
    for frame in frames:
        feed.put(frame)
    feed.end()
    feed.put(b"too late")
    assert reader.take(2_000_000) == b"".join(frames)
    settled()
    assert unfit == []


def test_what_finds_no_room_is_counted_and_told(reader, monkeypatch) -> None:
    monkeypatch.setattr(feeding, "MOST", 4 * len(FRAME))
    unfit: list[int] = []
    feed = RecorderPipe(unfit.append, lambda: None)
    for _ in range(7):
        feed.put(FRAME)
    assert unfit == []
    feed.begin(reader.to)
    assert len(reader.take(4 * len(FRAME))) == 4 * len(FRAME)
    wait_for(lambda: unfit, "the count")
    feed.end()
    settled()
    assert unfit == [3]
    assert reader.take(1) == b""


def test_another_reader_is_told_what_the_first_did_not_take_whole(reader) -> None:
    feed = RecorderPipe(lambda _: None, lambda: None)
    first = Reader()
    feed.begin(first.to)
    for n in range(4):
        feed.put(bytes([n]) * 50_000)
    first.take(75_000)  # the second one is under way, and can never be whole
    os.close(first.fd)
    settled()
    feed.leave()
    feed.begin(reader.to)
    feed.end()
    rest = reader.take(200_000)
    settled()
    # What stood in the first pipe is lost with it; a frame is never cut.
    assert rest == b"".join(bytes([n]) * 50_000 for n in range(rest[0], 4))
    assert rest[0] in {2, 3}


def test_a_reader_that_takes_nothing_is_told_of(reader, monkeypatch) -> None:
    monkeypatch.setattr(feeding, "STUCK", 0.05)
    stuck = threading.Event()
    feed = RecorderPipe(lambda _: None, stuck.set)
    feed.begin(reader.to)
    for _ in range(3):
        feed.put(FRAME)
    assert stuck.wait(60)
    feed.end()
    settled()
