"""Oracles: densities by torch.distributions, each term by hand."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Normal

from tests.filters.factories import OBS, E, FixedEnsemble, NoisyLinear, toy_denkf
from tests.filters.particle_for_tests import toy_filter
from tests.objectives.problem_for_tests import only, problem, stepped
from torch_denkf.filters import ParticleFilter
from torch_denkf.modules import ConstantNoise, GaussianLikelihood, Select
from torch_denkf.objectives import MixtureLoss

TERMS = ["state", "transition", "mean", "sensor", "nll"]
CLOSE = {"rtol": 1e-11, "atol": 1e-12}  # the same numbers in another order


@pytest.fixture(autouse=True)
def _double(float64):
    return


def test_members_without_weights_count_alike():
    filter = toy_denkf()
    frames, out = problem(filter)
    each = Normal(out["belief", "ensemble"], 1.0).log_prob(frames["state"].unsqueeze(-2)).sum(-1)
    expected = math.log(E) - each.logsumexp(-1)
    torch.testing.assert_close(MixtureLoss(filter)(frames)["loss_state"], expected[stepped(frames)].mean(), **CLOSE)


def test_mean_sensor_and_nll_by_hand():
    filter = toy_filter()
    frames, out = problem(filter, masks=OBS)
    losses = MixtureLoss(
        filter, **dict.fromkeys(TERMS, 1.0), observation_scale=[2.0, 3.0], state_scale=[1.0, 2.0, 4.0]
    )(frames)
    steps, observed = stepped(frames), frames["observed"].all(-1)
    assert 0 < observed.sum() < observed.numel()
    weights = out["belief", "log_weight"].exp().unsqueeze(-1)
    mean = (weights * out["belief", "ensemble"]).sum(-2)
    error = ((mean - frames["state"]) / torch.tensor([1.0, 2.0, 4.0])).square().mean(-1)
    torch.testing.assert_close(losses["loss_mean"], error[steps].mean(), **CLOSE)
    torch.testing.assert_close(losses["loss_nll"], -out["info", "log_likelihood"].squeeze(-1)[steps].mean(), **CLOSE)
    samples = (out["sensor", "ensemble"] - frames["target_observation"].unsqueeze(-2)) / torch.tensor([2.0, 3.0])
    size = samples.shape[-2]
    pairs = sum((samples[..., i, :] - samples[..., j, :]).abs() for i in range(size) for j in range(size))
    crps = (samples.abs().mean(-2) - pairs / (2 * size * (size - 1))).mean(-1)
    torch.testing.assert_close(losses["loss_sensor"], crps[observed].mean(), **CLOSE)


def known_filter():
    """Particles that stay where they are, and a known observation of the first dimension."""
    return ParticleFilter(
        NoisyLinear(torch.eye(2)),
        None,
        Select([0]),
        GaussianLikelihood(observation_key="y"),
        noise=ConstantNoise([1.0], in_key="y"),
        initial=FixedEnsemble(torch.randn(5, 2)),
    )


def test_a_known_observation_needs_no_target():
    filter = known_filter()
    frames = TensorDict({"y": torch.randn(3, 4, 1), "state": torch.randn(3, 4, 2)}, [3, 4])
    loss = MixtureLoss(filter, **only(TERMS, "sensor"))
    loss.set_keys(sensor="y")
    expected = (frames["y"] - frames["state"][..., :1]).abs().mean()  # the CRPS of one reading
    torch.testing.assert_close(loss(frames)["loss_sensor"], expected, **CLOSE)
