"""Mixed precision raises; process noise of zero, in an ensemble, in a replaced network."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.filters.beliefs_for_tests import COV, MEAN, close
from tests.filters.factories import NoisyLinear, linear_system
from tests.filters.gaussian_for_tests import linear_filter
from torch_denkf.filters import EKF, UKF, KalmanFilter
from torch_denkf.modules import ConstantNoise, LinearObservation, MomentPrior


def test_mixed_float64_and_float32_raise():
    F, Q, H, R = linear_system(torch.float64)
    with pytest.raises(TypeError, match=r"mean is torch.float32 and transition is torch.float64; convert one"):
        KalmanFilter(F, H, process_noise_cov=Q, noise=R.sqrt(), mean=torch.zeros(2), cov=torch.eye(2))


def test_float64_readings_raise_by_name():
    filter = linear_filter("EKF")
    td = filter.initialise(TensorDict({"observation": torch.zeros(2, dtype=torch.float64)}))
    with pytest.raises(TypeError, match=r"observation.*float64"):
        filter.step(td)
    # A dictionary is one robot's: numbers, lists and arrays come in the filter's precision.
    belief = filter.initialise({"observation": torch.zeros(2, dtype=torch.float64).numpy()})
    assert filter.step(belief)[MEAN].dtype == torch.float32


def test_a_mask_in_a_dictionary_stays_a_mask():
    filter = linear_filter("EKF")
    belief = filter.initialise({"observation": np.zeros(2)})
    frame = {"observation": np.array([3.0, np.nan]), "observed": np.array([True, False])}
    given = {key: belief[key].numpy() for key in filter.carry_keys}
    nested = {"belief": {key[-1]: value for key, value in given.items()}}
    expected = belief.copy().update({"observation": torch.tensor([3.0, torch.nan]), "observed": [True, False]})
    out = filter.step({**frame, **nested})
    assert out["observed"].dtype == torch.bool
    close(out, filter.step(expected), [MEAN, COV])


@pytest.mark.parametrize("kind", [EKF, UKF])
@pytest.mark.parametrize("q", [0.0, [0.0, 0.0]])
def test_no_process_noise_is_zero(float64, kind, q):
    F, _, H, R = linear_system()
    parts = (None, LinearObservation(H), ConstantNoise(R.sqrt(), in_key="observation"))
    prior = MomentPrior(torch.zeros(2), torch.eye(2))
    filter = kind(NoisyLinear(F), *parts, process_noise=q, initial=prior, observation_key="observation")
    exact = KalmanFilter(
        F, H, process_noise_cov=torch.zeros(2, 2), noise=R.sqrt(), mean=torch.zeros(2), cov=torch.eye(2)
    )
    frames = TensorDict({"observation": torch.randn(3, 6, 2)}, [3, 6])
    # The sigma points' ridge is 10 eps of the correlations.
    close(filter.sequence(frames.copy()), exact.sequence(frames.copy()), [MEAN, COV], atol=1e-10)
