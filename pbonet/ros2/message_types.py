"""Types of ROS 2 messages: definitions, hashes and CDR, all by the package rosbags."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import numpy as np

from pbonet.errors import ConfigError, ConfigFileError, ProtocolError, did_you_mean
from pbonet.io import from_extra

if TYPE_CHECKING:
    from collections.abc import Iterable

HEADER: Final = "std_msgs/msg/Header"
COMMAND: Final = "pbonet_interfaces/srv/Command"
"""The service of a command; its words are those of a line at the prompt."""
COMMAND_TEXT: Final = """string arguments
---
bool success
string message
string data
"""
TRAJECTORY: Final = "trajectory_msgs/msg/JointTrajectory"
FOLLOW: Final = "control_msgs/action/FollowJointTrajectory"
CANCEL: Final = "action_msgs/srv/CancelGoal"
_CANCEL_TEXT: Final = (
    "action_msgs/GoalInfo goal_info\n---\nint8 return_code\n"
    "action_msgs/GoalInfo[] goals_canceling\n"
)
_TOLERANCES: Final = {
    "control_msgs/msg/JointTolerance": "string name\n",
    "control_msgs/msg/JointComponentTolerance": "string joint_name\nuint16 component\n",
}
"""Names of what has a tolerance; three numbers of `_BOUNDS` follow."""
_BOUNDS: Final = "float64 position\nfloat64 velocity\nfloat64 acceleration\n"
_POINT: Final = "trajectory_msgs/JointTrajectoryPoint"
_MULTI_POINT: Final = "trajectory_msgs/MultiDOFJointTrajectoryPoint"
_FOLLOW_TEXT: Final = f"""{TRAJECTORY} trajectory
trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
JointTolerance[] path_tolerance
JointComponentTolerance[] component_path_tolerance
JointTolerance[] goal_tolerance
JointComponentTolerance[] component_goal_tolerance
builtin_interfaces/Duration goal_time_tolerance
---
int32 error_code
string error_string
---
{HEADER} header
string[] joint_names
{_POINT} desired
{_POINT} actual
{_POINT} error
string[] multi_dof_joint_names
{_MULTI_POINT} multi_dof_desired
{_MULTI_POINT} multi_dof_actual
{_MULTI_POINT} multi_dof_error
"""
"""As in ROS 2 Jazzy."""
_PARAMETERS: Final = {
    "ListParameters": "string[] prefixes\nuint64 depth\n---\n"
    "{}/ListParametersResult result\n",
    "GetParameters": "string[] names\n---\n{}/ParameterValue[] values\n",
    "GetParameterTypes": "string[] names\n---\nuint8[] types\n",
    "DescribeParameters": "string[] names\n---\n{}/ParameterDescriptor[] descriptors\n",
    "SetParameters": "{0}/Parameter[] parameters\n---\n"
    "{0}/SetParametersResult[] results\n",
    "SetParametersAtomically": "{0}/Parameter[] parameters\n---\n"
    "{0}/SetParametersResult result\n",
}
"""Services by which every node of ROS 2 shows its parameters."""
_INFO: Final = "service_msgs/msg/ServiceEventInfo"
_PARTS: Final = 3
_SIMPLE: Final = (
    *("bool", "byte", "char", "string", "float32", "float64"),
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
)
_SEPARATOR: Final = re.compile(r"^---[ \t]*(?:\n|$)", re.MULTILINE)
_NO_ROOM: Final = re.compile(r"^\s*([\w/]\S*\[(?:<=)?(?:0+|-\d+)\])\s", re.MULTILINE)
_ACTION_PARTS: Final = ("Goal", "Result", "Feedback")
_UUID, _TIME = "unique_identifier_msgs/UUID", "builtin_interfaces/Time"


class Field(NamedTuple):
    """One field of a message."""

    name: str
    type: str
    """A number's type, ``string``, or the name of a message."""
    nested: bool
    size: int | None
    """Elements of an array; 0: a sequence; None: a single value."""
    bound: int
    """Elements that a sequence may have; 0: any number."""


