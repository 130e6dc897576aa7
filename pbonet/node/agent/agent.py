"""The agent: the network side of an RTPU (Stewart 1994, section 4.5).

It registers by a liveliness token, receives requests over zenoh, passes them to its
RTPU process, which carries them out, and publishes events of that process. If it is
killed, control continues for the declared grace, and an agent that starts within it
takes over. What it keeps is what the RTPU process is to do when that, or the machine,
was lost (`desired_state`).
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import platform
import socket
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Self

import msgspec
import zenoh

import pbonet
from pbonet.errors import DuplicateNameError, NodeError, PbonetError, Severity
from pbonet.node.metrics import MetricsServer, check_address
from pbonet.node.mirror import TableCarrier
from pbonet.node.restart import DesiredState, Takeovers, TaskRestarts, path_of
from pbonet.node.rtpu import cleanup
from pbonet.node.spp import Executives
from pbonet.node.wire import core_trace, rtpu_messages
from pbonet.svar import survive_cuts
from pbonet.versions import LAYERS
from pbonet.xm.net import (
    AgentInfo,
    Client,
    LinkReport,
    client_of_router,
    credentials,
    dialling,
    key_expressions,
    messages,
    run_folder,
    session,
)

from . import restart_check
from .certificate_expiry import KeyTerm
from .duplicate_agents import DuplicateAgents
from .heartbeat import ALWAYS, Change, Heartbeat
from .ipc_facade import Mail
from .key_subscriptions import KeySubscriptions
from .link_watchdog import NearestRouter, cut_tls
from .machine_state import NeededFolders, copy_speed, machine_info
from .peer_latency import PeerLatencies
from .recorder_supervisor import Recorders
from .rtpu_link import RtpuLink, contained
from .shared_memory_status import Age, SharedMemoryStatus, restarting
from .shutdown_event import Ending
from .start_rtpu import choose_core, used_cores
from .stop_orders import Order, StopOrders
from .stopped_processes import StoppedProcesses
from .subsystem_links import Links
from .zenoh_server import Server

if TYPE_CHECKING:
    from collections.abc import Callable, Set as AbstractSet

    from pbonet.config import AgentConfig
    from pbonet.node.rtpu import SnapshotChanges

log = logging.getLogger("pbonet.node")

STOP_TIME = 2.0
"""Seconds for turning all tasks OFF."""
ANEW_TIME = 10.0
"""Minimum seconds in which a restarted agent can take over its RTPU process."""
TOKEN_TIME = 1.0
"""Seconds for which the token of a killed predecessor may remain."""
LOCK_TIME = 0.3
"""Seconds for which an ending RTPU process may hold the name, to clean up, and within
which one notices that its agent has left."""
READY_TIME = 5.0
"""Seconds for which masters do not see an agent that spawns tasks again."""
LET_GO_TIME = 2.0
"""Seconds for closing tables."""
HERE_TIME = 1.0
"""Seconds for which it counts which RTPUs live here."""
RESTARTS = 5
RESTART_WINDOW = 60.0
"""An RTPU process that is lost more often than this many times in so many seconds is
not started again."""


class Agent:
    """An agent and its RTPU process.

    Args:
        config: The machine's configuration; `name` must be set.
        backend: ``auto``, ``fifo`` or ``park``; see `pbonet.node.rt._rt.Dispatcher`.
        lasts: Whether the next agent of that name is to know what this one had.
    """

    reason = ""
    """Why the agent has ended by itself."""
    _metrics: MetricsServer | None = None
    _claims: AbstractSet[str] = frozenset()
    """The subsystems that use the RTPU, as last announced."""
    _here_at = 0.0
    """When it was seen which RTPUs live here."""

    def __init__(
        self, config: AgentConfig, *, backend: str = "auto", lasts: bool = True
    ) -> None:
        if config.name is None:
            raise NodeError(
                "an agent needs a name",
                remedy='use --name NAME, or name = "NAME" in agent.toml',
            )
        self.config = config
        self.places = run_folder.Places(config.domain, config.name)
        self._folders = NeededFolders(self.places.folder)
        self._machine = run_folder.machine()
        self._key_folder = keys_in = Path(config.keys) if config.keys else None
        _check_addresses(config, keys_in)
        core = choose_core(self.places) if config.core is None else config.core
        self._rtpu_config = rtpu_messages.RtpuConfig(
            domain=config.domain,
            name=config.name,
            core=core,
            libraries=tuple(os.path.abspath(p) for p in config.libraries),  # noqa: PTH100
            grace=config.grace,
            backend=backend,
            awake=config.awake,
            core_share=config.core_share,
            devices=config.device,
            spps=config.spp,
            runs=os.path.abspath(config.runs or os.environ.get("PBONET_RUNS", "runs")),  # noqa: PTH100
        )
        self._recorders = Recorders(self._note, config)
        self._executives = Executives(config, self._note)
        self._mark = f"again-{os.urandom(4).hex()}-"
        file = path_of(config.domain, config.name) if lasts else None
        self._desired = DesiredState(file, self._note, self._mark)
        self._overview = SharedMemoryStatus(
            *(config.domain, config.name, self._note, self._recorders.fares),
            notes=self._desired.notes,
            devices=config.device,
            processors=self._executives.status,
            runs=self._rtpu_config.runs,
        )
        self._lock: run_folder.NameLock | None = None
        self._session: zenoh.Session | None = None
        self._dials: list[str] = []
        self._position = run_folder.Position()
        self._neighbour: client_of_router.Neighbour | None = None
        self._server: Server | None = None
        self._duplicates: DuplicateAgents | None = None
        self._heartbeat: Heartbeat | None = None
        self._ways: PeerLatencies | None = None
        self._stops: StopOrders | None = None
        self._again: TaskRestarts | None = None
        self._takeovers: Takeovers | None = None
        self._mirrors: TableCarrier | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._subscriptions: KeySubscriptions | None = None
        self._links: Links | None = None
        self._mail: Mail | None = None
        self._term: KeyTerm | None = None
        self._nearest: NearestRouter | None = None
        self._stopped = StoppedProcesses(
            *(self.name, self._processes, self._note, self._every_turn),
            busy=self._has_tables,
        )
        self._link: RtpuLink | None = None
        self._apart: dict[str, float] = {}
        """Subsystems whose keeper is on another machine, and its silence, as sent."""
        self._about: AgentInfo | None = None
        self._here: list[str] = []
        """RTPUs that live on this machine; see `AgentInfo.here`."""
        self._over = Ending()
        self._stopping = False
        self._started = False
        self._restarts: list[float] = []
        self._restarter: threading.Thread | None = None
        self._guard = threading.Lock()
        self._given_up = False
        """Whether that was a loss, and not the orderly end of the RTPU process."""

    @property
    def name(self) -> str:
        """The RTPU's name."""
        return self._rtpu_config.name

    # -- start and end -----------------------------------------------------------------

    def start(self) -> Self:
        """Lock the name, find or start the RTPU process, and serve requests.

        Raises:
            DuplicateNameError: Another agent of the domain has the name.
            PbonetError: Something necessary is not available.
        """
        survive_cuts()  # it carries tables between machines
        self._refuse_used_rtpu()
        text = f"agent {self.name}, process {os.getpid()}"
        config = self.config
        self._lock, self._position = client_of_router.take_place(
            *(self.places, text),
            routed=bool(config.routers),
            reached=bool(config.listen or config.connect or config.multicast),
            patience=LOCK_TIME,
        )
        try:
            self._open()
        except BaseException:
            self.stop()
            raise
        self._started = True
        return self

    @property
    def metrics_port(self) -> int | None:
        """The port on which metrics are served; None: they are not."""
        return self._metrics.port if self._metrics is not None else None

    def _open_session(self) -> zenoh.Session:
        config = self.config
        if self._position.rank:
            self._dials = list(config.routers or config.connect)
            self._session = client_of_router.open_session(
                self.places,
                self._dials,
                position=self._position,
                listen=config.listen,
                key_folder=self._key_folder,
            )
            self._neighbour = client_of_router.Neighbour(self._session, config.domain)
            return self._session
        dialled = dialling.Dialled(
            self.places,
            place=self._position.place,
            listen=config.listen,
            connect=config.connect,
            multicast=config.multicast,
            key_folder=self._key_folder,
        )
        self._session = dialled.session
        dialled.settle()
        self._session, self._dials = dialled.session, dialled.dials
        return self._session

    def _unlinked(self) -> list[str]:
        """Return the endpoints without a link, of those that should have one."""
        if self._ways is None or self._session is None:
            return []
        found = self._ways.unlinked(self._dials)
        if not found or not self._position.rank:
            return found
        one_is_linked = len(found) < len(self._dials)
        with contextlib.suppress(zenoh.ZError):
            one_is_linked |= client_of_router.goes_by_neighbour(self._session)
        return [] if one_is_linked else found

    def _open(self) -> None:
        self._link = RtpuLink(self.places, self._rtpu_config, self)
        self._link.begin()  # it starts while the session is opened
        self._session = self._open_session()
        self._refuse_duplicate()
        damage = self._desired.load()
        info = self._link.open()
        core_trace.sweep()
        self._executives.start([info.core, *used_cores(self.places.folder.parent)])
        self._desired.begin(taken_over=self._link.taken_over)
        self._here = self.places.neighbours()
        self._stopped.start()
        self._about = self._describe()
        client = Client(self._session, self.config.domain, f"{self.name}-stops")
        self._stops = StopOrders(
            *(self.name, client, self._note),
            before=self._desired.orders,
            changed=self._desired.changed,
        )
        self._desired.orders_of, self._desired.others_of = (
            self._stops.left,
            self._stops.others,
        )
        self._mail = Mail(
            *(self._session, self.places, self.config.files, self._note),
            parts=self._stops.parts,
        )
        self._server = Server(
            self._session,
            *(self.config.domain, self.name),
            node=self,
            mail=self._mail,
            overview=self._overview,
            book=self._recorders,
        )
        self._again = TaskRestarts(
            *(self.name, self._desired, client, self), note=self._note, mark=self._mark
        )
        self._server.start()
        self._refuse_duplicate()
        self._duplicates = DuplicateAgents(
            self._session,
            key_expressions.rtpu(self.config.domain, self.name, "status"),
            os.getpid(),
            self._met_twin,
        )
        self._duplicates.start()
        beats, ways = self._meet_others(
            *(self._session, client, self._stops), info=info
        )
        where = self._session, self.config.domain
        self._mirrors = TableCarrier(
            *(*where, ways.clocks, self._note, self._stops.refuses),
            speaks=ways.table_version,
        )
        self._mirrors.start(beats.unanswered)
        self._mirrors.carry(info.tables)
        self._subscriptions = KeySubscriptions(
            self._session, self.config.events, self._arrived
        )
        self._links = Links(
            *(*where, self.name, ways.clock, self._note),
            refuses=self._stops.holds_agent,
            need=ways.need,
        )
        self._term = KeyTerm(
            self._key_folder,
            self.name,
            self._note,
            self._unlinked,
            functools.partial(cut_tls, self._session),
        )
        self._term.start()
        self._nearest = NearestRouter(
            self._session,
            self._dials if self._position.rank else [],
            beats.is_needed,
            self.name,
        )
        self._nearest.start()
        if self.config.metrics is not None:
            self._metrics = MetricsServer(
                self.name, self.config.metrics, self._key_folder, self
            )
        self._begin_again(damage)
        self._token = self._session.liveliness().declare_token(
            key_expressions.rtpu(self.config.domain, self.name, "alive")
        )
        how = "took over" if self._link.taken_over else "started"
        log.info(
            "%s: %s RTPU process %d on core %d", self.name, how, info.pid, info.core
        )

    def _meet_others(
        self,
        link: zenoh.Session,
        client: Client,
        stops: StopOrders,
        *,
        info: rtpu_messages.RtpuInfo,
    ) -> tuple[Heartbeat, PeerLatencies]:
        """Start to give signs of life, and to ask and watch other agents."""
        beats = self._heartbeat = Heartbeat(
            *(link, self.info(), self._on_sight, stops.holds),
            met=self._on_first_sign,
            machine_of=self._machine_of,
            used=self._is_used,
        )
        self._takeovers = Takeovers(
            self.name,
            *(client, beats, stops),
            written=self._overview.written,
            send=self._note,
        )
        self._takeovers.update(info)
        self._takeovers.start()
        ways = self._ways = PeerLatencies(
            link,
            *(self.info(), self._recorders.send, self._note),
            listeners=(stops, self._takeovers),
            silent=beats.is_silent,
            token_came=beats.token_came,
            partners=self._partners,
            knows_all=self._key_folder is not None
            and credentials.role(self._key_folder) is credentials.Role.GATEWAY,
            by_router=self._position.rank > 0,
        )
        ways.start()
        taken_over = self._link is not None and self._link.taken_over
        beats.join(info.tables, since=ALWAYS if taken_over else None)
        beats.start()
        return beats, ways

    def _begin_again(self, damage: str) -> None:
        """Give again what the agent before this one had, or tell why not."""
        if damage:
            log.error("%s: %s", self.name, damage)
            error = int(Severity.ERROR)
            self._note(rtpu_messages.Note(error, "STATE_UNREADABLE", damage))
        if self._again is not None:
            self._again.begin(
                "the machine was started again"
                if self._desired.rebooted
                else "the agent and the RTPU process had ended",
                wait=READY_TIME,
            )

    def _processes(self) -> dict[int, str]:
        """Return the processes to keep running, with what each one is."""
        found = self._recorders.processes() | self._executives.processes()
        if (neighbour := self._neighbour) is not None:
            found |= neighbour.processes()
        if (link := self._link) is not None and link.info is not None:
            found[link.info.pid] = "the RTPU process"
        return found

    def _has_tables(self) -> bool:
        """Return whether the RTPU process has a table."""
        link = self._link
        return link is not None and link.info is not None and bool(link.info.tables)

    def _is_used(self) -> bool:
        """Return whether masters or programs elsewhere use this RTPU.

        Without the link a master loses it, and a program what it holds here.
        """
        mail = self._mail
        return bool(self._claims) or (mail is not None and mail.is_used())

    def _every_turn(self) -> None:
        """Do what is due a few times a second."""
        if lost := self._folders.lost():
            if not self._over.is_set():
                self._give_up(lost)
            return
        self._send_alive()

    def _send_alive(self) -> None:
        """Send the RTPU process a sign of life, if others depend on this agent."""
        link, beats = self._link, self._heartbeat
        if link is None or link.info is None or beats is None:
            return
        before = self._apart
        self._apart = {
            subsystem: beats.silence(subsystem, use.keeper)
            for subsystem, use in link.info.tables.items()
            if use.alone and use.keeper and not beats.is_here(use.keeper)
        }
        if before or self._apart:
            self._note(rtpu_messages.Alive(self._apart))

    def _refuse_used_rtpu(self) -> None:
        """Raise if the RTPU process has a live agent, though its lock was removed."""
        deadline = time.monotonic() + LOCK_TIME
        while not run_folder.is_held(self.places.lock):
            left = cleanup.read(self.places.state)
            if left is None or left.agent in {0, os.getpid()}:
                return
            if time.monotonic() > deadline:
                raise DuplicateNameError(
                    "the RTPU process of that name has an agent already",
                    where=f"{self.name}, process {left.pid}",
                    got=f"its agent is process {left.agent}, and its lock "
                    f"{self.places.lock} was removed",
                    remedy="choose another name, or end that agent with "
                    f"`kill {left.agent}`",
                )
            time.sleep(0.02)

    def _refuse_duplicate(self) -> None:
        """Raise if an agent of that name is alive anywhere in the domain."""
        if self._session is None:
            return
        key = key_expressions.rtpu(self.config.domain, self.name, "alive")
        deadline = time.monotonic() + TOKEN_TIME
        while session.alive(self._session, key):
            if time.monotonic() > deadline:
                raise DuplicateNameError(
                    f"domain {self.config.domain} has an agent {self.name} already",
                    where=key,
                    remedy="choose another name, or stop that agent",
                )
            time.sleep(0.05)

    def stop(self, timeout: float = STOP_TIME, *, keep: bool = False) -> bool:
        """Turn all tasks OFF in order, end the RTPU process, and release the name.

        Args:
            timeout: Seconds for turning all tasks OFF.
            keep: Let the next agent spawn the tasks again: the machine is shut down.

        Returns:
            Whether the RTPU process ended by itself.
        """
        link = self._begin_to_stop()
        try:
            return link.shut_down(timeout) if link is not None else True
        finally:
            self._executives.stop()
            self._recorders.stop()
            self._leave(keep=keep or not self._started)

    def abandon(self) -> None:
        """Leave, and let the RTPU process continue for the next agent."""
        link = self._begin_to_stop()
        if link is not None:
            link.leave(ANEW_TIME)
        if self._server is not None:
            self._server.fail_pending("the agent restarts; requests under way continue")
        self._executives.stop(sweep=False)
        self._recorders.stop(sweep=False)
        self._leave(keep=True)

    def _begin_to_stop(self) -> RtpuLink | None:
        """Prevent restarts; return the RTPU process to end, if any."""
        with self._guard:
            self._stopping = True
            link, self._link = self._link, None
        self._over.set()
        self._desired.freeze()
        if self._again is not None:
            self._again.abandon()
        if self._mail is not None:
            self._mail.end_waits()
        return link

    def _met_twin(self, other: AgentInfo) -> None:
        """Report another agent of this name that a new link has made visible."""
        text = (
            f"another agent {other.name} runs on {other.host}, process {other.pid}; "
            "requests reach either: stop one of them"
        )
        log.error("%s: %s", self.name, text)
        self._note(rtpu_messages.Note(int(Severity.ERROR), "DUPLICATE_NAME", text))

    def _partners(self) -> set[str]:
        """Return the agents to ask every second."""
        beats, stops, links = self._heartbeat, self._stops, self._links
        found: set[str] = set()
        if beats is not None and stops is not None:
            found |= beats.partners() | stops.awaited()
        if (link := self._link) is not None and link.info is not None:
            found |= {use.keeper for use in link.info.tables.values() if use.keeper}
        return found if links is None else found | links.partners()

    def _machine_of(self, name: str) -> str | None:
        """Return the machine of an agent that has answered."""
        ways = self._ways
        return ways.machine(name) if ways is not None else None

    def _on_first_sign(self, name: str) -> None:
        """Have an agent asked that is heard for the first time."""
        if (ways := self._ways) is not None:
            ways.in_sight(name)

    def _on_sight(self, change: Change) -> None:
        """Act on an agent that goes out of sight or comes back."""
        ways, mirrors = self._ways, self._mirrors
        if ways is not None:
            (ways.in_sight if change.seen else ways.out_of_sight)(change.agent)
        if mirrors is None:
            return
        if change.seen:
            mirrors.in_sight()
        elif change.last:
            mirrors.out_of_sight(change.machine)

    def _note(self, note: msgspec.Struct) -> None:
        """Send a message to the RTPU process, if there is one, such as an event."""
        link = self._link
        if link is not None:
            with contextlib.suppress(NodeError):
                link.send(note)

    def _arrived(self, message: rtpu_messages.Arrived | rtpu_messages.Note) -> None:
        link = self._link
        if link is not None:
            link.send(message)

    def _leave(self, *, keep: bool) -> None:
        if self._again is not None:
            self._again.stop()
            self._again = None
        self._desired.close(keep=keep)
        network = (
            self._metrics,
            self._mail,
            self._links,
            self._subscriptions,
            self._mirrors,
            self._ways,
            self._takeovers,
            self._stops,
        )
        others = self._duplicates, self._term, self._nearest, self._stopped
        for part in (*network, *others):
            if part is not None:
                with contained():  # whatever fails, the process has to end
                    part.stop()
        ways, beats = self._ways, self._heartbeat
        self._mail = self._links = self._subscriptions = None
        self._mirrors = self._ways = self._duplicates = self._term = None
        self._nearest = None
        self._stops = self._takeovers = self._metrics = None
        self._heartbeat = None
        if self._restarter is not None:
            self._restarter.join()
        self._overview.let_go()
        if self._server is not None:
            self._server.stop()
            self._server = None
        if ways is not None and not (keep or self._given_up):
            ways.announce_end()  # after the last answer, and before silence
        if beats is not None:
            beats.stop()
        if self._session is not None:
            self._session.close()  # type: ignore[no-untyped-call]
            self._session = None
        if self._lock is not None:
            self.places.remove(*self.places.agents_files)
            self._lock.release()
            run_folder.sweep_routers(self.config.domain)
            self._lock = None
        self._over.set()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the agent has ended or must end; return whether it has."""
        return self._over.wait(timeout)

    def heed_signals(self) -> None:
        """Let signals wake `wait`; to be called by the main thread."""
        self._over.heed_signals()

    def ask_to_end(self) -> None:
        """Make `wait` return; may be called from a signal handler."""
        self._over.set()

    def may_start_anew(self, again: Callable[[], AgentConfig] | None = None) -> bool:
        """Return whether an agent with the configuration of `again` could start."""
        try:
            config = self.config if again is None else again()
            restart_check.check(self.config, config, self._rtpu_config.core)
        except Exception as error:  # noqa: BLE001 - after any error this agent continues
            why = error if isinstance(error, PbonetError) else repr(error)
            text = f"the agent does not restart: {why}"
            log.error("%s: %s", self.name, text)  # noqa: TRY400 - no fault of a program
            self._note(rtpu_messages.Note(int(Severity.ERROR), "NOT_RESTARTED", text))
            return False
        for what in restart_check.kept(self.config, config):
            log.warning(restart_check.LATER, self.name, what)
        return True

    def go_on(self) -> bool:
        """Undo `ask_to_end`; return whether nothing else ends the agent."""
        self._over.clear()
        return not self.reason

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *exc: object) -> None:
        self.stop()

    # -- for the server ----------------------------------------------------------------

    def forward(
        self, n: int, data: bytes, masters: list[tuple[str, str]] | None
    ) -> None:
        """Pass a request to the RTPU process.

        Raises:
            NodeError: There is no RTPU process now.
        """
        link = self._link
        if link is None:
            raise restarting(self.name)
        link.send(rtpu_messages.Forward(n, data, masters))

    def info(self) -> AgentInfo:
        """Return this agent's identity and abilities."""
        info = self._link.info if self._link is not None else None
        if self._about is None or info is None:
            return self._describe()
        term, ways = self._term, self._ways
        self._see_neighbours()
        return msgspec.structs.replace(
            self._about,
            rtpu_pid=info.pid,
            backend=info.backend,
            share=info.share,
            dispatch=info.dispatch,
            share_reason=info.share_reason,
            limits=info.limits,
            claims=info.claims,
            on=self._overview.on(),
            rtpu_age=(time.monotonic_ns() - info.started_ns) * 1e-9,
            stops=list(dict.fromkeys([*self._desired.stops, *info.stops])),
            due=self._stops.due() if self._stops is not None else {},
            here=self._here,
            now_ns=time.monotonic_ns(),
            keys_left=term.left if term is not None else None,
            lost=ways.lost() if ways is not None else [],
        )

    def _see_neighbours(self) -> None:
        """See which RTPUs live here, if that was not done within a second."""
        now = time.monotonic()
        if now - self._here_at >= HERE_TIME:
            self._here_at = now
            with contextlib.suppress(OSError):  # the folder was removed
                self._here = self.places.neighbours()

    def _describe(self) -> AgentInfo:
        """Return the part of the identity that is constant during a session."""
        return AgentInfo(
            name=self.name,
            domain=self.config.domain,
            host=socket.gethostname(),
            machine=self._machine,
            core=self._rtpu_config.core,
            cores=os.cpu_count() or 1,
            pid=os.getpid(),
            rtpu_pid=0,
            backend="",
            version=pbonet.__version__,
            protocol=messages.VERSION,
            versions=LAYERS,
            python=platform.python_version(),
            libraries=list(self._rtpu_config.libraries),
            names={"device": sorted(self._rtpu_config.devices)},
            zid=str(self._session.info.zid()) if self._session is not None else "",
            dials=self._dials,
            listens=list(self.config.listen),
            here=self._here,
            copy_speed=copy_speed(),
            now_ns=time.monotonic_ns(),
        )

    def status(self, subsystem: str) -> messages.RtpuStatus:
        """Return the status of a subsystem's tasks on the RTPU, for the metrics."""
        return self._overview.status(subsystem)

    def ages(self, subsystem: str) -> list[Age]:
        """Return the ages of a subsystem's variables, for the metrics."""
        return self._overview.ages(subsystem)

    def machine(self) -> messages.MachineInfo:
        """Return the clock of the machine, and the disk on which runs are recorded."""
        return machine_info(self._rtpu_config.runs)

    def ways(self, *, measure: bool = True) -> LinkReport:
        """Return the paths to the other agents, measured now or a second ago."""
        ways = self._ways
        report = LinkReport(rtpu=self.name)
        if ways is not None:
            report = ways.report(measure=measure)
        if self._mirrors is not None:
            report.tables = self._mirrors.report()
        return report

    # -- messages of the RTPU process --------------------------------------------------

    def answered(self, n: int, data: bytes) -> None:
        """Pass an answer on to its client."""
        if self._server is not None:
            self._server.answer(n, data)

    def published(self, data: bytes) -> None:
        """Publish an event, and record it."""
        self._recorders.send(rtpu_messages.Happened(data))
        if self._server is not None:
            self._server.publish(data)

    def called(self, call: rtpu_messages.Called) -> None:
        """Call successors on other machines."""
        if self._mirrors is not None:
            self._mirrors.call(call)

    def informed(self, info: rtpu_messages.RtpuInfo) -> None:
        """Carry the tables that are now open, and update the recordings."""
        self._recorders.update(info.recordings, info.claims)
        self._overview.informed(info)
        self._stopped.hurry()
        ways, beats = self._ways, self._heartbeat
        if ways is not None and beats is not None:
            if info.tables.keys() - beats.groups():
                ways.expect_others()
            beats.join(info.tables)
            if info.claims.keys() != self._claims:
                ways.announce_change()
        self._claims = info.claims.keys()
        if self._mirrors is not None:
            self._mirrors.carry(info.tables)
        if self._takeovers is not None:
            self._takeovers.update(info)

    def learned(self, news: SnapshotChanges) -> None:
        """Store the RTPU process's report of its state."""
        self._overview.learn(news)
        self._desired.learn(news)

    def stop_ordered(self, request: Order) -> None:
        """Repeat a stop to RTPUs that are out of reach, when they are seen again.

        Nothing that was lost here is given again after it.
        """
        if self._stops is not None:
            self._stops.add(request)
        if isinstance(request, messages.Replaced):
            here = request.tasks.get(self.name, ())
            self._desired.replaced(request.subsystem, here)
        elif request.stop_id not in self._desired.stops:
            self._desired.ended(request.subsystem)

    def done(self, request: messages.AnyRequest, data: bytes) -> None:
        """Keep what a command makes the RTPU do."""
        self._desired.done(request, data)

    def warned(self, data: bytes) -> bytes:
        """Return the packed answer to a stop with a warning if that is not kept."""
        return self._desired.warned(data)

    # -- for giving lost tasks again ---------------------------------------------------

    def submit(
        self, request: messages.AnyRequest, reply: Callable[[bytes], None]
    ) -> None:
        """Carry out a request of this agent, and pass its packed answer on.

        Raises:
            NodeError: The agent ends.
        """
        if self._server is None:
            raise restarting(self.name)
        self._server.submit(request, reply)

    def values(self, request: messages.Display) -> bytes:
        """Return the packed answer with values of variables."""
        return self._overview.answer(request)

    def spread(
        self,
        subsystem: str,
        done: Callable[[], None],
        *,
        take: bool = False,
        value: str = "",
    ) -> None:
        """Call `done` when other machines have the table; see `TableCarrier.spread`."""
        if subsystem and self._mirrors is not None:
            self._mirrors.spread(subsystem, done, take=take, value=value)
        else:
            done()

    def broke(self, reason: str) -> None:
        """Fail pending requests: their answers may have been lost with the link."""
        if self._server is not None:
            self._server.fail_pending(f"the link to the RTPU process broke: {reason}")

    def let_go(self) -> None:
        """Stop carrying tables, so that the next agent may make them again."""
        self._overview.let_go()
        if self._mirrors is not None:
            self._mirrors.carry({}, wait=LET_GO_TIME)

    def lost(self, how: str, *, again: bool, orderly: bool) -> None:
        """Restart the RTPU process if it was killed; otherwise end."""
        self._desired.lost()
        if self._again is not None:
            self._again.abandon()
        self._recorders.update({})
        if self._server is not None:
            self._server.fail_pending(how)
        with self._guard:
            if self._stopping:
                return
            self._link = None
        if not again:
            self._give_up(how, loss=not orderly)
            return
        log.error("%s: %s", self.name, how)
        self._restarter = threading.Thread(
            target=self._restart, args=(how,), name="pbonet restart", daemon=True
        )
        self._restarter.start()

    def _restart(self, how: str) -> None:
        """Start the RTPU process again, or end."""
        try:
            self._start_again(how)
        except Exception as error:
            log.debug("starting again has failed", exc_info=True)
            if self._over.is_set():
                cleanup.clean_after(self.places)
                return
            self._give_up(f"the RTPU process does not start again: {error}")

    def _start_again(self, how: str) -> None:
        now, at = time.monotonic(), time.strftime("%H:%M:%S")
        self._restarts = [t for t in self._restarts if now - t < RESTART_WINDOW] + [now]
        if len(self._restarts) > RESTARTS:
            self._give_up(f"the RTPU process was lost {len(self._restarts)} times")
            return
        cleaned = cleanup.clean_after(self.places)
        if self._over.is_set():
            return
        link = RtpuLink(self.places, self._rtpu_config, self)
        link.open(self._over.is_set)
        with self._guard:
            stopping = self._stopping
            if not stopping:
                self._link = link
        if stopping:
            link.shut_down(STOP_TIME)
            return
        text = f"{how}; its tasks turned themselves off; RESTART says which come back"
        self._note(rtpu_messages.Note(int(Severity.FATAL), "RTPU_DIED", text))
        for text in cleaned:
            self._note(rtpu_messages.Note(int(Severity.WARNING), "CLEANED", text))
        self._desired.begin(taken_over=False)
        if self._again is not None:
            self._again.begin(f"{how.splitlines()[0]}, at {at}")

    def _give_up(self, reason: str, *, loss: bool = True) -> None:
        self.reason, self._given_up = reason, loss
        log.error("%s: %s", self.name, reason)
        self._over.set()


def _check_addresses(config: AgentConfig, keys: Path | None) -> None:
    """Refuse addresses that cannot be, or that reach beyond this machine without keys.

    Raises:
        NodeError: One of an agent's endpoints is refused.
        ConfigError: That of the metrics is.
    """
    for one in config.listen:
        session.check_endpoint(one, insecure=config.insecure, key_folder=keys)
    if config.routers and (config.connect or config.multicast):
        other = "multicast" if config.multicast else "connect"
        raise NodeError(
            "an agent with routers has no links to other agents",
            where=config.name or "",
            expected=f"routers or {other}",
            got="both",
            remedy=f"remove {other} (also PBONET_CONNECT): routers lead to all agents",
        )
    if len(config.connect) >= client_of_router.MESH:
        log.warning(
            "%s: links to %d agents; beyond %d machines start a router (pbonet router)"
            " and name it as routers in each agent.toml, instead of connect",
            *(config.name, len(config.connect), client_of_router.MESH),
        )
    if config.metrics is not None:
        check_address(config.metrics, keys)
