"""Services of a bridge: the commands of the one table, and tasks' parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, cast

import msgspec
from msgspec import structs

from pbonet.errors import AccessError, PbonetError, UnknownTaskError
from pbonet.master.console import (
    COMMANDS,
    Call,
    CommandSession,
    Reply,
    Scope,
    convert,
    find,
    oneshot,
    render,
)

from .message_types import COMMAND

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from pbonet.master.configuration import Place
    from pbonet.master.console import Command
    from pbonet.master.subsystem import Subsystem

    from .message_types import MessageTypes
    from .ros_node import RosNode

_PACKAGE: Final = "rcl_interfaces"
_WAITS: Final = {"sigwait"}
"""Commands that would keep all others waiting."""
_AT_ONCE: Final = {"stop"}
"""Commands that wait for no other."""
_SCALARS: Final = {
    bool: (1, "bool"),
    int: (2, "integer"),
    float: (3, "double"),
    str: (4, "string"),
}
_LISTS: Final = {
    bool: (6, "bool"),
    int: (7, "integer"),
    float: (8, "double"),
    str: (9, "string"),
}
"""Numbers and fields of ParameterValue by Python's types; 0 is no value."""
_NOT_SET: Final = 0


def offered() -> list[Command]:
    """Return the commands that a bridge offers: those that all interfaces have."""
    return [
        one
        for one in COMMANDS
        if one.scope is Scope.EVERYWHERE and one.name not in _WAITS
    ]


class Services:
    """Carries out commands for nodes of ROS 2.

    Args:
        node: The node that offers them.
        subsystem: Open, for watching.
        path: Its file.
        place: Where it is.
        control: Whether nodes may change it; `stop` they may in any case.
    """

    def __init__(
        self,
        node: RosNode,
        subsystem: Subsystem,
        path: Path,
        place: Place,
        *,
        control: bool,
    ) -> None:
        self._node, self._subsystem = node, subsystem
        self._path, self._control = path, control
        self._place = structs.replace(place, confirm=None)  # nodes cannot be asked
        self._types: MessageTypes = node.types

    def open(self) -> None:
        """Offer everything from now on."""
        for command in offered():
            name = command.name.replace(" ", "_")
            at_once = command.name in _AT_ONCE
            requests = self._node.queue(f"ros {name}") if at_once else None
            self._node.serve(name, COMMAND, self._answering(command), requests)
        for name, answer in (
            ("ListParameters", self._list),
            ("GetParameters", self._get),
            ("GetParameterTypes", self._get_types),
            ("DescribeParameters", self._describe),
            ("SetParameters", self._set),
            ("SetParametersAtomically", self._set_at_once),
        ):
            self._node.serve(_snake(name), f"{_PACKAGE}/srv/{name}", answer)

    # -- commands ---------------------------------------------------------------------

    def _answering(self, command: Command) -> Callable[[Any], Any]:
        def answer(request: Any) -> Any:  # noqa: ANN401
            response = self._new(f"{COMMAND}_Response")
            try:
                reply = self.command(f"{command.name} {request.arguments}")
            except PbonetError as error:
                response.message = str(error)
                response.data = msgspec.json.encode(error.to_wire()).decode()
                return response
            response.success = True
            lines = [f"WARNING> {one}" for one in reply.warnings]
            response.message = "\n".join([
                *lines,
                render.text(reply.command, reply.data),
            ])
            response.data = msgspec.json.encode(reply.data).decode()
            return response

        return answer

    def command(self, line: str) -> Reply:
        """Carry out a command line, as the prompt does.

        Raises:
            AccessError: It changes the subsystem, and nodes may not.
            PbonetError: The line is wrong, or the command failed.
        """
        session = CommandSession(self._subsystem)
        call = session.read(line)
        assert call is not None  # noqa: S101 - it begins with a command
        return self._perform(session, call, words_of(call))

    def call(self, name: str, **args: object) -> Reply:
        """Carry out a command with arguments by name; raises as `command` does."""
        session, command = CommandSession(self._subsystem), find(name)
        return self._perform(session, Call(command, convert(command, args)), args)

    def _perform(
        self, session: CommandSession, call: Call, args: dict[str, object]
    ) -> Reply:
        if not call.changes:
            return session.perform(call)
        if not self._control:
            raise AccessError(
                f"{call.command.name} changes the subsystem; this bridge only shows it",
                where=self._subsystem.name,
                remedy="start the bridge with --control, or use pbonet's own verbs",
            )
        return oneshot.run(self._path, call.command.name, args, self._place)

    # -- parameters -------------------------------------------------------------------

    def _new(self, name: str) -> Any:  # noqa: ANN401
        return self._types.new(name)

    def _answer(self, name: str, **fields: object) -> Any:  # noqa: ANN401
        response = self._new(f"{_PACKAGE}/srv/{name}_Response")
        for key, value in fields.items():
            setattr(response, key, value)
        return response

    def _all(self, tasks: Iterable[str]) -> dict[str, dict[str, Any]]:
        """Return the parameters of tasks, by ``TASK.PARAMETER``."""
        found: dict[str, dict[str, Any]] = {}
        for task in dict.fromkeys(tasks):
            try:
                reply = self.call("get", task=task)
            except UnknownTaskError:
                continue
            found |= {f"{task}.{one['name']}": one for one in reply.data["params"]}
        return found

    def _of(self, names: Iterable[str]) -> list[dict[str, Any] | None]:
        """Return the parameters of these names; None for each one that is not there."""
        names = list(names)
        there = self._all(name.rpartition(".")[0] for name in names)
        return [there.get(name) for name in names]

    def _list(self, request: Any) -> Any:  # noqa: ANN401
        tasks = [one["task"] for one in self.call("status").data["tasks"]]
        found = self._all(tasks)
        response = self._answer("ListParameters")
        wanted = list(request.prefixes)
        response.result.names = [
            name
            for name in found
            if not wanted or any(name == p or name.startswith(f"{p}.") for p in wanted)
        ]
        response.result.prefixes = list(
            dict.fromkeys(name.rpartition(".")[0] for name in response.result.names)
        )
        return response

    def _get(self, request: Any) -> Any:  # noqa: ANN401
        found = [self._value(one) for one in self._of(request.names)]
        return self._answer("GetParameters", values=found)

    def _get_types(self, request: Any) -> Any:  # noqa: ANN401
        import numpy as np

        found = [self._value(one).type for one in self._of(request.names)]
        return self._answer("GetParameterTypes", types=np.array(found, np.uint8))

    def _describe(self, request: Any) -> Any:  # noqa: ANN401
        names = list(request.names)
        found: list[Any] = []
        for name, one in zip(names, self._of(names), strict=True):
            about = self._new(f"{_PACKAGE}/msg/ParameterDescriptor")
            about.name, about.type = name, self._value(one).type
            if one is not None:
                about.description = f"{one['doc']} [{one['unit']}]"
                about.additional_constraints = one["bounds"]
            found.append(about)
        return self._answer("DescribeParameters", descriptors=found)

    def _set(self, request: Any) -> Any:  # noqa: ANN401
        results = [self._set_one(one) for one in request.parameters]
        return self._answer("SetParameters", results=results)

    def _set_at_once(self, request: Any) -> Any:  # noqa: ANN401
        """Set a single parameter: several of one task have no common instant."""
        given = list(request.parameters)
        if len(given) == 1:
            return self._answer(
                "SetParametersAtomically", result=self._set_one(given[0])
            )
        result = self._new(f"{_PACKAGE}/msg/SetParametersResult")
        result.reason = "parameters are set one by one; use set_parameters"
        return self._answer("SetParametersAtomically", result=result)

    def _set_one(self, parameter: Any) -> Any:  # noqa: ANN401
        result = self._new(f"{_PACKAGE}/msg/SetParametersResult")
        task, _, name = parameter.name.rpartition(".")
        try:
            self.call("set", task=task, param=name, value=_words(parameter.value))
        except PbonetError as error:
            result.reason = str(error)
        else:
            result.successful = True
        return result

    def _value(self, one: dict[str, Any] | None) -> Any:  # noqa: ANN401
        """Return a parameter's value as ROS has it."""
        message = self._new(f"{_PACKAGE}/msg/ParameterValue")
        if one is None:
            return message
        value = one["value"]
        if isinstance(value, list | tuple):
            fill_list(message, list(cast("list[Any]", value)))
        elif type(value) in _SCALARS:
            message.type, field = _SCALARS[type(value)]
            setattr(message, f"{field}_value", value)
        else:
            message.type, message.string_value = _SCALARS[str][0], str(value)
        return message


