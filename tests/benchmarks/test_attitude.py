"""The simulated log against known motions, the walk against gravity; baselines against what they claim."""

import pytest
import torch
from torch.testing import assert_close

from benchmarks.attitude.baselines import error_state_filter, integrate, mahony
from benchmarks.attitude.study import scores
from benchmarks.attitude.task import DT, FIELD, GRAVITY, Sensors, simulated, tilt_error
from torch_denkf import EKF
from torch_denkf.functional.manifolds import SE23, SO3, rotate
from torch_denkf.modules import ConstantNoise, MomentPrior
from torch_denkf.motions import AttitudeMotion, Gravity, InertialMotion, Magnetic

PERFECT = Sensors(*[0.0] * 7)


def log_of(data):
    return [data[key].double().numpy() for key in ("gyro", "accelerometer", "dt")]


def test_perfect_sensors_lead_where_the_body_is(float64):
    data = simulated(2, 5.0, 3, PERFECT).double()
    motion = InertialMotion(DT, gravity=GRAVITY)
    poses = torch.cat([data[key] for key in ("orientation", "velocity", "position")], -1)
    state = torch.cat([poses[:, :1], torch.zeros(2, 1, 6)], -1)
    for row in range(1, data.shape[1]):
        state = motion.compute(state, data["imu"][:, row])
    error = SE23().minus(state[:, 0, :10], poses[:, -1])
    assert error[:, :3].abs().max() < 1e-4
    assert error[:, 3:].abs().max() < 1e-2
    assert_close(Magnetic(SO3(), FIELD).observe(data["orientation"]), data["magnetometer"], rtol=0, atol=1e-4)
    turns = torch.as_tensor(integrate(*(log_of(data)[at] for at in (0, 2)), data["orientation"][:, 0].numpy()))
    assert SO3().distance(turns[:, -1], data["orientation"][:, -1]).max() < 1e-4


def test_tilt_and_gyro_bias_converge_without_acceleration(float64):
    """At rest, tilted; both start 10 degrees off. The bias about up cannot be seen."""
    truth = SO3().exp(torch.tensor([[0.5, -0.4, 1.0]]))
    wrong = SO3().plus(truth, torch.tensor([[0.17, 0.0, 0.0]])).numpy()
    rows, bias = 6000, torch.tensor([0.02, -0.01, 0.03])
    force = Gravity(SO3()).observe(truth).expand(1, rows, 3).numpy()
    gyro, dt = bias.expand(1, rows, 3).numpy(), torch.full((1, rows, 1), DT).numpy()
    assert tilt_error(torch.as_tensor(mahony(gyro, force, dt, wrong))[0, -1], truth[0]) < 1e-3
    turns, biases, _ = error_state_filter(gyro, force, dt, wrong, 1e-4, 1e-5, 0.1, 0.2, 0.05)
    assert tilt_error(torch.as_tensor(turns)[0, -1], truth[0]) < 1e-3
    axis = rotate(SO3().inverse(truth[0]), torch.tensor([0.0, 0.0, 1.0]))
    away = torch.as_tensor(biases)[0, -1] - bias
    assert (away - axis * (axis @ away)).norm() < 1e-3


def test_the_covariance_is_that_of_many_runs(float64):
    """White noise on a reading of up, and on the gyro: 300 runs are as wrong as the filter says."""
    runs, rows, std = 300, 300, 0.1
    truth, gyro_noise = SO3().exp(torch.randn(runs, 3)), 0.02
    up = Gravity(SO3(), gravity=1.0).observe(truth).unsqueeze(1)
    force = (up + std * torch.randn(runs, rows, 3)).numpy()
    gyro = (gyro_noise / DT**0.5 * torch.randn(runs, rows, 3) + 0.01 * torch.randn(runs, 1, 3)).numpy()
    start = SO3().perturb(truth, torch.tensor(0.05), torch.randn(runs, 3)).numpy()
    dt = torch.full((runs, rows, 1), DT).numpy()
    turns, _, cov = error_state_filter(gyro, force, dt, start, gyro_noise, 0.0, std)
    log = {"orientation": truth.unsqueeze(1).expand(runs, rows, 4)}
    found = scores(torch.as_tensor(turns), log, slice(100, None), torch.as_tensor(cov)[..., :3, :3])
    assert found["claimed"] == pytest.approx(found["tilt"], rel=0.1)


@pytest.mark.parametrize("up_noise", [0.05, 1.0])
def test_the_librarys_filter_is_the_one_in_plain_numpy(float64, up_noise):
    """On simulated runs that turn about; they share no code."""
    data = simulated(1, 4.0, 9).double()
    orientation = data["orientation"] / data["orientation"].norm(dim=-1, keepdim=True)
    motion = AttitudeMotion("dt", gyro_noise=1e-3, gyro_walk=5e-5)
    ekf = EKF(
        motion,
        None,
        Gravity(motion.space, gravity=1.0),
        ConstantNoise([up_noise] * 3, in_key="up"),
        process_noise=motion.noise_of_step(DT),
        initial=MomentPrior(
            torch.cat([orientation[0, 0], torch.zeros(3)]),
            torch.tensor([0.05**2] * 3 + [0.01**2] * 3).diag(),
            space=motion.space,
        ),
        observation_key="up",
    )
    data["dt"], up = torch.full_like(data["dt"], DT), data["accelerometer"]
    data["up"] = up / up.norm(dim=-1, keepdim=True)
    out = ekf.sequence(data.clone(), keep=[("belief", "mean"), ("belief", "cov")])
    plain = error_state_filter(*log_of(data), orientation[:, 0].numpy(), 1e-3, 5e-5, up_noise)
    turns, biases, cov = map(torch.as_tensor, plain)
    assert SO3().distance(out["belief", "mean"][..., :4], turns).max() < 1e-7
    assert_close(out["belief", "mean"][..., 4:], biases, rtol=0, atol=1e-9)
    assert_close(out["belief", "cov"], cov, rtol=1e-6, atol=1e-10)
