"""A position as a set-point of a MAVLink vehicle."""

from typing import Annotated as A

from pbonet import InVar, OutVar, PortBasedObject, Vector
from pbonet.modules._mavlink import ACC, POSITION, YAW, YAW_RATE, V
from pbonet.modules._mavlink_heading import Heading


class MavSetpointPos(PortBasedObject[Heading], module_class="subsystem interface"):
    """setpoint = the position x_des, and a heading; for `mav_vehicle`."""

    x_des: A[Vector, InVar("X_DES", "3", "m", "desired position, NED")]
    setpoint: A[Vector, OutVar("SETPOINT", "13", "mixed", "kind, mask, eleven values")]

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        free = self.params.heading == "free"
        self.setpoint[:] = 0.0
        self.setpoint[0] = POSITION
        self.setpoint[1] = V | ACC | YAW_RATE | (YAW if free else 0)
        self.setpoint[2:5] = self.x_des
        self.setpoint[11] = 0.0 if free else self.params.yaw

    def off(self) -> None:
        if not self.task.handover:
            self.setpoint[:] = 0.0
