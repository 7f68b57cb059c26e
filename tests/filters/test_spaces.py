"""Filters and smoothers whose state is an orientation: against closed forms, other filters, and a turned world."""

from functools import partial

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tensordict import TensorDict
from torch import nn

from tests.filters.beliefs_for_tests import close
from torch_denkf.baselines import BackpropKF
from torch_denkf.filters import EKF, UKF, DEnKF, ParticleFilter
from torch_denkf.functional.manifolds import SO3, Circle, Euclidean, Product
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


pytestmark = pytest.mark.usefixtures("float64")


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
    """Returns a filter of orientations."""
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
    """Returns true states, gyro, readings of the orientation, some of which are missing, and where a filter starts."""
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
    """Filters data, and the same data in a rotated world."""
    other = data.clone()
    for key in ("start", "pose"):
        other[key] = turned(turn, data[key])
    return filter.sequence(data), filter.sequence(other)


def assert_turned(here, there, turn, atol):
    """Means are turned, and nothing else."""
    for key in [key for key in ("belief", "smoothed") if here.get(key, None) is not None]:
        assert SPACE.minus(there[key, "mean"], turned(turn, here[key, "mean"])).abs().max() < atol
        close(there[key], here[key], ["var"], atol=atol)


# ------------------------------------------------------------------------------------------------------- closed forms


def numpy_ekf(data):
    """Runs an error-state extended Kalman filter with scipy's rotations: means and covariances at each step."""

    def right(v):  # the right Jacobian
        a, k = np.linalg.norm(v), np.cross(np.eye(3), v)
        return np.eye(3) - (1 - np.cos(a)) / a**2 * k + (a - np.sin(a)) / a**3 * k @ k

    gyro, pose, seen, start = (data[key].numpy() for key in ("action", "pose", "observed", "start"))
    read, (q, r) = np.eye(3, 6), (np.diag(np.square(std)) for std in (Q, R))
    turn, bias, p = Rotation.from_quat(np.roll(start[0, :4], -1)), start[0, 4:], np.diag(np.square(STD))
    means, covs = [start[0]], [p]
    for t in range(1, len(gyro)):
        moved = DT * (gyro[t - 1] - bias)
        f = np.eye(6)
        f[:3, :3], f[:3, 3:] = Rotation.from_rotvec(-moved).as_matrix(), -DT * right(moved)
        turn, p = turn * Rotation.from_rotvec(moved), f @ p @ f.T + q
        if seen[t, 0]:
            innovation = (turn.inv() * Rotation.from_quat(np.roll(pose[t], -1))).as_rotvec()
            gain = p @ read.T @ np.linalg.inv(read @ p @ read.T + r)
            step, keep = gain @ innovation, np.eye(6) - gain @ read
            p = keep @ p @ keep.T + gain @ r @ gain.T
            turn, bias = turn * Rotation.from_rotvec(step[:3]), bias + step[3:]
            turned = np.eye(6)
            turned[:3, :3] = right(step[:3])
            p = turned @ p @ turned.T
        means.append(np.concatenate([np.roll(turn.as_quat(), 1), bias]))
        covs.append(p)
    return np.stack(means), np.stack(covs)


def test_ekf_is_that_of_numpy():
    data = log()
    out = make("EKF").sequence(data.clone())
    for run in range(B):
        means, covs = numpy_ekf(data[run])
        away = SPACE.minus(out[MEAN][run], torch.from_numpy(means))
        assert away.abs().max() < 1e-9
        assert (out["belief", "cov"][run] - torch.from_numpy(covs)).abs().max() < 1e-9


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


GAUSSIAN = [partial(FixedLag, lag=3), RTSSmoother]
SMOOTHERS = {"EKF": GAUSSIAN, "UKF": GAUSSIAN, "particles": [partial(FixedLag, lag=3), ParticleSmoother]}
SMOOTHERS["etkf"] = [partial(FixedLag, lag=3), EnRTS, partial(EnKS, lag=4)]


@pytest.mark.parametrize("turn", [[0.0, 0.0, 3.0], [2.0, -1.0, 0.5], [torch.pi, 0.0, 0.0]])
@pytest.mark.parametrize("kind", KINDS)
def test_a_turned_world_turns_the_belief_and_nothing_else(kind, turn):
    """The error is in the body's axes, so that the world's do not count."""
    filter, turn = make(kind), SO3().exp(torch.tensor(turn))
    data = with_noise(filter, log())
    here, there = turned_beliefs(filter, turn, data.clone())
    assert_turned(here, there, turn, 1e-8)
    close(there["info"], here["info"], ["log_likelihood"], atol=1e-8)
    for smoother in SMOOTHERS.get(kind, []) if turn[2] else []:  # of one turn
        assert_turned(*turned_beliefs(smoother(filter), turn, data.clone()), turn, 1e-8)


# ------------------------------------------------------------------------------------------------------ ways to run it


@pytest.mark.parametrize("kind", [*KINDS, "lagged", "gated EKF"])
def test_missing_reading_equals_masked_reading(kind):
    filter = FixedLag(make("EKF"), 2) if kind == "lagged" else make(kind.split()[-1])
    filter = Gated(filter, response="student", window=1, rate=1e-2) if kind == "gated EKF" else filter
    start = filter.initialise(with_noise(filter, log(steps=3))[:, 1].clone())
    start["observed"][:] = False
    out = filter.predict(start.exclude("pose", "observed").copy())
    assert out[MEAN].isfinite().all()
    close(out, filter.step(start.copy()), filter.belief_keys, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_finite_under_masks_and_at_half_a_turn(kind):
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


# -------------------------------------------------------------------------------------------------------- what is told


def test_mismatched_spaces_raise():
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
    parts, drift = (Turning(), None, Orientation(), ConstantNoise(R, in_key="pose")), FadingBias([0.1] * 4, time=10.0)
    known = {"process_noise": [0.1] * 7, "initial": AroundState([0.1] * 7, ensemble_size=E)}
    read, gaussian = {"reading_space": SO3(), "observation_key": "pose"}, GaussianAround([0.1] * 7)
    sensor = FusedSensor(Orientation(), R, reading_space=SO3(), sensor_error=drift)
    for make_one in (
        *(
            partial(filter, *parts, sensor_error=drift, **{**known, "initial": gaussian}, **read)
            for filter in (EKF, UKF)
        ),
        partial(DEnKF, *parts, EnsembleAnalysis("etkf", reading_space=SO3()), sensor_error=drift, **known),
        partial(DEnKF, *parts, sensor_error=drift, **known, **read),
        partial(FusedFilter, Turning(), {"pose": sensor}, **known),
    ):
        with pytest.raises(ValueError, match="sensor_error is added to readings of numbers and angles"):
            make_one()
    on, sensor = (
        partial(EnsembleAnalysis, "etkf", reading_space=SO3()),
        FusedSensor(Orientation(), R, sensor_error=drift),
    )
    with pytest.raises(ValueError, match="not for the analysis of 'pose'"):
        FusedFilter(Turning(), {"pose": sensor}, analysis=on, **known)


# --------------------------------------------------------------------------------------------- several in one update


class Both(SubModel):
    """Reads the orientation and the bias."""

    def __init__(self):
        super().__init__(nn.Identity(), [("forecast", "ensemble")], [("forecast", "observation")])

    def compute(self, state):
        return state


def in_one(kind, lag=None, **options):
    """Returns a joint update of a pose and of numbers; and one update of both, side by side."""
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
