"""Several sensors in one filter: one Kalman filter of all readings in their order is the oracle."""

import copy
import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from scipy.linalg import block_diag
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn
from torch.testing import assert_close

from tests.filters.factories import FixedEnsemble, NoisyLinear, linear_kalman, linear_system
from tests.filters.gaussian_for_tests import directional_check
from torch_denkf.filters import EKF, DEnKF, KalmanFilter
from torch_denkf.functional import wrap_angles
from torch_denkf.functional.manifolds import Circle, Euclidean
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.fusion.parts import JoinedReading
from torch_denkf.imperfect import FadingBias
from torch_denkf.modules import (
    CholeskyNoise,
    ConstantNoise,
    DiagonalNoise,
    EKFAnalysis,
    EKFTransition,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedObservation,
    LearnedTransition,
    LinearObservation,
    LinearTransition,
    MappedNoise,
    MomentPrior,
    Select,
    StochasticMLP,
    UKFAnalysis,
    UKFTransition,
    VectorSensor,
)
from torch_denkf.monitoring import BlackIsMissing
from torch_denkf.smoothers import FixedLag

B, T, DELAY = 3, 11, 3
BELIEF = [("belief", "mean"), ("belief", "cov")]
KINDS = ("Kalman", "EKF", "UKF")


def known_noise():
    unit = ConstantNoise([1.0, 1.0], in_key=("belief", "mean"), out_key=("forecast", "noise"))
    return MappedNoise(unit, torch.linalg.cholesky(linear_system()[1]))


def sensors(**second):
    """Returns the two components of the linear system's reading, as two sensors."""
    _, _, H, R = linear_system()
    return {
        "first": FusedSensor(LinearObservation(H[:1]), R[:1].sqrt()),
        "second": FusedSensor(LinearObservation(H[1:]), R[1:].sqrt(), **second),
    }


def fused(kind, *, joint=False, lag=None, members=None, noisy=True, analysis=None, **second):
    F, Q, _, _ = linear_system()
    options = {"joint": joint, "lag": lag, "analysis": analysis}
    if kind == "ensemble":
        motion = NoisyLinear(F, torch.linalg.cholesky(Q) if noisy else None)
        return FusedFilter(motion, sensors(**second), initial=FixedEnsemble(members), **options)
    motion = LinearTransition(F, Q)
    if kind != "Kalman":
        motion = {"EKF": EKFTransition, "UKF": UKFTransition}[kind](NoisyLinear(F), known_noise())
    initial = MomentPrior(torch.tensor([1.0, -1.0]), torch.diag(torch.tensor([1.0, 2.0])))
    return FusedFilter(motion, sensors(**second), initial=initial, **options)


def readings():
    """Returns readings of both sensors in their order, and masks; the first frame, which no update sees, hides all."""
    torch.manual_seed(0)
    y = torch.randn(B, T, 2)
    frames = TensorDict({"first": y[..., :1], "second": y[..., 1:]}, [B, T])
    for name in ("first", "second"):
        frames[f"{name}_observed"] = torch.rand(B, T, 1) < 0.7
        frames[f"{name}_observed"][:, 0] = False
    frames["is_init"] = torch.zeros(B, T, 1, dtype=torch.bool)
    frames["is_init"][:, 0] = True
    return frames


def as_kalman(frames):
    """Returns the frames for one Kalman filter of both sensors."""
    out = frames.select("is_init")
    out["observation"] = torch.cat([frames["first"], frames["second"]], -1)
    out["observed"] = torch.cat([frames["first_observed"], frames["second_observed"]], -1)
    return out


def arriving(frames, late):
    """Returns the second sensor's readings when they arrive: at t comes that of t - late[t]."""
    index = torch.arange(T) - late
    out = frames.copy()
    for key in ("second", "second_observed"):
        out[key] = frames[key][:, index.clamp(min=0)]
    out["second_observed"] = out["second_observed"] & (index >= 0).unsqueeze(-1)
    out["late"] = late.reshape(1, T, 1).expand(B, T, 1)
    return out


