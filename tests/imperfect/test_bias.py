"""Oracle: the Kalman filter of the augmented state, by hand, for a linear system with coloured reading errors."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import linear_kalman
from tests.filters.gaussian_for_tests import linear_filter
from torch_denkf.baselines import IEnKS
from torch_denkf.filters import EKF, UKF, DEnKF, KalmanFilter, ParticleFilter
from torch_denkf.imperfect import FadingBias
from torch_denkf.imperfect.bias import BiasedBelief, BiasedNoise, BiasedObservation, BiasedTransition
from torch_denkf.modules import (
    CholeskyNoise,
    ConstantNoise,
    EnsembleAnalysis,
    GaussianAround,
    GaussianPrior,
    LearnedTransition,
    MomentPrior,
    NoisyTransition,
    Select,
)

Q, R, STEPS = 0.02, 0.3, 40  # standard deviations: of the rate in a step, of the reading's white error
STD, TIME = [0.8, 0.5], [3.0, 20.0]  # of a fast bias and a slow one, of the same reading


def motion():
    """Returns a place and its rate."""
    network = torch.nn.Linear(2, 2, bias=False).double()
    network.weight.data = torch.tensor([[1.0, 1.0], [0.0, 1.0]], dtype=torch.double)
    return LearnedTransition(network.requires_grad_(False), residual=False)


def parts():
    bias = FadingBias(torch.tensor(STD, dtype=torch.double), TIME, trainable=False)
    q = ConstantNoise(
        torch.tensor([0.0, Q], dtype=torch.double), in_key=("belief", "mean"), out_key=("forecast", "noise")
    )
    r = ConstantNoise(torch.tensor([R], dtype=torch.double), in_key="reading")
    return bias, BiasedTransition(motion(), bias), BiasedNoise(q, bias), BiasedObservation(Select([0]), bias), r


def simulate(seed=0):
    """Returns true places ``[T]`` and readings ``[T]`` with coloured errors."""
    rng = np.random.default_rng(seed)
    decay = np.exp(-1 / np.array(TIME))
    place, rate, bias, places, readings = 0.0, 0.0, np.array(STD) * rng.normal(size=2), [], []
    for _ in range(STEPS):
        place, rate = place + rate, rate + Q * rng.normal()
        bias = decay * bias + np.array(STD) * np.sqrt(1 - decay**2) * rng.normal(size=2)
        places.append(place)
        readings.append(place + bias.sum() + R * rng.normal())
    return np.array(places), np.array(readings)


def augmented_kalman_filter(readings, start):
    """Returns means ``[T, 4]`` and covariances ``[T, 4, 4]``; the first is the start."""
    decay = np.exp(-1 / np.array(TIME))
    f = np.zeros((4, 4))
    f[:2, :2], f[2:, 2:] = [[1, 1], [0, 1]], np.diag(decay)
    q = np.diag([0, Q**2, *(np.array(STD) ** 2 * (1 - decay**2))])
    h = np.array([[1.0, 0.0, 1.0, 1.0]])
    mean, cov = np.zeros(4), np.diag(np.array(start) ** 2)
    out = [(mean, cov)]
    for reading in readings[1:]:
        mean, cov = f @ mean, f @ cov @ f.T + q
        gain = cov @ h.T / (h @ cov @ h.T + R**2)
        mean, cov = mean + gain[:, 0] * (reading - h @ mean), cov - gain @ h @ cov
        out.append((mean, cov))
    return tuple(map(np.stack, zip(*out, strict=True)))


START = [0.1, 0.1, *STD]


def with_oracle(filter):
    """Returns a filter's belief, and the oracle's means and covariances."""
    readings = simulate()[1]
    out = filter.sequence(TensorDict({"reading": torch.tensor(readings).unsqueeze(-1)}, [STEPS]))
    return out, *map(torch.tensor, augmented_kalman_filter(readings, START))


def test_stationary_variance_and_time_constant():
    bias = FadingBias(torch.tensor([2.0, 0.5]), [4.0, 30.0])
    torch.testing.assert_close(bias.decay**2 * bias.std**2 + bias.variance, bias.std**2)
    torch.testing.assert_close(bias.decay**10, torch.exp(-10 / torch.tensor([4.0, 30.0])))
    very_slow = FadingBias(torch.tensor([1.0]), 1e9)
    torch.testing.assert_close(very_slow.variance, torch.tensor([2e-9]))  # no digits are lost


def test_likelihood_is_maximal_at_the_true_size_and_time():
    """At the true values the slope of the readings' likelihood is zero on average: on many runs it is small."""
    _, transition, q, observation, r = parts()
    bias = FadingBias(torch.tensor(STD, dtype=torch.double), TIME)
    for part in (transition, q, observation):
        part.bias = bias
    initial = GaussianAround([*START[:2], *STD], state_key="state").double()
    filter = EKF(transition, None, observation, r, process_noise=q, initial=initial, observation_key="reading")
    runs = 64
    readings = torch.tensor(np.stack([simulate(seed)[1] for seed in range(runs)])).unsqueeze(-1)
    frames = TensorDict({"reading": readings, "state": torch.zeros(runs, STEPS, 4, dtype=torch.double)}, [runs, STEPS])

    def log_likelihood():
        info = filter.sequence(frames)["info"]
        variance = (info["innovation"].square() / info["nis"]).clamp_min(1e-12)
        return -0.5 * (info["nis"] + variance.log())[:, 1:].sum((1, 2))

    likelihood = log_likelihood()
    each, sizes = torch.eye(runs, dtype=torch.double), [bias.log_std, bias.log_time]
    slopes = torch.cat(torch.autograd.grad(likelihood, sizes, each, is_grads_batched=True), -1)
    assert (slopes.mean(0).abs() < 4 * slopes.std(0) / runs**0.5).all()
    with torch.no_grad():
        bias.log_std += 0.7
    assert log_likelihood().mean() < likelihood.mean()


