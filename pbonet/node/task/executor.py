"""Runs the methods of one instance, with the right copies before and after each.

Task processes, the bench and the simulator use it. It follows the rules in
`pbonet.node.wire.lifecycle`.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

from pbonet.errors import MethodError, StateError
from pbonet.node.wire import (
    NOT_MADE,
    RULES,
    Event,
    Failure,
    Outcome,
    Rule,
    Step,
    outcome,
    rule,
    signal_event,
)
from pbonet.outside import open_devices
from pbonet.pbo import (
    Answer,
    Counted,
    CycleAborted,
    Handling,
    PortBasedObject,
    Recovery,
    Signal,
    State,
    TaskFailure,
    TimingFailure,
    change_param,
    find_param,
)

from .lifecycle_steps import LifecycleSteps
from .step_failures import (
    RAISED,
    Raised,
    RefusedError,
    StepFailed,
    add_remedy,
    answered,
    bad_answer,
    contained,
    is_answer,
    method_error,
    name_bad_inputs,
    recovery,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from .port_transfer import Copies


BY_INPUTS = frozenset({"on", "cycle", "stable"})
"""Methods that fail for an input that is no number."""
_ALIVE = frozenset({State.OFF, State.ON, State.ERROR})


class Executor:
    """Runs one instance of a module through its life.

    Args:
        instance: Bound by `pbonet.pbo.bind`.
        copies: Transfers its ports.
        illegal: For a CRITICAL task: returns whether the illegal-configuration flag is
            up; `cycle` then runs ``stable`` instead, or writes safe values.

    Raises:
        DeclarationError: A CRITICAL task whose module has no ``stable`` and no safe
            values.
    """

    def __init__(
        self,
        instance: PortBasedObject[Any],
        copies: Copies,
        *,
        illegal: Callable[[], bool] | None = None,
    ) -> None:
        self.instance = instance
        self.task = instance.task
        self.state = State.NOT_CREATED
        self.failure: MethodError | None = None
        """The last failure of a method, whatever `error` answered."""
        self.cycling: Callable[[], str] = lambda: "cycle"
        """Returns the method that runs now; set by the owner of a native loop."""
        self.made_safe = False
        """Whether the cycle under way has failed in time and the table has the safe
        values of its out-vars; set by the owner of the loop before `abort` or `fault`,
        which take them into the out-vars."""
        self._spent = False
        self._outdated = False
        self._actions = LifecycleSteps(instance, copies, illegal)
        self._do = self._actions.do
        self._devices = self._actions.devices
        self._wakeup = tuple(
            self._do[step] for step in RULES[State.ON, Event.WAKEUP].steps
        )
        self._counted = (
            self.task.source if isinstance(self.task.source, Counted) else None
        )

    @property
    def critical(self) -> int:
        """The action in place of `cycle` while the flag is up: `pbonet.svar.Action`."""
        return self._actions.critical

    def write_safe(self, dt: float) -> None:
        """Write the safe values of out-vars and devices that have some."""
        self._actions.safe(dt)

    # -- signals ----------------------------------------------------------------------

    def spawn(self) -> State:
        """Run `init`; the task is OFF afterwards.

        Raises:
            MethodError: It failed; `kill` has run and the task is NOT-CREATED.
            StateError: The instance has been initialised before.
        """
        if self._spent:
            raise StateError(
                "a task is created once",
                where=self.task.name,
                remedy="bind a new instance",
            )
        self._spent = True
        return self._run(Event.SPAWN)

    def signal(
        self, name: str, arg: str = "", *, handover: bool = False, cede: bool = False
    ) -> State:
        """Carry out ``on``, ``off``, ``kill``, ``clear`` or ``reinit``.

        Args:
            name: The signal.
            arg: Text for the module, as ``self.task.arg``.
            handover: For ``off`` and ``kill``: a successor takes over the outputs. For
                ``on``: this task does, from a predecessor.
            cede: For ``off``: the successor takes them over in its own claim.

        Returns:
            The state afterwards. For ``on`` it may be OFF if the module cannot start
            yet; for ``clear`` it may be ERROR.

        Raises:
            StateError: The signal is not valid in this state; nothing was done.
            SvarOwnerError: ``on``: another task writes an out-var; nothing was done.
            PortError: ``reinit``: a size changed; the old constants remain.
            MethodError: A method failed and the error was not corrected; `state` is the
                task's new state.
        """
        event = signal_event(name, where=self.task.name)
        self.task.arg = arg
        self.task.handover = handover
        self._actions.cede = cede
        try:
            if event is Event.ON and self.state is State.OFF and self._outdated:
                self._run(Event.REINIT)
            return self._run(event)
        finally:
            self._actions.cede = False
            self.task.arg = ""
            self.task.handover = False

    def set(self, name: str, words: tuple[str, ...], *, where: str = "") -> object:
        """Change a parameter between two cycles; return the new value.

        Args:
            name: The parameter.
            words: Its value, as the words of a LOCAL line.
            where: The place of the value, for errors.

        Raises:
            ParameterError: There is no such parameter, or the value is refused.
            MethodError: The module refused it; the old value remains.
            StateError: There is no task.
        """
        rule(self.state, Event.SET, where=self.task.name)
        before = self.instance.params
        params = change_param(
            before,
            name,
            words,
            where=where or self.task.name,
            running=self.state is State.ON,
        )
        key = find_param(before, name)
        self.instance.params = params
        try:
            self._call(Event.SET, Step.SET, key, getattr(params, key))
        except MethodError as error:
            self.instance.params = before
            add_remedy(error, f"the old value of {key} remains")
            raise
        return getattr(params, key)

    def get(self, name: str) -> object:
        """Return a parameter's current value, as returned by the module's `get`.

        Raises:
            ParameterError: There is no such parameter.
            MethodError: The module's `get` failed.
            StateError: There is no task.
        """
        rule(self.state, Event.GET, where=self.task.name)
        key = find_param(self.instance.params, name, where=self.task.name)
        return self._call(Event.GET, Step.GET, key)

    # -- cycling ----------------------------------------------------------------------

    def cycle(self, dt: float, now: int | None = None) -> State:
        """Run one cycle in Python: copy in, the module's method, copy out.

        Args:
            dt: Seconds since the release of the last executed cycle.
            now: Value of ``self.task.now`` during the cycle, in nanoseconds.

        Returns:
            The state afterwards; OFF if the module asked for it.

        Raises:
            StateError: The task is not ON.
        """
        if self.state is not State.ON:
            rule(self.state, Event.WAKEUP, where=self.task.name)
        self._actions.dt = dt
        open_devices.use(self._devices)
        counted = self._counted
        if counted is not None:
            counted.release = now
        try:
            for do in self._wakeup:
                do()
        except CycleAborted:
            with suppress(MethodError):  # it is kept in `failure`, as for a cycle
                self.abort()
        except RAISED as error:
            self.fault(error, self._actions.method)
        finally:
            if counted is not None:
                counted.release = None
                counted.cyclecount += 1
        if self.task.off_requested and self.state is State.ON:
            return self.signal("off")
        return self.state

    def sync(self) -> State:
        """Run the module's `sync`, which waits for the event of a synchronous task.

        Returns ON when the event came, otherwise the state that `error` chose after a
        failure.

        Raises:
            StateError: The task is not ON.
        """
        found = rule(self.state, Event.SYNC, where=self.task.name)
        open_devices.use(self._devices)
        try:
            self._steps(found, found.steps)
        except StepFailed as failed:
            self.fault(failed.cause, str(failed.step))
        return self.state

    def fault(self, error: BaseException, method: str = "cycle") -> State:
        """Let `error` handle an exception of a cycle; return the new state.

        The owner of the native loop calls this with any exception from the loop,
        including an error made from refused flags.

        Args:
            error: The exception.
            method: The method that raised it: ``cycle``, ``stable``, ``sync`` or
                ``timing_failure``.
        """
        event = Event.SYNC if method == "sync" else Event.WAKEUP
        cause = contained(error)
        self._take_safe()
        found = rule(self.state, event, where=self.task.name)
        self._put_right(found, cause, self._described(cause, method))
        return self.state

    def timing_failure(self, kind: TimingFailure) -> Recovery:
        """Call the module's handler in the middle of a cycle (section 6.3).

        Nothing is copied. The caller continues, calls `abort`, or skips a release,
        depending on what is returned. A module without a handler continues, with a
        warning.

        Raises:
            StateError: The task is not ON.
            MethodError: The handler returned an unknown answer.
            Exception: The handler's exception: an error of the task, as if the cycle
                had raised it; pass it to `fault`.
        """
        task, cls = self.task, type(self.instance)
        if self.state is not State.ON:
            raise StateError(
                "only a task that is ON has timing failures",
                where=task.name,
                got=f"state {self.state}",
                remedy="turn it on first",
            )
        if "timing_failure" not in cls.__interface__.methods:
            task.warn(f"timing failure, {kind}: {kind.meaning}")
            return Recovery.CONTINUE
        before = self._actions.method
        self._actions.method = "timing_failure"
        task.handling = kind
        try:
            answer = recovery(self.instance.timing_failure(kind))
        finally:
            task.handling = None
        self._actions.method = before
        return answer

    def _take_safe(self) -> None:
        """Take the safe values into the out-vars if the failed cycle has got them."""
        if self.made_safe:
            self.made_safe = False
            self._actions.was_made_safe()

    def abort(self) -> State:
        """Restart after a cycle that a timing failure ended: `on` runs again.

        The cycle's values of the out-vars are discarded; the task still owns them.

        Returns:
            The state afterwards: ON, or OFF if `on` answers that it cannot continue.

        Raises:
            StateError: The task is not ON.
            MethodError: `on` failed and the error was not corrected; `state` is the
                task's new state.
        """
        self._take_safe()
        self.task.restart_rng()
        self.task.handover = True
        try:
            return self._run(Event.ABORT)
        finally:
            self.task.handover = False

    # -- one event --------------------------------------------------------------------

    def _run(self, event: Event) -> State:
        found = rule(self.state, event, where=self.task.name)
        self._enter(found)
        try:
            self._steps(found, found.steps)
        except StepFailed as failed:
            if event is Event.REINIT and not isinstance(failed.cause, RefusedError):
                self._outdated = True
            self._recover(found, failed)
        if event is Event.REINIT:
            self._outdated = False
        return self.state

    def _enter(self, found: Rule) -> None:
        open_devices.use(self._devices)
        task = self.task
        task.nextstate = found.to
        task.on_fail = self._on_fail if found.failure is Failure.ERROR else None

    def _steps(self, found: Rule, steps: tuple[Step, ...]) -> None:
        """Take the steps of a rule, then enter its end state or that of an answer."""
        end: Outcome | None = None
        for step in steps:
            end = self._take(found, step)
            if end is not None:
                break
        for step in end.steps if end else ():
            self._take(found, step)
        to = end.to if end else found.to
        if (errors := self._make_safe(to)) and to is not State.ERROR:
            ended = to is State.NOT_CREATED
            step = Step.KILL if ended else next(s for s in found.steps if s.is_method)
            raise StepFailed(step, contained(errors[0]))
        self._enter_state(to)

    def _take(self, found: Rule, step: Step) -> Outcome | None:
        """Take one step; return the outcome of its answer, None to continue."""
        self._actions.method = str(step)
        if step is Step.KILL:
            self.task.on_fail = None
        try:
            result = self._do[step]()
            return answered(found, step, result) if found.answers else None
        except RAISED as error:
            raise StepFailed(step, contained(error)) from None

    def _go(self, state: State) -> None:
        """Enter `state`; in any but ON the devices of the task have safe values."""
        self._make_safe(state)
        self._enter_state(state)

    def _make_safe(self, state: State) -> list[Exception]:
        """Write devices' safe values before `state`; return what was not written."""
        if state is State.ON:
            return []
        errors = self._devices.make_safe(close=state is State.NOT_CREATED)
        for error in errors:
            self.task.warn(f"the safe values were not written: {error}")
        return errors

    def _enter_state(self, state: State) -> None:
        task = self.task
        self.state = task.state = task.nextstate = state
        task.on_fail = self._on_fail if state is State.ON else None
        self._actions.method = "cycle"

    # -- failures ---------------------------------------------------------------------

    def _recover(self, found: Rule, failed: StepFailed) -> None:
        """Apply the rule to a failure; raise it unless it was corrected."""
        if isinstance(failed.cause, RefusedError) and self.state in _ALIVE:
            self._go(self.state)
            raise failed.cause.error from None
        failure = self._described(failed.cause, str(failed.step))
        if failed.step is Step.KILL or found.failure is Failure.GO_ON:
            self._go(found.to)
        elif found.failure is Failure.KILL:
            self._follow(NOT_MADE, failure)
        elif found.failure is Failure.REPORT:
            self._go(self.state)
        else:
            left = self._put_right(found, failed.cause, failure)
            if left is None:
                return
            failure = left
        if self.state is State.NOT_CREATED and found.failure is not Failure.KILL:
            add_remedy(failure, "the task has ended anyway")
        raise failure from failed.cause

    def _put_right(
        self, found: Rule, error: Raised, failure: MethodError
    ) -> MethodError | None:
        """Call `error`, unless it was called already, and apply its answer.

        In a combination, the parts after the failed one may fail as well.

        Returns:
            The failure that remains; None if `error` answered CONTINUE and that
            succeeded.
        """
        while (answer := self._answer(error, failure)) is Answer.CONTINUE:
            try:
                answer = self.instance.__resumed__() or answer
                break
            except RAISED as second:
                before, error = failure, contained(second)
                failure = self._described(error, self._actions.method)
                add_remedy(failure, f"before that was corrected: {before}")
        if answer is Answer.CONTINUE:
            try:
                self._steps(found, found.resume)
            except StepFailed as failed:
                failure = self._described(failed.cause, str(failed.step))
                if failed.step is Step.KILL:
                    self._go(found.to)
                    return failure
                answer = Answer.ERROR
            else:
                return None
        self._follow(outcome(found, answer), failure)
        return failure

    def _answer(self, error: Raised, failure: MethodError) -> Answer:
        """Return the answer of handlers or of `error`, given in ``fail()`` or now."""
        if isinstance(error, TaskFailure) and error.answer is not None:
            if error.answer is Answer.CONTINUE:  # from a handler that jumps
                self.failure = None
            return error.answer
        shown = error.error if isinstance(error, TaskFailure) else error
        try:
            settled = self.task.settle(shown) is not Handling.ABORT
        except RAISED as second:
            self._also(failure, contained(second), self._actions.method)
            settled = False
        if settled:
            self.failure = None
            return Answer.CONTINUE
        return self._ask(error, failure)

    def _follow(self, after: Outcome, failure: MethodError) -> None:
        """Apply an outcome; further failures are reported with `failure`."""
        self.task.on_fail = None
        self.task.nextstate = after.to
        self._actions.cede = False
        for step in after.steps:
            try:
                self._do[step]()
            except RAISED as error:
                self._also(failure, contained(error), str(step))
        self._go(after.to)
        if after.to is State.ERROR:
            self.task.signal(Signal.ERROR, self.task.errmsg)

    def _on_fail(self, error: MethodError) -> Answer:
        """Call the module's `error` for ``self.task.fail()``."""
        method = (
            self.cycling() if self._actions.method == "cycle" else self._actions.method
        )
        return self._ask(error, self._described(error, method))

    def _ask(self, error: Raised, failure: MethodError) -> Answer:
        """Call the module's `error`; an exception in it counts as the answer ERROR."""
        task, before = self.task, self.task.on_fail
        shown = error.error if isinstance(error, TaskFailure) else error
        task.on_fail = None
        try:
            answer = self.instance.error(shown)
            if not is_answer(answer):
                raise bad_answer("error", answer, None)
        except RAISED as second:
            self._also(failure, contained(second), "error")
            return Answer.ERROR
        finally:
            task.on_fail = before
        return answer

    def _described(self, error: Raised, method: str) -> MethodError:
        """Return `error` as the error of a method, and store it in the context."""
        asked = isinstance(error, TaskFailure) and error.answer is not None
        if asked and self.failure is not None:
            return self.failure  # stored when `error` was called
        described = method_error(error, method, self._who())
        if method in BY_INPUTS:
            name_bad_inputs(described, self.instance)
        self.task.errmsg = str(described)
        self.failure = described
        if not isinstance(error, TaskFailure | MethodError):
            self.task.errnum = 1
        return described

    def _who(self) -> str:
        """Return the task; for a combination, the part that failed."""
        part = self.task.at()
        return f"{self.task.name}.{part}" if part else self.task.name

    def _also(self, failure: MethodError, error: Raised, method: str) -> None:
        """Add a failure that is a consequence of `failure` to it."""
        second = method_error(error, method, self._who())
        add_remedy(failure, f"and then {second}")
        self.task.errmsg = str(failure)

    def _call(self, event: Event, step: Step, *args: object) -> object:
        """Call `set` or `get`, which have arguments and do not change the state."""
        self._enter(rule(self.state, event, where=self.task.name))
        method: Callable[..., object] = getattr(self.instance, str(step))
        try:
            return method(*args)
        except RAISED as error:
            raise self._described(cause := contained(error), str(step)) from cause
        finally:
            self._enter_state(self.state)
