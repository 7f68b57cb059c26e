"""Observations from the joints of a legged robot: positions and velocities of its feet, and its first pose."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from torch_denkf._checks import check_number
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.functional.kernels.small_system import on_gpu
from torch_denkf.functional.manifolds import SO3, Euclidean, Space, quaternion_product, rotate, rotation_matrix, skew
from torch_denkf.modules import SubModel
from torch_denkf.motions.time_step import keys_of_dt

__all__ = ["FeetInBody", "FeetRates", "LegReadings"]


class LegReadings(SubModel):
    """Writes the filter's observations from the joints, and the initial state of a robot at rest.

    That state has the inclination by the accelerometer, position zero and heading zero; without an accelerometer
    reading, as in a rejected row, the base's z points up.

    Args:
        kinematics: of the robot's legs.
        dt: time step in seconds, or the key of an entry ``[*B, 1]``, positive, which is checked here.
        imu_key: entry ``[*B, 6]``: gyro in rad/s, accelerometer in m/s^2, in the sensor's axes.
        joints_key: angles ``[*B, J]`` in rad.
        rates_key: joint rates ``[*B, J]`` in rad/s; ``None`` for no such sensor.
        contact_key: contact of each foot, ``[*B, F]`` bool.
        prefix: prefix of the outputs: ``feet`` ``[*B, 3 F]`` in m, ``observed`` ``[*B, 3 F]`` bool, ``start`` ``[*B, 16
            + 3 F]``, and ``rates`` ``[*B, 3 F]`` in m/s if there is ``rates_key``.
    """

    def __init__(
        self,
        kinematics: LegKinematics,
        dt: float | NestedKey,
        *,
        imu_key: NestedKey = "imu",
        joints_key: NestedKey = "joints",
        rates_key: NestedKey | None = None,
        contact_key: NestedKey = "contact",
        prefix: str = "legs",
    ):
        rates = [] if rates_key is None else [rates_key]
        names = ["feet", "observed", "start", *(["rates"] if rates else [])]
        self.steps = keys_of_dt(dt)
        in_keys = [imu_key, joints_key, contact_key, *self.steps, *rates]
        super().__init__(kinematics, in_keys, [(prefix, name) for name in names])

    def compute(self, imu, joints, contact, *others):
        """Returns the feet, their contacts, the initial state, and the feet's velocities."""
        kinematics, values = self.module, (imu, joints, contact, *others)
        sizes = [6, len(kinematics.joints), len(kinematics.feet), *[1] * len(self.steps), len(kinematics.joints)]
        for key, size, value in zip(self.in_keys, sizes, values, strict=False):
            if value.shape != (*imu.shape[:-1], size):
                raise ValueError(f"{key!r} of this robot is [*B, {size}]; got {list(value.shape)}.")
        if self.steps and not on_gpu(joints):
            check_number(repr(self.steps[0]), others[0], above=0, cure="It is the time step in seconds")
        rates = others[-1].to(kinematics.base.dtype) if len(others) > len(self.steps) else None
        joints = joints.to(kinematics.base.dtype)
        feet, *moves = [kinematics(joints)] if rates is None else kinematics.moving(joints, rates)
        begin = self._start(imu[..., 3:].to(feet.dtype), feet)
        return feet.flatten(-2), contact.repeat_interleave(3, -1), begin, *(value.flatten(-2) for value in moves)

    def _start(self, force: Tensor, feet: Tensor) -> Tensor:
        sensor = self.module.base
        up = rotate(sensor[:4], force)
        length = torch.linalg.vector_norm(up, dim=-1, keepdim=True)
        up = torch.where(length == 0, torch.eye(3, dtype=up.dtype, device=up.device)[2], up / length)
        x, y, z = up.split(1, -1)
        turn = torch.cat([1 + z, y, -x, torch.zeros_like(z)], -1)  # the shortest from there to the world's z
        about_x = torch.eye(4, dtype=up.dtype, device=up.device)[1]
        turn = torch.where(z < -1 + 1e-6, about_x, turn)  # upside down, all are as short
        turn = SO3().compose(turn / torch.linalg.vector_norm(turn, dim=-1, keepdim=True), sensor[:4].expand_as(turn))
        place = rotate(quaternion_product(turn, SO3().inverse(sensor[:4]).expand_as(turn)), sensor[4:])
        standing = place.unsqueeze(-2) + rotate(turn.unsqueeze(-2), feet)
        still = torch.zeros_like(place)
        return torch.cat([turn, still, place, still, still, standing.flatten(-2)], -1)


