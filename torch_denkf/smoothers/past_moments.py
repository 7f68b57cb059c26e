r"""Fixed-lag smoothing of a mean and a covariance: the last L states of a Kalman filter, corrected by each reading.

For each state :math:`x_{t-j}` the filter carries its smoothed mean, the product D of the smoother's gains of the
steps since, and the covariance V of :math:`x_{t-j}` given :math:`x_t`. With P, the covariance of the belief of t,
the smoothed covariance is :math:`V + D P D^T`, and a reading that moves the mean of t by d moves that of t - j by D d.
This is the Rauch-Tung-Striebel smoother, forward in time; it is independent of the kind of update.

On a space, V and D are of the tangents at the means: each time a mean moves, they are transported to the new one.
"""

from __future__ import annotations

import torch
from torch import nn

from torch_denkf.functional.linalg import divide
from torch_denkf.functional.manifolds import Space
from torch_denkf.functional.smoothing.rts import left_open, smoothing_gain
from torch_denkf.modules.around import Wrapper
from torch_denkf.modules.gaussian import GaussianTransition
from torch_denkf.modules.kalman import LinearTransition
from torch_denkf.smoothers.past import AGE_KEY, Past, check_age
from torch_denkf.submodel import Entries, SubModel, Transition

__all__ = ["MOMENTS_PAST", "CrossTransition", "LaggedMoments", "MomentsPast"]


class CrossTransition(Wrapper, Transition):
    """A forecast of mean and covariance, with the covariance of the states before and after the step.

    Args:
        transition: :class:`LinearTransition`, :class:`EKFTransition` or :class:`UKFTransition`; its keys and noise
            are kept.
        with_open: whether it also writes ``"open"``, the covariance of the state before the step given the state after
            it, ``[*B, S, S]``; ``"cross"`` has rows before the step, ``[*B, S, S]``. Both have the mean's prefix.

    Raises:
        TypeError: for another transition.

    Example:
        >>> from tensordict import TensorDict
        >>> double = CrossTransition(LinearTransition(2 * torch.eye(1), torch.eye(1)))
        >>> double(TensorDict({"belief": {"mean": torch.ones(1), "cov": torch.eye(1)}}))["forecast", "cross"]
        tensor([[2.]])
    """

    def __init__(self, transition: LinearTransition | GaussianTransition, with_open: bool = False):
        if not isinstance(transition, LinearTransition | GaussianTransition):
            raise TypeError(
                f"{type(transition).__name__} does not give the covariance of the states before and after a step; "
                "LinearTransition, EKFTransition and UKFTransition do."
            )
        keys = [(transition.out_keys[0][0], name) for name in ("cross", "open")[: 1 + with_open]]
        super().__init__(transition, out_keys=[*transition.out_keys, *keys])

    def on_entries(self, entries, call):
        """Returns the forecast and the cross-covariance."""
        written, link = self.module.with_link(entries, call)
        before, middle, after = link[:3]
        made = [before @ middle @ after.mT]
        if len(self.out_keys) > 3:
            made.append(left_open(smoothing_gain(made[0], written[self.module.out_keys[1]]), *link))
        return {**written, **dict(zip(self.out_keys[2:], made, strict=True))}

    def without_step(self, entries):
        """Returns zero covariances at a reset, where there is no state before."""
        return {key: torch.zeros_like(self.required(entries, self.in_keys[1])) for key in self.out_keys[2:]}


def _copies(prefix: str, lag: int, belief: Entries) -> list[torch.Tensor]:
    """Returns copies of the state, which V = 0 and D = I determine exactly."""
    mean, cov = belief[prefix, "mean"], belief[prefix, "cov"]
    gain = torch.eye(cov.shape[-1], dtype=mean.dtype, device=mean.device).expand(cov.shape)
    return [torch.stack([value] * lag, -2 if value is mean else -3) for value in (mean, 0 * cov, gain)]


def _oldest_carried(prefix: str, lag: int, entries: Entries, *, space: Space | None = None) -> tuple[torch.Tensor, ...]:
    return _oldest(*(entries[prefix, name] for name in ("cov", *MOMENTS_PAST.carried)))


