"""The Unimation PUMA 560 in numbers, as published.

Sources, by what is taken from them:

[AKB]
    B. Armstrong, O. Khatib, J. Burdick, "The explicit dynamic model and inertial
    parameters of the PUMA 560 arm", IEEE Conf. Robotics and Automation, San Francisco,
    1986, pp. 510-518: masses, centres of mass and inertias (an arm was taken apart,
    weighed, balanced and swung), and the largest joint torques.
[CA]
    P. Corke, B. Armstrong-Helouvry, "A search for consensus among model parameters
    reported for the PUMA 560 robot", IEEE Conf. Robotics and Automation, San Diego,
    1994, pp. 1608-1613: the same quantities in the frames of Paul's table (which are
    used here), motor inertias, gear ratios, viscous and Coulomb friction.
[FGL]
    K. S. Fu, R. C. Gonzalez, C. S. G. Lee, "Robotics: Control, Sensing, Vision, and
    Intelligence", McGraw-Hill, 1987, section 2.2: the joint limits. Lee's link twists
    are the negative of Paul's, so that joints 2 and 3 count the other way there.

Notes. Link 1 turns about its own axis only, so that its mass was never measured and is
zero here; it has no influence. Frame 0 stands at the shoulder. The inertia that [AKB]
measured for link 3 is, by 0.0075 kg*m^2, not quite that of a rigid body (its largest
moment exceeds the sum of the others), which is within their measurement error and left
as published; the mass matrix is positive definite regardless, and a test proves it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, radians
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ArmData:
    """Parameters of an arm with revolute joints and geared motors."""

    dh: Floats
    """Rows of theta (rad), d (m), a (m), alpha (rad)."""
    mass: Floats
    """kg, per link."""
    com: Floats
    """Centre of mass in the link's frame, m."""
    inertia: Floats
    """Diagonal terms about the centre of mass, kg*m^2."""
    gear: Floats
    """Motor turns per joint turn."""
    motor_inertia: Floats
    """At the motor's shaft, kg*m^2."""
    motor_viscous: Floats
    """Friction at the motor's shaft, N*m*s/rad."""
    motor_coulomb_up: Floats
    """Friction at the motor's shaft while the joint angle grows, N*m."""
    motor_coulomb_down: Floats
    """The same while the joint angle shrinks; positive."""
    torque: Floats
    """Largest torque at the joint, N*m."""
    lower: Floats
    """Smallest joint angle, rad."""
    upper: Floats
    """Largest joint angle, rad."""

    @property
    def ndof(self) -> int:
        """Number of joints."""
        return len(self.dh)

    @property
    def rotor(self) -> Floats:
        """Motor inertia as felt at the joint, kg*m^2."""
        return self.motor_inertia * self.gear**2

    @property
    def viscous(self) -> Floats:
        """Viscous friction at the joint, N*m*s/rad."""
        return self.motor_viscous * self.gear**2

    @property
    def coulomb_up(self) -> Floats:
        """Coulomb friction at the joint while its angle grows, N*m."""
        return self.motor_coulomb_up * self.gear

    @property
    def coulomb_down(self) -> Floats:
        """Coulomb friction at the joint while its angle shrinks, N*m; positive."""
        return self.motor_coulomb_down * self.gear


def _array(*values: object) -> Floats:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def _degrees(*values: float) -> Floats:
    return _array(*(radians(value) for value in values))


PUMA560 = ArmData(
    dh=_array(  # [CA]; theta, d, a, alpha
        (0.0, 0.0, 0.0, pi / 2),
        (0.0, 0.0, 0.4318, 0.0),
        (0.0, 0.15005, 0.0203, -pi / 2),
        (0.0, 0.4318, 0.0, pi / 2),
        (0.0, 0.0, 0.0, -pi / 2),
        (0.0, 0.0, 0.0, 0.0),
    ),
    mass=_array(0.0, 17.4, 4.8, 0.82, 0.34, 0.09),  # [AKB]
    com=_array(  # [AKB] in the frames of [CA]
        (0.0, 0.0, 0.0),
        (-0.3638, 0.006, 0.2275),
        (-0.0203, -0.0141, 0.070),
        (0.0, 0.019, 0.0),
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 0.032),
    ),
    inertia=_array(  # [AKB] in the frames of [CA]
        (0.0, 0.35, 0.0),
        (0.13, 0.524, 0.539),
        (0.066, 0.086, 0.0125),
        (1.8e-3, 1.3e-3, 1.8e-3),
        (0.3e-3, 0.4e-3, 0.3e-3),
        (0.15e-3, 0.15e-3, 0.04e-3),
    ),
    # [CA] from here; two of the gears turn the joint backwards, which is taken up by
    # giving friction per direction of the joint
    gear=_array(62.6111, 107.815, 53.7063, 76.0364, 71.923, 76.686),
    motor_inertia=_array(200e-6, 200e-6, 200e-6, 33e-6, 33e-6, 33e-6),
    motor_viscous=_array(1.48e-3, 0.817e-3, 1.38e-3, 71.2e-6, 82.6e-6, 36.7e-6),
    motor_coulomb_up=_array(0.395, 0.126, 0.132, 11.2e-3, 9.26e-3, 3.96e-3),
    motor_coulomb_down=_array(0.435, 0.071, 0.105, 16.9e-3, 14.5e-3, 10.5e-3),
    torque=_array(97.6, 186.4, 89.4, 24.2, 20.1, 21.3),  # [AKB]
    lower=_degrees(-160, -45, -225, -110, -100, -266),  # [FGL]
    upper=_degrees(160, 225, 45, 170, 100, 266),
)
