"""Process noise of a unicycle: the noise of the velocities also moves the pose of the same step."""

from __future__ import annotations

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch.nn import functional as F

from torch_denkf.applications.car.unicycle import unicycle_jacobians
from torch_denkf.modules.process_noise import NoiseThrough
from torch_denkf.motions.time_step import check_dt, keys_of_dt

__all__ = ["UnicycleNoise"]


class UnicycleNoise(NoiseThrough):
    r"""Computes process noise of a unicycle in which the noise of the velocities also moves the pose of the same step.

    :class:`~torch_denkf.applications.car.UnicycleTransition` moves the pose with the *new* velocities, which have the
    noise. Noise that is added to the velocities *after* the motion would be uncorrelated with the pose of that step,
    and an innovation of the velocities would not correct the pose. Here :math:`Q = G Q_v G^T` with :math:`G = \partial
    (x, y, \theta, v, \dot\theta)_t / \partial (v, \dot\theta)_t`.

    Args:
        noise: writes variances ``[*B, 2]`` or a covariance ``[*B, 2, 2]`` of (v, theta_dot), in (m/s)^2 and
            (rad/s)^2; its keys are kept. In a filter this module may read ``("belief", "mean")``.
        dt: time step in seconds, or the key of an entry ``[*B, 1]``; the same as for the transition.
        mean_key: mean at t-1, ``[*B, S]``, starting with [x, y, theta, v, theta_dot]; further dimensions, such as
            clones, get no noise.
        forecast_mean_key: mean of the forecast, ``[*B, S]``, which the filter writes.

    Raises:
        ValueError: if the noise does not have two dimensions.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import CholeskyNoise
        >>> noise = UnicycleNoise(CholeskyNoise(2, r=[0.5, 0.1], in_features=5), dt=0.1)
        >>> mean = torch.tensor([0.0, 0.0, 0.0, 10.0, 0.0])
        >>> td = TensorDict({"belief": {"mean": mean}, "forecast": {"mean": mean}})
        >>> noise(td)["forecast", "noise"][0, 3]  # covariance of x and v: dt times the variance of v
        tensor(0.0250, grad_fn=...)
    """

    noise_dim = 2

    def __init__(
        self,
        noise: TensorDictModuleBase,
        dt: float | NestedKey,
        *,
        mean_key: NestedKey = ("belief", "mean"),
        forecast_mean_key: NestedKey = ("forecast", "mean"),
    ):
        check_dt(dt)
        super().__init__(noise, further_keys=[mean_key, forecast_mean_key, *keys_of_dt(dt)])
        self.mean_key, self.forecast_mean_key, self.dt = unravel_key(mean_key), unravel_key(forecast_mean_key), dt

    def _matrix(self, entries):
        before, forecast = self.required(entries, self.mean_key), self.required(entries, self.forecast_mean_key)
        dt = self.required(entries, self.dt) if keys_of_dt(self.dt) else self.dt
        _, moved = unicycle_jacobians(before[..., :3], forecast[..., 3:5], dt)
        own = torch.eye(2, dtype=moved.dtype, device=moved.device).expand(*moved.shape[:-2], 2, 2)
        return F.pad(torch.cat([moved, own], -2), (0, 0, 0, forecast.shape[-1] - 5))