def test_bias_block_of_the_covariance():
    bias = FadingBias([2.0], time=5.0, trainable=False)
    inner = CholeskyNoise(2, r=[0.1, 1.0], in_features=3, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    q = BiasedNoise(inner, bias)(TensorDict({("belief", "mean"): torch.zeros(4, 3)}, [4]))["forecast", "noise"]
    expected = torch.diag(torch.tensor([0.01, 1.0, 4 * (1 - np.exp(-0.4))], dtype=torch.float))
    torch.testing.assert_close(q, expected.expand(4, 3, 3), atol=1e-6, rtol=1e-5)


def test_each_component_gets_its_biases():
    state = torch.tensor([[1.0, 2.0, 0.1, 0.2, 0.01, 0.02]])
    td = TensorDict({("forecast", "ensemble"): state}, [])
    read = BiasedObservation(Select([0, 1]), FadingBias([1.0] * 4, time=2.0))(td)["forecast", "observation"]
    torch.testing.assert_close(read, torch.tensor([[1.11, 2.22]]))
    read = BiasedObservation(Select([0, 1]), FadingBias([1.0] * 4, time=2.0), dims=[1, 1, 1, 0])(td)
    torch.testing.assert_close(read["forecast", "observation"], torch.tensor([[1.02, 2.31]]))


def test_invalid_arguments_raise():
    with pytest.raises(ValueError, match="time, in steps"):
        FadingBias([1.0], time=0.0)
    with pytest.raises(ValueError, match="2 components of the reading, and there are 1"):
        BiasedObservation(Select([0]), FadingBias([1.0], time=1.0), dims=[0, 0])
    td = TensorDict({("forecast", "ensemble"): torch.zeros(3, 5)}, [])
    with pytest.raises(ValueError, match="not as many for each of the 2"):
        BiasedObservation(Select([0, 1]), FadingBias([1.0] * 3, time=1.0))(td)
    with pytest.raises(ValueError, match="splits a state of 1"):
        BiasedObservation(Select([0]), FadingBias([1.0], time=1.0))(
            TensorDict({("forecast", "ensemble"): torch.zeros(3, 1)}, [])
        )


# --------------------------------------------------------------------------------------------- one option of a filter


def unit(dtype=torch.double):
    return {"mean": torch.zeros(2, dtype=dtype), "std": torch.tensor(START[:2], dtype=dtype)}


def known_bias(**options):
    return FadingBias(torch.tensor(STD, dtype=torch.double), TIME, trainable=False, **options)


@pytest.mark.parametrize("kind", [EKF, UKF, KalmanFilter])
def test_the_option_is_the_augmented_kalman_filter(kind):
    given = unit()
    q = torch.tensor([0.0, Q], dtype=torch.double)
    if kind is KalmanFilter:
        filter = KalmanFilter(
            motion().module.weight,
            torch.eye(1, 2, dtype=torch.double),
            process_noise=q,
            noise=torch.tensor([R], dtype=torch.double),
            mean=given["mean"],
            cov=given["std"].square().diag(),
            sensor_error=known_bias(),
            observation_key="reading",
        )
    else:
        initial = MomentPrior(given["mean"], given["std"].square().diag())
        r = ConstantNoise(torch.tensor([R], dtype=torch.double), in_key="reading")
        options = {"process_noise": q, "initial": initial, "observation_key": "reading", "sensor_error": known_bias()}
        filter = kind(motion(), None, Select([0]), r, **options)
    out, mean, cov = with_oracle(filter)
    torch.testing.assert_close(out["belief", "mean"], mean, atol=1e-9, rtol=1e-7)
    torch.testing.assert_close(out["belief", "cov"], cov, atol=1e-9, rtol=1e-7)


@pytest.mark.parametrize("own", [False, True])
def test_the_option_of_an_ensemble_comes_close_to_it(own):
    """With process noise as an option, and with that of the transition itself."""
    torch.manual_seed(0)
    q, given = torch.tensor([0.0, Q], dtype=torch.double), unit()
    initial = GaussianPrior(given["mean"], given["std"], ensemble_size=20000)
    analysis = EnsembleAnalysis("etkf", observation_key="reading")
    r = ConstantNoise(torch.tensor([R], dtype=torch.double), in_key="reading")
    noise = ConstantNoise(q, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    moves = NoisyTransition(motion(), noise) if own else motion()
    options = {"initial": initial, "sensor_error": known_bias(), "process_noise": None if own else q}
    out, mean, cov = with_oracle(DEnKF(moves, None, Select([0]), r, analysis, **options))
    std = cov.diagonal(dim1=1, dim2=2).sqrt()
    assert ((out["belief", "mean"] - mean).abs() / std).max() < 0.08  # members say it to 0.7 % a step
    assert (out["belief", "var"].sqrt() / std - 1).abs().max() < 0.05


def test_the_option_of_particles_comes_close_to_it():
    torch.manual_seed(0)
    given = unit()
    particles = ParticleFilter(
        motion(),
        None,
        Select([0]),
        noise=ConstantNoise(torch.tensor([R], dtype=torch.double), in_key="reading"),
        initial=GaussianPrior(given["mean"], given["std"], ensemble_size=50000),
        process_noise=torch.tensor([0.0, Q], dtype=torch.double),
        sensor_error=known_bias(),
        observation_key="reading",
    )
    out, mean, cov = with_oracle(particles)
    std = cov.diagonal(dim1=1, dim2=2).sqrt()
    assert ((out["belief", "mean"] - mean).abs() / std).max() < 0.1
    assert (out["belief", "var"].sqrt() / std - 1).abs().max() < 0.1
    moved = particles["transition"]
    with pytest.raises(ValueError, match="motion inside the ResampledTransition"):
        ParticleFilter(moved, None, Select([0]), initial=particles.initial, sensor_error=known_bias())


def test_the_option_of_an_iterated_smoother_is_its_parts():
    bias, moves, q, reads, r = parts()
    initial = GaussianPrior(**unit(), ensemble_size=6)
    rest = {"observation_key": "reading", "noise": r}
    by_hand = IEnKS(moves, None, reads, process_noise=q, initial=BiasedBelief(initial, bias), **rest)
    plain = torch.tensor([0.0, Q], dtype=torch.double)
    option = IEnKS(motion(), None, Select([0]), process_noise=plain, initial=initial, sensor_error=bias, **rest)
    td = by_hand.draw_noise(TensorDict({"reading": torch.randn(2, 5, 1, dtype=torch.double)}, [2, 5]))
    for key in ("ensemble", "mean", "var"):
        torch.testing.assert_close(
            option.sequence(td.clone())["belief", key], by_hand.sequence(td.clone())["belief", key]
        )
    with pytest.raises(TypeError, match="BackpropKF takes no sensor_error"):
        linear_filter("BackpropKF", sensor_error=known_bias())


def test_scale_errors():
    state = torch.tensor([[2.0, 4.0, 0.1, -0.5]])
    td = TensorDict({("forecast", "ensemble"): state}, [])
    read = BiasedObservation(Select([0, 1]), FadingBias([1.0] * 2, time=2.0, factor=True))(td)
    torch.testing.assert_close(read["forecast", "observation"], torch.tensor([[2.2, 2.0]]))
    read = BiasedObservation(Select([0, 1]), FadingBias([1.0] * 2, time=2.0, factor=True), dims=[1, 1])(td)
    torch.testing.assert_close(read["forecast", "observation"], torch.tensor([[2.0, 4 * 0.6]]))
    with pytest.raises(ValueError, match="no factors"):
        linear_kalman(sensor_error=FadingBias([1.0], 1.0, factor=True))


def residuals(runs, steps, *, std=(2.0, 0.5), time=(10.0, 3.0), white=(0.5, 1.0), seed=0):
    """Returns stationary AR(1) noise plus white noise."""
    rng, decay = np.random.default_rng(seed), np.exp(-1 / np.array(time))
    bias, rows = np.array(std) * rng.normal(size=(runs, 2)), []
    for _ in range(steps):
        rows.append(bias + np.array(white) * rng.normal(size=(runs, 2)))
        bias = decay * bias + np.array(std) * np.sqrt(1 - decay**2) * rng.normal(size=(runs, 2))
    return torch.tensor(np.stack(rows, 1))


@pytest.mark.parametrize("gaps", [False, True])
def test_size_and_time_constant_from_residuals(gaps):
    """400 runs of 100 steps hold N T / (2 time) = 2,000 and 6,700 draws of the biases apart from each other: their

    variances are known to sqrt(2 / 2000) = 3 %, standard deviations to 1.6 %, and times, a ratio of two such, to about
    5 %. Allowed are three standard errors; the weak bias has three times its variance in white noise on top of it.
    """
    values = residuals(400, 100)
    if gaps:
        values[torch.rand(400, 100, generator=torch.Generator().manual_seed(0)) < 0.3] = torch.nan
    bias, white = FadingBias.from_residuals(values, trainable=False)
    std, time = bias.std, bias.log_time.exp()
    assert std.tolist() == pytest.approx([2.0, 0.5], rel=0.06)
    assert time[0].item() == pytest.approx(10.0, rel=0.15)
    assert time[1].item() == pytest.approx(3.0, rel=0.2)
    assert white.tolist() == pytest.approx([0.5, 1.0], rel=0.06)


def test_constant_and_fading_biases_together():
    """400 draws of a run's error: its standard deviation is known to 3.5 %; the others as above."""
    values = residuals(400, 100) + torch.tensor(np.random.default_rng(1).normal(size=(400, 1, 2)) * [1.5, 1.0])
    values[0] = torch.nan  # a run without observations
    values[torch.rand(400, 100, generator=torch.Generator().manual_seed(0)) < 0.3] = torch.nan
    bias, white = FadingBias.from_residuals(values, per_run=True)
    assert bias.std.tolist() == pytest.approx([1.5, 1.0, 2.0, 0.5], rel=0.12)
    assert bias.log_time.exp().tolist() == pytest.approx([1e4, 1e4, 10.0, 3.0], rel=0.25)
    assert white.tolist() == pytest.approx([0.5, 1.0], abs=0.15)  # residual of a covariance of 6.5
    one = FadingBias.from_residuals(values)[0]
    assert (one.log_time.exp() > 20).all()  # one time for both kinds fits neither


def test_white_residuals_and_few_raise():
    with pytest.raises(ValueError, match="do not last"):
        FadingBias.from_residuals(torch.randn(50, 100, 1, generator=torch.Generator().manual_seed(1)))
    with pytest.raises(ValueError, match="it takes 100"):
        FadingBias.from_residuals(residuals(2, 20))
    with pytest.raises(ValueError, match=r"\[N, T, K\]"):
        FadingBias.from_residuals(torch.randn(50, 100))
    with pytest.raises(ValueError, match="about ten; got one"):
        FadingBias.from_residuals(residuals(1, 300), per_run=True)
