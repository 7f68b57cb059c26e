"""Errors of a legged robot's filter: Hartley's equations, and his filter in numpy."""

import math

import numpy as np
import pytest
import torch

from torch_denkf.applications.legged import QUADRUPED, LeggedNoises, legged_filter, quadruped_env
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.applications.legged.motion import LeggedMotion, LeggedMotionNoise, LeggedSpace
from torch_denkf.functional.manifolds import SO3, rotation_matrix, whole_parts
from torch_denkf.metrics.state import rotation_error

DT, GRAVITY = 0.01, torch.tensor([0.0, 0.0, -9.81])


@pytest.fixture(autouse=True)
def _double(float64):
    return


def test_group_axioms_and_jacobian_equal_autodiff():
    space = LeggedSpace(2)
    torch.manual_seed(0)
    one, other, third = (space.exp(torch.randn(space.tangent_dim)) for _ in range(3))
    torch.testing.assert_close(
        space.compose(space.compose(one, other), third), space.compose(one, space.compose(other, third))
    )
    torch.testing.assert_close(space.compose(one, space.inverse(one)), space.neutral(one))
    step, tangent = 0.1 * torch.randn(2, space.tangent_dim)
    torch.testing.assert_close(space.log(space.exp(tangent)), tangent)
    around = lambda more: space.minus(space.exp(tangent + more), space.exp(tangent))  # noqa: E731
    jacobian = torch.func.jacrev(around)(torch.zeros_like(step))
    torch.testing.assert_close(space.right_jacobian(tangent), jacobian)
    moved = space.compose(space.compose(one, space.exp(step)), space.inverse(one))
    torch.testing.assert_close(space.exp(space.adjoint(one) @ step), moved)
    basis = torch.func.jacrev(lambda more: space.plus(one, more))(torch.zeros_like(step))
    torch.testing.assert_close(space.basis(one), basis)
    torch.testing.assert_close(space.dual_basis(one) @ basis, torch.eye(space.tangent_dim))


def test_labels_may_be_of_some_vectors_alone():
    """Their errors are those of the whole state; of a foot without an orientation there is none."""
    space, (base, truth) = LeggedSpace(2), LeggedSpace(2).exp(torch.randn(2, 21))
    whole = space.minus(base, truth)
    for lost, told in ((16, range(15)), (5, [0, 1, 2, *range(6, 21)]), (11, [*range(10), *range(11, 21)])):
        part = truth.clone()
        part[lost : 22 if lost == 16 else lost + 1] = torch.nan
        points, tangents = whole_parts(space, ~part.isnan())
        assert tangents.nonzero().flatten().tolist() == list(told)
        found = space.minus(base, torch.where(points, truth, space.neutral(truth)))
        torch.testing.assert_close(found[tangents], whole[tangents])
    no_turn = torch.arange(22) > 0
    assert whole_parts(space, no_turn)[1].nonzero().flatten().tolist() == list(range(9, 15))
    angle = rotation_error(space.plus(truth, 0.5 * torch.eye(21)[1]), truth, space=space)
    torch.testing.assert_close(angle.deg2rad(), torch.tensor([0.5]))


