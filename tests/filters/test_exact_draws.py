"""Oracle: the Kalman filter, which an ensemble with exact draws is on linear systems, whatever was drawn."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torch_denkf.applications.car.modules.unicycle_noise import UnicycleNoise
from torch_denkf.baselines import IEnKS
from torch_denkf.filters import DEnKF, KalmanFilter
from torch_denkf.functional.manifolds import SO3, Circle, Euclidean
from torch_denkf.functional.moments import ensemble_cov
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.imperfect import FadingBias
from torch_denkf.modules import (
    AroundState,
    CholeskyNoise,
    ConstantNoise,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedObservation,
    LearnedTransition,
    MappedNoise,
    NoisyTransition,
    ScaledNoise,
)
from torch_denkf.modules.process_noise import NoiseThrough
from torch_denkf.monitoring import Gated
from torch_denkf.smoothers import FixedLag

E, S, T = 16, 3, 12
Q = torch.tensor([0.3, 0.0, 0.1], dtype=torch.float64)
R = torch.tensor([0.5, 0.2], dtype=torch.float64)
FORECAST = {"in_key": ("belief", "mean"), "out_key": ("forecast", "noise")}


pytestmark = pytest.mark.usefixtures("float64")


def system():
    f = torch.tensor([[0.9, 0.3, 0.0], [-0.3, 0.9, 0.2], [0.0, 0.0, 0.95]])
    return f, torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.5, 1.0]])


def linear(matrix):
    layer = nn.Linear(*matrix.shape[::-1], bias=False)
    layer.weight = nn.Parameter(matrix.clone())
    return layer


def kalman(**kwargs):
    f, h = system()
    prior = {"mean": torch.ones(S), "cov": torch.tensor([1.0, 2.0, 0.5]).square().diag()}
    return KalmanFilter(f, h, process_noise=Q, noise=R, observation_key="reading", **prior, **kwargs)


def frames():
    data = TensorDict({"reading": torch.randn(4, T, 2)}, [4, T])
    data["observed"] = torch.rand(4, T, 2) < 0.7
    data["is_init"] = torch.zeros(4, T, 1, dtype=torch.bool)
    data["is_init"][1, 5] = True
    data["a"], data["b"] = data["reading"].split(1, -1)
    data["a_observed"], data["b_observed"] = data["observed"].split(1, -1)
    return data


def parts(members=E):
    f, h = system()
    transition, observation = LearnedTransition(linear(f - torch.eye(S))), LearnedObservation(linear(h))
    initial = GaussianPrior(torch.ones(S), torch.tensor([1.0, 2.0, 0.5]), ensemble_size=members)
    return (transition, None, observation, ConstantNoise(R, in_key="reading")), {"initial": initial}


def denkf(process_noise, scheme="etkf", **kwargs):
    modules, options = parts()
    analysis = EnsembleAnalysis(scheme, observation_key="reading")
    return DEnKF(*modules, analysis, process_noise=process_noise, **options, **kwargs)


def bias():
    return FadingBias([0.4, 0.7], time=5.0, trainable=False)


def of_two_sensors(process_noise):
    (transition, *_), options = parts(members=24)
    sensors = {
        name: FusedSensor(LearnedObservation(linear(row[None])), r[None], observation_key=name)
        for name, row, r in zip("ab", system()[1], R, strict=True)
    }
    return FusedFilter(transition, sensors, process_noise=process_noise, **options)


def iterated(process_noise, iterations):
    """Shifts the noise in each iteration, so that its mean is not zero."""
    modules, options = parts()
    return IEnKS(*modules, observation_key="reading", process_noise=process_noise, iterations=iterations, **options)


MADE = {
    "etkf": denkf,
    "perturbed": lambda q: denkf(q, "perturbed"),
    "errors of the sensor": lambda q: denkf(q, sensor_error=bias()),
    "two sensors": of_two_sensors,
    "lag": lambda q: FixedLag(denkf(q, "perturbed"), 2),
    "one iteration": lambda q: iterated(q, 1),
    "iterated": lambda q: iterated(q, 3),
}


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("noises", ["of all dimensions", "two noises through a matrix"])
def test_is_the_kalman_filter(name, noises):
    two, data = ConstantNoise(Q[[0, 2]], **FORECAST), frames()
    process_noise = Q if noises == "of all dimensions" else MappedNoise(two, torch.eye(S)[:, [0, 2]])
    out = MADE[name](process_noise).sequence(data.copy())
    oracle = kalman(sensor_error=bias()) if name == "errors of the sensor" else kalman()
    oracle = oracle.sequence(data)
    atol = 1e-8 if name == "errors of the sensor" else 1e-9
    torch.testing.assert_close(out["belief", "mean"], oracle["belief", "mean"], rtol=0, atol=atol)
    torch.testing.assert_close(ensemble_cov(out["belief", "ensemble"]), oracle["belief", "cov"], rtol=0, atol=atol)
    if name in ("etkf", "perturbed"):
        for key in ("nis", "log_likelihood"):
            torch.testing.assert_close(out["info", key], oracle["info", key], rtol=0, atol=10 * atol)


@pytest.mark.parametrize("space", [None, Euclidean(2) * Circle()])
def test_perturbed_members_have_the_covariance_of_the_square_root_filter(space):
    """Draws are uncorrelated with the members and with predictions that are no linear function of them."""
    forecast = torch.randn(5, E, S) if space is None else 0.3 * torch.randn(5, E, S)
    predicted = forecast[..., :2].square() + forecast[..., 1:]
    forecast = forecast if space is None else space.plus(torch.tensor([0.0, 0.0, 3.1]).expand(5, E, S), forecast)
    forecast = {"ensemble": forecast, "observation": predicted}
    td = TensorDict({"forecast": forecast, "reading": torch.ones(5, 2), "sensor": {"noise": R.expand(5, 2)}}, [5])
    out, expected = (
        EnsembleAnalysis(scheme, observation_key="reading", space=space)(td.copy())["belief"]["ensemble"]
        for scheme in ("perturbed", "etkf")
    )
    if space is not None:
        out, expected = (space.minus(members, torch.tensor([0.0, 0.0, 3.1])) for members in (out, expected))
    torch.testing.assert_close(ensemble_cov(out), ensemble_cov(expected), rtol=0, atol=1e-9)


def test_on_a_circle_members_lie_on_both_sides_of_the_turn():
    start = AroundState([0.3], ensemble_size=E, space=Circle())(TensorDict({"state": torch.tensor([3.1])}))
    noise = ConstantNoise([0.2], in_key=("belief", "mean"), out_key=("forecast", "noise"))
    members = NoisyTransition(Still(), noise, space=Circle())(start)["forecast", "ensemble"]
    var = Circle().minus(members, torch.tensor([3.1])).var(-2)
    torch.testing.assert_close(var, torch.tensor([0.13]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("space", [Circle(), SO3()])
def test_a_gate_that_never_acts_changes_no_perturbation(space):
    """Each run of its analysis makes the draws exact for the predictions that are aligned there."""
    dim, start = space.tangent_dim, torch.zeros(space.point_dim).index_fill(0, torch.tensor([0]), 3.0)
    start = space.plus(space.normalise(start), torch.zeros(dim))  # next to the turn of a circle
    filter = DEnKF(
        LearnedTransition(nn.Identity(), residual=False),
        None,
        LearnedObservation(nn.Identity()),
        ConstantNoise([0.3] * dim, in_key="reading"),
        EnsembleAnalysis("perturbed", observation_key="reading", space=space, reading_space=space),
        initial=AroundState([0.2] * dim, ensemble_size=E, space=space),
        process_noise=[0.1] * dim,
    )
    state = space.plus(start.expand(3, 4, -1), 0.1 * torch.randn(3, 4, dim))
    data = TensorDict({"reading": state, "state": state, "observed": torch.rand(3, 4, dim) < 0.7}, [3, 4])
    data = filter.draw_noise(data)
    expected = filter.sequence(data.copy())["belief", "ensemble"]
    out = Gated(filter, dim, rate=0).sequence(data)["belief", "ensemble"]
    torch.testing.assert_close(out, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("hidden", [[False, True], [False, False]])
def test_masked_prediction_does_not_affect_perturbed_observations(hidden):
    """A prediction of NaN where nothing is read, such as the bearing of a landmark that nobody sees."""
    forecast, seen = torch.randn(E, S, requires_grad=True), ~torch.tensor(hidden)
    data = TensorDict({"reading": torch.ones(2), "observed": seen})
    data["sensor", "noise"], data["noise", "self"] = R, torch.randn(E, 2)
    out = []
    for value in (0.0, torch.nan):
        predicted = torch.where(seen, forecast[:, :2], value)
        data["forecast"] = TensorDict({"ensemble": forecast, "observation": predicted}, [])
        members = EnsembleAnalysis("perturbed", observation_key="reading")(data.copy())["belief", "ensemble"]
        out += [members, *torch.autograd.grad(members.square().sum(), forecast)]
    torch.testing.assert_close(out[2:], out[:2])
    assert out[3].isfinite().all()


def test_process_noise_of_some_dimensions_before_and_after_the_motion():
    f, _ = system()
    ensemble = torch.randn(5, E, S)
    td = TensorDict({("belief", "ensemble"): ensemble}, [5])
    noise = ConstantNoise(torch.tensor([0.7]), in_key=("belief", "ensemble"))
    q = torch.zeros(S, S)
    q[2, 2] = 0.49
    moved = ensemble_cov(ensemble)
    for before, expected in ((False, f @ moved @ f.T + q), (True, f @ (moved + q) @ f.T)):
        noisy = NoisyTransition(LearnedTransition(linear(f - torch.eye(S))), noise, [2], before=before)
        out = noisy(td.copy())["forecast", "ensemble"]
        torch.testing.assert_close(ensemble_cov(out), expected, rtol=0, atol=1e-10)
        torch.testing.assert_close(out.mean(-2), ensemble.mean(-2) @ f.T, rtol=0, atol=1e-10)


@pytest.mark.parametrize("kind", ["variances", "covariance"])
@pytest.mark.parametrize("dims", [None, [4, 0, 2, 5]])
@pytest.mark.parametrize("space", [None, Euclidean(7)])
def test_few_noises_of_many_dimensions_need_few_members(kind, dims, space):
    """Draws q = 2 noises of S = 7 states exactly with S + 9/8 q + 3 members."""
    inner = ConstantNoise(torch.tensor([0.3, 2.0]), **FORECAST)
    if kind == "covariance":
        inner = CholeskyNoise(2, r=torch.tensor([0.3, 2.0]), in_features=7, **FORECAST)
    ensemble, enters = torch.randn(5, 12, 7), torch.eye(7) if dims is None else torch.eye(7)[:, dims]
    matrix = torch.randn(enters.shape[1], 2)
    noisy = NoisyTransition(Still(), MappedNoise(inner, matrix), dims, space=space)
    out = noisy(TensorDict({("belief", "ensemble"): ensemble}, [5]))["forecast", "ensemble"]
    added, through = out - ensemble, enters @ matrix
    q = through @ torch.tensor([0.09, 4.0]).diag() @ through.T
    torch.testing.assert_close(ensemble_cov(added), q.expand(5, 7, 7), rtol=0, atol=1e-10)
    assert added.mean(-2).abs().max() < 1e-10
    assert (added.mT @ (ensemble - ensemble.mean(-2, keepdim=True))).abs().max() < 1e-10


def test_few_noises_of_a_car_are_exact_with_few_members():
    """Draws the noises of speed and turn rate through a matrix that depends on the state."""
    noise = UnicycleNoise(ConstantNoise(torch.tensor([0.3, 0.1]), **FORECAST), dt=0.1)
    td = TensorDict({("belief", "ensemble"): torch.randn(3, 10, 5)}, [3])
    added = NoisyTransition(Still(), noise)(td.copy())["forecast", "ensemble"] - td["belief", "ensemble"]
    mean = td["belief", "ensemble"].mean(-2)
    q = noise(TensorDict({"belief": {"mean": mean}, "forecast": {"mean": mean}}, [3]))["forecast", "noise"]
    torch.testing.assert_close(ensemble_cov(added), q, rtol=0, atol=1e-10)
    assert (added.mT @ (td["belief", "ensemble"] - mean.unsqueeze(-2))).abs().max() < 1e-10


class Floored(MappedNoise):
    """Noise through a matrix, and more noise."""

    def on_entries(self, entries, call):
        written, key = super().on_entries(entries, call), self.out_keys[0]
        return {**written, key: written[key] + torch.eye(S)}


class Rolled(NoiseThrough):
    """It does not say how many numbers there are."""

    def _matrix(self, entries):
        return torch.eye(S).roll(1, 0)[:, :2]


@pytest.mark.parametrize("kind", ["floored", "looked at", "rolled", "swapped", "swapped for more"])
def test_noise_that_is_more_than_a_matrix_is_drawn_whole(kind):
    inner, seen = ConstantNoise(torch.tensor([1.0, 2.0]), **FORECAST), []
    noise = {"floored": Floored, "rolled": lambda inner, _: Rolled(inner)}.get(kind, MappedNoise)(
        inner, torch.eye(S, 2)
    )
    noisy, q = NoisyTransition(Still(), noise), torch.tensor([1.0, 4.0, 0.0])
    if kind == "floored":
        q = q + 1
    elif kind == "rolled":
        q = q.roll(1)
    elif kind == "looked at":
        noise.register_forward_hook(lambda module, read, out: seen.append(out["forecast", "noise"]))
    elif kind == "swapped":
        q = Q.square()
        noisy.module["noise"] = ConstantNoise(Q, **FORECAST)
    else:
        q = 9 * q
        noisy.module["noise"] = ScaledNoise(noise, 3.0)
    td = TensorDict({("belief", "ensemble"): torch.randn(5, E, S)}, [5])
    added = noisy(td.copy())["forecast", "ensemble"] - td["belief", "ensemble"]
    torch.testing.assert_close(ensemble_cov(added), q.diag().expand(5, S, S), rtol=0, atol=1e-9)
    assert len(seen) == (kind == "looked at")


def test_a_new_noise_module_gets_the_mean():
    """The old one did not read it, so that it was not worked out."""
    filter = denkf(Q)
    seen = []
    means = TensorDictModule(
        lambda mean: seen.append(mean) or mean.square(), [FORECAST["in_key"]], [FORECAST["out_key"]]
    )
    filter = filter.with_modules({"transition.noise": means})
    td = filter.initialise(TensorDict({"reading": torch.ones(2, 2)}, [2]))
    filter.step(td.copy())
    torch.testing.assert_close(seen[-1], td["belief", "ensemble"].mean(-2))


@pytest.mark.parametrize("space", [Euclidean(1) * Circle(), SO3()])
def test_on_a_space_the_tangents_have_the_moments(space):
    """Members that are spread little: the covariance of the tangents grows by Q, to second order of the spread."""
    std = torch.full((space.tangent_dim,), 1e-3)
    start = AroundState(std, ensemble_size=E, space=space)
    point = space.plus(
        torch.zeros(space.point_dim).index_fill(0, torch.tensor([0]), 1.0), torch.zeros(space.tangent_dim)
    )
    td = start(TensorDict({"state": point}))
    noisy = NoisyTransition(
        Still(), ConstantNoise(2 * std, in_key=("belief", "mean"), out_key=("forecast", "noise")), space=space
    )
    out = noisy(td)["forecast", "ensemble"]
    tangents = space.minus(out, point)
    assert tangents.mean(-2).abs().max() < 1e-6
    torch.testing.assert_close(ensemble_cov(tangents), 5e-6 * torch.eye(len(std)), rtol=0, atol=5e-9)


class Still(nn.Module):
    """A motion that is none."""

    in_keys = [("belief", "ensemble")]  # noqa: RUF012
    out_keys = [("forecast", "ensemble")]  # noqa: RUF012

    def forward(self, td):
        return td.set(("forecast", "ensemble"), td["belief", "ensemble"])


def test_random_draws_are_unchanged():
    td = TensorDict({("belief", "ensemble"): torch.randn(E, S), ("noise", "self"): torch.randn(E, S)})
    noise = ConstantNoise(Q, in_key=("belief", "ensemble"))
    noisy = NoisyTransition(LearnedTransition(nn.Linear(S, S)), noise, draws="random")
    plain = noisy.module["transition"](td.copy())["forecast", "ensemble"]
    out = noisy(td.copy())["forecast", "ensemble"]
    torch.testing.assert_close(out, plain + Q * td["noise", "self"])
    with pytest.raises(ValueError, match="draws"):
        NoisyTransition(LearnedTransition(nn.Linear(S, S)), noise, draws="exactly")


@pytest.mark.parametrize("place", ["initial", "transition"])
def test_noise_of_another_ensemble_raises(place):
    """It was recorded with more members: the belief would have as many."""
    filter, data = denkf(Q), frames()
    data = filter.draw_noise(data)
    data["noise", place] = torch.randn(4, T, E + 1, S)
    with pytest.raises(ValueError, match=rf"{place}.* must be .* = \[4, {'12, ' * (place == 'initial')}16, 3\], got"):
        filter.sequence(data)
