"""Three pictures of the quadruped in one: it stands, squats, and is pushed.

    MUJOCO_GL=egl python examples/quadruped/picture.py FILE.png

Runs the job in virtual time and draws what was measured; rendered by MuJoCo.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
SIZE = 480, 480
"""Height and width of each, pixels."""
TIMES = 0.5, 2.0, 3.69
"""When, in seconds: the third is just before the push ends."""


def main(file: str) -> None:
    """Draw to `file`."""
    files: Any = importlib.import_module("matplotlib.image")
    mujoco: Any = importlib.import_module("mujoco")
    sys.path.insert(0, str(HERE))
    demo = importlib.import_module("demo")
    recording = demo.run(sim=True)
    time, pose, _ = demo.bodies(recording)
    joints = recording.series("Q_MEZ")[1]
    model = mujoco.MjModel.from_xml_path(str(HERE / "quadruped.xml"))
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = [0.0, 0.03, 0.15]
    camera.distance, camera.azimuth, camera.elevation = 1.05, 215.0, -14.0
    renderer = mujoco.Renderer(model, *SIZE)
    drawn: list[np.ndarray[Any, Any]] = []
    for when in TIMES:
        k = int(np.searchsorted(time, when))
        data.qpos[:3], data.qpos[7:] = pose[k, :, 3], joints[k]
        mujoco.mju_mat2Quat(data.qpos[3:7], pose[k, :, :3].ravel())
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, camera)
        if when >= demo.PUSHED:
            _arrow(mujoco, renderer.scene, data.qpos[:3])
        drawn.append(np.asarray(renderer.render()).copy())
    files.imsave(file, np.concatenate(drawn, axis=1))


def _arrow(mujoco: Any, scene: Any, to: Any) -> None:  # noqa: ANN401 - it has no stubs
    """Draw the force of the push at the body."""
    arrow = scene.geoms[scene.ngeom]
    scene.ngeom += 1
    mujoco.mjv_initGeom(
        arrow,
        mujoco.mjtGeom.mjGEOM_ARROW,
        np.zeros(3),
        np.zeros(3),
        np.eye(3).ravel(),
        np.array([0.85, 0.2, 0.1, 1.0]),
    )
    kind, width = mujoco.mjtGeom.mjGEOM_ARROW, 0.012
    start, end = to + np.array([0.0, 0.4, 0.03]), to + np.array([0.0, 0.08, 0.03])
    mujoco.mjv_connector(arrow, kind, width, start, end)


if __name__ == "__main__":
    main(sys.argv[1])
