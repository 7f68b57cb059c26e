"""Draws the velocity of a robot on slippery ground by two filters, and a video of the estimated velocity."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from statistics import NormalDist

import mujoco
import numpy as np
import torch
from matplotlib.colors import to_rgba
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.plots import plt, save
from benchmarks.legged.task import LEVEL, Robot

__all__ = ["Camera", "draw"]


def draw(robot: Robot, beliefs: Mapping[str, TensorDict], path: Path, *, seconds: tuple[float, float] = (2, 6)) -> None:
    """Draws the velocity along three axes in the first run, and the feet's contacts below.

    Args:
        robot: with its log.
        beliefs: of the filters, by name.
        path: PNG.
        seconds: begin and end of the drawn interval.
    """
    half = NormalDist().inv_cdf((1 + LEVEL) / 2)
    rows = slice(*(round(each / robot.dt) for each in seconds))
    time = robot.dt * torch.arange(robot.log.shape[1])[rows]
    true, contact = robot.log["true", "velocity"][0, rows], robot.log["contact"][0, rows]
    options = {"sharex": True, "layout": "constrained", "height_ratios": [3, 3, 3, 1]}
    figure, axes = plt.subplots(4, 1, figsize=(9, 7), **options)
    for number, axis in enumerate(axes[:3]):
        for color, (name, belief) in enumerate(beliefs.items()):
            mean, var = (belief[key][0, rows, number] for key in ("velocity", "velocity_var"))
            axis.fill_between(
                time, mean - half * var.sqrt(), mean + half * var.sqrt(), color=f"C{color}", alpha=0.2, lw=0
            )
            axis.plot(time, mean, f"C{color}", label=f"EKF, {name} contacts, {LEVEL:.0%}")
        axis.plot(time, true[:, number], "k", lw=1, label="truth")
        axis.set_ylabel(f"{'xyz'[number]}, m/s")
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    axes[3].imshow(contact.T, aspect="auto", extent=(*seconds, 4.5, 0.5), cmap="Greys", interpolation="nearest")
    axes[3].set(ylabel="contact", xlabel="time, s", yticks=[1, 2, 3, 4])
    save(figure, path)


class Camera:
    """Camera that follows a robot, and draws arrows above its base.

    Args:
        model: of the robot.
        data: its state, which is read at each frame.
        size: of a frame, height and width.
    """

    LONG = 2.0  # m of an arrow for 1 m/s

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, size: tuple[int, int] = (240, 400)):
        self.renderer, self.data, self.view = mujoco.Renderer(model, *size), data, mujoco.MjvCamera()
        self.view.type, self.view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, int(model.jnt_bodyid[0])
        self.view.distance, self.view.azimuth, self.view.elevation = 3.2, 130.0, -40.0
        for flag in (mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_SHADOW):
            self.renderer.scene.flags[flag] = 0

    def frame(self, arrows: Mapping[str, Tensor], std: Tensor) -> np.ndarray:
        """Returns an image ``[H, W, 3]``.

        Args:
            arrows: velocities ``[3]`` in the base's axes, by their colour.
            std: of the last one, which is drawn as an ellipsoid of 90 % intervals at its tip.
        """
        self.renderer.update_scene(self.data, self.view)
        axes, half = np.empty(9), NormalDist().inv_cdf((1 + LEVEL) / 2)
        mujoco.mju_quat2Mat(axes, self.data.qpos[3:7])
        start = self.data.qpos[:3] + np.array([0.0, 0.0, 0.3])
        for color, velocity in arrows.items():
            tip = start + self.LONG * axes.reshape(3, 3) @ velocity.double().numpy()
            arrow = self._geom(mujoco.mjtGeom.mjGEOM_ARROW, np.zeros(3), start, axes, to_rgba(color))
            # MuJoCo draws half of an arrow's length.
            mujoco.mjv_connector(arrow, mujoco.mjtGeom.mjGEOM_ARROW, 0.025, start, 2 * tip - start)
        radii = self.LONG * half * std.double().numpy()
        self._geom(mujoco.mjtGeom.mjGEOM_ELLIPSOID, radii, tip, axes, to_rgba(color, 0.35))
        return self.renderer.render()

    def _geom(self, kind, size, place, axes, color) -> mujoco.MjvGeom:
        scene = self.renderer.scene
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, size, place, axes, np.array(color, dtype=np.float32))
        scene.ngeom += 1
        return geom
