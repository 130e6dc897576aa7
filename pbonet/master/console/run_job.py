"""A job, or a sequence, from one command: agents, verification, watch, orderly end."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import TYPE_CHECKING, Final

from pbonet.analysis import legality
from pbonet.config import Library
from pbonet.errors import (
    NoAnswerError,
    PbonetError,
    SeveralError,
    Severity,
    StateError,
    UnreachableError,
)
from pbonet.master.configuration import Files
from pbonet.master.subsystem import Embedded, RecordingControl, Subsystem, profiling
from pbonet.xm.net import messages as m, open_files

from . import live_status, render, summary
from .network_interface import Port
from .run_end import (
    Interrupts,
    Outcome,
    Shortfall,
    Standstills,
    Status,
    is_read,
    unrecorded,
)
from .run_sequence import STOPPED_ELSEWHERE, SequenceThread
from .watch_values import OUTPUT, Listener

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path

    from pbonet.master.configuration import Place
    from pbonet.xm.net import RtpuStatus

    from .live_status import View

_PERIOD: Final = 0.5
"""Seconds between two readings of the status."""
_PATIENCE: Final = 10
"""Number of checks in which an RTPU may be out of reach: its agent may be restarted."""


class Run:
    """One run of a job, or of a sequence of jobs, in real time.

    Args:
        path: The ``.job`` or ``.seq`` file.
        place: Domain, endpoints, libraries.
        view: The display.
        seconds: How long; None: until interrupted, or stopped from elsewhere.
        embed: Start agents for RTPUs without one.
        wait: Wait so many seconds for these instead; None: not at all.
        record: ``off``, ``outputs``, ``all``, ``last SECONDS``; None: as the job says.
        runs: Folder of the logs of embedded agents; None for theirs.
        profile: Save the tasks' execution profiles at the end.
        agents: Those that start already; None: none do.

    Raises:
        ConfigError: A file is missing or wrong.
    """

    def __init__(
        self,
        path: str | Path,
        place: Place,
        view: View,
        *,
        seconds: float | None = None,
        embed: bool | str | Path = True,
        wait: float | None = None,
        record: str | None = None,
        runs: str | Path | None = None,
        profile: bool = False,
        agents: Embedded | None = None,
    ) -> None:
        self._path = path
        self._place = place
        self._view = view
        self._limit = seconds
        self._embed = embed
        self._wait = wait
        self._recordings = RecordingControl(record)
        self._record = record
        self._profile = profile
        self._missing = 0
        self._away: list[str] = []
        self._standstills = Standstills()
        self._reason = ""
        self._faults: list[str] = []
        self._unfinished: list[PbonetError] = []
        self.files = Files(path, Library(place.libraries))
        self.name = self.files.recorded_job().name
        self._seconds = None if self.files.seq else seconds
        self._sequence: SequenceThread | None = None
        ends = "it goes to its safe job" if self.files.seq else "it ends in order"
        self._interrupts = Interrupts(
            ends=f"{ends}; a second interrupt stops everything at once", say=view.say
        )
        self._agents = agents or Embedded(
            place.domain,
            libraries=[*map(str, self.files.library.folders)],
            connect=place.connect,
            runs=runs,
            settings=None if isinstance(embed, bool) else embed,
        )

    def run(self) -> Outcome:
        """Run the job from its start to its end; nothing of it is left afterwards.

        Raises:
            PbonetError: The job could not be started; nothing of it is left.
        """
        open_files.ensure("run")
        agents = self._agents
        with self._interrupts.caught(), agents:
            names = [entry.name for entry in self.files.sbs.rtpus]
            if self._wait is not None:
                agents.await_others(
                    names, self._wait, self._interrupts.wished, self._view.say
                )
            elif self._embed:
                self._start_agents(agents, names)
            outcome = self._steer()
            ours = {child.rtpu for child in agents.children}
            killed = agents.stop()
        self._read_log(outcome)
        outcome.faults += [
            f"the embedded agent of {rtpu} had to be killed" for rtpu in killed
        ]
        for error in self._unfinished:
            silent = isinstance(error, NoAnswerError | UnreachableError)
            if silent and error.where in ours and error.where not in killed:
                # Its agent has ended, which turns off its tasks and releases the RTPU.
                self._view.say(render.warning(str(error)))
            else:
                outcome.faults.append(str(error))
        if text := self._standstills.text(outcome.tasks):
            outcome.shortfalls.append(Shortfall(Status.STOOD_STILL, text))
        if STOPPED_ELSEWHERE in self._reason:
            text = "another master, or `pbonet stop`, ended its tasks before the end"
            outcome.shortfalls.append(Shortfall(Status.STOPPED, text))
        return outcome

    def _start_agents(self, agents: Embedded, names: list[str]) -> None:
        if not agents.launched:
            agents.launch(agents.missing(names))
        if agents.children:
            for rtpu, core in agents.wait().items():
                self._view.say(f"{rtpu} has no agent: started one on core {core}")

    def _steer(self) -> Outcome:
        subsystem = Subsystem(
            self._path,
            **self._place.arguments,
            kind="run",
            warned=lambda text: self._view.say(render.warning(text)),
            record=self._record,
        )
        self._recordings = subsystem.recordings
        subsystem.open()
        infos = self._report_limits(subsystem)
        statuses: list[RtpuStatus] = []
        begin = time.monotonic()
        listener = Listener(subsystem, printed=True)
        try:
            self._interrupts.force = subsystem.stop
            self._interrupts.awaited = subsystem.clients.awaited
            listener.open()  # before a task may fail
            begin = self._start(subsystem, infos)
            statuses = self._watch(subsystem, begin, listener)
        except BaseException:
            with contextlib.suppress(PbonetError):  # the first error counts
                subsystem.finish()
            raise
        finally:
            if self._sequence is not None:
                self._sequence.end()
        passed = time.monotonic() - begin
        if self._sequence is not None:
            self._faults += self._sequence.faults()
        if self._profile:
            self._save_profiles(subsystem)
        self._finish(subsystem)
        self._take(listener)  # what modules printed in `off`
        if listener.dropped:
            text = f"{listener.dropped} events or printed lines came too fast to show"
            self._view.say(render.warning(text))
        return Outcome(
            job=self.name,
            seconds=passed,
            tasks=summary.summarize(statuses),
            reason=self._reason,
            faults=self._faults,
            unlogged={one.rtpu: one.unlogged for one in statuses},
            sequence=self._sequence.state if self._sequence else None,
        )

    def _finish(self, subsystem: Subsystem) -> None:
        """End the subsystem.

        If an agent of this run has ended, all of them end now, and each RTPU process
        turns its tasks OFF: nothing is requested of one that cannot answer.
        """
        ours = {child.rtpu for child in self._agents.children}
        if self._agents.ended() and ours.issuperset(subsystem.clients.names):
            subsystem.detach()
            return
        self._resume_agents()
        try:
            self._unfinished += subsystem.finish()
        except SeveralError as error:
            self._unfinished += error.errors
        except PbonetError as error:
            self._unfinished.append(error)

    def _read_log(self, outcome: Outcome) -> None:
        """Read this machine's log, for the exact delays, if that is soon done."""
        try:
            log = self._recordings.log()
        except PbonetError as error:
            text = f"the log cannot be read: {error}"
            outcome.shortfalls.append(Shortfall(Status.UNRECORDED, text))
            return
        if self._recordings.wanted:
            planned = [entry.name for entry in self.files.sbs.rtpus]
            paths = self._recordings.paths
            if text := unrecorded(log, planned, paths, outcome.unlogged):
                outcome.shortfalls.append(Shortfall(Status.UNRECORDED, text))
        if log is None:
            return
        outcome.log, outcome.recording = str(log.path), log
        if is_read(log):
            outcome.tasks = summary.refined(outcome.tasks, log)

    def _save_profiles(self, subsystem: Subsystem) -> None:
        """Save the measured profiles; a failure here is not a failure of the run."""
        try:
            saved = profiling.save(subsystem.task_set, [])
        except PbonetError as error:
            self._view.say(render.warning(f"no profiles were saved: {error}"))
            return
        for one, path in saved:
            self._view.say(f"profile of {one.rmod}, {one.cycles} cycles: {path}")

    def _report_limits(self, subsystem: Subsystem) -> dict[str, m.AgentInfo]:
        """Say what the RTPUs cannot guarantee, each thing once; return who they are."""
        infos, _ = subsystem.clients.each(lambda _: m.Hello(), m.AgentInfo)
        lacking: dict[str, list[str]] = {}
        for rtpu, info in infos.items():
            for limit in info.limits:
                lacking.setdefault(limit, []).append(rtpu)
        for limit, rtpus in lacking.items():
            self._view.say(render.warning(f"{', '.join(rtpus)}: {limit}"))
        return infos

    def _report_loads(
        self, reports: list[legality.RtpuReport], infos: dict[str, m.AgentInfo]
    ) -> None:
        """Report the verdict for each RTPU, and for those that share a core."""
        cores: dict[tuple[str, int], list[legality.RtpuReport]] = {}
        for one in reports:
            self._view.say(legality.report_head(one))
            if one.tasks and (info := infos.get(one.rtpu)):
                cores.setdefault((info.machine, info.core), []).append(one)
        for (_, core), sharers in cores.items():
            if len(sharers) > 1:
                found = legality.sharing(sharers)
                text = found.as_text(core)
                self._view.say(text if found.kept else render.warning(text))

    def _start(self, subsystem: Subsystem, infos: dict[str, m.AgentInfo]) -> float:
        """Assemble the job; an interrupt meanwhile gives it up. Return the time.

        A sequence begins, and does the rest in a thread.
        """
        if self.files.seq is not None:
            self._sequence = SequenceThread(subsystem, self._limit, self._view.say)
            self._sequence.start()
            return time.monotonic()
        done = threading.Event()

        def give_up() -> None:
            while not done.is_set():
                if self._interrupts.wished.wait(0.05):
                    subsystem.stopped.set()
                    return

        watcher = threading.Thread(target=give_up, daemon=True)
        watcher.start()
        try:
            self._report_loads(subsystem.report(), infos)
            statuses = subsystem.start()
        finally:
            done.set()
            watcher.join()
        told = ", ".join(one.task for one in statuses if not one.stands_by)
        standing = [
            f"{one.task} stands by for {one.fallback_of}"
            for one in statuses
            if one.stands_by
        ]
        self._view.say("; ".join([f"job {self.name} is ON: {told}", *standing]))
        return time.monotonic()

    def _watch(
        self, subsystem: Subsystem, begin: float, listener: Listener
    ) -> list[RtpuStatus]:
        """Show the status until it is time to end; return the last of each task."""
        seen = summary.Seen()
        with self._port(subsystem), self._view:
            while True:
                passed = time.monotonic() - begin
                statuses = self._status(subsystem)
                seen.update(statuses)
                self._standstills.update(statuses)
                events = self._take(listener)
                self._view.show(passed, statuses, events)
                if self._over(statuses, passed):
                    if self._missing and self._resume_agents():
                        seen.update(self._status(subsystem))
                    break
                left = _PERIOD
                if self._seconds is not None:
                    left = min(left, max(0.0, self._seconds - passed))
                self._interrupts.wished.wait(left)
        if 0 < self._missing <= _PATIENCE:  # longer absence is the reason of the end
            self._faults.append(f"{' and '.join(self._away)} gave no status at the end")
        return seen.last(subsystem.task_set.model.killed)

    def _take(self, listener: Listener) -> list[m.Event]:
        """Return the new events, show what modules printed, and note what is fatal."""
        events = listener.take()
        self._faults += [one.text for one in events if one.severity >= Severity.FATAL]
        for one in events:
            if one.code == OUTPUT:
                self._view.say(render.printed(one))
        return [one for one in events if one.code != OUTPUT]

    @contextlib.contextmanager
    def _port(self, subsystem: Subsystem) -> Generator[None]:
        """Serve verbs of the command line meanwhile, under the subsystem's name."""
        port = Port(subsystem, subsystem.name, handover=False)
        try:
            port.open()
        except PbonetError as error:
            self._view.say(render.warning(f"no verb can control this run: {error}"))
            yield
            return
        try:
            yield
        finally:
            port.close()

    def _status(self, subsystem: Subsystem) -> list[RtpuStatus]:
        """Return the status; an RTPU that stays away ends the run."""
        self._resume_agents()
        try:
            statuses = subsystem.rtpu_status()
        except PbonetError as error:
            statuses = []
            self._view.say(render.warning(str(error)))
        there = {rtpu.rtpu for rtpu in statuses}
        self._away = [name for name in subsystem.clients.names if name not in there]
        if ended := self._agents.ended():
            self._reason = ended[0]
            self._faults += ended
            return statuses
        self._missing = self._missing + 1 if self._away else 0
        if self._missing > _PATIENCE:
            self._reason = f"{' and '.join(self._away)} cannot be reached"
            self._faults.append(self._reason)
        return statuses

    def _resume_agents(self) -> bool:
        """Continue agents that a signal has stopped; return whether there were any."""
        texts = self._agents.resume()
        for text in texts:
            self._view.say(render.warning(text))
        return bool(texts)

    def _over(self, statuses: list[RtpuStatus], passed: float) -> bool:
        """Return whether the run is over, and note why."""
        if self._reason:
            return True
        if self._sequence is not None:
            self._reason = self._sequence.over(self._interrupts.wished)
            return bool(self._reason)
        if self._interrupts.wished.is_set():
            self._reason = "interrupted"
        elif self._seconds is not None and passed >= self._seconds:
            self._reason = f"{self._seconds:g} s are over"
        elif not self._missing and not any(rtpu.tasks for rtpu in statuses):
            self._reason = "its tasks are gone" if self._faults else STOPPED_ELSEWHERE
        return bool(self._reason)


