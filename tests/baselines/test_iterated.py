"""The iterated smoother: exact where the system is linear, better than one update where it is not."""

import pytest
import torch
from torch.testing import assert_close

from tests.filters.factories import NoisyLinear, assert_equal, linear_denkf, linear_kalman, linear_system, random_draws
from tests.filters.gaussian_for_tests import known_process_noise
from tests.smoothers.joint import COV, MEAN, drive
from torch_denkf.baselines import IEnKS
from torch_denkf.baselines.iterated_smoothing import iterated_smoothing
from torch_denkf.functional import analyse
from torch_denkf.modules import (
    ConstantNoise,
    GaussianPrior,
    LearnedTransition,
    LinearObservation,
    Select,
    StochasticMLP,
    SubModel,
)
from torch_denkf.smoothers import FixedLag


def linear(size, *, noise=None, initial=None, **kwargs):
    F, _, H, R = linear_system()
    return IEnKS(
        NoisyLinear(F),
        None,
        LinearObservation(H),
        ConstantNoise(R.sqrt(), in_key="observation"),
        initial=initial or GaussianPrior(MEAN, torch.tensor(COV).sqrt(), ensemble_size=size),
        process_noise=noise,
        observation_key="observation",
        **kwargs,
    )


@pytest.mark.parametrize("iterations", [1, 4])
def test_without_process_noise_equals_the_kalman_smoother(float64, iterations):
    """Equals the ETKF after one iteration of a linear system, and further ones change nothing."""
    etkf = linear_denkf("etkf")
    frames = drive(3, 7)
    expected = FixedLag(etkf, 1).sequence(frames.copy())
    out = linear(6, initial=etkf.initial, iterations=iterations).sequence(frames.copy())
    for key in (("belief", "mean"), ("belief", "var"), ("smoothed", "mean"), ("smoothed", "var")):
        assert_close(out[key], expected[key], rtol=0, atol=1e-9)
    for name in ("innovation", "nis", "log_likelihood"):
        assert_close(out["info", name], expected["info", name], rtol=0, atol=1e-9)
    assert_equal(out, expected, [("smoothed", "age")])


class Given(SubModel):
    """A sensor that draws what stands in the data."""

    def compute(self, samples):
        return samples


def test_mean_of_samples_is_the_reading(float64):
    F, _, H, R = linear_system()
    frames, initial = drive(3, 7), linear_denkf("etkf").initial
    expected = linear(6, initial=initial).sequence(frames.copy())
    spread = torch.randn(3, 7, 6, 2)
    frames["samples"] = frames["observation"].nan_to_num().unsqueeze(-2) + spread - spread.mean(-2, keepdim=True)
    sensor = Given(torch.nn.Identity(), ["samples"], [("sensor", "ensemble")])
    noise = ConstantNoise(R.sqrt(), in_key="samples")
    out = IEnKS(NoisyLinear(F), sensor, LinearObservation(H), noise, initial=initial).sequence(frames)
    for key in (("belief", "ensemble"), ("smoothed", "ensemble"), ("info", "innovation"), ("info", "nis")):
        assert_close(out[key], expected[key], rtol=0, atol=1e-10)


def test_with_process_noise_many_members_are_the_kalman_smoother(float64):
    frames, size = drive(2, 6), 500
    expected = FixedLag(linear_kalman(), 1).sequence(frames.copy())
    with torch.no_grad():
        out = random_draws(linear(size, noise=known_process_noise(), iterations=1)).sequence(frames.copy())
    for kind in ("belief", "smoothed"):
        std = expected[kind, "var"].sqrt()
        assert ((out[kind, "mean"] - expected[kind, "mean"]).abs() < 5 * std / size**0.5).all()
        assert ((out[kind, "var"] / std.square() - 1).abs() < 5 * (2 / size) ** 0.5).all()


def test_iterations_find_the_most_likely_state(float64):
    """One dimension, cubed: the mean ends where the gradient of the posterior is zero."""
    members = torch.randn(200, 1)
    members = (members - members.mean()) / members.std() * 0.5 + 1.0
    noise, reading = torch.tensor([0.05]), torch.tensor([4.0])

    def cube(x):
        return x.mean(-2, keepdim=True) ** 3 + 3 * x.mean(-2, keepdim=True) ** 2 * (x - x.mean(-2, keepdim=True))

    smoothed, _ = iterated_smoothing(members, cube, reading, noise, iterations=20)
    mode = smoothed.mean()
    slope = (mode - 1.0) / 0.25 - 3 * mode**2 * (reading - mode**3) / noise
    assert slope.abs() < 1e-6
    once = analyse(members, cube(members), reading, noise, scheme="etkf").ensemble.mean()
    assert (once**3 - reading).abs() > 10 * (mode**3 - reading).abs()


def test_gradients_are_those_of_finite_differences(float64):
    inputs = [torch.randn(2, 4, 3), torch.randn(2, 2), torch.rand(2, 2) + 0.5, torch.randn(3, 2)]
    observed = torch.tensor([[True, False], [True, True]])

    def smooth(ensemble, observation, noise, matrix):
        return iterated_smoothing(
            ensemble, lambda x: torch.tanh(x @ matrix), observation, noise, observed=observed, iterations=3
        )

    assert torch.autograd.gradcheck(smooth, [value.requires_grad_() for value in inputs])


def test_unsupported_options_raise():
    with pytest.raises(ValueError, match="draw noise of their own"):
        IEnKS(
            LearnedTransition(StochasticMLP(2, 2)),
            None,
            Select([0]),
            ConstantNoise([0.3], in_key="reading"),
            initial=GaussianPrior([0.0, 0.0], [1.0, 1.0]),
            observation_key="reading",
        )
    with pytest.raises(ValueError, match="no update_at_reset"):
        linear(4, update_at_reset=True)
