"""The motion of fifteen states: a pose, and velocities and accelerations in the body's axes that stay as they are."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from torch_denkf.functional.manifolds import Circle, Euclidean, Product
from torch_denkf.motions.motion import Motion
from torch_denkf.submodel import SubModel

__all__ = ["ANGLES", "STATES", "Drifts", "RobotMotion", "RobotNoise", "state_space"]

STATES = (
    *("x", "y", "z", "roll", "pitch", "yaw"),
    *("vx", "vy", "vz", "vroll", "vpitch", "vyaw"),
    *("ax", "ay", "az"),
)
ANGLES = (3, 4, 5)


def state_space(drifts: int = 0) -> Product:
    """Returns the space of the fifteen states, and of drifts behind them."""
    return Product(Euclidean(3), Circle(), Circle(), Circle(), Euclidean(9 + drifts))


class Drifts(nn.Module):
    """Slow errors of readings, K Ornstein-Uhlenbeck processes of the time in seconds, whose size and time are learned.

    Args:
        std: standard deviations in the long run ``[K]``.
        time: seconds in which each fades to 1/e, ``[K]``.
    """

    def __init__(self, std: Tensor, time: Tensor):
        super().__init__()
        self.log_std, self.log_time = nn.Parameter(std.log()), nn.Parameter(time.log())

    def __len__(self) -> int:
        return len(self.log_std)

    @property
    def variance(self) -> Tensor:
        """Returns the variances in the long run ``[K]``."""
        return (2 * self.log_std).exp()

    def decay(self, dt: float | Tensor) -> Tensor:
        """Returns the shares that are left after ``dt`` seconds, ``[*, K]`` for ``[*, 1]``."""
        return (-dt * (-self.log_time).exp()).exp()


class RobotMotion(Motion):
    r"""A body whose velocity and acceleration, in its own axes, and turn rates stay as they are.

    The state is x, y and z in m; roll, pitch and yaw in rad, :math:`R = R_z R_y R_x`; the velocity in m/s, the turn
    rates in rad/s and the acceleration in m/s^2, in the body's axes. Near a pitch of half a turn it is singular.

    Args:
        dt: time step in seconds, or the key of an entry ``[*B, 1]`` with the seconds since the last step.
        drifts: K slow errors of readings, which stand behind the fifteen; shared with :class:`RobotNoise`.
        held: whether velocities and turn rates are means of the coming step, so that the body moves along the heading
            of its middle. Otherwise they are those of its beginning, as in robot_localization.
        in_key: the belief's ensemble ``[*B, E, 15 + K]``.
        out_key: forecast ensemble ``[*B, E, 15 + K]``.

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
        drifts: Drifts | None = None,
        held: bool = False,
        *,
        in_key: NestedKey = ("belief", "ensemble"),
        out_key: NestedKey = ("forecast", "ensemble"),
    ):
        super().__init__(state_space(0 if drifts is None else len(drifts)), dt, {}, in_key, out_key)
        self.drifts, self.held = drifts, held

    def move(self, state, *, dt):
        """Returns the pose moved by velocity and acceleration, the velocity by the acceleration."""
        return self._moved(state, dt)[0]

    def move_and_gradient(self, state, *, dt):
        """Returns the states and the Jacobian."""
        moved, way, axes, rates, yaw = self._moved(state, dt)
        step = torch.as_tensor(dt, dtype=state.dtype, device=state.device).expand(*state.shape[:-1], 1).unsqueeze(-1)
        (sin, cos), (flat, tan) = (state[..., 3].sin(), state[..., 3].cos()), (state[..., 4].cos(), state[..., 4].tan())
        turn, across = sin * state[..., 10] + cos * state[..., 11], cos * state[..., 10] - sin * state[..., 11]
        zero, small = torch.zeros_like(turn), torch.eye(3, dtype=state.dtype, device=state.device)
        by_roll = torch.stack([tan * across, -turn, across / flat], -1)
        by_pitch = torch.stack([turn / flat**2, zero, turn * tan / flat], -1)
        by_angles = torch.stack([by_roll, by_pitch, torch.zeros_like(by_roll)], -1) * step
        by_rates = rates * step
        about_pitch = torch.stack([-yaw.sin(), yaw.cos(), zero], -1)  # the axes about which the angles turn
        about_yaw = torch.stack([-way[..., 1], way[..., 0], zero], -1)
        turned = [torch.linalg.cross(axes[..., 0], way), torch.linalg.cross(about_pitch, way), about_yaw]
        by_turn = torch.stack(turned, -1)
        out = torch.eye(state.shape[-1], dtype=state.dtype, device=state.device).repeat(*state.shape[:-1], 1, 1)
        out[..., :3, 3:6], out[..., :3, 6:9] = by_turn, axes * step
        if self.held:
            out[..., :3, 3:6] = by_turn + 0.5 * by_turn @ by_angles
            out[..., :3, 9:12] = 0.5 * by_turn @ by_rates
        else:
            out[..., :3, 12:15] = 0.5 * axes * step * step
        out[..., 3:6, 3:6], out[..., 3:6, 9:12], out[..., 6:9, 12:15] = small + by_angles, by_rates, small * step
        if self.drifts is not None:
            out[..., 15:, 15:] = self.drifts.decay(step.squeeze(-1)).diag_embed()
        return moved, out

    def _moved(self, state, dt):
        """Returns later states, distance travelled, body axes in the world, angle rates from turn rates, and yaw."""
        place, angles, velocity, rates, force, slow = state.split([3, 3, 3, 3, 3, state.shape[-1] - 15], -1)
        (sr, sp), (cr, cp) = angles[..., :2].sin().unbind(-1), angles[..., :2].cos().unbind(-1)
        one, zero = torch.ones_like(sr), torch.zeros_like(sr)
        columns = [one, zero, zero], [sr * sp / cp, cr, sr / cp], [cr * sp / cp, -sr, cr / cp]
        by_rates = torch.stack([torch.stack(column, -1) for column in columns], -1)
        turn = (by_rates @ rates.unsqueeze(-1)).squeeze(-1) * dt
        heading = angles + 0.5 * turn if self.held else angles
        (sr, sp, sy), (cr, cp, cy) = heading.sin().unbind(-1), heading.cos().unbind(-1)
        bx = torch.stack([cy * cp, sy * cp, -sp], -1)
        by = torch.stack([cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr], -1)
        bz = torch.stack([cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr], -1)
        axes = torch.stack([bx, by, bz], -1)
        way = velocity * dt if self.held else velocity * dt + 0.5 * force * dt * dt
        way = (axes @ way.unsqueeze(-1)).squeeze(-1)
        turned = angles + turn
        turned = turned - 2 * torch.pi * (turned / (2 * torch.pi)).round().detach()
        later = [place + way, turned, velocity + force * dt, rates, force]
        if self.drifts is not None:
            later.append(self.drifts.decay(dt) * slow)
        return torch.cat(later, -1), way, axes, by_rates, heading[..., 2]

    def noise_of_step(self, dt):
        """None of its own: see :class:`RobotNoise`."""
        return [0.0]