def run(
    path: str | Path,
    place: Place,
    *,
    seconds: float | None = None,
    sim: bool = False,
    embed: bool = True,
    wait: float | None = None,
    record: str | None = None,
    runs: str | Path | None = None,
    profile: bool = False,
    quiet: bool = False,
    strict: bool = False,
    agents: Embedded | None = None,
) -> Outcome:
    """Run a job or a sequence in real or virtual time, and return the result.

    Args:
        path: The ``.job`` file, or a ``.seq`` file with a program of jobs.
        place: Domain, endpoints, libraries.
        seconds: How long; None: until interrupted, or 10 s of virtual time. A sequence
            that lasts longer is aborted; None: it has no limit.
        sim: In virtual time.
        embed: Start agents for RTPUs without one.
        wait: Wait so many seconds for these instead; None: not at all.
        record: ``off``, ``outputs``, ``all``, ``last SECONDS``; None: as the job says.
        runs: Folder of the logs; None for PBONET_RUNS, else ``runs`` here.
        profile: Save the tasks' execution profiles at the end, in real time.
        quiet: Leave standard output to the caller.
        strict: Give an outcome that lacks something an exit status of its own.
        agents: As `launch_agents` returns them; None: they are started now.

    Raises:
        PbonetError: The job could not be started.
    """
    if sim and profile:
        raise StateError(
            "a simulation measures no execution times",
            expected="--sim or --profile",
            got="both",
            remedy="run the job without --sim to measure its tasks",
        )
    if sim and wait is not None:
        raise StateError(
            "a simulation waits for no agents",
            expected="--sim or --wait, not both",
            remedy="leave one of them out",
        )
    view = live_status.view(quiet=quiet)
    if sim:
        from . import run_simulated

        outcome = run_simulated.simulate(
            path, place, view, seconds, record=record, runs=runs
        )
    else:
        outcome = Run(
            path,
            place,
            view,
            seconds=seconds,
            embed=embed,
            wait=wait,
            record=record,
            runs=runs,
            profile=profile,
            agents=agents,
        ).run()
    outcome.strict = strict
    what = "sequence" if outcome.sequence is not None else "job"
    view.say(
        f"{what} {outcome.job} ended after {outcome.seconds:.1f} s: {outcome.reason}"
    )
    view.say(summary.text(outcome.tasks))
    for fault in outcome.faults:
        view.say(f"ERROR> {fault}")
    if outcome.log:
        view.say(outcome.log_line())
    if text := outcome.last_line():
        view.say(text)
    return outcome
