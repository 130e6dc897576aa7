"""Send a variable to another subsystem, on any machine."""

from typing import Annotated as A

from pbonet import InVar, Params, PortBasedObject, Vector, param, tbuf
from pbonet.io import devices_allowed


class Outgoing(Params):
    """The link."""

    link: A[str, param("none", "name of the link; other subsystems use SUBSYSTEM:NAME")]


class TbufSend(PortBasedObject[Outgoing], module_class="subsystem interface"):
    """Send z in every cycle, with the time; not while z is stale (its MAXAGE).

    So what the receiver has is never older than it seems. It never waits: not for
    a receiver, nor for a network. In a simulation nothing is sent.
    """

    z: A[Vector, InVar("Z", "n", "any", "the value to send")]

    def init(self) -> None:
        self._link = None
        if devices_allowed():
            form = ("f8", self.z.shape)
            self._link = tbuf.Writer(self.params.link, form, data=self.z)

    def on(self) -> None:
        self._stale = False

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        stale = self.task.stale("z")
        if stale and not self._stale:
            self.task.warn(f"link {self.params.link} is paused: its variable is stale")
        self._stale = stale
        if self._link is not None and not stale:
            self._link.write()

    def kill(self) -> None:
        if link := getattr(self, "_link", None):
            link.close()
