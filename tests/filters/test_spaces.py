"""Filters and smoothers whose state is an orientation: against closed forms, other filters, and a turned world."""

from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.beliefs_for_tests import close
from torch_denkf.baselines import BackpropKF
from torch_denkf.filters import EKF, UKF, DEnKF, ParticleFilter
from torch_denkf.functional.manifolds import SO3, Circle, Euclidean, Opposite, Product
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.imperfect import FadingBias
from torch_denkf.modules import (
    AroundState,
    ConstantNoise,
    EnsembleAnalysis,
    GaussianAround,
    LearnedTransition,
    MomentPrior,
    Select,
    SubModel,
    UKFTransition,
)
from torch_denkf.monitoring import Gated
from torch_denkf.smoothers import EnKS, EnRTS, FixedLag, ParticleSmoother, RTSSmoother

B, T, E, DT = 3, 12, 24, 0.1
SPACE = Product(SO3(), Euclidean(3))  # orientation, and a gyro's bias in rad/s
STD, Q, R = [0.2] * 3 + [0.1] * 3, [0.02] * 3 + [0.01] * 3, [0.1] * 3  # standard deviations of tangents
MEAN, VAR = ("belief", "mean"), ("belief", "var")
KINDS = ("EKF", "UKF", "perturbed", "etkf", "significance", "fused", "gated", "particles")


@pytest.fixture(autouse=True)
def _double(float64):
    return


class Turning(SubModel):
    """Turns by what a gyro reads, less its bias."""

    def __init__(self):
        super().__init__(nn.Identity(), [("belief", "ensemble"), "action"], [("forecast", "ensemble")])

    def compute(self, state, gyro):
        orientation, bias = state.split([4, 3], -1)
        return torch.cat([SO3().plus(orientation, DT * (gyro.unsqueeze(-2) - bias)), bias], -1)


class Orientation(SubModel):
    """Reads the orientation."""

    def __init__(self, in_key=("forecast", "ensemble"), out_key=("forecast", "observation")):
        super().__init__(nn.Identity(), [in_key], [out_key])

    def compute(self, state):
        return state[..., :4]


def make(kind, members=E, **options):
    """A filter of orientations."""
    parts = (Turning(), None, Orientation(), ConstantNoise(R, in_key="pose"))
    known = {"process_noise": Q, "observation_key": "pose", "reading_space": SO3(), **options}
    around = AroundState(STD, ensemble_size=200 if kind == "particles" else members, state_key="start", space=SPACE)
    if kind in ("EKF", "UKF"):
        filter = {"EKF": EKF, "UKF": UKF}[kind]
        return filter(*parts, initial=GaussianAround(STD, state_key="start", space=SPACE), **known)
    if kind == "particles":
        return ParticleFilter(*parts[:3], noise=parts[3], initial=around, **known)
    if kind == "fused":
        sensor = FusedSensor(Orientation(), R, reading_space=SO3(), observed_key="observed")
        return FusedFilter(Turning(), {"pose": sensor}, initial=around, process_noise=Q, **options)
    if kind == "gated":
        return Gated(make("etkf", **options), response="student", window=1, rate=1e-2)
    del known["observation_key"], known["reading_space"]
    more = {"localisation": "significance", "threshold": 1.0} if kind == "significance" else {}
    scheme = "etkf" if kind == "significance" else kind
    analysis = EnsembleAnalysis(scheme, space=SPACE, reading_space=SO3(), observation_key="pose", **more)
    return DEnKF(*parts, analysis, initial=around, **known)


def log(steps=T, seed=0, hidden=True):
    """True states, gyro, readings of the orientation, some of which are missing, and where a filter starts."""
    torch.manual_seed(seed)
    rates, turns, biases = torch.randn(B, steps, 3), [SO3().exp(2 * torch.randn(B, 3))], [0.1 * torch.randn(B, 3)]
    for t in range(steps - 1):
        turns.append(SO3().plus(SO3().plus(turns[-1], DT * rates[:, t]), Q[0] * torch.randn(B, 3)))
        biases.append(biases[-1] + Q[3] * torch.randn(B, 3))
    turns, biases = torch.stack(turns, 1), torch.stack(biases, 1)
    data = TensorDict({"state": torch.cat([turns, biases], -1), "action": rates + biases}, [B, steps])
    data["pose"] = SO3().plus(turns, R[0] * torch.randn(B, steps, 3))
    start = SPACE.plus(data["state"][:, 0], torch.tensor(STD) * torch.randn(B, 6))
    data["start"] = start.unsqueeze(1).expand(B, steps, 7).contiguous()
    data["observed"] = torch.ones(B, steps, 1, dtype=torch.bool)
    if hidden:
        data["observed"][:, 3:5] = False
        data["pose"][:, 3:5] = torch.nan
    return data


