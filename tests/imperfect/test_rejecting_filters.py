"""Filters behind RejectReadings treat readings that cannot be true as missing; by themselves they raise."""

import re

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ExcludeTransform, TransformedEnv

from tests.filters.factories import M, S, toy_denkf
from tests.filters.test_contract import FILTERS as CONTRACT
from tests.transforms.envs_for_tests import base_env
from torch_denkf import RejectReadings
from torch_denkf.filters import DEnKF, Filter, KalmanFilter, ParticleFilter
from torch_denkf.modules import (
    ConstantNoise,
    GaussianPrior,
    LearnedLikelihood,
    LearnedTransition,
    LinearObservation,
    LocalEnsembleAnalysis,
    Select,
    StochasticMLP,
    VectorSensor,
)
from torch_denkf.modules.particles import ParticleAnalysis
from torch_denkf.transforms import DEnKFTransform

REJECTED = ("info", "rejected")
BAD = [float("nan"), float("inf"), -float("inf"), 1e25, -2e18]


def learned_particles():
    return ParticleFilter(
        LearnedTransition(StochasticMLP(S, S, (8,))),
        VectorSensor(M, 2, ensemble_size=1, num_cells=(8,), layer="none"),
        Select([0, 1]),
        LearnedLikelihood(2, 2, num_cells=(8,), encoding_key=("sensor", "ensemble")),
        initial=GaussianPrior([0.0] * S, [1.0] * S, ensemble_size=16),
    )


def local():
    return DEnKF(
        transition=LearnedTransition(StochasticMLP(2, 2, (8,))),
        sensor=None,
        observation=LinearObservation(torch.eye(2)),
        noise=ConstantNoise([0.5, 0.3], in_key="observation"),
        analysis=LocalEnsembleAnalysis.around(
            torch.tensor([[0.0], [1.0]]), torch.tensor([[0.0], [1.0]]), 1.0, observation_key="observation"
        ),
        initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=16),
    )


ONE = ("Kalman", "EKF", "UKF", "Backprop KF", "DEnKF etkf", "DEnKF perturbed", "DEnKF sakov", "LSTM")
ONE += tuple(f"particles, {scheme}" for scheme in ("systematic", "soft", "transport"))
#: Filters by name, the entry that they read, and whether its components are hidden one by one.
FILTERS = {name: (CONTRACT[name], "observation", True) for name in ONE} | {
    "local": (local, "observation", True),
    "sensor": (lambda: toy_denkf(action=False), "measurement", False),
    "learned likelihood": (learned_particles, "measurement", False),
}
ALL = pytest.mark.parametrize("name", FILTERS)


def make(name) -> Filter:
    """Makes a filter with the same weights each time."""
    torch.manual_seed(7)
    return FILTERS[name][0]()


def frames_of(name, *batch, masked=False):
    """Sound frames with a mask, the same frames with bad values where the mask hides them, and how many that are."""
    _, key, by_component = FILTERS[name]
    generator = torch.Generator().manual_seed(3)
    clean = torch.randn(*batch, M if key == "measurement" else 2, generator=generator)
    bad = torch.rand(clean.shape, generator=generator) < 0.2
    hidden = bad if by_component else bad.any(-1, keepdim=True)
    values = torch.tensor(BAD)[torch.randint(5, clean.shape, generator=generator)]
    observed = torch.rand(*batch, 1, generator=generator) < 0.7 if masked else torch.ones(*batch, 1, dtype=torch.bool)
    expected = TensorDict({key: clean, "observed": observed & ~hidden}, batch)
    spoiled = TensorDict({key: torch.where(bad, values, clean)}, batch)
    if masked:
        spoiled["observed"] = observed
    return expected, spoiled, (hidden & observed).sum(-1, keepdim=True)


def rejecting(name):
    """Returns the rejection of bad readings in front of the filter of that name."""
    _, key, by_component = FILTERS[name]
    return RejectReadings({key: "observed"}, by_component=[key] if by_component else [])


def same(filter, got, expected):
    keys = [*filter.belief_keys, *filter.structure.likelihoods]
    for key in keys:
        assert got[key].isfinite().all(), key
        torch.testing.assert_close(got[key], expected[key], rtol=0, atol=0, msg=lambda text, key=key: f"{key}: {text}")


