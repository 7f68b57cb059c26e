"""Oracles: sums over components with scipy, integrals of distribution functions, each term by hand."""

import math

import numpy as np
import pytest
import torch
from scipy.special import logsumexp
from scipy.stats import norm
from tensordict import TensorDict

from tests.filters.factories import OBS, E, FixedEnsemble, NoisyLinear, S, toy_denkf
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


def mixture_by_hand(out, prefix, truth, std, dims):
    """One element and one component at a time."""
    particles, log_weights = (out[prefix, name].detach().numpy() for name in ("ensemble", "log_weight"))
    values = np.empty(truth.shape[:-1])
    for index in np.ndindex(values.shape):
        components = [
            log_weights[index][i]
            + sum(norm.logpdf(truth[index][d], particles[index][i, d], s) for d, s in zip(dims, std, strict=True))
            for i in range(particles.shape[-2])
        ]
        values[index] = -logsumexp(components)
    return torch.from_numpy(values)


@pytest.mark.parametrize("learned", [False, True])
@pytest.mark.parametrize("dims", [None, [2, 0]])
def test_mixture_by_hand(learned, dims):
    filter = toy_filter("soft", learned)
    frames, out = problem(filter)
    chosen = range(S) if dims is None else dims
    std = [0.3, 0.7, 2.0][: len(chosen)]
    losses = MixtureLoss(filter, component_std=std, transition=0.5, dims=dims)(frames)
    assert sorted(losses.keys()) == ["loss_state", "loss_transition"]
    steps = stepped(frames)
    assert 0 < steps.sum() < steps[..., 1:].numel()
    for name, prefix, weight in (("state", "belief", 1.0), ("transition", "forecast", 0.5)):
        expected = mixture_by_hand(out, prefix, frames["state"], std, chosen)[steps].mean()
        torch.testing.assert_close(losses[f"loss_{name}"], weight * expected, **CLOSE)


def test_scales_are_units_of_the_width():
    filter = toy_filter()
    frames, out = problem(filter)
    loss = MixtureLoss(filter, component_std=0.5, state_scale=[0.5, math.inf, 4.0])
    expected = mixture_by_hand(out, "belief", frames["state"], [0.25, 2.0], [0, 2])[stepped(frames)].mean()
    torch.testing.assert_close(loss(frames)["loss_state"], expected, **CLOSE)
    loss = MixtureLoss(filter, component_std=[0.5, 1.0, 0.2], state_scale=[0.5, math.inf, 4.0])
    expected = mixture_by_hand(out, "belief", frames["state"], [0.25, 0.8], [0, 2])[stepped(frames)].mean()
    torch.testing.assert_close(loss(frames)["loss_state"], expected, **CLOSE)


def test_weighted_crps_is_the_integral_of_the_squared_difference_of_distributions():
    filter = toy_filter()
    frames, out = problem(filter, batch=(2, 4))
    value = MixtureLoss(filter, score="crps", reduction="none")(frames)["loss_state"]
    grid = torch.linspace(-12, 12, 240_001)
    steps = stepped(frames)
    for b, t in steps.nonzero().tolist():
        particles, weights = out["belief", "ensemble"][b, t], out["belief", "log_weight"][b, t].exp()
        truth = frames["state"][b, t]
        assert max(particles.abs().max(), truth.abs().max()) < 12
        total = 0.0
        for d in range(S):
            below = (weights.unsqueeze(-1) * (particles[:, d].unsqueeze(-1) <= grid)).sum(0)
            total += torch.trapezoid((below - (truth[d] <= grid).double()).square(), grid)
        # E + 1 jumps, each misplaced by at most half a step of 1e-4.
        torch.testing.assert_close(value[b, t], total / S, rtol=0, atol=5e-4)
    assert (value[~steps] == 0).all()


