"""Calibrates the other domain's camera on its demos, and renders the simulator's arm for that camera.

A few demos show few poses: a sensor that learns from them alone memorises them. But their states are known, and so is
the arm's shape. So the camera's pose, field of view and lens are fitted until rendered silhouettes match the difference
from the image without the arm. Then thousands of the simulator's states are rendered for that camera onto that image,
in the arm's colours.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from torch_denkf.applications.ur5.simulation.camera import Camera
from torch_denkf.applications.ur5.simulation.domains import SIM, Domain, apply_domain
from torch_denkf.applications.ur5.simulation.render import GHOSTS, SCENERY, Renderer
from torch_denkf.applications.ur5.simulation.scene import UR5Scene

SIDE = 112  # pixels, of the silhouettes
DIFFERENT = 18  # grey levels, least difference between the arm and the background
SHOTS = 100  # frames for the calibration of the camera
# Stages of the calibration: number of frames, blur of the silhouettes in pixels, Gauss-Newton steps.
Levels = Sequence[tuple[int, float, int]]
LEVELS: Levels = ((40, 8.0, 8), (40, 4.0, 8), (60, 2.0, 8), (SHOTS, 1.0, 6))
OFTEN = 0.35  # largest share of frames in which a pixel shows the arm: above, the median may show it, too
UNITS = np.array([0.1, 0.1, 0.1, 0.05, 0.05, 0.05, 0.05, 2.0, 0.1])  # expected error of each parameter
HELD = 0.3  # share of the images with the object between the fingers
HOME = np.array([0.0, -1.5, 1.5, -1.5, -1.5, 0.0, 0.4])


class Drawn:
    """Renders the arm without background for a camera.

    Args:
        side: of the images in pixels.
        look: camera, lens, and light.
    """

    def __init__(self, side: int, look: Domain = SIM):
        self.side, self.scene = side, UR5Scene((side, side))
        model = self.scene.model
        model.geom_group[model.body_rootid[model.geom_bodyid] == model.body("base").id] = GHOSTS
        model.geom_group[[self.scene.object_geom, self.scene.goal_geom]] = SCENERY
        self.scene.reset(HOME, np.array([0.1, 0.0, 0.025]), np.array([1.0, 0.0, 0.0, 0.0]))
        self.renderer = Renderer(model, (side, side))
        self.look(look)

    def look(self, look: Domain) -> None:
        """Sets camera, lens and light."""
        apply_domain(self.scene, look)
        self.lens = Camera((self.side, self.side), look.distortion, (0.0, 0.0)).lens

    def arm(self, joints: np.ndarray, *, held: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Returns colours ``[H, W, 3]`` and the covered share of each pixel ``[H, W]``, at joints ``[7]``.

        Args:
            joints: rad.
            held: place of an object to render, m from the table's centre ``[3]``; ``None`` for none.
        """
        pose = self.scene.pose_with(joints.astype(float))
        groups = (GHOSTS,) if held is None else (GHOSTS, SCENERY)
        if held is not None:
            pose[self.scene.object_qpos][:3] = held
        picture = np.ascontiguousarray(self.renderer.draw(self.scene.posed(pose), groups=groups))
        return self.lens(picture), self.lens(picture.max(-1).astype(bool).astype(np.float32))

    def close(self) -> None:
        """Frees the context."""
        self.renderer.close()


def without_arm(pixels: np.ndarray) -> np.ndarray:
    """Returns the background ``[H, W, 3]``: the median of frames ``[N, H, W, 3]``."""
    return np.median(pixels, 0)


