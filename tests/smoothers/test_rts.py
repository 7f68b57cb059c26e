"""RTS against one dense solve over all states; the UKF and the EKF are exact on a linear system."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from tests.filters.factories import NoisyLinear, linear_kalman
from tests.filters.gaussian_for_tests import directional_check, learned_filter, learned_frames, linear_filter
from tests.smoothers.joint import drive, joint_beliefs
from torch_denkf import EKF, UKF, KalmanFilter
from torch_denkf.functional.manifolds import SE2
from torch_denkf.functional.smoothing.rts import smoothing_gain
from torch_denkf.modules import ConstantNoise, LinearObservation, MappedNoise, MomentPrior
from torch_denkf.motions import ConstantTwist, PoseOf
from torch_denkf.smoothers import FixedLag, RTSSmoother

FILTERS = ["Kalman", "EKF", "UKF", "BackpropKF"]


def make(name):
    return linear_kalman() if name == "Kalman" else linear_filter(name)


@pytest.mark.parametrize("lag", [None, 0, 1, 3])
@pytest.mark.parametrize("name", FILTERS)
def test_each_state_is_that_of_the_joint_gaussian(float64, name, lag):
    frames = drive(4, 9)
    mean, cov = joint_beliefs(frames, lag)
    out = RTSSmoother(make(name), lag)(frames.copy())
    assert_close(out["smoothed", "mean"], mean, rtol=0, atol=1e-10)
    assert_close(out["smoothed", "cov"], cov, rtol=0, atol=1e-10)
    assert out["smoothed", "var"].equal(out["smoothed", "cov"].diagonal(dim1=-2, dim2=-1))
    filtered = make(name).sequence(frames.copy())
    assert_close(out["belief", "mean"], filtered["belief", "mean"], rtol=0, atol=0)


def test_a_compiled_filter_is_compiled_once_for_sequences_of_any_length(float64, monkeypatch):
    made, own = [], torch.compile
    monkeypatch.setattr(torch, "compile", lambda *args, **options: made.append(args) or own(*args, **options))
    smoother = RTSSmoother(linear_kalman().compile(chunk=1, backend="eager"))
    for count in (9, 5):
        frames = drive(4, count, resets=False)
        out = smoother(frames.copy())
        assert_close(out["smoothed", "mean"], joint_beliefs(frames)[0], rtol=0, atol=1e-10)
    assert len(made) == 1


@pytest.mark.parametrize("name", FILTERS)
def test_online_fixed_lag_equals_the_delayed_smoother(float64, name):
    lag, frames = 3, drive(4, 9)
    out = FixedLag(make(name), lag).sequence(frames.copy())
    age = out["smoothed", "age"].squeeze(-1)
    for t in range(9):
        whole = joint_beliefs(frames[:, : t + 1])  # all readings up to now
        at = (t - age[:, t]).unsqueeze(-1)
        mean, cov = (value[torch.arange(4), at.squeeze(-1)] for value in whole)
        assert_close(out["smoothed", "mean"][:, t], mean, rtol=0, atol=1e-10)
        assert_close(out["smoothed", "cov"][:, t], cov, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", FILTERS)
def test_update_at_reset_is_smoothed(float64, name):
    frames = drive(3, 6, resets=False, missing=0.0)
    filter = make(name)
    filter = filter.with_options(update_at_reset=True)
    whole = RTSSmoother(filter)(frames.copy())
    online = FixedLag(filter, 5).sequence(frames.copy())
    assert_close(online["smoothed", "mean"][:, -1], whole["smoothed", "mean"][:, 0], rtol=0, atol=1e-10)
    assert_close(online["smoothed", "mean"][:, 0], online["belief", "mean"][:, 0], rtol=0, atol=1e-10)
    assert online["smoothed", "age"][0].flatten().tolist() == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("name", ["EKF", "UKF", "BackpropKF"])
def test_gradients_through_the_smoother(float64, name):
    filter, frames = learned_filter(name), learned_frames(3, 5)
    for smoother in (RTSSmoother(filter), FixedLag(filter, 2)):
        directional_check(
            lambda smoother=smoother: sum(
                smoother.sequence(frames.copy())["smoothed", key].square().sum() for key in ("mean", "cov")
            ),
            filter.parameters(),
        )


def unsure(name, dtype):
    """Returns a vehicle with a prior std of 1000 m and readings of 0.1 m; on a space also a heading."""
    dt, like = 0.1, {"dtype": dtype}
    if name == "SE2":
        motion = ConstantTwist(SE2(), dt, twist_noise=[0.05, 0.1, 0.1])
        space, reading = motion.space, PoseOf(motion.space)
        cov = torch.diag(torch.tensor([0.25, 1e6, 1e6, 0.01, 1.0, 1.0], **like))
        prior = MomentPrior(torch.zeros(6, **like), cov, space=space)
        noise = ConstantNoise(torch.tensor([0.01, 0.1, 0.1], **like), in_key="observation")
        options = {"observation_key": "observation", "reading_space": reading.reading_space}
        return EKF(motion, None, reading, noise, process_noise=motion.process_noise, initial=prior, **options)
    F = torch.eye(4, **like) + dt * torch.diag(torch.tensor([1.0, 0.0, 1.0], **like), 1)
    walk = 0.01 * torch.tensor([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], **like)
    Q, H = torch.block_diag(walk, walk), torch.eye(4, **like)[[0, 2]]
    cov = torch.diag(torch.tensor([1e6, 100.0, 1e6, 100.0], **like))
    if name == "Kalman":
        return KalmanFilter(F, H, process_noise_cov=Q, noise=[0.1, 0.1], mean=torch.zeros(4, **like), cov=cov)
    unit = ConstantNoise(torch.ones(4, **like), in_key=("belief", "mean"), out_key=("forecast", "noise"))
    q, r = MappedNoise(unit, torch.linalg.cholesky(Q)), ConstantNoise([0.1, 0.1], in_key="observation")
    prior = MomentPrior(torch.zeros(4, **like), cov)
    options = {"process_noise": q, "initial": prior, "observation_key": "observation"}
    filter = {"EKF": EKF, "UKF": UKF}[name](NoisyLinear(F), None, LinearObservation(H), r, **options)
    return filter.to(dtype)


@pytest.mark.parametrize("smoother", [RTSSmoother, partial(RTSSmoother, lag=5), partial(FixedLag, lag=5)])
@pytest.mark.parametrize("name", ["Kalman", "EKF", "UKF", "SE2"])
def test_vague_prior_keeps_the_covariance_positive(name, smoother):
    time = 0.1 * torch.arange(30, dtype=torch.double)
    torch.manual_seed(0)
    place = torch.stack([700 + 3 * time, -400 - 2 * time], -1) + 0.1 * torch.randn(30, 2, dtype=torch.double)
    readings = torch.cat([torch.full((30, 1), 0.3), place], -1) if name == "SE2" else place
    found = {}
    for dtype in (torch.double, torch.float):
        torch.set_default_dtype(dtype)
        try:
            out = smoother(unsure(name, dtype)).sequence(TensorDict({"observation": readings.to(dtype)}, [30]))
        finally:
            torch.set_default_dtype(torch.float)
        found[dtype] = out["smoothed", "mean"].double(), out["smoothed", "cov"].double()
    (mean, cov), (rounded, rounded_cov) = found.values()
    std = cov.diagonal(dim1=-2, dim2=-1).sqrt()
    scale = std.unsqueeze(-1) * std.unsqueeze(-2)
    assert (torch.linalg.eigvalsh(rounded_cov / scale) > 0).all()
    assert_close(rounded_cov / scale, cov / scale, rtol=0, atol=0.05)
    assert ((rounded - mean).abs() < 0.05 * std).all()


@pytest.mark.parametrize("lag", [None, 40])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 2e-3)])
def test_a_constant_state_of_which_one_direction_is_unknown(lag, dtype, tolerance):
    """With Q = 0 and a prior of rank 1 all covariances are singular; oracle: x = a u, a regression on one number."""
    for seed in range(4):
        torch.manual_seed(seed)
        u, reads, readings = (torch.randn(*shape, dtype=dtype) for shape in ((3,), (1, 3), (40, 1)))
        moments = {"mean": torch.zeros(3, dtype=dtype), "cov": torch.outer(u, u)}
        noises = {"process_noise_cov": torch.zeros(3, 3, dtype=dtype), "noise_cov": torch.eye(1, dtype=dtype)}
        filter = KalmanFilter(torch.eye(3, dtype=dtype), reads, **noises, **moments)
        out = RTSSmoother(filter, lag)(TensorDict({"observation": readings}, [40]))
        slope = (reads @ u).item()
        variance = 1 / (1 + 39 * slope**2)  # the first reading is of the initial belief
        mean, cov = variance * slope * readings[1:].sum() * u, variance * torch.outer(u, u)
        assert_close(out["smoothed", "mean"], mean.expand(40, 3), rtol=tolerance, atol=tolerance)
        assert_close(out["smoothed", "cov"], cov.expand(40, 3, 3), rtol=tolerance, atol=tolerance)


def test_the_gain_of_a_singular_forecast_has_a_gradient(float64):
    """Rounding makes one eigenvalue slightly negative: no NaN, in the gradient neither."""
    u = torch.tensor([1.0, 2.0, -3.0])
    cov = (torch.outer(u, u) - 1e-12 * torch.eye(3)).requires_grad_()
    gain = smoothing_gain(cov, cov)
    assert_close(gain @ u, u, rtol=1e-6, atol=0)
    assert torch.autograd.grad((gain @ u).sum(), cov)[0].isfinite().all()
