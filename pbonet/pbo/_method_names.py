"""The names of the methods of modules, and of the classes of the library.

They stand apart from what reads a class body, which needs numpy.
"""

from __future__ import annotations

from typing import Literal, get_args

METHODS = {
    "init": "(self)",
    "on": "(self)",
    "cycle": "(self, dt)",
    "off": "(self)",
    "kill": "(self)",
    "error": "(self, error)",
    "clear": "(self)",
    "reinit": "(self)",
    "sync": "(self)",
    "set": "(self, name, value)",
    "get": "(self, name)",
    "stable": "(self, dt)",
    "timing_failure": "(self, kind)",
}
"""The methods that the runtime calls, and how each is written."""

ModuleClass = Literal[
    "",
    "controller",
    "robot interface",
    "kinematics",
    "trajectory",
    "sensor",
    "teleoperation",
    "signal",
    "connector",
    "subsystem interface",
]
"""A class of modules in the library; empty: none is declared."""
MODULE_CLASSES: tuple[str, ...] = get_args(ModuleClass)[1:]
"""The classes of modules in the library (Stewart 1994, Figure 3.14)."""
ROBOT_INTERFACE: ModuleClass = "robot interface"
