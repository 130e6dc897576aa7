"""Message queues: policies, blocks, bounds, refusals; a model drives them at random."""

import random
import time
from pathlib import Path

import pytest

from pbonet import xm
from pbonet.errors import (
    XmDamagedError,
    XmDestroyedError,
    XmLayoutError,
    XmQueueFullError,
    XmTooLongError,
)
from pbonet.xm import Full, Policy, Queue

PRIORITIES = [(b"low", 1), (b"high", 9), (b"mid", 5), (b"mid2", 5)]
ORDER = {
    Policy.FIFO: [b"low", b"high", b"mid", b"mid2"],
    Policy.LIFO: [b"mid2", b"mid", b"high", b"low"],
    Policy.HPF: [b"high", b"mid", b"mid2", b"low"],
}


@pytest.fixture
def queue(request):
    settings = {"messages": 4, "blocks": 8, "block": 16}
    made = Queue.create("events", **(settings | getattr(request, "param", {})))
    yield made
    made.destroy()


def drain(queue: Queue) -> list[bytes]:
    return list(iter(queue.try_receive, None))


@pytest.mark.parametrize("policy", ORDER)
def test_policies(policy) -> None:
    queue = Queue.create("events", policy=policy)
    for data, priority in PRIORITIES:
        assert queue.send(data, priority)
    assert len(queue) == 4
    assert queue.policy is policy
    assert drain(queue) == ORDER[policy]
    queue.send(b"x", 7)
    queue.receive()
    assert queue.last_priority == 7
    queue.destroy()


def test_long_messages_stand_beside_short_ones(queue) -> None:
    sent = [b"", b"a" * 16, b"b" * 17, bytes(range(70))]
    for message in sent:
        queue.send(message)
    assert queue.free == (0, 0)
    assert [queue.receive() for _ in sent] == sent
    assert queue.free == (4, 8)
    assert queue.receive(0) is None
    assert queue.receive(time.monotonic_ns() + 2_000_000) is None


@pytest.mark.parametrize("queue", [{"blocks": 1000}], indirect=True)
def test_a_message_may_be_as_long_as_the_queue(queue) -> None:
    whole = random.Random(1).randbytes(16_000)
    queue.send(whole)
    assert queue.receive() == whole
    with pytest.raises(XmTooLongError, match="expected at most 16000 bytes, got 16001"):
        queue.send(whole + b"1")
    assert len(queue) == 0


def test_full_refuses(queue) -> None:
    for n in range(4):
        queue.send(bytes([n]))
    with pytest.raises(XmQueueFullError) as error:
        queue.send(b"more")
    assert str(error.value) == (
        "local:events: the queue is full (expected room for 4 bytes, got 4 messages in "
        "it); receive more often, make it larger, or choose what to drop (full=)"
    )
    assert queue.dropped == 0
    assert not queue.send(b"more", full=Full.DROP)
    assert queue.dropped == 1
    assert drain(queue) == [bytes([n]) for n in range(4)]


def test_full_drops_the_oldest_until_it_fits(queue) -> None:
    for n in range(4):
        queue.send(bytes([n]) * 30)
    assert queue.send(b"x" * 50, full=Full.DROP_OLDEST)
    assert queue.dropped == 2
    assert drain(queue) == [bytes([2]) * 30, bytes([3]) * 30, b"x" * 50]


@pytest.mark.parametrize("queue", [{"policy": Policy.HPF}], indirect=True)
def test_of_priorities_the_lowest_goes(queue) -> None:
    for data, priority in PRIORITIES:
        queue.send(data, priority)
    for data in (b"n1", b"n2"):
        queue.send(data, 5, full=Full.DROP_OLDEST)
    assert drain(queue) == [b"high", b"mid2", b"n1", b"n2"]


@pytest.mark.parametrize("queue", [{"policy": Policy.LIFO}], indirect=True)
def test_of_a_lifo_queue_the_oldest_goes_too(queue) -> None:
    for data in (b"1", b"2", b"3", b"4", b"5"):
        queue.send(data, full=Full.DROP_OLDEST)
    assert drain(queue) == [b"5", b"4", b"3", b"2"]


def test_waiting_for_room_ends_at_its_limit(queue) -> None:
    for _ in range(4):
        queue.send(b"x")
    until = time.monotonic_ns() + 3_000_000
    with pytest.raises(XmQueueFullError):
        queue.send(b"y", until_ns=until)
    assert time.monotonic_ns() >= until
    assert not queue.send(b"y", until_ns=time.monotonic_ns() + 1, full=Full.DROP)
    assert queue.waiting == 0


def test_waiting_takes_nothing(queue) -> None:
    assert not queue.wait(time.monotonic_ns() + 2_000_000)
    queue.send(b"x")
    assert queue.wait(0)
    assert queue.wait()
    assert (len(queue), queue.waiting) == (1, 0)
    assert queue.receive() == b"x"


