"""A camera in a scene that MuJoCo draws, without a screen.

Drawing takes milliseconds on a graphics card, and tens of them on the processor: it
belongs into the executive of a special purpose processor (`pbonet.io.spp`), never
into a cycle.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any
from weakref import finalize

import numpy as np

from pbonet.errors import DeviceError, ParameterError, did_you_mean

from .optional_packages import load_mujoco

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Picture = NDArray[np.uint8]


class MujocoCamera:
    """Takes pictures of a scene: joints and bodies are where they are put.

    No time passes in the scene. It draws by EGL, on the graphics card of the machine,
    or by Mesa's software where there is none.

    Args:
        file: The scene's MJCF file.
        camera: The name of the camera in it.
        width: Of a picture, pixels.
        height: Of a picture, pixels.

    Raises:
        ParameterError: There is no such file or camera, or MuJoCo cannot read it.
        DeviceError: MuJoCo is not installed, or EGL does not work here.
    """

    def __init__(self, file: Path, camera: str, width: int, height: int) -> None:
        mujoco: Any = load_mujoco("the drawn camera")
        self._mujoco = mujoco
        self._model = self._read(file)
        self._number = self._named(camera, file)
        self._data = mujoco.MjData(self._model)
        self._context = _context(width, height)
        self._model.vis.global_.offwidth = width
        self._model.vis.global_.offheight = height
        self._drawing = mujoco.MjrContext(
            self._model, mujoco.mjtFontScale.mjFONTSCALE_100
        )
        # In its own context: else it would free what another camera holds.
        self._end = finalize(self, _free, self._context, self._drawing)
        self._end.atexit = False  # the display is closed by then
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._drawing)
        self._scene = mujoco.MjvScene(self._model, maxgeom=1000)
        self._options, self._view = mujoco.MjvOption(), mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._view.fixedcamid = self._number
        self._frame = mujoco.MjrRect(0, 0, width, height)
        self._pixels: Picture = np.zeros((height, width, 3), np.uint8)

    @property
    def fovy(self) -> float:
        """Angle of view from the upper to the lower edge of a picture, rad."""
        return float(np.radians(self._model.cam_fovy[self._number]))

    @property
    def pose(self) -> Floats:
        """Where the camera was in the last picture: [R p], [3, 4], p in m.

        Its axes are those of `Pinhole`: x to the right, y down, z forwards.
        """
        data, k = self._data, self._number
        turn = data.cam_xmat[k].reshape(3, 3) * (1.0, -1.0, -1.0)
        return np.column_stack((turn, data.cam_xpos[k]))

    def take(self, q: Floats, **bodies: Floats) -> Picture:
        """Return a picture, rows of red, green and blue, from above to below.

        It is a view of memory that the next call writes again.

        Args:
            q: Positions of the joints, in the file's order.
            bodies: Places (m) of mocap bodies, by name.
        """
        mujoco, model, data = self._mujoco, self._model, self._data
        self._context.make_current()
        data.qpos[:] = q
        for name, place in bodies.items():
            data.mocap_pos[model.body(name).mocapid] = place
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        mujoco.mjv_updateScene(
            model,
            data,
            self._options,
            None,
            self._view,
            int(mujoco.mjtCatBit.mjCAT_ALL),
            self._scene,
        )
        mujoco.mjr_render(self._frame, self._scene, self._drawing)
        mujoco.mjr_readPixels(self._pixels, None, self._frame, self._drawing)
        return self._pixels[::-1]

    def close(self) -> None:
        """Give up what the drawing holds; harmless if that was done before."""
        self._end()

    def _read(self, file: Path) -> Any:  # noqa: ANN401 - it has no stubs
        try:
            return self._mujoco.MjModel.from_xml_path(str(file))
        except ValueError as error:
            raise ParameterError(
                "MuJoCo cannot read the scene",
                where=str(file),
                got=" ".join(str(error).split()),
                remedy="correct it, or name another file",
            ) from None

    def _named(self, camera: str, file: Path) -> int:
        names = [str(self._model.camera(k).name) for k in range(self._model.ncam)]
        if camera not in names:
            raise ParameterError(
                f"the scene has no camera {camera}",
                where=str(file),
                expected=" or ".join(names) or "a camera",
                remedy=did_you_mean(camera, names) or "name one of these",
            )
        return names.index(camera)


def _free(context: Any, drawing: Any) -> None:  # noqa: ANN401 - as below
    context.make_current()
    drawing.free()
    context.free()


def _context(width: int, height: int) -> Any:  # noqa: ANN401 - it has no stubs
    """Return a place to draw, from now on that of this thread."""
    try:
        context = import_module("mujoco.egl").GLContext(width, height)
        context.make_current()
    except Exception as error:  # noqa: BLE001 - what fails depends on the driver
        raise DeviceError(
            "EGL does not work here, so that MuJoCo cannot draw",
            got=" ".join(str(error).split()) or type(error).__name__,
            remedy="install it (Debian: apt-get install libegl1 libopengl0 "
            "libgl1-mesa-dri)",
        ) from None
    return context