def arrived(frames, late, now):
    """Returns the readings in their order, as far as they have arrived at ``now``."""
    out = frames[:, : now + 1].copy()
    times = torch.arange(T) - late
    known = torch.isin(torch.arange(now + 1), times[: now + 1])
    out["second_observed"] = out["second_observed"] & known.unsqueeze(-1)
    return out


@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_in_turn_and_joint_are_one_kalman_filter(float64, kind, joint):
    frames = readings()
    expected = linear_kalman().sequence(as_kalman(frames))
    out = fused(kind, joint=joint).sequence(frames.copy())
    for key in (*BELIEF, ("info", "log_likelihood"), ("info", "nis")):
        assert_close(out[key], expected[key], rtol=0, atol=1e-10)


def test_in_turn_and_joint_are_the_same_ensemble_in_mean_and_covariance(float64):
    frames, (F, _, H, R) = readings(), linear_system()
    members = torch.randn(7, 2, generator=torch.Generator().manual_seed(1))
    outs = [
        fused("ensemble", joint=joint, members=members, noisy=False).sequence(frames.copy()) for joint in (False, True)
    ]
    assert_close(outs[0]["belief", "mean"], outs[1]["belief", "mean"], rtol=0, atol=1e-10)
    assert_close(outs[0]["belief", "var"], outs[1]["belief", "var"], rtol=0, atol=1e-10)
    whole = DEnKF(
        transition=NoisyLinear(F),
        sensor=None,
        observation=LinearObservation(H),
        noise=ConstantNoise(R.sqrt(), in_key="observation"),
        analysis=EnsembleAnalysis("etkf", observation_key="observation"),
        initial=FixedEnsemble(members),
    ).sequence(as_kalman(frames))
    assert_close(outs[1]["belief", "ensemble"], whole["belief", "ensemble"], rtol=0, atol=1e-12)


PATTERNS = {
    "three steps late": torch.full((T,), DELAY),
    "out of order": torch.tensor([0, 2] * T)[:T],  # that of t=2 before that of t=1, and so on
}


@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("pattern", PATTERNS)
def test_late_readings_equal_ordered_readings(float64, kind, joint, pattern):
    frames, late = readings(), PATTERNS[pattern]
    key = {} if pattern == "three steps late" else {"late_key": "late"}
    out = fused(kind, joint=joint, delay=DELAY, **key).sequence(arriving(frames, late))
    for now in range(T):
        expected = linear_kalman().sequence(as_kalman(arrived(frames, late, now)))
        for name in BELIEF:
            assert_close(out[name][:, now], expected[name][:, -1], rtol=0, atol=1e-10)


@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_late_readings_of_an_ensemble_whose_motion_is_known(float64, joint, pattern):
    frames, late = readings(), PATTERNS[pattern]
    members = torch.randn(7, 2, generator=torch.Generator().manual_seed(1))
    given = {"members": members, "noisy": False}
    key = {} if pattern == "three steps late" else {"late_key": "late"}
    out = fused("ensemble", joint=joint, delay=DELAY, **key, **given).sequence(arriving(frames, late))
    for now in range(T):
        expected = fused("ensemble", **given).sequence(arrived(frames, late, now))
        for name in ("mean", "var"):
            assert_close(out["belief", name][:, now], expected["belief", name][:, -1], rtol=0, atol=1e-10)


