"""Pictures of a scene, drawn without a window."""

from __future__ import annotations

import importlib
import os
import platform
import weakref
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.engine.plant_arrays import SimulatorError

MAX_GEOMS = 10_000
"""Shapes in one picture."""


class PictureError(SimulatorError):
    """No picture can be drawn here."""


class Painter:
    """Draws one MuJoCo model with OpenGL: EGL on Linux, the system's own elsewhere, or what MUJOCO_GL names."""

    def __init__(self, model: Any) -> None:
        """Make a context for drawing.

        Args:
            model: The `mujoco.MjModel`.

        Raises:
            PictureError: there is no OpenGL to draw with.
        """
        import mujoco

        self._mujoco, self._model = mujoco, model
        self._gl = _context()
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, MAX_GEOMS)
        self._option = mujoco.MjvOption()
        # A context that Python collects at its leisure would free its textures from whichever context is current.
        self._finalizer = weakref.finalize(self, _free, self._gl, self._context)

    def draw(self, data: Any, camera: str, width: int, height: int) -> NDArray[np.uint8]:
        """Picture of the present state.

        Args:
            data: The `mujoco.MjData`.
            camera: Name of a camera of the model.
            width: Of the picture [pixels].
            height: [pixels].

        Returns:
            RGB, shape (height, width, 3), row 0 at the top.

        Raises:
            PictureError: there is no such camera, or the picture has no pixels.
        """
        mj, model = self._mujoco, self._model
        index = mj.mj_name2id(model, mj.mjtObj.mjOBJ_CAMERA, camera)
        if index < 0:
            have = ", ".join(sorted(model.camera(i).name for i in range(model.ncam)))
            raise PictureError(f"unknown camera '{camera}'; available: {have}")
        if width < 1 or height < 1:
            raise PictureError(f"a picture of {width} x {height} pixels has none; give at least 1 x 1")
        self._gl.make_current()
        if width > self._context.offWidth or height > self._context.offHeight:
            mj.mjr_resizeOffscreen(
                max(width, self._context.offWidth), max(height, self._context.offHeight), self._context
            )
        view = mj.MjvCamera()
        view.type, view.fixedcamid = mj.mjtCamera.mjCAMERA_FIXED, index
        mj.mjv_updateScene(model, data, self._option, None, view, mj.mjtCatBit.mjCAT_ALL, self._scene)
        rect = mj.MjrRect(0, 0, width, height)
        mj.mjr_render(rect, self._scene, self._context)
        picture = np.empty((height, width, 3), dtype=np.uint8)
        mj.mjr_readPixels(picture, None, rect, self._context)
        return np.ascontiguousarray(picture[::-1])

    def close(self) -> None:
        """Free what the graphics driver holds."""
        self._finalizer()


def _free(gl: Any, context: Any) -> None:
    gl.make_current()
    context.free()
    gl.free()


def _context() -> Any:
    """An OpenGL context without a window, 1 x 1 pixel: pictures are drawn into a buffer of their own size."""
    way = os.environ.get("MUJOCO_GL", "").lower()
    if way not in ("egl", "osmesa", "glfw", "cgl"):
        way = {"Linux": "egl", "Darwin": "cgl"}.get(platform.system(), "glfw")
    try:
        return importlib.import_module(f"mujoco.{way}").GLContext(1, 1)
    except Exception as error:  # whatever the graphics libraries raise, each has its own
        reason = " ".join(str(error).split())
        raise PictureError(
            f"no OpenGL to draw pictures with ({way}: {reason}): install it (Debian: libegl1 libgl1-mesa-dri), or set "
            "MUJOCO_GL to egl, osmesa or glfw"
        ) from error
