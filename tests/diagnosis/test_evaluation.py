"""Oracle: true states drawn from the belief's own distribution, in the tangent space at its mean."""

import pytest
import torch
from tensordict import TensorDict

from tests.filters.test_hidden_numbers import make
from torch_denkf.diagnosis import evaluate
from torch_denkf.functional.manifolds import SE2, SO3, Euclidean, Product
from torch_denkf.metrics import interval_coverage, nees, state_errors

N, NAN = 3000, float("nan")
SPACE = Product(SE2(), Euclidean(1))
STD = torch.tensor([0.2, 2.0, 0.1, 1.0], dtype=torch.float64)  # heading, forward, left, and the scalar component


@pytest.fixture(autouse=True)
def _double(float64):
    return


def beliefs(kind, space=SPACE, std=STD, size=16, n=N):
    """Returns beliefs with random means, and true states drawn from them; the first element is not scored."""
    rng = torch.Generator().manual_seed(0)
    mean = space.exp(3 * torch.randn(1, n + 1, space.tangent_dim, generator=rng))

    def draw(*shape):
        return std * torch.randn(1, n + 1, *shape, space.tangent_dim, generator=rng)

    data = TensorDict({"state": space.plus(mean, draw())}, [1, n + 1])
    var = std.square().expand(1, n + 1, -1)
    if kind == "EKF":
        data["belief"] = TensorDict({"mean": mean, "var": var, "cov": var.diag_embed()}, [1, n + 1])
        return data
    members = space.plus(mean.unsqueeze(-2), draw(size))
    mean = space.mean(members)
    var = space.minus(members, mean.unsqueeze(-2)).var(-2)
    data["belief"] = TensorDict({"ensemble": members, "mean": mean, "var": var}, [1, n + 1])
    if kind == "particles":
        data["belief", "log_weight"] = torch.zeros_like(members[..., 0]).log_softmax(-1)
    return data


@pytest.mark.parametrize("kind", ["EKF", "etkf", "particles"])
@pytest.mark.parametrize("space", [SPACE, SO3()])
def test_scores_of_a_consistent_belief(kind, space):
    std = torch.linspace(0.1, 0.2, space.tangent_dim)  # narrow: the tangent axes turn with the mean of the members
    size, n = (200, 500) if kind == "particles" else (16, N)
    out = evaluate(make(kind, space), beliefs(kind, space, std, size, n), level=0.8)
    assert out.known.tolist() == [n] * space.tangent_dim
    assert (out.coverage - 0.8).abs().max() < 5 * (0.16 / n) ** 0.5
    own = 1.0 if kind == "EKF" else 1 + 1 / size  # the sample mean adds a variance of 1 / size
    torch.testing.assert_close(out.rmse, std * own**0.5, rtol=5 / n**0.5, atol=0)
    torch.testing.assert_close(out.crps, std / torch.pi**0.5, rtol=0.1, atol=0)  # Gaussian: sigma / sqrt(pi)
    dim = space.tangent_dim  # the inverse of a sample covariance of random members is biased upwards
    expected = dim if kind != "etkf" else dim * (size + 1) * (size - 1) / (size * (size - dim - 2))
    assert abs(out.nees.mean / expected - 1) < 0.1


def test_coverage_of_a_pose_is_in_body_axes():
    data = beliefs("EKF")
    mean, var, cov, truth = (
        data[key][0] for key in (("belief", "mean"), ("belief", "var"), ("belief", "cov"), "state")
    )
    out = evaluate(make("EKF", SPACE), data, level=0.95)
    plain = interval_coverage(mean, var, truth, level=0.95)
    assert plain[1] > 0.98
    assert plain[2] < 0.3
    assert out.coverage.sub(0.95).abs().max() < 0.02
    assert nees(mean, cov, truth).mean > 100 > 5 > out.nees.mean
    expected = nees(mean[1:], cov[1:], truth[1:], space=SPACE, level=0.95)
    torch.testing.assert_close(out.nees.mean, expected.mean)
    assert (out.nees.lower, out.nees.upper) == (expected.lower, expected.upper)
    torch.testing.assert_close(out.rmse, state_errors(mean[1:], truth[1:], space=SPACE).rmse)


def test_partially_known_true_state():
    data = beliefs("EKF")
    filter, whole = make("EKF", SPACE), evaluate(make("EKF", SPACE), data)
    pose = evaluate(filter, data, data["state"][..., :3])
    torch.testing.assert_close(pose.rmse[:3], whole.rmse[:3])
    assert pose.known.tolist() == [N] * 3 + [0]
    assert pose.rmse[3].isnan()
    assert pose.coverage[3].isnan()
    assert abs(pose.nees.mean - 3) < 0.2
    data["state_observed"] = torch.ones(1, N + 1, 1, dtype=torch.bool)
    data["state_observed"][:, 100:] = False
    part = evaluate(filter, data)
    torch.testing.assert_close(part.rmse, evaluate(filter, data[:, :100]).rmse)
    assert part.known.tolist() == [99] * 4
    assert part.nees.values.shape == (99,)


def test_frames_without_a_belief_are_filtered_and_smoothed_beliefs_are_scored():
    filter, space = make("EKF", SE2()), SE2()
    rng = torch.Generator().manual_seed(3)
    truth = space.exp(0.3 * torch.randn(4, 1, 3, generator=rng)).expand(4, 8, 3)
    data = TensorDict({"start": truth, "state": truth}, [4, 8])
    data["pose"] = space.plus(truth, 0.1 * torch.randn(4, 8, 3, generator=rng))
    written = filter.sequence(data.copy())
    assert evaluate(filter, data).rmse.equal(evaluate(filter, written).rmse)
    assert "belief" not in data
    named = filter.with_options(prefix="imu")
    assert evaluate(named, named.sequence(data.copy())).rmse.equal(evaluate(filter, written).rmse)
    written["smoothed"] = TensorDict({"mean": truth, "var": torch.ones_like(truth)}, [4, 8])
    smoothed = evaluate(filter, written, belief="smoothed")
    assert smoothed.rmse.abs().max() < 1e-7
    assert smoothed.nees is None
    assert smoothed.coverage.tolist() == [1.0] * 3
