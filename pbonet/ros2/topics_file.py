"""The file of a bridge: which variables and topics belong together; TOML."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, cast

from msgspec import Struct

from pbonet.analysis.legality import same_unit
from pbonet.config import load, toml_record, toml_table
from pbonet.errors import ConfigError, did_you_mean

from .wire_format import LONGEST, MOST_DOMAIN, NAME, Qos

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from pbonet.config import Variable

JOINT_STATE: Final = "sensor_msgs/msg/JointState"
ARRAY: Final = "std_msgs/msg/Float64MultiArray"
_JOINT_FIELDS: Final = {
    "position": ("Q", ("rad", "m")),
    "velocity": ("Q^", ("rad/s", "m/s")),
    "effort": ("T", ("N*m", "N")),
}
"""Fields of JointState, with the variable's name before the ``_`` and its units."""
_RATES: Final = 0.001, float("inf")
"""Bounds of `max_hz`."""
_DEPTHS: Final = 1, 10_000
_FEEDBACKS: Final = 5.0, 1000.0
"""Bounds of `feedback_hz`; SILENT of `ros_trajectory` is several times the time between
two, as with every one the task sees that its goal is watched."""
_GOAL: Final = 8
"""Bytes before the points in a link's record."""
_LINK: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+\-]{0,63}")
HOME: Final = "ros2"
"""The part before the colon of a link that a bridge writes."""
Plain = str | bool | int | float


class Topic(Struct, kw_only=True, forbid_unknown_fields=True):
    """The common part of publishing and subscribing."""

    topic: str
    """Its name; without a first slash it is below the node's."""
    type: str
    """The message, such as ``geometry_msgs/msg/Twist``."""
    reliable: bool = True
    depth: int = 10
    transient_local: bool = False
    """Whether subscribers that come later get the last messages."""
    max_hz: float = 1000.0
    """How often a second a message is handled at most; the newest one then."""

    @property
    def qos(self) -> Qos:
        """Its quality of service."""
        return Qos(self.reliable, self.depth, self.transient_local)


class Publish(Topic, kw_only=True, forbid_unknown_fields=True):
    """Variables that become a topic."""

    fields: dict[str, str]
    """By field, the variable or some of its elements: ``Q_MEZ``, ``X[0:3]``."""
    constants: dict[str, Plain | list[Plain]] = {}
    """Fields that stay as they are."""
    frame: str = ""
    """``frame_id`` of all headers."""


class Subscribe(Topic, kw_only=True, forbid_unknown_fields=True):
    """A topic that becomes a link."""

    link: str
    """The link is ``ros2:LINK``, for `tbuf_receive` and `ros_trajectory`."""
    fields: list[str] = []
    """The message's fields, in the order of the variable's elements."""
    joints: list[str] = []
    """Joints in the order of the variable's elements; the message's may differ."""
    points: int = 64
    """The most points of a trajectory."""
    stamp: Literal["arrival", "header"] = "arrival"
    """From when its age counts; ``header`` needs clocks that agree."""


class Action(Struct, kw_only=True, forbid_unknown_fields=True):
    """A FollowJointTrajectory action, whose goals `ros_trajectory` follows."""

    name: str
    """Its name; without a first slash it is below the node's."""
    link: str
    """The link is ``ros2:LINK``, for `ros_trajectory`."""
    joints: list[str]
    """Joints in the order of the variables' elements; the message's may differ."""
    desired: str
    """The variable that is Y of `ros_trajectory`."""
    actual: str
    """The variable with the measured positions."""
    newest: str = "TRAJ"
    """The variable that is TRAJ of `ros_trajectory`."""
    points: int = 64
    """The most points of a trajectory."""
    feedback_hz: float = 20.0
    """How often a second there is feedback, and goals are judged."""

    @property
    def variables(self) -> list[str]:
        """The variables that must be written while a goal is followed."""
        return list(dict.fromkeys((self.newest, self.desired, self.actual)))


class Topics(Struct, kw_only=True, forbid_unknown_fields=True):
    """All that a bridge is to do."""

    domain: int | None = None
    """None: ROS_DOMAIN_ID, else 0."""
    node: str = ""
    """The node's name, with its namespace; empty: the subsystem's name."""
    messages: list[str] = []
    """Folders of packages with ``.msg`` files."""
    publish: list[Publish] = []
    subscribe: list[Subscribe] = []
    action: list[Action] = []

    @property
    def folders(self) -> list[Path]:
        """The folders of packages."""
        return list(map(Path, self.messages))

    @property
    def ros_domain(self) -> int:
        """The ROS domain."""
        if self.domain is not None:
            return self.domain
        text = os.environ.get("ROS_DOMAIN_ID") or "0"
        if not text.isdigit() or int(text) > MOST_DOMAIN:
            raise ConfigError(
                "ROS_DOMAIN_ID is no ROS domain",
                expected=f"0 to {MOST_DOMAIN}",
                got=text,
                remedy="unset it, or set another one",
            )
        return int(text)


_TABLES: Final[dict[str, type[Struct]]] = {
    "publish": Publish,
    "subscribe": Subscribe,
    "action": Action,
}


def read_topics(path: Path) -> Topics:
    """Return what a bridge's file says.

    Raises:
        ConfigFileError: It cannot be read.
        ConfigError: It is not TOML, or says something that cannot be.
    """
    table = toml_table(load(path), str(path))
    found = _converted(table, str(path))
    found.messages = [str(path.parent / folder) for folder in found.messages]
    _check(found, str(path))
    return found


