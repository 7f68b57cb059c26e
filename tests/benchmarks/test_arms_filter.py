"""Oracles: the stated standard deviations, and motions of which networks that are written by hand give closed forms."""

import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("dm_control", reason="dm_control is not installed: pip install dm-control 'mujoco<4'")

from benchmarks.arms.arms import ARMS, NOISE
from benchmarks.arms.filters import DRIFT, ArmTransition, make_filter
from benchmarks.arms.sensor import JointSensor

REACHER = ARMS["reacher"]


class Says(torch.nn.Module):
    """The means are some of the features of two joints; the noise is the least that there is."""

    def __init__(self, features):
        super().__init__()
        self.features = features

    def forward(self, features):
        mean = features[..., self.features]
        return torch.cat([mean, torch.full_like(mean, -30.0)], -1)


def wandering():
    """Episodes of a reacher that begin at rest."""
    velocity = torch.randn(4, 30, 2).cumsum(1)
    velocity[:, 0] = 0
    return TensorDict({"state": REACHER.join(REACHER.dt * velocity.cumsum(1), velocity)}, [4, 30])


def white_noise(denkf, key):
    """The standard deviations of R."""
    noise = denkf["noise"](TensorDict({key: torch.zeros(4)}))["sensor", "noise"]
    return noise.sqrt().tolist()


def test_the_filter_of_encoders_knows_their_noise_and_begins_at_rest():
    denkf = make_filter(REACHER, wandering(), None, None)
    assert white_noise(denkf, "reading") == pytest.approx([NOISE] * 4)
    assert denkf.initial.std[4:].tolist() == pytest.approx([1e-3] * 2)
    assert denkf.initial.mean[4:].tolist() == [0.0] * 2


def test_the_filter_of_pictures_knows_their_errors_and_begins_at_rest():
    error = torch.tensor([0.01, 0.02, 0.03, 0.04])
    denkf = make_filter(REACHER, wandering(), JointSensor(REACHER), error)
    assert white_noise(denkf, ("sensor", "reading")) == pytest.approx(error.tolist())
    assert denkf.initial.std[4:].tolist() == pytest.approx([1e-3] * 2 + error.tolist())
    assert denkf.initial.mean[4:].tolist() == [0.0] * 6
    assert denkf["transition"].bias.equal(error)


def test_the_network_reads_and_says_velocities_in_their_units():
    scale, change = torch.tensor([4.0, 8.0]), torch.tensor([2.0, 3.0])
    move = ArmTransition(REACHER, scale, 50 * torch.ones(2), change, torch.ones(2))
    move.module = Says(slice(4, 6))  # velocities
    mean, std = move.faster(REACHER.join(torch.tensor([0.3, -0.5]), torch.tensor([1.0, 2.0])), torch.zeros(2))
    assert mean.tolist() == pytest.approx([2 * 1 / 4, 3 * 2 / 8])
    assert std.tolist() == pytest.approx([2 * 0.002, 3 * 0.002])


def test_an_angle_turns_by_the_share_of_the_change_that_leads():
    one, lead = torch.ones(2), torch.tensor([0.5, 0.25])
    move = ArmTransition(REACHER, one, 50 * one, one, lead)
    move.module = Says(slice(6, 8))  # actions
    angles, velocity = torch.tensor([0.3, -0.5]), torch.tensor([1.0, 2.0])
    members = REACHER.join(angles, velocity).expand(4000, -1)
    turned, after = REACHER.split(move.compute(members, torch.tensor([10.0, -10.0])))
    assert after.mean(0).tolist() == pytest.approx([11.0, -8.0], abs=1e-3)
    steps = [REACHER.dt * (1 + 0.5 * 10), REACHER.dt * (2 - 0.25 * 10)]
    assert (turned - angles).mean(0).tolist() == pytest.approx(steps, abs=5e-4)  # its own deviation is 0.00007


def test_no_angle_turns_further_than_the_fastest_arm_would():
    """Not even of a member that the analysis made faster than that."""
    arm, one = ARMS["manipulator"], torch.ones(4)
    move = ArmTransition(arm, one, one, one, 0.8 * one)
    members = arm.join(0 * one, 100 * one).expand(64, -1)
    with torch.no_grad():
        turned, after = arm.split(move.compute(members, torch.zeros(5)))
    assert after.abs().max() <= 1
    drift = (DRIFT**2 * arm.dt + arm.creep**2) ** 0.5
    assert turned.abs().max() < arm.dt + 5 * drift
