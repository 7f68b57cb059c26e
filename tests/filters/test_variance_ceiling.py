"""Tests what a variance ceiling clamps. Oracles: closed forms, and the filter without a ceiling."""

import warnings

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import NoisyLinear, linear_denkf
from torch_denkf.filters import KalmanFilter

ENSEMBLE, MEAN, COV, VAR = (("belief", name) for name in ("ensemble", "mean", "cov", "var"))


@pytest.fixture(autouse=True)
def _double(float64):
    torch.manual_seed(0)


def unseen(*batch):
    masks = torch.zeros(*batch, 1, dtype=torch.bool)
    return TensorDict({"observation": torch.zeros(*batch, 2), "observed": masks}, batch)


def kalman(ceiling, cov, mean=(1.0, -2.0)):
    one = torch.eye(2)
    return KalmanFilter(
        one, one, process_noise_cov=one, noise_cov=one, mean=torch.tensor(mean), cov=cov, variance_ceiling=ceiling
    )


@pytest.mark.filterwarnings("ignore:The variance")
def test_the_correlations_stay():
    cov = torch.tensor([[399.0, 60.0], [60.0, 24.0]])
    out = kalman(100.0, cov).step(kalman(100.0, cov).initialise(unseen()))
    # P + Q is [[400, 60], [60, 25]]: the first variance is 4 times too large, its deviation 2 times.
    torch.testing.assert_close(out[COV], torch.tensor([[100.0, 30.0], [30.0, 25.0]]))
    torch.testing.assert_close(out[VAR], torch.tensor([100.0, 25.0]))
    torch.testing.assert_close(out[MEAN], torch.tensor([1.0, -2.0]))


@pytest.mark.filterwarnings("ignore:The variance")
def test_the_mean_is_held_within_a_thousand_deviations():
    filter = kalman(4.0, 10.0 * torch.eye(2), mean=(5000.0, -1500.0))
    out = filter.step(filter.initialise(unseen()))
    torch.testing.assert_close(out[MEAN], torch.tensor([2000.0, -1500.0]))


@pytest.mark.filterwarnings("ignore:The variance")
def test_members_that_are_not_held_do_not_move_by_a_bit():
    F = torch.diag(torch.tensor([1.7, 0.9]))
    transition = NoisyLinear(F)
    held, free = (linear_denkf(variance_ceiling=most).with_modules(transition=transition) for most in (5.0, None))
    td = free.initialise(unseen(2))
    td[ENSEMBLE] = td[ENSEMBLE] / 7 + torch.tensor([1.0, 1 / 3])
    td[ENSEMBLE][1, :, 0] *= 20.0
    expected, out = free.step(td.copy()), held.step(td.copy())
    assert out[ENSEMBLE][0].equal(expected[ENSEMBLE][0])
    assert out[ENSEMBLE][1, :, 1].equal(expected[ENSEMBLE][1, :, 1])
    assert expected[VAR][1, 0] > 5.0
    torch.testing.assert_close(out[VAR][1, 0], torch.tensor(5.0))
    torch.testing.assert_close(out[ENSEMBLE].var(-2), out[VAR])
    torch.testing.assert_close(out[ENSEMBLE].mean(-2), expected[MEAN])


@pytest.mark.parametrize("sequence", [False, True])
def test_a_compiled_filter_holds_it_and_says_so_once(sequence):
    cov, outs = torch.tensor([[399.0, 60.0], [60.0, 24.0]]), []
    for chunk in (0, 2):
        filter = kalman(100.0, cov).compile(chunk=chunk, backend="eager")
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            for _ in range(2):
                out = filter.sequence(unseen(4)) if sequence else filter.step(filter.initialise(unseen()))
        assert sum("variance_ceiling" in str(warning.message) for warning in said) == 1
        outs.append(out)
    for key in (MEAN, COV, VAR):
        torch.testing.assert_close(outs[1][key], outs[0][key], rtol=0, atol=1e-12)
    steps = outs[1][VAR][1:] if sequence else outs[1][VAR]  # the initial belief is what it was made to be
    assert (steps <= 100.0 + 1e-9).all()
