r"""Joint mean and covariance of the present state and the last L states, for delayed readings.

:class:`torch_denkf.fusion.FusedFilter` puts these parts around the update of a Kalman filter. A reading of any of the L
+ 1 states is a reading of the joint state, so that the update itself does not change. For linear systems the result
equals that of readings in order.
"""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import nn

from torch_denkf.functional.manifolds import Repeated, Space, check_space
from torch_denkf.fusion.joint_forecast import joint_forecast
from torch_denkf.smoothers.past import Past
from torch_denkf.submodel import Entries, SubModel

__all__ = ["JOINT_PAST", "JointForecast", "PresentOfJoint", "joint_space"]


def _copies(prefix: str, lag: int, belief: Entries) -> list[torch.Tensor]:
    mean, cov = belief[prefix, "mean"], belief[prefix, "cov"]
    ones, count = [1] * (mean.ndim - 1), lag + 1
    return [mean.repeat(*ones, count), cov.repeat(*ones, count, count)]


def _present_and_oldest(
    prefix: str, lag: int, entries: Entries, *, space: Space | None = None
) -> tuple[torch.Tensor, ...]:
    return _ends(entries[prefix, "joint_mean"], entries[prefix, "joint_cov"], lag + 1)


def _ends(mean: torch.Tensor, cov: torch.Tensor, count: int) -> tuple[torch.Tensor, ...]:
    """Returns mean, covariance and variance of the first and the last of ``count`` states in a joint state."""
    out: list[torch.Tensor] = []
    points, tangents = mean.shape[-1] // count, cov.shape[-1] // count
    for own, at in ((slice(points), slice(tangents)), (slice(-points, None), slice(-tangents, None))):
        out += [mean[..., own], cov[..., at, at], cov[..., at, at].diagonal(dim1=-2, dim2=-1)]
    return tuple(out)


def joint_space(space: Space | None, lag: int) -> Space | None:
    """Returns the space of the present and the last L states; ``None`` for vectors."""
    return space if space is None or not lag else check_space("space", Repeated(space, lag + 1))


_MOMENTS = ("mean", "cov", "var")
#: Mean ``[*B, (L + 1) S]`` and covariance of the present and the states of the lag window, the latest first; on a
#: space, points and the covariance of all their tangents.
JOINT_PAST = Past(("joint_mean", "joint_cov"), _MOMENTS, _copies, _present_and_oldest, present=_MOMENTS)


class JointForecast(SubModel):
    """Predicts the joint state by one step: puts the forecast before the previous states, and drops the oldest.

    It reads the outputs of :class:`CrossTransition`, and writes ``("joint", "mean")`` ``[*B, (L + 1) S]`` and
    ``("joint", "cov")``.
    """

    def __init__(self):
        in_keys = [("forecast", name) for name in ("mean", "cov", "cross")]
        in_keys += [("belief", "joint_mean"), ("belief", "joint_cov"), ("smoothed", "age")]
        super().__init__(nn.Identity(), in_keys, [("joint", "mean"), ("joint", "cov")])

    def compute(self, mean, cov, cross, joint_mean, joint_cov, age):
        """Returns mean and covariance of the joint state."""
        # At the start of an episode, before its own frame, no step has been made.
        return joint_forecast(mean, cov, cross, joint_mean, joint_cov, unmoved=age < 0)


class PresentOfJoint(SubModel):
    """Extracts the beliefs of the present state and of the state L steps ago from the updated joint state.

    Args:
        count: L + 1.
        joint_key: prefix of ``mean`` ``[*B, (L + 1) S]`` and ``cov``.
    """

    def __init__(self, count: int, joint_key: str = "joint"):
        out_keys: list[NestedKey] = [("belief", name) for name in ("mean", "cov", "var", "joint_mean", "joint_cov")]
        out_keys += [("smoothed", name) for name in (*_MOMENTS, "age")]
        super().__init__(nn.Identity(), [(joint_key, "mean"), (joint_key, "cov"), ("smoothed", "age")], out_keys)
        self.count = count

    def compute(self, mean, cov, age):
        """Returns the beliefs."""
        ends = _ends(mean, cov, self.count)
        return *ends[:3], mean, cov, *ends[3:], (age + 1).clamp(max=self.count - 1)
