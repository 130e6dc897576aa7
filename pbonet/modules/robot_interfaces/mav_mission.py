"""The mission of a MAVLink vehicle, over its task's link."""

from pathlib import Path
from typing import Annotated as A

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, UserSignal, param
from pbonet.errors import ParameterError
from pbonet.io import Outside, find_file
from pbonet.modules._mavlink import link_of
from pbonet.modules._mavlink_mission import (
    ACCEPTED,
    Download,
    Item,
    Upload,
    exact,
    read_mission,
)
from pbonet.modules._values import keep

FRESH = 2.0
"""Seconds since the last heartbeat within which the vehicle is there."""


class Plan(Params):
    """The mission."""

    file: A[
        str,
        param("none", "waypoints (QGC WPL 110), in a folder of modules; empty: none"),
    ] = ""
    component: A[int, param("none", "that of its autopilot", ge=1, le=255)] = 1


class MavMission(PortBasedObject[Plan], module_class="robot interface"):
    """The mission of FILE is given to the vehicle, and read back, when the task is on.

    It is the vehicle's when it was read back equal to the bit: WP_COUNT is then the
    number of its items. `set file NAME` gives another one. WP_NOW is the item that the
    vehicle flies, which is for its modes to decide. A part of the task of
    `mav_vehicle`, after it; while the flag is up nothing is given.
    """

    ARRIVED = UserSignal(0, "the vehicle has reached an item of its mission")
    GIVEN = UserSignal(1, "the vehicle has the mission of FILE")

    system: A[int, InConst("MAV_SYS", "1", "none", "system id of the vehicle")]
    age: A[float, InVar("LINK_AGE", "1", "s", "since the last heartbeat")]
    now: A[int, OutVar("WP_NOW", "1", "none", "item that it flies", new=True)]
    count: A[
        int, OutVar("WP_COUNT", "1", "none", "items it has, 0: not known", new=True)
    ]

    def init(self) -> None:
        self._link = link_of(self.task)
        self._outside = Outside("mission", room=1 << 16)
        self._items = self._read()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"component"})
        self._items = self._read()
        self._begin()

    def on(self) -> None:
        self._begin()

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the clock tells
        self._watch()
        if self._items and self.age < FRESH:
            self._give()

    def stable(self, dt: float) -> None:  # noqa: ARG002
        """Give nothing."""
        self._watch()

    def _begin(self) -> None:
        self._step: Upload | Download | None = None
        self._ended = False
        self.count = 0

    def _watch(self) -> None:
        """Take what the vehicle says about its mission."""
        for m in self._link.all_of("MISSION_CURRENT"):
            self.now = m.seq
        for m in self._link.all_of("MISSION_ITEM_REACHED"):
            self.task.signal(self.ARRIVED, str(m.seq))

    def _give(self) -> None:
        """Go on with the upload, then with reading it back."""
        now, to = self.task.now, (self.system, self.params.component)
        if self._ended:
            return
        if self._step is None:
            self._step = Upload(self._link, to, self._items, now)
        self._step.run(now)
        if self._step.result < 0:
            return
        if self._step.result != ACCEPTED:
            self._end(f"the vehicle refused the mission: result {self._step.result}")
        elif isinstance(self._step, Upload):
            self._step = Download(self._link, to, now)
        elif [*map(exact, self._step.items)] == [*map(exact, self._items)]:
            self.count = len(self._items)
            self._end("")
            self.task.signal(self.GIVEN)
        else:
            self._end("the vehicle has another mission than it was given")

    def _end(self, problem: str) -> None:
        self._ended = True
        if problem:
            self.task.warn(problem)

    def _read(self) -> list[Item]:
        """Return the items of FILE.

        Raises:
            ParameterError: It is missing, or no mission.
        """
        if not (name := self.params.file):
            return []
        return read_mission(self._outside.ask(self._text, name), name)

    def _text(self, name: str) -> str:
        path = find_file(name, self.task.libraries)
        try:
            return Path(path).read_text("utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ParameterError(
                "the mission cannot be read",
                where=str(path),
                got=str(error),
                remedy="write a text file of waypoints, or name another one",
            ) from None
