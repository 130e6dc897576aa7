"""The steps of a task's life: copies, and methods of the module."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pbonet.errors import DeclarationError, PbonetError, PortError, SvarError
from pbonet.node.wire import Step
from pbonet.outside import open_devices
from pbonet.pbo import Counted, PortBasedObject, check_sizes, memory, write_safe
from pbonet.ports import Kind, is_safe
from pbonet.svar import Action

from .step_failures import ALL_REFUSED, RefusedError, refused, too_old

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
        critical: What runs in place of `cycle` while the flag is up.
        devices: What the module has open for writing.

    Raises:
        DeclarationError: A CRITICAL task whose module has no ``stable`` and no safe
            values.
    """

    def __init__(
        self,
        instance: PortBasedObject[Any],
        copies: Copies,
        illegal: Callable[[], bool] | None,
    ) -> None:
        declared = type(instance).__interface__
        has_stable = "stable" in declared.methods
        if illegal is not None and not has_stable and not is_safe(declared.ports):
            raise DeclarationError(
                "a CRITICAL task needs a module with stable()",
                where=type(instance).__name__,
                expected="stable(), or a safe value of each out-var",
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
        self.critical = Action.GO_ON
        if illegal is not None:
            self.critical = Action.STABLE if has_stable else Action.SAFE
        self.devices = open_devices.Openings()
        self._safe_ports = write_safe(instance)
        self._action = 0
        self.do: dict[Step, Callable[[], object]] = {
            Step.COPY_IN_CONSTS: self._copy_in_consts,
            Step.COPY_OUT_CONSTS: self._copy_out_consts,
            Step.COPY_IN: self._copy_in,
            Step.COPY_IN_ON: self._copy_in_on,
            Step.COPY_IN_AGAIN: lambda: self._accept(copies.copy_in_on()),
            Step.CLAIM: self._claim,
            Step.COMMIT: self._commit,
            Step.RELEASE: self._release,
            Step.INIT: instance.init,
            Step.ON_METHOD: instance.on,
            Step.CYCLE: lambda: self._choose(self.dt),
            Step.OFF_METHOD: instance.off,
            Step.KILL: instance.kill,
            Step.CLEAR: instance.clear,
            Step.REINIT: instance.reinit,
            Step.SYNC: instance.sync,
        }

    def _copy_in(self) -> None:
        self._accept(self._copies.copy_in())
        self._action = self._copies.action
        if not self._action and self._illegal is not None and self._illegal():
            self._action = self.critical

    def _choose(self, dt: float) -> None:
        """Run `cycle`, or what runs in its place because inputs are too old."""
        self.method = "stable" if self._action == Action.STABLE else "cycle"
        if self._action == Action.GO_ON:
            self._instance.cycle(dt)
        elif self._action == Action.STABLE:
            self._instance.stable(dt)
        elif self._action == Action.SAFE:
            self.safe(dt)
        elif self._action == Action.ERROR:
            raise too_old(self._copies.blamed)

    def safe(self, dt: float) -> None:
        """Write the safe values of out-vars and devices that have some."""
        self._safe_ports(dt)
        self.devices.repeat()

    def was_made_safe(self) -> None:
        """Take the safe values into the out-vars: they were committed already."""
        self._safe_ports(0.0)
        self._copies.was_made_safe()

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
        task = self._task
        self._accept(self._copies.claim(task.now, task.cyclecount, task.stamp_ns))
        self._owns = True

    def _commit(self) -> None:
        """Copy the outputs out; not in a cycle that was skipped."""
        action, self._action = self._action, Action.GO_ON
        if action == Action.HOLD:
            return
        if action:
            self._copies.make_new()
        task = self._task
        own_ns = 0 if action else task.stamp_ns
        self._accept(self._copies.commit(task.now, task.cyclecount, own_ns))

    def _release(self) -> None:
        if not self._owns:
            return
        self._owns = False
        if self.cede:
            self._copies.cede()
        else:
            self._copies.release()