@pytest.mark.parametrize("kind", ["Kalman", "ensemble"])
def test_readings_from_before_the_episode_are_ignored(float64, kind):
    frames = readings()
    members = torch.randn(7, 2, generator=torch.Generator().manual_seed(1))
    frames["is_init"][:, 6] = True
    frames["second_observed"][:] = True
    given = {"members": members, "noisy": False} if kind == "ensemble" else {}
    out = fused(kind, delay=DELAY, **given).sequence(frames.copy())
    alone = fused(kind, delay=DELAY, **given).sequence(frames[:, 6:].copy())
    assert_close(out["belief", "mean"][:, 6:], alone["belief", "mean"], rtol=0, atol=0)
    assert (alone["info", "second", "nis"][:, :DELAY] == 0).all()
    assert (alone["info", "second", "nis"][:, DELAY:] > 0).all()


def moved_and_read(steps, late, reading, *, mean, cov, noise):
    """Returns the belief after some steps with one reading of the second sensor, taken ``late`` steps before."""
    F, Q, H, R = linear_system()
    for step in range(steps + 1):
        mean, cov = (F @ mean, F @ cov @ F.mT + noise * Q) if step else (mean, cov)
        if step == steps - late:
            gain = cov @ H[1:].mT / (H[1:] @ cov @ H[1:].mT + R[1])
            mean, cov = mean + gain @ (reading - H[1:] @ mean), cov - gain @ H[1:] @ cov
    return mean, cov


@pytest.mark.parametrize("update_at_reset", [False, True])
@pytest.mark.parametrize("kind", ["Kalman", "ensemble"])
def test_late_reading_belongs_to_its_stated_step_or_none(float64, kind, update_at_reset):
    """Draws every step of the episode; not one before, not one to come, not one beyond the lag."""
    members, (F, Q, _, _) = torch.randn(7, 2), linear_system()
    if kind == "Kalman":
        motion, initial = LinearTransition(F, Q), MomentPrior(torch.tensor([1.0, -1.0]), torch.diag(torch.rand(2)))
        prior = {"mean": initial.mean, "cov": initial.cov, "noise": 1.0}
    else:
        motion, initial = NoisyLinear(F), FixedEnsemble(members)
        prior = {"mean": members.mean(0), "cov": members.mT.cov(), "noise": 0.0}
    delay = 3
    own = sensors(delay=delay, late_key="late")
    filter = FusedFilter(motion, own, initial=initial, update_at_reset=update_at_reset)
    used = []
    for steps in range(not update_at_reset, 6):
        for late in range(-1, delay + 2):
            frames = TensorDict({"first": torch.zeros(steps + 1, 1)}, [steps + 1])
            frames["second"] = torch.full_like(frames["first"], 4.0)
            frames["first_observed"] = torch.zeros(steps + 1, 1, dtype=torch.bool)
            frames["second_observed"] = frames["first_observed"].index_fill(0, torch.tensor([steps]), True)
            frames["late"] = torch.full((steps + 1, 1), late)
            belief = filter.sequence(frames)[-1]
            counts = 0 <= late <= min(steps, delay)
            mean, cov = moved_and_read(steps, late if counts else -1, torch.tensor([4.0]), **prior)
            assert_close(belief["belief", "mean"], mean, rtol=0, atol=1e-10)
            assert_close(belief["belief", "var"], cov.diagonal(), rtol=0, atol=1e-10)
            assert (belief["info", "second", "nis"] > 0).item() == counts
            assert belief["smoothed", "age"].item() == min(steps, delay)
            used.append(counts)
    assert sum(used) == (18 if update_at_reset else 17)


@pytest.mark.parametrize("kind", KINDS)
def test_the_state_a_lag_ago_is_that_of_the_smoother(float64, kind):
    frames = readings()
    expected = FixedLag(linear_kalman(), 4).sequence(as_kalman(frames))
    out = fused(kind, lag=4, joint=True).sequence(frames.copy())
    for name in ("mean", "cov", "var", "age"):
        assert_close(out["smoothed", name], expected["smoothed", name], rtol=0, atol=1e-10)


SPREAD = {
    "Kalman": partial(EKFAnalysis, inflation=1.3),
    "UKF": partial(UKFAnalysis, inflation=1.3),
    "ensemble": partial(EnsembleAnalysis, "etkf", inflation=1.3),
}


