"""The motion of fifteen states: a pose, and velocities and accelerations in the body's axes that stay as they are."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from torch_denkf.functional.manifolds import Circle, Euclidean, Product
from torch_denkf.motions.motion import Motion
from torch_denkf.submodel import SubModel

__all__ = ["ANGLES", "STATES", "RobotMotion", "RobotNoise", "STATE_SPACE"]

STATES = (
    *("x", "y", "z", "roll", "pitch", "yaw"),
    *("vx", "vy", "vz", "vroll", "vpitch", "vyaw"),
    *("ax", "ay", "az"),
)
ANGLES = (3, 4, 5)
STATE_SPACE = Product(Euclidean(3), Circle(), Circle(), Circle(), Euclidean(9))


class RobotMotion(Motion):
    r"""A body whose velocity and acceleration, in its own axes, and turn rates stay as they are.

    The state is x, y and z in m; roll, pitch and yaw in rad, :math:`R = R_z R_y R_x`; the velocity in m/s, the turn
    rates in rad/s and the acceleration in m/s^2, in the body's axes. Near a pitch of half a turn it is singular.

    Args:
        dt: time step in seconds, or the key of an entry ``[*B, 1]`` with the seconds since the last step.
        in_key: the belief's ensemble ``[*B, E, 15]``.
        out_key: forecast ensemble ``[*B, E, 15]``.

    Reference:
        Moore, Stouch, "A generalized extended Kalman filter implementation for the Robot Operating System", 2014.

    Example:
        >>> from tensordict import TensorDict
        >>> state = torch.zeros(1, 15)
        >>> state[0, 5], state[0, 6] = torch.pi / 2, 2.0  # it looks along y
        >>> moved = RobotMotion(0.5)(TensorDict({("belief", "ensemble"): state}))["forecast", "ensemble"]
        >>> moved[0, :2].round(decimals=3).abs()
        tensor([0., 1.])
    """

    def __init__(
        self,
        dt: float | NestedKey,
        *,
        in_key: NestedKey = ("belief", "ensemble"),
        out_key: NestedKey = ("forecast", "ensemble"),
    ):
        super().__init__(STATE_SPACE, dt, {}, in_key, out_key)

    def move(self, state, *, dt):
        """The pose moved by velocity and acceleration, the velocity by the acceleration."""
        place, angles, velocity, rates, force = state.split([3, 3, 3, 3, 3], -1)
        way = velocity * dt + 0.5 * force * dt * dt
        (sr, sp, sy), (cr, cp, cy) = angles.sin().unbind(-1), angles.cos().unbind(-1)
        x, y, z = way.unbind(-1)
        y, z = cr * y - sr * z, sr * y + cr * z
        x, z = cp * x + sp * z, cp * z - sp * x
        moved = torch.stack([cy * x - sy * y, sy * x + cy * y, z], -1)
        p, q, r = rates.unbind(-1)
        turn = (sr * q + cr * r) / cp
        turned = angles + torch.stack([p + sp * turn, cr * q - sr * r, turn], -1) * dt
        turned = turned - 2 * torch.pi * (turned / (2 * torch.pi)).round().detach()
        return torch.cat([place + moved, turned, velocity + force * dt, rates, force], -1)

    def noise_of_step(self, dt):
        """None of its own: see :class:`RobotNoise`."""
        return [0.0]


class RobotNoise(SubModel):
    """Process noise of the fifteen states, a covariance for each second, scaled by what is learned.

    Args:
        cov: of a second, ``[15, 15]``.
        dt: time step in seconds, or the key of an entry ``[*B, 1]``.
        dynamic: whether that of the pose is multiplied by the square of the speed, turn rates included.
        out_key: the covariance ``[*B, 15, 15]``.
    """

    cov: Tensor

    def __init__(
        self, cov: Tensor, dt: float | NestedKey, dynamic: bool = False, out_key: NestedKey = ("forecast", "noise")
    ):
        keys = [] if isinstance(dt, float) else [dt]
        super().__init__(nn.Identity(), [("belief", "mean"), *keys], [out_key])
        self.register_buffer("cov", cov)
        self.dt, self.dynamic = dt, dynamic
        self.log_scale = nn.Parameter(torch.zeros(len(STATES), dtype=cov.dtype))

    def compute(self, mean, *dt):
        """The covariance of the step."""
        scale = self.log_scale.exp()
        cov = (self.cov * scale * scale.unsqueeze(-1)).to(mean.dtype)
        if self.dynamic:
            speed = torch.linalg.vector_norm(mean[..., 6:12], dim=-1, keepdim=True)
            factor = torch.cat([speed.expand(*speed.shape[:-1], 6), torch.ones_like(mean[..., 6:])], -1)
            block = torch.zeros_like(cov)
            block[:6, :6] = 1.0
            apart = cov * (1 - block)  # what couples pose and velocity stays as it is
            cov = cov * block * factor.unsqueeze(-1) * factor.unsqueeze(-2) + apart
        step = dt[0].to(mean.dtype).unsqueeze(-1) if dt else self.dt
        return cov * step if dt or self.dynamic else (cov * step).expand(*mean.shape[:-1], 15, 15)
