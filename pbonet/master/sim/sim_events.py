"""What happens in a simulation, as the events that RTPUs would tell of it."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from pbonet.errors import MethodError, Severity
from pbonet.node.wire import EventLog, severity
from pbonet.pbo import Signal, State, signal_names

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Generator, Iterable

    from pbonet.errors import PbonetError
    from pbonet.pbo import Notice

    from .sim_task import SimTask


class SimEvents:
    """The events of each RTPU, with the codes and texts of a run in real time.

    Args:
        rtpus: Their names; the first tells what concerns no task.
        subsystem: Whose tasks.
        clock_ns: The virtual time.
        state_of: Tells the state of a task.

    Attributes:
        logs: What each RTPU has told.
        epoch_ns: What is added to virtual time to get nanoseconds since 1970.
    """

    def __init__(
        self,
        rtpus: Iterable[str],
        subsystem: str,
        clock_ns: Callable[[], int],
        state_of: Callable[[str], State | None],
    ) -> None:
        self._subsystem = subsystem
        self._causes: set[str] = set()
        """For which the flag was up at the last look."""
        self.epoch_ns = 0
        self._ending: dict[str, int] | None = None
        """Tasks of each RTPU that were killed by the stop that goes on."""

        def wall() -> float:
            return (clock_ns() + self.epoch_ns) * 1e-9

        self.logs = {
            name: EventLog(name, clock_ns=clock_ns, wall=wall) for name in rtpus
        }
        for log in self.logs.values():
            log.state_of = lambda _, task: state_of(task) or State.NOT_CREATED

    def spawned(self, task: SimTask) -> None:
        """Tell of a task that is there."""
        info = task.member.info
        what = f"module {info.name} {info.version}" if info else "no module"
        text = f"in virtual time, {what}, state {State.OFF}"
        self.tell(task, Severity.INFO, "SPAWNED", text)

    def not_spawned(self, task: SimTask, error: PbonetError) -> None:
        """Tell of a task whose `init` failed."""
        self.tell(task, Severity.ERROR, "SPAWN_FAILED", str(error))

    def signalled(
        self, task: SimTask, signal: str, error: PbonetError | None = None
    ) -> None:
        """Tell what a signal has led to; of kills by a stop `stopped` tells."""
        if signal == "kill" and self._ending is not None:
            rtpu = task.member.rtpu
            self._ending[rtpu] = self._ending.get(rtpu, 0) + 1
            if error is None:
                return
        text = f"{signal}: {task.executor.state}"
        if error is None:
            self.tell(task, Severity.INFO, "STATE", text)
        else:
            text = f"{text}: {error}"
            self.tell(task, Severity.ERROR, "SIGNAL_FAILED", text, error=error)

    @contextlib.contextmanager
    def stopping(self) -> Generator[None]:
        """Tell at the end of a block how many tasks it has ended."""
        self._ending = {}
        try:
            yield
        finally:
            ended, self._ending = self._ending, None
            for rtpu, count in ended.items():
                text = f"{count} tasks ended"
                log, name = self.logs[rtpu], self._subsystem
                log.add(Severity.INFO, "STOPPED", text, subsystem=name)

    def noticed(self, task: SimTask, notices: Iterable[Notice]) -> None:
        """Tell what a module said."""
        info = task.member.info
        own = {one.name: one.bit for one in info.signals} if info else {}
        for one in notices:
            warns, names = one.bits & Signal.WARNING, signal_names(one.bits, own)
            plain = warns or one.handled
            said = " ".join(names) + (f": {one.text}" if one.text else "")
            self.tell(
                task,
                Severity.WARNING if one.handled else severity(one.bits),
                "HANDLED" if one.handled else "WARNING" if warns else "SIGNAL",
                one.text if plain else said,
                bits=one.bits,
                errnum=one.code,
                place=one.place,
            )

    def cycled(self, task: SimTask) -> None:
        """Tell of a cycle that failed, or behind which the task is OFF."""
        executor = task.executor
        failed, executor.faulted = executor.faulted, None
        if failed is None:
            if executor.state is not State.ON:
                self.signalled(task, "off")
        elif executor.failure is not None:  # else the handler's own notice says it
            text = f"{executor.task.errmsg or failed}: {executor.state}"
            error = executor.failure
            self.tell(task, Severity.ERROR, "METHOD", text, error=error)

    def flagged(self, now: Collection[str], *, told: bool) -> None:
        """Tell what raises the illegal-configuration flag, and what does no more.

        Args:
            now: The causes that stand; who raised one is named behind it.
            told: Whether that is an event: not while a job begins or ends.
        """
        before, self._causes = self._causes, set(now)
        if not told:
            return
        for cause in sorted(self._causes - before):
            self._told(cause, Severity.WARNING, "ILLEGAL", cause)
        for cause in sorted(before - self._causes):
            self._told(cause, Severity.INFO, "LEGAL", f"no longer: {cause}")

    def _told(self, cause: str, level: Severity, code: str, text: str) -> None:
        """Have the RTPU tell of a cause whose task raised it, else the first one."""
        rtpu = cause.rpartition("(")[2].partition("/")[0]
        log = self.logs.get(rtpu) or next(iter(self.logs.values()))
        log.add(level, code, text, subsystem=self._subsystem)

    def tell(
        self,
        task: SimTask,
        level: Severity,
        code: str,
        text: str,
        *,
        bits: int = 0,
        errnum: int = 0,
        place: str = "",
        error: PbonetError | None = None,
    ) -> None:
        """Tell something of a task."""
        method = error if isinstance(error, MethodError) else None
        self.logs[task.member.rtpu].add(
            level,
            code,
            text,
            subsystem=self._subsystem,
            task=task.name,
            cycle=task.source.cyclecount,
            bits=bits,
            errnum=method.number if method else errnum,
            place=method.place if method else place,
        )