def foreground(pixels: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """Returns masks ``[N, H, W]`` of pixels that differ from the background, with a gain fitted to each frame."""
    gain = np.median(pixels / np.maximum(behind, 1.0), axis=(1, 2, 3), keepdims=True)
    return (np.abs(pixels - gain * behind).max(-1) > DIFFERENT).astype(np.float32)


def look_of(numbers: np.ndarray) -> Domain:
    """Returns a camera from place and target in m, roll in rad, field in degrees, and first distortion coefficient."""
    x, y, z, to_x, to_y, to_z, roll, field, bend = (float(value) for value in numbers)
    return Domain(camera=(x, y, z), target=(to_x, to_y, to_z), roll=roll, field=field, distortion=(bend, 0.0))


def find_camera(pixels: np.ndarray, joints: np.ndarray, levels: Levels = LEVELS) -> tuple[Domain, float]:
    """Fits the camera of frames ``[N, S, S, 3]`` to joints ``[N, 7]``; also returns the relative residual.

    Runs Gauss-Newton steps on silhouettes with decreasing blur, from the simulator's camera.
    """
    small = np.stack([cv2.resize(frame, (SIDE, SIDE), interpolation=cv2.INTER_AREA) for frame in pixels])
    small = small.astype(np.float32)
    shown = foreground(small, without_arm(small))
    drawn = Drawn(SIDE)
    found = np.array([*SIM.camera, *SIM.target, SIM.roll, SIM.field, 0.0])
    order = np.random.default_rng(0).permutation(len(small))[:SHOTS]

    def silhouettes(numbers: np.ndarray, rows: np.ndarray) -> np.ndarray:
        drawn.look(look_of(numbers))
        return np.stack([drawn.arm(joints[row])[1] for row in rows])

    for count, width, steps in levels:
        rows = order[:count]
        # Pixels that mostly show the arm are excluded, as the frames' median shows it, too.
        often = (silhouettes(found, order).mean(0) > OFTEN).astype(np.float32)
        counted = 1 - cv2.dilate(often, np.ones((int(2 * width) + 5,) * 2))
        seen = counted * _blurred(shown[rows], width)

        def misfit(way: np.ndarray, start=found, rows=rows, seen=seen, counted=counted, width=width) -> np.ndarray:
            return (counted * _blurred(silhouettes(start + UNITS * (way - 1), rows), width) - seen).ravel()

        # Starts from one, not zero, because the step of the finite differences is relative.
        solution = least_squares(misfit, np.ones(len(found)), diff_step=0.1, max_nfev=steps)
        found = found + UNITS * (solution.x - 1)
        share = 2 * solution.cost / float(np.square(seen).sum())
    drawn.close()
    return look_of(found), share


def _blurred(masks: np.ndarray, width: float) -> np.ndarray:
    return np.stack([cv2.GaussianBlur(mask, (0, 0), width) for mask in masks])


def colours(drawn: Drawn, pixels: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Fits gain and offset of red, green, and blue ``[2, 3]`` from rendered arms to those in frames."""
    shown, before, after = foreground(pixels, without_arm(pixels)), [], []
    for frame, mask, row in zip(pixels, shown, joints, strict=True):
        picture, covered = drawn.arm(row)
        both = (mask > 0) & (covered == 1)
        before.append(picture[both])
        after.append(frame[both])
    x, y = np.concatenate(before).astype(float), np.concatenate(after).astype(float)
    gain = ((x - x.mean(0)) * (y - y.mean(0))).mean(0) / x.var(0)
    return np.stack([gain, y.mean(0) - gain * x.mean(0)])


class Pasted:
    """Renders the simulator's arm for the other domain's camera, in front of that domain's background.

    Args:
        pixels: uint8 frames ``[N, 3, H, W]`` of demos in the other domain.
        states: of these frames, ``[N, 10]``.
        levels: stages of the camera's calibration.
    """

    def __init__(self, pixels: Tensor, states: Tensor, levels: Levels = LEVELS):
        frames, joints = pixels.permute(0, 2, 3, 1).numpy(), states[:, :7].numpy()
        chosen = np.random.default_rng(0).permutation(len(frames))[: 2 * SHOTS]
        frames, joints = frames[chosen], joints[chosen]
        self.look, self.misfit = find_camera(frames, joints, levels)
        self.drawn, frames = Drawn(frames.shape[1], self.look), frames.astype(np.float32)
        self.behind = without_arm(frames)
        self.paint = colours(self.drawn, frames, joints)
        self.grain = float(np.median(np.abs(frames - self.behind))) / 0.67 / 2  # halved: half is light

    def __call__(self, states: Tensor, seed: int = 0) -> Tensor:
        """Returns images, uint8 ``[N, 3, H, W]``, of states ``[N, 10]``, with slightly random colours."""
        rng, out = np.random.default_rng(seed), torch.empty(len(states), 3, *self.behind.shape[:2], dtype=torch.uint8)
        for index, state in enumerate(states.numpy()):
            held = state[7:] + 0.01 * rng.standard_normal(3) if rng.random() < HELD else None
            self._light(rng)
            picture, covered = self.drawn.arm(state[:7], held=held)
            gain = 1 + 0.05 * rng.standard_normal(3)
            arm = gain * (self.paint[0] * picture + self.paint[1])
            light = self.behind + covered[..., None] * (arm - self.behind)
            light = (1 + 0.06 * rng.standard_normal()) * light + self.grain * rng.standard_normal(light.shape)
            out[index] = torch.from_numpy(light.clip(0, 255).astype(np.uint8).transpose(2, 0, 1))
        return out

    def _light(self, rng: np.random.Generator) -> None:
        """Draws the direction of the main light, and the object's colour."""
        model, way = self.drawn.scene.model, rng.standard_normal(3) * [1.0, 1.0, 0.2] - [0.0, 0.0, 1.0]
        model.light("main").dir[:] = way / np.linalg.norm(way)
        model.geom_rgba[self.drawn.scene.object_geom, :3] = rng.uniform(0.1, 0.9, 3)

    def close(self) -> None:
        """Frees the context."""
        self.drawn.close()