@pytest.mark.parametrize("queue", [{"blocks": 1000}], indirect=True)
@pytest.mark.parametrize("size", [0, 5, 16, 1024, 1025, 9000])
def test_receiving_into_a_buffer(queue, size) -> None:
    data = random.Random(size).randbytes(size)
    queue.send(memoryview(data), 3)
    buffer = bytearray(size + 7)
    assert queue.receive_into(buffer) == size
    assert buffer[:size] == data
    assert queue.free == (4, 1000)
    assert queue.receive_into(buffer, 0) is None


def test_a_buffer_that_is_too_short_leaves_the_message(queue) -> None:
    queue.send(b"12345")
    with pytest.raises(XmTooLongError, match="expected at most 4 bytes, got 5 bytes"):
        queue.receive_into(bytearray(4))
    with pytest.raises(BufferError):
        queue.receive_into(b"12345")
    assert queue.receive() == b"12345"


def test_settings_are_those_it_was_made_with(queue) -> None:
    other = xm.queue("events", messages=4, block=16)
    other.send(b"x")
    assert queue.receive() == b"x"
    with pytest.raises(XmLayoutError, match="expected policy 2, got policy 0"):
        xm.queue("events", policy=Policy.HPF)
    other.close()


@pytest.mark.parametrize("settings", [{"messages": 0}, {"blocks": 0}, {"block": 7}])
def test_settings_have_bounds(settings) -> None:
    with pytest.raises(ValueError, match=r"is not within"):
        Queue.create("bad", **settings)


def test_destroyed_is_told(queue) -> None:
    other = xm.queue("events")
    queue.destroy()
    with pytest.raises(XmDestroyedError):
        other.send(b"x")
    other.close()
    fresh = xm.queue("events")
    assert fresh.free == (64, 64)
    fresh.destroy()


def test_messages_outlive_their_senders() -> None:
    first = xm.queue("events")
    first.send(b"still here")
    first.close()
    second = xm.queue("events")
    assert second.receive() == b"still here"
    second.destroy()


def test_damage_is_found_and_not_followed(queue) -> None:
    """A file with some word wrong is refused, or gives errors; nothing crashes."""
    queue.send(b"x" * 60)
    queue.send(b"y" * 40)
    good = Path(queue.path).read_bytes()
    pick = random.Random(5)
    tail = len(good) - 2000
    copy = Path(queue.path.replace("events", "copy"))
    for _ in range(300):
        bad = bytearray(good)
        place = pick.choice([pick.randrange(60), pick.randrange(tail, len(good) - 4)])
        bad[place : place + 4] = pick.randbytes(4)
        copy.write_bytes(bad[: len(good)])
        copy.chmod(0o600)
        try:
            other = Queue.attach("copy")
        except (XmDamagedError, XmLayoutError):
            continue
        try:
            for _again in range(3):
                other.try_receive()
                other.send(b"z" * 100, full=Full.DROP)
        except (XmDamagedError, XmDestroyedError):
            pass
        other.close()
    copy.unlink()


class Model:
    """What a queue should do, in a list."""

    def __init__(self, policy: Policy, messages: int, blocks: int, block: int) -> None:
        self.policy, self.most, self.blocks, self.block = (
            policy,
            messages,
            blocks,
            block,
        )
        self.held: list[tuple[bytes, int, int]] = []
        self.n = 0

    def fits(self, size: int) -> bool:
        used = sum(-(-len(data) // self.block) for data, _, _ in self.held)
        need = -(-size // self.block)
        return len(self.held) < self.most and used + need <= self.blocks

    def send(self, data: bytes, priority: int, full: Full) -> bool:
        hpf = self.policy is Policy.HPF
        while full is Full.DROP_OLDEST and self.held and not self.fits(len(data)):
            self.held.remove(min(self.held, key=lambda m: (m[1] if hpf else 0, m[2])))
        if not self.fits(len(data)):
            return False
        self.n += 1
        self.held.append((data, priority, self.n))
        return True

    def receive(self) -> bytes | None:
        if not self.held:
            return None
        keys = {
            Policy.FIFO: lambda m: m[2],
            Policy.LIFO: lambda m: -m[2],
            Policy.HPF: lambda m: (-m[1], m[2]),
        }
        first = min(self.held, key=keys[self.policy])
        self.held.remove(first)
        return first[0]


@pytest.mark.parametrize("policy", list(Policy))
def test_a_model_in_step(policy) -> None:
    queue = Queue.create("events", policy=policy, messages=6, blocks=12, block=16)
    model = Model(policy, 6, 12, 16)
    pick = random.Random(policy)
    for _ in range(5000):
        if pick.random() < 0.55:
            data = pick.randbytes(pick.randrange(90))
            priority = pick.randrange(-3, 4)
            full = pick.choice([Full.DROP, Full.DROP_OLDEST])
            assert queue.send(data, priority, full=full) == model.send(
                data, priority, full
            )
        else:
            assert queue.try_receive() == model.receive()
        assert len(queue) == len(model.held)
    queue.destroy()