def inflated(frames, factor, *, noise=1.0, mean=None, cov=None):
    """Runs a Kalman filter by hand, one sensor after the other, each followed by inflation."""
    F, Q, H, R = linear_system()
    means, covs = [mean.expand(B, 2)], [cov.expand(B, 2, 2)]
    moved = []
    for row in frames.unbind(1)[1:]:
        mean, cov = means[-1] @ F.mT, F @ covs[-1] @ F.mT + noise * Q
        moved.append((mean, cov))
        for index, name in enumerate(("first", "second")):
            h, seen = H[index], row[f"{name}_observed"]
            gain = (cov @ h) / (h @ cov @ h.unsqueeze(-1) + R[index])
            new = mean + gain * (row[name] - mean @ h.unsqueeze(-1))
            shrunk = cov - gain.unsqueeze(-1) * (h @ cov).unsqueeze(-2)
            mean = torch.where(seen, new, mean)
            cov = torch.where(seen.unsqueeze(-1), factor**2 * shrunk, cov)
        means.append(mean)
        covs.append(cov)
    return means, covs, moved


def test_lagged_belief_follows_the_inflated_present(float64):
    """The smoother of Rauch, Tung and Striebel, by hand: it takes the inflated belief of the present for the belief."""
    frames, lag, F = readings(), 3, linear_system()[0]
    out = FixedLag(fused("Kalman", analysis=SPREAD["Kalman"]), lag).sequence(frames.copy())
    start = {"mean": torch.tensor([1.0, -1.0]), "cov": torch.diag(torch.tensor([1.0, 2.0]))}
    means, covs, moved = inflated(frames, 1.3, **start)
    mean, cov = means[-1], covs[-1]
    for step in range(T - 2, T - 2 - lag, -1):
        gain = covs[step] @ F.mT @ torch.linalg.inv(moved[step][1])
        mean = means[step] + (gain @ (mean - moved[step][0]).unsqueeze(-1)).squeeze(-1)
        cov = covs[step] + gain @ (cov - moved[step][1]) @ gain.mT
    assert_close(out["belief", "cov"][:, -1], covs[-1], rtol=0, atol=1e-10)
    assert_close(out["smoothed", "mean"][:, -1], mean, rtol=0, atol=1e-10)
    assert_close(out["smoothed", "cov"][:, -1], cov, rtol=0, atol=1e-10)


def test_an_ensemble_with_a_lag_inflates_its_present_alone(float64):
    members = torch.randn(7, 2, generator=torch.Generator().manual_seed(1))
    frames, given = readings(), {"members": members, "noisy": False, "analysis": SPREAD["ensemble"]}
    out = fused("ensemble", lag=3, **given).sequence(frames.copy())
    means, covs, _ = inflated(frames, 1.3, noise=0.0, mean=members.mean(0), cov=members.mT.cov())
    assert_close(out["belief", "mean"], torch.stack(means, 1), rtol=0, atol=1e-10)
    variances = torch.stack(covs, 1).diagonal(dim1=-2, dim2=-1)
    assert_close(out["belief", "var"], variances, rtol=1e-9, atol=1e-10)
    expected = FixedLag(fused("ensemble", **given), 3).sequence(frames.copy())
    assert_close(out["smoothed", "ensemble"], expected["smoothed", "ensemble"], rtol=0, atol=1e-12)


