"""Oracles: the picture without ghosts, and how many pixels differ from it."""

import pytest
import torch

from tests.envs.opengl import needs_opengl
from torch_denkf.applications.ur5 import UR5TableEnv
from torch_denkf.applications.ur5.simulation import render


@pytest.fixture
def env():
    needs_opengl()
    env = UR5TableEnv("push", size=(64, 80), render_at=(), seed=0)
    env.reset()
    yield env
    env.close()


def changed(picture, other):
    return (picture - other).abs().amax(-3) > 0.02


def test_ghosts_spread_with_the_ensemble(env):
    state = env.reset()["state"]
    alone = env.render_state(state)
    draws = torch.randn(8, 10)
    arm = changed(env.render_state(state, ghosts=state[None]), alone)
    around = [
        (changed(env.render_state(state, ghosts=state + std * draws), alone) & ~arm).sum().item()
        for std in (0.01, 0.04, 0.16)
    ]
    assert around[0] > 0
    assert around[0] * 1.5 < around[1]
    assert around[1] * 1.5 < around[2]
    assert env.render_state(state).equal(alone)  # nothing of the ghosts is left
    assert env.render_state(state, ghosts=state[None][:0]).equal(alone)


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


def test_batches(env):
    state = env.reset()["state"] + 0.1 * torch.randn(2, 3, 10)
    ghosts = state.unsqueeze(-2) + 0.1 * torch.randn(2, 3, 4, 10)
    drawn = env.render_state(state, ghosts=ghosts)
    assert drawn.shape == (2, 3, 3, 64, 80)
    assert drawn[1, 2].equal(env.render_state(state[1, 2], ghosts=ghosts[1, 2]))


def test_scenery_is_left_out(env):
    state = env.reset()["state"]
    arm, everything = env.render_state(state, scenery=False), env.render_state(state)
    assert changed(arm, everything).sum() > 20  # a red or blue object and the goal's disc
    scene = env._scene
    scene.data.qpos[scene.object_qpos] = torch.tensor([0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0]).numpy()  # out of sight
    scene.show_goal(None)
    assert not changed(env.render_state(state), arm).any()


def test_the_object_is_no_ghost(env):
    state = env.reset()["state"]
    drawn = env.render_state(state, ghosts=state.expand(6, 10)) - env.render_state(state, ghosts=state.expand(1, 10))
    scene = env._scene
    before = env.render_state(state)
    scene.model.geom_rgba[scene.object_geom, :3] = (0.0, 0.0, 1.0)
    of_object = (env.render_state(state) - before).abs().amax(0) > 0.1
    assert of_object.any()
    assert drawn.abs().amax(0)[of_object].median() < 0.02  # the arm may hide a corner of it


@pytest.mark.parametrize("shape", [(10,), (4, 5, 10), (5, 6)])
def test_ghosts_of_another_shape(env, shape):
    with pytest.raises(ValueError, match=r"ghosts are \[\*N, G, S\] next to a state \[\*N, S\]"):
        env.render_state(torch.zeros(10), ghosts=torch.zeros(shape))


def test_too_many_ghosts(env):
    with pytest.raises(ValueError, match="draw fewer ghosts"):
        env.render_state(torch.zeros(10), ghosts=torch.zeros(400, 10))


def test_groups_do_not_change_the_plain_picture(env):
    state = env.reset()["state"]
    before = env.render_state(state)
    env._scene.model.geom_group[:] = render.PLAIN
    assert env.render_state(state).equal(before)
