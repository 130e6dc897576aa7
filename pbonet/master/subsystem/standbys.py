"""Tasks that stand by for another one: named, ended, and informed of orders."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.errors import PbonetError
from pbonet.xm.net import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from pbonet.master.configuration import TaskModel

    from .rtpu_clients import RtpuClients


class Standbys:
    """The fallbacks of a subsystem's tasks.

    Args:
        model: Returns the tasks as last seen.
        clients: The RTPUs.
        note: Called with the status of a task.
        warned: Called with each warning.
    """

    def __init__(
        self,
        model: Callable[[], TaskModel],
        clients: RtpuClients,
        note: Callable[[m.TaskStatus], None],
        warned: Callable[[str], None],
    ) -> None:
        self._model, self._clients = model, clients
        self._note, self._warned = note, warned

    def name(
        self,
        standby: str,
        original: str,
        takeover: float = 0.0,
        *,
        ready: bool | None = None,
    ) -> None:
        """Make a task the fallback of another one; "" ends that.

        Args:
            standby: The one.
            original: The other one.
            takeover: Seconds without its RTPU after which the standby takes over by
                itself; 0: never.
            ready: Whether it does so from now on; None: if the original is ON.

        Raises:
            PbonetError: It could not take over.
        """
        model = self._model()
        member, other = model.find(standby), model.get(original)
        if other is not None:
            away = other.rtpu != member.rtpu
            member.original_rtpu = other.rtpu if away else ""
        request = m.Standby(
            task=standby,
            original=original,
            rtpu=member.original_rtpu if original else "",
            takeover=takeover,
            ready=ready if ready is not None else other is not None and other.is_on,
        )
        member.fallback_of, member.takeover = original, takeover
        self._note(self._clients.call(member.rtpu, request, m.TaskStatus))

    def inform(self, items: Iterable[tuple[str, str]], *, ready: bool) -> None:
        """Inform the standbys of tasks on other RTPUs that these get an order.

        What was ordered is no loss. A standby that cannot be informed is reported.

        Args:
            items: Pairs of task and signal.
            ready: Whether the tasks were turned on, else they are to be turned off.
        """
        signals = {"on"} if ready else {"off", "kill"}
        ordered = {task for task, signal in items if signal in signals}
        for one in list(self._model()):
            original = one.fallback_of
            if not one.original_rtpu or original not in ordered:
                continue
            try:
                self.name(one.name, original, one.takeover, ready=ready)
            except PbonetError as error:
                does = "does not stand by" if ready else "may take over"
                self._warned(f"the fallback {one.name} of {original} {does}: {error}")
