"""The RTPUs of one subsystem: claims on them, and requests under those claims.

Claiming stands for what `sbsInit` does in Stewart 1994, section 4.5.1: the master asks
every RTPU of the ``.sbs`` file for its use, exclusive or shared. A claim carries an
epoch into every command, so that a master that was replaced is refused.
"""

from __future__ import annotations

import contextlib
import os
from types import NoneType
from typing import TYPE_CHECKING, TypeVar

import msgspec
import zenoh

from pbonet.analysis.schedule import CoreShare
from pbonet.errors import (
    ClaimError,
    NoAnswerError,
    NodeError,
    PbonetError,
    UnreachableError,
    did_you_mean,
)
from pbonet.lazy import logger
from pbonet.xm.net import key_expressions, messages as m, rpc

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from pbonet.config import RtpuEntry, SbsFile

T = TypeVar("T")


def client_name(kind: str) -> str:
    """Return a unique name for a master or tool: its kind, host, process, and luck."""
    host = "".join(c if c.isalnum() else "-" for c in os.uname().nodename)[:24]
    return f"{kind}-{host}-{os.getpid()}-{os.urandom(2).hex()}"


def core_shares(agents: Mapping[str, m.AgentInfo]) -> dict[str, CoreShare]:
    """Return what tasks may use of the core of each RTPU whose agent says it."""
    return {
        name: CoreShare(
            share=agent.share, dispatch=agent.dispatch, reason=agent.share_reason
        )
        for name, agent in agents.items()
        if agent.share
    }


