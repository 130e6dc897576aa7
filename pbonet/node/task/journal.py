"""Records what a task does between its cycles.

The native loop records the cycles. Everything else that is needed to replay the
module's code from a log is recorded here: the copies around the other methods, and the
reasons why the executor ran them. None of this happens within a cycle.
"""

from __future__ import annotations

import contextlib
import os
from typing import TYPE_CHECKING, NamedTuple, Protocol

import msgspec

from pbonet.errors import SvarError
from pbonet.log import Did, Step, TaskAbout, code_of, pack
from pbonet.node.wire import readable

from .port_transfer import Copies
from .step_failures import ALL_REFUSED

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence
    from contextlib import AbstractContextManager
    from typing import Any

    from numpy.typing import NDArray

    from pbonet.config import Library, Rmod, Variable
    from pbonet.node.wire import TaskSpec
    from pbonet.outside import Tape
    from pbonet.pbo import ModuleInfo
    from pbonet.svar import Blamed

    Variables = list[Variable]


class Local(Copies, Protocol):
    """Copies that report their last commit."""

    @property
    def array(self) -> Callable[[str], NDArray[Any]]:
        """Returns the local copy of a variable by its name."""
        ...

    @property
    def out_uid(self) -> int:
        """The register of the last commit."""
        ...

    @property
    def out_number(self) -> int:
        """The number of the last commit there."""
        ...


class RecordSink(Protocol):
    """The destination of records: a ring, or a substitute."""

    def put(
        self,
        data: bytes,
        *,
        cycle: int = 0,
        kind: int = 0,
        now_ns: int = 0,
        uid: int = 0,
        number: int = 0,
    ) -> bool:
        """Append one record; return False if there is no room."""
        ...


class Time(Protocol):
    """The task's time, which does not advance between two records."""

    @property
    def cycles(self) -> int:
        """Cycles executed since the task was spawned."""
        ...

    def tick(self) -> int:
        """Read the time, freeze it at that value, and return it."""
        ...

    def held(self) -> AbstractContextManager[object]:
        """Return a context manager that freezes it."""
        ...


class TaskIdentity(NamedTuple):
    """Identity of a task that has no process of its own."""

    domain: str
    rtpu: str
    subsystem: str
    task: str
    freq: float
    rmod: str
    rmod_name: str
    libraries: tuple[str, ...]


class Indexed(Protocol):
    """The variables of a table."""

    @property
    def variables(self) -> Sequence[Variable]:
        """All variables."""
        ...

    def index(self, name: str) -> int:
        """Return the index of a variable."""
        ...


