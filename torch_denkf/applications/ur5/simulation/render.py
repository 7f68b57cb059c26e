"""Pictures of a MuJoCo scene without a window: an OpenGL context of its own, made at the first picture."""

from __future__ import annotations

import atexit
import os
import sys
import weakref
from collections.abc import Collection, Iterable

import mujoco
import numpy as np

__all__ = ["GHOSTS", "PLAIN", "SCENERY", "Renderer"]

PLAIN, GHOSTS, SCENERY = 0, 1, 2  # groups of geoms: all else; what ghosts are made of; what can be left out
GHOST_COLOUR = (1.0, 0.4, 0.0, 0.08)  # the last one is the opacity

_opened: weakref.WeakSet[Renderer] = weakref.WeakSet()


def _close_all() -> None:
    for renderer in list(_opened):
        renderer.close()


def _context_class() -> type:
    """Returns MuJoCo's context for ``MUJOCO_GL``; EGL where neither that nor a display is set.

    ``mujoco`` reads the variable once, when it is imported, and torchrl imports it early; here it counts when the
    first picture is made.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if chosen == "egl" or (not chosen and sys.platform == "linux" and not os.environ.get("DISPLAY")):
        from mujoco.egl import GLContext
    elif chosen == "osmesa":
        from mujoco.osmesa import GLContext
    elif hasattr(mujoco, "GLContext"):
        GLContext = mujoco.GLContext
    else:
        raise ImportError(f"MUJOCO_GL={chosen!r} switches rendering off")
    return GLContext


def _open_context(height: int, width: int):
    try:
        context = _context_class()(width, height)
        context.make_current()
        return context
    except Exception as error:  # AttributeError, ImportError, OSError, GLError, FatalError: each library has its own
        chosen = os.environ.get("MUJOCO_GL", "")
        raise RuntimeError(
            f"MuJoCo cannot open OpenGL to draw pictures (MUJOCO_GL={chosen!r}): {type(error).__name__}: {error}. "
            "On Debian or Ubuntu: apt-get install libegl1 libgl1-mesa-dri, and leave MUJOCO_GL unset or set it to "
            "'egl' before Python starts; or apt-get install libosmesa6 and set it to 'osmesa'. Without pictures: "
            "UR5TableEnv(..., from_pixels=False)."
        ) from error


class Renderer:
    """Draws a model's scene from a camera, without shadows, reflections and multisampling: three ms instead of 80.

    Args:
        model: of the scene; what its geoms and lights look like may change between pictures, its textures may not.
        size: (H, W) in pixels.
        camera: name of the camera.

    Raises:
        RuntimeError: if no OpenGL library is there; the message names the packages.
    """

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int], camera: str = "front"):
        self._gl = self._context = None
        self._gl = _open_context(*size)
        try:
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except mujoco.FatalError as error:
            self.close()
            raise RuntimeError(
                f"MuJoCo found no OpenGL ({error}). On Debian or Ubuntu: apt-get install libegl1 libgl1-mesa-dri."
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        if not _opened:
            # Handlers run last in, first out: this one before EGL's, which ends the display.
            atexit.unregister(_close_all)
            atexit.register(_close_all)
        _opened.add(self)
        self._model, self._size = model, size
        self._scene, self._option = mujoco.MjvScene(model, maxgeom=5000), mujoco.MjvOption()
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_HAZE):
            self._scene.flags[flag] = False
        self._camera = mujoco.MjvCamera()
        self._camera.type, self._camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(camera).id
        self._rect = mujoco.MjrRect(0, 0, size[1], size[0])

    def draw(
        self,
        data: mujoco.MjData,
        ghosts: Iterable[mujoco.MjData] = (),
        groups: Collection[int] = (PLAIN, GHOSTS, SCENERY),
    ) -> np.ndarray:
        """Returns the picture ``[H, W, 3]``, uint8, of the positions in ``data`` (after ``mj_kinematics``).

        Args:
            data: what is drawn as it is.
            ghosts: further positions, of which the geoms of group ``GHOSTS`` are drawn translucent. Each is done with
                before the next is asked for, so that all may share one ``MjData``, also with ``data``.
            groups: the geoms to draw of ``data``.
        """
        if self._gl is None or self._context is None:
            raise RuntimeError("the renderer is closed")
        mujoco.mj_camlight(self._model, data)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        self._show(groups)
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._camera, everything, self._scene)
        for ghost in ghosts:
            self._add_ghost(ghost)
        self._gl.make_current()  # another environment of this process may have drawn in between
        mujoco.mjr_render(self._rect, self._scene, self._context)
        picture = np.empty((*self._size, 3), np.uint8)
        mujoco.mjr_readPixels(picture, None, self._rect, self._context)
        return picture[::-1]

    def _show(self, groups: Collection[int]) -> None:
        self._option.geomgroup[:] = [group in groups for group in range(len(self._option.geomgroup))]

    def _add_ghost(self, data: mujoco.MjData) -> None:
        first = self._scene.ngeom
        if first + self._model.ngeom > self._scene.maxgeom:
            raise ValueError(f"the scene of {self._scene.maxgeom} shapes is full: draw fewer ghosts")
        self._show([GHOSTS])
        moving = mujoco.mjtCatBit.mjCAT_DYNAMIC.value
        mujoco.mjv_addGeoms(self._model, data, self._option, mujoco.MjvPerturb(), moving, self._scene)
        for shape in self._scene.geoms[first : self._scene.ngeom]:
            shape.rgba[:], shape.transparent = GHOST_COLOUR, 1
            shape.emission, shape.specular, shape.reflectance = 0.6, 0.0, 0.0

    def __del__(self):
        self.close()

    def close(self) -> None:
        """Frees the context; nothing can be drawn afterwards."""
        gl, context, self._gl, self._context = self._gl, self._context, None, None
        if gl is not None:
            if context is not None:
                gl.make_current()
                context.free()
            gl.free()