def _converted(table: dict[str, Any], where: str) -> Topics:
    """Return what a file says, unless a key is unknown, missing or of another type."""
    _must_know(table, Topics, where)
    for key, kind in _TABLES.items():
        entries = table.get(key)
        for place, entry in enumerate(_list_of(entries)):
            if isinstance(entry, dict):
                _must_know(
                    cast("dict[str, Any]", entry), kind, f"{where}: {key}[{place}]"
                )
    return toml_record(table, Topics, where, remedy="docs/ros2.md lists the keys")


def _must_know(table: dict[str, Any], kind: type[Struct], where: str) -> None:
    for key in table:
        if key not in kind.__struct_fields__:
            raise ConfigError(
                f"unknown key {key!r}",
                where=where,
                expected=" ".join(kind.__struct_fields__),
                remedy=did_you_mean(key, kind.__struct_fields__) or "remove it",
            )


def _list_of(entries: object) -> list[object]:
    return cast("list[object]", entries) if isinstance(entries, list) else []


def _check(topics: Topics, where: str) -> None:
    _check_domain(topics, where)
    names = [topics.node] if topics.node else []
    names += [one.topic for one in (*topics.publish, *topics.subscribe)]
    names += [one.name for one in topics.action]
    for name in names:
        if not NAME.fullmatch(name):
            raise ConfigError(
                f"{name!r} is no name of ROS",
                where=where,
                expected="letters, digits and _, in parts with / between",
                remedy="rename it",
            )
    full = [full_name(topics.node or "SUBSYSTEM", one.topic) for one in topics.publish]
    _refuse_twice("topic", full, where)
    links = [one.link for one in topics.subscribe]
    links += [one.link for one in topics.action]
    _refuse_twice("link", links, where)
    _refuse_twice("action", [one.name for one in topics.action], where)
    for one in (*topics.publish, *topics.subscribe):
        its = f"{where}: {one.topic}"
        _must_be_within("max_hz", one.max_hz, _RATES, its)
        _must_be_within("depth", one.depth, _DEPTHS, its)
    for action in topics.action:
        its = f"{where}: {action.name}"
        _must_be_within("feedback_hz", action.feedback_hz, _FEEDBACKS, its)
    for link in topics.subscribe:
        _check_reader(link, where)
    for action in topics.action:
        _check_reader(action, where)


def _check_reader(reader: Subscribe | Action, where: str) -> None:
    where = f"{where}: {reader.name if isinstance(reader, Action) else reader.topic}"
    _refuse_twice("joint", reader.joints, where)
    row = 8 * (1 + 3 * len(reader.joints))
    most = (LONGEST - _GOAL) // row
    _must_be_within("points", reader.points, (1, most), where)
    if not _LINK.fullmatch(reader.link):
        raise ConfigError(
            f"{reader.link!r} is no name of a link",
            where=where,
            expected="NAME, of letters, digits, and _ - . after the first; tasks read "
            f"it as {HOME}:NAME",
            remedy="rename it",
        )


def full_name(node: str, topic: str) -> str:
    """Return the full name of a topic of a node."""
    topic = topic.removeprefix("~/")
    return topic if topic.startswith("/") else f"/{node.strip('/')}/{topic}"


def _must_be_within(
    key: str, value: float, bounds: tuple[float, float], where: str
) -> None:
    least, most = bounds
    if not least <= value <= most:
        raise ConfigError(
            f"{key} is out of bounds",
            where=where,
            expected=f"{least:g} to {most:g}",
            got=f"{value:g}",
        )


def _check_domain(topics: Topics, where: str) -> None:
    if not 0 <= topics.ros_domain <= MOST_DOMAIN:
        raise ConfigError(
            "this is no ROS domain",
            where=where,
            expected=f"0 to {MOST_DOMAIN}",
            got=str(topics.domain),
        )


def _refuse_twice(what: str, names: Sequence[str], where: str) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(
                f"the {what} {name} is there twice",
                where=where,
                expected=f"one of each {what}",
                remedy="remove or rename one of them",
            )


def by_names(variables: Iterable[Variable]) -> Topics:
    """Return the topics of a table without a file: all its variables are published.

    ``Q_MEZ``, ``Q^_MEZ`` and ``T_MEZ`` become one JointState if their units are those
    of joints, and so with any other ending; all others become arrays of numbers.
    """
    left = {one.name: one for one in variables if one.dtype[0] != "V"}
    found: list[Publish] = []
    for name in [one for one in left if one.startswith("Q_")]:
        ending = name.removeprefix("Q_")
        joints = _joints(ending, left)
        if "position" in joints:
            size = left[name].nelem
            for one in joints.values():
                del left[one]
            topic = f"joint_states/{ros_name(ending)}"
            found.append(
                Publish(
                    topic=topic,
                    type=JOINT_STATE,
                    fields=joints,
                    constants={"name": [f"joint{i + 1}" for i in range(size)]},
                )
            )
    found += [
        Publish(topic=f"variables/{ros_name(name)}", type=ARRAY, fields={"data": name})
        for name in left
    ]
    return Topics(publish=found)


def _joints(ending: str, variables: dict[str, Variable]) -> dict[str, str]:
    """Return which variables of an ending are which field of JointState."""
    found: dict[str, str] = {}
    size = variables[f"Q_{ending}"].nelem
    for field, (first, units) in _JOINT_FIELDS.items():
        one = variables.get(f"{first}_{ending}")
        if (
            one is not None
            and one.nelem == size
            and any(same_unit(one.units, unit) for unit in units)
        ):
            found[field] = one.name
    return found


def ros_name(name: str) -> str:
    """Return a variable's name as ROS allows it: ``Q^_MEZ`` becomes ``qdot_mez``."""
    text = name.replace("^", "dot").replace("'", "p")
    return re.sub(r"\W", "_", text).lower()