class Journal:
    """The copies of a task, each recorded; see `port_transfer.Copies`.

    Args:
        local: Does the copying.
        ring: Destination of the records.
        about: The task.
        time: The task's time, which does not advance between two records.
        tape: The module's inputs from outside.
    """

    def __init__(
        self,
        local: Local,
        ring: RecordSink,
        about: TaskAbout,
        time: Time,
        tape: Tape,
    ) -> None:
        self._tape = tape
        self._local = local
        self._ring = ring
        self._about = about
        self._time = time

    @contextlib.contextmanager
    def doing(self, did: Did) -> Generator[None]:
        """Record an action before it is carried out, and freeze time."""
        with self._time.held():
            did.arg = readable(did.arg)  # a module's error may contain any characters
            self._put(Step.DID, msgspec.json.encode(did))
            try:
                yield
            finally:
                self._put_heard(Step.HEARD)

    @property
    def blamed(self) -> Blamed:
        """Variable and element to which the flags of the last commit refer."""
        return self._local.blamed

    def copy_in_consts(self) -> int:
        """Copy the in-consts in; returns flags."""
        flags = self._local.copy_in_consts()
        return self._copied(Step.CONSTS_IN, flags, self._about.inconst)

    def copy_out_consts(self, now_ns: int = 0) -> int:
        """Copy the out-consts out; returns flags."""
        flags = self._local.copy_out_consts(now_ns)
        return self._copied(Step.CONSTS_OUT, flags, self._about.outconst)

    def copy_in(self) -> int:
        """Copy the in-vars in; returns flags."""
        flags = self._local.copy_in()
        return self._copied(Step.VARS_IN, flags, self._about.invar)

    def copy_in_on(self) -> int:
        """Copy the in-vars and the out-vars in; returns flags."""
        flags = self._local.copy_in_on()
        both = [*self._about.invar, *self._about.outvar]
        return self._copied(Step.ON_IN, flags, both)

    def check_claim(self) -> None:
        """Raise if `claim` would, because another task owns an out-var."""
        try:
            self._local.check_claim()
        except SvarError:
            self._put(Step.DID, msgspec.json.encode(Did("refused", name="check_claim")))
            raise

    @property
    def action(self) -> int:
        """The action because inputs are too old: a value of `svar.Action`."""
        return self._local.action

    def make_new(self) -> None:
        """Let the next commit not inherit the age of an input."""
        self._local.make_new()

    def claim(self, now_ns: int = 0, cycle: int = 0, own_ns: int = 0) -> int:
        """Copy the out-vars out and own them, as one event; returns flags."""
        flags = self._local.claim(now_ns, cycle, own_ns)
        return self._copied(Step.CLAIM, flags, self._about.outvar)

    def commit(self, now_ns: int = 0, cycle: int = 0, own_ns: int = 0) -> int:
        """Copy the out-vars out; returns flags."""
        flags = self._local.commit(now_ns, cycle, own_ns)
        return self._copied(Step.COMMIT, flags, self._about.outvar)

    def was_made_safe(self) -> None:
        """Record the safe values that were committed in place of a cycle's outputs."""
        self._copied(Step.COMMIT, 0, self._about.outvar)

    def cede(self) -> None:
        """Stop writing the out-vars, and leave them to a successor's claim."""
        self._local.cede()

    def release(self) -> None:
        """Release the out-vars, whose values remain."""
        self._local.release()

    def _copied(self, step: Step, flags: int, variables: Variables) -> int:
        if flags & ALL_REFUSED:
            refused = Did("refused", name=step.name, arg=str(flags))
            self._put(Step.DID, msgspec.json.encode(refused))
        else:
            self._put(step, pack(variables, self._local.array))
        return flags

    def broken_off(self) -> None:
        """Record what `sync` read before a command interrupted it."""
        self._put_heard(Step.SYNC)

    def _put_heard(self, step: Step) -> None:
        if heard := self._tape.take():
            self._put(step, heard)

    def _put(self, step: Step, data: bytes) -> None:
        self._put_heard(Step.HEARD)
        committed = step in {Step.CLAIM, Step.COMMIT}
        self._ring.put(
            data,
            kind=step,
            cycle=self._time.cycles,
            now_ns=self._time.tick(),
            uid=self._local.out_uid if committed else 0,
            number=self._local.out_number if committed else 0,
        )


def about(
    spec: TaskSpec | TaskIdentity,
    rmod: Rmod,
    info: ModuleInfo,
    library: Library,
    table: Indexed,
    *,
    seed: int,
) -> TaskAbout:
    """Return the description of the task whose cycles a ring holds."""

    def variables(ports: tuple[str, ...]) -> Variables:
        indices = {table.index(rmod.svar_name(port)) for port in ports}
        plain = [table.variables[index] for index in sorted(indices)]
        return [msgspec.structs.replace(one, place=None) for one in plain]

    return TaskAbout(
        domain=spec.domain,
        rtpu=spec.rtpu,
        subsystem=spec.subsystem,
        task=spec.task,
        module=info.name,
        pid=os.getpid(),
        freq=spec.freq,
        rmod=spec.rmod,
        rmod_name=spec.rmod_name,
        libraries=spec.libraries,
        inconst=variables(rmod.inconst),
        invar=variables(rmod.invar),
        outconst=variables(rmod.outconst),
        outvar=variables(rmod.outvar),
        code=code_of(files_of(rmod, library)),
        hears=True,
        timing=True,
        seed=seed,
    )


def files_of(rmod: Rmod, library: Library) -> list[str]:
    """Return the files of an RMOD's modules."""
    if not rmod.parts:
        return [library.load(rmod.module).info.file]
    return [file for part in rmod.parts for file in files_of(part, library)]
