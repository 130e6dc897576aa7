"""Semaphores, queues and mailboxes of all machines, for verbs (Stewart 1994, 5.3, 5.4).

A verb is a process for a moment: what it holds when it ends counts as held by a process
that died. So a binary semaphore is held only while a command runs.
"""

from __future__ import annotations

import os
import subprocess
import time
from contextlib import closing
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet import xm
from pbonet.errors import (
    PbonetError,
    UnreachableError,
    XmError,
    XmExistsError,
    XmLayoutError,
    XmMissingError,
    XmNameError,
    XmQueueFullError,
    did_you_mean,
)
from pbonet.xm.ipc import mailboxes, names, overview, remote_channel
from pbonet.xm.net import resource_messages as r

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

ANSWER_TIME = 2.0
"""Seconds in which an agent lists its resources."""


class Listed(Struct, frozen=True, kw_only=True):
    """A resource, as it is listed."""

    name: str
    """``RTPU:NAME``."""
    settings: dict[str, int]
    value: int | None
    """Value of a semaphore; messages or interrupts that wait; None: not readable."""
    waiting: int
    """Threads that wait for it."""
    holder: int | None
    """Process that holds a binary semaphore, or handles a mailbox."""
    sent: int
    dropped: int
    """Messages dropped, or interrupts refused, for lack of room."""
    error: str


class Message(Struct, frozen=True, kw_only=True):
    """A message that was received."""

    priority: int
    hex: str
    text: str | None
    """None: it is no text."""


def settle_in(domain: str, connect: Sequence[str]) -> None:
    """Have names of resources be those of a domain.

    Args:
        domain: The domain.
        connect: Endpoints of agents on other machines.
    """
    xm.live_on(names.NOWHERE, domain=domain)
    if connect:
        os.environ[remote_channel.CONNECT] = " ".join(connect)


# -- lists ----------------------------------------------------------------------------


def listed(kind: str, rtpus: Sequence[str] = ()) -> tuple[list[Listed], list[str]]:
    """Return the resources of a kind, and warnings of RTPUs that did not answer.

    Args:
        kind: ``sem``, ``queue`` or ``mailbox``.
        rtpus: The RTPUs; all, and programs of this machine, if none is named.

    Raises:
        UnreachableError: An RTPU that is named is not there.
        NoAnswerError: It does not answer.
    """
    domain = names.home().domain
    here = {names.NOWHERE, *names.rtpus(domain)}
    away = _others(here, named=bool(set(rtpus) - here))
    _must_be_there(rtpus, here | away)
    found: list[Listed] = []
    warnings: list[str] = []
    for rtpu in sorted(rtpus or here | away):
        try:
            found += [_listed(rtpu, one) for one in _resources(rtpu, kind, here)]
        except PbonetError as error:
            if rtpus:
                raise
            warnings.append(str(error))
    return found, warnings


def _others(here: set[str], *, named: bool) -> set[str]:
    """Return the RTPUs of other machines; none if no agent is reached and none asked.

    Raises:
        UnreachableError: One was named, and no agent can be reached.
    """
    try:
        return {*remote_channel.carrier().rtpus()} - here
    except UnreachableError:
        if named or os.environ.get(remote_channel.CONNECT):
            raise
        return set()


def _must_be_there(wanted: Sequence[str], known: set[str]) -> None:
    for rtpu in wanted:
        if rtpu not in known:
            raise UnreachableError(
                f"there is no RTPU {rtpu}",
                where=f"domain {names.home().domain}",
                got=", ".join(sorted(known)),
                remedy=did_you_mean(rtpu, known) or "start its agent",
            )


def _resources(rtpu: str, kind: str, here: set[str]) -> list[r.Resource]:
    if rtpu in here:
        return overview.resources(names.home().domain, rtpu, kind)
    request = r.Overview(kind=kind)
    carrier = remote_channel.carrier()
    return carrier.call(rtpu, request, list[r.Resource], timeout=ANSWER_TIME)


def _listed(rtpu: str, one: r.Resource) -> Listed:
    seen = one.seen or r.Seen(waiting=0)
    return Listed(
        name=f"{rtpu}:{one.name}",
        settings=one.settings,
        value=seen.value if one.seen else None,
        waiting=seen.waiting,
        holder=seen.holder,
        sent=seen.sent,
        dropped=seen.dropped,
        error=one.error,
    )


