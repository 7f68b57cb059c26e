"""A pose that continues moving as it does."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torch import Tensor

from torch_denkf.functional.manifolds import SE2, SE3, Euclidean, Product
from torch_denkf.motions.motion import Motion, carried, corner, densities, integrated, walked

__all__ = ["ConstantTwist"]


class ConstantTwist(Motion):
    r"""A pose, and its rate of change in the body's own axes, which stays as it is: :math:`x' = x \exp(\xi \Delta t)`.

    The state is a point of ``Product(space, Euclidean(D))``: the pose, then the twist :math:`\xi` per second, in the
    order of the pose's tangent, which is rotation first.

    Args:
        space: of the pose, ``SE2()`` or ``SE3()``.
        dt: time step in seconds, or the key of an entry ``[*B, 1]`` with the seconds since the last step.
        twist_noise: how the twist walks at random: standard deviation after a second, in rad/s, then in m/s; one
            number, or one for each of D.
        in_key: the belief's ensemble ``[*B, E, P]``.
        out_key: forecast ensemble ``[*B, E, P]``.

    Raises:
        TypeError: if the space is no pose.
        ValueError: if ``dt`` or a noise is negative.

    Example:
        >>> from tensordict import TensorDict
        >>> quarter = ConstantTwist(SE2(), dt=1.0)  # ahead with 1 m/s, on an arc to the left
        >>> td = TensorDict({("belief", "ensemble"): torch.tensor([[0.0, 0.0, 0.0, torch.pi / 2, 1.0, 0.0]])})
        >>> quarter(td)["forecast", "ensemble"]
        tensor([[1.5708, 0.6366, 0.6366, 1.5708, 1.0000, 0.0000]])
    """

    def __init__(
        self,
        space: SE2 | SE3,
        dt: float | NestedKey,
        *,
        twist_noise: float | Sequence[float] | Tensor = 0.0,
        in_key: NestedKey = ("belief", "ensemble"),
        out_key: NestedKey = ("forecast", "ensemble"),
    ):
        if not isinstance(space, (SE2, SE3)):
            raise TypeError(f"space of ConstantTwist is that of a pose, SE2() or SE3(); got {space!r}.")
        super().__init__(Product(space, Euclidean(space.tangent_dim)), dt, {}, in_key, out_key)
        self.pose_space = space
        self.twist_noise = densities("twist_noise", twist_noise, space.tangent_dim)

    def move(self, state, *, dt):
        """Returns the pose moved by its twist."""
        pose, twist = self.space.points(state)
        return torch.cat([self.pose_space.plus(pose, twist * dt), twist], -1)

    def gradient(self, state, *, dt):
        """Returns the Jacobian of the pose by itself and by its twist; the twist stays."""
        twist = self.space.points(state)[1]
        by_pose, by_rate = carried(self.pose_space, twist * dt, dt)
        return corner(torch.cat([by_pose, by_rate], -1))

    def noise_of_step(self, dt):
        """Returns the noise of the pose, then of the twist."""
        return integrated(self.twist_noise, dt) + walked(self.twist_noise, dt)