class MessageTypes:
    """All types that are known: those of ROS 2, services, and those of a user.

    Args:
        folders: Folders of packages, with files ``PACKAGE/msg/NAME.msg`` and
            ``PACKAGE/action/NAME.action``.

    Raises:
        DeviceError: rosbags is not installed.
        ConfigError: A definition is wrong.
    """

    def __init__(self, folders: Iterable[Path] = ()) -> None:
        with from_extra("ros2", "ROS 2"):
            from rosbags import typesys
            from rosbags.interfaces import Nodetype

        self._sys: Any = typesys
        self._nodes = Nodetype
        self._store: Any = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
        defined: dict[str, Any] = self._store.fielddefs
        defined.update(_as_in_ros(defined))
        self._files: dict[str, str] = {}
        self._with_bounds: dict[str, list[Field]] = {}
        self.add_service(COMMAND, COMMAND_TEXT)
        for name, text in _PARAMETERS.items():
            self.add_service(
                f"rcl_interfaces/srv/{name}", text.format("rcl_interfaces/msg")
            )
        for folder in folders:
            self._add_folder(folder)

    def add(self, name: str, text: str, home: str = "", where: str = "") -> None:
        """Add a message by its definition, the text of a ``.msg`` file.

        Args:
            name: Its name.
            text: The definition.
            home: Where messages without a package are, ``PACKAGE/msg``; empty: beside
                this one.
            where: The place, for errors.

        Raises:
            ConfigError: It is no definition, or differs from a known one.
        """
        try:
            found = _as_in_ros(self._sys.get_types_from_msg(text, name))
            if home:
                found[name] = _moved(found[name], f"{name.rpartition('/')[0]}/", home)
            self._store.register(found)
        except Exception as error:  # noqa: BLE001 - what rosbags' parser raises
            raise ConfigError(
                f"this is no definition of the message {name}",
                where=where,
                got=str(error).partition("\n")[0] or type(error).__name__,
                remedy="write it as in a .msg file of ROS 2; types of messages that "
                "ROS 2 has cannot be changed",
            ) from None
        self._files[name] = where

    def add_service(self, name: str, text: str) -> None:
        """Add a service by its definition, the text of a ``.srv`` file.

        Raises:
            ConfigError: It is no definition.
        """
        request, _, response = text.partition("---\n")
        for part, its in (("Request", request), ("Response", response)):
            self.add(f"{name}_{part}", its)
        ask, answer = f"{name}_Request", f"{name}_Response"
        self.add(
            f"{name}_Event",
            f"{_INFO} info\n{ask}[<=1] request\n{answer}[<=1] response\n",
        )
        self.add(
            name,
            f"{ask} request_message\n{answer} response_message\n"
            f"{name}_Event event_message\n",
        )

    def add_action(self, name: str, text: str, where: str = "") -> None:
        """Add an action by its definition, the text of an ``.action`` file.

        Args:
            name: Its name.
            text: The definition.
            where: The place, for errors.

        Raises:
            ConfigError: It is no definition.
        """
        package = name.partition("/")[0]
        texts = _SEPARATOR.split(text)
        if len(texts) != len(_ACTION_PARTS):
            raise ConfigError(
                f"this is no definition of the action {name}",
                where=where,
                expected="goal, result and feedback, with lines of --- between",
                got=f"{len(texts)} parts",
                remedy="write it as in an .action file of ROS 2",
            )
        for part, its in zip(_ACTION_PARTS, texts, strict=True):
            self.add(f"{name}_{part}", its, f"{package}/msg", where)
        goal_id = f"{_UUID} goal_id\n"
        self.add_service(
            f"{name}_SendGoal",
            f"{goal_id}{name}_Goal goal\n---\nbool accepted\n{_TIME} stamp\n",
        )
        self.add_service(
            f"{name}_GetResult",
            f"{goal_id}---\nint8 status\n{name}_Result result\n",
        )
        self.add(f"{name}_FeedbackMessage", f"{goal_id}{name}_Feedback feedback\n")

    def add_following(self) -> None:
        """Add the action of a controller of trajectories, unless a user gave it.

        Raises:
            ConfigError: That of the user has no fields that are needed.
        """
        self.add_service(CANCEL, _CANCEL_TEXT)
        for name, text in _TOLERANCES.items():
            if not self.has(name):
                self.add(name, text + _BOUNDS)
        if not self.has(f"{FOLLOW}_Goal"):
            self.add_action(FOLLOW, _FOLLOW_TEXT)
        texts = _SEPARATOR.split(_FOLLOW_TEXT)
        for part, text in zip(_ACTION_PARTS, texts, strict=True):
            name = f"{FOLLOW}_{part}"
            self.must_have(name)
            known = {one.name for one in self.fields(name)}
            wanted = [line.split()[1] for line in text.splitlines()]
            missing = [one for one in wanted if one not in known]
            if missing:
                raise ConfigError(
                    f"the {part.lower()} of {FOLLOW} has no field {missing[0]}",
                    where=self._files[name],
                    expected=" ".join(wanted),
                    remedy="give the .action file of ROS 2's control_msgs, or none",
                )

    def _add_folder(self, folder: Path) -> None:
        files = _files(folder, "msg")
        actions = _files(folder, "action")
        if not files and not actions:
            raise ConfigError(
                "this folder has no messages",
                where=str(folder),
                expected="files PACKAGE/msg/NAME.msg",
                remedy="name the folder in which the packages are",
            )
        found: dict[str, Any] = {}
        for file in files:
            name = _type_of_file(file)
            text = _text_of(file)
            try:
                found |= _as_in_ros(self._sys.get_types_from_msg(text, name))
            except Exception as error:  # noqa: BLE001 - what rosbags' parser raises
                raise ConfigError(
                    f"this is no definition of the message {name}",
                    where=str(file),
                    got=str(error).partition("\n")[0] or type(error).__name__,
                    remedy="write it as in ROS 2",
                ) from None
        try:
            self._store.register(found)
        except Exception as error:  # noqa: BLE001 - what rosbags raises
            raise ConfigError(
                "these messages do not fit together",
                where=str(folder),
                got=str(error).partition("\n")[0],
                remedy="give every message that another one has, too",
            ) from None
        self._files |= {_type_of_file(file): str(file) for file in files}
        for file in actions:
            self.add_action(_type_of_file(file), _text_of(file), str(file))

    def has(self, name: str) -> bool:
        """Return whether a message is known."""
        return name in self._store.fielddefs

    def must_have(
        self, name: str, where: str = "", within: tuple[str, ...] = ()
    ) -> None:
        """Refuse a type that is not known, has a field of such a type, or has itself.

        Args:
            name: The type.
            where: The place, for errors.
            within: Types from the whole message to this one.

        Raises:
            ConfigError: It is none.
        """
        way = (*within, name)
        if name in within:
            raise ConfigError(
                f"the message {name} contains itself",
                where=self._files.get(name) or where,
                expected="fields whose types lead to numbers and texts",
                got=" has ".join(way[way.index(name) :]),
                remedy="remove one of these fields",
            )
        if name not in self._store.fielddefs:
            raise ConfigError(
                f"there is no message {name}",
                where=where,
                expected="a name such as sensor_msgs/msg/JointState",
                remedy=did_you_mean(name, self._store.fielddefs)
                or "give its .msg file: `messages` names the folder of its package",
            )
        for field in self.fields(name):
            if field.nested:
                self._must_have_field(name, field, where)
                self.must_have(field.type, where, way)

    def _must_have_field(self, name: str, field: Field, where: str) -> None:
        if self.has(field.type):
            return
        short = field.type.rpartition("/")[2]
        raise ConfigError(
            f"the field {field.name} of {name} is of the unknown type {short}",
            where=self._files.get(name) or where,
            expected="a number's type, string, or a message that is known",
            got=field.type,
            remedy=did_you_mean(short, _SIMPLE)
            or "correct it, or give its .msg file, too",
        )

    def hash(self, name: str) -> str:
        """Return the hash of a message's or service's type, as keys have it."""
        return str(self._store.hash_rihs01(name))

    def definition(self, name: str) -> str:
        """Return the text of a message, with all those that it has."""
        return str(self._store.generate_msgdef(name, ros_version=2)[0])

    @property
    def store(self) -> Any:  # noqa: ANN401 - rosbags' own
        """All types, as rosbags has them."""
        return self._store

    def fields(self, name: str) -> list[Field]:
        """Return the fields of a message."""
        return [self._field(*one) for one in self._store.fielddefs[name][1]]

    def _field(self, name: str, kind: tuple[Any, Any]) -> Field:
        node, about = kind
        size: int | None = None
        bound = 0
        if node == self._nodes.ARRAY:
            (node, about), size = about
        elif node == self._nodes.SEQUENCE:
            size = 0
            (node, about), bound = about
        nested = node == self._nodes.NAME
        return Field(name, about if nested else about[0], nested, size, bound)

    def new(self, name: str) -> Any:  # noqa: ANN401 - by its type
        """Return a message whose numbers are 0, whose texts and lists are empty."""
        values = {one.name: self._empty(one) for one in self.fields(name)}
        return self._store.types[name](**values)

    def _empty(self, field: Field) -> object:
        if field.nested or field.type in {"string", "wstring"}:
            return self._several(field)
        if field.size is not None:
            return np.zeros(field.size, dtype_of(field.type))
        return False if field.type == "bool" else np.dtype(field.type).type(0).item()

    def _several(self, field: Field) -> object:
        make = (lambda: self.new(field.type)) if field.nested else str
        return make() if field.size is None else [make() for _ in range(field.size)]

    def encode(self, name: str, message: object) -> bytes:
        """Return a message in CDR.

        Raises:
            ProtocolError: A list has more elements than its type allows.
        """
        self._must_keep_bounds(name, message)
        return bytes(self._store.serialize_cdr(message, name))

    def decode(self, name: str, data: bytes) -> Any:  # noqa: ANN401 - by its type
        """Return the message that CDR means.

        Raises:
            ProtocolError: It is no such message, or a list in it has more elements than
                its type allows.
        """
        try:
            message = self._store.deserialize_cdr(data, name)
        except Exception as error:  # noqa: BLE001 - what its generated code raises
            raise ProtocolError(
                f"this is no message {name}",
                got=f"{len(data)} bytes: {type(error).__name__}",
                remedy="its sender has another definition of the type",
            ) from None
        self._must_keep_bounds(name, message)
        return message

    def _must_keep_bounds(self, name: str, message: object, above: str = "") -> None:
        for field in self._bounded(name):
            path, value = f"{above}{field.name}", getattr(message, field.name)
            if field.bound and len(value) > field.bound:
                raise ProtocolError(
                    f"the list {path} is too long for its type",
                    expected=f"at most {field.bound} elements, as {name} says",
                    got=f"{len(value)}",
                    remedy="give fewer, or change the definition of the type",
                )
            if field.nested and field.size is None:
                self._must_keep_bounds(field.type, value, f"{path}.")
            elif field.nested:
                for place, one in enumerate(value):
                    self._must_keep_bounds(field.type, one, f"{path}[{place}].")

    def _bounded(self, name: str) -> list[Field]:
        """Return the fields that are lists with a bound, or contain one."""
        if name not in self._with_bounds:
            self._with_bounds[name] = [
                one
                for one in self.fields(name)
                if one.bound or (one.nested and self._bounded(one.type))
            ]
        return self._with_bounds[name]


