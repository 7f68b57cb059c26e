"""The inertial sensor's filter: against the same equations in numpy, and on data of its own model."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torch_denkf.applications.imu import imu, imu_rows, orientations
from torch_denkf.applications.imu.filter import ImuSettings
from torch_denkf.functional.manifolds import SO3, rotate
from torch_denkf.pretrained import from_pretrained

SETTINGS = ImuSettings(
    gyro=0.003,
    gyro_scale=0.02,
    gyro_skew=0.01,
    magnetometer=1.0,
    magnetic_bias=1.0,
    lag=0.01,
    lag_std=0.01,
    heading=0.2,
)


def body_log(count=400, rate=100.0, seed=0):
    """Returns a body that rests for 2 s and then turns and sways; gyro with a bias, white noise on all."""
    generator = torch.Generator().manual_seed(seed)
    time = torch.arange(count, dtype=torch.float64).unsqueeze(-1) / rate
    moving = time >= 2.0
    rate_of_turn = moving * torch.tensor([1.5, -0.9, 1.2]) * (time * torch.tensor([3.0, 2.0, 4.0])).cos()
    turns = [SO3().exp(torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64))]
    for step in rate_of_turn[1:] / rate:
        turns.append(SO3().plus(turns[-1], step))
    truth = torch.stack(turns)
    back = SO3().inverse(truth)
    push = moving * torch.tensor([1.0, 0.7, 0.4]) * (time * torch.tensor([5.0, 4.0, 6.0])).sin()

    def noisy(value, size):
        return value + size * torch.randn(count, 3, generator=generator, dtype=torch.float64)

    field = torch.tensor([0.0, 16.0, -41.0], dtype=torch.float64).expand(count, 3)
    return truth, {
        "gyro": noisy(rate_of_turn + torch.tensor([0.01, -0.02, 0.005]), 0.003),
        "acceleration": noisy(rotate(back, push + torch.tensor([0.0, 0.0, 9.82])), 0.05),
        "magnetometer": noisy(rotate(back, field), 0.3),
    }


# ------------------------------------------------------------------------------------------- the same in numpy


def matrix(q):
    return Rotation.from_quat(q, scalar_first=True).as_matrix()


def rotation(v):
    return Rotation.from_rotvec(v).as_matrix()


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def left_jacobian(v):
    angle = np.linalg.norm(v)
    if angle < 1e-6:
        return np.eye(3) + skew(v) / 2
    k = skew(v / angle)
    return np.eye(3) + (1 - np.cos(angle)) / angle * k + (1 - np.sin(angle) / angle) * k @ k


def reference(rows, s):
    """Returns an error-state Kalman filter; the rotation's error stands in the world's axes, vectors in the body's."""
    start = np.array([s.tilt] * 2 + [s.heading] + [s.gyro_bias] * 3)
    errors = [s.gyro_scale if i == j else s.gyro_skew for i in range(3) for j in range(3)]
    rest = [s.motion_start] * 9 + [s.magnetic_bias] * 3 + [s.field] * 2 + [s.lag_std] + [s.stray] * 3 + [s.lever] * 3
    cov = np.diag(np.concatenate([start, errors, rest]) ** 2)
    turn, x = matrix(rows["start"][0, :4].numpy()), rows["start"][0, 4:].numpy().copy()
    found = []
    for t in range(len(rows)):
        row = {key: value[t].numpy() for key, value in rows.items()}
        gyro, dt = row["gyro"], row["dt"].item()
        if t:
            angles = (gyro - x[:3] - x[3:12].reshape(3, 3) @ gyro) * dt
            back, f = rotation(-angles), np.eye(36)
            turn = turn @ rotation(angles)
            step, fades = np.kron(row["moves"].reshape(3, 3), back), np.exp(-dt / s.stray_time)
            f[15:24, 15:24], f[30:33, 30:33] = step, fades * back
            x[12:21], x[27:30] = step @ x[12:21], fades * back @ x[27:30]
            spread = left_jacobian(-angles) * dt  # of the gyro's errors, to a turn in the body's axes
            for at, of in ((0, -turn), *((k, -skew(x[k - 3 : k])) for k in (15, 18, 21, 30))):
                f[at : at + 3, 3:6] = of @ spread
                f[at : at + 3, 6:15] = of @ spread @ np.kron(np.eye(3), gyro)
            q = np.zeros(36)
            q[:3] = s.gyro**2 + s.gyro_rate**2 * (gyro @ gyro)
            q[3:6] = s.gyro_walk**2
            q[21:24] = 2 * sum(s.poles) * (s.motion**2 + s.motion_unrest**2 * row["unrest"] ** 2)
            q[24:27], q[27:29], q[33:] = s.magnetic_walk**2, s.field_walk**2, s.lever_walk**2
            stray = s.stray**2 + s.stray_unrest**2 * row["disturbance"].item() ** 2
            q[30:33] = stray * (1 - fades**2) / dt
            cov = f @ cov @ f.T + np.diag(q * dt)

        def update(read, predicted, h, variance):
            nonlocal turn, x, cov
            gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + variance * np.eye(3))
            change = gain @ (read - predicted)
            reset = np.eye(36)
            reset[:3, :3] = left_jacobian(change[:3])
            keep = np.eye(36) - gain @ h
            cov = reset @ (keep @ cov @ keep.T + variance * gain @ gain.T) @ reset.T
            turn, x = rotation(change[:3]) @ turn, x + change[3:]

        up, lever, h = np.array([0, 0, s.gravity]), row["lever"].reshape(3, 3), np.zeros((3, 36))
        h[:, :3], h[:, 21:24], h[:, 33:] = turn.T @ skew(up), np.eye(3), lever
        update(row["accelerometer"], turn.T @ up + x[18:21] + lever @ x[30:], h, s.accelerometer**2)
        if row["magnetometer_observed"]:
            field, h, lag = np.array([0, *x[24:26]]), np.zeros((3, 36)), np.eye(3) + x[26] * skew(gyro)
            h[:, :3], h[:, 24:27], h[:, 27:29] = lag @ turn.T @ skew(field), np.eye(3), (lag @ turn.T)[:, 1:]
            h[:, 29], h[:, 30:33] = skew(gyro) @ (turn.T @ field + x[27:30]), lag
            noise = s.magnetometer**2 + s.magnetometer_rate**2 * (gyro @ gyro)
            update(row["magnetometer"], lag @ (turn.T @ field + x[27:30]) + x[21:24], h, noise)
        if row["rest_observed"]:
            h = np.zeros((3, 36))
            h[:, 3:6] = np.eye(3)
            update(gyro, x[:3], h, s.rest**2)
        found.append((turn, x.copy(), cov))
    return [np.stack(each) for each in zip(*found, strict=True)]