@pytest.mark.parametrize("joint", [False, True])
def test_inflation_of_clones_raises(joint):
    members = torch.randn(7, 2)
    for kind, analysis in SPREAD.items():
        with pytest.raises(ValueError, match=r"inflation or relaxation of .* let Refiltering make them again"):
            fused(kind, members=members, joint=joint, analysis=analysis, delay=DELAY)
        if kind != "ensemble":
            with pytest.raises(ValueError, match=r"inflation or relaxation of .* put FixedLag\(filter, lag\) around"):
                fused(kind, joint=joint, analysis=analysis, lag=DELAY)
    relaxed = partial(EnsembleAnalysis, "etkf", relaxation=0.5)
    with pytest.raises(ValueError, match="inflation or relaxation"):
        fused("ensemble", members=members, joint=joint, analysis=relaxed, delay=DELAY)
    own = sensors(delay=DELAY)
    own["first"] = replace(own["first"], analysis=SPREAD["ensemble"])  # in time, and not inflated for the late one
    with pytest.raises(ValueError, match="inflation or relaxation of 'first'"):
        FusedFilter(NoisyLinear(linear_system()[0]), own, initial=FixedEnsemble(members))


@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("gaussian", [True, False])
def test_the_gradient_reaches_everything_through_late_readings(float64, gaussian, joint):
    torch.manual_seed(0)
    mlp = {"layer": "none", "activation": nn.Tanh}
    camera = VectorSensor(4, 2, ensemble_size=6, num_cells=(8,), layer="none", in_key="lamps")
    parts = {
        "camera": FusedSensor(
            LearnedObservation(StochasticMLP(2, 2, (6,), **mlp)),
            DiagonalNoise(2, r=0.5, num_cells=(4,)),
            sensor=camera,
            delay=2,
        ),
        "wheel": FusedSensor(Select([1]), ConstantNoise([0.3], trainable=True)),
    }
    motion = LearnedTransition(StochasticMLP(2, 2, (6,), output_gain=0.5, **mlp))
    if gaussian:
        initial, q = MomentPrior(torch.zeros(2), torch.eye(2)), CholeskyNoise(2, r=0.4)
        filter = FusedFilter(motion, parts, initial=initial, process_noise=q, joint=joint)
    else:
        filter = FusedFilter(motion, parts, initial=FixedEnsemble(torch.randn(6, 2)), joint=joint)
    with torch.no_grad():
        for parameter in filter.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    frames = TensorDict({"lamps": torch.randn(2, 6, 4), "wheel": torch.randn(2, 6, 1)}, [2, 6])
    directional_check(
        lambda: sum(filter.sequence(frames.copy())["belief", key].square().sum() for key in ("mean", "var")),
        filter.parameters(),
    )


def test_angles_side_by_side(float64):
    """A heading near pi, read a full turn away: both ways to update take the shorter way round."""
    turns = {
        "compass": FusedSensor(Select([0]), [0.3], reading_space=Circle()),
        "pair": FusedSensor(Select([1, 0]), [0.5, 0.4], reading_space=Euclidean(1) * Circle()),
    }
    F = torch.eye(2)
    frames = TensorDict({"compass": torch.full((3, 1), -3.1), "pair": torch.tensor([[0.2, -3.0]] * 3)}, [3])
    means = []
    for joint in (False, True):
        initial = MomentPrior(torch.tensor([3.1, 0.0]), torch.eye(2))
        kf = FusedFilter(LinearTransition(F, 0.1 * F), turns, initial=initial, joint=joint)
        means.append(kf.sequence(frames.copy())["belief", "mean"])
    assert_close(means[0], means[1], rtol=0, atol=1e-10)
    assert (means[0][-1, 0] > 3.1).all(), "further, not back through zero"


def test_mean_of_sampled_angles_is_circular(float64):
    samples = torch.tensor([torch.pi - 0.1, 0.3 - torch.pi, 0.1 - torch.pi]).unsqueeze(-1)  # by 0.1 beyond pi
    numbers = torch.tensor([[1.0], [2.0], [6.0]])
    td = TensorDict({"a": numbers, "b": samples, "qa": torch.ones(1), "qb": torch.ones(1)})
    found = JoinedReading(["a", "b"], ["qa", "qb"], [None, Circle()], observation_key="c", noise_key="qc")(td)["c"]
    assert_close(found[0], torch.tensor(3.0))
    assert_close(wrap_angles(found[1:] - torch.pi - 0.1), torch.zeros(1), rtol=0, atol=1e-12)