class FeetInBody(SubModel):
    r"""Observes the feet in the inertial sensor's axes, :math:`R^\top (f_i - p)`, of forecast states.

    Args:
        space: of the states, :class:`~torch_denkf.applications.legged.motion.LeggedSpace`.
        in_key: states to observe ``[*B, E, P]``.
        out_key: predicted readings ``[*B, E, 3 F]`` in m.
    """

    def __init__(
        self,
        space: Space,
        *,
        in_key: NestedKey = ("forecast", "ensemble"),
        out_key: NestedKey = ("forecast", "observation"),
    ):
        super().__init__(nn.Identity(), [in_key], [out_key])
        self.observed_space, self.tangents_of = space, (space, Euclidean(space.tangent_dim - 15))

    def compute(self, state):
        """Returns the predicted readings."""
        self.observed_space.check(point=state)
        return _feet(state).flatten(-2)

    def jacobian(self, state):
        """Returns both: what turns the world changes no reading."""
        to_body = rotation_matrix(state[..., None, :4]).mT
        none = torch.zeros_like(to_body)
        return self.compute(state), _of_feet(state, to_body, [none, none, -to_body, none, none])


class FeetRates(SubModel):
    r"""Observes velocities of stance feet in sensor axes, :math:`-R^\top v - (\omega - b) \times R^\top (f_i - p)`.

    The readings follow from the joint rates, and determine the base's velocity.

    Args:
        space: of the states, :class:`~torch_denkf.applications.legged.motion.LeggedSpace`.
        imu_key: entry ``[*B, 6]``, of which the gyro is read, in rad/s.
        moves_key: velocities of stance feet, ``[*B, 3 F]`` in m/s, in the sensor's axes; ``None`` for zero.
        in_key: states to observe ``[*B, E, P]``.
        out_key: predicted readings ``[*B, E, 3 F]`` in m/s.
    """

    def __init__(
        self,
        space: Space,
        *,
        imu_key: NestedKey = "imu",
        moves_key: NestedKey | None = None,
        in_key: NestedKey = ("forecast", "ensemble"),
        out_key: NestedKey = ("forecast", "observation"),
    ):
        super().__init__(nn.Identity(), [in_key, imu_key, *([] if moves_key is None else [moves_key])], [out_key])
        self.observed_space, self.tangents_of = space, (space, Euclidean(space.tangent_dim - 15))

    def compute(self, state, imu, moves=None):
        """Returns the predicted readings."""
        self.observed_space.check(point=state)
        turn = self._turn(state, imu)
        velocity = rotate(state[..., :4], state[..., 4:7], back=True).unsqueeze(-2)
        rates = (-velocity - torch.linalg.cross(*torch.broadcast_tensors(turn, _feet(state)))).flatten(-2)
        return rates if moves is None else rates + moves.to(rates.dtype).unsqueeze(-2)

    def jacobian(self, state, imu, moves=None):
        """Returns both."""
        to_body, turn = rotation_matrix(state[..., None, :4]).mT, self._turn(state, imu).unsqueeze(-1)
        by_place = torch.linalg.cross(*torch.broadcast_tensors(turn, to_body), dim=-2)
        none = torch.zeros_like(to_body)
        columns = [none, -to_body, by_place, -skew(_feet(state)), none]
        return self.compute(state, imu, moves), _of_feet(state, -by_place, columns)

    def _turn(self, state: Tensor, imu: Tensor) -> Tensor:
        return (imu[..., :3].to(state.dtype).unsqueeze(-2) - state[..., 10:13]).unsqueeze(-2)


def _of_feet(state: Tensor, by_itself: Tensor, columns: list[Tensor]) -> Tensor:
    """Returns a Jacobian ``[*, 3 F, 15 + 3 F]`` from its blocks ``[*, F, 3, 3]``, or ``[*, 1, 3, 3]`` of all feet.

    Args:
        state: where, ``[*, 16 + 3 F]``.
        by_itself: of a foot's reading by that foot.
        columns: of the readings by orientation, velocity, position and the biases.
    """
    count = (state.shape[-1] - 16) // 3
    eye = torch.eye(count, dtype=state.dtype, device=state.device)
    own = (eye[:, None, :, None] * by_itself.unsqueeze(-2)).flatten(-2)
    shared = [block.expand(*own.shape[:-1], 3) for block in columns]
    return torch.cat([*shared, own], -1).flatten(-3, -2)


def _feet(state: Tensor) -> Tensor:
    """Returns the feet in the sensor's axes, ``[*, F, 3]``."""
    away = state[..., 16:].unflatten(-1, (-1, 3)) - state[..., None, 7:10]
    return rotate(state[..., None, :4], away, back=True)
