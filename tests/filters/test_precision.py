"""Mixed precision is refused by name; process noise of zero, in an ensemble, in a replaced network."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.filters.beliefs_for_tests import COV, MEAN, VAR, close
from tests.filters.factories import (
    NoisyLinear,
    linear_system,
)
from tests.filters.gaussian_for_tests import linear_filter
from torch_denkf.applications.car import UnicycleTransition
from torch_denkf.filters import EKF, UKF, DEnKF, KalmanFilter
from torch_denkf.modules import ConstantNoise, GaussianPrior, LinearObservation, MomentPrior, Select


def test_float64_matrices_beside_float32_are_refused():
    F, Q, H, R = linear_system(torch.float64)
    with pytest.raises(TypeError, match=r"mean is torch.float32 and transition is torch.float64; convert one"):
        KalmanFilter(F, H, process_noise_cov=Q, noise=R.sqrt(), mean=torch.zeros(2), cov=torch.eye(2))
    kf = KalmanFilter(
        F, H, process_noise_cov=Q, noise=R.sqrt(), mean=torch.zeros(2).double(), cov=torch.eye(2).double()
    )
    frames = TensorDict({"observation": torch.randn(5, 2, dtype=torch.float64)}, [5])
    assert kf.sequence(frames)[MEAN].dtype == torch.float64


def test_float64_readings_are_refused_by_name():
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


def test_process_noise_is_a_part_of_an_ensemble_filter(float64):
    torch.manual_seed(0)
    F, Q, H, R = linear_system()
    parts = (None, LinearObservation(H), ConstantNoise(R.sqrt(), in_key="observation"))
    kalman = KalmanFilter(
        F, H, process_noise_cov=torch.diag(Q.diagonal()), noise=R.sqrt(), mean=torch.zeros(2), cov=torch.eye(2)
    )
    prior = GaussianPrior(torch.zeros(2), torch.ones(2), ensemble_size=20_000)
    filter = DEnKF(
        NoisyLinear(F), *parts, initial=prior, observation_key="observation", process_noise=Q.diagonal().sqrt()
    )
    frames = TensorDict({"observation": torch.randn(8, 2)}, [8])
    exact, out = kalman.sequence(frames.copy()), filter.sequence(frames.copy())
    torch.testing.assert_close(out[MEAN], exact[MEAN], rtol=0, atol=0.05)  # 5 standard errors of 20,000 members
    torch.testing.assert_close(out[VAR], exact[VAR], rtol=0.06, atol=0)
    collapsed = DEnKF(NoisyLinear(F), *parts, initial=prior, observation_key="observation").sequence(frames.copy())
    assert (collapsed[VAR][-1] < 0.3 * exact[VAR][-1]).all()


@pytest.mark.parametrize("value", [0.1, torch.tensor(0.1), np.float32(0.1)])
def test_a_number_in_a_dictionary_is_an_entry_of_one(value):
    filter = DEnKF(
        UnicycleTransition(torch.zeros_like, dt="seconds"),
        None,
        Select([3, 4]),
        ConstantNoise([0.3, 0.05], in_key="reading"),
        initial=GaussianPrior([0.0, 0.0, 0.0, 1.0, 0.0], [0.0] * 5, ensemble_size=4),
        observation_key="reading",
    )
    belief = filter.initialise({}).update({"reading": torch.tensor([1.0, 0.0])})
    out = filter.predict({"seconds": value, "belief": belief["belief"]})
    torch.testing.assert_close(out["belief", "mean"], torch.tensor([0.1, 0.0, 0.0, 1.0, 0.0]))
    assert out["seconds"].shape == (1,)