@ALL
@pytest.mark.parametrize("masked", [False, True])
def test_a_sequence_is_that_of_a_mask(name, masked):
    expected, spoiled, count = frames_of(name, 3, 12, masked=masked)
    torch.manual_seed(0)
    expected = make(name).sequence(expected)
    torch.manual_seed(0)
    filter = make(name)
    got = filter.sequence(rejecting(name)(spoiled.copy()))
    same(filter, got, expected)
    assert got[REJECTED].equal(count)
    assert count.sum() > 0


@ALL
def test_a_filter_by_itself_raises_and_keeps_its_belief(name):
    _, key, _ = FILTERS[name]
    filter = make(name)
    td = filter.initialise(frames_of(name, 3)[0])
    before = td.clone()
    td[key][1, 0], td["observed"][:] = torch.nan, True
    with pytest.raises(ValueError, match=re.escape(f"NaN or infinity in ['{key}']")):
        filter.step(td)
    assert all(td[belief].equal(before[belief]) for belief in filter.carry_keys)


@pytest.mark.parametrize("name", ["Kalman", "DEnKF etkf", "particles, systematic"])
def test_readings_that_no_step_uses_may_be_anything(name):
    """Left out of a step, or of a reset that does not look at them."""
    _, key, _ = FILTERS[name]
    filter = make(name)
    td = filter.initialise(TensorDict({key: torch.full((3, 2), torch.nan)}, [3]))
    assert filter.predict(td.clone())["belief", "mean"].isfinite().all()
    assert filter.step(td.clone(), without=[key])["belief", "mean"].isfinite().all()
    env = TransformedEnv(base_env(missing=1.0, batch_size=[2]), ExcludeTransform("observed"))
    env.append_transform(DEnKFTransform(make(name)))
    td = env.reset()
    assert td[key].isnan().all()
    assert td["belief", "mean"].isfinite().all()
    with pytest.raises(ValueError, match=r"NaN or infinity in \['observation'\]"):
        env.step(env.rand_action(td))


def test_a_step_is_exact_up_to_the_limit():
    """K = 1/3 at P = 1 and R = 2."""
    one = torch.eye(2)
    kf = KalmanFilter(one, one, process_noise_cov=0 * one, noise_cov=2 * one, mean=torch.zeros(2), cov=one)
    belief = kf.initialise(TensorDict({"observation": torch.zeros(3, 2)}, [3]))
    belief["belief", "mean"] = torch.full((3, 2), 9e17)
    torch.testing.assert_close(kf.step(belief)["belief", "mean"], torch.full((3, 2), 6e17))


def test_gradients_exclude_rejected_readings():
    """Also those of the sensor that would have read it: they are those of a masked frame."""
    expected, spoiled, _ = frames_of("sensor", 3, 12)
    gradients = []
    for frames in (expected, rejecting("sensor")(spoiled)):
        filter = make("sensor")
        torch.manual_seed(0)
        filter.sequence(frames)["belief", "mean"].square().mean().backward()
        gradients.append({name: value.grad for name, value in filter.named_parameters() if value.grad is not None})
    assert gradients[0].keys() == gradients[1].keys()
    for name, gradient in gradients[1].items():
        assert gradient.isfinite().all(), name
        torch.testing.assert_close(gradient, gradients[0][name])


def test_a_reading_that_no_particle_can_explain():
    """0 / 0 of Bayes' rule: the weights stay, and the log-likelihood tells."""
    prior = torch.tensor([0.2, 0.3, 0.5]).log()
    td = TensorDict({
        "forecast": {
            "ensemble": torch.tensor([[0.0], [1.0], [2.0]]),
            "log_weight": prior,
            "log_likelihood": torch.full((3,), -torch.inf),
        }
    })  # fmt: skip
    out = ParticleAnalysis()(td)
    assert out["belief", "log_weight"].equal(prior)
    torch.testing.assert_close(out["belief", "mean"], torch.tensor([1.3]))
    assert out["info", "log_likelihood"].item() == -torch.inf
