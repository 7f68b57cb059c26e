"""Oracles of all Gaussian filters (EKF, UKF, Backprop KF): the Kalman filter, differences of losses, the true noise."""

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import assert_equal, linear_kalman, linear_system
from tests.filters.gaussian_for_tests import (
    BELIEF,
    CONTROL,
    FILTERS,
    INFO,
    directional_check,
    learned_filter,
    learned_frames,
    linear_filter,
    linear_frames,
    minimise,
    prior,
)
from torch_denkf.modules import CholeskyNoise, ConstantNoise
from torch_denkf.objectives import GaussianLoss

ALL = pytest.mark.parametrize("name", FILTERS)


@ALL
@pytest.mark.parametrize("width", [1, 2])
@pytest.mark.parametrize("update_at_reset", [False, True])
def test_on_a_linear_system_all_are_the_kalman_filter(float64, name, width, update_at_reset):
    frames = linear_frames(3, 50, width=width)
    assert frames["is_init"][:, 1:].any()
    expected = linear_kalman(update_at_reset=update_at_reset).sequence(frames.copy())
    got = linear_filter(name, update_at_reset=update_at_reset).sequence(frames.copy())
    # Rounding of 1e-15 a step, contracted; the sigma points' ridge is 4e-14.
    assert_equal(got, expected, [*BELIEF, *INFO, ("forecast", "mean"), ("forecast", "cov")], atol=1e-11)


@ALL
def test_actions_move_the_mean_alone(float64, name):
    F, *_ = linear_system()
    frames = linear_frames(3, 20)
    with_control, without = (linear_filter(name, control=c).sequence(frames.copy()) for c in (True, False))
    torch.testing.assert_close(with_control["belief", "cov"], without["belief", "cov"], rtol=0, atol=1e-13)
    moved = with_control["belief", "mean"][:, :-1] @ F.mT + frames["action"][:, :-1] @ torch.tensor(CONTROL).mT
    stepped = ~frames["is_init"][:, 1:].squeeze(-1)
    torch.testing.assert_close(with_control["forecast", "mean"][:, 1:][stepped], moved[stepped], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["EKF", "UKF"])
@pytest.mark.parametrize("layer", ["dropout", "flipout"])
def test_stochastic_networks_run_deterministically(name, layer):
    filter, frames = learned_filter(name, layer=layer), learned_frames(2, 6)
    first, second = (filter.sequence(frames.copy()) for _ in range(2))
    assert first["belief", "mean"].equal(second["belief", "mean"])
    assert "noise" not in filter.draw_noise(frames.copy())


# --------------------------------------------------------------------------------------------------- gradients


@ALL
def test_all_parameters_have_the_gradient_of_a_difference(float64, name):
    filter, frames = learned_filter(name), learned_frames(2, 6)
    target = torch.randn(2, 6, 3)

    def loss():
        out = filter.sequence(frames.copy())
        return (out["belief", "mean"] - target).square().sum() - out["info", "log_likelihood"].sum()

    directional_check(loss, filter.parameters())


# ------------------------------------------------------------------------------------------------------- training


def test_the_likelihood_finds_the_true_noise():
    F, Q, H, R = linear_system()
    generator, rows, steps = torch.Generator().manual_seed(0), 4000, 10
    initial, readings = prior(), []
    state = initial.mean + torch.randn(rows, 2, generator=generator) * initial.cov.diagonal().sqrt()
    for _ in range(steps):
        readings.append(state @ H.mT + R.sqrt() * torch.randn(rows, 2, generator=generator))
        state = state @ F.mT + torch.randn(rows, 2, generator=generator) @ torch.linalg.cholesky(Q).mT
    frames = TensorDict({"observation": torch.stack(readings, 1)}, [rows, steps])
    q = CholeskyNoise(2, r=0.5)
    r = ConstantNoise([1.0, 0.4], trainable=True, in_key="observation")
    filter = linear_filter("EKF", process_noise=q, noise=r)
    loss = GaussianLoss(filter, state=0.0, transition=0.0, sensor=0.0, nll=1.0)
    before, after = minimise(loss, frames, filter.parameters(), 20)
    assert after < before
    learned = q(TensorDict({("belief", "mean"): torch.zeros(2)}))["forecast", "noise"].detach()
    # 40,000 readings would tell one variance to sqrt(2 / 40,000) = 0.7 %; Q and R share them: 1 % and 4 % over seeds.
    torch.testing.assert_close(r.log_variance.exp().detach(), R, rtol=0.1, atol=0)
    torch.testing.assert_close(learned.diagonal(), Q.diagonal(), rtol=0.1, atol=0)
    torch.testing.assert_close(learned[0, 1], Q[0, 1], rtol=0, atol=0.1 * Q.diagonal().prod().sqrt().item())


# ---------------------------------------------------------------------------------------------------------- keys


@ALL
def test_the_noise_is_read_where_its_module_writes_it(float64, name):
    _, _, _, R = linear_system()
    frames = linear_frames(3, 12)
    expected = linear_filter(name).sequence(frames.copy())
    # What lies under the name that is usual has nothing to do with this filter.
    frames["sensor", "noise"] = torch.full((3, 12, 2), 100.0)
    noise = ConstantNoise(R.sqrt(), in_key="observation", out_key=("camera", "r"))
    found = linear_filter(name, noise=noise).sequence(frames.copy())
    assert_equal(found, expected, [*BELIEF, *INFO], atol=0)
    torch.testing.assert_close(found["camera", "r"], R.expand(3, 12, 2), rtol=1e-14, atol=0)
    alone = linear_filter(name, noise=noise).sequence(frames.exclude("sensor"))
    assert_equal(alone, expected, [*BELIEF, *INFO], atol=0)
