"""Sends an ordered list of signals, in as few messages as the order allows.

Tasks that take over from tasks on another RTPU stand by before the first signal is
sent. Those that end engage them, or on another machine the agent does, with the news
that the others have ended. No task waits for this master in between.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from itertools import chain
from typing import TYPE_CHECKING

from pbonet.errors import NoAnswerError, PbonetError, UnreachableError
from pbonet.master.configuration import stuck
from pbonet.pbo import State
from pbonet.xm.net import messages as m, rpc

from . import signal_list_split

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.master.configuration import TaskModel

    from .rtpu_clients import RtpuClients

Item = tuple[str, str]


def send(
    model: TaskModel,
    clients: RtpuClients,
    items: Sequence[Item],
    limit: float,
    *,
    before: Sequence[Item] = (),
) -> dict[str, str]:
    """Send signals in order; see `SubsystemTasks.send`."""
    sending = _Sending(model, clients, items, limit, before)
    try:
        sending.have_successors_stand_by()
        for step in signal_list_split.steps(model, items, sending.successors):
            sending.step(step)
    except PbonetError:
        sending.withdraw()
        raise
    return sending.states


class _Sending:
    """A list that is being sent."""

    def __init__(
        self,
        model: TaskModel,
        clients: RtpuClients,
        items: Sequence[Item],
        limit: float,
        before: Sequence[Item],
    ) -> None:
        self._model = model
        self._clients = clients
        self._limit = limit
        self._items = list(items)
        self._whole = [*before, *items]
        self._done = len(before)
        self._handover = signal_list_split.handed_over(model, items)
        self._calls: dict[str, list[m.Call]] = {}
        self.successors: dict[str, list[str]] = {}
        """Tasks that stand by, and the callers of each."""
        self.states: dict[str, str] = {}

    def have_successors_stand_by(self) -> None:
        """Have all tasks stand by that will be called from another RTPU.

        Raises:
            ReconfigError: One could not take over; nothing was done.
        """
        found = signal_list_split.across(self._model, self._items)
        for task, olds in found.items():
            self._stand_by(task, olds)

    def _machine(self, task: str) -> str:
        return self._clients.agent(self._model.find(task).rtpu).machine

    def _stand_by(self, task: str, olds: list[str]) -> None:
        here = self._machine(task)
        far = [old for old in olds if self._machine(old) != here]
        timeout = self._limit * (len(self._items) + 1)
        request = m.Successors(after={task: olds}, timeout=timeout, far=far)
        self.successors[task] = olds
        try:
            calls = self._clients.call(
                self._model.find(task).rtpu,
                request,
                dict[str, list[m.Call]],
                timeout=self._limit,
            )
        except PbonetError as error:
            first = (task, "on")
            others = [item for item in self._whole[self._done :] if item != first]
            whole = [*self._whole[: self._done], first, *others]
            raise stuck(whole, self._done, error) from error
        for old, theirs in calls.items():
            self._calls.setdefault(old, []).extend(theirs)

    def withdraw(self) -> None:
        """Have tasks stand by no longer that have not come on."""
        for task in self.successors:
            member = self._model.get(task)
            if member is not None and member.state is State.OFF:
                request = m.Successors(after={task: []})
                with contextlib.suppress(PbonetError):  # its time limit ends it, too
                    self._clients.call(member.rtpu, request, dict[str, list[m.Call]])
        self.successors, self._calls = {}, {}

    def _take_called(self, sent: int) -> dict[Item, str]:
        """End standing by; take in tasks that were called before their turn came.

        The dispatcher engages a task as soon as those it waits for have ended, though
        an item between them fails.

        Args:
            sent: How many items were sent, those that failed among them.

        Returns:
            Remarks on those that were called, and are not known to be ON.
        """
        gone = self._whole[:sent]
        called = [
            task
            for task, olds in self.successors.items()
            if (task, "on") in self._whole[sent:]
            and all((old, "off") in gone for old in olds)
        ]
        self.withdraw()
        remarks: dict[Item, str] = {}
        for task in called:
            state = self._state(task)
            if state is State.ON:
                self._whole.remove((task, "on"))
                self._whole.insert(self._done, (task, "on"))
                self._take(m.Reconfigured(done=1, states={task: "ON"}), [(task, "on")])
            elif state is None:
                remarks[task, "on"] = "may have come on: its RTPU does not say"
            elif state is not State.OFF:
                remarks[task, "on"] = f"was called, and is {state} now"
        return remarks

    def _state(self, task: str) -> State | None:
        """Return the state of a task from its RTPU; None if it does not answer."""
        member = self._model.get(task)
        if member is None:
            return State.NOT_CREATED
        try:
            status = self._clients.call(member.rtpu, m.Status(task=task), m.RtpuStatus)
        except PbonetError:
            return None
        states = [State(one.state) for one in status.tasks if one.task == task]
        return states[0] if states else State.NOT_CREATED

    def step(self, parts: dict[str, list[Item]]) -> None:
        """Send what one RTPU is to do, or several at once.

        Raises:
            ReconfigError: An item failed.
        """
        self._judge(parts, *self._send(parts))

    def _judge(
        self,
        parts: dict[str, list[Item]],
        answers: dict[str, m.Reconfigured],
        errors: dict[str, PbonetError],
    ) -> None:
        """Enter the items that were done; raise an error if some were not."""
        unheard = {
            rtpu: error
            for rtpu, error in errors.items()
            if isinstance(error, UnreachableError | NoAnswerError)
        }
        failed = {
            rtpu: rpc.placed(rtpu, PbonetError.from_wire(answer.error))
            for rtpu, answer in answers.items()
            if answer.error is not None
        }
        causes = unheard | failed | errors
        left: list[Item] = []
        for rtpu in causes:
            answer = answers.get(rtpu)
            done = answer.done if answer is not None else 0
            left += (answer.rest if answer is not None else []) or parts[rtpu][done:]
        made = {rtpu: _without(part, left) for rtpu, part in parts.items()}
        whole = [*chain(*made.values()), *left]
        sent = self._done + len(whole)
        self._whole[self._done : sent] = whole
        for rtpu, answer in answers.items():
            self._take(answer, made[rtpu])
        for cause in causes.values():
            remarks = self._take_called(sent)
            unsure = sum(len(parts[rtpu]) for rtpu in unheard)
            raise stuck(
                self._whole, self._done, cause, unsure=unsure, remarks=remarks
            ) from cause

    def _take(self, answer: m.Reconfigured, made: Sequence[Item]) -> None:
        for task, signal in made:
            self._model.ordered(task, signal)
        for task, state in answer.states.items():
            self._model.move(task, State(state))
        self.states |= answer.states
        self._done += len(made)

    def _send(
        self, parts: dict[str, list[Item]]
    ) -> tuple[dict[str, m.Reconfigured], dict[str, PbonetError]]:
        """Send each RTPU its part; return the answers, and why there are none."""
        limit = (1.0 + m.MOST_EXTRA) * self._limit * max(map(len, parts.values()))
        requests = {rtpu: self._request(part, parts) for rtpu, part in parts.items()}
        if len(parts) > 1:
            answers, errors = self._clients.each(
                lambda rtpu: requests[rtpu], m.Reconfigured, rtpus=parts, timeout=limit
            )
            silent = [rtpu for rtpu in parts if rtpu not in answers]
            return answers, dict(zip(silent, errors, strict=True))
        ((rtpu, request),) = requests.items()
        try:
            answer = self._clients.call(rtpu, request, m.Reconfigured, timeout=limit)
        except PbonetError as error:
            return {}, {rtpu: error}
        return {rtpu: answer}, {}

    def _request(self, part: list[Item], parts: dict[str, list[Item]]) -> m.Reconfig:
        """Return what one RTPU is sent, while others are sent the other parts."""
        others = [task for one in parts.values() if one is not part for task, _ in one]
        rates = [self._model.find(task).freq for task in others]
        return m.Reconfig(
            items=part,
            handover=self._handover,
            timeout=self._limit,
            calls={task: self._calls[task] for task, _ in part if task in self._calls},
            slowest=max((1.0 / rate for rate in rates if rate), default=0.0),
        )


def _without(items: Sequence[Item], left: Sequence[Item]) -> list[Item]:
    """Return the items that were done: the rest came last."""
    undone = Counter(left)
    found: list[Item] = []
    for item in reversed(items):
        if undone[item]:
            undone[item] -= 1
        else:
            found.insert(0, item)
    return found
