"""Oracles: the moments asked for (five standard errors) and center + std * noise."""

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import linear_denkf
from torch_denkf.functional.draws import exact_draws
from torch_denkf.functional.moments import ensemble_cov
from torch_denkf.modules import AroundState, FromSensor, GaussianPrior

E = 40_000
BATCHES = [(), (3,), (2, 3)]


def assert_moments(td, mean, std):
    """Draws an ensemble whose moments are right within five standard errors; mean and var are those of the ensemble."""
    ensemble = td["belief", "ensemble"]
    mean, std = mean.expand(ensemble[..., 0, :].shape), std.expand(ensemble[..., 0, :].shape)
    torch.testing.assert_close(td["belief", "mean"], ensemble.mean(-2), rtol=0, atol=1e-12)
    torch.testing.assert_close(td["belief", "var"], ensemble.var(-2), rtol=1e-10, atol=1e-12)
    assert ((td["belief", "mean"] - mean).abs() <= 5 * std / E**0.5).all()
    # Var of a sample variance of normals: 2 sigma^4 / (E - 1).
    assert ((td["belief", "var"] - std**2).abs() <= 5 * std**2 * (2 / (E - 1)) ** 0.5).all()
    anomalies = (ensemble - mean.unsqueeze(-2)) / std.clamp_min(1e-9).unsqueeze(-2)
    assert ((anomalies[..., 0] * anomalies[..., 1]).mean(-1).abs() <= 5 / E**0.5).all()


@pytest.mark.parametrize("batch", BATCHES)
def test_gaussian_prior(float64, batch):
    mean, std = torch.tensor([1.0, -2.0, 5.0]), torch.tensor([0.5, 2.0, 0.0])
    td = GaussianPrior(mean, std, ensemble_size=E)(TensorDict({}, batch))
    assert td["belief", "ensemble"].shape == (*batch, E, 3)
    assert_moments(td, mean, std)
    if batch == (3,):
        assert not td["belief", "ensemble"][0].equal(td["belief", "ensemble"][1])


@pytest.mark.parametrize("batch", BATCHES)
def test_around_state(float64, batch):
    state, std = torch.randn(*batch, 2), torch.tensor([0.5, 2.0])
    td = AroundState(std, ensemble_size=E, state_key="truth")(TensorDict({"truth": state}, batch))
    assert_moments(td, state, std)
    exact = AroundState([0.0, 0.0], ensemble_size=4)(TensorDict({"state": state}, batch))
    assert exact["belief", "ensemble"].equal(state.unsqueeze(-2).expand(*batch, 4, 2))


class TestFromSensor:
    mean, std = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)

    def start(self):
        return FromSensor([2, 0], mean=self.mean, std=self.std, ensemble_size=E)

    @pytest.mark.parametrize("samples", [True, False])
    @pytest.mark.parametrize("batch", BATCHES)
    def test_observed_dimensions_follow_the_sensor(self, float64, samples, batch):
        reading = 10 + torch.randn(*batch, 8, 2)
        variance = torch.rand(*batch, 2) + 0.5
        value = reading if samples else reading.mean(-2)
        td = self.start()(TensorDict({"sensor": {"ensemble": value, "noise": variance}}, batch))
        y = reading.mean(-2)
        one = torch.ones(batch)
        mean = torch.stack([y[..., 1], 2.0 * one, y[..., 0]], -1)
        std = torch.stack([variance[..., 1].sqrt(), 0.2 * one, variance[..., 0].sqrt()], -1)
        assert_moments(td, mean, std)

    def test_without_observation_the_belief_is_the_prior(self, float64):
        nan = torch.full((2,), torch.nan)
        td = TensorDict({"sensor": {"ensemble": nan, "noise": torch.ones(2)}, "observed": torch.tensor([False])})
        assert_moments(self.start()(td), self.mean, self.std)

    def test_partly_observed(self, float64):
        td = TensorDict(
            {
                "sensor": {"ensemble": torch.tensor([9.0, torch.nan]), "noise": torch.tensor([4.0, 1.0])},
                "observed": torch.tensor([True, False]),
            }
        )
        assert_moments(self.start()(td), torch.tensor([1.0, 2.0, 9.0]), torch.tensor([0.1, 0.2, 2.0]))

    def test_initial_belief_without_its_reading_raises(self):
        start = FromSensor([0], [0.0, 0.0], [1.0, 1.0], ensemble_size=6, observation_key="readng")
        frames = TensorDict({"observation": torch.zeros(2, 3, 2), ("sensor", "noise"): torch.ones(2, 3, 1)}, [2, 3])
        filter = linear_denkf(initial=start)
        with pytest.raises(KeyError, match="FromSensor reads 'readng', which is missing"):
            filter.initialise(frames[:, 0].copy())
        with pytest.raises(KeyError, match="FromSensor reads 'readng', which is missing"):
            filter.sequence(frames)


def test_noise_given(float64):
    noise = torch.randn(3, 4, 2)
    td = TensorDict({("noise", "self"): noise}, [3])
    mean, std = torch.tensor([1.0, 2.0]), torch.tensor([3.0, 4.0])
    for draws, expected in (("random", noise), ("exact", exact_draws(noise))):
        out = GaussianPrior(mean, std, ensemble_size=4, draws=draws)(td.copy())["belief", "ensemble"]
        assert out.equal(mean + std * expected)


@pytest.mark.parametrize("batch", [[], [3]])
def test_the_first_ensemble_has_the_priors_moments(float64, batch):
    td = GaussianPrior([1.0, 2.0], [3.0, 4.0], ensemble_size=8)(TensorDict({}, batch))
    torch.testing.assert_close(td["belief", "mean"], torch.tensor([1.0, 2.0]).expand(*batch, 2))
    torch.testing.assert_close(
        ensemble_cov(td["belief", "ensemble"]), torch.tensor([[9.0, 0], [0, 16]]).expand(*batch, 2, 2)
    )


def test_gradient_through_a_trainable_center(float64):
    state = torch.zeros(2, requires_grad=True)
    AroundState([1.0, 1.0], ensemble_size=4)(TensorDict({"state": state}))["belief", "mean"].sum().backward()
    torch.testing.assert_close(state.grad, torch.ones(2))
