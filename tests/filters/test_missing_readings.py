"""NaN, steps without a frame or without a reading, and systems that nobody observes."""

import warnings

import pytest
import torch
from tensordict import TensorDict

from tests.filters.beliefs_for_tests import BELIEF, ENSEMBLE, MEAN, VAR, close
from tests.filters.factories import (
    NoisyLinear,
    linear_denkf,
    linear_system,
    linear_with,
    parts_of_reading,
    random_draws,
)
from tests.filters.particle_for_tests import bootstrap
from tests.filters.test_several_analyses import reads
from torch_denkf.filters import DEnKF, Filter, KalmanFilter, ParticleFilter
from torch_denkf.modules import ConstantNoise, FromSensor, GaussianPrior, LinearObservation
from torch_denkf.modules.particles import with_weights

LOG_WEIGHT = ("belief", "log_weight")


def test_noise_that_is_given_and_is_not_finite_is_named():
    filter = linear_denkf("perturbed", noisy=True)
    td = filter.draw_noise(filter.initialise(TensorDict({"observation": torch.zeros(2)})))
    td["noise", "transition"][3, 1] = torch.inf
    with pytest.raises(ValueError, match=r"NaN or infinity in \[\('noise', 'transition'\)\]"):
        filter.step(td)


@pytest.mark.parametrize("observed", [None, True])
def test_a_prediction_does_not_resample_and_leaves_the_mask_alone(float64, observed):
    """Keeps particles and weights as they are where there is no frame, whatever the mask of the last frame said."""
    filter, (F, *_) = bootstrap(50, noisy=False), linear_system()
    td = filter.initialise(TensorDict({"observation": torch.randn(2)}))
    td["belief", "log_weight"] = torch.randn(50).log_softmax(-1)
    if observed is not None:
        td["observed"] = torch.tensor([observed])
    out = filter.predict(td.copy())
    close(out, {ENSEMBLE: td[ENSEMBLE] @ F.mT, LOG_WEIGHT: td[LOG_WEIGHT]}, [ENSEMBLE, LOG_WEIGHT], atol=1e-14)
    mask = out.get("observed", None)
    assert mask is None if observed is None else mask.item() is True


def test_only_readings_are_left_out_of_a_prediction(float64):
    F, *_ = linear_system()

    class Wind(NoisyLinear):
        def __init__(self):
            super().__init__(F)
            self.in_keys, self.out_keys = [("forecast", "ensemble"), "wind"], [("forecast", "ensemble")]

        def compute(self, ensemble, wind, *, noise):
            return ensemble + wind.unsqueeze(-2)

    filter = linear_with({"transition": NoisyLinear(F), "wind": Wind()})
    assert filter.structure.readings == ("observation",)
    td = filter.initialise(TensorDict({"wind": torch.tensor([3.0, -1.0])}))
    moved = td[MEAN] @ F.mT + td["wind"]
    close(filter.predict(td), {MEAN: moved}, [MEAN])
    for name in ("analysis", "observed"):  # a mask that is not there hides nothing
        with pytest.raises(KeyError, match="which no module must find"):
            filter.step(td, without=[name])
    with pytest.raises(TypeError, match="list of keys"):
        filter.step(td, without="observation")


def test_one_of_two_sensors_may_be_missing(float64):
    both = reads({**parts_of_reading(0, "forecast", "mid"), **parts_of_reading(1, "mid", "belief")})
    td = both.initialise(TensorDict({"y0": torch.randn(1), "y1": torch.randn(1)}))
    for missing, kept in (("y0", 1), ("y1", 0)):
        expected = reads(parts_of_reading(kept, "forecast", "belief")).step(td.copy())
        close(both.step(td.exclude(missing).copy(), without=[missing]), expected, BELIEF)