class RtpuClients:
    """The RTPUs that a ``.sbs`` file names, as one master sees them.

    Args:
        client: How they are asked.
        sbs: What the file says.
    """

    def __init__(self, client: rpc.Client, sbs: SbsFile) -> None:
        self.client = client
        self.sbs = sbs
        self.entries: dict[str, RtpuEntry] = {entry.name: entry for entry in sbs.rtpus}
        self.epochs: dict[str, int] = {}
        self._agents: dict[str, m.AgentInfo] = {}
        self._token: rpc.Declared | None = None
        self._last: dict[str, m.Request] = {}
        """The newest requests, by RTPU."""

    def awaited(self) -> str:
        """Return what is waited for when a request is under way: the newest ones."""
        found = [f"{_in_words(one)} on {rtpu}" for rtpu, one in self._last.items()]
        return ", ".join(found)

    @property
    def names(self) -> list[str]:
        """The RTPUs in the order of the file."""
        return list(self.entries)

    @property
    def keeper_first(self) -> list[str]:
        """The RTPUs, the one that keeps the table before the others."""
        return sorted(self.entries, key=lambda name: name != self.sbs.keeper)

    @property
    def claimed(self) -> bool:
        """Whether this master holds the subsystem."""
        return bool(self.epochs)

    def agent(self, rtpu: str) -> m.AgentInfo:
        """Return the description of an RTPU's agent and machine.

        ``machine`` is the identity of the machine; ``host`` is only its name, which
        another machine may have too.

        Raises:
            PbonetError: The agent does not answer.
        """
        if rtpu not in self._agents:
            self._agents[rtpu] = self.call(rtpu, m.Hello(), m.AgentInfo)
        return self._agents[rtpu]

    def machines(self) -> dict[str, str]:
        """Return the machine of each RTPU that has described itself."""
        return {name: agent.machine for name, agent in self._agents.items()}

    def core_shares(self) -> dict[str, CoreShare]:
        """Return what tasks may use of the core of each RTPU that has said it."""
        return core_shares(self._agents)

    def copy_speeds(self) -> dict[str, float]:
        """Return the bytes a second that each RTPU's machine copies, where measured."""
        speeds = {name: agent.copy_speed for name, agent in self._agents.items()}
        return {name: speed for name, speed in speeds.items() if speed}

    def share_a_machine(self, one: str, other: str) -> bool:
        """Return whether two RTPUs are known to be on one machine, with one table."""
        if one == other:
            return True
        agents = [self._agents.get(rtpu) for rtpu in (one, other)]
        machines = {agent.machine if agent is not None else None for agent in agents}
        return None not in machines and len(machines) == 1

    def entry(self, rtpu: str) -> RtpuEntry:
        """Return an RTPU's entry in the file.

        Raises:
            NodeError: The file does not name it.
        """
        if rtpu not in self.entries:
            raise NodeError(
                f"the subsystem {self.sbs.subsystem} has no RTPU {rtpu}",
                where=self.sbs.file,
                expected="one of " + ", ".join(self.entries),
                remedy=did_you_mean(rtpu, self.entries) or "add an RTPU line for it",
            )
        return self.entries[rtpu]

    def claim(
        self,
        rtpus: Iterable[str] | None = None,
        *,
        svar: str = "",
        svar_name: str = "",
        take_over: bool = False,
        confirm: Callable[[str], bool] | None = None,
        partly: bool = False,
    ) -> tuple[dict[str, m.Claimed], list[PbonetError]]:
        """Reserve RTPUs and open the table there, on its keeper before the others.

        A master that lives is replaced only after every RTPU has said that it would
        grant the claim. On failure none stays reserved by this call, except one that
        was taken from such a master: its claim is open to others from then on.

        Args:
            rtpus: Which; None: every one.
            svar: The text of the table's ``.svar`` file; empty: open no table.
            svar_name: The name of that file, for messages.
            take_over: Replace a master that lives.
            confirm: Asked, with a sentence, before tasks that are CRITICAL and ON are
                taken over; None: that is refused.
            partly: Be content with those that answer.

        Returns:
            The claims, and the errors of the RTPUs that do not answer.

        Raises:
            SeveralError: Several RTPUs cannot be had; of one, its own error.
            ClaimError: An RTPU belongs to another subsystem or another master.
            SvarError: The table stands there with another layout.
            UnreachableError: An agent is not there.
            NoAnswerError: One is there, and does not answer.
        """
        self._declare()
        wanted = self.entries if rtpus is None else list(rtpus)
        claims: dict[str, m.Request] = {
            name: m.Claim(
                subsystem=self.sbs.subsystem,
                usage=self.entries[name].usage,
                scheduler=self.entries[name].scheduler,
                errprint=self.entries[name].errprint,
                minfreq=self.entries[name].minfreq,
                maxfreq=self.entries[name].maxfreq,
                hangtime=self.entries[name].hangtime,
                take_over=take_over,
                svar=svar,
                svar_name=svar_name,
                keep=name == self.sbs.keeper,
                keeper=self.sbs.keeper,
                alone=self.sbs.alone,
            )
            for name in self.keeper_first
            if name in wanted
        }
        if take_over:
            self._probe(claims, confirm, partly=partly)
        first = [name for name in claims if name == self.sbs.keeper]
        results: dict[str, m.Claimed] = {}
        errors: list[PbonetError] = []
        for names in (first, [name for name in claims if name not in first]):
            group = {name: claims[name] for name in names}
            got, failed = self.client.call_all(group, m.Claimed)
            results |= got
            errors += failed
        self.epochs |= {name: claimed.epoch for name, claimed in results.items()}
        self._agents |= {
            name: claimed.agent for name, claimed in results.items() if claimed.agent
        }
        if not (partly and _only_unheard(results, errors)):
            self._refuse(errors, len(claims), results)
        return results, errors

    def _probe(
        self,
        claims: Mapping[str, m.Request],
        confirm: Callable[[str], bool] | None,
        *,
        partly: bool,
    ) -> None:
        """Ask every RTPU whether it would grant the claim, and the user if need be."""
        probes = {
            name: msgspec.structs.replace(one, probe=True)
            for name, one in claims.items()
        }
        found, errors = self.client.call_all(probes, m.Claimed)
        if not (partly and _only_unheard(found, errors)):
            self._refuse(errors, len(claims), {})
        concerned = [
            f"{rtpu}: {' '.join(one.critical)}, of master {one.taken_from}"
            for rtpu, one in sorted(found.items())
            if one.taken_from and one.critical
        ]
        if not concerned:
            return
        what = "; ".join(concerned)
        text = f"CRITICAL tasks are ON and have a master that lives ({what})"
        if confirm is None or not confirm(f"{text}. Take them over?"):
            self.drop()
            raise ClaimError(
                "tasks that are CRITICAL and ON are taken over only when confirmed",
                where=self.sbs.subsystem,
                got=what,
                remedy="end that master; or confirm: with --yes in a script, with "
                "Subsystem(..., confirm=...) in a program",
            )

    def _refuse(
        self, errors: list[PbonetError], count: int, granted: dict[str, m.Claimed]
    ) -> None:
        """Raise the errors of a claim, if there are any, after it was undone."""
        if errors:
            self.give_back(granted)
        rpc.raise_all(
            f"{len(errors)} of {count} RTPUs of the subsystem {self.sbs.subsystem} "
            "cannot be had",
            errors,
        )

    def call(
        self,
        rtpu: str,
        request: m.Request,
        result: type[T],
        *,
        timeout: float = rpc.ANSWER_TIME,
    ) -> T:
        """Send a request to one RTPU, under the claim on it if there is one.

        Raises:
            PbonetError: As `rpc.Client.call` and the agent say.
        """
        signed = self._signed(rtpu, request)
        self._last = {rtpu: signed}
        return self.client.call(rtpu, signed, result, timeout=timeout)

    def each(
        self,
        make: Callable[[str], m.Request],
        result: type[T],
        *,
        rtpus: Iterable[str] | None = None,
        timeout: float = rpc.ANSWER_TIME,
    ) -> tuple[dict[str, T], list[PbonetError]]:
        """Send a request to each RTPU at once; return results and errors."""
        wanted = self.entries if rtpus is None else rtpus
        requests = {rtpu: self._signed(rtpu, make(rtpu)) for rtpu in wanted}
        self._last = requests
        return self.client.call_all(requests, result, timeout=timeout)

    def infos(self) -> list[m.AgentInfo]:
        """Return the agents that answer now: one may be another since the claim."""
        infos, _ = self.each(lambda _: m.Hello(), m.AgentInfo)
        return list(infos.values())

    def pass_to_gateways(self, stop: m.Stop) -> None:
        """Give a stop also to agents without RTPUs of the subsystem, if they have keys.

        Gateways among them repeat it to a machine that is out of reach now, which
        takes it from no other agent.
        """
        if all(agent.keys_left is None for agent in self._agents.values()):
            return
        try:
            others = sorted(set(self.client.rtpus()) - self.entries.keys())
            requests = {rtpu: self._signed(rtpu, stop) for rtpu in others}
            _, errors = self.client.call_all(requests, m.Stopped)
        except PbonetError as failure:  # the stop itself has been carried out
            errors = [failure]
        for error in errors:
            logger("pbonet.master").info("the stop was not reported: %s", error)

    def release(self) -> list[PbonetError]:
        """Give every RTPU back; return what went wrong."""
        errors: list[PbonetError] = []
        if self.epochs:
            _, errors = self.each(
                lambda _: m.Release(), NoneType, rtpus=list(self.epochs)
            )
        self.drop()
        return errors

    def give_back(self, claims: dict[str, m.Claimed]) -> None:
        """Undo a failed claim.

        RTPUs with tasks of the subsystem stay claimed, and those that were taken from
        a master that lives.
        """
        free = [
            name
            for name, claimed in claims.items()
            if not (claimed.tasks or claimed.taken_from)
        ]
        if free:
            _, errors = self.each(lambda _: m.Release(), NoneType, rtpus=free)
            for error in errors:
                logger("pbonet.master").warning("cannot give back: %s", error)
        self.drop()

    def drop(self) -> None:
        """Stop being a master without telling the agents; claims stand open to others.

        The agents continue; the next master of the subsystem finds the tasks running.
        """
        self.epochs = {}
        if self._token is not None:
            with contextlib.suppress(zenoh.ZError):
                self._token.undeclare()
            self._token = None

    def masters(self) -> list[str]:
        """Return the names of the subsystem's masters that live."""
        key = key_expressions.masters(self.client.domain, self.sbs.subsystem)
        return [key_expressions.last(token) for token in self.client.tokens(key)]

    def must_be_claimed(self) -> None:
        """Refuse what only a master may do.

        Raises:
            ClaimError: The subsystem was opened for watching, or is closed.
        """
        if not self.epochs:
            raise ClaimError(
                "this changes the subsystem, which is open for reading only",
                where=self.sbs.subsystem,
                remedy="open it as its master",
            )

    def _signed(self, rtpu: str, request: m.Request) -> m.Request:
        """Return the request to one RTPU; other RTPUs may get the same one."""
        return msgspec.structs.replace(
            request, subsystem=self.sbs.subsystem, epoch=self.epochs.get(rtpu, 0)
        )

    def _declare(self) -> None:
        """Declare a liveliness token for this master; agents watch it."""
        if self._token is not None:
            return
        key = key_expressions.master(
            self.client.domain, self.sbs.subsystem, self.client.name
        )
        self._token = self.client.announce(key)


def _in_words(request: m.Request) -> str:
    """Return in a few words what a request has done."""
    if isinstance(request, m.Control):
        return f"the {request.signal} of {request.task}"
    if isinstance(request, m.Spawn):
        return f"the creation of {request.task}"
    return f"an answer to {type(request).__name__}"


def _only_unheard(results: Mapping[str, object], errors: Sequence[PbonetError]) -> bool:
    """Return whether some RTPUs answered, and the others did not answer at all."""
    unheard = (UnreachableError, NoAnswerError)
    return bool(results) and all(isinstance(error, unheard) for error in errors)
