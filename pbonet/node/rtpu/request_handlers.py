"""Handlers of the requests to an RTPU: the SBS server (Stewart 1994, section 4.5).

`handle` takes a request as it came from the network and gives the packed answer; it
never raises. A request with the same client and id is executed once, however often it
comes: the answer is kept, here and not in the agent, so that it survives the agent.
Another request under the same id is refused.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections import OrderedDict
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from pbonet.errors import PbonetError, ProtocolError, Severity, StateError
from pbonet.node.wire import Answers, being_stopped, rtpu_messages
from pbonet.pbo import State
from pbonet.xm.net import codec, messages as m

from . import (
    create_task,
    module_inspection,
    parameter_requests,
    reconfig,
    record_request,
    signal_tasks,
)

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from .claims import Entry
    from .rtpu_state import Rtpu

KEPT_ANSWERS = 1000
LONGEST = 3600.0
"""Longest wait that a request may ask for, in seconds."""
LARGEST_LIST = 900_000
"""Bytes of events in one answer; the client continues from the last number it got."""
_LOOKING = m.Hello | m.Modules | m.Events
_UNCLAIMED = _LOOKING | m.Claim | m.Stop | m.Replaced
_READING = _LOOKING | m.Get

Masters = list[tuple[str, str]] | None
Result = tuple[object, list[str]]


class _Known(NamedTuple):
    """A request that came before."""

    op: str
    digest: bytes
    answer: asyncio.Task[bytes]


class RequestHandlers:
    """Carries out requests on one RTPU.

    Args:
        rtpu: What they are carried out on.
    """

    def __init__(self, rtpu: Rtpu) -> None:
        self._rtpu = rtpu
        rtpu.obey = partial(signal_tasks.obey, rtpu)
        self._inspecting = module_inspection.ModuleInspection(rtpu)
        self._codec = codec.Codec()
        self._pack = Answers(rtpu.name, self._report)
        self._answers: OrderedDict[tuple[str, str], _Known] = OrderedDict()
        self._masters: Masters = None
        self._orders: dict[str, asyncio.Event] = {}
        """Orders that are being carried out, by `Stop.stop_id`."""
        self._do: dict[type[m.Request], Callable[[Any], Awaitable[Result]]] = {
            m.Claim: self._claim,
            m.Release: self._release,
            m.CloseTable: self._close_table,
            m.Spawn: self._spawn,
            m.Gone: self._gone,
            m.Control: self._control,
            m.Successors: self._successors,
            m.Reconfig: self._reconfig,
            m.Standby: self._standby,
            m.Freq: self._freq,
            m.Get: self._get,
            m.Set: self._set,
            m.Rank: self._rank,
            m.Modules: self._modules,
            m.Stop: self._stop,
            m.Replaced: self._replaced,
            m.Flag: self._flag,
            m.Sigmask: self._sigmask,
            m.Job: self._job,
            m.Record: self._record,
            m.Events: self._events,
        }

    async def handle(self, data: bytes, masters: Masters = None) -> bytes:
        """Return the packed answer to a packed request."""
        try:
            request = self._codec.request(data)
        except PbonetError as error:
            return self._codec.pack(codec.refusal(error, data))
        if isinstance(request, _READING) or not request.id:
            return await self._carry_out(request, masters)
        key = (request.client, request.id)
        digest = hashlib.blake2b(self._codec.pack(request), digest_size=16).digest()
        known = self._answers.get(key)
        if known is None:
            answer = asyncio.create_task(self._carry_out(request, masters))
            known = _Known(request.__struct_config__.tag, digest, answer)  # type: ignore[arg-type]
            self._answers[key] = known
            self._forget_old()
        elif known.digest != digest:
            return self._pack.bad(request, self._another(request, known.op))
        return await asyncio.shield(known.answer)

    def _another(self, request: m.Request, before: str) -> ProtocolError:
        """Return the error for an id that was used by another request."""
        return ProtocolError(
            f"the id {request.id} of client {request.client} was used by another "
            "request",
            where=self._rtpu.name,
            expected=f"the same {before} again, or a new id",
            got=f"{request.__struct_config__.tag} with other contents",
            remedy="count ids up, and give each run of a program another client name",
        )

    def _forget_old(self) -> None:
        for key in list(self._answers)[: len(self._answers) - KEPT_ANSWERS]:
            if self._answers[key].answer.done():
                del self._answers[key]

    async def _carry_out(self, request: m.Request, masters: Masters) -> bytes:
        try:
            if isinstance(request, m.Claim):
                result, warnings = self._claim_knowing(request, masters)
            else:
                self._check(request)
                result, warnings = await self._do[type(request)](request)
            return self._pack.good(request, result, warnings)
        except Exception as error:  # noqa: BLE001 - the server outlives any request
            return self._pack.bad(request, error)

    def _report(self, text: str) -> None:
        self._rtpu.events.add(Severity.ERROR, "INTERNAL", text)

    def _check(self, request: m.Request) -> None:
        """Refuse what needs a claim and has none, and what comes during a stop."""
        if isinstance(request, m.Spawn | m.Control | m.Successors | m.Reconfig):
            _check_timeout(request.timeout)
        if isinstance(request, _UNCLAIMED):
            return
        if isinstance(request, m.Freq | m.Get) and getattr(request, "hz", None) is None:
            return
        if isinstance(request, m.Sigmask | m.Job) and not request.changes:
            return
        self._rtpu.claims.check(request)
        self._rtpu.owned_constants.note_master(request.subsystem)
        if request.subsystem in self._rtpu.stopping:
            raise being_stopped(self._rtpu.name, request.subsystem)

    # -- claims and tables -------------------------------------------------------------

    def _claim_knowing(self, request: m.Claim, masters: Masters) -> Result:
        rtpu = self._rtpu
        holder = rtpu.claims.holder(request, masters)
        before = rtpu.claims.get(request.subsystem)
        if request.probe:
            rtpu.claims.judge(request, masters=masters, busy=rtpu.busy())
            if request.svar:
                rtpu.tables.judge(request)
            return self._claimed(request.subsystem, before, holder), []
        entry = rtpu.claims.claim(request, masters=masters, busy=rtpu.busy())
        self._close_orphaned_tables()
        if request.svar:
            try:
                rtpu.tables.open(request)
            except BaseException:
                rtpu.claims.restore(request.subsystem, before)
                raise
        rtpu.rank()
        rtpu.publish_claims()
        claimed = self._claimed(request.subsystem, entry, holder)
        if before is None or before.epoch != entry.epoch:
            self._announce(entry, claimed)
        return claimed, []

    def _announce(self, entry: Entry, claimed: m.Claimed) -> None:
        """Report a claim; all masters on the RTPU learn of one that was taken over."""
        text = f"{entry.usage} use by master {entry.client}, epoch {entry.epoch}"
        self._rtpu.events.add(Severity.INFO, "CLAIM", text, subsystem=entry.subsystem)
        if claimed.taken_from:
            on = " ".join(claimed.critical) or "none"
            self._rtpu.events.add(
                Severity.WARNING,
                "TAKEN_OVER",
                f"master {entry.client} took subsystem {entry.subsystem} over from "
                f"master {claimed.taken_from}, which lives; CRITICAL tasks ON: {on}",
            )

    def _claimed(self, subsystem: str, entry: Entry | None, holder: str) -> m.Claimed:
        tasks = self._rtpu.of(subsystem)
        return m.Claimed(
            epoch=entry.epoch if entry is not None else 0,
            tasks=[task.name for task in tasks],
            critical=[
                task.name
                for task in tasks
                if task.facts.rmod.critical and task.state is State.ON
            ],
            taken_from=holder,
            rmods={task.name: task.facts.text for task in tasks},
            modules={task.name: task.ready.info for task in tasks if task.ready},
        )

    def _close_orphaned_tables(self) -> None:
        """Let go of the tables of subsystems whose claim has lapsed."""
        claimed = self._rtpu.claims.epochs()
        for subsystem in self._rtpu.tables.subsystems():
            if subsystem not in claimed:
                self._rtpu.tables.close(subsystem)
                record_request.end(self._rtpu, subsystem)

    async def _claim(self, request: m.Claim) -> Result:
        return self._claim_knowing(request, None)

    async def _release(self, request: m.Release) -> Result:
        self._must_be_idle(request.subsystem, "given back")
        self._rtpu.forget(request.subsystem)
        self._rtpu.signals.forget(request.subsystem)
        self._rtpu.events.forget(request.subsystem)
        self._rtpu.tables.close(request.subsystem)
        self._rtpu.claims.release(request.subsystem)
        record_request.end(self._rtpu, request.subsystem)
        self._rtpu.publish_claims()
        self._rtpu.events.add(
            Severity.INFO,
            "RELEASE",
            f"released by {request.client}",
            subsystem=request.subsystem,
        )
        return None, []

    def _must_be_idle(self, subsystem: str, what: str) -> None:
        names = [task.name for task in self._rtpu.of(subsystem)]
        if names:
            raise StateError(
                f"cannot be {what} while the subsystem has tasks here",
                where=f"{self._rtpu.name}/{subsystem}",
                got="tasks " + " ".join(names),
                remedy="kill them first, or stop the subsystem",
            )

    async def _close_table(self, request: m.CloseTable) -> Result:
        self._must_be_idle(request.subsystem, "closed")
        self._rtpu.tables.close(request.subsystem)
        return None, []

    async def _flag(self, request: m.Flag) -> Result:
        rtpu, subsystem = self._rtpu, request.subsystem
        rtpu.tables.need(subsystem)
        if request.up:
            rtpu.flags.master_found(subsystem, request.cause, request.unwritten)
        else:
            rtpu.flags.master_mended(subsystem, request.cause)
        return rtpu.tables.causes(subsystem), []

    async def _record(self, request: m.Record) -> Result:
        return record_request.begin(self._rtpu, request), []

    async def _sigmask(self, request: m.Sigmask) -> Result:
        rtpu, subsystem = self._rtpu, request.subsystem
        if request.changes:
            if request.task:
                rtpu.need(subsystem, request.task)
            names = None if request.unset else request.names
            rtpu.signals.mask(subsystem, request.task, names)
            for task in rtpu.of(subsystem):
                rtpu.signals.apply(rtpu.core, task)
        return rtpu.signals.masks(subsystem), []

    async def _job(self, request: m.Job) -> Result:
        claims = self._rtpu.claims
        if request.changes:
            claims.stand(request.subsystem, request.told)
        if request.told is not None and request.note:
            self._rtpu.events.add(
                Severity.INFO,
                "STEP",
                f"job {request.told.name} is entered: {request.note}",
                subsystem=request.subsystem,
            )
        entry = claims.get(request.subsystem)
        return [entry.job] if entry and entry.job else [], []

    # -- tasks -------------------------------------------------------------------------

    async def _spawn(self, request: m.Spawn) -> Result:
        task = await create_task.spawn(self._rtpu, request)
        self._rtpu.owned_constants.took_over(task, request.replaces)
        notes = task.ready.notes if task.ready and self._rtpu.locks_memory else []
        return self._rtpu.status_of(task), list(notes)

    async def _gone(self, request: m.Gone) -> Result:
        return create_task.gone(self._rtpu, request), []

    async def _control(self, request: m.Control) -> Result:
        rtpu = self._rtpu
        tomb = rtpu.tombs.get((request.subsystem, request.task))
        if tomb is not None and request.signal == "kill":
            rtpu.bury(request.subsystem, request.task)
            return tomb, []
        task = rtpu.need(request.subsystem, request.task)
        warnings = await signal_tasks.control(
            rtpu,
            task,
            request.signal,
            request.timeout,
            arg=request.arg,
            replaces=request.replaces,
            extra=m.MOST_EXTRA * request.timeout,
        )
        if request.signal == "kill":
            return task.last_status, warnings
        if request.replaces:
            rtpu.owned_constants.took_over(task, request.replaces)
        return rtpu.status_of(task), warnings

    async def _reconfig(self, request: m.Reconfig) -> Result:
        return await reconfig.reconfigure(self._rtpu, request), []

    async def _successors(self, request: m.Successors) -> Result:
        successors, subsystem = self._rtpu.successors, request.subsystem
        return await successors.expect(
            subsystem, request.after, request.timeout, far=request.far
        ), []

    async def _standby(self, request: m.Standby) -> Result:
        rtpu = self._rtpu
        await rtpu.fallbacks.pair(
            request.subsystem,
            request.task,
            request.original,
            rtpu=request.rtpu,
            takeover=request.takeover,
            ready=request.ready,
        )
        return rtpu.status_of(rtpu.need(request.subsystem, request.task)), []

    async def _freq(self, request: m.Freq) -> Result:
        task = self._rtpu.need(request.subsystem, request.task)
        if request.hz is not None:
            await parameter_requests.set_freq(self._rtpu, task, request.hz)
        return task.freq, []

    async def _get(self, request: m.Get) -> Result:
        task = self._rtpu.need(request.subsystem, request.task)
        return await parameter_requests.get(task, request.name), []

    async def _set(self, request: m.Set) -> Result:
        task = self._rtpu.need(request.subsystem, request.task)
        return await parameter_requests.set_(
            self._rtpu, task, request.name, request.value
        ), []

    async def _rank(self, request: m.Rank) -> Result:
        whose, tombs = request.subsystem, self._rtpu.tombs
        # One that died since the master read the list is no fault of the others.
        ranks = {n: r for n, r in request.tasks.items() if (whose, n) not in tombs}
        for name in ranks:
            self._rtpu.need(whose, name)
        for name, (crit, priority) in ranks.items():
            create_task.check_rank(crit, priority, name)
            self._rtpu.told[whose, name] = (crit, priority)
        self._rtpu.rank()
        return None, []

    async def _stop(self, request: m.Stop) -> Result:
        return await self._once(request.stop_id, partial(self._end_all, request)), []

    async def _replaced(self, request: m.Replaced) -> Result:
        return await self._once(request.stop_id, partial(self._turn_off, request)), []

    async def _once(
        self, order: str, do: Callable[[], Awaitable[m.Stopped]]
    ) -> m.Stopped:
        """Carry out an order once; a repetition is answered when that is done."""
        while (running := self._orders.get(order)) is not None:
            await running.wait()
        if order in self._rtpu.stops:
            return m.Stopped(off=[], killed=[])
        done = asyncio.Event()
        if order:
            self._orders[order] = done
        try:
            stopped = await do()
            if order:
                self._rtpu.stops.append(order)
        finally:
            self._orders.pop(order, None)
            done.set()
        self._rtpu.publish_claims()
        return stopped

    async def _end_all(self, request: m.Stop) -> m.Stopped:
        names = [request.subsystem] if request.subsystem else sorted(self._rtpu.busy())
        limit = request.timeout if 0 <= request.timeout <= LONGEST else LONGEST
        stopped = await signal_tasks.stop(self._rtpu, names, limit, request.order)
        for name in names:
            self._rtpu.claims.stand(name, None)
        return stopped

    async def _turn_off(self, request: m.Replaced) -> m.Stopped:
        rtpu = self._rtpu
        names = request.tasks.get(rtpu.name, [])
        tasks = [one for one in rtpu.of(request.subsystem) if one.name in names]
        return await signal_tasks.replaced(rtpu, tasks, request.timeout)

    # -- the rest ----------------------------------------------------------------------

    async def _modules(self, request: m.Modules) -> Result:
        return await self._inspecting.modules(request.name)

    async def _events(self, request: m.Events) -> Result:
        chosen: list[m.Event] = []
        size = 0
        for event in self._rtpu.events.since(request.since):
            size += len(rtpu_messages.encode(event))
            if size > LARGEST_LIST:
                break
            chosen.append(event)
        return chosen, []


def _check_timeout(timeout: float) -> None:
    """Refuse an invalid time limit.

    Raises:
        ProtocolError: It is negative, too long, or no number.
    """
    if not 0 <= timeout <= LONGEST:
        raise ProtocolError(
            "this is not a valid time limit",
            expected=f"0 to {LONGEST:g} s",
            got=f"{timeout:g}",
            remedy="give one within these",
        )
