"""Claims of subsystems on an RTPU, with epochs (Stewart 1994, 4.5.1).

A claim belongs to the subsystem, not to the program that made it. Each claim or
take-over raises the epoch, every command carries it, and so a master that was replaced
while it was away is refused when it comes back. The table is kept by the RTPU process
and outlives the agent.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from msgspec import Struct, structs

from pbonet.config import LONGEST_HANG
from pbonet.errors import ClaimError
from pbonet.xm.net import Standing

if TYPE_CHECKING:
    from collections.abc import Collection

    from pbonet.xm.net import Claim, Request


class Entry(Struct, kw_only=True):
    """One subsystem's claim."""

    subsystem: str
    client: str
    epoch: int
    usage: str
    scheduler: str
    errprint: str
    minfreq: float
    maxfreq: float
    hangtime: float
    job: Standing | None = None
    """The current job, on the RTPU that keeps the table."""


class Claims:
    """The claims on one RTPU.

    Args:
        rtpu: Its name, for messages.
        epoch: The highest epoch that was ever given out.
    """

    def __init__(self, rtpu: str, epoch: int = 0) -> None:
        self._rtpu = rtpu
        self._entries: dict[str, Entry] = {}
        self.epoch = epoch

    def epochs(self) -> dict[str, int]:
        """Return the epoch of every subsystem that holds a claim."""
        return {name: entry.epoch for name, entry in self._entries.items()}

    def entries(self) -> list[Entry]:
        """Return all claims, without the current jobs."""
        return [structs.replace(entry, job=None) for entry in self._entries.values()]

    def get(self, subsystem: str) -> Entry | None:
        """Return the claim of `subsystem`, if it has one."""
        return self._entries.get(subsystem)

    def claim(
        self,
        request: Claim,
        *,
        masters: Collection[tuple[str, str]] | None,
        busy: Collection[str],
    ) -> Entry:
        """Grant or refuse a claim.

        Args:
            request: What is asked for.
            masters: Subsystem and client of the masters that live; None when that is
                not known, and then all of them count as alive.
            busy: Subsystems that have tasks on the RTPU.

        Raises:
            ClaimError: Another subsystem or another master holds the RTPU.
        """
        self.judge(request, masters=masters, busy=busy)
        for name in self._lapsed(request.subsystem, masters, busy):
            del self._entries[name]
        held = self._entries.get(request.subsystem)
        if held is not None and held.client == request.client:
            epoch = held.epoch
        elif held is None and request.epoch:
            epoch = request.epoch
            self.epoch = max(self.epoch, epoch)
        else:
            self.epoch += 1
            epoch = self.epoch
        entry = Entry(
            subsystem=request.subsystem,
            client=request.client,
            epoch=epoch,
            usage=request.usage,
            scheduler=request.scheduler,
            errprint=request.errprint,
            minfreq=request.minfreq,
            maxfreq=request.maxfreq,
            hangtime=request.hangtime,
            job=held.job if held is not None else None,
        )
        self._entries[request.subsystem] = entry
        return entry

    def judge(
        self,
        request: Claim,
        *,
        masters: Collection[tuple[str, str]] | None,
        busy: Collection[str],
    ) -> None:
        """Refuse a claim that `claim` would refuse, and change nothing.

        Raises:
            ClaimError: As `claim` says.
        """
        self._check_settings(request)
        held = self._entries.get(request.subsystem)
        if held is not None and self.holder(request, masters):
            _check_take_over(self._rtpu, request, held)
        self._check_others(request, self._lapsed(request.subsystem, masters, busy))

    def holder(
        self, request: Claim, masters: Collection[tuple[str, str]] | None
    ) -> str:
        """Return the other master that lives and has the claim; empty: there is none.

        Args:
            request: A claim of the same subsystem.
            masters: As for `claim`.
        """
        held = self._entries.get(request.subsystem)
        if held is None or held.client == request.client:
            return ""
        gone = masters is not None and (held.subsystem, held.client) not in masters
        return "" if gone else held.client

    def check(self, request: Request) -> Entry:
        """Return the claim under which `request` comes.

        Raises:
            ClaimError: Its subsystem has none, or another master took over.
        """
        return check(self._rtpu, self._entries.get(request.subsystem), request)

    def stand(self, subsystem: str, job: Standing | None) -> None:
        """Note the current job of `subsystem`; harmless when it has no claim."""
        if entry := self._entries.get(subsystem):
            entry.job = job

    def release(self, subsystem: str) -> None:
        """Forget the claim of `subsystem`."""
        self._entries.pop(subsystem, None)

    def restore(self, subsystem: str, entry: Entry | None) -> None:
        """Have the claim of `subsystem` as it was before; None: there was none."""
        self.release(subsystem)
        if entry is not None:
            self._entries[subsystem] = entry

    def _check_settings(self, request: Claim) -> None:
        for what, got, known in (
            ("usage", request.usage, ("exclusive", "shared")),
            ("scheduler", request.scheduler, ("MUF", "EDF", "RM")),
            ("errprint", request.errprint, ("errors", "warnings", "none")),
        ):
            if got not in known:
                raise ClaimError(
                    f"there is no such {what}",
                    where=self._rtpu,
                    expected="one of " + " ".join(known),
                    got=repr(got),
                    remedy="correct its line in the .sbs file",
                )
        if not request.subsystem or not request.client:
            raise ClaimError(
                "a claim needs the names of the subsystem and of its master",
                where=self._rtpu,
                got=f"subsystem {request.subsystem!r}, client {request.client!r}",
                remedy="fill in both, as docs/protocol.md describes",
            )
        for usable, what, expected, got, keyword in (
            (
                0 < request.minfreq < request.maxfreq < math.inf,
                "the range of frequencies",
                "0 < minfreq < maxfreq, in Hz",
                f"{request.minfreq:g} to {request.maxfreq:g}",
                "MINFREQ and MAXFREQ",
            ),
            (
                0 < request.hangtime <= LONGEST_HANG,
                "the time after which a cycle hangs",
                f"above 0, up to {LONGEST_HANG:g} s",
                f"{request.hangtime:g} s",
                "HANGTIME",
            ),
            (
                0 <= request.alone < math.inf,
                "the time without the keeper",
                "0 s (never) or more",
                f"{request.alone:g} s",
                "ALONE",
            ),
        ):
            if not usable:
                raise ClaimError(
                    f"{what} is not usable",
                    where=self._rtpu,
                    expected=expected,
                    got=got,
                    remedy=f"correct {keyword} in the .sbs file",
                )

    def _lapsed(
        self,
        subsystem: str,
        masters: Collection[tuple[str, str]] | None,
        busy: Collection[str],
    ) -> list[str]:
        """Return other subsystems whose master is gone and that have no task left."""
        if masters is None:
            return []
        return [
            name
            for name, entry in self._entries.items()
            if name != subsystem
            and (name, entry.client) not in masters
            and name not in busy
        ]

    def _check_others(self, request: Claim, lapsed: Collection[str]) -> None:
        others = [
            entry
            for name, entry in self._entries.items()
            if name != request.subsystem and name not in lapsed
        ]
        for other in others:
            if other.usage == "exclusive" or request.usage == "exclusive":
                raise ClaimError(
                    f"subsystem {other.subsystem} uses the RTPU",
                    where=self._rtpu,
                    expected="USAGE shared on both sides, or an RTPU that is free",
                    got=f"{other.usage} use by {other.subsystem} (master "
                    f"{other.client}), {request.usage} use asked for",
                    remedy=f"end that master and `pbonet stop {other.subsystem}`",
                )
            if other.scheduler != request.scheduler:
                raise ClaimError(
                    "an RTPU that is shared has one scheduler",
                    where=self._rtpu,
                    expected=f"SCHEDULER {other.scheduler}, as {other.subsystem} has",
                    got=f"SCHEDULER {request.scheduler}",
                    remedy="give both the same SCHEDULER, or one of them another RTPU",
                )


def _check_take_over(rtpu: str, request: Claim, held: Entry) -> None:
    if not request.take_over:
        raise ClaimError(
            f"subsystem {held.subsystem} has a master already",
            where=rtpu,
            got=f"master {held.client}, epoch {held.epoch}",
            remedy="if it is just starting, wait; else end it, or take over with "
            "--take-over",
        )


def check(rtpu: str, entry: Entry | None, request: Request) -> Entry:
    """Return the claim under which a request comes.

    Args:
        rtpu: The RTPU that received it.
        entry: The claim of its subsystem, if that has one.
        request: The request.

    Raises:
        ClaimError: Its subsystem has none, or another master took over.
    """
    if entry is None:
        raise ClaimError(
            f"subsystem {request.subsystem!r} has not claimed the RTPU",
            where=rtpu,
            remedy="claim it first",
        )
    if entry.epoch != request.epoch:
        raise ClaimError(
            f"another master controls subsystem {request.subsystem} now",
            where=rtpu,
            expected=f"epoch {entry.epoch}, held by {entry.client}",
            got=f"epoch {request.epoch} from {request.client or 'nobody'}",
            remedy="claim again; with --take-over if that master still lives",
        )
    return entry
