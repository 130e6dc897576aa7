"""Commands of an operator to a MAVLink vehicle: arming and modes."""

from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, param


class Orders(Params):
    """The commands."""

    arm: A[int, param("none", "1 arms, 0 disarms", ge=0, le=1)] = 0
    mode: A[int, param("none", "custom mode of the autopilot", ge=0)] = 0


class MavCommand(PortBasedObject[Orders], module_class="teleoperation"):
    """ARM_CMD and MODE_CMD become what `set` says, when it is said.

    Turning it on changes neither: so a task that starts again commands nothing.
    """

    arm: A[int, OutVar("ARM_CMD", "1", "none", "1 arms, 0 disarms")]
    mode: A[int, OutVar("MODE_CMD", "1", "none", "mode to set")]

    def on(self) -> None:
        self._said: dict[str, int] = {}

    def set(self, name: str, value: object) -> None:
        if getattr(self, "_said", None) is not None and isinstance(value, int):
            self._said[name] = value

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - commands only
        if self._said:
            self.arm = self._said.get("arm", self.arm)
            self.mode = self._said.get("mode", self.mode)
            self._said.clear()
