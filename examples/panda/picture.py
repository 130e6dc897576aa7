"""A picture of the arm and of what its hand has drawn, rendered by MuJoCo.

    MUJOCO_GL=egl python examples/panda/picture.py FILE.png

Runs the job in virtual time and draws the recorded way of the hand.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
SIZE = 720, 960
"""Height and width, pixels."""


def scene(mujoco: Any, way: Any) -> Any:  # noqa: ANN401 - it has no stubs
    """Return the arm on a floor, with a dot for each place of its hand."""
    spec = mujoco.MjSpec.from_file(str(HERE / "panda.urdf"))
    spec.visual.global_.offheight, spec.visual.global_.offwidth = SIZE
    spec.visual.headlight.ambient = [0.4, 0.4, 0.4]
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.97, 0.98, 1.0],
        rgb2=[0.75, 0.82, 0.9],
        width=64,
        height=384,
    )
    world = spec.worldbody
    world.add_light(pos=[1.5, -1.5, 3.0], dir=[-0.5, 0.5, -1.0])
    world.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[3.0, 3.0, 0.1],
        rgba=[0.8, 0.84, 0.88, 1],
    )
    for place in way:
        world.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[0.006, 0.0, 0.0],
            pos=place,
            rgba=[0.85, 0.2, 0.1, 1.0],
        )
    return spec.compile()


def main(file: str) -> None:
    """Draw to `file`."""
    files: Any = importlib.import_module("matplotlib.image")
    mujoco: Any = importlib.import_module("mujoco")
    sys.path.insert(0, str(HERE))
    demo = importlib.import_module("demo")
    recording = demo.run(sim=True)
    time, there, _ = demo.hand(recording)
    model = scene(mujoco, there[::10])
    data = mujoco.MjData(model)
    outside = time[np.argmax(there[:, 1])]  # where the hand hides least
    when, joints = recording.series("Q_MEZ")
    data.qpos[:] = joints[np.searchsorted(when, outside)]
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = [0.15, 0.0, 0.4]
    camera.distance, camera.azimuth, camera.elevation = 1.6, 215.0, -14.0
    renderer = mujoco.Renderer(model, *SIZE)
    renderer.update_scene(data, camera)
    files.imsave(file, np.asarray(renderer.render()))


if __name__ == "__main__":
    main(sys.argv[1])