class RobotNoise(SubModel):
    """Process noise of the fifteen states, a covariance per second with learned factors, and that of drifts.

    Args:
        cov: of a second, ``[15, 15]``.
        dt: time step in seconds, or the key of an entry ``[*B, 1]``.
        dynamic: whether that of the pose is multiplied by the square of the speed, turn rates included.
        drifts: K slow errors of readings behind the fifteen states.
        out_key: the covariance ``[*B, 15 + K, 15 + K]``.
    """

    cov: Tensor

    def __init__(
        self,
        cov: Tensor,
        dt: float | NestedKey,
        dynamic: bool = False,
        drifts: Drifts | None = None,
        out_key: NestedKey = ("forecast", "noise"),
    ):
        keys = [] if isinstance(dt, float) else [dt]
        super().__init__(nn.Identity(), [("belief", "mean"), *keys], [out_key])
        self.register_buffer("cov", cov)
        self.dt, self.dynamic, self.drifts = dt, dynamic, drifts
        self.log_scale = nn.Parameter(torch.zeros(len(STATES), dtype=cov.dtype))

    def compute(self, mean, *dt):
        """Returns the covariance of the step."""
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
        cov = cov * step if dt or self.dynamic else (cov * step).expand(*mean.shape[:-1], 15, 15)
        if self.drifts is None:
            return cov
        passed = dt[0].to(mean.dtype) if dt else mean.new_full((*mean.shape[:-1], 1), self.dt)
        slow = (self.drifts.variance * (1 - self.drifts.decay(passed).square())).diag_embed()
        rows = nn.functional.pad(cov, (0, len(self.drifts))), nn.functional.pad(slow, (15, 0))
        return torch.cat(rows, -2)
