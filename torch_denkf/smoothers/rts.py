"""The Rauch-Tung-Striebel smoother for filters with a mean and a covariance."""

from __future__ import annotations

from torch_denkf._registered import compiler
from torch_denkf.filters import Filter
from torch_denkf.functional.smoothing.rts import rts_smooth
from torch_denkf.smoothers.base import Smoother
from torch_denkf.smoothers.fixed_lag import prefix_of
from torch_denkf.smoothers.past_moments import CrossTransition

__all__ = ["RTSSmoother"]


class RTSSmoother(Smoother):
    """Rauch-Tung-Striebel smoother of a Kalman, extended or unscented Kalman filter.

    For a :class:`~torch_denkf.filters.KalmanFilter` it is exact: the mean and the covariance of each state given all
    readings. For an :class:`~torch_denkf.filters.EKF` it uses the Jacobian of the transition, for a
    :class:`~torch_denkf.filters.UKF` its sigma points. It writes ``("smoothed", "mean")`` ``[*B, T, S]``,
    ``("smoothed", "cov")`` ``[*B, T, S, S]`` and ``("smoothed", "var")`` ``[*B, T, S]``, see :class:`Smoother`.

    Args:
        filter: the filter.
        lag: number of later readings; ``None`` for all.

    Raises:
        TypeError: for a filter without a covariance, or with a transition that has no cross-covariance.

    Reference:
        Särkkä, "Bayesian filtering and smoothing", 2013, sections 8.2, 9.1 and 9.3.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> plain = KalmanFilter(one, one, process_noise=[1.0], noise=[1.0], mean=torch.zeros(1), cov=one)
        >>> smoother = RTSSmoother(plain)
        >>> out = smoother(TensorDict({"observation": torch.ones(4, 1)}, [4]))
        >>> out["smoothed", "var"][:-1] < out["belief", "var"][:-1]
        tensor([[True],
                [True],
                [True]])
    """

    def __init__(self, filter: Filter, lag: int | None = None):
        prefix = prefix_of(filter, "moments", self)
        self.place = filter.structure.transition[0]
        forecast = filter.structure.forecast_of[prefix, "mean"][0]
        CrossTransition(filter.transition_module)  # raises without a cross-covariance
        keys = [(prefix, "mean"), (prefix, "cov"), *((forecast, name) for name in ("mean", "cov", "cross", "open"))]
        super().__init__(filter, lag, keys, ("mean", "cov", "var"))

    def _extended(self, lag):
        return self.filter.with_modules({self.place: CrossTransition(self.filter.transition_module, with_open=True)})

    def _smooth(self, entries, follows, out):
        space = self.filter.structure.space
        values = [entries[key] for key in self._needed]
        if space is None and self.lag is None:  # all times at once
            mean, cov = compiler().rts_in_time(*values, follows=follows)
        else:
            mean, cov = rts_smooth(*values, follows=follows, lag=self.lag, space=space)
        return mean, cov, cov.diagonal(dim1=-2, dim2=-1)
