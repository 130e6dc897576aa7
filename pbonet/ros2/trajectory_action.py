"""A FollowJointTrajectory action: its goals are followed by `ros_trajectory`."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from concurrent.futures import Future
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from pbonet import tbuf
from pbonet.analysis.legality import same_unit
from pbonet.errors import ConfigError, PbonetError, ProtocolError, SvarError
from pbonet.svar import Flags, Freshness, Table

from . import field_paths
from .field_paths import POSITION
from .message_types import (
    CANCEL,
    FOLLOW,
    TRAJECTORY,
    nanoseconds,
    seconds,
    set_stamp,
)
from .subscribing import Trajectory
from .topics_file import Subscribe
from .wire_format import Qos

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from pbonet.config import Variable
    from pbonet.svar import LocalTable

    from .message_types import MessageTypes
    from .repeated_warnings import Warnings
    from .ros_node import RosNode
    from .topics_file import Action

_STATUS_QOS: Final = Qos(depth=1, transient_local=True)
_NEWEST: Final = 2
"""Elements of TRAJ of `ros_trajectory`."""
_KEPT: Final = 32
"""Goals that have ended whose results can be asked for."""
_AWAY: Final = 0.5
"""Seconds without a cycle after which the task that follows counts as OFF."""
_TAKEN: Final = 1.0
"""Seconds in which the task must have begun a trajectory, or have stopped."""
_AHEAD: Final = 0.1
_OLD: Final = 0.5
"""Seconds by which a trajectory's stamp may be ahead, or old."""
_BAD: Final = Flags.COPY_LOST | Flags.TABLE_OVERWRITTEN


class Status(IntEnum):
    """States of a goal, as in action_msgs/msg/GoalStatus."""

    UNKNOWN = 0
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


