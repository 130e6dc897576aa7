"""Runs the methods of one instance, with the right copies before and after each.

The same `Executor` serves the task process (where the native loop does the cycling),
`pbonet.testing.Bench` and the simulator (where `Executor.cycle` does). It obeys the
tables of `pbonet.node.lifecycle` and knows neither processes nor shared memory.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pbonet.errors import (
    DeclarationError,
    MethodError,
    PortError,
    StateError,
    SvarError,
)
from pbonet.pbo import (
    Answer,
    Counted,
    PortBasedObject,
    Signal,
    State,
    TaskFailure,
    change_param,
    check_sizes,
    find_param,
    memory,
)
from pbonet.ports import Kind

from .failures import (
    ALL_REFUSED,
    RAISED,
    Raised,
    RefusedError,
    StepFailed,
    bad_answer,
    contained,
    is_answer,
    method_error,
    refused,
)
from .lifecycle import ANSWERED, RULES, Event, Failure, Rule, Step, rule, signal_event

if TYPE_CHECKING:
    from collections.abc import Callable

    from .copies import Copies


_ALIVE = frozenset({State.OFF, State.ON, State.ERROR})


class Executor:
    """Runs one instance of a module through its life.

    Args:
        instance: Bound by `pbonet.pbo.bind`.
        copies: Carries its ports.
        illegal: Given for a CRITICAL task: tells whether the illegal-configuration flag
            is up, in which case `cycle` runs ``stable`` instead.

    Raises:
        DeclarationError: A CRITICAL task whose module has no ``stable``.
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
        """What a method failed with last, whatever `error` made of it."""
        self._owns = False
        self._spent = False
        self._dt = 0.0
        self._method = ""
        self._copies = copies
        self._illegal = illegal
        self._counted = (
            self.task.source if isinstance(self.task.source, Counted) else None
        )
        self._do = self._actions()
        self._wakeup = tuple(
            self._do[step] for step in RULES[State.ON, Event.WAKEUP].steps
        )
        cls = type(instance)
        if illegal is not None and "stable" not in cls.__interface__.methods:
            raise DeclarationError(
                "a CRITICAL task needs a module with stable()",
                where=cls.__name__,
                remedy="write `def stable(self, dt: float) -> None`, or take CRITICAL "
                "out of the .rmod file",
            )

    # -- signals ----------------------------------------------------------------------

    def spawn(self) -> State:
        """Run `init`; the task is OFF behind it.

        Raises:
            MethodError: It failed; `kill` has run and the task is NOT-CREATED.
            StateError: The instance has had its life.
        """
        if self._spent:
            raise StateError(
                "a task is created once",
                where=self.task.name,
                remedy="bind a new instance",
            )
        self._spent = True
        return self._run(Event.SPAWN)

    def signal(self, name: str, arg: str = "", *, handover: bool = False) -> State:
        """Carry out ``on``, ``off``, ``kill``, ``clear`` or ``reinit``.

        Args:
            name: The signal.
            arg: Text for the module, as ``self.task.arg``.
            handover: For ``off`` and ``kill``: a successor takes over the outputs.

        Returns:
            The state behind it. For ``on`` it may be OFF, when the module cannot start
            yet; for ``clear`` it may be ERROR.

        Raises:
            StateError: The signal is not valid in this state; nothing happened.
            SvarOwnerError: ``on``: another task writes an out-var; nothing happened.
            PortError: ``reinit``: a size changed; the old constants stand.
            MethodError: A method failed and was not put right; `state` says where the
                task stands now.
        """
        event = signal_event(name, where=self.task.name)
        self.task.arg = arg
        self.task.handover = handover
        try:
            return self._run(event)
        finally:
            self.task.arg = ""
            self.task.handover = False

    def set(self, name: str, words: tuple[str, ...], *, where: str = "") -> object:
        """Change a parameter, between two cycles.

        Args:
            name: The parameter.
            words: Its value, as the words of a LOCAL line.
            where: The place of the value, for errors.

        Returns:
            The new value.

        Raises:
            ParameterError: No such parameter, or the value is refused.
            MethodError: The module refused it; the old value stands.
            StateError: There is no task.
        """
        rule(self.state, Event.SET, where=self.task.name)
        before = self.instance.params
        params = change_param(before, name, words, where=where or self.task.name)
        key = find_param(before, name)
        self.instance.params = params
        try:
            self._call(Event.SET, Step.SET, key, getattr(params, key))
        except MethodError:
            self.instance.params = before
            raise
        return getattr(params, key)

    def get(self, name: str) -> object:
        """Return a parameter's present value, as the module's `get` gives it.

        Raises:
            ParameterError: There is no such parameter.
            MethodError: The module's `get` failed.
            StateError: There is no task.
        """
        rule(self.state, Event.GET, where=self.task.name)
        key = find_param(self.instance.params, name, where=self.task.name)
        return self._call(Event.GET, Step.GET, key)

    # -- cycling ----------------------------------------------------------------------

    @property
    def law(self) -> Callable[[float], object]:
        """What a cycle calls: `cycle`, or the choice between it and ``stable``."""
        return self.instance.cycle if self._illegal is None else self._choose

    def cycle(self, dt: float, now: int | None = None) -> State:
        """Do one cycle here, in Python: copies, the module's law, copies.

        Args:
            dt: Seconds since the release of the last executed cycle.
            now: What ``self.task.now`` is during the cycle, in nanoseconds.

        Returns:
            The state behind it; OFF when the module asked for it.

        Raises:
            StateError: The task is not ON.
        """
        if self.state is not State.ON:
            rule(self.state, Event.WAKEUP, where=self.task.name)
        self._dt = dt
        counted = self._counted
        if counted is not None:
            counted.release = now
        try:
            for do in self._wakeup:
                do()
        except RAISED as error:
            self.fault(contained(error))
        finally:
            if counted is not None:
                counted.release = None
                counted.cyclecount += 1
        if self.task.off_requested and self.state is State.ON:
            return self.signal("off")
        return self.state

    def sync(self) -> State:
        """Wait for the event that wakes a synchronous task: runs the module's `sync`.

        Returns:
            ON when the event came; else what `error` made of a failure.

        Raises:
            StateError: The task is not ON.
        """
        found = rule(self.state, Event.SYNC, where=self.task.name)
        try:
            self._steps(found, found.steps)
        except StepFailed as failed:
            self._ask_and_obey(found, failed.cause, str(failed.step))
        return self.state

    def fault(self, error: BaseException, method: str = "cycle") -> State:
        """Have `error` deal with what a cycle raised, and return the next state.

        The native loop's owner calls this with whatever came out of the loop, an error
        made from refused flags included.

        Args:
            error: What was raised.
            method: Which method raised it: ``cycle``, ``stable`` or ``sync``.
        """
        event = Event.SYNC if method == "sync" else Event.WAKEUP
        self._ask_and_obey(rule(self.state, event), contained(error), method)
        return self.state

    # -- one event --------------------------------------------------------------------

    def _run(self, event: Event) -> State:
        found = rule(self.state, event, where=self.task.name)
        self._enter(found)
        try:
            self._steps(found, found.steps)
        except StepFailed as failed:
            self._recover(found, failed)
        return self.state

    def _enter(self, found: Rule) -> None:
        task = self.task
        task.state = self.state
        task.nextstate = found.to
        task.on_fail = self._ask if found.failure is Failure.ERROR else None

    def _steps(self, found: Rule, steps: tuple[Step, ...]) -> None:
        """Take the steps of a rule, and go to its end or where an answer sends."""
        for step in steps:
            self._method = str(step)
            if step is Step.KILL:
                self.task.on_fail = None
            try:
                result = self._do[step]()
                end = self._end(found, step, result) if found.answers else None
            except RAISED as error:
                raise StepFailed(step, contained(error)) from None
            if end is not None:
                self._go(end)
                return
        self._go(found.to)

    @staticmethod
    def _end(found: Rule, step: Step, answer: object) -> State | None:
        """Return where the answer of a method ends the rule, None to go on."""
        if not step.is_method:
            return None
        if answer is not None and not isinstance(answer, Answer):
            raise bad_answer(step, answer, found)
        if answer not in found.answers:
            raise bad_answer(step, answer, found)
        return found.answers[answer]

    def _go(self, state: State) -> None:
        """Be in `state`."""
        task = self.task
        self.state = task.state = task.nextstate = state
        task.on_fail = self._ask if state is State.ON else None
        self._method = "cycle"

    # -- failures ---------------------------------------------------------------------

    def _recover(self, found: Rule, failed: StepFailed) -> None:
        """Do what the rule says about a failure, then raise it unless put right."""
        if isinstance(failed.cause, RefusedError) and self.state in _ALIVE:
            self._go(self.state)
            raise failed.cause.error from None
        method = self._described(failed.cause, str(failed.step))
        if failed.step is Step.KILL or found.failure is Failure.GO_ON:
            self._go(found.to)
        elif found.failure is Failure.KILL:
            self._kill_after(method)
        elif found.failure is Failure.REPORT:
            self._go(self.state)
        elif self._ask_and_obey(found, failed.cause, str(failed.step)):
            return
        raise method from failed.cause

    def _kill_after(self, method: MethodError) -> None:
        """Run `kill` behind a failed `init`."""
        self.task.on_fail = None
        self.task.nextstate = State.NOT_CREATED
        try:
            self._do[Step.KILL]()
        except RAISED as error:
            second = self._described(contained(error), "kill")
            method.remedy = "; ".join(filter(None, [method.remedy, str(second)]))
        self._go(State.NOT_CREATED)

    def _ask_and_obey(self, found: Rule, error: Raised, method: str) -> bool:
        """Ask `error` unless it was asked, and obey; True when it answered CONTINUE."""
        answer = error.answer if isinstance(error, TaskFailure) else None
        if answer is None:
            self._method = method
            answer = self._ask(error)
        if answer is not Answer.CONTINUE:
            self._obey(answer)
            return False
        try:
            self.task.nextstate = found.to
            self._steps(found, found.resume)
        except StepFailed as failed:
            second = self._described(failed.cause, str(failed.step))
            if failed.step is Step.KILL:
                self._go(found.to)
            else:
                self._obey(Answer.ERROR)
            raise second from failed.cause
        return True

    def _obey(self, answer: Answer) -> None:
        outcome = ANSWERED[answer]
        for step in outcome.steps:
            self._do[step]()
        self._go(outcome.to)
        if outcome.to is State.ERROR:
            self.task.signal(Signal.ERROR, self.task.errmsg)

    def _ask(self, error: Raised) -> Answer:
        """Run the module's `error`; an error in there is the answer ERROR."""
        task, before = self.task, self.task.on_fail
        described = self._described(error, self._method)
        shown = error.error if isinstance(error, TaskFailure) else error
        task.on_fail = None
        try:
            answer = self.instance.error(shown)
            if not is_answer(answer):
                raise bad_answer("error", answer, None)
        except RAISED as second:
            also = self._described(contained(second), "error")
            task.errmsg = f"{described}; and then {also}"
            return Answer.ERROR
        finally:
            task.on_fail = before
        return answer

    def _described(self, error: Raised, method: str) -> MethodError:
        """Return `error` as the error of a method, and note it in the context."""
        described = method_error(error, method, self.task.name)
        self.task.errmsg = str(described)
        self.failure = described
        if not isinstance(error, TaskFailure | MethodError):
            self.task.errnum = 1
        return described

    def _call(self, event: Event, step: Step, *args: object) -> object:
        """Call `set` or `get`, which have arguments and change no state."""
        self._enter(rule(self.state, event, where=self.task.name))
        method: Callable[..., object] = getattr(self.instance, str(step))
        try:
            return method(*args)
        except RAISED as error:
            cause = contained(error)
            raise self._described(cause, str(step)) from cause
        finally:
            self._go(self.state)

    # -- steps ------------------------------------------------------------------------

    def _actions(self) -> dict[Step, Callable[[], object]]:
        copies, instance = self._copies, self.instance
        law = self.law
        return {
            Step.COPY_IN_CONSTS: self._copy_in_consts,
            Step.COPY_OUT_CONSTS: self._copy_out_consts,
            Step.COPY_IN: lambda: self._accept(copies.copy_in()),
            Step.COPY_IN_ON: self._copy_in_on,
            Step.CLAIM: self._claim,
            Step.COMMIT: self._commit,
            Step.RELEASE: self._release,
            Step.INIT: instance.init,
            Step.ON_METHOD: instance.on,
            Step.CYCLE: lambda: law(self._dt),
            Step.OFF_METHOD: instance.off,
            Step.KILL: instance.kill,
            Step.CLEAR: instance.clear,
            Step.REINIT: instance.reinit,
            Step.SYNC: instance.sync,
        }

    def _choose(self, dt: float) -> None:
        if self._illegal is not None and self._illegal():
            self.instance.stable(dt)
        else:
            self.instance.cycle(dt)

    def _accept(self, flags: int) -> None:
        """Raise when the flags of a copy say that it was refused."""
        if flags & ALL_REFUSED:
            raise refused(flags, self._copies.blamed)

    def _copy_in_consts(self) -> None:
        """Copy in-consts in; refuse other sizes, and put the old values back."""
        arrays = memory(self.instance).arrays
        ports = type(self.instance).__interface__.ports
        before = {
            port.attr: arrays[port.attr].copy()
            for port in ports
            if port.kind is Kind.INCONST
        }
        self._accept(self._copies.copy_in_consts())
        try:
            check_sizes(self.instance, Kind.INCONST)
        except PortError as error:
            for attr, values in before.items():
                arrays[attr][...] = values
            raise RefusedError(error) from None

    def _copy_out_consts(self) -> None:
        check_sizes(self.instance, Kind.OUTCONST)
        self._accept(self._copies.copy_out_consts(self.task.now))

    def _copy_in_on(self) -> None:
        """Copy in what `on` wants, if the task may then own its out-vars."""
        try:
            self._copies.check_claim()
        except SvarError as error:
            raise RefusedError(error) from None
        self.task.reset()
        if self._counted is not None:
            self._counted.cyclecount = 0
        self._accept(self._copies.copy_in_on())

    def _claim(self) -> None:
        self._accept(self._copies.claim(self.task.now, self.task.cyclecount))
        self._owns = True

    def _commit(self) -> None:
        self._accept(self._copies.commit(self.task.now, self.task.cyclecount))

    def _release(self) -> None:
        if self._owns:
            self._owns = False
            self._copies.release()
