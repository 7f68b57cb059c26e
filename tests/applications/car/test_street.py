"""The drawing of rendered drives: pictures are where poses and geometry put them, on hills too; cars move."""

import dataclasses

import cv2
import numpy as np
import pytest

from torch_denkf.applications.car.kitti.render import roadside_scene
from torch_denkf.applications.car.street.camera import HEIGHT, Camera
from torch_denkf.applications.car.street.renderer import Renderer
from torch_denkf.applications.car.street.scene import RESOLUTION
from torch_denkf.applications.car.street.terrain import SMOOTH
from torch_denkf.applications.car.street.textures import TILE
from torch_denkf.applications.car.vision.poses import KITTI_DT, poses_to_state

cv2.setNumThreads(1)
SPACING = 32  # pixels of the ground's texture between dots: 3.2 m


def turn(axis, angle):
    return cv2.Rodrigues(np.eye(3)[axis] * angle)[0]


def poses_along(x, z, y, yaw, pitch, roll):
    """Camera poses; yaw to the right, pitch up, roll clockwise."""
    rows = zip(x, y, z, yaw, pitch, roll, strict=True)
    return np.stack(
        [np.column_stack([turn(1, h) @ turn(0, p) @ turn(2, r), [px, py, pz]]) for px, py, pz, h, p, r in rows]
    )


WAVE, HILL = 2 * np.pi / 150, 3.0  # a hill of 6 m every 150 m: slopes up to 7 degrees


def straight():
    z = 0.9 * np.arange(90)
    sway = 0.02 * np.sin(0.7 * np.arange(90))
    return poses_along(0 * z, z, 0 * z, 0 * z, -0.02 + sway, 0.04 + sway), lambda x, z: np.full_like(x, HEIGHT)


def hill():
    z = 0.7 * np.arange(190)
    smoothed = HILL * np.exp(-0.5 * (SMOOTH * WAVE) ** 2)  # a Gaussian filter's gain at the hill's frequency
    pitch = -np.arctan(-HILL * WAVE * np.sin(WAVE * z)) - 0.02
    poses = poses_along(0 * z, z, HILL * (np.cos(WAVE * z) - 1), 0 * z, pitch, 0.03 * np.sin(z / 7))
    return poses, lambda x, z: HEIGHT - HILL + smoothed * np.cos(WAVE * z)


def project(camera, pose, points):
    local = (points - pose[:, 3]) @ pose[:, :3]
    u = camera.fx * local[:, 0] / local[:, 2] + camera.cx
    return np.stack([u, camera.fy * local[:, 1] / local[:, 2] + camera.cy], -1), local[:, 2]


def project_disc(camera, pose, x, z, height, radius):
    """Returns the middle of a disc's picture, which is not the picture of its middle: near parts appear larger."""
    ring = np.sqrt((np.arange(200) + 0.5) / 200) * radius
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(200)
    px, pz = x + ring * np.cos(angle), z + ring * np.sin(angle)
    spots, depth = project(camera, pose, np.stack([px, height(px, pz), pz], -1))
    return np.average(spots, 0, weights=depth**-3.0)


def empty(poses, **changes):
    """Returns a scene along poses with nothing on the ground."""
    scene = roadside_scene(poses_to_state(poses, KITTI_DT), np.random.default_rng(0), ground=poses[:, 1, 3] + HEIGHT)
    bare = {"objects": [], "dashes": np.zeros((0, 2, 2)), "blots": np.zeros((0, 5)), "light": np.ones(3)}
    return dataclasses.replace(scene, **bare, sun=np.zeros(2), shade=1.0, gamma=1.0, **changes)


# On hills the verge is not as level to the sides as the road.
@pytest.mark.parametrize(("road", "reach"), [(straight, 12), (hill, 4)])
def test_dots_on_the_road_are_where_the_poses_put_them(road, reach):
    poses, height = road()
    tile = np.full((TILE, TILE, 3), 250, np.uint8)
    for row in range(0, TILE, SPACING):
        for column in range(0, TILE, SPACING):
            cv2.circle(tile, (column + 8, row + 8), 3, (0, 0, 0), -1)
    dots = np.tile(tile, (4, 4, 1))
    camera = Camera.odometry((250, 828))
    renderer = Renderer(empty(poses, ground=(dots, dots, dots)), camera, supersample=(2, 2))
    grid = RESOLUTION * (8 + SPACING * np.arange(-40, 70))
    found = 0
    misses = []
    for number in range(20, len(poses) - 20, 6):
        pose, picture = poses[number], cv2.cvtColor(renderer.render(poses[number], number), cv2.COLOR_BGR2GRAY)
        x, z = (axis.ravel() for axis in np.meshgrid(grid, grid))
        spots, depth = project(camera, pose, np.stack([x, height(x, z), z], -1))
        inside = (depth > 5) & (depth < 13) & (spots > [45, 0]).all(-1) & (spots < [783, 242]).all(-1)
        ends = [project(camera, pose, np.stack([x, height(x, z + r), z + r], -1))[0][:, 1] for r in (-0.35, 0.35)]
        inside &= ends[0] - ends[1] > 4  # not seen too flatly, near a crest
        inside &= np.abs((np.stack([x, z], -1) - pose[[0, 2], 3]) @ pose[[0, 2], 0]) < reach
        _, labels, stats, centres = cv2.connectedComponentsWithStats((picture < 110).astype(np.uint8))
        for k in np.flatnonzero(inside):
            spot = project_disc(camera, pose, x[k], z[k], height, 0.35)
            label = labels[tuple(np.round(spot[::-1]).astype(int))]
            assert label > 0, (number, spot)  # the dot's middle is dark
            assert stats[label, cv2.CC_STAT_WIDTH] < 80, (number, spot)  # and is a dot
            misses.append(centres[label] - spot)
            found += 1
    errors = np.abs(misses)
    # Measured across and down: medians (0.24, 0.06) on the level, (0.19, 0.24) on the hill, at most (1.0, 1.2). Dots
    # are 25 to 67 pixels wide and move by 5 and more pixels a frame.
    assert found > 20
    assert (np.median(errors, 0) < 0.35).all()
    assert (errors.max(0) < 1.4).all()