def with_noise(filter, data):
    torch.manual_seed(1)
    return filter.draw_noise(data.clone())


def turned(turn, value):
    """Orientations in a world that is turned, with whatever stands behind them."""
    return torch.cat([SO3().compose(turn.expand_as(value[..., :4]), value[..., :4]), value[..., 4:]], -1)


def turned_beliefs(filter, turn, data):
    """Filters data, and the same data in a world that is turned."""
    other = data.clone()
    for key in ("start", "pose"):
        other[key] = turned(turn, data[key])
    return filter.sequence(data), filter.sequence(other)


def assert_turned(here, there, turn, atol):
    """Means are turned, and nothing else."""
    for key in ("belief", "smoothed"):
        assert SPACE.minus(there[key, "mean"], turned(turn, here[key, "mean"])).abs().max() < atol
        close(there[key], here[key], ["var"], atol=atol)


# ------------------------------------------------------------------------------------------------------- closed forms


def numpy_ekf(data):
    """An error-state extended Kalman filter of one run, in numpy: means and covariances at each step."""

    def product(a, b):
        w = a[0] * b[0] - a[1:] @ b[1:]
        return np.concatenate([[w], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])

    def exp(v):
        angle = np.linalg.norm(v)
        return np.concatenate([[np.cos(angle / 2)], np.sinc(angle / 2 / np.pi) / 2 * v])

    def matrix_log(q):
        q = q if q[0] > 0 else -q
        size = np.linalg.norm(q[1:])
        return 2 * np.arctan2(size, q[0]) * (q[1:] / size if size > 0 else q[1:])

    def skew(v):
        return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])

    def right(v):  # the right Jacobian
        a, k = np.linalg.norm(v), skew(v)
        return np.eye(3) - (1 - np.cos(a)) / a**2 * k + (a - np.sin(a)) / a**3 * k @ k

    gyro, pose, seen = (data[key].numpy() for key in ("action", "pose", "observed"))
    x, p = data["start"][0].numpy().copy(), np.diag(np.square(STD))
    means, covs = [x], [p]
    for t in range(1, len(gyro)):
        d = DT * (gyro[t - 1] - x[4:])
        f = np.eye(6)
        f[:3, :3], f[:3, 3:] = np.linalg.inv(exp_matrix(d)), -DT * right(d)
        x = np.concatenate([product(x[:4], exp(d)), x[4:]])
        p = f @ p @ f.T + np.diag(np.square(Q))
        if seen[t, 0]:
            back = x[:4] * np.array([1, -1, -1, -1])
            innovation = matrix_log(product(back, pose[t]))
            gain = p[:, :3] @ np.linalg.inv(p[:3, :3] + np.diag(np.square(R)))
            step = gain @ innovation
            keep = np.eye(6)
            keep[:, :3] -= gain
            p = keep @ p @ keep.T + gain @ np.diag(np.square(R)) @ gain.T
            x = np.concatenate([product(x[:4], exp(step[:3])), x[4:] + step[3:]])
            turn = np.eye(6)
            turn[:3, :3] = right(step[:3])
            p = turn @ p @ turn.T
        means.append(x)
        covs.append(p)
    return np.stack(means), np.stack(covs)


def exp_matrix(v):
    """The rotation matrix of a rotation vector, by the matrix exponential's series."""
    k = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    out, term = np.eye(3), np.eye(3)
    for n in range(1, 30):
        term = term @ k / n
        out = out + term
    return out


