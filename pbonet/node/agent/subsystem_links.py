"""Links between subsystems on different machines (Stewart 1994, section 5.6).

An agent serves the links of its domain that exist on its machine. Users of a link need
not register: locks on the buffer's file show which users exist, and are released when
one is killed. `link_rules` decides what to do, and this file does it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from typing import TYPE_CHECKING

import zenoh

from pbonet.errors import PbonetError, Severity, XmError
from pbonet.node.wire import rtpu_messages
from pbonet.tbuf import CARER, READER, WRITER, Buffer, places
from pbonet.xm.ipc import names
from pbonet.xm.net import direct, key_expressions

from .link_ends import Receiver, Sender
from .link_rules import IDLE, LinkDuty, LocalUsers, RemoteUsers, duty

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.node.wire import Clock

log = logging.getLogger("pbonet.node")

LOOK = 0.1
"""Seconds between checks of the links that are served."""
SELDOM = 10.0
"""The same without links: a new one wakes the agent, unless the folder was replaced."""
YIELD = 1.0
"""Seconds until a link that another agent serves is tried again."""


class ServedLink:
    """One link that this agent serves."""

    def __init__(self, name: names.Name) -> None:
        self.name = name
        self.buffer = Buffer()
        places.attach(name, None, CARER, self.buffer)
        self.duty = IDLE
        self.sender: Sender | None = None
        self.receiver: Receiver | None = None
        self.tokens: dict[str, zenoh.LivelinessToken] = {}

    @property
    def here(self) -> LocalUsers:
        """Users of the link on this machine, without this agent."""
        return LocalUsers(
            writer=self.receiver is None and places.has(self.buffer.fileno, WRITER),
            reader=self.sender is None and places.has(self.buffer.fileno, READER),
        )

    @property
    def gone(self) -> bool:
        """Whether the buffer was destroyed, or its file removed."""
        return self.buffer.destroyed or not os.fstat(self.buffer.fileno).st_nlink


class Links:
    """An agent's part in all links of its domain.

    Args:
        session: The agent's session.
        domain: Its domain.
        name: Its name.
        clock: Returns the clock of an agent's machine; None if unknown.
        tell: Called with reports for masters.
        refuses: Returns whether records from an agent's machine are not used.
        need: Called with an agent whose clock is needed from now on.
    """

    def __init__(
        self,
        session: zenoh.Session,
        domain: str,
        name: str,
        clock: Callable[[str], Clock | None],
        tell: Callable[[rtpu_messages.Note], None],
        *,
        refuses: Callable[[str], bool],
        need: Callable[[str], None] = lambda _name: None,
    ) -> None:
        self._session = session
        self._domain = domain
        self._name = name
        self._clock, self._refuses, self._need = clock, refuses, need
        self._partners: set[str] = set()
        self._tell = tell
        self._standing = places.StandingLinks(domain)
        self._cares: dict[str, ServedLink] = {}
        self._later: dict[str, float] = {}
        self._there: dict[str, RemoteUsers] = {}
        self._guard = threading.Lock()
        self._folder = places.waiting()
        self._over = self._closed = False
        self._subscriber = session.liveliness().declare_subscriber(
            key_expressions.all_links(domain),
            direct(self._on_token),
            history=True,
        )
        self._thread = threading.Thread(
            target=self._work, name="pbonet links", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Stop serving links; unused files are removed."""
        self._over = True
        self._folder.wake()
        self._thread.join()
        with contextlib.suppress(zenoh.ZError):
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        with self._guard:
            self._closed = True
            self._folder.close()
        for text in list(self._cares):
            self._drop(text)
        places.sweep(self._domain)

    def partners(self) -> set[str]:
        """Return the agents at the other ends of the links that this one serves."""
        return self._partners

    # -- declarations of other agents --------------------------------------------------

    def _on_token(self, sample: zenoh.Sample) -> None:
        """Record that a token appeared or disappeared; runs in zenoh's own thread."""
        parts = key_expressions.link_parts(str(sample.key_expr))
        if parts is None:
            return
        text, leaf, agents = parts
        came = sample.kind == zenoh.SampleKind.PUT
        with self._guard:
            there = self._there.setdefault(text, RemoteUsers())
            if leaf == "sink" and len(agents) == 1:
                change = there.sinks.add if came else there.sinks.discard
                change(agents[0])
            elif leaf == "source" and len(agents) == len(("writer", "reader")):
                pair = agents[0], agents[1]
                (there.sources.add if came else there.sources.discard)(pair)
            if not there.sinks and not there.sources:
                del self._there[text]
            if not self._closed:
                self._folder.wake()

    def _elsewhere(self, text: str) -> RemoteUsers:
        with self._guard:
            found = self._there.get(text, RemoteUsers())
            return RemoteUsers(set(found.sinks), set(found.sources))

    # -- actions -----------------------------------------------------------------------

    def _work(self) -> None:
        while not self._over:
            pause = LOOK
            try:
                self._scan()
                pause = self._pause()
            except OSError:  # for example if the shared memory folder is removed
                log.exception("%s: links cannot be served", self._name)
            self._folder.wait(pause)

    def _pause(self) -> float:
        """Return the seconds until the next check, if nothing happens before."""
        busy = self._cares or self._later or not self._folder.hears
        return LOOK if busy else SELDOM

    def _scan(self) -> None:
        standing = self._standing.names()
        for text in self._later.keys() - set(standing):
            del self._later[text]
        for text in standing:
            if text not in self._cares:
                self._adopt(text)
        for text, care in list(self._cares.items()):
            try:
                self._tend(text, care, stands=text in standing)
            except Exception:  # the other links must still be served
                log.exception("%s: link %s cannot be served", self._name, text)

    def _tend(self, text: str, care: ServedLink, *, stands: bool) -> None:
        """Serve one link."""
        here = care.here
        unused = not here.writer and not here.reader and care.duty == IDLE
        if not stands or care.gone or unused:
            self._drop(text)
            return
        wanted = duty(self._name, here, self._elsewhere(text), care.duty)
        if care.sender is not None and not care.sender.works:
            wanted = IDLE  # and again at the next check
        if wanted != care.duty:
            self._change(care, wanted)

    def _adopt(self, text: str) -> None:
        """Serve a link, unless another agent of this machine does."""
        if time.monotonic() < self._later.get(text, 0.0):
            return
        place, _, resource = text.partition(":")
        try:
            self._cares[text] = ServedLink(names.Name(self._domain, place, resource))
            self._later.pop(text, None)
        except XmError as error:
            self._later[text] = time.monotonic() + YIELD
            log.debug("%s: link %s is not served: %s", self._name, text, error)

    def _drop(self, text: str) -> None:
        care = self._cares.pop(text)
        self._change(care, IDLE)
        places.leave(care.buffer)

    def _change(self, care: ServedLink, wanted: LinkDuty) -> None:
        """Change to another duty; what fails now is tried again later."""
        if care.receiver is not None and care.duty.take != wanted.take:
            care.receiver.stop()
            care.receiver = None
        if care.sender is not None and care.duty.serve != wanted.serve:
            care.sender.stop()
            care.sender = None
        try:
            self._begin(care, wanted)
        except (XmError, zenoh.ZError) as error:
            log.debug("%s: link %s: %s", self._name, care.name, error)
            wanted = LinkDuty(sink=wanted.sink)
        self._show(care, wanted)
        care.duty, before = wanted, care.duty
        duties = [one.duty for one in self._cares.values()]
        self._partners = {far for d in duties for far in (d.take, d.serve) if far}
        if wanted.take and wanted.take != before.take:
            self._need(wanted.take)
        if (wanted.take, wanted.serve) != (before.take, before.serve):
            self._report(care.name, wanted, before)

    def _begin(self, care: ServedLink, wanted: LinkDuty) -> None:
        me, name = self._name, care.name
        if wanted.serve and care.sender is None:
            key = key_expressions.link(
                self._domain, str(name), "data", me, wanted.serve
            )
            who = f"agent {me} for {wanted.serve}"
            care.sender = Sender(self._session, name, key, who)
        if wanted.take and care.receiver is None:
            far = wanted.take
            key = key_expressions.link(self._domain, str(name), "data", far, me)
            care.receiver = Receiver(
                self._session,
                name,
                key,
                who=f"agent {me} from {far}",
                clock=lambda: self._clock(far),
                refuses=lambda: self._refuses(far),
                misfit=lambda error: self._misfit(name, error),
            )

    def _show(self, care: ServedLink, wanted: LinkDuty) -> None:
        """Declare the tokens of a duty, and no others."""
        text, shown = str(care.name), set[str]()
        if wanted.sink:
            shown.add(key_expressions.link(self._domain, text, "sink", self._name))
        if wanted.serve:
            shown.add(
                key_expressions.link(
                    self._domain, text, "source", self._name, wanted.serve
                )
            )
        for key in set(care.tokens) - shown:
            with contextlib.suppress(zenoh.ZError):
                care.tokens.pop(key).undeclare()  # type: ignore[no-untyped-call]
        for key in shown - set(care.tokens):
            care.tokens[key] = self._session.liveliness().declare_token(key)

    # -- reports -----------------------------------------------------------------------

    def _report(self, name: names.Name, wanted: LinkDuty, before: LinkDuty) -> None:
        if wanted.take or wanted.serve:
            text = f"link {name} {_way(wanted)} is up"
            self._note(rtpu_messages.Note(int(Severity.INFO), "LINK_UP", text))
        else:
            text = f"link {name} {_way(before)} is down"
            self._note(rtpu_messages.Note(int(Severity.WARNING), "LINK_DOWN", text))

    def _misfit(self, name: names.Name, error: Exception) -> None:
        text = f"records of link {name} are refused: {error}"
        self._note(rtpu_messages.Note(int(Severity.ERROR), "LINK_MISFIT", text))

    def _note(self, note: rtpu_messages.Note) -> None:
        log.info("%s: %s", self._name, note.text)
        with contextlib.suppress(PbonetError):
            self._tell(note)


def _way(done: LinkDuty) -> str:
    return f"from {done.take}" if done.take else f"to {done.serve}"