# -- semaphores -----------------------------------------------------------------------


def make_semaphore(
    name: str, *, initial: int, maximum: int | None, binary: bool
) -> None:
    """Make a semaphore, which stays when this process has ended.

    Raises:
        XmExistsError: There is one of this name.
        XmError: It cannot be made.
    """
    _must_be_new(xm.Semaphore.attach, name, "sem")
    _in_range(
        lambda: xm.Semaphore.create(
            name, initial=initial, maximum=maximum, binary=binary
        ).close(),
        name,
    )


def give(name: str) -> int:
    """Give one unit of a semaphore (V); return its value after that.

    Raises:
        XmError: It is at its maximum already, or cannot be used.
    """
    with closing(xm.Semaphore.attach(name)) as semaphore:
        if not semaphore.v():
            raise XmError(
                "the semaphore is at its maximum",
                where=name,
                expected=f"a value below {semaphore.maximum}",
                got=str(semaphore.value),
                remedy="take one first: pbonet sem get",
            )
        return semaphore.value


def take(
    name: str, *, wait: float, priority: int = 0, run: str = ""
) -> tuple[xm.Taken, int]:
    """Take one unit of a semaphore (P).

    Args:
        name: The semaphore.
        wait: Seconds to wait for it.
        priority: Higher ones are served first.
        run: A command line of the shell; it is given back when the command has ended.

    Returns:
        What P returned, and the command's exit status.

    Raises:
        XmError: It did not get one in that time; it is binary, and no command is run;
            or it cannot be used.
    """
    with closing(xm.Semaphore.attach(name)) as semaphore:
        if semaphore.binary and not run:
            raise XmError(
                "a binary semaphore cannot be taken by a verb that ends at once",
                where=name,
                expected="a process that holds it",
                remedy="run a command that holds it: --run 'COMMAND'",
            )
        taken = semaphore.p(_until(wait), priority=priority)
        if not taken:
            holder = (
                f"; process {semaphore.holder} holds it" if semaphore.holder else ""
            )
            raise XmError(
                f"the semaphore was not free within {wait:g} s",
                where=name,
                got=f"value {semaphore.value}, {semaphore.waiting} others wait{holder}",
                remedy="wait longer with --wait",
            )
        if not run:
            return taken, 0
        try:
            return taken, _status(run)
        finally:
            semaphore.v()


def _status(command: str) -> int:
    """Run a command line; return its exit status, as a shell gives it.

    Ctrl-C goes to the command too, which may take time to end; until then it is held.
    """
    with subprocess.Popen(command, shell=True) as process:  # noqa: S602 - the user's
        while True:
            try:
                status = process.wait()
            except KeyboardInterrupt:
                continue
            return status if status >= 0 else _KILLED - status


_KILLED = 128
"""Exit status of a command that a signal ended, less the signal."""


# -- queues ---------------------------------------------------------------------------


def make_queue(
    name: str, *, policy: str, messages: int, block: int, blocks: int | None
) -> None:
    """Make a queue, which stays when this process has ended.

    Raises:
        XmExistsError: There is one of this name.
        XmError: It cannot be made.
    """
    _must_be_new(xm.Queue.attach, name, "queue")
    _in_range(
        lambda: xm.Queue.create(
            name,
            policy=xm.Policy[policy.upper()],
            messages=messages,
            block=block,
            blocks=blocks,
        ).close(),
        name,
    )


def send(
    name: str,
    data: bytes,
    *,
    priority: int = 0,
    wait: float = 0.0,
    full: str = "refuse",
) -> bool:
    """Send a message to a queue; return whether it was put there.

    Args:
        name: The queue.
        data: The message.
        priority: Of the message.
        wait: Seconds to wait for room.
        full: ``refuse``, ``drop`` or ``drop-oldest``, if there is none then.

    Raises:
        XmQueueFullError: There is no room, and `full` is ``refuse``.
        XmError: The queue is missing, or the message is too long.
    """
    with closing(xm.Queue.attach(name)) as queue:
        try:
            return queue.send(
                data,
                priority,
                full=xm.Full[full.replace("-", "_").upper()],
                until_ns=_until(wait),
            )
        except XmQueueFullError as error:
            error.remedy = "wait for room with --wait, or say what to drop with --full"
            raise


