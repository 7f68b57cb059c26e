"""A robot on wheels, with a gyro whose bias and wheels whose scale are not known."""

from __future__ import annotations

import math

import torch
from tensordict import NestedKey

from torch_denkf._checks import check_number
from torch_denkf.functional.manifolds import SE2, Euclidean, Product
from torch_denkf.motions.motion import Motion, carried, corner, integrated, walked

__all__ = ["PlanarMotion"]


class PlanarMotion(Motion):
    r"""A unicycle in the plane, whose gyro has a bias and whose wheels have a scale.

    The state is a point of ``Product(SE2(), Euclidean(4))``: heading in rad, x and y in m; speed ahead in m/s, turn
    rate in rad/s, what the gyro reads too much in rad/s, and the ratio of what the wheels read to the speed. The pose
    moves on the arc of a constant speed and turn rate. The tangent of the pose is (turn, ahead, to the left).

    Args:
        dt: time step in seconds, or the key of an entry ``[*B, 1]`` with the seconds since the last step.
        speed_noise: how the speed walks at random: standard deviation after a second, in m/s.
        turn_noise: likewise of the turn rate, in rad/s.
        bias_noise: likewise of the gyro's bias, in rad/s.
        scale_noise: likewise of the wheels' scale.
        damping: the share per second by which the speed goes back to ``usual_speed``, and the turn rate to zero.
        usual_speed: in m/s.
        in_key: the belief's ensemble ``[*B, E, 7]``.
        out_key: forecast ensemble ``[*B, E, 7]``.

    Raises:
        ValueError: if ``dt``, a noise or ``damping`` is negative.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({("belief", "ensemble"): torch.tensor([[torch.pi / 2, 0.0, 0.0, 2.0, 0.0, 0.0, 1.0]])})
        >>> PlanarMotion(0.5)(td)["forecast", "ensemble"][0, 1:3].round(decimals=4).abs()
        tensor([0., 1.])
    """

    def __init__(
        self,
        dt: float | NestedKey,
        *,
        speed_noise: float = 0.0,
        turn_noise: float = 0.0,
        bias_noise: float = 0.0,
        scale_noise: float = 0.0,
        damping: float = 0.0,
        usual_speed: float = 0.0,
        in_key: NestedKey = ("belief", "ensemble"),
        out_key: NestedKey = ("forecast", "ensemble"),
    ):
        super().__init__(Product(SE2(), Euclidean(4)), dt, {}, in_key, out_key)
        noises = {"speed_noise": speed_noise, "turn_noise": turn_noise}
        noises |= {"bias_noise": bias_noise, "scale_noise": scale_noise, "damping": damping}
        for name, value in noises.items():
            check_number(name, value, least=0)
        check_number("usual_speed", usual_speed)
        self.noises = [float(value) for value in noises.values()][:4]
        self.damping, self.usual_speed = float(damping), float(usual_speed)

    def move(self, state, *, dt):
        """The pose on its arc; speed and turn rate on their way back."""
        pose, rest = self.space.points(state)
        speed, turn, errors = rest.split([1, 1, 2], -1)
        arc = torch.cat([turn * dt, speed * dt, torch.zeros_like(turn)], -1)
        kept = self._kept(dt)
        speed = self.usual_speed + kept * (speed - self.usual_speed)
        return torch.cat([SE2().plus(pose, arc), speed, kept * turn, errors], -1)

    def gradient(self, state, *, dt):
        """That of the pose by itself, by the speed ahead and by the turn rate; and the damping of these."""
        speed, turn = state[..., 3:4], state[..., 4:5]
        arc = torch.cat([turn * dt, speed * dt, torch.zeros_like(turn)], -1)
        by_pose, by_rate = carried(SE2(), arc, dt)
        by_rate = torch.cat([by_rate[..., :2].flip(-1), torch.zeros_like(by_pose[..., :2])], -1)
        kept, one = self._kept(dt) * torch.ones_like(speed), torch.ones_like(speed)
        return corner(torch.cat([by_pose, by_rate], -1), torch.cat([kept, kept, one, one], -1).diag_embed())

    def _kept(self, dt):
        return torch.exp(-self.damping * dt) if isinstance(dt, torch.Tensor) else math.exp(-self.damping * dt)

    def noise_of_step(self, dt):
        """Of turn, ahead and sideways; of speed, turn rate, bias and scale."""
        ahead, turn = integrated(self.noises[:2], dt)
        return [turn, ahead, 0.0, *walked(self.noises, dt)]
