"""A process that dies at any step of an operation leaves semaphore and queue usable.

`xm_steps` is built from the same headers with a hook before and behind every store that
others can see; it kills itself at the step it is told. The other users are the
production build: this process, and children that wait.
"""

import subprocess
import time

import pytest
from svar_rig import build, wait_for
from xm_rig import HEADERS, LONG, Line

from pbonet.xm import Policy, Queue, Semaphore, Taken

SHORT, LONGER = b"s" * 10, b"l" * 2000
SENT = {"send": b"k" * 100, "drop": b"k" * 100, "long": b"k" * 3000}


@pytest.fixture(scope="module")
def steps(tmp_path_factory):
    target = tmp_path_factory.mktemp("steps") / "steps"
    return build("xm_steps.c", target, headers=HEADERS)


def soon() -> int:
    return time.monotonic_ns() + LONG


class Steps:
    """Does one thing again and again, killed one step later each time."""

    def __init__(self, program, shared, deed: str) -> None:
        self.command = [str(program), shared.path, deed]
        self.step = 0

    def __iter__(self):
        return self

    def __next__(self) -> subprocess.Popen:
        """Start the next; the test says when it may have ended, by calling `over`."""
        self.step += 1
        assert self.step < 1000
        return subprocess.Popen([*self.command, str(self.step)])

    def over(self, process: subprocess.Popen) -> bool:
        """Return whether it had fewer steps and so ended by itself."""
        code = process.wait(timeout=30)
        assert code in {0, -9}
        assert code or self.step > 2
        return code == 0


def each(steps, shared, deed: str):
    """Yield once behind each kill, and once behind the whole deed."""
    run = Steps(steps, shared, deed)
    for process in run:
        over = run.over(process)
        yield over
        if over:
            return


@pytest.mark.parametrize("deed", ["p", "wait"])
def test_a_p_killed_at_any_step_is_told_to_the_next(steps, deed):
    with_it = set()
    grip = Semaphore.create("grip", binary=True)
    for over in each(steps, grip, deed):
        taken = grip.p(soon())
        with_it.add(taken)
        assert taken or not over
        assert grip.v()
        assert (grip.value, grip.waiting, grip.holder) == (1, 0, None)
    assert with_it == {Taken.TAKEN, Taken.HOLDER_DIED}, "both sides were met"
    grip.destroy()


def test_a_waiter_killed_at_any_step_takes_no_wakeup_along(steps):
    items = Semaphore.create("items", initial=0)
    run = Steps(steps, items, "wait")
    taken = set()
    for process in run:
        wait_for(
            lambda: items.waiting or process.poll() is not None,  # noqa: B023
            "it to wait, or to be dead",
        )
        assert items.v()
        over = run.over(process)
        left = items.p(time.monotonic_ns() + 200_000_000)
        taken.add(left)
        assert not (over and left), "it had taken what it was called for"
        if over:
            break
    assert taken == {Taken.TAKEN, Taken.TIMED_OUT}
    assert (items.value, items.waiting) == (0, 0)
    items.destroy()


def test_a_v_killed_at_any_step_is_heard_or_was_not_made(steps):
    items = Semaphore.create("items", initial=0)
    heard = set()
    run = Steps(steps, items, "v")
    for count in range(1, 1000):
        line = Line(items)
        line.join(lambda: items.p(soon()), 1)
        over = run.over(next(run))
        wait_for(lambda: line.order or items.value == 0, "a wake-up that is not lost")  # noqa: B023
        heard.add(bool(line.order))
        if not line.order:
            items.v()
        assert line.after(1) == [1]
        assert line.end() == [0]
        while items.try_p():  # where the V came twice: the killed one's, and ours
            pass
        if over:
            break
        assert count < 999
    assert heard == {True, False}
    items.destroy()


@pytest.fixture(params=list(Policy), ids=lambda policy: policy.name)
def events(request):
    queue = Queue.create("events", policy=request.param, messages=4, blocks=200)
    yield queue
    queue.destroy()


def drain(queue: Queue) -> list[bytes]:
    """Take all there is, and see that nothing is missing then."""
    found = []
    while (message := queue.try_receive()) is not None:
        found.append(message)
    Queue.attach("events").close()  # who comes looks for what the dead had in hand
    assert queue.free == (queue.messages, queue.blocks)
    return found


@pytest.mark.parametrize("deed", SENT)
def test_a_send_killed_at_any_step_is_whole_or_not_at_all(steps, events, deed):
    before = [SHORT, LONGER]
    sides = set()
    if deed == "drop":
        before += [b"3", b"4"]
    for message in before:
        events.send(message)
    for over in each(steps, events, deed):
        found = drain(events)
        arrived = SENT[deed] in found
        sides.add(arrived)
        assert arrived or not over
        lost = set(before) - set(found)
        assert lost <= ({SHORT} if deed == "drop" else set())
        assert len(found) == arrived + len(before) - len(lost)
        for message in before:
            events.send(message)
    assert sides == {True, False}


@pytest.mark.parametrize("deed", ["receive", "fetch"])
def test_a_receive_killed_at_any_step_loses_the_message_in_hand_at_most(
    steps, events, deed
):
    sides = set()
    messages = [SHORT, LONGER, b"", b"4"]
    first = {Policy.LIFO: b"4"}.get(events.policy, SHORT)
    for message in messages:
        events.send(message)
    for over in each(steps, events, deed):
        lost = set(messages) - set(drain(events))
        sides.add(bool(lost))
        assert lost == {first} if over else lost <= {first}
        for message in messages:
            events.send(message)
    assert sides == {True, False}


@pytest.mark.parametrize("kind", [Semaphore, Queue])
def test_who_is_killed_while_it_attaches_leaves_no_member(steps, kind):
    shared = kind.create("events")
    for _ in each(steps, shared, "join"):
        for _again in range(3):
            kind.attach("events").close()
    others = []
    while len(others) < 127:  # all places but ours are free again
        others.append(kind.attach("events"))
    for other in others:
        other.close()
    shared.destroy()


def test_a_full_queue_is_looked_over_for_what_the_dead_had_in_hand(steps):
    queue = Queue.create("events", messages=2, blocks=100)
    free_again = 0
    for _ in each(steps, queue, "long"):
        while queue.try_receive() is not None:
            pass
        free_again += queue.free != (2, 100)
        assert queue.send(b"1")
        assert queue.send(b"2")
        assert queue.try_receive() == b"1"
        assert queue.try_receive() == b"2"
    assert free_again > 3, "it died with a message in hand"
    queue.destroy()
