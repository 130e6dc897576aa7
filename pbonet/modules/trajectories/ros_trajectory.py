"""Follow the trajectories that a node of ROS 2 sends, such as those of MoveIt."""

from typing import Annotated as A

import numpy as np

from pbonet import (
    InConst,
    OutVar,
    Params,
    PortBasedObject,
    Signal,
    Vector,
    param,
    tbuf,
)
from pbonet.io import devices_allowed
from pbonet.modules._values import rest
from pbonet.modules.trajectories.traj_play import hermite

_NOT_FOLLOWED = -1.0


class Sent(Params):
    """The link, and what it may hold."""

    link: A[str, param("none", "name of the link that `pbonet ros2 bridge` writes")]
    points: A[int, param("none", "most points, as `points` of the topic", ge=1)] = 64
    maxage: A[float, param("s", "an older one is not begun; 0: any is", ge=0)] = 0.5
    silent: A[
        float, param("s", "silence of the bridge that ends a goal; 0: none does", ge=0)
    ] = 1.0


class RosTrajectory(PortBasedObject[Sent], module_class="trajectory"):
    """y = the last JointTrajectory that came over a link of `pbonet ros2 bridge`.

    It begins where y stands, with the velocity that y has, and passes each point at its
    time after the arrival, by cubic Hermite pieces. A point without a velocity gets
    that of second-order differences, the last one rests. Points at time 0 are left out.
    A new trajectory replaces the old one at once; one without points stops y where it
    stands, as `stable` does. A trajectory with times that do not grow, without
    positions, with numbers that are not finite, or older than `maxage` is warned of and
    not followed. What comes while the task is OFF or runs `stable` is not followed
    later. At its end the signal FINISH is sent. If Y is the goal of `otg`, that limits
    velocity, acceleration and jerk. The bridge repeats the goal of an action as long as
    it watches it: when it is silent for `silent`, y stops, and a warning says so. TRAJ
    says what became of the newest trajectory that came: its number, and the seconds
    until its end; 0: it was reached, -1: it is not followed, or no longer. In a
    simulation nothing comes.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of joints")]
    y: A[Vector, OutVar("Y", "ndof", "any", "the trajectory")]
    y_dot: A[Vector, OutVar("Y^", "ndof", "any", "its time derivative")]
    newest: A[
        Vector, OutVar("TRAJ", "2", "mixed", "number of the newest, seconds left or -1")
    ]

    def init(self) -> None:
        self._rests = True
        self._followed = 0.0
        self._goal = 0
        self._link = None
        rows = self.params.points, 1 + 3 * self.ndof
        form = np.dtype([("goal", "i8"), ("rows", "f8", rows)])
        if devices_allowed():
            self._link = tbuf.Reader(self.params.link, form)

    def on(self) -> None:
        self._rest()

    def cycle(self, dt: float) -> None:
        if self._link is not None and self._link.read():
            self._take(self._link)
        if self._rests or self._is_silent():
            return
        self._time += dt
        if self._time < self._times[-1]:
            self._project()
            self._say(self._times[-1] - self._time)
        else:
            self.y[:], self.y_dot[:] = self._points[-1], 0.0
            self._rests = True
            self._say(0.0)
            self.task.signal(Signal.FINISH)

    def stable(self, dt: float) -> None:  # noqa: ARG002
        """Stop, and forget the trajectory, and each one that comes."""
        self._rest()

    def off(self) -> None:
        rest(self.task, self.y_dot)

    def kill(self) -> None:
        if link := getattr(self, "_link", None):
            link.close()

    def _rest(self) -> None:
        """Stop; what came before is over."""
        if self._link is not None:
            self._link.read()
            self._recognize(self._link)
        self._stop()

    def _stop(self) -> None:
        self._rests = True
        self.y_dot[:] = 0.0
        self.newest[1] = _NOT_FOLLOWED

    def _say(self, left: float) -> None:
        """Set the seconds that are left, unless a newer one was refused meanwhile."""
        if self.newest[0] == self._followed:
            self.newest[1] = left

    def _recognize(self, link: tbuf.Reader) -> bool:
        """Set the number of what has come; return whether it is the goal from before.

        A goal of an action has a number of its own; a message of a topic has that of
        its record.
        """
        goal = int(link.value["goal"])
        again = goal != 0 and goal == self._goal
        self._goal = goal
        self._heard_ns = self.task.now
        self.newest[0] = goal or link.number
        return again

    def _is_silent(self) -> bool:
        """Stop if the bridge no longer watches the goal; return whether it does not."""
        silence = (self.task.now - self._heard_ns) * 1e-9
        limit = self.params.silent
        if not (self._goal and limit and silence > limit):
            return False
        self.task.warn(
            f"link {self.params.link}: the arm stops, because the bridge of ROS 2 that "
            f"watches its goal is silent for {silence:.3g} s (SILENT {limit:g}); "
            "start it again, and send a new goal"
        )
        self._stop()
        return True

    def _take(self, link: tbuf.Reader) -> None:
        """Begin the trajectory that has come, unless it comes too late."""
        if self._recognize(link):
            return
        self.newest[1] = _NOT_FOLLOWED
        rows: Vector = link.value["rows"]
        age, limit = (link.age_ns() or 0) * 1e-9, self.params.maxage
        if limit and age > limit and np.isfinite(rows[:, 0]).any():
            self.task.warn(
                f"link {self.params.link}: a trajectory was not followed, because it "
                f"is {age:.3g} s old (MAXAGE {limit:g}); check the network and clocks"
            )
            return
        self._begin(rows)

    def _begin(self, rows: Vector) -> None:
        """Take the points of a trajectory, with where y stands before them."""
        n = self.ndof
        there = rows[np.isfinite(rows[:, 0])]
        if len(there) == 0:
            self._stop()
            return
        there = there[there[:, 0] > 0.0]
        times = np.concatenate(([0.0], there[:, 0]))
        points = np.vstack((self.y, there[:, 1 : 1 + n]))
        given = there[:, 1 + n : 1 + 2 * n]
        if (
            len(there) == 0
            or (np.diff(times) <= 0).any()
            or not np.isfinite(points).all()
            or np.isinf(given).any()
        ):
            self.task.warn(
                f"link {self.params.link}: a trajectory was not followed, because its "
                "times do not grow, positions are missing, or numbers are not finite"
            )
            return
        rates = np.gradient(points, times, axis=0, edge_order=1)
        rates[0], rates[-1] = self.y_dot, 0.0
        rates[1:] = np.where(np.isnan(given), rates[1:], given)
        self._times, self._points, self._rates = times, points, rates
        self._time, self._rests = 0.0, False
        self._followed = self.newest[0]

    def _project(self) -> None:
        k = int(np.searchsorted(self._times, self._time, side="right")) - 1
        span = float(self._times[k + 1] - self._times[k])
        begin, goal = ((self._points[i], self._rates[i]) for i in (k, k + 1))
        share = (self._time - float(self._times[k])) / span
        self.y[:], self.y_dot[:] = hermite(share, span, begin, goal)
