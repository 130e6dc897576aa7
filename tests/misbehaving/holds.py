"""A module with parameters and a `stable`, for what is changed while it runs."""

from typing import Annotated as A

import numpy as np

from pbonet import (
    Answer,
    InVar,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
    param,
)


class Setting(Params):
    """What is held."""

    level: A[float, param("none", "what y is set to", ge=-10, le=10)]
    ready: A[bool, param("none", "whether it can be turned on")] = True


class Holds(PortBasedObject[Setting]):
    """y = (level, z1), and (-1, z1) while the configuration is illegal."""

    z: A[Vector, InVar("Z", "2", "none", "what is passed on")]
    y: A[Vector, OutVar("Y", "2", "none", "the level, and what came in")]

    def on(self) -> Answer | None:
        return None if self.params.ready else Answer.OFF

    def cycle(self, dt: float) -> None:
        self.y[:] = self.params.level, self.z[0]

    def stable(self, dt: float) -> None:
        if self.params.level == 7.0:
            raise ValueError("seven is not stable")
        if self.params.level == 8.0:
            self.task.fail("eight is not stable")
        self.y[:] = np.nan if self.params.level == 6.0 else -1.0, self.z[0]

    def set(self, name: str, value: object) -> None:
        if value == 9.0:
            raise ValueError("nine is not liked")
