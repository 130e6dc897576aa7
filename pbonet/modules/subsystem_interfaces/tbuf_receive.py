"""Receive a variable of another subsystem, on any machine."""

from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param, tbuf
from pbonet.io import devices_allowed

NEVER = 1
"""Age of a value that was never received, nanoseconds."""


class Incoming(Params):
    """The link, and the largest age."""

    link: A[str, param("none", "name of the link, SUBSYSTEM:NAME of the sender")]
    maxage: A[float, param("s", "warn when the value is older; 0: never", ge=0)] = 0.0
    fail: A[bool, param("none", "whether a value that is too old is an error")] = False


class TbufReceive(PortBasedObject[Incoming], module_class="subsystem interface"):
    """z = the value received last, stamped with the time at which it was written.

    So the age of the variable in the table is that of what it holds, and readers see it
    stale by its own MAXAGE, however the link was lost. Until something has come, z
    stays what it was. What is older than `maxage` is warned of once, or is an error;
    the next record ends it. In a simulation nothing is received.
    """

    z: A[Vector, OutVar("Z", "n", "any", "the received value")]

    def init(self) -> None:
        self._link = None
        if devices_allowed():
            self._link = tbuf.Reader(self.params.link, ("f8", self.z.shape))

    def on(self) -> None:
        self._old = False
        self._began = self.task.now
        if self._link is not None:
            self._link.read()
            self._take(self._link)

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - stamps tell the time
        link = self._link
        if link is None:
            return
        if link.read():
            self._take(link)
        if limit := self.params.maxage:
            age = (self.task.now - (link.time_ns or self._began)) * 1e-9
            if age > limit and not self._old:
                self._warn_of_age(age)
            self._old = age > limit

    def kill(self) -> None:
        if link := getattr(self, "_link", None):
            link.close()

    def _take(self, link: tbuf.Reader) -> None:
        if link.number:
            self.z[:] = link.value
        self.task.stamp_ns = link.time_ns or NEVER

    def _warn_of_age(self, age: float) -> None:
        text = f"link {self.params.link}: nothing arrived for {age:.3g} s"
        if self.params.fail:
            self.task.fail(f"{text}; check its sender and the network")
        self.task.warn(text)