def test_ekf_is_that_of_numpy():
    data = log()
    out = make("EKF").sequence(data.clone())
    for run in range(B):
        means, covs = numpy_ekf(data[run])
        away = SPACE.minus(out[MEAN][run], torch.from_numpy(means))
        assert away.abs().max() < 1e-9
        assert (out["belief", "cov"][run] - torch.from_numpy(covs)).abs().max() < 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_small_angles_are_plain_numbers(kind):
    """With all angles a thousandth, products of two are a millionth: what plain filters of numbers leave out."""
    small, size = 1e-3, 6
    torch.manual_seed(0)
    move = torch.eye(6)
    move[:3, 3:] = -DT * torch.eye(3)
    std, q, r = (small * torch.tensor(value) for value in (STD, Q, R))
    tangents = small * torch.randn(B, T, 3)
    pose = torch.cat([SO3().exp(tangents)], -1)
    data = TensorDict({"pose": pose, "action": torch.zeros(B, T, 3), "start": torch.zeros(B, T, 7)}, [B, T])
    data["start"][..., 0] = 1.0
    data["observed"] = torch.ones(B, T, 1, dtype=torch.bool)
    flat = TensorDict({"pose": tangents, "start": torch.zeros(B, T, size), "observed": data["observed"]}, [B, T])
    still = nn.Linear(6, 6, bias=False)
    still.weight.data = move
    noise = ConstantNoise(r, in_key="pose")
    options = {"process_noise": q, "observation_key": "pose"}
    parts = (LearnedTransition(still, residual=False), None, Select([0, 1, 2]), noise)
    own = (Turning(), None, Orientation(), noise)
    if kind in ("EKF", "UKF"):
        filter = {"EKF": EKF, "UKF": UKF}[kind]
        on_space = filter(
            *own, initial=GaussianAround(std, state_key="start", space=SPACE), reading_space=SO3(), **options
        )
        plain = filter(*parts, initial=GaussianAround(std, state_key="start"), **options)
    else:
        priors = [AroundState(std, ensemble_size=E, state_key="start", space=space) for space in (SPACE, None)]
        if kind == "particles":
            on_space = ParticleFilter(
                *own[:3], noise=noise, initial=priors[0], reading_space=SO3(), resampling=None, **options
            )
            plain = ParticleFilter(*parts[:3], noise=noise, initial=priors[1], resampling=None, **options)
        elif kind in ("fused", "gated"):
            pytest.skip("made of the same analyses")
        else:
            more = {"localisation": "significance", "threshold": 1.0} if kind == "significance" else {}
            scheme = "etkf" if kind == "significance" else kind
            del options["observation_key"]
            spaces = ({"space": SPACE, "reading_space": SO3()}, {})
            on_space, plain = (
                DEnKF(*of, EnsembleAnalysis(scheme, observation_key="pose", **more, **where), initial=prior, **options)
                for of, where, prior in zip((own, parts), spaces, priors, strict=True)
            )
    noises = plain.draw_noise(flat.clone())
    if noises.get("noise", None) is not None:
        data["noise"] = noises["noise"]
    out, expected = on_space.sequence(data), plain.sequence(noises)
    away = SPACE.minus(out[MEAN], data["start"])
    assert (away - expected[MEAN]).abs().max() < 1e-2 * small
    # Weights of particles that are never resampled multiply such errors up over all readings.
    assert (out[VAR] / expected[VAR] - 1).abs().max() < (0.05 if kind == "particles" else 0.01)


def test_a_circle_is_an_angle():
    data = TensorDict({"pose": 3 + torch.randn(B, T, 2), "start": torch.full((B, T, 2), 3.0)}, [B, T])
    parts = (
        LearnedTransition(nn.Identity(), residual=False),
        None,
        Select([0, 1]),
        ConstantNoise([0.3, 0.4], in_key="pose"),
    )
    start = GaussianAround([0.5, 0.6], state_key="start")
    wraps = Product(Circle(), Euclidean(1))
    for filter in (EKF, UKF):
        options = {"process_noise": [0.1, 0.2], "observation_key": "pose", "initial": start}
        one = filter(*parts, reading_space=wraps, **options).sequence(data.clone())
        other = filter(*parts, reading_space=Opposite(wraps), **options).sequence(data.clone())  # not in closed form
        close(one, other, [MEAN, ("belief", "cov"), ("info", "nis")])
    around = AroundState([0.5, 0.6], ensemble_size=E, state_key="start")
    options = {"process_noise": [0.1, 0.2], "initial": around}
    one, other = (
        DEnKF(*parts, EnsembleAnalysis("etkf", observation_key="pose", **told), **options)
        for told in ({"reading_space": wraps}, {"reading_space": Opposite(wraps)})
    )
    noisy = with_noise(one, data)
    close(one.sequence(noisy.clone()), other.sequence(noisy.clone()), [MEAN, VAR, ("info", "nis")])


