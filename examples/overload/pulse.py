"""Bursts of work with rest between them."""

from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, param


class Rhythm(Params):
    """How long both are."""

    work: A[int, param("none", "cycles of work", ge=1)]
    rest: A[int, param("none", "cycles of rest, which come first", ge=1)]


class Pulse(PortBasedObject[Rhythm]):
    """Say when to work, counting its own cycles."""

    go: A[int, OutVar("GO", "1", "none", "whether to work")]

    def on(self) -> None:
        """Begin with the rest."""
        self.go = 0
        self._done = 0

    def cycle(self, dt: float) -> None:  # noqa: ARG002
        """Work in the last cycles of each round."""
        rest = self.params.rest
        self.go = int(self._done % (rest + self.params.work) >= rest)
        self._done += 1

    def off(self) -> None:
        """Leave nobody at work."""
        self.go = 0
