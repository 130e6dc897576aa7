"""The library of the camera's processor: draws what the camera sees, and looks at it.

The executive of `[spp.camera]` in the agent's settings runs this file.
"""

from pathlib import Path
from types import SimpleNamespace

from pbonet.io import MujocoCamera, red_blob
from pbonet.io.spp import Library

SCENE = Path(__file__).with_name("scene.xml")
SIZE = 320, 240
"""Width and height of a picture, pixels."""

library = Library()
library.variable("q", 6)
library.variable("ball", 3)
library.variable("seen", 6)


@library.setup("numpy")
def open_scene(m: SimpleNamespace) -> None:
    """Open the scene, and take a first picture, which takes longer than all others."""
    m.local.camera = MujocoCamera(SCENE, "eye", *SIZE)
    m.local.camera.take(m.q, ball=m.ball)


@library.routine("numpy")
def look(m: SimpleNamespace, number: int) -> None:
    """Take a picture with the joints at `q` and the ball at `ball`."""
    blob = red_blob(m.local.camera.take(m.q, ball=m.ball))
    m.seen[:] = number, *blob
