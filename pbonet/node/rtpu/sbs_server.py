"""The SBS server of an RTPU: what its process does (Stewart 1994, section 4.5).

Its main thread waits for messages from the agent, the fork server and the tasks; a
native thread beside it, which never takes the interpreter's lock, dispatches. When the
agent is gone for longer than the grace, everything is turned OFF in order and the
process ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import faulthandler
import os
import signal
from typing import TYPE_CHECKING

import msgspec

from pbonet import tbuf
from pbonet.errors import DuplicateNameError, NodeError, Severity
from pbonet.node.wire import EventLog, core_trace, process_setup, rtpu_messages
from pbonet.svar import survive_cuts
from pbonet.xm import live_on, sweep
from pbonet.xm.net import run_folder

from . import agent_loss, cleanup, orphaned_rings, record_request, signal_tasks
from .fork_client import Server
from .network_queues import NetworkQueues
from .request_handlers import RequestHandlers
from .rtpu_snapshot import SnapshotPublisher
from .rtpu_state import Rtpu

if TYPE_CHECKING:
    import socket
    from collections.abc import Iterable

    from pbonet.xm.net import Event

END_TIME = 2.0
"""Seconds that turning everything OFF may take when the process ends."""


class AgentLink:
    """The listening socket: one agent may be connected, and other RTPUs give orders.

    Args:
        rtpu: The RTPU that the agent's requests are about.
        end: Called with a reason when the process must end.
    """

    def __init__(self, rtpu: Rtpu, end: asyncio.Future[str]) -> None:
        self._rtpu = rtpu
        self._end = end
        self._operations = RequestHandlers(rtpu)
        self._queues = NetworkQueues(rtpu.events)
        self._writer: asyncio.StreamWriter | None = None
        self._agent_pid = 0
        self._grace = rtpu.config.grace
        self._grace_timer: asyncio.TimerHandle | None = None
        self._published = 0
        self._snapshots = SnapshotPublisher(rtpu)
        self._silence = agent_loss.Silence(rtpu)
        self._outbox: list[bytes] = []
        self._due = False
        self.end_time = END_TIME
        self._server: asyncio.Server | None = None
        self._running: set[asyncio.Task[None]] = set()
        self._first: msgspec.msgpack.Decoder[rtpu_messages.ToRtpu] = (
            msgspec.msgpack.Decoder(rtpu_messages.ToRtpu)
        )
        self._decoder: msgspec.msgpack.Decoder[rtpu_messages.FromAgent] = (
            msgspec.msgpack.Decoder(rtpu_messages.FromAgent)
        )
        rtpu.events.publish = self._publish
        rtpu.claims_changed = lambda: self._send(rtpu.info())
        rtpu.call_far = lambda name, calls: self._send(
            rtpu_messages.Called(name, calls)
        )
        rtpu.changed = self._soon

    async def listen(self, places: run_folder.Places) -> None:
        """Listen on the runtime folder's socket, and wait for an agent at most grace.

        The agent that has started this process is waited for while it lives: it may
        still open its session.

        A file that exists there was left by a dead process: its lock is ours.
        """
        places.remove(places.ctl)
        self._server = await asyncio.start_unix_server(self._serve, places.ctl)
        places.ctl.chmod(0o600)
        self._start_grace()

    def refuse(self) -> None:
        """Accept no agent any more: this process ends, and another one is started."""
        if self._server is not None:
            self._server.close()

    async def close(self, reason: str) -> None:
        """Notify the agent that the process ends, and close."""
        self._queues.close()
        self._silence.close()
        if self._writer is not None:
            self._send(rtpu_messages.Ending(reason))
            self._flush()
            with contextlib.suppress(OSError, TimeoutError):
                async with asyncio.timeout(0.5):
                    await self._writer.drain()
            self._writer.close()

    async def _serve(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        try:
            first = self._first.decode(await rtpu_messages.read_frame(reader))
            if isinstance(first, rtpu_messages.Order):
                answer = await signal_tasks.obey_neighbour(self._rtpu, first)
                writer.write(rtpu_messages.frame(answer))
                await writer.drain()
                return
            taken = self._writer is not None or self._end.done()
            if not isinstance(first, rtpu_messages.Attach) or taken:
                writer.close()
                return
            self._attach(first, writer)
            while True:
                self._take(self._decoder.decode(await rtpu_messages.read_frame(reader)))
        except (OSError, asyncio.IncompleteReadError, msgspec.MsgspecError, NodeError):
            pass
        finally:
            writer.close()
            if writer is self._writer:
                self._detach()

    def _attach(
        self, hello: rtpu_messages.Attach, writer: asyncio.StreamWriter
    ) -> None:
        if self._grace_timer is not None:
            self._grace_timer.cancel()
            self._grace_timer = None
        self._grace = hello.grace
        back = self._agent_pid != 0
        self._agent_pid = self._rtpu.agent_pid = hello.agent_pid
        self._rtpu.save()
        self._writer = writer
        self._snapshots.forget()
        self._outbox.clear()
        writer.write(rtpu_messages.frame(self._rtpu.info()))
        self._soon()
        for event in self._rtpu.events.since(self._published + 1):
            self._publish(event)
        if back:
            agent_loss.back(self._rtpu)
            self._rtpu.events.add(
                Severity.INFO, "AGENT_BACK", f"agent {hello.agent_pid} took over"
            )

    def _detach(self) -> None:
        self._writer = None
        if self._end.done():
            return
        self._rtpu.agent_pid = 0
        self._rtpu.save()
        task = asyncio.create_task(agent_loss.give_up(self._rtpu))
        self._running.add(task)
        task.add_done_callback(self._running.discard)
        self._rtpu.events.add(
            Severity.WARNING,
            "AGENT_GONE",
            f"agent {self._agent_pid} is gone; control continues for {self._grace:g} s",
        )
        self._rtpu.later(agent_loss.forget_trace(), "trace")
        self._start_grace()

    def _start_grace(self) -> None:
        loop = asyncio.get_running_loop()
        self._grace_timer = loop.call_later(self._grace, self._end_grace)

    def _end_grace(self) -> None:
        if not self._agent_pid and os.getppid() == self._rtpu.config.agent:
            self._start_grace()
        else:
            self._finish(f"no agent for {self._grace:g} s")

    def _finish(self, reason: str) -> None:
        if not self._end.done():
            self._end.set_result(reason)

    def _take(self, message: rtpu_messages.FromAgent) -> None:
        match message:
            case rtpu_messages.Forward():
                task = asyncio.create_task(self._answer(message))
                self._running.add(task)
                task.add_done_callback(self._running.discard)
            case rtpu_messages.Note():
                self._rtpu.events.add(
                    Severity(message.severity),
                    message.code,
                    message.text,
                    subsystem=message.subsystem,
                    task=message.task,
                )
            case rtpu_messages.Recorder():
                record_request.keep_losses(self._rtpu, message)
            case rtpu_messages.Alive():
                self._silence.take(message.silences)
            case rtpu_messages.TakeOver():
                self._rtpu.later(
                    signal_tasks.take_over(self._rtpu, message), "takeover"
                )
            case rtpu_messages.Arrived():
                self._queues.put(message)
            case rtpu_messages.Shutdown():
                self.end_time = message.timeout
                self._finish("the agent was asked to end")
            case rtpu_messages.Attach():
                self._grace = message.grace

    async def _answer(self, message: rtpu_messages.Forward) -> None:
        data = await self._operations.handle(message.data, message.masters)
        self._send(rtpu_messages.Answered(message.n, data))

    def _publish(self, event: Event) -> None:
        if self._writer is not None:
            self._published = event.n
            self._send(rtpu_messages.Published(rtpu_messages.encode(event)))

    def _send(self, message: msgspec.Struct) -> None:
        self._outbox.append(rtpu_messages.frame(message))
        self._soon()

    def _soon(self) -> None:
        """Send after what the loop does now, so that nothing half done is reported."""
        if not self._due:
            self._due = True
            asyncio.get_running_loop().call_soon(self._flush)

    def _flush(self) -> None:
        """Send what has changed, then what may cause questions about it."""
        self._due = False
        out, self._outbox = self._outbox, []
        if self._writer is not None and not self._writer.is_closing():
            news = self._snapshots.news()
            self._writer.write(
                b"".join([rtpu_messages.framed(news) if news else b"", *out])
            )


async def run(config: rtpu_messages.RtpuConfig, forks: Server) -> int:
    """Run as the RTPU process until there is a reason to end.

    Args:
        config: The settings from the agent.
        forks: The fork server that was forked off before.
    """
    loop = asyncio.get_running_loop()
    end: asyncio.Future[str] = loop.create_future()

    def asked(which: signal.Signals) -> None:
        if not end.done():
            end.set_result(f"signal {which.name}")

    for which in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(which, asked, which)
    live_on(config.name, domain=config.domain)
    places = run_folder.Places(config.domain, config.name)
    lock = run_folder.NameLock(places.ctl_lock, f"pid {os.getpid()}")
    try:
        cleanup.clean(places)
        orphaned_rings.sweep(config.domain, config.name)
        rtpu = Rtpu(config, EventLog(config.name), places, forks)
        await _serve(rtpu, places, end)
    finally:
        lock.release()
    return 0


async def _serve(
    rtpu: Rtpu, places: run_folder.Places, end: asyncio.Future[str]
) -> None:
    try:
        await rtpu.start()
        link = AgentLink(rtpu, end)
        await link.listen(places)
        rtpu_messages.report_ready(rtpu.config.ready_fd)
        reason = await end
        link.refuse()
        rtpu.events.add(Severity.INFO, "ENDING", f"the RTPU process ends: {reason}")
        await signal_tasks.stop(rtpu, sorted(rtpu.busy()), link.end_time)
        await link.close(reason)
    finally:
        try:
            await rtpu.close()
        finally:
            clean_up(places, rtpu.agent_pid, rtpu.rings)


def clean_up(
    places: run_folder.Places, agent: int = 0, rings: Iterable[str] = ()
) -> None:
    """Remove all that is not needed any more; one failure does not prevent the rest.

    Args:
        places: The RTPU's files.
        agent: The process of its last agent; 0: it has ended.
        rings: Rings of tasks that were being created.
    """
    with contextlib.ExitStack() as last_first:
        if not process_setup.start_time(agent):
            last_first.callback(_remove_dead_agent, places)
        last_first.callback(places.remove, places.ctl, places.state, places.log)
        last_first.callback(cleanup.sweep_claims)
        last_first.callback(core_trace.sweep)
        last_first.callback(tbuf.sweep, places.domain)
        last_first.callback(sweep, places.name, places.domain)
        last_first.callback(cleanup.remove_rings, rings)
        last_first.callback(process_setup.end_marked, process_setup.mark())


def _remove_dead_agent(places: run_folder.Places) -> None:
    """Remove what an agent left that was killed; nothing while one is alive."""
    with contextlib.suppress(DuplicateNameError):
        lock = run_folder.NameLock(places.lock)
        places.remove(*places.agents_files)
        orphaned_rings.sweep(places.domain, places.name)
        lock.release()
        run_folder.sweep_routers(places.domain)


def main(config: rtpu_messages.RtpuConfig, pid: int, control: socket.socket) -> int:
    """Serve until there is a reason to end; return the exit status.

    Args:
        config: The settings from the agent.
        pid: The fork server that was forked off before.
        control: The socket to it.

    Raises:
        PbonetError: The RTPU cannot be started.
    """
    faulthandler.enable(all_threads=False)  # others keep running
    survive_cuts()
    process_setup.set_title("pbonet-rtpu")
    process_setup.on_end_of_parent(os.getppid())
    return asyncio.run(run(config, Server(pid, control)))


__all__ = ["AgentLink", "clean_up", "main", "run"]
