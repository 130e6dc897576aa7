"""The code of one task, run again record by record.

The instance, its executor and the order of methods are those of a task; the copies
provide the recorded inputs, and pass on the module's outputs.
"""

from __future__ import annotations

import contextlib
import time
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pbonet.config import Library, Limit, parse_rmod
from pbonet.errors import PbonetError, SvarOwnerError
from pbonet.log import CDR, COMMITS, HELD, SAFE, STABLE, Step, StepSchema, size, unpack
from pbonet.node.task import RAISED, Executor, check_ports, files_of, set_param
from pbonet.outside import BrokenOffError, NotRecordedError, Player
from pbonet.pbo import PythonWatch, bind, decode_params
from pbonet.svar import Blamed

from . import _outside
from ._chance import Chance, noting
from ._failing import Failing, HandlerError
from ._inputs import Commits, Inputs, Key
from ._records import DID, HEAD, alike, did, kind_of
from ._trial import Trial
from ._verdict import Divergence, Verdict

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

    from numpy.typing import NDArray

    from pbonet.config import Variable
    from pbonet.log import Did, TaskLife


_HEAD_AT: Final = len(CDR)
_CYCLE: Final = int(Step.CYCLE)


class Stop(BaseException):
    """Nothing after this can be compared; it is not an error of the module."""


class _Copies:
    """Copies between a log and the arrays of a module.

    Args:
        run: Whose.
    """

    blamed = Blamed()
    action = 0

    def __init__(self, run: Run) -> None:
        self._run = run

    def check_claim(self) -> None:
        if self._run.refused("check_claim"):
            raise SvarOwnerError("refused, as it was recorded")

    def copy_in_consts(self) -> int:
        return self._in(Step.CONSTS_IN, self._run.about.inconst)

    def copy_in_on(self) -> int:
        about = self._run.about
        return self._in(Step.ON_IN, [*about.invar, *about.outvar])

    def copy_in(self) -> int:
        return self._in(Step.VARS_IN, self._run.about.invar)

    def copy_out_consts(self, now_ns: int = 0) -> int:  # noqa: ARG002 - as a table has it
        run = self._run
        return self._out(Step.CONSTS_OUT, run.about.outconst, run.consts)

    def make_new(self) -> None:
        """Values have no age here."""

    def claim(self, now_ns: int = 0, cycle: int = 0, own_ns: int = 0) -> int:  # noqa: ARG002
        return self._out(Step.CLAIM, self._run.about.outvar, self._run.group)

    def commit(self, now_ns: int = 0, cycle: int = 0, own_ns: int = 0) -> int:  # noqa: ARG002
        return self._out(Step.COMMIT, self._run.about.outvar, self._run.group)

    def was_made_safe(self) -> None:
        self.commit()

    def cede(self) -> None:
        """Nothing is owned here, and there are no successors."""

    def release(self) -> None:
        """Nothing is owned here."""

    def _in(self, step: Step, variables: Sequence[Variable]) -> int:
        if flags := self._run.refused(step.name):
            return flags
        data = self._run.arrived(variables, self._run.next(step))
        unpack(variables, data, self._run.arrays.__getitem__)
        return 0

    def _out(
        self, step: Step, variables: Sequence[Variable], made: NDArray[np.uint8]
    ) -> int:
        if flags := self._run.refused(step.name):
            return flags
        self._run.limit(variables)
        self._run.compare(variables, self._run.next(step), made.tobytes())
        return 0


