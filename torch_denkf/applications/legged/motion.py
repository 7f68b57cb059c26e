"""How a legged robot moves, by an inertial sensor and by which feet stand."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from torch_denkf.applications.legged.noises import LeggedNoises
from torch_denkf.functional.manifolds import SE23, Euclidean, Product, Space, _blocks, _RotationAndVectors, rotate
from torch_denkf.modules import SubModel
from torch_denkf.motions import InertialMotion
from torch_denkf.motions.motion import Motion
from torch_denkf.motions.time_step import keys_of_dt

__all__ = ["LeggedMotion", "LeggedMotionNoise", "legged_space"]


@dataclass(frozen=True)
class _Turned(_RotationAndVectors):
    """A rotation, and K vectors that it turns."""

    vectors: int

    @property
    def point_dim(self) -> int:  # type: ignore[override]
        """4 and three for each vector."""
        return 4 + 3 * self.vectors

    @property
    def tangent_dim(self) -> int:  # type: ignore[override]
        """3 and three for each vector."""
        return 3 + 3 * self.vectors


@dataclass(frozen=True)
class InvariantSpace(Space):
    """The points of :func:`legged_space`, whose errors are turns and steps of the world about its origin."""

    feet: int

    @property
    def point_dim(self) -> int:  # type: ignore[override]
        """16 + 3 F."""
        return 16 + 3 * self.feet

    @property
    def tangent_dim(self) -> int:  # type: ignore[override]
        """15 + 3 F."""
        return 15 + 3 * self.feet

    @property
    def group(self):
        return _Turned(2 + self.feet)

    def _split(self, value, pose):
        first, biases, feet = value[..., :pose], value[..., pose : pose + 6], value[..., pose + 6 :]
        return torch.cat([first, feet], -1), biases

    def _join(self, moved, biases, pose):
        return torch.cat([moved[..., :pose], biases, moved[..., pose:]], -1)

    def compose(self, first, second):
        (one, b1), (other, b2) = self._split(first, 10), self._split(second, 10)
        return self._join(self.group.compose(other, one), b1 + b2, 10)

    def inverse(self, point):
        one, b = self._split(point, 10)
        return self._join(self.group.inverse(one), -b, 10)

    def exp(self, tangent):
        one, b = self._split(tangent, 9)
        return self._join(self.group.exp(one), b, 10)

    def log(self, point):
        one, b = self._split(point, 10)
        return self._join(self.group.log(one), b, 9)

    def _matrix(self, block):
        six = torch.eye(6, dtype=block.dtype, device=block.device).expand(*block.shape[:-2], 6, 6)
        full = _blocks([block[..., :, :], six])
        n = block.shape[-1]
        order = [*range(9), *range(n, n + 6), *range(9, n)]
        return full[..., order, :][..., order]

    def right_jacobian(self, tangent):
        return self._matrix(self.group.right_jacobian(-self._split(tangent, 9)[0]))

    def adjoint(self, point):
        return self._matrix(self.group.adjoint(self.group.inverse(self._split(point, 10)[0])))

    def to_world(self, point):
        return self._matrix(self.group.adjoint(self._split(point, 10)[0]))

    def neutral(self, like=None):
        return legged_space(self.feet).neutral(like)

    def normalise(self, point):
        return legged_space(self.feet).normalise(point)

    def near(self, points, weights=None):
        return legged_space(self.feet).near(points, weights)


class WorldNoise(SubModel):
    def __init__(self, noise, space):
        super().__init__(noise, [("forecast", "mean"), *noise.in_keys], [("forecast", "noise")])
        self.space = space
        self.noise = noise

    def compute(self, mean, *more):
        var = self.noise.compute(*more)
        a = self.space.to_world(mean)
        return a @ (var.unsqueeze(-1) * a.mT)


def legged_space(feet: int) -> Product:
    """Where the states live: the inertial sensor's pose with its velocity, its biases, and the feet in the world.

    A point has 16 + 3 F numbers: orientation (4), velocity in m/s and position in m (3 each), both in the world's axes;
    the gyro's bias in rad/s and the accelerometer's in m/s^2; then each foot's position in m. A tangent has 15 + 3 F.
    """
    return Product(SE23(), Euclidean(3), Euclidean(3), Euclidean(3 * feet))


class LeggedMotion(Motion):
    r"""Moves the base as its inertial sensor says; a foot that stands stays, one in the air goes where its joints say.

    A foot in the air is :math:`p + R k`, with the sensor's pose R, p and the foot's place k by the joints. That is the
    limit of a foot that stays and has boundless process noise, once its reading is taken in; and members of an
    ensemble, whose feet in the air would show large correlations by chance, keep those that are due.

    Args:
        feet: F.
        dt: time step in seconds, or the key of an entry ``[*B, 1]``.
        gravity: in m/s^2.
        imu_key: entry ``[*B, 6]``: gyro in rad/s, accelerometer in m/s^2, in the sensor's axes.
        feet_key: places of the feet by the joints ``[*B, 3 F]`` in m, in the sensor's axes.
        contact_key: which of them stand, ``[*B, F]`` bool.
    """

    def __init__(
        self,
        feet: int,
        dt: float | NestedKey,
        *,
        gravity: float = 9.81,
        imu_key: NestedKey = "imu",
        feet_key: NestedKey = ("legs", "feet"),
        contact_key: NestedKey = "contact",
    ):
        actions = {imu_key: 6, feet_key: 3 * feet, contact_key: feet}
        super().__init__(legged_space(feet), dt, actions, ("belief", "ensemble"), ("forecast", "ensemble"))
        self.inertial = InertialMotion(dt, gravity=gravity)

    def move(self, state, imu, feet, contact, *, dt):
        """The states one step later."""
        base = self.inertial.move(state[..., :16], imu, dt=dt)
        turn, place = base[..., None, :4], base[..., None, 7:10]
        by_joints = place + rotate(turn, feet.unflatten(-1, (-1, 3)))
        stands = contact.unsqueeze(-1) > 0
        moved = torch.where(stands, state[..., 16:].unflatten(-1, (-1, 3)), by_joints)
        return torch.cat([base, moved.flatten(-2)], -1)


class LeggedMotionNoise(SubModel):
    """Variances ``[*B, 15 + 3 F]`` that a step of :class:`LeggedMotion` adds, by which feet stand.

    A foot that stands slips a little; one in the air is where its joints say but for their error.

    Args:
        feet: F.
        dt: time step in seconds, or the key of an entry ``[*B, 1]``.
        noises: of sensors and feet.
        contact_key: which feet stand, ``[*B, F]`` bool.
        slip_key: how a standing foot walks at random, in m^2/s, ``[*B, F]``; ``None`` for that of ``noises``.
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
        contact_key: NestedKey = "contact",
        slip_key: NestedKey | None = None,
    ):
        self.dt, self.learned = dt, slip_key is not None
        more = [*([] if slip_key is None else [slip_key]), *keys_of_dt(dt)]
        super().__init__(nn.Identity(), [contact_key, *more], [("forecast", "noise")])
        n = noises
        densities = [n.gyro, n.accelerometer, n.accelerometer / 3**0.5, n.gyro_walk, n.accelerometer_walk]
        self.register_buffer("base", torch.tensor(densities).square().repeat_interleave(3))
        self.register_buffer("powers", torch.tensor([1.0, 1.0, 3.0, 1.0, 1.0]).repeat_interleave(3))
        self.register_buffer("slip", torch.tensor(n.slip**2))
        self.register_buffer("air", torch.tensor(n.kinematics**2))

    def compute(self, contact, *more):
        """The variances."""
        slip = more[0] if self.learned else self.slip
        dt = self.slip.new_tensor(self.dt) if len(more) == self.learned else more[-1].to(self.slip.dtype)
        base = (self.base * dt**self.powers).expand(*contact.shape[:-1], 15)
        return torch.cat([base, torch.where(contact, slip * dt, self.air).repeat_interleave(3, -1)], -1)