def test_particles_on_a_circle_are_a_grids():
    """A belief that is spread over the circle: the grid's mean direction, to the error of so many particles."""
    spread, noise, members = 1.2, 0.8, 40_000
    grid = torch.linspace(-torch.pi, torch.pi, 2001)[:-1]
    start, reading = torch.tensor([3.0]), torch.tensor([-2.0])

    def density(center, std):
        turns = torch.arange(-3, 4) * 2 * torch.pi
        return torch.exp(-0.5 * ((grid.unsqueeze(-1) - center + turns) / std) ** 2).sum(-1)

    away = Circle().minus(reading.expand(2000, 1), grid.unsqueeze(-1)).squeeze(-1)
    posterior = density(start, spread) * torch.exp(-0.5 * (away / noise) ** 2)
    posterior = posterior / posterior.sum()
    expected = Circle().mean(grid.unsqueeze(-1), posterior)
    variance = (posterior * Circle().minus(grid.unsqueeze(-1), expected.expand(2000, 1)).squeeze(-1) ** 2).sum()
    filter = ParticleFilter(
        LearnedTransition(nn.Identity(), residual=False),
        None,
        Select([0]),
        noise=ConstantNoise([noise], in_key="pose"),
        initial=AroundState([spread], ensemble_size=members, state_key="start", space=Circle()),
        observation_key="pose",
        reading_space=Circle(),
        update_at_reset=True,
    )
    torch.manual_seed(0)
    out = filter.initialise(TensorDict({"start": start, "pose": reading}))
    assert Circle().distance(out[MEAN], expected) < 4 * (variance / members).sqrt()
    assert (out[VAR] / variance - 1).abs() < 0.05


# ------------------------------------------------------------------------------------------------------ turned worlds


@pytest.mark.parametrize("turn", [[0.0, 0.0, 3.0], [2.0, -1.0, 0.5], [torch.pi, 0.0, 0.0]])
@pytest.mark.parametrize("kind", KINDS)
def test_a_turned_world_turns_the_belief_and_nothing_else(kind, turn):
    """The error is in the body's axes, so that the world's do not count."""
    filter, data, turn = make(kind), log(), SO3().exp(torch.tensor(turn))
    data = with_noise(filter, data)
    other = data.clone()
    for key in ("start", "pose"):
        other[key] = turned(turn, data[key])
    here, there = filter.sequence(data), filter.sequence(other)
    away = SPACE.minus(there[MEAN], turned(turn, here[MEAN]))
    assert away.abs().max() < 1e-9
    close(there, here, [VAR, ("info", "log_likelihood")], atol=1e-8)


@pytest.mark.parametrize("kind", ["EKF", "UKF", "etkf", "particles"])
def test_a_turned_world_turns_what_is_smoothed(kind):
    filter, data, turn = make(kind), log(), SO3().exp(torch.tensor([2.0, -1.0, 0.5]))
    smoothers = [FixedLag(filter, lag=3)] + ([RTSSmoother(filter)] if kind in ("EKF", "UKF") else [])
    smoothers += [EnRTS(filter), EnKS(filter, lag=4)] if kind == "etkf" else []
    smoothers += [ParticleSmoother(filter)] if kind == "particles" else []
    data = with_noise(filter, data)
    other = data.clone()
    for key in ("start", "pose"):
        other[key] = turned(turn, data[key])
    for smoother in smoothers:
        here, there = smoother.sequence(data.clone()), smoother.sequence(other.clone())
        away = SPACE.minus(there["smoothed", "mean"], turned(turn, here["smoothed", "mean"]))
        assert away.abs().max() < 1e-8
        close(there, here, [("smoothed", "var")], atol=1e-8)


