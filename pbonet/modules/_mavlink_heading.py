"""Where a MAVLink vehicle points while it follows a set-point."""

from typing import Annotated as A, Literal

from pbonet import Params, param


class Heading(Params):
    """Where the vehicle points."""

    heading: A[
        Literal["free", "fixed"], param("none", "left to the vehicle, or YAW")
    ] = "free"
    yaw: A[float, param("rad", "the heading if it is fixed; 0 is north")] = 0.0