def test_covariances_of_readings_side_by_side(float64):
    F, Q, H, _ = linear_system()
    cov = torch.tensor([[0.5, 0.2], [0.2, 0.3]])

    class Constant(ConstantNoise):
        def compute(self, like, *, batch_size):
            return cov.expand(*batch_size, 2, 2)

    both = {"pair": FusedSensor(LinearObservation(H), Constant([1.0, 1.0])), "one": FusedSensor(Select([1]), [0.7])}
    frames = TensorDict({"pair": torch.randn(4, 2), "one": torch.randn(4, 1)}, [4])
    outs = []
    for joint in (False, True):
        initial = MomentPrior(torch.zeros(2), torch.eye(2))
        outs.append(FusedFilter(LinearTransition(F, Q), both, initial=initial, joint=joint).sequence(frames.copy()))
    assert_close(outs[0]["belief", "cov"], outs[1]["belief", "cov"], rtol=0, atol=1e-10)
    assert_close(outs[0]["belief", "mean"], outs[1]["belief", "mean"], rtol=0, atol=1e-10)


def with_lasting_errors(*, joint=False, delay=0, kind=None):
    """Returns two sensors of the linear system, each with lasting errors, around one that has none."""
    F, Q, H, R = linear_system()
    errors = [FadingBias([std], time, trainable=False) for std, time in ((0.8, 6.0), (1.5, 1e6))]
    sensors = {
        "first": FusedSensor(LinearObservation(H[:1]), R[:1].sqrt(), sensor_error=errors[0]),
        "wheel": FusedSensor(LinearObservation(H[:1]), R[:1].sqrt()),
        "second": FusedSensor(LinearObservation(H[1:]), R[1:].sqrt(), delay=delay, sensor_error=errors[1]),
    }
    options = {"initial": MomentPrior(torch.tensor([1.0, -1.0]), torch.diag(torch.tensor([1.0, 2.0]))), "joint": joint}
    if kind is None:
        return FusedFilter(NoisyLinear(F), sensors, process_noise=known_noise(), **options)
    if kind == "Kalman":
        return FusedFilter(LinearTransition(F, Q), sensors, **options)
    motion = {"EKF": EKFTransition, "UKF": UKFTransition}[kind](NoisyLinear(F), known_noise())
    return FusedFilter(motion, sensors, **options)


def lasting_errors_in_numpy(frames, Q):
    """Runs a textbook Kalman filter whose state ends with both sensors' biases."""
    F, _, H, R = (value.numpy() for value in linear_system())
    decay = np.exp([-1 / 6, -1e-6])
    f = block_diag(F, np.diag(decay))
    q = block_diag(Q.numpy(), np.diag(np.array([0.8, 1.5]) ** 2 * (1 - decay**2)))
    rows = [("first", [*H[0], 1, 0], R[0]), ("wheel", [*H[0], 0, 0], R[0]), ("second", [*H[1], 0, 1], R[1])]
    means, covs = [], []
    for run in frames:
        mean, cov = np.array([1.0, -1.0, 0, 0]), np.diag([1.0, 2.0, 0.64, 2.25])
        for t, frame in enumerate(run):
            if t:
                mean, cov = f @ mean, f @ cov @ f.T + q
            for name, h, r in rows:
                if frame[f"{name}_observed"]:
                    h = np.array(h)
                    gain = cov @ h / (h @ cov @ h + r)
                    mean, cov = mean + gain * (frame[name].item() - h @ mean), cov - np.outer(gain, h @ cov)
        means.append(mean)
        covs.append(cov)
    return torch.tensor(np.stack(means)), torch.tensor(np.stack(covs))


