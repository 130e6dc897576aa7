"""Six axes without friction, each a mass that turns: what the controllers hold."""

from typing import Annotated as A

from pbonet import InVar, OutConst, OutVar, Params, PortBasedObject, Vector, param


class Mass(Params):
    """One inertia for all axes."""

    inertia: A[float, param("kg*m^2", "inertia of each axis", gt=0)] = 1.0


class Axes(PortBasedObject[Mass], module_class="robot interface"):
    """Turn six masses by the commanded torques, in steps of dt."""

    ndof: A[int, OutConst("NDOF", "1", "none", "degrees of freedom")]
    tau: A[Vector, InVar("T_REF", "6", "N*m", "commanded torque")]
    q: A[Vector, OutVar("Q_MEZ", "6", "rad", "measured position")]
    qd: A[Vector, OutVar("Q^_MEZ", "6", "rad/s", "measured velocity")]

    def init(self) -> None:
        """Set the number of axes."""
        self.ndof = 6

    def cycle(self, dt: float) -> None:
        """Integrate speed, then position."""
        self.qd += self.tau / self.params.inertia * dt
        self.q += self.qd * dt

    def stable(self, dt: float) -> None:
        """Brake, whatever the torque is."""
        self.qd *= max(0.0, 1.0 - 20.0 * dt)
        self.q += self.qd * dt