@torch.no_grad()
@pytest.mark.parametrize("axes", [9, 6])
def test_equals_the_error_state_kalman_filter(axes):
    _, log = body_log()
    if axes == 6:
        del log["magnetometer"]
    else:
        log["magnetometer"][120:135] = torch.nan
    rows = imu_rows(SETTINGS, **log, rate=100.0)
    assert rows["rest_observed"].sum() > 3
    out = imu(**dataclasses.asdict(SETTINGS)).double().sequence(rows.clone())["belief"]
    turn, x, cov = reference(rows, SETTINGS)
    found = np.stack([matrix(q) for q in out["mean"][:, :4].numpy()])
    assert np.abs(found - turn).max() < 1e-6
    assert np.abs(out["mean"][:, 4:].numpy() - x).max() < 1e-6
    scale = np.sqrt(np.einsum("tii->ti", cov))
    assert np.abs((out["cov"].numpy() - cov) / (scale[:, :, None] * scale[:, None])).max() < 1e-6


# --------------------------------------------------------------------------------------------------- a whole log


@pytest.mark.parametrize("rate", [50.0, 286.0])
def test_orientations_of_all_readings(rate):
    truth, log = body_log(int(6 * rate), rate)
    found = orientations(imu().double(), **log, rate=rate)
    north = SO3().compose(truth, SO3().inverse(found.quaternion))  # turn in the world's axes
    away = SO3().log(north)[int(2 * rate) :].rad2deg()
    assert found.quaternion.shape == (len(truth), 4)
    assert away[:, :2].square().mean().sqrt() < 0.5
    assert away[:, 2].square().mean().sqrt() < 1.5
    assert (found.std > 0).all()


def test_within_a_block_the_gyro_turns_exactly():
    count, rate = 140, 100.0
    gyro = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64).expand(count, 3)
    force = torch.tensor([0.0, 0.0, 9.82], dtype=torch.float64).expand(count, 3)
    found = orientations(imu(gyro_scale=1e-9, gyro_skew=1e-9, gyro_bias=1e-9).double(), gyro, force, rate=rate)
    angle = 2 * torch.atan2(found.quaternion[:, 3], found.quaternion[:, 0])
    steps = torch.remainder(angle.diff() + torch.pi, 2 * torch.pi) - torch.pi
    torch.testing.assert_close(steps, torch.full_like(steps, 0.02), atol=1e-9, rtol=0)
    later = orientations(imu(gyro_bias=1e-9, latency=0.05).double(), gyro, force, rate=rate).quaternion
    ahead = SO3().log(SO3().compose(SO3().inverse(found.quaternion), later))
    torch.testing.assert_close(ahead[:, 2], torch.full_like(angle, 0.1), atol=1e-3, rtol=0)


def test_a_field_unlike_that_of_the_place_widens_the_heading():
    _, log = body_log(250)
    model = imu().double()
    found = orientations(model, **log, rate=100.0)
    field = found.mean[-1, 28:30]
    model.settings = dataclasses.replace(model.settings, place=(field - torch.tensor([2.0, -1.0])).tolist())
    wider = orientations(model, **log, rate=100.0).std
    more = (wider.square() - found.std.square())[-1]
    torch.testing.assert_close(more, torch.tensor([0.0, 0.0, 2.5 / field[0].item() ** 2], dtype=more.dtype))
    with pytest.raises(ValueError, match="place are 2 numbers"):
        imu(place=(16.0,))


def test_a_log_that_is_not_one():
    _, log = body_log(100)
    with pytest.raises(ValueError, match="at least 5 readings"):
        imu_rows(SETTINGS, log["gyro"][:3], log["acceleration"][:3], rate=100.0)
    with pytest.raises(ValueError, match="poles"):
        imu(poles=(1.0, 2.0))


@pytest.mark.slow
def test_compiled_equals_eager():
    """The first compiled step is compared with the eager one, and raises if it differs."""
    _, log = body_log(100)
    model = from_pretrained("imu").double()
    rows = imu_rows(model.settings, **{name: value.double() for name, value in log.items()}, rate=100.0)
    row = model.initialise(rows[0].clone())
    with torch.no_grad():
        eager = model.step(row.clone())["belief", "cov"]
        torch.testing.assert_close(model.compile().step(row.clone())["belief", "cov"], eager)
