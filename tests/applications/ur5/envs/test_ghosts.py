"""Oracles: the picture without ghosts, and how many pixels differ from it."""

import pytest
import torch

from tests.envs.opengl import needs_opengl
from torch_denkf.applications.ur5 import UR5TableEnv


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