def _files(folder: Path, kind: str) -> list[Path]:
    """Return the files of messages (``msg``) or actions (``action``) in a folder."""
    return sorted(folder.glob(f"*/{kind}/*.{kind}"))


def _text_of(file: Path) -> str:
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigFileError(
            "the definition cannot be read",
            where=str(file),
            got=getattr(error, "strerror", None) or str(error),
            remedy="write it in UTF-8, and let this user read it",
        ) from None
    if found := _NO_ROOM.search(text):
        raise ConfigError(
            "a list has no room for an element",
            where=str(file),
            expected="a length or bound of at least 1, as float64[<=3]",
            got=found[1],
            remedy="write `[]` for a list of any length",
        )
    return text


def _type_of_file(file: Path) -> str:
    """Return ``PACKAGE/msg/NAME`` for its file."""
    return "/".join((*file.parts[-_PARTS:-1], file.stem))


def _as_in_ros(tree: Any) -> Any:  # noqa: ANN401 - a definition, as rosbags has it
    """Return a definition as ROS means it.

    In a ``.msg`` file ``char`` is another word for ``uint8``, hashes included, and a
    service has no ``/msg`` in its name; rosbags 0.11.9 has it otherwise.
    """
    if isinstance(tree, str):
        return tree.replace("/srv/msg/", "/srv/")
    if isinstance(tree, tuple) and tree[0] == "char" and tree[1:] == (0,):
        return "uint8", 0
    if isinstance(tree, dict):
        named = cast("dict[str, Any]", tree)
        return {_as_in_ros(key): _as_in_ros(value) for key, value in named.items()}
    if isinstance(tree, list | tuple):
        parts = [_as_in_ros(one) for one in cast("list[Any]", tree)]
        return parts if isinstance(tree, list) else tuple(parts)
    return tree


