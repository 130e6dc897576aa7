"""What is mounted on the hand: it only says how long it is."""

from typing import Annotated as A

from pbonet import OutConst, Params, PortBasedObject, param


class Size(Params):
    """How long the fingers are."""

    length: A[float, param("m", "from the hand's last frame to the tip", gt=0)]


class Fingers(PortBasedObject[Size]):
    """Gives the constant that all who move the tip need; it need not be turned on."""

    length: A[float, OutConst("TOOL_LENGTH", "1", "m", "from the hand to the tip")]

    def init(self) -> None:
        """Say how long it is."""
        self.length = self.params.length

    def cycle(self, dt: float) -> None:
        """Do nothing: a tool's length does not change while it is mounted."""
