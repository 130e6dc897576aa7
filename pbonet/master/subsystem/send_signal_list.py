"""Sends an ordered list of signals, in as few messages as the order allows.

Tasks that take over from tasks on another RTPU stand by before the first signal is
sent: there the dispatcher engages them as soon as the others have ended, and nobody
waits for this master. On another machine they are called by its agent, with the news
that the others have ended.
"""

from __future__ import annotations

import contextlib
from itertools import chain
from typing import TYPE_CHECKING

from pbonet.errors import NoAnswerError, PbonetError, UnreachableError
from pbonet.master.configuration import stuck
from pbonet.pbo import State
from pbonet.xm.net import messages as m, rpc

from . import signal_list_split

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.master.configuration import Picture

    from .rtpu_clients import Fleet

Item = tuple[str, str]


def send(
    picture: Picture,
    fleet: Fleet,
    items: Sequence[Item],
    limit: float,
    *,
    before: Sequence[Item] = (),
) -> dict[str, str]:
    """Send signals in order; see `Crew.send`."""
    sending = _Sending(picture, fleet, items, limit, before)
    try:
        sending.have_heirs_stand_by()
        for step in signal_list_split.steps(picture, items, sending.heirs):
            sending.step(step)
    except PbonetError:
        sending.withdraw()
        raise
    return sending.states


class _Sending:
    """A list that is being sent."""

    def __init__(
        self,
        picture: Picture,
        fleet: Fleet,
        items: Sequence[Item],
        limit: float,
        before: Sequence[Item],
    ) -> None:
        self._picture = picture
        self._fleet = fleet
        self._limit = limit
        self._items = list(items)
        self._whole = [*before, *items]
        self._done = len(before)
        self._handover = signal_list_split.handed_over(picture, items)
        self._calls: dict[str, list[m.Call]] = {}
        self.heirs: dict[str, list[str]] = {}
        """Tasks that stand by, and who calls each."""
        self.states: dict[str, str] = {}

    def have_heirs_stand_by(self) -> None:
        """Have all tasks stand by that will be called from another RTPU.

        Raises:
            ReconfigError: One could not take over; nothing was done.
        """
        heirs = signal_list_split.across(self._picture, self._items)
        for heir, olds in heirs.items():
            if len(self._hosts([heir, *olds])) == 1:
                self._stand_by(heir, olds)
            elif all(
                self._are_apart(*one) for one in signal_list_split.bound(heirs, heir)
            ):
                self._stand_by(heir, olds, far=True)

    def _hosts(self, tasks: Sequence[str]) -> set[str]:
        return {self._fleet.agent(self._picture.find(task).rtpu).host for task in tasks}

    def _are_apart(self, heir: str, olds: list[str]) -> bool:
        """Tell whether tasks leave one RTPU for an heir on another machine."""
        rtpus = {self._picture.find(old).rtpu for old in olds}
        return len(rtpus) == 1 and not self._hosts([heir]) & self._hosts(olds)

    def _stand_by(self, heir: str, olds: list[str], *, far: bool = False) -> None:
        timeout = self._limit * (len(self._items) + 1)
        request = m.Heirs(after={heir: olds}, timeout=timeout, far=far)
        self.heirs[heir] = olds
        try:
            calls = self._fleet.call(
                self._picture.find(heir).rtpu,
                request,
                dict[str, list[m.Call]],
                timeout=self._limit,
            )
        except PbonetError as error:
            first = (heir, "on")
            others = [item for item in self._whole[self._done :] if item != first]
            whole = [*self._whole[: self._done], first, *others]
            raise stuck(whole, self._done, error) from error
        for old, theirs in calls.items():
            self._calls.setdefault(old, []).extend(theirs)

    def withdraw(self) -> None:
        """Have those stand by no longer that have not come on."""
        for heir in self.heirs:
            member = self._picture.get(heir)
            if member is not None and member.state is State.OFF:
                request = m.Heirs(after={heir: []})
                with contextlib.suppress(PbonetError):  # its time limit ends it, too
                    self._fleet.call(member.rtpu, request, dict[str, list[m.Call]])
        self.heirs, self._calls = {}, {}

    def step(self, parts: dict[str, list[Item]]) -> None:
        """Send what one RTPU is to do, or several at once.

        Raises:
            ReconfigError: An item failed.
        """
        answers, errors = self._send(parts)
        if again := {rtpu: one.rest for rtpu, one in answers.items() if one.unseen}:
            # It is another machine after all, whatever its name.
            self.withdraw()
            for rtpu, rest in again.items():
                made = parts[rtpu][: len(parts[rtpu]) - len(rest)]
                self._take(answers.pop(rtpu), made)
            more, failed = self._send(again)
            answers, errors = answers | more, errors | failed
        self._judge(parts | again, answers, errors)

    def _judge(
        self,
        parts: dict[str, list[Item]],
        answers: dict[str, m.Reconfigured],
        errors: dict[str, PbonetError],
    ) -> None:
        """Take in what was done; raise when that is not all."""
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
        made = {
            rtpu: [item for item in part if item not in left]
            for rtpu, part in parts.items()
        }
        whole = [*chain(*made.values()), *left]
        self._whole[self._done : self._done + len(whole)] = whole
        for rtpu, answer in answers.items():
            self._take(answer, made[rtpu])
        for cause in causes.values():
            unsure = sum(len(parts[rtpu]) for rtpu in unheard)
            raise stuck(self._whole, self._done, cause, unsure=unsure) from cause

    def _take(self, answer: m.Reconfigured, made: Sequence[Item]) -> None:
        for task, signal in made:
            self._picture.ordered(task, signal)
        for task, state in answer.states.items():
            self._picture.move(task, State(state))
        self.states |= answer.states
        self._done += len(made)

    def _send(
        self, parts: dict[str, list[Item]]
    ) -> tuple[dict[str, m.Reconfigured], dict[str, PbonetError]]:
        """Send each RTPU its part; return the answers, and why there are none."""
        limit = self._limit * max(map(len, parts.values()))
        requests = {rtpu: self._request(part, parts) for rtpu, part in parts.items()}
        if len(parts) > 1:
            answers, errors = self._fleet.each(
                lambda rtpu: requests[rtpu], m.Reconfigured, rtpus=parts, timeout=limit
            )
            silent = [rtpu for rtpu in parts if rtpu not in answers]
            return answers, dict(zip(silent, errors, strict=True))
        ((rtpu, request),) = requests.items()
        try:
            answer = self._fleet.call(rtpu, request, m.Reconfigured, timeout=limit)
        except PbonetError as error:
            return {}, {rtpu: error}
        return {rtpu: answer}, {}

    def _request(self, part: list[Item], parts: dict[str, list[Item]]) -> m.Reconfig:
        """Return what one RTPU is sent, while others are sent the other parts."""
        others = [task for one in parts.values() if one is not part for task, _ in one]
        rates = [self._picture.find(task).freq for task in others]
        return m.Reconfig(
            items=part,
            handover=self._handover,
            timeout=self._limit,
            calls={task: self._calls[task] for task, _ in part if task in self._calls},
            slowest=max((1.0 / rate for rate in rates if rate), default=0.0),
        )