def lasting_readings():
    frames = readings()
    frames["wheel"], frames["wheel_observed"] = frames["first"] + 0.3, frames["second_observed"]
    return frames


@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("delay", [0, DELAY])
@pytest.mark.parametrize("kind", [None, *KINDS])
def test_errors_that_last_are_those_of_a_kalman_filter_that_holds_them(float64, kind, joint, delay):
    frames, late = lasting_readings(), torch.full((T,), delay)
    mean, cov = lasting_errors_in_numpy(arrived(frames, late, T - 1), linear_system()[1])
    out = with_lasting_errors(joint=joint, delay=delay, kind=kind).sequence(arriving(frames, late))["belief"][:, -1]
    assert_close(out["mean"], mean, rtol=0, atol=1e-9)
    assert_close(out["cov"], cov, rtol=0, atol=1e-9)


@pytest.mark.parametrize("noise", [False, True])
def test_gradients_of_coloured_noise_and_linear_motion(float64, noise):
    """F, B and Q of the user's own transition, and size and time of the error: gradients by finite differences."""
    F, Q, H, R = linear_system()
    error = FadingBias([0.8, 0.6], 6.0)
    motion = LinearTransition(F, known_noise() if noise else Q, control=torch.tensor([[0.3], [1.0]]), trainable=True)
    sensors = {"a": FusedSensor(LinearObservation(H), R.sqrt(), sensor_error=error)}
    filter = FusedFilter(motion, sensors, initial=MomentPrior(torch.zeros(2), torch.eye(2)))
    frames = TensorDict({"a": torch.randn(2, 6, 2), "action": torch.randn(2, 6, 1)}, [2, 6])
    whole = KalmanFilter(
        F,
        H,
        process_noise_cov=Q,
        noise=R.sqrt(),
        mean=torch.zeros(2),
        cov=torch.eye(2),
        sensor_error=error,
        control=motion.control.detach(),
        observation_key="a",
    )
    expected = whole.sequence(frames.copy())
    out = filter.sequence(frames.copy())
    for key in BELIEF:
        assert_close(out[key], expected[key], rtol=0, atol=1e-10)
    assert {motion.matrix, motion.control} <= set(filter.parameters())
    for parameter in (motion.matrix, motion.control, error.log_std, error.log_time):
        loss = lambda: filter.sequence(frames.copy())["belief", "mean"].square().sum()  # noqa: E731
        directional_check(loss, [parameter])


def test_each_component_of_a_reading_has_its_own_error(float64):
    """Puts the second sensor behind the error of the first: one Kalman filter of all three readings is the oracle."""
    F, Q, H, _ = linear_system()
    h, r, start = torch.cat([H[:1], H]), torch.tensor([0.5, 0.7, 0.9]), (torch.ones(2), torch.eye(2))
    errors = [FadingBias(*given, trainable=False) for given in (([0.8], 6.0), ([1.5, 0.4], [20.0, 2.0]))]
    sensors = {
        "one": FusedSensor(LinearObservation(h[:1]), r[:1], sensor_error=errors[0]),
        "pair": FusedSensor(LinearObservation(h[1:]), r[1:], sensor_error=errors[1]),
    }
    fused = FusedFilter(NoisyLinear(F), sensors, initial=MomentPrior(*start), process_noise=known_noise())
    both = FadingBias([0.8, 1.5, 0.4], [6.0, 20.0, 2.0], trainable=False)
    whole = KalmanFilter(F, h, process_noise_cov=Q, noise=r, mean=start[0], cov=start[1], sensor_error=both)
    y = torch.randn(B, T, 3)
    out = fused.sequence(TensorDict({"one": y[..., :1], "pair": y[..., 1:]}, [B, T]))
    expected = whole.sequence(TensorDict({"observation": y}, [B, T]))
    for key in BELIEF:
        assert_close(out[key], expected[key], rtol=0, atol=1e-10)


