"""An attitude and thrust as a set-point of a MAVLink vehicle."""

from typing import Annotated as A

from pbonet import InVar, OutVar, Params, PortBasedObject, Vector
from pbonet.modules._mavlink import ATTITUDE, RATES


class MavSetpointAtt(PortBasedObject[Params], module_class="subsystem interface"):
    """setpoint = the attitude att_des and the share thr of the thrust; no rates."""

    att_des: A[Vector, InVar("ATT_DES", "4", "none", "desired attitude w x y z")]
    thr: A[float, InVar("THR_DES", "1", "none", "share of the largest thrust")]
    setpoint: A[Vector, OutVar("SETPOINT", "13", "mixed", "kind, mask, eleven values")]

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        self.setpoint[:] = 0.0
        self.setpoint[0], self.setpoint[1] = ATTITUDE, RATES
        self.setpoint[2:6] = self.att_des
        self.setpoint[9] = min(max(self.thr, 0.0), 1.0)

    def off(self) -> None:
        if not self.task.handover:
            self.setpoint[:] = 0.0
