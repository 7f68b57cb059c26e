"""Domains of the UR5: the simulator as it is, or a stand-in for a real laboratory."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from torch_denkf.applications.ur5.simulation.names import DOMAIN_NAMES
from torch_denkf.applications.ur5.simulation.scene import UR5Scene

__all__ = ["DOMAINS", "Domain", "apply_domain", "light_of_episode"]


@dataclass(frozen=True)
class Domain:
    """Appearance and motion of the arm.

    Attributes:
        camera: position of the camera, m from the table's centre.
        target: the point that it looks at.
        roll: of the camera, rad.
        field: its vertical field of view, degrees.
        light: direction in which the main light shines.
        brightness: colour of the main light; of the lamps at the camera, a third.
        flicker: standard deviation of the light's factor from episode to episode.
        textured: wooden table, stained wall and floor, and a dirty arm, instead of plain colours.
        distortion: k1, k2 of the lens (Brown 1966), at image coordinates of one at the upper edge.
        exposures: pictures whose mean is one frame, 20 ms apart: motion blur.
        noise: standard deviations of the sensor's noise (of one grey level in 255) at black and at white.
        delay: control steps by which the frame is late.
        friction: dry friction of the six joints, N m.
        damping: viscous friction of the six joints, N m s/rad.
        offset: true angle less the commanded one, of the six joints, rad.
    """

    camera: tuple[float, float, float] = (1.4, 0.0, 0.85)
    target: tuple[float, float, float] = (-0.18, 0.02, 0.27)
    roll: float = 0.0
    field: float = 33.0
    light: tuple[float, float, float] = (-0.35, 0.35, -1.0)
    brightness: tuple[float, float, float] = (0.55, 0.55, 0.55)
    flicker: float = 0.0
    textured: bool = False
    distortion: tuple[float, float] = (0.0, 0.0)
    exposures: int = 1
    noise: tuple[float, float] = (0.0, 0.0)
    delay: int = 0
    friction: tuple[float, ...] = (0.0,) * 6
    damping: tuple[float, ...] = (0.0,) * 6
    offset: tuple[float, ...] = (0.0,) * 6


SIM = Domain()
REAL_LIKE = replace(
    SIM,
    camera=(1.33, 0.16, 0.93),
    target=(-0.16, 0.0, 0.25),
    roll=0.03,
    field=36.0,
    light=(-0.2, -0.8, -0.7),
    brightness=(0.62, 0.52, 0.38),
    flicker=0.08,
    textured=True,
    distortion=(-0.09, 0.015),
    exposures=2,
    noise=(2.0, 5.0),
    delay=1,
    friction=(4.0, 4.0, 3.0, 0.8, 0.8, 0.6),
    damping=(6.0, 6.0, 4.0, 1.0, 1.0, 0.8),
    offset=(0.012, -0.008, 0.01, -0.012, 0.01, 0.015),
)
DOMAINS = dict(zip(DOMAIN_NAMES, (SIM, REAL_LIKE), strict=True))


def apply_domain(scene: UR5Scene, domain: Domain) -> None:
    """Sets the model's camera, lights, textures and joints. Call it before the first picture."""
    model = scene.model
    camera, backwards = model.camera("front"), np.array(domain.camera) - np.array(domain.target)
    right = np.cross([0.0, 0.0, 1.0], backwards)
    axes = np.stack([right, np.cross(backwards, right), backwards], -1)
    turn = np.array(
        [[np.cos(domain.roll), -np.sin(domain.roll), 0], [np.sin(domain.roll), np.cos(domain.roll), 0], [0, 0, 1]]
    )
    mujoco.mju_mat2Quat(camera.quat, (axes / np.linalg.norm(axes, axis=0) @ turn).ravel())
    camera.pos[:], camera.fovy[:] = domain.camera, domain.field
    model.light("main").dir[:] = np.array(domain.light) / np.linalg.norm(domain.light)
    light_of_episode(scene, domain, 1.0)
    model.dof_frictionloss[scene.arm_dofs] = domain.friction
    model.dof_damping[scene.arm_dofs] = domain.damping
    scene.offset = np.array(domain.offset)
    if domain.textured:
        rng = np.random.default_rng(5)  # one laboratory: it looks the same in every episode
        for name, paint in _PAINT.items():
            texture = model.texture(name)
            size = int(texture.height[0]), int(texture.width[0])
            start = int(texture.adr[0])
            model.tex_data[start : start + size[0] * size[1] * 3] = (
                (paint(rng, *size).clip(0, 1) * 255).astype(np.uint8).ravel()
            )
        arm = np.isin(
            model.geom_bodyid, [b for b in range(model.nbody) if model.body_rootid[b] == model.body("base").id]
        )
        stain = rng.uniform(0.6, 0.95, (int(arm.sum()), 1)) * np.array([1.0, 0.97, 0.9])
        model.geom_rgba[arm, :3] *= stain


def light_of_episode(scene: UR5Scene, domain: Domain, factor: float) -> None:
    """Brightens or dims all lights."""
    scene.model.light("main").diffuse[:] = factor * np.array(domain.brightness)
    scene.model.light("fill").diffuse[:] = factor * 0.36 * np.array(domain.brightness)
    scene.model.vis.headlight.diffuse[:] = factor * 0.55 * np.array(domain.brightness)


def _smooth(rng: np.random.Generator, height: int, width: int, cells: tuple[int, int]) -> np.ndarray:
    """Returns noise in [0, 1] with so many cells down and across, interpolated."""
    grid = rng.uniform(size=(cells[0] + 1, cells[1] + 1))
    y, x = np.linspace(0, cells[0], height, endpoint=False), np.linspace(0, cells[1], width, endpoint=False)
    i, j, fy, fx = y.astype(int), x.astype(int), (y % 1)[:, None], (x % 1)[None]
    top = grid[i][:, j] * (1 - fx) + grid[i][:, j + 1] * fx
    bottom = grid[i + 1][:, j] * (1 - fx) + grid[i + 1][:, j + 1] * fx
    return top * (1 - fy) + bottom * fy


def _wood(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    grain = 0.6 * _smooth(rng, height, width, (64, 3)) + 0.4 * _smooth(rng, height, width, (128, 6))
    return np.array([0.42, 0.27, 0.16]) + (grain - 0.5)[..., None] * np.array([0.3, 0.22, 0.15])


def _clutter(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Returns a wall with shelves and posters: rectangles of all sizes and colours on a stained ground."""
    picture = 0.55 + 0.25 * (_smooth(rng, height, width, (6, 6))[..., None] - 0.5) + np.zeros(3)
    for _ in range(45):
        y, x = rng.integers(height), rng.integers(width)
        h, w = rng.integers(6, 50), rng.integers(6, 40)
        picture[y : y + h, x : x + w] = rng.uniform(0.1, 0.85) * rng.uniform(0.6, 1.0, 3)
    return picture


def _concrete(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    stain = _smooth(rng, height, width, (8, 8)) + 0.5 * _smooth(rng, height, width, (64, 64))
    return 0.28 + 0.2 * (stain[..., None] - 0.75) + np.zeros(3)


_PAINT = {"table": _wood, "wall": _clutter, "floor": _concrete}