# ------------------------------------------------------------------------------------------------------ ways to run it


@pytest.mark.parametrize("kind", [*KINDS, "lagged", "gated EKF"])
def test_a_reading_that_is_missing_is_one_that_is_hidden(kind):
    filter = FixedLag(make("EKF"), 2) if kind == "lagged" else make(kind.split()[-1])
    filter = Gated(filter, response="student", window=1, rate=1e-2) if kind == "gated EKF" else filter
    start = filter.initialise(with_noise(filter, log(steps=3))[:, 1].clone())
    start["observed"][:] = False
    out = filter.predict(start.exclude("pose", "observed").copy())
    assert out[MEAN].isfinite().all()
    close(out, filter.step(start.copy()), filter.belief_keys, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_finite_also_behind_masks_and_half_a_turn_away(kind):
    filter, data = make(kind), log()
    data["pose"][0, 6] = SO3().plus(data["pose"][0, 5], torch.tensor([torch.pi, 0.0, 0.0]))
    data["start"].requires_grad_()
    data["pose"].requires_grad_()
    torch.manual_seed(0)
    out = filter.sequence(data.clone())
    loss = SPACE.minus(out[MEAN], data["state"]).square().sum() + out[VAR].sum()
    loss.backward()
    assert data["start"].grad.isfinite().all()
    assert data["pose"].grad.isfinite().all()


# -------------------------------------------------------------------------------------------------- what it is good for


def test_errors_are_as_large_as_they_say_and_smoothers_are_better():
    data = log(steps=150, seed=2, hidden=False)
    filters = {kind: make(kind, members=100) for kind in ("EKF", "UKF", "etkf")}  # an ensemble that is large enough
    errors = {}
    for kind, filter in filters.items():
        smoother = EnRTS(filter) if kind == "etkf" else RTSSmoother(filter)
        torch.manual_seed(0)
        out = smoother.sequence(data.clone())
        for key in ("belief", "smoothed"):
            error = SPACE.minus(out[key, "mean"], data["state"])[:, 10:]
            errors[kind, key] = error[..., :3].square().sum(-1).mean().sqrt()
            # Six numbers, whose errors last about ten steps: 3 x 14 of them, a standard error of a tenth.
            assert 0.6 < (error.square() / out[key, "var"][:, 10:]).mean() < 1.6
        assert errors[kind, "smoothed"] < 0.9 * errors[kind, "belief"]
    assert abs(errors["UKF", "belief"] / errors["EKF", "belief"] - 1) < 0.02
    assert abs(errors["etkf", "belief"] / errors["EKF", "belief"] - 1) < 0.15


# -------------------------------------------------------------------------------------------------------- what is told


def test_what_does_not_fit_is_refused():
    with pytest.raises(TypeError, match=r"space is a Space, such as SO3\(\)"):
        AroundState([0.1] * 3, space="SO3")
    with pytest.raises(ValueError, match=r"tangent has shape \[4\]; a tangent of SO3\(\) is \[\*, 3\]"):
        AroundState([0.1] * 4, space=SO3())
    with pytest.raises(ValueError, match=r"mean has shape \[3\]; a point of SO3\(\) is \[\*, 4\]"):
        MomentPrior(torch.zeros(3), torch.eye(3), space=SO3())
    matrices = (torch.eye(7), None, torch.eye(4, 7), ConstantNoise([0.1] * 4, in_key="pose"))
    start = GaussianAround(STD, state_key="start", space=SPACE)
    with pytest.raises(ValueError, match="Give the same sensor and noise to an EKF"):
        BackpropKF(*matrices, process_noise_cov=torch.eye(7), initial=start, observation_key="pose")
    with pytest.raises(ValueError, match="put the biases into the state"):
        make("EKF", sensor_error=FadingBias([0.1], time=10.0))
    parts = (Turning(), None, Orientation(), ConstantNoise(R, in_key="pose"))
    plain = {"process_noise": [0.1] * 7, "sensor_error": FadingBias([0.1] * 4, time=10.0)}
    error, around = "sensor_error is added to readings of numbers and angles", AroundState([0.1] * 7, ensemble_size=E)
    for filter in (EKF, UKF):
        with pytest.raises(ValueError, match=error):
            filter(*parts, initial=GaussianAround([0.1] * 7), reading_space=SO3(), observation_key="pose", **plain)
    with pytest.raises(ValueError, match=error):
        DEnKF(*parts, EnsembleAnalysis("etkf", reading_space=SO3()), initial=around, **plain)
    with pytest.raises(ValueError, match=error):
        DEnKF(*parts, initial=around, reading_space=SO3(), observation_key="pose", **plain)
    on = partial(EnsembleAnalysis, "etkf", reading_space=SO3())
    sensor = FusedSensor(Orientation(), R, sensor_error=plain["sensor_error"])
    with pytest.raises(ValueError, match="not for the analysis of 'pose'"):
        FusedFilter(Turning(), {"pose": sensor}, initial=around, process_noise=[0.1] * 7, analysis=on)
    sensor = FusedSensor(Orientation(), R, reading_space=SO3(), sensor_error=plain["sensor_error"])
    with pytest.raises(ValueError, match=error):
        FusedFilter(Turning(), {"pose": sensor}, initial=around, process_noise=[0.1] * 7)


# --------------------------------------------------------------------------------------------- several in one update


class Both(SubModel):
    """Reads the orientation and the bias."""

    def __init__(self):
        super().__init__(nn.Identity(), [("forecast", "ensemble")], [("forecast", "observation")])

    def compute(self, state):
        return state


def in_one(kind, lag=None, **options):
    """A joint update of a pose and of numbers; and one update of both, side by side."""
    around = AroundState(STD, ensemble_size=E, state_key="start", space=SPACE)
    initial = GaussianAround(STD, state_key="start", space=SPACE) if kind in ("EKF", "UKF") else around
    sensors = {
        "pose": FusedSensor(Orientation(), R, reading_space=SO3()),
        "bias": FusedSensor(Select([4, 5, 6]), [0.2] * 3),
    }
    q = ConstantNoise(Q, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    motion = UKFTransition(Turning(), q, space=SPACE) if kind == "UKF" else Turning()
    noise = {} if kind == "UKF" else {"process_noise": Q}
    joint = FusedFilter(motion, sensors, initial=initial, joint=True, lag=lag, **noise, **options)
    whole = {"EKF": EKF, "UKF": UKF}.get(kind, DEnKF)
    parts = [Turning(), None, Both(), ConstantNoise([*R, *[0.2] * 3], in_key="both")]
    if whole is DEnKF:
        parts.append(EnsembleAnalysis("etkf", space=SPACE, reading_space=SPACE, observation_key="both"))
        return joint, DEnKF(*parts, initial=initial, process_noise=Q)
    return joint, whole(*parts, initial=initial, process_noise=Q, observation_key="both", reading_space=SPACE)


@pytest.mark.parametrize("lag", [None, 2])
@pytest.mark.parametrize("kind", ["EKF", "UKF", "DEnKF"])
def test_a_pose_and_numbers_in_one_update(kind, lag):
    joint, whole = in_one(kind, lag)
    data = log(hidden=False)
    data["bias"] = data["state"][..., 4:] + 0.2 * torch.randn(B, T, 3)
    data["both"] = torch.cat([data["pose"], data["bias"]], -1)
    data["observed"] = torch.ones(B, T, 6, dtype=torch.bool)
    data["pose_observed"] = torch.rand(B, T, 1) < 0.7
    data["observed"][..., :3] = data["pose_observed"]
    data["pose"] = torch.where(data["pose_observed"], data["pose"], torch.nan)
    data = with_noise(whole, data)
    out, expected = joint.sequence(data.clone()), whole.sequence(data.clone())
    assert SPACE.minus(out[MEAN], expected[MEAN]).abs().max() < 1e-9
    assert (out[VAR] - expected[VAR]).abs().max() < 1e-9
    for name in ("nis", "log_likelihood"):
        torch.testing.assert_close(out["info", name], expected["info", name], rtol=0, atol=1e-8)
