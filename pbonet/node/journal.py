"""Puts on record what a task does between its cycles.

The native loop records the cycles. All else that is needed to run the module's code
again from a log goes through here: the copies around the other methods, and what made
the executor run them. None of it happens within a cycle.
"""

from __future__ import annotations

import contextlib
import os
from typing import TYPE_CHECKING

import msgspec

from pbonet.errors import SvarError
from pbonet.log import Did, Step, TaskAbout
from pbonet.log.code import code_of
from pbonet.log.groups import pack

from ._ring import Ring
from .failures import ALL_REFUSED

if TYPE_CHECKING:
    from collections.abc import Generator

    from pbonet.config.library import Library
    from pbonet.config.model import Rmod, Variable
    from pbonet.outside import Tape
    from pbonet.pbo import ModuleInfo
    from pbonet.svar import LocalTable, Table

    from .tasktalk import SlotTime
    from .wire import TaskSpec

    Variables = list[Variable]


class Journal:
    """The copies of a task, and a record of each; see `pbonet.node.copies.Copies`.

    Args:
        local: What copies.
        ring: Where records go.
        about: Whose they are.
        time: The task's time, which stands still from one record to the next.
        tape: What the module hears from outside.
    """

    def __init__(
        self,
        local: LocalTable,
        ring: Ring,
        about: TaskAbout,
        time: SlotTime,
        tape: Tape,
    ) -> None:
        self._tape = tape
        self._local = local
        self._ring = ring
        self._about = about
        self._time = time

    @contextlib.contextmanager
    def doing(self, did: Did) -> Generator[None]:
        """Put on record what is about to be done, and have time stand still."""
        with self._time.held():
            self._put(Step.DID, msgspec.json.encode(did))
            try:
                yield
            finally:
                self._put_heard(Step.HEARD)

    @property
    def blamed(self) -> tuple[str, int]:
        """Variable and element that the last flags of a commit are about."""
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
        """Raise when `claim` would, because another task owns an out-var."""
        try:
            self._local.check_claim()
        except SvarError:
            self._put(Step.DID, msgspec.json.encode(Did("refused", name="check_claim")))
            raise

    def claim(self, now_ns: int = 0, cycle: int = 0) -> int:
        """Copy the out-vars out and become their owner, in one event; returns flags."""
        flags = self._local.claim(now_ns, cycle)
        return self._copied(Step.CLAIM, flags, self._about.outvar)

    def commit(self, now_ns: int = 0, cycle: int = 0) -> int:
        """Copy the out-vars out; returns flags."""
        flags = self._local.commit(now_ns, cycle)
        return self._copied(Step.COMMIT, flags, self._about.outvar)

    def cede(self) -> None:
        """Write the out-vars no more, and leave them to an heir's claim."""
        self._local.cede()

    def release(self) -> None:
        """Give up the out-vars, whose values stand."""
        self._local.release()

    def _copied(self, step: Step, flags: int, variables: Variables) -> int:
        if flags & ALL_REFUSED:
            refused = Did("refused", name=step.name, arg=str(flags))
            self._put(Step.DID, msgspec.json.encode(refused))
        else:
            self._put(step, pack(variables, self._local.array))
        return flags

    def broken_off(self) -> None:
        """Put on record what `sync` heard before a command broke it off."""
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
    spec: TaskSpec, rmod: Rmod, info: ModuleInfo, library: Library, table: Table
) -> TaskAbout:
    """Return whose cycles a task's ring holds."""

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
        code=code_of(_files(rmod, library)),
        hears=True,
    )


def _files(rmod: Rmod, library: Library) -> list[str]:
    """Return the files of the modules that an RMOD runs."""
    if not rmod.parts:
        return [library.load(rmod.module).info.file]
    return [file for part in rmod.parts for file in _files(part, library)]