def test_members_without_weights_count_alike():
    filter = toy_denkf()
    frames, out = problem(filter)
    equal = {("belief", "ensemble"): out["belief", "ensemble"]}
    equal["belief", "log_weight"] = torch.full((2, 7, E), -math.log(E))
    expected = mixture_by_hand(equal, "belief", frames["state"], [1.0] * S, range(S))
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


@pytest.mark.parametrize("score", ["mixture", "crps"])
def test_angles_wrap(score):
    filter = toy_filter()
    frames, out = problem(filter)
    # Near the middle of the particles: no error exceeds pi.
    ensemble = out["belief", "ensemble"].detach()
    frames["state"] = (ensemble.amax(-2) + ensemble.amin(-2)) / 2
    assert (out["belief", "ensemble"] - frames["state"].unsqueeze(-2)).abs().max() < math.pi
    plain = MixtureLoss(filter, score=score, dims=[2, 1])(frames)["loss_state"]
    turned = frames.clone()
    turned["state"][..., 1] += 2 * math.pi * torch.randint(-3, 4, (2, 7))
    wrapped = MixtureLoss(filter, score=score, dims=[2, 1], angles=[1])(turned)["loss_state"]
    torch.testing.assert_close(wrapped, plain, rtol=1e-9, atol=1e-12)
    assert MixtureLoss(filter, score=score, dims=[2, 1], angles=[2])(turned)["loss_state"] > plain + 0.5


def test_a_truth_of_fewer_dimensions():
    filter = toy_filter()
    frames, _ = problem(filter)
    expected = MixtureLoss(filter, dims=[0, 1])(frames)["loss_state"]
    short = frames.copy().set("state", frames["state"][..., :2])
    assert MixtureLoss(filter)(short)["loss_state"].equal(expected)


@pytest.mark.parametrize("reduction", ["none", "sum", "mean"])
def test_reductions(reduction):
    filter = toy_filter()
    frames, out = problem(filter)
    each = mixture_by_hand(out, "belief", frames["state"], [1.0] * S, range(S))
    steps = stepped(frames)
    expected = {"none": torch.where(steps, each, 0.0), "sum": each[steps].sum(), "mean": each[steps].mean()}
    value = MixtureLoss(filter, reduction=reduction)(frames)["loss_state"]
    torch.testing.assert_close(value, expected[reduction], **CLOSE)


# ------------------------------------------------------------------------------------------------ interface


def test_set_keys_and_in_keys():
    filter = toy_filter()
    frames, _ = problem(filter)
    loss = MixtureLoss(filter)
    expected = loss(frames)["loss_state"]
    loss.set_keys(state=("truth", "x"))
    renamed = frames.copy()
    renamed["truth", "x"] = renamed["state"]
    assert loss(renamed.exclude("state"))["loss_state"].equal(expected)
    assert ("truth", "x") in loss.in_keys
    assert ("truth", "x") not in MixtureLoss(filter, **only(TERMS, "nll")).in_keys
    assert {id(p) for p in loss.parameters()} == {id(p) for p in filter.parameters()}


def test_errors():
    filter = toy_filter()
    frames, _ = problem(filter)
    with pytest.raises(ValueError, match="'mse'"):
        MixtureLoss(filter, score="mse")
    with pytest.raises(ValueError, match="component_std is the width"):
        MixtureLoss(filter, component_std=[1.0, 0.0, 1.0])
    with pytest.raises(ValueError, match="component_std has one entry"):
        MixtureLoss(filter, component_std=[1.0, 1.0, 1.0], dims=[0, 1])
    with pytest.raises(ValueError, match="state_scale has one entry"):
        MixtureLoss(filter, state_scale=[1.0], dims=[0, 1])
    with pytest.raises(KeyError, match=r"MixtureLoss reads 'state'.*set_keys"):
        MixtureLoss(filter)(frames.exclude("state"))
    with pytest.raises(KeyError, match="target_observation"):
        MixtureLoss(filter, sensor=1.0)(frames.exclude("target_observation"))
