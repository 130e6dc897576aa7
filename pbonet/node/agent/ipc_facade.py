"""An agent's part in express mail: its server, and the gateway of its tasks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .file_server import FileServer
from .resource_server import ResourceServer
from .task_gateway import TaskGateway

if TYPE_CHECKING:
    from collections.abc import Callable

    import zenoh

    from pbonet.node.wire import rtpu_messages
    from pbonet.xm.net import XmRequest, run_folder


class Mail:
    """The server of resources and the gateway for tasks.

    Args:
        session: The agent's session.
        places: The agent's files.
        files: The folder of files for other machines, if declared.
        note: Called with reports for masters.
        parts: Returns whether a missed stop keeps tasks of a subsystem and an RTPU on
            another machine apart.

    Raises:
        NodeError: That folder does not exist.
    """

    def __init__(
        self,
        session: zenoh.Session,
        places: run_folder.Places,
        files: str | None,
        note: Callable[[rtpu_messages.Note], None],
        parts: Callable[[str, str], bool],
    ) -> None:
        whose = session, places.domain, places.name
        fileserver = FileServer(files, places.name)
        self._resources = ResourceServer(*whose, fileserver, parts)
        self._relay = TaskGateway(*whose, places.post, note, parts=parts)

    def take(self, request: XmRequest, reply: Callable[[bytes], None]) -> None:
        """Start a request, which is answered when it is done; returns at once."""
        self._resources.take(request, reply)

    def is_used(self) -> bool:
        """Return whether programs elsewhere hold, or wait for, something here."""
        return self._resources.is_used()

    def end_waits(self) -> None:
        """Release all resources, which can then be removed."""
        self._resources.stop()

    def stop(self) -> None:
        """End the server and the gateway."""
        self._resources.stop()
        self._relay.stop()
