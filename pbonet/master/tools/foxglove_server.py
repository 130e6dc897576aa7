"""The running table, states and events for Foxglove, by its own WebSocket protocol.

Nothing is asked of a task, and nothing of an agent that no viewer wants to see: values
are those that `display` gives, at a rate of this program's.
"""

from __future__ import annotations

import sys
import time
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

import msgspec

from pbonet.errors import NodeError, PbonetError
from pbonet.log import LOG_SCHEMA, log_message
from pbonet.master.console import Follower, Interrupts, render
from pbonet.master.subsystem import EventFilter, Subsystem
from pbonet.xm.net import messages as m, session

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from pbonet.config import Variable
    from pbonet.master.configuration import Place

STATES: Final = 0.5
"""Seconds between two checks of the tasks' states and the events."""
_STATUS_SCHEMA: Final = {"type": "object", "title": "pbonet.TaskStatus"}


class Where(msgspec.Struct, frozen=True):
    """Where viewers find the server."""

    host: str = "127.0.0.1"
    port: int = 8765
    """0 for any that is free."""


class Viewer:
    """Serves one subsystem to viewers.

    Args:
        subsystem: Open, for watching.
        where: Host and port.

    Raises:
        NodeError: The SDK is not there, or the port cannot be had.
    """

    def __init__(self, subsystem: Subsystem, where: Where) -> None:
        self._subsystem = subsystem
        self._sdk = _sdk()
        self._context = self._sdk.Context()
        self._fresh: set[str] = set()
        """Topics that a viewer has just subscribed to."""
        self._seen: dict[str, tuple[str | None, int]] = {}
        """The writer and the number of the value that was sent last."""
        self._follower = Follower(subsystem, EventFilter.of({}))
        name = subsystem.name
        self._variables = {
            variable.name: self._channel(
                f"{name}/{variable.name}", _schema(variable), units=variable.units
            )
            for variable in subsystem.files.table.variables
        }
        self._events = self._channel(f"{name}/events", LOG_SCHEMA)
        self._tasks: dict[str, Any] = {}
        try:
            self._server = self._sdk.start_server(
                name=f"pbonet {name}",
                host=where.host,
                port=where.port,
                context=self._context,
                server_listener=_Listener(self._fresh),
            )
        except (OSError, RuntimeError) as error:
            raise NodeError(
                "viewers cannot be served there",
                where=f"{where.host}:{where.port}",
                got=str(error),
                remedy="choose another --port; 0 takes one that is free",
            ) from None
        self.port: int = self._server.port

    def _channel(self, topic: str, schema: dict[str, Any], **metadata: str) -> Any:  # noqa: ANN401
        return self._sdk.Channel(
            topic, schema=schema, context=self._context, metadata=metadata
        )

    def link(self) -> str:
        """Return a link that opens Foxglove on it."""
        return str(self._server.app_url())

    def close(self) -> None:
        """Let the viewers go."""
        self._server.stop()

    def values(self) -> None:
        """Send new values of the variables that have a viewer.

        Raises:
            PbonetError: The keeper does not answer.
        """
        names = [n for n, channel in self._variables.items() if channel.has_sinks()]
        if not names:
            return
        fresh = {name for name in names if self._is_fresh(name)}
        keeper = self._subsystem.files.sbs.keeper
        request = m.Display(names=names)
        now = time.time_ns()
        for value in self._subsystem.clients.call(keeper, request, list[m.VarValue]):
            state = (value.writer, value.seq)
            if value.name in fresh or self._seen.get(value.name) != state:
                self._seen[value.name] = state
                at = now - round((value.age or 0.0) * 1e9)
                self._variables[value.name].log(_message(value), log_time=at)

    def _is_fresh(self, name: str) -> bool:
        topic = f"{self._subsystem.name}/{name}"
        there = topic in self._fresh
        self._fresh.discard(topic)
        return there

    def states(self) -> list[str]:
        """Send how the tasks stand, and what has happened; return complaints."""
        for event in self._follower.take():
            at = round(event.wall * 1e9)
            plain = msgspec.to_builtins(event)
            self._events.log(log_message(plain, at, event.subsystem), log_time=at)
        clients = self._subsystem.clients
        results, errors = clients.each(lambda _: m.Status(), m.RtpuStatus)
        now = time.time_ns()
        there: set[str] = set()
        for status in _tasks_of(results):
            there.add(status.task)
            if status.task not in self._tasks:
                topic = f"{self._subsystem.name}/tasks/{status.task}"
                self._tasks[status.task] = self._channel(topic, _STATUS_SCHEMA)
            self._tasks[status.task].log(msgspec.to_builtins(status), log_time=now)
        for task in self._tasks.keys() - there:
            self._tasks.pop(task).close()
        return sorted({*map(str, errors), *self._follower.complaints().values()})


