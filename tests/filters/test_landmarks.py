"""A vehicle that sees landmarks: an extended Kalman filter written out in numpy."""

import numpy as np
import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf.applications.car import UnicycleTransition
from torch_denkf.filters import EKF
from torch_denkf.functional.manifolds import Circle, Euclidean, Flat
from torch_denkf.modules import ConstantNoise, GaussianAround, LearnedObservation

LANDMARKS = [[-12.0, 0.0], [5.0, 15.0]]  # m; the first is behind the vehicle, so that its direction passes pi
DT = 0.1  # s


def numpy_range_bearing_ekf(readings, observed, m, P, Q, R):
    """Vehicle [x, y, theta, v, omega] that sees distances and directions of landmarks; Jacobians by hand."""
    means, covs, dt = [m], [P], DT
    for y, seen in zip(readings[1:], observed[1:], strict=True):
        heading, v = m[2] + 0.5 * dt * m[4], m[3]
        c, s = np.cos(heading), np.sin(heading)
        F = np.eye(5)
        F[0, 2:] = -v * dt * s, dt * c, -0.5 * v * dt**2 * s
        F[1, 2:] = v * dt * c, dt * s, 0.5 * v * dt**2 * c
        F[2, 4] = dt
        m = m + np.array([v * dt * c, v * dt * s, m[4] * dt, 0, 0])
        P = F @ P @ F.T + Q
        if seen:
            dx, dy = (np.array(LANDMARKS) - m[:2]).T
            r = np.hypot(dx, dy)
            H = np.zeros((4, 5))
            H[:2, 0], H[:2, 1] = -dx / r, -dy / r
            H[2:, 0], H[2:, 1], H[2:, 2] = dy / r**2, -dx / r**2, -1
            d = y - np.concatenate([r, np.arctan2(dy, dx) - m[2]])
            d[2:] = (d[2:] + np.pi) % (2 * np.pi) - np.pi
            S = H @ P @ H.T + R
            K = P @ H.T @ np.linalg.inv(S)
            m, P = m + K @ d, P - K @ S @ K.T
        means.append(m), covs.append(P)
    return np.stack(means), np.stack(covs)


class RangeBearing(nn.Module):
    """Distances of the landmarks, and their directions relative to the heading."""

    def forward(self, state):
        dx, dy = (torch.tensor(LANDMARKS) - state[..., None, :2]).unbind(-1)
        return torch.cat([torch.hypot(dx, dy), torch.atan2(dy, dx) - state[..., 2:3]], -1)


STD = [0.01, 0.01, 0.01, 0.1, 0.05]  # process noise of a step
READING_STD = [0.2, 0.2, 0.02, 0.02]  # m, m, rad, rad
START_STD = [0.0, 0.0, 0.0, 1.0, 0.1]


def range_bearing():
    q = ConstantNoise(STD, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    return EKF(
        UnicycleTransition(torch.zeros_like, DT),
        None,
        LearnedObservation(RangeBearing()),
        ConstantNoise(READING_STD, in_key="reading"),
        process_noise=q,
        initial=GaussianAround(START_STD, state_key="start"),
        observation_key="reading",
        reading_space=Euclidean(2) * Circle() * Circle(),
    )


def simulate_range_bearing(rows, steps):
    """Returns true states, readings, and initial beliefs whose errors match the prior."""
    start = torch.tensor([0.0, 0.0, 0.0, 5.0, 0.4]).expand(rows, 5)
    state = start + torch.tensor(START_STD) * torch.randn(rows, 5)
    move, states = UnicycleTransition(torch.zeros_like, DT), [state]
    for _ in range(steps - 1):
        td = move(TensorDict({("belief", "ensemble"): state.unsqueeze(-2)}, [rows]))
        state = td["forecast", "ensemble"].squeeze(-2) + torch.tensor(STD) * torch.randn(rows, 5)
        states.append(state)
    states = torch.stack(states, 1)
    readings = RangeBearing()(states) + torch.tensor(READING_STD) * torch.randn(rows, steps, 4)
    readings = Flat(4, circular=[2, 3]).normalise(readings)
    return TensorDict(
        {"state": states, "reading": readings, "start": start.unsqueeze(1).expand_as(states)}, [rows, steps]
    )


def test_ekf_equals_numpy_on_a_vehicle_that_sees_landmarks(float64):
    frames = simulate_range_bearing(3, 60)
    frames["observed"] = torch.rand(3, 60, 1) < 0.7
    out = range_bearing().sequence(frames)
    assert (frames["reading"][..., 2].diff(dim=1).abs() > 5).any(), "a direction passes pi"
    Q, R, P = (np.diag(np.square(std)) for std in (STD, READING_STD, START_STD))
    for row in range(3):
        readings, observed = frames["reading"][row].numpy(), frames["observed"][row, :, 0].numpy()
        means, covs = numpy_range_bearing_ekf(readings, observed, frames["start"][row, 0].numpy(), P, Q, R)
        np.testing.assert_allclose(out["belief", "mean"][row], means, rtol=0, atol=1e-10)
        np.testing.assert_allclose(out["belief", "cov"][row], covs, rtol=0, atol=1e-10)
