"""Motion model of a legged robot, by an inertial sensor and foot contacts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from torch_denkf.applications.legged.noises import LeggedNoises
from torch_denkf.functional.manifolds import (
    SE23,
    Euclidean,
    Opposite,
    Product,
    Space,
    Turned,
    rotate,
    rotation_matrix,
    skew,
)
from torch_denkf.modules import SubModel
from torch_denkf.motions import InertialMotion
from torch_denkf.motions.motion import Motion
from torch_denkf.motions.time_step import keys_of_dt

__all__ = ["LeggedMotion", "LeggedMotionNoise", "LeggedSpace"]


@dataclass(frozen=True)
class LeggedSpace(Space):
    """State space: the inertial sensor's pose with its velocity, its biases, and the feet in the world.

    A point has 16 + 3 F numbers: orientation (4), velocity in m/s and position in m (3 each), both in the world's axes;
    the gyro's bias in rad/s and the accelerometer's in m/s^2; then each foot's position in m.

    A tangent has 15 + 3 F components in the same order. The first three rotate the world about its origin: velocity,
    position and feet rotate with the sensor. The kinematics of the feet are invariant to that, so a filter with a wrong
    initial inclination gets no spurious information on it from the feet.

    Args:
        feet: F.

    Source:
        Hartley, Ghaffari, Eustice & Grizzle 2020, IJRR 39.
    """

    feet: int
    _angles = 3
    #: The same with the biases at the end; made once, as torch.compile cannot trace how it is made.
    in_groups: Product = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        object.__setattr__(self, "in_groups", Product(Opposite(Turned(2 + self.feet)), Euclidean(6)))

    @property
    def point_dim(self) -> int:  # type: ignore[override]
        """Returns 16 + 3 F."""
        return 16 + 3 * self.feet

    @property
    def tangent_dim(self) -> int:  # type: ignore[override]
        """Returns 15 + 3 F."""
        return 15 + 3 * self.feet

    def compose(self, first, second):
        """Composes in reverse order: the second, then the first; biases add up."""
        return _in_order(self.in_groups.compose(_in_groups(first, 10), _in_groups(second, 10)), 10)

    def inverse(self, point):
        """Returns the inverse element."""
        return _in_order(self.in_groups.inverse(_in_groups(point, 10)), 10)

    def exp(self, tangent):
        """Returns the end of a step at a constant rate: the exponential map."""
        return _in_order(self.in_groups.exp(_in_groups(tangent, 9)), 10)

    def log(self, point):
        """Returns the step that leads to a point: the inverse of :meth:`exp`."""
        return _in_order(self.in_groups.log(_in_groups(point, 10)), 9)

    def right_jacobian(self, tangent):
        """Returns that of a step in the world's axes."""
        return _matrix_in_order(self.in_groups.right_jacobian(_in_groups(tangent, 9)))

    def adjoint(self, point):
        """Takes errors in the world's axes to the sensor's."""
        return _matrix_in_order(self.in_groups.adjoint(_in_groups(point, 10)))

    def basis(self, point):
        """Returns the derivative of points by steps in the world's axes."""
        return _matrix_in_order(self.in_groups.basis(_in_groups(point, 10)), rows=10)

    def dual_basis(self, point):
        """Returns the step in the world's axes that leads to a point nearby."""
        return _matrix_in_order(self.in_groups.dual_basis(_in_groups(point, 10)), columns=10)

    def neutral(self, like=None):
        """Returns no rotation and zeros."""
        return _in_order(self.in_groups.neutral(like), 10)

    def normalise(self, point):
        """Scales the quaternion to length one."""
        return _in_order(self.in_groups.normalise(_in_groups(point, 10)), 10)

    def near(self, points, weights=None):
        """Works part by part."""
        return _in_order(self.in_groups.near(_in_groups(points, 10), weights), 10)

    def _whole(self, known):
        # A vector's step needs the orientation and that vector alone: labels may be of the base, without feet.
        turn, biases = known[..., :4].all(-1, keepdim=True), known[..., 10:16]
        vectors = torch.cat([known[..., 4:10], known[..., 16:]], -1).unflatten(-1, (-1, 3)).all(-1)
        vectors = (turn & vectors).repeat_interleave(3, -1)
        return tuple(
            torch.cat([turn.expand(*turn.shape[:-1], size), vectors[..., :6], biases, vectors[..., 6:]], -1)
            for size in (4, 3)
        )


