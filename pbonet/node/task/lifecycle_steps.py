"""The steps of a task's life: copies, and methods of the module."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pbonet.errors import DeclarationError, PbonetError, PortError, SvarError
from pbonet.node.wire import Step
from pbonet.pbo import Counted, PortBasedObject, check_sizes, memory
from pbonet.ports import Kind

from .step_failures import ALL_REFUSED, RefusedError, refused

if TYPE_CHECKING:
    from collections.abc import Callable

    from .port_transfer import Copies


class LifecycleSteps:
    """Carries out the steps of one instance.

    Args:
        instance: Bound by `pbonet.pbo.bind`.
        copies: Transfers its ports.
        illegal: For a CRITICAL task: whether the illegal-configuration flag is up.

    Attributes:
        do: The function of each step.
        dt: The argument of `cycle`.
        method: The current or last method; ``stable`` if that runs in place of
            `cycle`.
        cede: Whether a successor takes over the out-vars in its own claim.

    Raises:
        DeclarationError: A CRITICAL task whose module has no ``stable``.
    """

    def __init__(
        self,
        instance: PortBasedObject[Any],
        copies: Copies,
        illegal: Callable[[], bool] | None,
    ) -> None:
        cls = type(instance)
        if illegal is not None and "stable" not in cls.__interface__.methods:
            raise DeclarationError(
                "a CRITICAL task needs a module with stable()",
                where=cls.__name__,
                remedy="write `def stable(self, dt: float) -> None`, or take CRITICAL "
                "out of the .rmod file",
            )
        self.dt = 0.0
        self.method = ""
        self.cede = False
        self._instance = instance
        self._task = instance.task
        self._copies = copies
        self._illegal = illegal
        self._owns = False
        law = instance.cycle if illegal is None else self._choose
        self.do: dict[Step, Callable[[], object]] = {
            Step.COPY_IN_CONSTS: self._copy_in_consts,
            Step.COPY_OUT_CONSTS: self._copy_out_consts,
            Step.COPY_IN: lambda: self._accept(copies.copy_in()),
            Step.COPY_IN_ON: self._copy_in_on,
            Step.COPY_IN_AGAIN: lambda: self._accept(copies.copy_in_on()),
            Step.CLAIM: self._claim,
            Step.COMMIT: self._commit,
            Step.RELEASE: self._release,
            Step.INIT: instance.init,
            Step.ON_METHOD: instance.on,
            Step.CYCLE: lambda: law(self.dt),
            Step.OFF_METHOD: instance.off,
            Step.KILL: instance.kill,
            Step.CLEAR: instance.clear,
            Step.REINIT: instance.reinit,
            Step.SYNC: instance.sync,
        }

    def _choose(self, dt: float) -> None:
        if self._illegal is not None and self._illegal():
            self.method = "stable"
            self._instance.stable(dt)
        else:
            self.method = "cycle"
            self._instance.cycle(dt)

    def _accept(self, flags: int) -> None:
        """Raise if the flags of a copy show that it was refused."""
        if flags & ALL_REFUSED:
            raise refused(flags, self._copies.blamed)

    def _copy_in_consts(self) -> None:
        """Copy the in-consts in; restore the old ones if that fails."""
        arrays = memory(self._instance).arrays
        ports = type(self._instance).__interface__.ports
        names = [port.attr for port in ports if port.kind is Kind.INCONST]
        before = {attr: arrays[attr].copy() for attr in names}
        try:
            self._accept(self._copies.copy_in_consts())
            check_sizes(self._instance, Kind.INCONST)
        except PbonetError as error:
            for attr, values in before.items():
                arrays[attr][...] = values
            if isinstance(error, PortError):
                raise RefusedError(error) from None
            raise

    def _copy_out_consts(self) -> None:
        check_sizes(self._instance, Kind.OUTCONST)
        self._accept(self._copies.copy_out_consts(self._task.now))

    def _copy_in_on(self) -> None:
        """Copy in what `on` needs, if the task can then own its out-vars."""
        try:
            self._copies.check_claim()
        except SvarError as error:
            raise RefusedError(error) from None
        self._task.reset()
        if isinstance(self._task.source, Counted):
            self._task.source.cyclecount = 0
        self._accept(self._copies.copy_in_on())

    def _claim(self) -> None:
        self._accept(self._copies.claim(self._stamp, self._task.cyclecount))
        self._owns = True

    def _commit(self) -> None:
        self._accept(self._copies.commit(self._stamp, self._task.cyclecount))

    @property
    def _stamp(self) -> int:
        """The time stamp of the outputs."""
        return self._task.stamp_ns or self._task.now

    def _release(self) -> None:
        if not self._owns:
            return
        self._owns = False
        if self.cede:
            self._copies.cede()
        else:
            self._copies.release()