def test_what_raises():
    F, Q, H, R = linear_system(torch.float32)
    moments = {"initial": MomentPrior(torch.zeros(2), torch.eye(2))}
    members = {"initial": GaussianPrior([0.0] * 2, [1.0] * 2, ensemble_size=4)}
    linear, noiseless, update = LinearTransition(F, Q), NoisyLinear(F), EnsembleAnalysis("etkf")

    def one(**options):
        return {"a": FusedSensor(LinearObservation(H), R.sqrt(), **options)}

    module, lasting = r"pass partial\(EnsembleAnalysis, \.\.\.\), not a module", FadingBias([1.0] * 2, 5.0)
    cases = [
        (ValueError, "at least one sensor", linear, {}, moments),
        (TypeError, "sensors is a dict", linear, [one()["a"]], moments),
        (TypeError, module, noiseless, one(), {**members, "process_noise": 0.1, "analysis": update}),
        (TypeError, module, noiseless, one(), {**members, "process_noise": 0.1, "analysis": update, "joint": True}),
        (TypeError, module, noiseless, one(analysis=update), {**members, "process_noise": 0.1}),
        (ValueError, "beyond lag=2", noiseless, one(delay=3), {**members, "lag": 2}),
        (ValueError, "how late", noiseless, one(late_key="age"), members),
        (TypeError, "is a FadingBias, or None; got float", noiseless, one(sensor_error=1.0), members),
        (ValueError, "analysis of their own", noiseless, one(analysis=EKF), {**members, "joint": True}),
    ]
    for sensors in (one(), one(sensor_error=lasting)):
        cases.append((ValueError, "writes an ensemble", linear, sensors, members))
        cases.append((ValueError, "process noise already", linear, sensors, {**moments, "process_noise": 0.1}))
        cases.append((ValueError, "need process_noise", noiseless, sensors, moments))
    for error, match, motion, sensors, options in cases:
        with pytest.raises(error, match=match):
            FusedFilter(motion, sensors, **options)
    wrong = TensorDict({"a": torch.zeros(3, len(H)), "a_observed": torch.ones(3, 1)}, [3])
    with pytest.raises(TypeError, match=r"a_observed.* must be boolean"):
        FusedFilter(linear, one(delay=1), **moments).sequence(wrong)
    with pytest.raises(TypeError, match="already carries a lag window"):
        FixedLag(FusedFilter(linear, one(), **moments, lag=3), 2)


@pytest.mark.parametrize(
    ("marker", "observed"), [(BlackIsMissing(), "seen"), (BlackIsMissing(observed_key="other"), "mine")]
)
def test_a_mask_that_the_sensor_would_not_read_raises(marker, observed):
    """The mask of the data goes through the one that the sensor makes, and neither is dropped."""
    camera = TensorDictSequential(marker, VectorSensor(3, 1, ensemble_size=4, in_key="pixels"))
    with pytest.raises(ValueError, match=f"observed_key= names '{observed}', which it would not read"):
        FusedFilter(
            NoisyLinear(torch.eye(1), 0.1 * torch.eye(1)),
            {"camera": FusedSensor(Select([0]), [1.0], sensor=camera, observed_key=observed)},
            initial=GaussianPrior([0.0], [1.0], ensemble_size=4),
        )


def test_a_sensor_is_copied_pickled_and_changed_and_names_wrong_arguments():
    with pytest.raises(TypeError, match=r"FusedSensor takes no argument 'dealy'; it takes .*delay, late_key"):
        FusedSensor(Select([0]), [0.1], dealy=3)
    with pytest.raises(TypeError, match="late_key of FusedSensor is a key"):
        FusedSensor(Select([0]), [0.1], delay=3, late_key=5)
    sensor = FusedSensor(Select([0]), [0.1], delay=3)
    assert copy.deepcopy(sensor).delay == pickle.loads(pickle.dumps(sensor)).delay == 3
    assert replace(sensor, delay=2).delay == 2