class Run:
    """One life of a task, run again.

    Args:
        life: Its records.
        commits: Of the whole run.
        libraries: Folders of modules, before those of the recording.
        verdict: The verdict to fill.
        rtol: Relative tolerance for floats; 0: identical to the bit.
        tried: Parameters for which these words are used, not the recorded ones.
    """

    def __init__(
        self,
        life: TaskLife,
        commits: Commits,
        libraries: Sequence[str | Path],
        verdict: Verdict,
        rtol: float,
        *,
        tried: Trial | None = None,
    ) -> None:
        self.about = life.about
        self._tried = tried or Trial()
        self._schema = life.schema
        self._player = Player() if life.about.hears else None
        self._unheard: int | None = None
        """The record of the first method with an answer that did not fit."""
        self._aborted: dict[int, bytes] = {}
        """Inputs of cycles that were not recorded, by the record with the reason."""
        self._gaps: set[int] = set()
        """Records before which others may be missing."""
        self._doubt = ""
        """Why the module may have another state than it had then."""
        self._records = self._listen(life)
        groups = iter(life.groups)
        self._groups = [
            next(groups) if kind_of(one) in COMMITS else b"" for one in self._records
        ]
        """The group of each record that is a commit."""
        self._at = 0
        self._verdict = verdict
        self._rtol = rtol
        self._lost = self._cycle = self._now = 0
        self._key: Key = (0, 0)
        """The commit that is being compared; of constants, (0, 0)."""
        self._where = "init"
        self._stable = False
        self._failed: PbonetError | None = None
        """The end of the last step between cycles."""
        self._unseen: set[str] = set()
        """Out-vars that `on` copied in, and that are not recorded."""
        self._lay_out()
        self._inputs = Inputs(self.about, self.arrays.__getitem__, commits)
        self._limited = [v for v in self.about.outvar if v.limit is Limit.CLIP]
        self._chance = Chance()
        with noting(self._chance):
            self._make(libraries)

    def _listen(self, life: TaskLife) -> list[bytes]:
        """Take the recorded answers from outside; return the other records."""
        if self._player is None:
            self._gaps = set(life.gaps)
            return life.records
        rest: list[bytes] = []
        began = 0
        heard: bytes = b""
        gaps = set(life.gaps)
        for place, one in enumerate(life.records):
            if place in gaps:
                self._gaps.add(len(rest))
            kind = kind_of(one)
            if kind == Step.CYCLE and not heard:
                rest.append(one)
                began = len(rest)
                continue
            if kind == Step.HEARD:
                self._take_answers(heard, began)
                heard = StepSchema.data(one)
                continue
            done = did(one)
            if heard and done is not None and done.what in {"abort", "fault"}:
                self._aborted[len(rest)] = heard  # by the cycle that it ended
            else:
                self._take_answers(heard, began)
            heard = b""
            rest.append(one)
            if kind in {Step.CYCLE, Step.SYNC}:
                began = len(rest)
            elif done is not None and done.what != "refused":
                began = len(rest) - 1
        self._take_answers(heard, began)
        if len(life.records) in life.gaps:
            self._gaps.add(len(rest))
        return rest

    def _take_answers(self, heard: bytes, began: int) -> None:
        """Take the answers of a method, of which this is the first record."""
        if not heard or self._player is None:
            return
        if self._player.feed(heard) and self._unheard is None:
            self._unheard = began

    def outside(self) -> AbstractContextManager[None]:
        """Return a context in which the module gets only recorded answers."""
        return _outside.only(self._player, self.about, self._chance)

    def _lay_out(self) -> None:
        """Make the arrays; each group in one piece, as in a local table."""
        about = self.about
        self.arrays: dict[str, NDArray[Any]] = {}
        self.group = np.zeros(size(about.outvar), np.uint8)
        self.consts = np.zeros(size(about.outconst), np.uint8)
        rest = [*about.invar, *about.inconst]
        self._rest = np.zeros(size(rest), np.uint8)
        for variables, memory in (
            (about.outvar, self.group),
            (about.outconst, self.consts),
            (rest, self._rest),
        ):
            at = 0
            for variable in variables:
                count = np.dtype(variable.dtype).itemsize * variable.nelem
                view = memory[at : at + count].view(np.dtype(variable.dtype))
                self.arrays.setdefault(variable.name, view)
                at += size([variable])

    def _make(self, libraries: Sequence[str | Path]) -> None:
        about = self.about
        rmod = parse_rmod(about.rmod, about.rmod_name)
        library = Library([*libraries, *about.libraries])
        loaded = library.load_rmod(rmod)
        self._chance.loaded_from(files_of(rmod, library))
        check_ports(rmod, loaded.info)
        settings = self._tried.over(about.task, rmod.settings)
        params = decode_params(loaded.cls, settings, where=rmod.file)
        told = _outside.of_task(self._player, timing=about.timing)
        self._source = _outside.Time(told, lambda: self._now)
        self._context = _outside.Context(
            told,
            about.task,
            rmod=rmod.name,
            freq=about.freq,
            source=self._source,
            handler=rmod.handler,
            seed=about.seed,
        )
        self._context.libraries = tuple(map(str, library.folders))
        self._context.safe_at = rmod.safe_at
        self._watch = PythonWatch(self._context)
        if about.timing:
            self._watch = _outside.Watch(told, self._context)
        self._context.watch = self._watch
        arrays = {
            port.attr: self.arrays[rmod.svar_name(port.name)]
            for port in loaded.info.ports
        }
        self._info = loaded.info
        self._instance = bind(loaded.cls, params, arrays, self._context)
        illegal = (lambda: self._stable) if rmod.critical else None
        self._executor = Executor(self._instance, _Copies(self), illegal=illegal)
        player = self._player if about.timing else None
        self._failing = Failing(told, player, self._executor, self._source, self._watch)

    # -- going through the records -----------------------------------------------------

    def go(self) -> None:
        """Run everything again and fill the verdict."""
        begun = time.perf_counter()
        try:
            with self.outside():
                self.step()  # its birth; what `init` needs is imported there
                self._verdict.loading += time.perf_counter() - begun
                begun = time.perf_counter()
                while self._at < len(self._records):
                    self.step()
                self.end()
        except Stop as stop:
            if self._verdict.divergence is None:
                self._verdict.gaps.append(str(stop))
        finally:
            self._verdict.took += time.perf_counter() - begun

    def end(self) -> None:
        """Check whether records are missing after the last one."""
        if self._at in self._gaps:
            self._verdict.gaps.append(f"{self._place()}: the next records are damaged")
            self._verdict.missing = True

    def step(self) -> None:
        """Run the step of the next record.

        Raises:
            Stop: Nothing after it can be run again.
        """
        try:
            self._step()
        except (NotRecordedError, BrokenOffError) as error:
            raise Stop(f"{self._place()}: {error}") from None
        except HandlerError as error:
            self._diverged(str(error))

    def _feed(self, heard: bytes) -> None:
        """Take the answers of a cycle or `sync`."""
        if heard and self._player is not None and self._player.feed(heard):
            self._player.lost = True

    def _step(self) -> None:
        message = self._records[self._at]
        if self._at == self._unheard and self._player is not None:
            self._player.lost = True
        head = HEAD.unpack_from(message, _HEAD_AT)
        if self._gaps or head[8] != self._lost or head[0] > self._cycle + 1:
            self._check_gap(head)
        if head[10] == _CYCLE:
            self._at += 1
            self._run_cycle(message, head, self._groups[self._at - 1])
        elif head[10] == Step.DID:
            self._at += 1
            self._now = head[1]
            self._obey(DID.decode(StepSchema.data(message)))
        elif head[10] == Step.SYNC:
            self._at += 1
            self._wait(StepSchema.data(message), head[1])
        elif self._doubt:
            self._at += 1  # of a method whose beginning is missing
        else:
            why = f": {self._failed}" if self._failed else ""
            self._diverged(f"the module did not get to {Step(head[10]).name}{why}")

    def _check_gap(self, head: tuple[int, ...]) -> None:
        """Go on in doubt if records are missing before one."""
        if head[8] != self._lost:
            count, self._lost = head[8] - self._lost, head[8]
            self.doubt(f"{count} records were lost after cycle {self._cycle}")
        elif self._at in self._gaps:
            self.doubt(f"{self._place()}: the next records are damaged")
        elif head[10] == Step.CYCLE and head[0] > self._cycle + 1:
            self.doubt(f"cycles {self._cycle + 1} to {head[0] - 1} are not recorded")
        self._gaps.discard(self._at)

    def doubt(self, why: str) -> None:
        """Continue although the module's state may differ from the recorded one.

        From here on, equal values count, and others prove nothing.
        """
        self._verdict.gaps.append(why)
        self._verdict.missing = True
        self._doubt = why

    def _run_cycle(
        self, message: bytes, head: tuple[int, ...], recorded: bytes
    ) -> None:
        number, release, _, _, dt, _, register, commit, _, flags, _ = head
        self._cycle, self._where, self._key = number, "cycle", (register, commit)
        consumed, inputs, heard = self._schema.rest(message)
        if why := self._inputs.bring(consumed, inputs):
            if not self._doubt:
                self.doubt(f"cycle {number}: {why}")
            return
        if heard:
            self._feed(heard)
        self._source.release = release
        try:
            if method := self._method(flags):
                self._failing.run(method, dt * 1e-9)
        except RAISED as error:
            self._diverged(f"it raised {type(error).__name__}: {error}")
        finally:
            self._source.release = None
        self._source.cyclecount += 1
        if self._limited:
            self.limit(self._limited)
        made = self.group.tobytes()
        self._verdict.cycles += self.compare(self.about.outvar, recorded, made)
        self._verdict.seconds += dt * 1e-9

    def _method(self, flags: int) -> Callable[[float], None] | None:
        """Return what ran in a cycle; None: it was skipped."""
        if flags & HELD:
            return None
        if flags & SAFE:
            return self._executor.write_safe
        return self._instance.stable if flags & STABLE else self._instance.cycle

    def _wait(self, heard: bytes, now: int) -> None:
        """Let the module wait for its event, as it did in the recording."""
        self._where, self._source.release = "sync", now
        self._feed(heard)
        try:
            with contextlib.suppress(BrokenOffError):
                self._failing.run(self._instance.sync)
        finally:
            self._source.release = None

    def _place(self) -> str:
        if self._where == "cycle":
            return f"cycle {self._cycle}"
        return f"{self._where} after cycle {self._cycle}"

    def _obey(self, done: Did) -> None:
        """Do what the task did between two cycles."""
        self._where = done.what
        if done.what == "fault" or (done.what == "abort" and not self.about.timing):
            what = done.arg or "a timing failure ended it"
            raise Stop(f"{done.name or 'cycle'} after cycle {self._cycle}: {what}")
        executor, self._failed = self._executor, None
        try:
            if done.what == "spawn":
                executor.spawn()
            elif done.what == "abort":
                self._abort(done)
            elif done.what == "set":
                if not self._tried.has(done.name):
                    set_param(executor, self._info, done.name, done.arg)
            elif done.what == "freq":
                self._context.freq = done.hz
            elif done.what != "refused":
                executor.signal(
                    done.what, done.arg, handover=done.handover, cede=done.cede
                )
        except PbonetError as error:
            # As it may have been in the task; later records show it.
            self._failed = error

    def _abort(self, done: Did) -> None:
        """Leave a cycle that is not recorded, and start again."""
        self._feed(self._aborted.pop(self._at - 1, b""))
        self._failing.aborted(self._cycle, done.calls)
        self._executor.made_safe = done.name == "safe"
        self._executor.abort()

    def refused(self, what: str) -> int:
        """Return the flags of a copy that was refused in the recording; else 0."""
        if self._at < len(self._records):
            done = did(self._records[self._at])
            if done is not None and (done.what, done.name) == ("refused", what):
                self._at += 1
                return int(done.arg or 1)
        return 0

    def next(self, step: Step) -> bytes:
        """Return the data of the next record, which must be of this kind."""
        if self._at >= len(self._records):
            raise Stop(f"the log ends amid {self._where} after cycle {self._cycle}")
        message = self._records[self._at]
        head = HEAD.unpack_from(message, len(CDR))
        kind, self._now = Step(head[10]), head[1]
        if kind is not step:
            self._diverged(f"it reached {step.name}, recorded is {kind.name}")
        self._at += 1
        if kind in {Step.CLAIM, Step.COMMIT}:
            self._key = (head[6], head[7])
            return self._groups[self._at - 1]
        self._key = (0, 0)
        return StepSchema.data(message)

    def arrived(self, variables: Sequence[Variable], data: bytes) -> bytes:
        """Return what a copy in brings, where this was recorded.

        Raises:
            Stop: An input is not recorded.
        """
        self.unseen({v.name for v in variables} & set(self.about.hidden))
        return data

    def unseen(self, names: set[str]) -> None:
        """Note variables with values that are neither recorded nor written by a task.

        Raises:
            Stop: One of them is an input.
        """
        own = {variable.name for variable in self.about.outvar}
        if inputs := names - own:
            raise Stop(f"{self._place()}: {min(inputs)} is not recorded")
        self._unseen |= names

    # -- comparing ---------------------------------------------------------------------

    def limit(self, variables: Sequence[Variable]) -> None:
        """Bring what a module wrote within limits, as a commit does."""
        for variable in variables:
            if variable.limit is Limit.CLIP:
                array = self.arrays[variable.name]
                low, high = (
                    None if one is None else np.array(one, array.dtype)
                    for one in (variable.min, variable.max)
                )
                np.clip(array, low, high, out=array)

    def compare(
        self, variables: Sequence[Variable], recorded: bytes, made: bytes
    ) -> bool:
        """Return if both are the same.

        Raises:
            Stop: They are not.
        """
        if recorded == made:
            return True
        found = self.differ(variables, recorded, made)
        if found is not None and not self._doubt:
            self._verdict.divergence = found
            raise Stop
        return found is None

    def differ(
        self, variables: Sequence[Variable], recorded: bytes, made: bytes
    ) -> Divergence | None:
        """Return the first place where a value differs from the recorded one."""
        if recorded == made:
            return None
        at = 0
        for variable in variables:
            dtype = np.dtype(variable.dtype)
            then = np.frombuffer(recorded, dtype, variable.nelem, at)
            now = np.frombuffer(made, dtype, variable.nelem, at)
            at += size([variable])
            if variable.name in self.about.hidden:
                continue
            other = np.flatnonzero(~alike(then, now, self._rtol))
            if len(other):
                if not self._doubt:
                    self._may_differ(variable.name)
                element = int(other[0])
                return Divergence(
                    cycle=self._cycle,
                    where=self._where,
                    variable=variable.name,
                    element=element,
                    recorded=then[element].item(),
                    computed=now[element].item(),
                )
        return None

    def _may_differ(self, name: str) -> None:
        """Return unless the module began from values that are not recorded.

        Raises:
            Stop: It did, or a timing failure came, or it used random numbers that are
                in no log, so nothing can be said.
        """
        if unsure := self._unsure:
            raise Stop(f"{self._place()}: {name} differs, but {unsure}")
        if self._unseen:
            raise Stop(
                f"{self._place()}: {name} differs, but {min(self._unseen)}, which `on` "
                "copies in, is not recorded"
            )

    @property
    def _unsure(self) -> str:
        """Why a difference may be no fault of the module's."""
        return self._failing.unsure or str(self._chance)

    def _diverged(self, reason: str) -> None:
        if unsure := self._unsure or self._doubt:
            raise Stop(f"{self._place()}: {reason}, but {unsure}")
        self._verdict.divergence = Divergence(
            cycle=self._cycle, where=self._where, reason=reason
        )
        raise Stop
