"""Sends an ordered list of signals, in as few messages as the order allows.

Tasks that take over from tasks on another RTPU of the same machine stand by before the
first signal is sent: there the dispatcher engages them as soon as the others have
ended, and nobody waits for this master.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from pbonet.errors import NoAnswerError, PbonetError, UnreachableError
from pbonet.master import lists
from pbonet.master.failures import stuck
from pbonet.pbo import State
from pbonet.xm import messages as m
from pbonet.xm import rpc

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.master.fleet import Fleet
    from pbonet.master.picture import Picture

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
        for rtpu, part in lists.runs(picture, items):
            sending.part(rtpu, part)
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
        self._handover = lists.handed_over(picture, items)
        self._heirs: dict[str, list[str]] = {}
        self._calls: dict[str, list[m.Call]] = {}
        self.states: dict[str, str] = {}

    def have_heirs_stand_by(self) -> None:
        """Have all tasks stand by that will be called from another RTPU.

        Raises:
            ReconfigError: One could not take over; nothing was done.
        """
        for heir, olds in lists.across(self._picture, self._items).items():
            if self._one_machine([heir, *olds]):
                self._stand_by(heir, olds)

    def _one_machine(self, tasks: Sequence[str]) -> bool:
        rtpus = {self._picture.find(task).rtpu for task in tasks}
        return len({self._fleet.host(rtpu) for rtpu in rtpus}) == 1

    def _stand_by(self, heir: str, olds: list[str]) -> None:
        request = m.Heirs(
            after={heir: olds}, timeout=self._limit * (len(self._items) + 1)
        )
        self._heirs[heir] = olds
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
        for heir in self._heirs:
            member = self._picture.get(heir)
            if member is not None and member.state is State.OFF:
                request = m.Heirs(after={heir: []})
                with contextlib.suppress(PbonetError):  # its time limit ends it, too
                    self._fleet.call(member.rtpu, request, dict[str, list[m.Call]])
        self._heirs, self._calls = {}, {}

    def part(self, rtpu: str, part: list[Item]) -> None:
        """Send what one RTPU is to do.

        Raises:
            ReconfigError: An item failed.
        """
        answer = self._send(rtpu, part)
        if answer.unseen:  # it is another machine after all, whatever its name
            self.withdraw()
            self._take(answer, part[: len(part) - len(answer.rest)])
            part = answer.rest
            answer = self._send(rtpu, part)
        left = answer.rest or part[answer.done :] if answer.error is not None else []
        made = [item for item in part if item not in left]
        begin, end = self._done, self._done + len(part)
        self._whole[begin:end] = [*made, *left]
        self._take(answer, made)
        if answer.error is not None:
            cause = rpc.placed(rtpu, PbonetError.from_wire(answer.error))
            raise stuck(self._whole, self._done, cause) from cause

    def _take(self, answer: m.Reconfigured, made: Sequence[Item]) -> None:
        for task, state in answer.states.items():
            self._picture.move(task, State(state))
        self.states |= answer.states
        self._done += len(made)

    def _send(self, rtpu: str, part: list[Item]) -> m.Reconfigured:
        calls = {task: self._calls[task] for task, _ in part if task in self._calls}
        request = m.Reconfig(
            items=part, handover=self._handover, timeout=self._limit, calls=calls
        )
        limit = self._limit * len(part)
        try:
            return self._fleet.call(rtpu, request, m.Reconfigured, timeout=limit)
        except (UnreachableError, NoAnswerError) as error:
            raise stuck(self._whole, self._done, error, unsure=len(part)) from error
        except PbonetError as error:
            raise stuck(self._whole, self._done, error) from error
