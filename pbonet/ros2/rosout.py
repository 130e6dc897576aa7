"""The bridge's warnings on /rosout, where users of ROS 2 read what nodes say."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

import zenoh

from .message_types import set_stamp
from .wire_format import Qos

if TYPE_CHECKING:
    from .ros_node import RosNode

_TOPIC: Final = "/rosout"
_LOG: Final = "rcl_interfaces/msg/Log"
_WARN: Final = 30
"""The level, as in the message's definition."""
_QOS: Final = Qos(depth=10, transient_local=True)
"""A subscriber that comes later gets the last ones, as those of any node."""


class Rosout:
    """Publishes what a user should know as messages of a node's log.

    Args:
        node: The node that says it.
    """

    def __init__(self, node: RosNode) -> None:
        self._types = node.types
        self._name = node.node.full_name.strip("/").replace("/", ".")
        self._publisher = node.publisher(_TOPIC, _LOG, _QOS)

    def warn(self, text: str) -> None:
        """Publish a warning; any thread calls it, also while the node ends."""
        message, now = self._types.new(_LOG), time.time_ns()
        set_stamp(message.stamp, now)
        message.level, message.name, message.msg = _WARN, self._name, text
        try:
            self._publisher.put(self._types.encode(_LOG, message), now)
        except zenoh.ZError:  # it was shown elsewhere, too
            return
