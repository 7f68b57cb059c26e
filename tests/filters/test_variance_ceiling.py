"""Tests the ceiling of a filter's variances in each way to run it; ``tests/test_beliefs.py`` has what it clamps."""

import warnings

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.filters import KalmanFilter

ENSEMBLE, MEAN, COV, VAR = (("belief", name) for name in ("ensemble", "mean", "cov", "var"))


pytestmark = pytest.mark.usefixtures("float64")


def unseen(*batch):
    masks = torch.zeros(*batch, 1, dtype=torch.bool)
    return TensorDict({"observation": torch.zeros(*batch, 2), "observed": masks}, batch)


def kalman(ceiling, cov, mean=(1.0, -2.0)):
    one = torch.eye(2)
    return KalmanFilter(
        one, one, process_noise_cov=one, noise_cov=one, mean=torch.tensor(mean), cov=cov, variance_ceiling=ceiling
    )


@pytest.mark.parametrize("sequence", [False, True])
def test_compiled_filter_clamps_and_warns_once(sequence):
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
    # P + Q is [[400, 60], [60, 25]]: the first variance is 4 times too large, its deviation 2 times.
    first = outs[1][COV][1] if sequence else outs[1][COV]
    torch.testing.assert_close(first, torch.tensor([[100.0, 30.0], [30.0, 25.0]]))
    steps = outs[1][VAR][1:] if sequence else outs[1][VAR]  # the initial belief is what it was made to be
    assert (steps <= 100.0 + 1e-9).all()