class Code(IntEnum):
    """Error codes of a result."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


class CancelCode(IntEnum):
    """Return codes of a request to cancel, as in action_msgs/srv/CancelGoal."""

    NONE = 0
    REJECTED = 1
    UNKNOWN_GOAL_ID = 2
    GOAL_TERMINATED = 3


def check(about: Action, variables: dict[str, Variable], where: str) -> None:
    """Refuse an action whose variables do not fit.

    Raises:
        ConfigError: One does not exist, or has another size or unit.
    """
    for name in about.variables:
        share = field_paths.share_of(name, variables, where)
        variable = variables[share.variable]
        size = _NEWEST if name == about.newest else len(about.joints)
        if name != variable.name or variable.nelem != size:
            raise ConfigError(
                f"{name} does not fit the action",
                where=where,
                expected=f"{size} elements",
                got=f"{share.end - share.first}",
                remedy="name its joints, and the variables of ros_trajectory",
            )
    for name in (about.desired, about.actual):
        if not any(same_unit(variables[name].units, one) for one in POSITION):
            raise ConfigError(
                f"{name} is no position of joints",
                where=where,
                expected=" or ".join(POSITION),
                got=variables[name].units,
                remedy="name Y of ros_trajectory, and what is measured",
            )


class Verdict(NamedTuple):
    """How a goal ends."""

    status: Status
    code: Code = Code.SUCCESSFUL
    text: str = ""


class Goal:
    """A goal that was accepted.

    Args:
        goal_id: Its identity, 16 bytes.
        wanted: The message ``FollowJointTrajectory_Goal``.
        rows: The points, as the link has them.
        joints: The joints, in their order.

    Raises:
        ProtocolError: It cannot be followed, or not be judged.
    """

    def __init__(
        self,
        goal_id: bytes,
        wanted: Any,  # noqa: ANN401 - a message, by its type
        rows: NDArray[np.float64],
        joints: list[str],
    ) -> None:
        self.goal_id = goal_id
        self.stamp_ns = time.time_ns()
        """When it was accepted, nanoseconds since 1970."""
        self.status = Status.EXECUTING
        self.verdict = Verdict(Status.UNKNOWN)
        self.number = 0
        """That of the record that must be followed, or that stops."""
        self.sent = self.ended = 0.0
        """When that was written, and when the end was first seen; `time.monotonic`."""
        self.waiting: list[Future[Any]] = []
        times = rows[: len(wanted.trajectory.points), 0]
        _check(wanted, times, rows[: len(times), 1 : 1 + 2 * len(joints)])
        self.duration = float(times[-1])
        self.target = rows[len(times) - 1, 1 : 1 + len(joints)].copy()
        self.path = _tolerances(wanted.path_tolerance, joints)
        self.tolerance = _tolerances(wanted.goal_tolerance, joints)
        self.patience = seconds(wanted.goal_time_tolerance)

    @property
    def is_over(self) -> bool:
        """Whether it has a result."""
        return self.status >= Status.SUCCEEDED


def _check(
    wanted: Any,  # noqa: ANN401 - as above
    times: NDArray[np.float64],
    numbers: NDArray[np.float64],
) -> None:
    """Refuse what `ros_trajectory` cannot follow.

    Args:
        wanted: The goal.
        times: The time of each point.
        numbers: Its positions, and its velocities.
    """
    positions, rates = np.hsplit(numbers, 2)
    if len(times) == 0 or times[-1] <= 0 or (np.diff(times) <= 0).any():
        raise _refused("its times do not grow", "points at growing times above 0")
    if not np.isfinite(positions).all():
        raise _refused("a point has no positions", "positions of all joints")
    if np.isinf(rates).any():
        raise _refused("a velocity is infinite", "finite ones, or none")
    if wanted.multi_dof_trajectory.points:
        raise _refused("it has joints with several degrees", "`trajectory` alone")
    if wanted.component_path_tolerance or wanted.component_goal_tolerance:
        raise _refused("it has tolerances of components", "those of joints")
    stamp_ns = nanoseconds(wanted.trajectory.header.stamp)
    ahead = (stamp_ns - time.time_ns()) * 1e-9
    if stamp_ns and not -_OLD < ahead < _AHEAD:
        raise _refused(
            f"it begins {abs(ahead):.3g} s {'later' if ahead > 0 else 'ago'}",
            "a stamp of 0, or of now",
        )


def _must_name(joints: list[str], trajectory: Any) -> None:  # noqa: ANN401
    """Refuse joints that the action does not have, and values of no joint."""
    names = list(trajectory.joint_names)
    others = sorted(set(names) - set(joints))
    if others or len(names) > len(joints):
        raise _refused(
            f"it moves the joint {others[0]}, too" if others else "a joint is twice",
            " ".join(joints),
        )
    if any(len(one.positions) > len(names) for one in trajectory.points):
        raise _refused("a point has too many positions", f"{len(names)}")


def _tolerances(given: Iterable[Any], joints: list[str]) -> NDArray[np.float64]:
    """Return the tolerance of each joint's position; infinity: none."""
    found = np.full(len(joints), np.inf)
    for one in given:
        if one.name not in joints:
            raise _refused(
                f"it has a tolerance for the joint {one.name}", " ".join(joints)
            )
        if not np.isfinite((one.position, one.velocity, one.acceleration)).all():
            raise _refused(
                f"a tolerance for the joint {one.name} is not finite", "a number"
            )
        if one.velocity > 0 or one.acceleration > 0:
            raise _refused(
                "it has a tolerance of velocity or acceleration", "those of position"
            )
        if one.position > 0:
            found[joints.index(one.name)] = one.position
    return found


def _refused(why: str, expected: str) -> ProtocolError:
    return ProtocolError(
        f"a goal was rejected: {why}",
        expected=expected,
        remedy="let its sender send another one",
    )