def receive(
    name: str, *, wait: float, count: int = 1, priority: int = 0
) -> list[tuple[bytes, int]]:
    """Receive messages, each with its priority.

    Args:
        name: The queue.
        wait: Seconds to wait for the first one; the others must be there.
        count: The most that are received.
        priority: Of this receiver among those that wait.

    Raises:
        XmError: None came in that time, or the queue is missing.
    """
    found: list[tuple[bytes, int]] = []
    with closing(xm.Queue.attach(name)) as queue:
        while len(found) < count:
            until = 0 if found else _until(wait)
            letter = queue.letter(until, priority=priority)
            if letter is None:
                break
            found.append(letter)
    if not found:
        raise _nothing_came("message", name, wait)
    return found


def message(data: bytes, priority: int) -> Message:
    """Return a message as data."""
    try:
        found = data.decode()
    except UnicodeDecodeError:
        found = "\0"
    plain = found.replace("\n", "").replace("\t", "")
    text = found if plain.isprintable() else None
    return Message(priority=priority, hex=data.hex(), text=text)


def remove(name: str, kind: str) -> None:
    """Destroy a resource; its users and waiters get an error.

    Raises:
        XmMissingError: There is none of that name.
        XmError: It cannot be used.
    """
    if kind == "sem":
        xm.Semaphore.attach(name).destroy()
        return
    if kind == "queue":
        xm.Queue.attach(name).destroy()
        return
    box = names.parse(name)
    inner = f"{box.rtpu}:{mailboxes.PREFIX}{box.resource}"
    try:
        queue = xm.Queue.attach(inner)
    except XmMissingError:
        raise XmMissingError(
            "no mailbox of this name is installed",
            where=str(box),
            remedy="'pbonet mailbox ls' shows those that there are",
        ) from None
    queue.destroy()
    xm.Semaphore.attach(inner).destroy()


# -- mailboxes ------------------------------------------------------------------------


def handle(name: str, *, wait: float, count: int = 1) -> list[int]:
    """Take interrupts from a mailbox of this machine, as its handler for a moment.

    Args:
        name: The mailbox; it is installed if there is none.
        wait: Seconds to wait for the first one; the others must be there.
        count: The most that are taken.

    Raises:
        XmTakenError: It has a handler.
        XmNameError: It is on another machine.
        XmError: None came in that time.
    """
    found: list[int] = []
    with closing(_mailbox(name)) as box:
        while len(found) < count:
            value = box.take(0 if found else _until(wait))
            if value is None:
                break
            found.append(value)
    if not found:
        raise _nothing_came("interrupt", name, wait)
    return found


def _mailbox(name: str) -> xm.Mailbox:
    try:
        return xm.Mailbox(name)
    except XmNameError as error:
        error.remedy = "run this verb on that machine"
        raise


def interrupt(name: str, value: int) -> None:
    """Send an interrupt to a mailbox on any machine.

    Raises:
        XmMissingError: The mailbox is not installed.
        XmQueueFullError: It is full.
        XmError: The value does not fit into 64 bits.
    """
    _in_range(lambda: xm.interrupt(name, value), name)


# -- parts of them --------------------------------------------------------------------


def _until(wait: float) -> int:
    """Return the end of a wait in nanoseconds of CLOCK_MONOTONIC."""
    return time.monotonic_ns() + round(wait * 1e9) if wait > 0 else 0


def _nothing_came(what: str, name: str, wait: float) -> XmError:
    within = f" within {wait:g} s" if wait else ""
    return XmError(
        f"no {what} came{within}",
        where=name,
        expected=f"at least one {what}",
        remedy="wait longer with --wait",
    )


def _must_be_new(
    attach: Callable[[str], xm.Semaphore | xm.Queue], name: str, verb: str
) -> None:
    """Check that there is no resource of a name: a new one would take its place.

    Raises:
        XmExistsError: There is one.
    """
    try:
        attach(name).close()
    except (XmMissingError, XmLayoutError):  # what cannot be read is replaced
        return
    raise XmExistsError(
        "there is one of this name already",
        where=name,
        expected="a name that is free",
        remedy=f"remove it with 'pbonet {verb} rm {name}', or take another name",
    )


def _in_range(make: Callable[[], None], name: str) -> None:
    """Have a size that is out of range be an error of four parts."""
    try:
        make()
    except (ValueError, OverflowError) as error:
        if isinstance(error, PbonetError):
            raise
        raise XmError(
            "a number is out of range",
            where=name,
            got=str(error),
            remedy="correct it",
        ) from None