class _Listener:
    """Receives the topics that viewers subscribe to; called by the SDK.

    Args:
        fresh: They are added there.
    """

    def __init__(self, fresh: set[str]) -> None:
        self._fresh = fresh

    def on_subscribe(self, _client: object, channel: Any) -> None:  # noqa: ANN401
        """Take note of a topic."""
        self._fresh.add(channel.topic)

    def on_unsubscribe(self, _client: object, _channel: object) -> None:
        """Without viewers nothing is sent anyway."""


def view(
    path: str | Path,
    place: Place,
    where: Where,
    *,
    hz: float = 20.0,
    insecure: bool = False,
    as_data: bool = False,
) -> None:
    """Serve a subsystem to viewers until interrupted.

    Args:
        path: The ``.sbs`` file, or a ``.job`` file that names it.
        place: Where the subsystem is.
        where: Where viewers find it.
        hz: How often values are read.
        insecure: Serve beyond this machine; nothing protects it.
        as_data: Print where it is as JSON.

    Raises:
        PbonetError: A file is wrong, no agent can be reached, or the SDK is not there.
    """
    host = f"[{where.host}]" if ":" in where.host else where.host
    try:
        session.check_endpoint(f"tcp/{host}:{where.port or 1}", insecure=insecure)
    except NodeError as error:
        error.where = f"--host {where.host}"
        error.expected = "an address of this machine alone, such as 127.0.0.1"
        error.remedy = (
            f"serve 127.0.0.1 and forward the port by `ssh -L {where.port}:127.0.0.1:"
            f"{where.port} HOST`; or use --insecure if everyone on that network may "
            "read all values"
        )
        raise
    subsystem = Subsystem(
        path,
        **place.arguments,
        kind="view",
        watch=True,
    )
    interrupts = Interrupts(once=True)
    with subsystem, interrupts.caught():
        viewer = Viewer(subsystem, where)
        url = f"ws://{host}:{viewer.port}"
        text = f"{url}\nin a browser: {viewer.link()}"
        data = msgspec.json.encode({"url": url, "link": viewer.link()}).decode()
        sys.stdout.write(f"{data if as_data else text}\n")
        sys.stdout.flush()
        try:
            _serve(viewer, interrupts, 1.0 / hz)
        finally:
            viewer.close()


def _serve(viewer: Viewer, interrupts: Interrupts, pause: float) -> None:
    told: list[str] = []
    states = 0.0
    while not interrupts.wished.wait(pause):
        complaints: list[str] = []
        try:
            viewer.values()
        except PbonetError as error:
            complaints.append(str(error))
        if time.monotonic() >= states:
            states = time.monotonic() + STATES
            complaints += viewer.states()
            for text in complaints:
                if text not in told:
                    render.print_error(render.warning(text))
            told = complaints


def _tasks_of(results: dict[str, m.RtpuStatus]) -> Iterator[m.TaskStatus]:
    for status in results.values():
        yield from status.tasks


def _schema(variable: Variable) -> dict[str, Any]:
    """Return the JSON schema of a variable's messages."""
    number = {"type": "number", "description": f"{variable.desc} [{variable.units}]"}
    return {
        "type": "object",
        "title": "pbonet.Variable",
        "properties": {
            "value": {"type": "array", "items": number},
            "writer": {"type": "string"},
            "cycle": {"type": "integer"},
            "stale": {"type": "boolean"},
        },
    }


def _message(value: m.VarValue) -> dict[str, Any]:
    values = value.values
    return {
        "value": list(values) if isinstance(values, bytes) else _finite(values),
        "writer": value.writer or "",
        "cycle": value.cycle,
        "stale": value.stale,
    }


def _finite(values: list[float]) -> list[float | None]:
    """Return numbers as JSON has them, which knows no NaN."""
    return [one if abs(one) < float("inf") else None for one in values]


def _sdk() -> Any:  # noqa: ANN401 - it may not be there
    """Return Foxglove's SDK.

    Raises:
        NodeError: It is not there.
    """
    try:
        return import_module("foxglove")
    except ImportError:
        raise NodeError(
            "Foxglove's SDK is not installed",
            expected="foxglove-sdk",
            remedy='pip install "pbonet[view]"; a log needs none, Foxglove opens it',
        ) from None