def test_noise_is_that_of_steps_in_the_sensors_axes():
    """For a mean and a covariance what an ensemble draws, to first order, wherever the mean is."""
    torch.manual_seed(0)
    space, stands = LeggedSpace(2), torch.tensor([True, False])
    state = space.exp(torch.randn(space.tangent_dim))
    drawn, cov = (LeggedMotionNoise(2, DT, LeggedNoises(), ensemble=both).double() for both in (True, False))
    step = lambda tangent: space.minus(drawn.space.plus(state, tangent), state)  # noqa: E731
    jacobian = torch.func.jacrev(step)(torch.zeros(space.tangent_dim))
    expected = jacobian @ drawn.compute(stands).diag() @ jacobian.mT
    torch.testing.assert_close(cov.compute(state, stands), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("contact", [torch.bool, torch.float32])
def test_the_jacobian_of_members_is_that_of_each(contact):
    motion, batch = LeggedMotion(2, "dt", moves_key="moves"), (2, 3)
    state = motion.space.exp(torch.randn(*batch, 4, motion.space.tangent_dim))
    read = [torch.randn(*batch, 6), torch.randn(*batch, 6), (torch.rand(*batch, 2) < 0.5).to(contact)]
    read += [torch.randn(*batch, 6), torch.full((*batch, 1), DT)]
    moved, jacobian = motion.jacobian(state, *read)
    each = [motion.jacobian(member.unsqueeze(-2), *read) for member in state.unbind(-2)]
    torch.testing.assert_close(moved, torch.cat([one for one, _ in each], -2))
    torch.testing.assert_close(jacobian, torch.cat([one for _, one in each], -3))


class Hartley:
    """The filter of Hartley et al. 2020, section 5, with all feet on the ground; errors in our order."""

    def __init__(self, mean, cov, noises):
        self.turn, self.cov, self.n = rotation_matrix(mean[:4]).numpy(), cov.numpy().copy(), noises
        self.vectors = mean[4:10].reshape(2, 3).numpy().copy()
        self.bias, self.feet = mean[10:16].numpy().copy(), mean[16:].reshape(-1, 3).numpy().copy()

    def world(self):
        """Returns the velocity, position, feet, and where their errors stand."""
        places = [slice(3, 6), slice(6, 9), *(slice(15 + 3 * k, 18 + 3 * k) for k in range(len(self.feet)))]
        return zip([*self.vectors, *self.feet], places, strict=True)

    def predict(self, imu):
        size, n, gravity = len(self.cov), self.n, GRAVITY.numpy()
        rate, force = np.split(imu - self.bias, 2)
        drift, spread = np.zeros((size, size)), np.eye(size)
        drift[3:6, :3], drift[6:9, 3:6] = cross(gravity), np.eye(3)
        spread[:3, :3] = self.turn
        drift[:3, 9:12], drift[3:6, 12:15] = -self.turn, -self.turn
        for vector, place in self.world():
            drift[place, 9:12] -= cross(vector) @ self.turn
            spread[place, :3], spread[place, place] = cross(vector) @ self.turn, self.turn
        noise = [n.gyro, n.accelerometer, 0.0, n.gyro_walk, n.accelerometer_walk, *[n.slip] * len(self.feet)]
        noise = np.diag(np.repeat(np.square(noise), 3))
        move = series(DT * drift)
        self.cov = move @ (self.cov + DT * spread @ noise @ spread.T) @ move.T
        turn = DT * cross(rate)
        once, twice = series(turn, 1) @ force, series(turn, 2) @ force
        velocity, position = self.vectors
        moved = position + DT * velocity + DT**2 * (self.turn @ twice + gravity / 2)
        self.vectors = np.stack([velocity + DT * (self.turn @ once + gravity), moved])
        self.turn = self.turn @ series(turn)

    def update(self, feet):
        size = len(self.cov)
        reading = np.zeros((3 * len(self.feet), size))
        for foot in range(len(self.feet)):
            reading[3 * foot : 3 * foot + 3, 6:9] = -np.eye(3)
            reading[3 * foot : 3 * foot + 3, 15 + 3 * foot : 18 + 3 * foot] = np.eye(3)
        innovation = (feet.reshape(-1, 3) @ self.turn.T - (self.feet - self.vectors[1])).ravel()
        total = reading @ self.cov @ reading.T + self.n.kinematics**2 * np.eye(len(innovation))
        gain = self.cov @ reading.T @ np.linalg.inv(total)
        step, turned = gain @ innovation, cross((gain @ innovation)[:3])
        found = [series(turned) @ vector + series(turned, 1) @ step[place] for vector, place in self.world()]
        self.turn, self.bias = series(turned) @ self.turn, self.bias + step[9:15]
        self.vectors, self.feet = np.stack(found[:2]), np.stack(found[2:])
        self.cov = (np.eye(size) - gain @ reading) @ self.cov


def cross(vector):
    return np.cross(vector, -np.eye(3))


def series(matrix, later=0):
    """Returns the exponential of a matrix, or its integrals."""
    return sum(np.linalg.matrix_power(matrix, k) / math.factorial(k + later) for k in range(12))


def test_equals_the_filter_of_hartley():
    """Forty rows of a quadruped that stands and bends its legs, from a start that is tilted by ten degrees."""
    env, noises = quadruped_env(seed=0), LeggedNoises(tilt=0.2)
    row, rows = env.reset(), []
    for step in range(40):
        rows.append(row.select("imu", "joints", "contact", "true"))
        row = env.step(row.set("action", torch.full((12,), 0.1 * math.sin(0.2 * step), dtype=torch.float32)))["next"]
    log = torch.stack(rows).double()
    log["contact"] = torch.ones(40, 4, dtype=torch.bool)
    filter = legged_filter(env.model, **QUADRUPED, dt=DT, kind="EKF", noises=noises, rates_key=None).double()
    space, belief = LeggedSpace(4), filter.initialise(log[0])
    tilt = torch.cat([torch.tensor([0.17, 0.0, 0.0]), torch.zeros(24)])
    belief["belief", "mean"] = space.plus(belief["belief", "mean"], tilt)
    other = Hartley(belief["belief", "mean"], belief["belief", "cov"], noises)
    for row in log[1:]:
        belief = filter.step(belief.update(row))
        other.predict(row["imu"].numpy())
        other.update(belief["legs", "feet"].numpy())
    mean, cov = belief["belief", "mean"], belief["belief", "cov"]
    sensor = LegKinematics(env.model, **QUADRUPED).base.double()
    true = SO3().compose(log[-1]["true", "orientation"], sensor[:4])
    up = [rotation_matrix(turn)[2] for turn in (mean[:4], true)]
    assert torch.acos(up[0] @ up[1]).rad2deg() < 2, "it finds where up is"
    assert np.abs(rotation_matrix(mean[:4]).numpy() - other.turn).max() < 2e-3
    assert np.abs(mean[4:10].numpy() - other.vectors.ravel()).max() < 2e-3
    assert np.abs(mean[10:16].numpy() - other.bias).max() < 2e-3
    assert np.abs(mean[16:].numpy() - other.feet.ravel()).max() < 2e-3
    std = cov.diagonal().sqrt().numpy()
    np.testing.assert_allclose(std, np.sqrt(np.diag(other.cov)), rtol=0.03)
