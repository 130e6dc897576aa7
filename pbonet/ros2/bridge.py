"""The process between a subsystem and ROS 2: ``pbonet ros2 bridge``."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

import msgspec

from pbonet import xm
from pbonet.master.console import Interrupts, render
from pbonet.master.subsystem import Subsystem
from pbonet.svar import Table, short_slices, survive_cuts
from pbonet.xm.net import session

from . import publishing, subscribing, topics_file, trajectory_action
from .message_types import MessageTypes
from .repeated_warnings import Warnings
from .ros_node import RosNode
from .rosout import Rosout
from .services import Services
from .subscribing import Incoming
from .topics_file import HOME
from .trajectory_action import TrajectoryAction
from .wire_format import Kind, Node

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pbonet.config import Variable
    from pbonet.master.configuration import Place

    from .publishing import Outgoing
    from .topics_file import Action, Topics

ROUTER: Final = "tcp/localhost:7447"
"""Where nodes of ROS 2 expect a router, unless told otherwise."""


_OF_ACTION: Final = "/_action/"
"""In the names of an action's topics and services, which ROS does not list either."""


class Network(msgspec.Struct, frozen=True):
    """Where the nodes of ROS 2 are."""

    router: str = ""
    """The endpoint of their router; empty without `listen`: `ROUTER`."""
    listen: str = ""
    """Serve as their router at this endpoint."""
    insecure: bool = False
    """Whether to listen beyond this machine."""

    @property
    def dialled(self) -> str:
        """The endpoint to which it connects."""
        return self.router or ("" if self.listen else ROUTER)


class Bridge:
    """A subsystem as a node of ROS 2.

    Args:
        subsystem: Its files are read; for services it is open, for watching.
        topics: What is published and subscribed; None: all variables, by their names.
        network: Where the nodes of ROS 2 are.
        warnings: What a user should know.

    Raises:
        ConfigError: The topics do not fit the table.
        NodeError: The nodes of ROS 2 cannot be reached.
        XmError: A link has another writer.
    """

    def __init__(
        self,
        subsystem: Subsystem,
        topics: Topics | None,
        network: Network,
        warnings: Warnings,
        where: str = "",
    ) -> None:
        self._ends = ExitStack()
        self._actions: list[str] = []
        variables = subsystem.files.table.variables
        topics = topics or topics_file.by_names(variables)
        types = MessageTypes(topics.folders)
        where = where or str(subsystem.files.path)
        records = [
            (one, subscribing.reading(types, one, f"{where}: {one.topic}"))
            for one in topics.subscribe
        ]
        for action in topics.action:
            trajectory_action.check(
                action, _by_name(variables), f"{where}: {action.name}"
            )
        domain = topics.ros_domain
        fillings = publishing.fillings(
            types, topics.publish, _by_name(variables), where
        )
        full_name = topics.node or subsystem.name.replace("-", "_")
        opened = session.ros2(
            domain,
            router=network.dialled,
            listen=network.listen,
            insecure=network.insecure,
        )
        namespace, _, name = f"/{full_name.strip('/')}".rpartition("/")
        node = Node(domain, "", name, namespace or "/")
        self.node = RosNode(opened, node, types, warnings)
        self._ends.callback(self.node.close)
        try:
            self._open(subsystem, records, fillings, types, warnings)
            self._offer(subsystem, topics.action, warnings)
        except BaseException:
            self._ends.close()
            raise

    def _open(
        self,
        subsystem: Subsystem,
        records: Sequence[tuple[topics_file.Subscribe, subscribing.Reading]],
        fillings: Sequence[tuple[topics_file.Publish, publishing.Filling]],
        types: MessageTypes,
        warnings: Warnings,
    ) -> None:
        self.node.open()
        warnings.also(Rosout(self.node).warn)
        xm.live_on(HOME, domain=subsystem.domain)
        for asked, record in records:
            link = Incoming(types, asked, record, warnings)
            self._ends.callback(link.close)
            self.node.subscribe(
                asked.topic, asked.type, asked.qos, link.take, asked.max_hz
            )
        outgoing: list[Outgoing] = []
        for about, filling in fillings:
            publisher = self.node.publisher(about.topic, about.type, about.qos)
            outgoing.append(
                publishing.Outgoing(filling, publisher, about.max_hz, warnings)
            )
        variables = subsystem.files.table.variables
        table = publishing.TablePublisher(
            f"{subsystem.domain}.{subsystem.name}",
            Table.layout_of(variables),
            outgoing,
            warnings,
        )
        table.start()
        self._ends.callback(table.stop)

    def _offer(
        self, subsystem: Subsystem, actions: Sequence[Action], warnings: Warnings
    ) -> None:
        name = f"{subsystem.domain}.{subsystem.name}"
        layout = Table.layout_of(subsystem.files.table.variables)
        for about in actions:
            action = TrajectoryAction(self.node, about, name, layout, warnings)
            self._ends.callback(action.close)
            action.open()
            self._actions.append(action.name)

    def close(self) -> None:
        """End everything."""
        self._ends.close()

    def offered(self) -> dict[str, list[str]]:
        """Return the names of all that it offers, by what it does with them."""
        ends = [one for one in self.node.ends if _OF_ACTION not in one.name]
        return {
            "publishes": [one.name for one in ends if one.kind == Kind.PUBLISHER],
            "subscribes": [one.name for one in ends if one.kind == Kind.SUBSCRIBER],
            "services": [one.name for one in ends if one.kind == Kind.SERVICE],
            "actions": self._actions,
        }


def _by_name(variables: Sequence[Variable]) -> dict[str, Variable]:
    return {one.name: one for one in variables}


def run(
    path: Path,
    place: Place,
    file: Path | None,
    network: Network,
    *,
    control: bool = False,
    as_data: bool = False,
) -> None:
    """Serve as the node of ROS 2 of a subsystem until interrupted.

    Args:
        path: The ``.sbs`` file, or a ``.job`` file that names it.
        place: Where the subsystem is.
        file: The file of topics; None: all variables are published, by their names.
        network: Where the nodes of ROS 2 are.
        control: Whether they may change the subsystem.
        as_data: Print what is offered as JSON.

    Raises:
        PbonetError: A file is wrong, an agent or a router cannot be reached, or a link
            has another writer.
    """
    survive_cuts()
    short_slices()  # before zenoh's threads begin, which get the same
    topics = None if file is None else topics_file.read_topics(file)
    subsystem = Subsystem(path, **place.arguments, kind="ros2", watch=True)
    warnings = Warnings(lambda text: render.print_error(render.warning(text)))
    interrupts = Interrupts(once=True)
    with subsystem, interrupts.caught():
        bridge = Bridge(subsystem, topics, network, warnings, str(file or path))
        try:
            Services(bridge.node, subsystem, path, place, control=control).open()
            sys.stdout.write(f"{_text(bridge, as_data=as_data)}\n")
            sys.stdout.flush()
            interrupts.wished.wait()
        finally:
            bridge.close()


def _text(bridge: Bridge, *, as_data: bool) -> str:
    node, offered = bridge.node.node, bridge.offered()
    if as_data:
        about = {"node": node.full_name, "domain": node.domain, **offered}
        return msgspec.json.encode(about).decode()
    lines = [f"node {node.full_name} in ROS domain {node.domain}"]
    lines += [f"{does} {name}" for does, names in offered.items() for name in names]
    return "\n".join(lines)
