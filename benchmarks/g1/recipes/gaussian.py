"""The baselines that carry mean and covariance: dEKF, dUKF and Backprop-KF."""

from __future__ import annotations

from benchmarks.common.gaussian import Backprop, Extended, Unscented
from benchmarks.g1.recipes._base import G1Recipe, register
from torch_denkf.modules import GaussianAround


class _Start(G1Recipe):
    def belief(self, std):
        return GaussianAround(std, state_key="start")


@register
class DEKF(Extended, _Start):
    """See :class:`benchmarks.common.gaussian.Extended`."""


@register
class DUKF(Unscented, _Start):
    """See :class:`benchmarks.common.gaussian.Unscented`."""


@register
class BKF(Backprop, _Start):
    """See :class:`benchmarks.common.gaussian.Backprop`."""