def _in_groups(value: Tensor, begin: int) -> Tensor:
    """Returns points or tangents with the biases, which begin there, at the end."""
    return torch.cat([value[..., :begin], value[..., begin + 6 :], value[..., begin : begin + 6]], -1)


def _in_order(value: Tensor, begin: int) -> Tensor:
    """Returns the inverse of :func:`_in_groups`."""
    return torch.cat([value[..., :begin], value[..., -6:], value[..., begin:-6]], -1)


def _matrix_in_order(value: Tensor, rows: int = 9, columns: int = 9) -> Tensor:
    return _in_order(_in_order(value, columns).mT, rows).mT


class LeggedMotion(Motion):
    r"""Moves the base by its inertial sensor; stance feet stay, swing feet are set to their kinematics.

    A swing foot is at :math:`p + R k`, with the sensor's pose R, p and the foot's position k by the joints. That is the
    limit of infinite process noise of the foot, after the update; it avoids large spurious correlations of swing feet
    in an ensemble.

    Args:
        feet: F.
        dt: time step in seconds, or the key of an entry ``[*B, 1]``.
        gravity: in m/s^2.
        imu_key: entry ``[*B, 6]``: gyro in rad/s, accelerometer in m/s^2, in the sensor's axes.
        feet_key: positions of the feet by the joints ``[*B, 3 F]`` in m, in the sensor's axes.
        contact_key: contact of each foot, ``[*B, F]`` bool.
        moves_key: velocities of stance feet, ``[*B, 3 F]`` in m/s, in the sensor's axes; ``None`` for zero.
    """

    drift: Tensor

    def __init__(
        self,
        feet: int,
        dt: float | NestedKey,
        *,
        gravity: float = 9.81,
        imu_key: NestedKey = "imu",
        feet_key: NestedKey = ("legs", "feet"),
        contact_key: NestedKey = "contact",
        moves_key: NestedKey | None = None,
    ):
        actions = {imu_key: 6, feet_key: 3 * feet, contact_key: feet}
        if moves_key is not None:
            actions[moves_key] = 3 * feet
        space: Any = LeggedSpace(feet)  # no Product: the motion uses the space as a whole
        super().__init__(space, dt, actions, ("belief", "ensemble"), ("forecast", "ensemble"))
        self.inertial = InertialMotion(dt, gravity=gravity)
        # Rates of change of the errors of orientation, velocity and position.
        drift = torch.zeros(9, 9)
        drift[3:6, :3], drift[6:, 3:6] = skew(torch.tensor([0.0, 0.0, -gravity])), torch.eye(3)
        self.register_buffer("drift", drift, persistent=False)

    def move(self, state, imu, feet, contact, *moves, dt):
        """Returns the states after one step."""
        base = self.inertial.move(state[..., :16], imu, dt=dt)
        turn, place = base[..., None, :4], base[..., None, 7:10]
        by_joints = place + rotate(turn, feet.unflatten(-1, (-1, 3)))
        stands = contact.unsqueeze(-1) > 0
        standing = state[..., 16:]
        if moves:
            standing = standing + dt * rotate(turn, moves[0].unflatten(-1, (-1, 3))).flatten(-2)
        moved = torch.where(stands, standing.unflatten(-1, (-1, 3)), by_joints)
        return torch.cat([base, moved.flatten(-2)], -1)

    def move_and_gradient(self, state, imu, feet, contact, *moves, dt):
        """Returns both; steps on the space turn the world, so that only gravity and the biases mix what they move."""
        moved = self.move(state, imu, feet, contact, *moves, dt=dt)
        to_world, stands = rotation_matrix(moved[..., :4]).unsqueeze(-3), contact.repeat_interleave(3, -1) > 0
        by_biases = self.inertial.gradient(state[..., :16], imu, dt=dt)[..., :9, 9:]
        turn, *others = (to_world @ by_biases.unflatten(-2, (3, 3))).unbind(-3)
        lever = torch.cat([moved[..., 4:10], state[..., 16:]], -1).unflatten(-1, (-1, 3))
        turned = torch.linalg.cross(*torch.broadcast_tensors(lever.unsqueeze(-1), turn.unsqueeze(-3)), dim=-2)
        by_biases = torch.cat([turn, turned[..., :2, :, :].flatten(-3, -2) + torch.cat(others, -2)], -2)
        return moved, self._assembled(by_biases, turned[..., 2:, :, :].flatten(-3, -2), stands, dt)

    def _assembled(self, by_biases: Tensor, feet_by_biases: Tensor, stands: Tensor, dt: Any) -> Tensor:
        """Returns the Jacobian; the rows of a swing foot are those of the position.

        Args:
            by_biases: rows of orientation, velocity and position, columns of the biases, ``[*, 9, 6]``.
            feet_by_biases: rows of stance feet, ``[*, 3 F, 6]``.
            stands: which rows these are, ``[*, 3 F]``.
            dt: seconds, a number or ``[*, 1]``.
        """
        batch, count = by_biases.shape[:-2], stands.shape[-1]
        eye = torch.eye(15 + count, dtype=by_biases.dtype, device=by_biases.device)
        step = (dt.unsqueeze(-1) if isinstance(dt, Tensor) else dt) * self.drift.to(eye)
        base = eye[:9, :9] + step + step @ step / 2
        base = torch.cat([base.expand(*batch, 9, 9), by_biases], -1)
        place = base[..., 6:, :].repeat(*[1] * len(batch), count // 3, 1)
        on_ground = nn.functional.pad(feet_by_biases, (9, 0))
        feet = torch.where(stands.unsqueeze(-1), on_ground, place)
        rows = [
            nn.functional.pad(base, (0, count)),
            eye[9:15].expand(*batch, 6, 15 + count),
            torch.cat([feet, stands.to(eye).diag_embed().expand(*batch, count, count)], -1),
        ]
        return torch.cat(rows, -2)


class LeggedMotionNoise(SubModel):
    """Process noise of a step of :class:`LeggedMotion`, given the foot contacts.

    Stance feet have the noise of slip, swing feet that of the kinematics.

    Args:
        feet: F.
        dt: time step in seconds, or the key of an entry ``[*B, 1]``.
        noises: of sensors and feet.
        ensemble: whether the belief is an ensemble: it gets variances ``[*B, 15 + 3 F]`` of steps on :attr:`space`, in
            the sensor's axes. A mean and a covariance get a covariance of tangents of :class:`LeggedSpace`.
        contact_key: contact of each foot, ``[*B, F]`` bool.
        slip_key: variance of a stance foot's velocity, independent in each step, in m^2/s^2, ``[*B, F]``; ``None`` for
            the slip of ``noises``.
    """

    base: Tensor
    powers: Tensor
    slip: Tensor
    air: Tensor

    def __init__(
        self,
        feet: int,
        dt: float | NestedKey,
        noises: LeggedNoises,
        *,
        ensemble: bool = False,
        contact_key: NestedKey = "contact",
        slip_key: NestedKey | None = None,
    ):
        self.dt, self.learned, self.ensemble = dt, slip_key is not None, ensemble
        self.space, self.world = Product(SE23(), Euclidean(6 + 3 * feet)), LeggedSpace(feet)
        mean = [] if ensemble else [("forecast", "mean")]
        more = [*([] if slip_key is None else [slip_key]), *keys_of_dt(dt)]
        super().__init__(nn.Identity(), [*mean, contact_key, *more], [("forecast", "noise")])
        n = noises
        densities = [n.gyro, n.accelerometer, n.accelerometer / 3**0.5, n.gyro_walk, n.accelerometer_walk]
        self.register_buffer("base", torch.tensor(densities).square().repeat_interleave(3))
        self.register_buffer("powers", torch.tensor([1.0, 1.0, 3.0, 1.0, 1.0]).repeat_interleave(3))
        self.register_buffer("slip", torch.tensor(n.slip**2))
        self.register_buffer("air", torch.tensor(n.kinematics**2))

    def compute(self, *entries):
        """Returns variances, or the covariance."""
        mean, (contact, *more) = (None, entries) if self.ensemble else (entries[0], entries[1:])
        dt = self.slip.new_full((), self.dt) if len(more) == self.learned else more[-1].to(self.slip.dtype)
        slip = more[0] * dt if self.learned else self.slip
        base = (self.base * dt**self.powers).expand(*contact.shape[:-1], 15)
        var = torch.cat([base, torch.where(contact, slip * dt, self.air).repeat_interleave(3, -1)], -1)
        if mean is None:
            return var
        # The three axes of a foot have one variance, which is the same in the sensor's axes and the world's.
        to_world = self.world.adjoint(self.world.inverse(mean))
        return to_world @ (var.unsqueeze(-1) * to_world.mT)