@pytest.mark.parametrize("case", ["plain", "weights", "update at reset", "stale"])
def test_a_start_without_the_reading_is_the_prior(float64, case):
    """The belief starts from reading 0 where it is there, from N(mean, std) where it is not; reading 1 is another's."""
    plain = linear_denkf()
    mean, std = torch.tensor([1.0, -2.0]), torch.tensor([0.5, 3.0])
    start = FromSensor([0], mean, std, ensemble_size=7, observation_key="y0", noise_variance_key="r0")
    modules = {"transition": plain["transition"]}
    modules |= parts_of_reading(0, "forecast", "mid", info_prefix="i0")
    modules |= parts_of_reading(1, "mid", "belief", info_prefix="i1")
    if case == "weights":
        particles = dict(bootstrap(7).module.items())
        filter = Filter({**particles, "r0": modules["r0"]}, initial=with_weights(start))
        noise_key = ("noise", "initial.initial")
    else:
        filter = Filter(modules, initial=start, update_at_reset=case == "update at reset")
        noise_key = ("noise", "initial")
    random_draws(filter)
    z, y = torch.randn(7, 2), torch.randn(2)
    given = TensorDict({"y0": y[:1], "y1": y[1:], "observation": y, noise_key: z})
    if case == "stale":
        given = filter.initialise(given)
    expected = mean + std * z
    out = filter.initialise(given if case == "stale" else given.exclude("y0"), without=["y0"])
    if case == "update at reset":  # with the reading that is there
        after = Filter({"transition": plain["transition"], **parts_of_reading(1, "forecast", "belief")}, initial=start)
        forecast = TensorDict({"forecast": {"ensemble": expected}, "y1": y[1:]})
        for name in ("r1", "h1", "a1"):
            forecast = after[name](forecast)
        expected = forecast[ENSEMBLE]
    torch.testing.assert_close(out[ENSEMBLE], expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(out[MEAN], expected.mean(-2), rtol=0, atol=1e-12)
    with pytest.raises(KeyError, match="'y0'"):
        filter.initialise(given.exclude("y0"))
    with pytest.raises(KeyError, match="no module must find"):
        filter.initialise(given, without=["y2"])


@pytest.mark.parametrize("kind", ["ensemble", "Kalman", "particles"])
def test_an_unstable_system_that_nobody_observes_stays_finite_and_comes_back(kind):
    """Without a ceiling it overflows at step 40 in float32: the standard deviation is nine times larger each step."""
    F, one = 9.0 * torch.eye(1), torch.eye(1)
    matrices = {"process_noise_cov": one, "noise_cov": one, "mean": torch.ones(1), "cov": one}
    parts = (NoisyLinear(F, one), None, LinearObservation(one))
    noise, prior = ConstantNoise([1.0], in_key="observation"), GaussianPrior([1.0], [1.0], ensemble_size=64)
    filter = {
        "Kalman": lambda: KalmanFilter(F, one, **matrices),
        "ensemble": lambda: DEnKF(*parts, noise, initial=prior, observation_key="observation"),
        "particles": lambda: ParticleFilter(*parts, noise=noise, initial=prior, observation_key="observation"),
    }[kind]()
    td = filter.initialise(TensorDict({"observation": torch.zeros(1)}))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for _ in range(60):
            td = filter.predict(td)
    assert sum("variance_ceiling" in str(warning.message) for warning in said) == 1
    assert td[MEAN].isfinite().all()
    assert td[VAR] <= 1.001e12
    if kind == "particles":  # a reading that none of the 64 particles explains leaves one of them
        return
    for reading in (3.0 * 9.0**k for k in range(6)):
        td = filter.step(td.set("observation", torch.tensor([reading])))
    assert (td[MEAN] - reading).abs() < 3.0
    assert td[VAR] < 3.0
    loose = KalmanFilter(F, one, **matrices, variance_ceiling=None)
    frames = TensorDict({"observation": torch.zeros(60, 1), "observed": torch.zeros(60, 1, dtype=torch.bool)}, [60])
    assert not loose.sequence(frames)[VAR].isfinite().all()
