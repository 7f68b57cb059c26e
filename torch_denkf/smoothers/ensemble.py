"""Ensemble smoothers of recordings: the ensemble Kalman smoother, and the ensemble Rauch-Tung-Striebel smoother."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf._checks import check_number
from torch_denkf.beliefs import moments_of
from torch_denkf.filters import Filter
from torch_denkf.functional.smoothing.ensemble import enrts_smooth
from torch_denkf.smoothers.base import Smoother, last_of_runs
from torch_denkf.smoothers.fixed_lag import FixedLag, prefix_of
from torch_denkf.submodel import SubModel, in_role

__all__ = ["EnKS", "EnRTS"]


class EnRTS(Smoother):
    """Ensemble Rauch-Tung-Striebel smoother: one backward pass over the outputs of the filter.

    The gain of each backward step is a regression of members on their own forecasts. It is independent of the analysis,
    and costs about as much as one. It writes ``("smoothed", "ensemble")`` ``[*B, T, E, S]``, ``mean`` and ``var``,
    see :class:`Smoother`.

    Args:
        filter: an ensemble filter whose analysis keeps the order of members: not ``rotate=True``.
        lag: number of later readings; ``None`` for all.
        damping: factor of each gain, 1 by default. A filter with inflation needs one below 1 / inflation, see
            :func:`~torch_denkf.functional.smoothing.ensemble.enrts_step`.

    Raises:
        TypeError: for a filter without an ensemble.
        ValueError: if the analysis rotates its members, so that members and forecasts are no longer paired; if the
            filter has inflation and there is no damping; or if the damping is not in (0, 1].

    Reference:
        Raanes, "On the ensemble Rauch-Tung-Striebel smoother and its equivalence to the ensemble Kalman smoother",
        Q. J. R. Meteorol. Soc. 142, 2016.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import DEnKF
        >>> smoother = EnRTS(DEnKF.paper(5, 2, ensemble_size=8))
        >>> out = smoother(TensorDict({"pixels": torch.rand(2, 3, 6, 50, 150)}, [2, 3]))
        >>> out["smoothed", "ensemble"].shape
        torch.Size([2, 3, 8, 5])
    """

    def __init__(self, filter: Filter, lag: int | None = None, *, damping: float | None = None):
        prefix = prefix_of(filter, "ensemble", self)
        if any(getattr(part, "rotate", False) for part in in_role(filter, SubModel)):
            raise ValueError(
                "An analysis with rotate=True mixes the members, so that EnRTS cannot pair a member with its "
                "forecast. Turn the rotation off, or use EnKS, which also rotates the lag window."
            )
        keys = [(prefix, "ensemble"), filter.structure.forecast_of[prefix, "ensemble"]]
        super().__init__(filter, lag, keys, ("ensemble", "mean", "var"))
        if damping is not None:
            check_number("damping", damping, above=0, most=1, cure="It is a factor of each gain")
        self.damping = damping
        self._check_inflation()

    def _smooth(self, entries, follows, out):
        self._check_inflation()  # it may have been changed
        values, damping = (entries[key] for key in self._needed), 1.0 if self.damping is None else self.damping
        space = self.filter.structure.space
        ensemble = enrts_smooth(*values, follows=follows, lag=self.lag, damping=damping, space=space)
        return ensemble, *moments_of(ensemble, None, space)

    def _check_inflation(self) -> None:
        """Raises if gains would carry an inflation back without a damping."""
        for part in in_role(self.filter, SubModel) if self.damping is None else ():
            for name, none in (("inflation", 1.0), ("adapt_inflation", 0.0)):
                value = getattr(part, name, none)
                if value > none:
                    raise ValueError(
                        f"{type(part).__name__} has {name}={value:g}, which the gains of EnRTS would carry back, so "
                        f"that the spread grows in each step. Pass damping=..., a factor of each gain below 1 / "
                        "inflation; or use EnKS or FixedLag, which do not inflate the lag window"
                    )


class EnKS(Smoother):
    """Ensemble Kalman smoother: each analysis also corrects the members of a lag window of L steps.

    It is :class:`FixedLag`, with outputs in the order of a recording. Random rotations also rotate the lag window, so
    that members stay paired. If the lag is the whole sequence, memory grows with the square of its length: use
    :class:`EnRTS` for long recordings. It writes ``("smoothed", "ensemble")`` ``[*B, T, E, S]``, ``mean`` and ``var``,
    see :class:`Smoother`.

    Args:
        filter: an ensemble filter, see :class:`FixedLag`.
        lag: number of later readings; ``None`` for all.

    Raises:
        TypeError: for another filter.

    Reference:
        Evensen & van Leeuwen, "An ensemble Kalman smoother for nonlinear dynamics", Monthly Weather Review 128, 2000.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import DEnKF
        >>> smoother = EnKS(DEnKF.paper(5, 2, ensemble_size=8), lag=2)
        >>> out = smoother(TensorDict({"pixels": torch.rand(2, 3, 6, 50, 150)}, [2, 3]))
        >>> out["smoothed", "mean"].shape
        torch.Size([2, 3, 5])
    """

    _by_lag = True

    def __init__(self, filter: Filter, lag: int | None = None):
        self.prefix = prefix_of(filter, "ensemble", self)
        keys = [(self.prefix, "ensemble")] + [(self.prefix, "past")] * (lag != 0)
        super().__init__(filter, lag, keys, ("ensemble", "mean", "var"))
        self._filter_for(2)  # raises for modules that do not support a lag

    def _extended(self, lag):
        return FixedLag(self.filter, lag) if lag else self.filter

    def _smooth(self, entries, follows, out):
        if self.lag == 0:
            ensemble = entries[self.prefix, "ensemble"]
        else:
            ensemble = of_own_time(entries[self.prefix, "ensemble"], entries[self.prefix, "past"], follows)[0]
        return ensemble, *moments_of(ensemble, None, self.filter.structure.space)


def of_own_time(ensemble: Tensor, past: Tensor, follows: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the members of each time as corrected L steps later, or at the end of their episode.

    Args:
        ensemble: ``[*B, T, E, S]``.
        past: at each time the members of the L times before, ``[*B, T, E, L, S]``.
        follows: ``[*B, T]``, see :class:`Smoother`.

    Returns:
        The members ``[*B, T, E, S]``, and the time of their last correction, ``[*B, T]``.
    """
    batch, (count, lag) = ensemble.shape[:-3], (ensemble.shape[-3], past.shape[-2])
    now = torch.arange(count, device=ensemble.device)
    later = torch.minimum(now + lag, last_of_runs(follows)).reshape(-1, count)
    whole = torch.cat([ensemble.unsqueeze(-2), past], -2).movedim(-2, -3)  # [*B, T, L + 1, E, S], the present first
    whole = whole.reshape(-1, *whole.shape[len(batch) :])
    rows = torch.arange(len(whole), device=ensemble.device).unsqueeze(-1)
    found = whole[rows, later, later - now]
    return found.reshape(ensemble.shape), later.reshape(follows.shape)
