"""Oracles: pictures taken otherwise, the pinhole formula, moments of the noise, what a missing library raises."""

import numpy as np
import pytest
import torch

from tests.envs.opengl import mujoco, needs_opengl
from torch_denkf.applications.ur5 import UR5TableEnv
from torch_denkf.applications.ur5.envs.expert import UR5Expert
from torch_denkf.applications.ur5.simulation.camera import distortion_map

SMALL = {"size": (48, 64), "max_steps": 30}


def make(task="pick", domain="sim", **kwargs):
    needs_opengl()
    return UR5TableEnv(task, domain, **{**SMALL, **kwargs})


def demo(steps=30, **kwargs):
    env = make(**kwargs)
    rollout = env.rollout(steps, UR5Expert(env))
    env.close()
    return rollout


def test_few_frames_of_an_episode():
    every = demo(seed=2)
    some = demo(seed=2, render_at=[0, 5, 17, 30])
    assert (some["next", "state"] == every["next", "state"]).all()
    for part, first in ((some, 0), (some["next"], 1)):
        full = every if first == 0 else every["next"]
        for row in range(30):
            wanted = row + first in (0, 5, 17, 30)
            assert part["observed"][row].item() == wanted
            assert part["pixels"][row].equal(full["pixels"][row] if wanted else torch.zeros(3, 48, 64))
    env = make(seed=2, render_at=8)
    drawn = []
    for _ in range(3):
        rollout = env.rollout(30, UR5Expert())
        drawn.append(torch.cat([rollout["observed"][:1], rollout["next", "observed"]]).flatten())
        assert drawn[-1].sum() == 8
    assert not drawn[0].equal(drawn[1])
    assert (rollout["next", "pixels"].sum((1, 2, 3)) > 0).equal(drawn[-1][1:])


def test_rendered_state_equals_the_recorded_image():
    env = make("put_down", seed=3)
    rollout = env.rollout(30, UR5Expert())
    seen, state = rollout["next", "pixels"][-1], rollout["next", "state"]
    drawn = env.render_state(state[[-1, 0]].unsqueeze(0))
    assert drawn.shape == (1, 2, 3, 48, 64)
    # float32 and the mean of two fingers that differ by a hair move an edge here and there.
    assert (drawn[0, 0] - seen).abs().mean() < 1e-3
    assert (drawn[0, 1] - seen).abs().mean() > 5e-3
    env.close()


def test_the_arm_is_in_view_and_where_the_pinhole_formula_has_it():
    env = make("pick", seed=4, size=(64, 64))
    camera = env._scene.model.camera("front")
    focal = 32 / np.tan(np.deg2rad(camera.fovy[0]) / 2)
    inside, total = 0, 0
    for _ in range(12):
        env.reset()
        data = env._scene.data
        mujoco.mj_camlight(env._scene.model, data)
        axes = data.camera("front").xmat.reshape(3, 3)
        names = ["forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link", "tool", "object"]
        points = np.stack([data.body(name).xpos for name in names] + [data.site("pinch").xpos])
        x, y, z = ((points - data.camera("front").xpos) @ axes).T
        column, row = 31.5 - focal * x / z, 31.5 + focal * y / z
        inside += int(((column > 0) & (column < 63) & (row > 0) & (row < 63)).sum())
        total += len(points)
    assert inside == total
    # The object's colour is where the formula has its centre.
    before = env.render_state(torch.zeros(10))
    env._scene.model.geom_rgba[env._scene.object_geom, :3] = [0.0, 1.0, 0.0]
    changed = (env.render_state(torch.zeros(10)) - before).abs().sum(0) > 0.05
    where = changed.nonzero().float().mean(0)
    assert abs(where[0] - row[5]) < 1.5
    assert abs(where[1] - column[5]) < 1.5
    env.close()


def test_lens():
    x, y = distortion_map((101, 101), 0.0, 0.0)
    np.testing.assert_allclose(x, np.tile(np.arange(101), (101, 1)), atol=1e-4)
    x, y = distortion_map((101, 101), -0.09, 0.0)
    assert x[50, 50] == pytest.approx(50)
    assert y[50, 50] == pytest.approx(50)
    # A barrel: the scale grows outwards from the middle, and the corners (r^2 = 2 x (100/101)^2) are kept.
    corner = 1 + 0.09 * 2 * (100 / 101) ** 2
    assert y[0, 50] == pytest.approx(50 - 50 * (1 + 0.09 * (100 / 101) ** 2) / corner, abs=1e-3)
    assert (x[0, 0], y[0, 0]) == pytest.approx((0, 0), abs=1e-3)


@pytest.fixture
def env():
    needs_opengl()
    env = UR5TableEnv("push", size=(64, 80), render_at=(), seed=0)
    env.reset()
    yield env
    env.close()


def changed(picture, other):
    return (picture - other).abs().amax(-3) > 0.02


def test_a_ghost_is_translucent_and_orange(env):
    state = env.reset()["state"]
    aside = state.clone()
    aside[0] += 0.8
    alone, other = env.render_state(torch.stack([state, aside]))
    with_ghost = env.render_state(state, ghosts=aside[None])
    touched, moved = changed(with_ghost, alone), changed(other, alone)
    assert (touched & ~moved).float().mean() < 0.01  # where the other arm is, and nowhere else
    red, _, blue = (with_ghost - alone)[:, touched].mean(-1)
    assert red > 0
    assert blue < 0
    change = (with_ghost - alone).abs().amax(0)[touched]
    assert change.median() < 0.2  # what is behind shines through,
    assert change.max() < 0.5  # also where several links lie behind one another
