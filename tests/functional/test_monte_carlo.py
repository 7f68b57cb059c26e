"""The perturbed filter against the Kalman filter it approximates, over 50 steps of a moving cart."""

import pytest
import torch

from torch_denkf.functional import analyse, ensemble_mean, kalman_predict, kalman_update
from torch_denkf.functional.moments import ensemble_cov

STEPS, REPEATS, DT = 50, 32, 0.5
# Position and velocity on a line with a slowly turning third component; position and the third are seen.
TRANSITION = torch.tensor([[1.0, DT, 0.0], [-0.1, 0.95, 0.2], [0.0, -0.2, 0.9]], dtype=torch.float64)
MATRIX = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
PROCESS = torch.tensor([0.1, 0.3, 0.2], dtype=torch.float64)  # standard deviations
NOISE = torch.tensor([0.5, 0.2], dtype=torch.float64)  # variances


def observations():
    generator = torch.Generator().manual_seed(0)
    state, seen = torch.zeros(3, dtype=torch.float64), []
    for _ in range(STEPS):
        state = TRANSITION @ state + PROCESS * torch.randn(3, generator=generator, dtype=torch.float64)
        draw = torch.randn(2, generator=generator, dtype=torch.float64)
        seen.append(MATRIX @ state + NOISE.sqrt() * draw)
    return seen


def kalman_filter():
    """Mean, upper triangle of the covariance and log-likelihood at every step: [STEPS, 3 + 6 + 1]."""
    mean, cov, rows = torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64), []
    for observation in observations():
        mean, cov = kalman_predict(mean, cov, TRANSITION, PROCESS.square().diag())
        mean, cov, _, _, likelihood = kalman_update(mean, cov, observation, MATRIX, NOISE)
        rows.append(torch.cat([mean, cov[torch.triu(torch.ones(3, 3)) > 0], likelihood]))
    return torch.stack(rows)


def ensemble_filter(size, seed):
    """Returns the same quantities of REPEATS independent filters: [REPEATS, STEPS, 3 + 6 + 1]."""
    generator = torch.Generator().manual_seed(seed)

    def randn(dim):
        return torch.randn(REPEATS, size, dim, generator=generator, dtype=torch.float64)

    ensemble, rows = randn(3), []
    for observation in observations():
        ensemble = ensemble @ TRANSITION.mT + PROCESS * randn(3)
        ensemble, _, _, likelihood = analyse(
            ensemble,
            ensemble @ MATRIX.mT,
            observation.expand(REPEATS, 2),
            NOISE.expand(REPEATS, 2),
            scheme="perturbed",
            perturbation=randn(2),
        )
        cov = ensemble_cov(ensemble)[:, torch.triu(torch.ones(3, 3)) > 0]
        rows.append(torch.cat([ensemble_mean(ensemble), cov, likelihood], -1))
    return torch.stack(rows, 1)


@pytest.fixture(scope="module")
def large():
    return ensemble_filter(6400, seed=1) - kalman_filter()


def test_large_ensemble_is_within_three_standard_errors_of_the_kalman_filter(large):
    # Ten quantities, each averaged over the 50 steps, of one filter (the first); the Monte-Carlo standard
    # error of one filter is the standard deviation of the other 31, which are independent of it. Under the
    # null hypothesis one of ten exceeds 3 with a probability of about 5 % (Student's t, 30 degrees of
    # freedom, Bonferroni); the seed is fixed, so this is not flaky.
    deviation = large.mean(1)
    assert (deviation[0].abs() <= 3 * deviation[1:].std(0)).all()
    # All 500 step-wise values of that filter: they are too many for 3 each (0.27 % are allowed beyond; 1 %
    # leaves room for their correlation in time), and none beyond the Bonferroni bound of a 1 % test,
    # Student's t with 30 degrees of freedom at 1 - 0.01 / 1000: 5.1.
    score = large[0].abs() / large[1:].std(0)
    assert (score > 3).double().mean() <= 0.01
    assert score.max() <= 5.1


def test_average_of_filters_shows_no_bias(large):
    # A test 5.7 times sharper: the mean of 32 filters, whose standard error is sqrt(32) smaller. Ten
    # comparisons, together at the 1 % level: Student's t with 31 degrees of freedom at 1 - 0.01 / 20 is
    # 3.6. The filter's own bias is of order 1 / E, one eightieth of one filter's error, and hides.
    deviation = large.mean(1)
    assert (deviation.mean(0).abs() <= 3.6 * deviation.std(0) / REPEATS**0.5).all()


def test_error_falls_as_the_square_root_of_the_ensemble_size(large):
    # 32 filters x 50 steps give each root mean square to a few per cent; over a factor of 64 in E the
    # fitted slope is then known to about 0.01.
    sizes = torch.tensor([100.0, 400.0, 1600.0, 6400.0], dtype=torch.float64)
    exact = kalman_filter()
    smaller = [ensemble_filter(int(size), seed=2) - exact for size in sizes[:-1]]
    errors = torch.stack([_group_errors(deviation) for deviation in (*smaller, large)])
    x = (sizes.log() - sizes.log().mean()).unsqueeze(1)
    slopes = (x * errors.log()).sum(0) / x.square().sum()
    assert ((slopes > -0.6) & (slopes < -0.4)).all()


def _group_errors(deviation):
    """Root mean squares of the mean's, the covariance's and the log-likelihood's errors."""
    return torch.stack([part.square().mean().sqrt() for part in deviation.split([3, 6, 1], -1)])