def _moved(tree: Any, old: str, new: str) -> Any:  # noqa: ANN401 - a definition
    """Return a definition with messages of one folder in another."""
    if isinstance(tree, str) and tree.startswith(old):
        return f"{new}/{tree.removeprefix(old)}"
    if isinstance(tree, list | tuple):
        parts = [_moved(one, old, new) for one in cast("list[Any]", tree)]
        return parts if isinstance(tree, list) else tuple(parts)
    return tree


def dtype_of(kind: str) -> str:
    """Return numpy's name of a number's type."""
    return {"bool": "bool", "octet": "u1", "byte": "u1", "char": "u1"}.get(kind, kind)


def seconds(message: Any) -> float:  # noqa: ANN401 - Time or Duration
    """Return a time or duration in seconds."""
    return float(message.sec) + 1e-9 * float(message.nanosec)


def nanoseconds(message: Any) -> int:  # noqa: ANN401 - Time or Duration
    """Return a time or duration in nanoseconds."""
    return int(message.sec) * 1_000_000_000 + int(message.nanosec)


def set_stamp(message: Any, stamp_ns: int) -> None:  # noqa: ANN401 - Time
    """Set a time to nanoseconds since 1970."""
    message.sec, message.nanosec = divmod(stamp_ns, 1_000_000_000)


def is_finite(values: Iterable[float]) -> bool:
    """Return whether all values are numbers."""
    return all(map(math.isfinite, values))