def _oldest(cov: torch.Tensor, past_mean, past_cov, past_gain) -> tuple[torch.Tensor, ...]:
    """Returns mean, covariance and variance of the oldest state, given the covariance of the present one."""
    gain = past_gain[..., -1, :, :]
    smoothed = past_cov[..., -1, :, :] + gain @ cov @ gain.mT
    smoothed = (smoothed + smoothed.mT) / 2
    return past_mean[..., -1, :], smoothed, smoothed.diagonal(dim1=-2, dim2=-1)


#: Means ``[*B, L, S]`` of the lag window, and V and D, ``[*B, L, S, S]``, the latest first.
MOMENTS_PAST = Past(("past_mean", "past_cov", "past_gain"), ("mean", "cov", "var"), _copies, _oldest_carried)


class MomentsPast(SubModel):
    """Shifts the lag window by one step: updates gains and residual covariances by the last transition.

    Args:
        belief_prefix: prefix of ``mean`` and of the lag window, see ``MOMENTS_PAST``.
        forecast_prefix: prefix of ``cov``, ``cross`` and ``open`` of the forecast, see :class:`CrossTransition`.
    """

    def __init__(self, *, belief_prefix: str = "belief", forecast_prefix: str = "forecast"):
        in_keys = [(belief_prefix, "mean"), *((forecast_prefix, name) for name in ("cov", "cross", "open"))]
        in_keys += [*((belief_prefix, name) for name in MOMENTS_PAST.carried), AGE_KEY]
        super().__init__(nn.Identity(), in_keys, [("past", name) for name in ("mean", "cov", "gain")])

    def compute(self, mean, cov, cross, open_cov, past_mean, past_cov, past_gain, age):
        """Returns the lag window."""
        check_age(age, mean.shape[:-1])
        # At the start of an episode, before the update with its own frame, there was no step.
        start = (age < 0).unsqueeze(-1)
        identity = torch.eye(cov.shape[-1], dtype=mean.dtype, device=mean.device)
        gain = torch.where(start, identity, smoothing_gain(cross, torch.where(start, identity, cov)))
        means = torch.cat([mean.unsqueeze(-2), past_mean[..., :-1, :]], -2)
        gains = torch.cat([identity.expand(cov.shape).unsqueeze(-3), past_gain[..., :-1, :, :]], -3)
        opens = torch.cat([torch.zeros_like(cov).unsqueeze(-3), past_cov[..., :-1, :, :]], -3)
        opens = opens + gains @ torch.where(start, 0, open_cov).unsqueeze(-3) @ gains.mT
        return means, (opens + opens.mT) / 2, gains @ gain.unsqueeze(-3)


class LaggedMoments(SubModel):
    """Writes the lag window after a reading, and the smoothed belief of the state L steps ago.

    Args:
        belief_prefix: prefix of ``mean``, ``cov`` and of the carried lag window, see ``MOMENTS_PAST``.
        forecast_prefix: prefix of ``mean`` of the forecast.
        space: space of the state; ``None`` for plain numbers.
    """

    def __init__(self, *, belief_prefix: str = "belief", forecast_prefix: str = "forecast", space: Space | None = None):
        in_keys = [(belief_prefix, "mean"), (belief_prefix, "cov"), (forecast_prefix, "mean")]
        in_keys += [*(("past", name) for name in ("mean", "cov", "gain")), AGE_KEY]
        out_keys = [(belief_prefix, name) for name in MOMENTS_PAST.carried]
        out_keys += [("smoothed", name) for name in (*MOMENTS_PAST.follow, "age")]
        super().__init__(nn.Identity(), in_keys, out_keys)
        self.space = space

    def compute(self, mean, cov, forecast, past_mean, past_cov, past_gain, age):
        """Returns the lag window, and the belief of its oldest state."""
        learned = mean - forecast if self.space is None else self.space.minus(mean, forecast)
        shift = (past_gain @ learned[..., None, :, None]).squeeze(-1)
        if self.space is None:
            past_mean = past_mean + shift
        else:
            past_mean, turn = self.space.plus(past_mean, shift), self.space.right_jacobian(shift)
            past_cov = turn @ past_cov @ turn.mT
            past_gain = divide(turn @ past_gain, self.space.right_jacobian(learned).unsqueeze(-3))
        age = (age + 1).clamp(max=past_mean.shape[-2])
        return past_mean, past_cov, past_gain, *_oldest(cov, past_mean, past_cov, past_gain), age
