r"""A mean and a covariance of the present state and the last L states together, for readings that come late.

:class:`torch_denkf.filters.FusedFilter` puts these parts around the update of a Kalman filter. A reading of any of the
L + 1 states is a reading of the joint state, so that the update itself needs nothing new. For linear systems the result
is that of readings in their order.
"""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import nn

from torch_denkf.functional import joint_forecast
from torch_denkf.modules._base import SubModel
from torch_denkf.modules._running import run_module
from torch_denkf.modules.past import WithPast

__all__ = ["JointForecast", "PresentOfJoint", "WithJointMoments"]


class WithJointMoments(WithPast):
    """An initial mean and covariance with a past: L states that are the first one.

    Args:
        initial: writes ``mean`` ``[*B, S]`` and ``cov`` ``[*B, S, S]``.
        lag: L.
        age: see :class:`WithEnsemblePast`.
        belief_key: prefix of what ``initial`` writes, and of ``joint_mean`` ``[*B, (L + 1) S]`` and ``joint_cov`` of
            the present and the past states, the latest first.
        smoothed_key: prefix of ``mean``, ``cov``, ``var`` and ``age`` of the oldest, see :class:`LaggedMoments`.

    Raises:
        ValueError: if ``lag`` is not positive.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import MomentPrior
        >>> start = WithJointMoments(MomentPrior(torch.zeros(2), torch.eye(2)), lag=3)
        >>> start(TensorDict({}))["belief", "joint_cov"].shape
        torch.Size([8, 8])
    """

    PAST = ("joint_mean", "joint_cov")
    SMOOTHED = ("mean", "cov", "var", "age")

    def on_entries(self, entries, call):
        """The belief and its past."""
        written = run_module(self.module, entries, call)
        mean, cov = written[self.belief_key, "mean"], written[self.belief_key, "cov"]
        count = self.lag + 1
        joint = mean.repeat(*[1] * len(call.batch_size), count), cov.repeat(*[1] * len(call.batch_size), count, count)
        age = torch.full((*call.batch_size, 1), self.age, device=mean.device)
        own = (*joint, mean, cov, cov.diagonal(dim1=-2, dim2=-1), age)
        return {**written, **dict(zip(self._own, own, strict=True))}

    def of_carry(self, entries):
        """The present state and the oldest one."""
        mean, cov = (entries[self.belief_key, name] for name in self.PAST)
        size = mean.shape[-1] // (self.lag + 1)
        present = dict(
            zip(
                [(self.belief_key, name) for name in ("mean", "cov", "var")],
                _part(mean, cov, slice(None, size)),
                strict=True,
            )
        )
        oldest = dict(zip(self._own[len(self.PAST) :], _part(mean, cov, slice(-size, None)), strict=False))
        return {**super().of_carry(entries), **present, **oldest}


def _part(mean: torch.Tensor, cov: torch.Tensor, part: slice) -> tuple[torch.Tensor, ...]:
    """Mean, covariance and variance of one of the states in a joint one."""
    return mean[..., part], cov[..., part, part], cov[..., part, part].diagonal(dim1=-2, dim2=-1)


class JointForecast(SubModel):
    """The joint state moves on by one step: the forecast in front of the last belief's states, the oldest is forgotten.

    It reads what :class:`CrossTransition` wrote, and writes ``("joint", "mean")`` ``[*B, (L + 1) S]`` and
    ``("joint", "cov")``.
    """

    def __init__(self):
        in_keys = [("forecast", name) for name in ("mean", "cov", "cross")]
        in_keys += [("belief", "joint_mean"), ("belief", "joint_cov"), ("smoothed", "age")]
        super().__init__(nn.Identity(), in_keys, [("joint", "mean"), ("joint", "cov")])

    def compute(self, mean, cov, cross, joint_mean, joint_cov, age):
        """Mean and covariance of the joint state."""
        # At the start of an episode, before its own frame, no step has been made.
        return joint_forecast(mean, cov, cross, joint_mean, joint_cov, unmoved=age < 0)


class PresentOfJoint(SubModel):
    """The belief of the present state and of the state L steps ago, from the joint state after all readings.

    Args:
        size: S.
        joint_key: prefix of ``mean`` ``[*B, (L + 1) S]`` and ``cov``.
    """

    def __init__(self, size: int, joint_key: str = "joint"):
        out_keys: list[NestedKey] = [("belief", name) for name in ("mean", "cov", "var", "joint_mean", "joint_cov")]
        out_keys += [("smoothed", name) for name in WithJointMoments.SMOOTHED]
        super().__init__(nn.Identity(), [(joint_key, "mean"), (joint_key, "cov"), ("smoothed", "age")], out_keys)
        self.size = size

    def compute(self, mean, cov, age):
        """The beliefs."""
        size = self.size
        present, oldest = (_part(mean, cov, part) for part in (slice(None, size), slice(-size, None)))
        return *present, mean, cov, *oldest, (age + 1).clamp(max=mean.shape[-1] // size - 1)
