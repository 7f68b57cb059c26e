"""The baselines that carry mean and covariance: dEKF, dUKF and Backprop-KF."""

from __future__ import annotations

from collections import OrderedDict

from benchmarks.common.gaussian import Backprop, Extended, Unscented
from benchmarks.ur5.recipes._base import UR5Recipe, register
from benchmarks.ur5.sensors import NEAR, NearForecast
from torch_denkf.modules import GaussianAround


class _Near(UR5Recipe):
    observation_key = NEAR

    def readings(self):
        return OrderedDict(near=NearForecast(self.preset, ("forecast", "mean")))

    def belief(self, std, state_key):
        return GaussianAround(std, state_key=state_key)


@register
class DEKF(Extended, _Near):
    """See :class:`benchmarks.common.gaussian.Extended`."""


@register
class DUKF(Unscented, _Near):
    """See :class:`benchmarks.common.gaussian.Unscented`."""


@register
class BKF(Backprop, _Near):
    """See :class:`benchmarks.common.gaussian.Backprop`."""
