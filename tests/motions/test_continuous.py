"""Steps of irregular length, in every kind of belief, against a Kalman filter written out for each step."""

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from torch_denkf.applications.car import UnicycleTransition
from torch_denkf.applications.car.modules.unicycle_noise import UnicycleNoise
from torch_denkf.filters import DEnKF
from torch_denkf.functional import kalman_predict, kalman_update
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.modules import (
    ConstantNoise,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedTransition,
    MappedNoise,
    MomentPrior,
    Select,
    UKFTransition,
)
from torch_denkf.motions import ContinuousMotion, ContinuousNoise, NoisePerSecond

DENSITY, R = 0.3, 0.2


def drives(*batch, count=12):
    torch.manual_seed(0)
    frames = TensorDict({"reading": torch.randn(*batch, count, 1)}, [*batch, count])
    frames["dt"] = torch.rand(*batch, count, 1).square()
    frames["dt"][..., 5, :] = 0.0  # two readings of one time
    frames["reading_observed"] = torch.rand(*batch, count, 1) < 0.8
    return frames


def by_hand(frames):
    """Returns the mean and covariance with F and Q of each step in their closed form; the first frame is not read."""
    mean, cov = torch.zeros(len(frames), 2), torch.eye(2).expand(len(frames), 2, 2)
    means, covs = [mean], [cov]
    for row in frames.unbind(1)[1:]:
        t = row["dt"].squeeze(-1)
        one, zero = torch.ones_like(t), torch.zeros_like(t)
        motion = torch.stack([one, t, zero, one], -1).reshape(-1, 2, 2)
        noise = DENSITY * torch.stack([t**3 / 3, t**2 / 2, t**2 / 2, t], -1).reshape(-1, 2, 2)
        mean, cov = kalman_predict(mean, cov, motion, noise)
        variance = torch.full_like(row["reading"], R**2)
        matrix = torch.tensor([[1.0, 0.0]])
        update = kalman_update(mean, cov, row["reading"], matrix, variance, observed=row["reading_observed"])
        mean, cov = update.mean, update.cov
        means.append(mean)
        covs.append(cov)
    return torch.stack(means, 1), torch.stack(covs, 1)


def parts():
    motion = ContinuousMotion(torch.tensor([[0.0, 1.0], [0.0, 0.0]]))
    return motion, ContinuousNoise(motion, torch.diag(torch.tensor([0.0, DENSITY])))


@pytest.mark.parametrize("kind", ["EKF", "UKF", "Euler"])
def test_kalman_filter_with_irregular_steps(float64, kind):
    motion, noise = parts()
    transition, q = motion, noise
    if kind == "UKF":
        transition, q = UKFTransition(motion, noise), None
    if kind == "Euler":  # exact here: the rate of change does not change within a step
        glide = torch.nn.Linear(2, 2, bias=False)
        glide.weight.data = motion.drift.clone()
        transition = LearnedTransition(glide, dt_key="dt")
    frames, prior = drives(3), MomentPrior(torch.zeros(2), torch.eye(2))
    filter = FusedFilter(transition, {"reading": FusedSensor(Select([0]), [R])}, initial=prior, process_noise=q)
    out = filter.sequence(frames.copy())
    mean, cov = by_hand(frames)
    assert_close(out["belief", "mean"], mean, rtol=0, atol=1e-10)
    assert_close(out["belief", "cov"], cov, rtol=0, atol=1e-10)


def test_ensemble_with_irregular_steps(float64):
    motion, noise = parts()
    filter = DEnKF(
        transition=motion,
        sensor=None,
        observation=Select([0]),
        noise=ConstantNoise([R], in_key="reading"),
        analysis=EnsembleAnalysis("etkf", observation_key="reading", observed_key="reading_observed"),
        initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=20_000),
        process_noise=noise,
    )
    frames = drives(2, count=8)
    torch.manual_seed(1)
    out = filter.sequence(frames.copy())
    mean, cov = by_hand(frames)
    assert_close(out["belief", "mean"], mean, rtol=0, atol=0.03)
    assert_close(out["belief", "var"], cov.diagonal(dim1=-2, dim2=-1), rtol=0.06, atol=1e-3)


def test_noise_per_second_adds_up_over_steps_of_any_length(float64):
    """A random walk over one second, in one step or in many, has the same covariance."""
    walk = ConstantNoise([0.5, 0.1], in_key=("belief", "mean"), out_key=("forecast", "noise"))
    variances = [
        NoisePerSecond(walk)(TensorDict({"dt": torch.tensor([dt]), "belief": {"mean": torch.zeros(2)}}))
        for dt in (0.2, 0.8, 1.0)
    ]
    variances = [out["forecast", "noise"] for out in variances]
    assert_close(variances[0] + variances[1], variances[2])
    assert_close(variances[2], torch.tensor([0.25, 0.01]))
    still = UnicycleTransition(torch.zeros_like, dt="dt")
    car = FusedFilter(
        still,
        {"speed": FusedSensor(Select([3]), [0.2])},
        initial=MomentPrior(torch.tensor([0.0, 0.0, 0.0, 10.0, 0.0]), torch.zeros(5, 5)),
        process_noise=UnicycleNoise(NoisePerSecond(walk), dt="dt"),
    )
    frames = TensorDict({"speed": torch.full((3, 1), torch.nan)}, [3])
    frames["speed_observed"] = torch.zeros(3, 1, dtype=torch.bool)
    frames["dt"] = torch.tensor([[0.0], [0.25], [0.75]])
    out = car.sequence(frames)
    assert_close(out["belief", "mean"][-1, 0], torch.tensor(10.0))
    assert_close(out["belief", "var"][-1, 3:], torch.tensor([0.25, 0.01]))


def test_a_covariance_per_second_grows_with_the_seconds(float64):
    root = torch.tensor([[0.5, 0.0], [0.2, 0.1]])
    walk = ConstantNoise([1.0, 1.0], in_key=("belief", "mean"), out_key=("forecast", "noise"))
    td = TensorDict({"dt": torch.tensor([[0.0], [0.2], [3.0]]), "belief": {"mean": torch.zeros(3, 2)}}, [3])
    found = NoisePerSecond(MappedNoise(walk, root))(td)["forecast", "noise"]
    assert_close(found, torch.tensor([0.0, 0.2, 3.0]).reshape(3, 1, 1) * (root @ root.mT))
