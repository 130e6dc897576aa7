"""Cameras that MuJoCo draws, where EGL works; elsewhere a test is skipped by name."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NoReturn

import pytest

from pbonet.errors import DeviceError
from pbonet.io import MujocoCamera

EXAMPLE = Path(__file__).parents[2] / "examples" / "camera_servoing"


def drawn_camera(name="eye", width=320, height=240):
    """Return a camera of the example's scene; its caller closes it."""
    try:
        return MujocoCamera(EXAMPLE / "scene.xml", name, width, height)
    except DeviceError as error:
        skip_without_egl(error)


def skip_without_egl(error) -> NoReturn:
    """Skip the test, if this is why no picture can be drawn here; else raise."""
    reasons = "EGL does not work here", "pip install 'pbonet[mujoco]'"
    if os.environ.get("CI") or not any(one in str(error) for one in reasons):
        raise error
    pytest.skip(str(error))