def words_of(call: Call) -> dict[str, object]:
    """Return a call's arguments as the words that another master takes."""
    commas = {arg.name for arg in call.command.args if arg.commas}
    return {
        name: ",".join(value) if name in commas else value
        for name, value in call.given.items()
    }


def fill_list(message: Any, values: list[Any]) -> None:  # noqa: ANN401
    """Set a ParameterValue to a list."""
    import numpy as np

    inner = cast("type[object]", type(values[0])) if values else float
    if inner not in _LISTS or any(type(one) is not inner for one in values):
        inner = float if all(isinstance(v, int | float) for v in values) else str
    message.type, field = _LISTS[inner]
    made: Any = [str(one) for one in values]
    if inner is not str:
        made = np.array(values, np.int64 if inner is int else inner)
    setattr(message, f"{field}_array_value", made)


def _words(value: Any) -> list[str]:  # noqa: ANN401
    """Return a ParameterValue as the words of a command line."""
    for number, field in _SCALARS.values():
        if value.type == number:
            return [_word(getattr(value, f"{field}_value"))]
    for number, field in _LISTS.values():
        if value.type == number:
            return [_word(one) for one in getattr(value, f"{field}_array_value")]
    return []


def _word(value: Any) -> str:  # noqa: ANN401
    if isinstance(value, str):
        return value
    plain = value.item() if hasattr(value, "item") else value
    return str(plain).lower() if isinstance(plain, bool) else repr(plain)


def _snake(name: str) -> str:
    """Return ``get_parameters`` for ``GetParameters``."""
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in name).removeprefix(
        "_"
    )