class TrajectoryAction:
    """An action server whose goals a task with `ros_trajectory` follows.

    A goal is accepted if that task is ON and could follow it. It succeeds when the task
    has reached the end and the measured positions are within the goal's tolerance; it
    is aborted when a tolerance of the path is violated, when the task has stopped, or
    by the next goal.

    Args:
        node: The node that offers it.
        about: What the file says.
        table: The table's name.
        layout: Its layout.
        warnings: What a user should know.

    Raises:
        XmError: The link has another writer.
    """

    def __init__(
        self,
        node: RosNode,
        about: Action,
        table: str,
        layout: str,
        warnings: Warnings,
    ) -> None:
        self._node, self._about, self._warnings = node, about, warnings
        self._table, self._layout = table, layout
        self._types: MessageTypes = node.types
        self._types.add_following()
        self.name = node.name_of(about.name)
        self._points = Trajectory(
            self._types,
            Subscribe(
                topic=about.name,
                type=TRAJECTORY,
                link=about.link,
                joints=about.joints,
                points=about.points,
            ),
            self.name,
        )
        self._goals: deque[Goal] = deque()
        self._active: Goal | None = None
        self._state: _TableView | None = None
        self._changed = threading.Condition(threading.RLock())
        self._over = False
        self._writer = tbuf.Writer(about.link, self._points.form)
        self._asked = np.zeros((), self._points.form)
        self._number = 0
        self._thread = threading.Thread(
            target=self._work, name=f"ros {self.name}", daemon=True
        )

    def open(self) -> None:
        """Offer it from now on."""
        node, base = self._node, f"{self._about.name}/_action"
        self._feedback = node.publisher(
            f"{base}/feedback", f"{FOLLOW}_FeedbackMessage", Qos()
        )
        self._statuses = node.publisher(
            f"{base}/status", "action_msgs/msg/GoalStatusArray", _STATUS_QOS
        )
        answers: tuple[tuple[str, str, Callable[[Any], Any]], ...] = (
            ("send_goal", f"{FOLLOW}_SendGoal", self._take),
            ("cancel_goal", CANCEL, self._cancel),
            ("get_result", f"{FOLLOW}_GetResult", self._result),
        )
        for end, kind, answer in answers:
            requests = node.queue(f"ros {self.name} {end}")  # a stop waits for no goal
            node.serve(f"{base}/{end}", kind, answer, requests)
        self._thread.start()

    def close(self) -> None:
        """Abort the goal, and detach from the link."""
        with self._changed:
            self._over = True
            if self._active is not None:
                self._abort(self._active, Code.INVALID_GOAL, "the bridge ends")
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join()
        self._writer.close()

    # -- services ---------------------------------------------------------------------

    def _take(self, request: Any) -> Any:  # noqa: ANN401
        response = self._types.new(f"{FOLLOW}_SendGoal_Response")
        try:
            with self._changed:
                goal = self._begin(bytes(request.goal_id.uuid), request.goal)
        except PbonetError as error:
            self._warnings.warn_of(self.name, error)
            return response
        response.accepted = True
        set_stamp(response.stamp, goal.stamp_ns)
        return response

    def _begin(self, goal_id: bytes, wanted: Any) -> Goal:  # noqa: ANN401
        """Send a goal to the task.

        Raises:
            PbonetError: It is rejected.
        """
        if self._over:  # the thread that judges goals has ended
            raise _refused("the bridge ends", "a bridge that goes on")
        if self._find(goal_id) is not None:
            raise _refused("its identity was used before", "a new one")
        self._points.read(wanted.trajectory, self._asked)
        _must_name(self._about.joints, wanted.trajectory)
        goal = Goal(goal_id, wanted, self._asked["rows"], self._about.joints)
        self._attach()
        self._send(goal)
        if self._active is not None:
            self._end(
                self._active,
                Verdict(Status.ABORTED, Code.INVALID_GOAL, "a new goal replaced it"),
            )
        self._goals.append(goal)
        while len(self._goals) > _KEPT:
            self._goals.popleft()
        self._active = goal
        self._publish_status()
        self._changed.notify()
        return goal

    def _attach(self) -> None:
        """Make sure that the task is ON.

        Raises:
            SvarError: There is no table, or it cannot be read.
            ProtocolError: The task does not run.
        """
        self._detach()
        self._state = _TableView(self._table, self._layout, self._about)
        if not self._state.copy():
            raise ProtocolError(
                f"a goal was rejected: {self._state.silent} is not written",
                expected=f"a commit in the last {_AWAY:g} s",
                remedy="turn the tasks on that write "
                f"{', '.join(self._about.variables)}",
            )

    def _detach(self) -> None:
        if self._state is not None:
            self._state.close()
            self._state = None

    def _send(self, goal: Goal) -> None:
        """Write the record that was asked for, on behalf of a goal.

        Its number grows with time, so that no other bridge, and no other buffer of the
        link, had the same.
        """
        self._number = max(self._number + 1, time.time_ns() // 1_000_000)
        self._asked["goal"] = self._number
        self._writer.value[...] = self._asked
        self._writer.write()
        goal.number, goal.sent = self._number, time.monotonic()

    def _cancel(self, request: Any) -> Any:  # noqa: ANN401
        response = self._types.new(f"{CANCEL}_Response")
        asked = request.goal_info
        goal_id, before_ns = bytes(asked.goal_id.uuid), nanoseconds(asked.stamp)
        with self._changed:
            known = self._find(goal_id)
            goal = self._active
            if any(goal_id) and known is None:
                response.return_code = int(CancelCode.UNKNOWN_GOAL_ID)
            elif known is not None and known.is_over and not before_ns:
                response.return_code = int(CancelCode.GOAL_TERMINATED)
            elif goal is None or not _is_meant(goal, goal_id, before_ns):
                response.return_code = int(CancelCode.REJECTED)
            else:
                self._begin_cancel(goal)
                response.goals_canceling = [self._info(goal)]
        return response

    def _begin_cancel(self, goal: Goal) -> None:
        if goal.status is not Status.CANCELING:
            goal.status = Status.CANCELING
            self._stop(goal)
            self._publish_status()

    def _stop(self, goal: Goal) -> None:
        """Let the task stop where it stands."""
        self._asked["rows"] = np.nan
        self._send(goal)

    def _result(self, request: Any) -> Any:  # noqa: ANN401
        """Return the response, or a future one."""
        with self._changed:
            goal = self._find(bytes(request.goal_id.uuid))
            if goal is None:
                return self._types.new(f"{FOLLOW}_GetResult_Response")
            if goal.is_over:
                return self._response(goal)
            goal.waiting.append(Future())
            return goal.waiting[-1]

    def _find(self, goal_id: bytes) -> Goal | None:
        return next((one for one in self._goals if one.goal_id == goal_id), None)

    # -- one goal ---------------------------------------------------------------------

    def _work(self) -> None:
        """Watch the active goal until the end."""
        while True:
            with self._changed:
                if self._over:
                    return
                if self._active is None:
                    self._detach()
                    self._changed.wait()
                    continue
                self._watch(self._active)
                self._changed.wait(1 / self._about.feedback_hz)

    def _watch(self, goal: Goal) -> None:
        """Publish feedback, and end the goal if it is over; the thread goes on."""
        try:
            there = self._state is not None and self._state.copy()
            verdict = self._judge(goal, there=there)
            if there:
                self._publish_feedback(goal)
            if verdict is None and self._state and self._state.number == goal.number:
                self._writer.write()  # again: the task sees that it is watched
        except SvarError as error:
            verdict = Verdict(Status.ABORTED, Code.INVALID_GOAL, str(error))
        except Exception as error:  # noqa: BLE001 - no goal ends the bridge
            self._warnings.failed(self.name, error)
            verdict = Verdict(Status.ABORTED, Code.INVALID_GOAL, str(error))
        if verdict is None:
            return
        if verdict.status is Status.ABORTED:
            self._abort(goal, verdict.code, verdict.text)
        else:
            self._end(goal, verdict)

    def _judge(self, goal: Goal, *, there: bool) -> Verdict | None:
        """Return how a goal ends; None: not yet."""
        state = self._state
        if not there or state is None:
            silent = "the table" if state is None else state.silent
            return _aborted(Code.INVALID_GOAL, f"{silent} is no longer written")
        if state.number != goal.number:
            late = time.monotonic() - goal.sent > _TAKEN
            why = f"the task has not read the link for {_TAKEN:g} s"
            return _aborted(Code.INVALID_GOAL, why) if late else None
        if goal.status is Status.CANCELING:
            return Verdict(Status.CANCELED, Code.SUCCESSFUL, "it was canceled")
        if state.left < 0:
            why = "the task that follows has stopped, or refused it (see its warnings)"
            return _aborted(Code.INVALID_GOAL, why)
        if state.left > 0:
            return self._judge_path(goal, state)
        return self._judge_end(goal, state)

    def _judge_path(self, goal: Goal, state: _TableView) -> Verdict | None:
        miss = np.abs(state.desired - state.actual)
        if (miss <= goal.path).all():
            return None
        return _aborted(
            Code.PATH_TOLERANCE_VIOLATED, self._worst(miss, goal.path, "from the path")
        )

    def _judge_end(self, goal: Goal, state: _TableView) -> Verdict | None:
        miss, now = np.abs(goal.target - state.actual), time.monotonic()
        if (miss <= goal.tolerance).all():
            return Verdict(Status.SUCCEEDED)
        goal.ended = goal.ended or now
        if not goal.patience or now - goal.ended <= goal.patience:
            return None
        return _aborted(
            Code.GOAL_TOLERANCE_VIOLATED,
            self._worst(miss, goal.tolerance, "from the goal"),
        )

    def _worst(
        self, miss: NDArray[np.float64], allowed: NDArray[np.float64], what: str
    ) -> str:
        k = int((miss - allowed).argmax())
        name = self._about.joints[k]
        return f"{name} is {miss[k]:.4g} {what} (tolerance {allowed[k]:g})"

    def _abort(self, goal: Goal, code: Code, why: str) -> None:
        """Let the task stop, and the goal be aborted."""
        self._stop(goal)
        self._end(goal, Verdict(Status.ABORTED, code, why))

    def _end(self, goal: Goal, verdict: Verdict) -> None:
        """Give a goal its result, to those, too, that wait for it."""
        goal.verdict, goal.status = verdict, verdict.status
        self._active = None
        if verdict.status is Status.ABORTED:
            self._warnings.warn(self.name, "a goal was aborted", f": {verdict.text}")
        response = self._response(goal)
        for one in goal.waiting:
            one.set_result(response)
        goal.waiting.clear()
        self._publish_status()

    # -- messages ---------------------------------------------------------------------

    def _response(self, goal: Goal) -> Any:  # noqa: ANN401
        response = self._types.new(f"{FOLLOW}_GetResult_Response")
        response.status = int(goal.status)
        response.result.error_code = int(goal.verdict.code)
        response.result.error_string = goal.verdict.text
        return response

    def _info(self, goal: Goal) -> Any:  # noqa: ANN401
        info = self._types.new("action_msgs/msg/GoalInfo")
        info.goal_id.uuid = np.frombuffer(goal.goal_id, np.uint8)
        set_stamp(info.stamp, goal.stamp_ns)
        return info

    def _publish_status(self) -> None:
        name = "action_msgs/msg/GoalStatus"
        message = self._types.new(f"{name}Array")
        for goal in self._goals:
            one = self._types.new(name)
            one.goal_info, one.status = self._info(goal), int(goal.status)
            message.status_list.append(one)
        data = self._types.encode(f"{name}Array", message)
        self._statuses.put(data, time.time_ns())

    def _publish_feedback(self, goal: Goal) -> None:
        state = self._state
        if state is None:
            return
        name, now = f"{FOLLOW}_FeedbackMessage", time.time_ns()
        message = self._types.new(name)
        message.goal_id.uuid = np.frombuffer(goal.goal_id, np.uint8)
        its = message.feedback
        set_stamp(its.header.stamp, now)
        its.joint_names = self._about.joints
        its.desired.positions = state.desired
        its.actual.positions = state.actual
        its.error.positions = state.desired - state.actual
        done_ns = round(max(goal.duration - max(state.left, 0.0), 0.0) * 1e9)
        for point in (its.desired, its.actual, its.error):
            set_stamp(point.time_from_start, done_ns)
        self._feedback.put(self._types.encode(name, message), now)


def _aborted(code: Code, why: str) -> Verdict:
    return Verdict(Status.ABORTED, code, why)


def _is_meant(goal: Goal, goal_id: bytes, before_ns: int) -> bool:
    """Return whether a request to cancel means a goal; no identity, no time: all."""
    if not any(goal_id) and not before_ns:
        return True
    return goal.goal_id == goal_id or 0 < goal.stamp_ns <= before_ns


class _TableView:
    """The variables that tell of the task that follows, as the table has them.

    Args:
        table: The table's name.
        layout: Its layout.
        about: Which variables.

    Raises:
        SvarError: There is no table, or it has another layout.
    """

    def __init__(self, table: str, layout: str, about: Action) -> None:
        self._table = Table.attach(table, layout=layout)
        names = about.variables
        self._places = {name: self._table.index(name) for name in names}
        self._local: LocalTable = self._table.local("ros2", os.getpid(), invar=names)
        self._local.keep_fresh({one: Freshness() for one in self._places.values()})
        self._newest = self._local.array(about.newest)
        self._desired = self._local.array(about.desired)
        self._actual = self._local.array(about.actual)
        self.silent = ""
        """The variable that is not written, if `copy` returned False."""

    def close(self) -> None:
        """Detach from the table."""
        self._table.close()

    def copy(self) -> bool:
        """Copy everything; return whether all of it is being written."""
        if self._local.copy_in() & _BAD:
            self.silent = "the table"
            return False
        for name, place in self._places.items():
            if not 0 <= self._local.age_ns(place) < _AWAY * 1e9:
                self.silent = name
                return False
        return True

    @property
    def number(self) -> int:
        """The newest trajectory that has come to the task."""
        return int(self._newest[0])

    @property
    def left(self) -> float:
        """Seconds until its end; 0: it was reached, -1: it is not followed."""
        return float(self._newest[1])

    @property
    def desired(self) -> NDArray[np.float64]:
        """Where the trajectory is."""
        return self._desired.astype(np.float64)

    @property
    def actual(self) -> NDArray[np.float64]:
        """Where the joints are."""
        return self._actual.astype(np.float64)
