"""The local ensemble transform (LETKF) as a TensorDict module: updates each component from nearby observations."""

from __future__ import annotations

import math
from typing import Any, Unpack

import torch

from torch_denkf._checks import check_count, check_values
from torch_denkf.functional import letkf, neighbours
from torch_denkf.functional.inflation import relax_to_prior_spread
from torch_denkf.functional.localisation import Neighbours, neighbours_of_taper
from torch_denkf.functional.moments import ensemble_mean, ensemble_var
from torch_denkf.modules.ensemble import EnsembleOptions, EnsembleUpdate
from torch_denkf.modules.tensors import check_untrained, mean_of_members

__all__ = ["LocalEnsembleAnalysis"]

_CHOSEN_ONCE = "the neighbours and their weights are computed once"


class LocalEnsembleAnalysis(EnsembleUpdate):
    """Updates each component of the state from the observations near it, see :func:`~torch_denkf.functional.letkf`.

    It is for fields, in which a few members represent thousands of components, and covariances of distant components
    are due to chance. It replaces :class:`EnsembleAnalysis` and has the same inputs and outputs. Nothing of size S x O
    is stored; S local systems, E x E each, are solved ``tile`` at a time.

    ``nis`` and ``log_likelihood`` treat observations as independent, each with the variance of its own forecast plus
    R: the localisation suppresses the sample correlations of E members between observations. The expectation of
    ``nis`` is the number of observations, if the filter is consistent.

    Args:
        near: the observations of each component: :class:`~torch_denkf.functional.localisation.Neighbours`, or a taper
            ``[S, O]``. For positions and a radius, see :meth:`around`.
        inflation: factor of the analysis anomalies of components with an observation nearby; 1 for none.
        relaxation: relaxation to prior spread in [0, 1]; 0 for none.
        rotate: random mean-preserving rotation of the anomalies, the same for all components; rows without any
            observation are not rotated.
        tile: components to analyse at a time; memory is ``E * L * tile`` for each element of the batch, with L
            neighbours.
        localisation: ``"significance"`` also weighs each observation near a component by the significance of their
            correlation, see :class:`EnsembleAnalysis`.
        threshold: threshold of ``"significance"``, in standard deviations; a ``Parameter`` is trained.
        reading_space: space of the reading, such as ``Circle()`` for an angle; innovation and R are tangents.
        **options: common options of ensemble updates, see :class:`~torch_denkf.modules.ensemble.EnsembleOptions`, and
            the keys, :class:`~torch_denkf.modules.ensemble.EnsembleAnalysisKeys`. Learned observations are averaged.
            Missing readings and their variances may be NaN.

    Raises:
        ValueError: if a taper is not a matrix or requires a gradient, or the sizes do not fit.
        KeyError: if an entry is missing.

    Source:
        Hunt, Kostelich & Szunyogh 2007, Physica D 230.

    Example:
        >>> from tensordict import TensorDict
        >>> places = torch.arange(40.0).unsqueeze(-1)
        >>> analysis = LocalEnsembleAnalysis.around(places, places[::2], radius=4.0, period=[40.0], inflation=1.04)
        >>> td = TensorDict({
        ...     "forecast": {"ensemble": torch.randn(7, 40), "observation": torch.randn(7, 20)},
        ...     "sensor": {"ensemble": torch.randn(20), "noise": torch.ones(20)},
        ... })
        >>> analysis(td)["belief", "mean"].shape
        torch.Size([40])
    """

    def __init__(self, near: Neighbours | torch.Tensor, *, tile: int = 4096, **options: Unpack[EnsembleOptions]):
        check_count("tile", tile)
        if not (isinstance(near, Neighbours) or (isinstance(near, torch.Tensor) and near.ndim == 2)):
            raise TypeError(f"near is Neighbours, or a taper [S, O]; got {near!r}")
        super().__init__(**options)
        if isinstance(self.threshold, torch.Tensor) and self.threshold.numel() > 1:
            raise ValueError(f"threshold is one number for all components; got {list(self.threshold.shape)}")
        if isinstance(near, torch.Tensor):
            near = neighbours_of_taper(near, tile=tile)
        check_values("near's taper", near.taper, least=0)
        check_untrained("near", near.taper, _CHOSEN_ONCE)
        self.register_buffer("index", near.index, persistent=False)
        self.register_buffer("taper", near.taper, persistent=False)
        self.tile = tile

    @classmethod
    def around(
        cls,
        states: torch.Tensor,
        observations: torch.Tensor,
        radius: float,
        *,
        period: torch.Tensor | list[float] | None = None,
        **kwargs,
    ) -> LocalEnsembleAnalysis:
        """Builds the analysis from positions, with Gaspari & Cohn's taper.

        Args:
            states: positions of the components, ``[S, D]``, in any unit.
            observations: positions of the observations, ``[O, D]``.
            radius: see :func:`~torch_denkf.functional.localisation.gaspari_cohn`; the taper ends at 3.65 radii. It is a
                constant, because neighbours are computed once.
            period: ``[D]``, the circumference of each circular coordinate, ``inf`` for the others.
            **kwargs: passed on to the constructor.

        Raises:
            ValueError: if the radius is not positive, or requires a gradient.
        """
        check_untrained("radius", radius, _CHOSEN_ONCE)
        period = None if period is None else torch.as_tensor(period, dtype=states.dtype)
        return cls(neighbours(states, observations, radius, period=period), **kwargs)

    def compute(self, forecast, predicted, observation, variance, observed=None, *, noise):
        """Returns the belief and the diagnostics."""
        observation = mean_of_members(observation, predicted.shape[:-2])
        ensemble = self._analyse(forecast, predicted, observation, variance, observed, noise, 1)
        if self.relaxation:
            ensemble = relax_to_prior_spread(ensemble, forecast, self.relaxation)
        if self.inflation != 1.0:
            mean = ensemble.mean(-2, keepdim=True)
            factor = torch.where(self._reached(observed, variance), self.inflation, 1.0).to(ensemble.dtype)
            ensemble = mean + factor.unsqueeze(-2) * (ensemble - mean)
        if observed is not None:
            ensemble = torch.where(observed.any(-1)[..., None, None], ensemble, forecast)
        diagnostics = _diagnostics(predicted, observation, variance, observed)
        return ensemble, ensemble_mean(ensemble), ensemble_var(ensemble), *diagnostics

    def move_past(self, past, predicted, observation, variance, observed=None, *, noise=None):
        """Updates earlier states ``[*B, E, L, S]``, see :meth:`EnsembleAnalysis.move_past`.

        Each component is updated from the observations near its present position. Features that move far in L steps
        need a larger radius.
        """
        observation = mean_of_members(observation, predicted.shape[:-2])
        lag, flat = past.shape[-2], past.flatten(-2)
        moved = self._analyse(flat, predicted, observation, variance, observed, noise, lag)
        if observed is not None:
            moved = torch.where(observed.any(-1)[..., None, None], moved, flat)
        return moved.unflatten(-1, past.shape[-2:])

    def _analyse(self, ensemble, predicted, observation, variance, observed, noise, copies: int) -> torch.Tensor:
        """Returns the analysis of ``copies`` states, concatenated along components, with rotated anomalies."""
        index, taper = self.index, self.taper
        if copies > 1:
            index, taper = index.repeat(copies, 1), taper.repeat(copies, 1)
        near = Neighbours(index, taper)
        options: dict[str, Any] = {"observed": observed, "significance": self.significance, "tile": self.tile}
        return self.rotated(letkf(ensemble, predicted, observation, variance, near, **options), noise)

    def _reached(self, observed: torch.Tensor | None, variance: torch.Tensor) -> torch.Tensor:
        """Marks components with an observation nearby, ``[S]`` or ``[*B, S]``."""
        near = self.taper > 0
        if observed is None or observed.shape[-1] < variance.shape[-1]:
            return near.any(-1)
        parts = zip(self.index.split(self.tile), near.split(self.tile), strict=True)
        return torch.cat([(observed[..., index] & part).any(-1) for index, part in parts], -1)


def _diagnostics(predicted, observation, variance, observed) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns innovation, its normalised square and its log-likelihood, for independent observations."""
    if observed is not None:  # first, so that a masked NaN reaches no gradient
        predicted = torch.where(observed.unsqueeze(-2), predicted, 0)
        observation, variance = torch.where(observed, observation, 0), torch.where(observed, variance, 1)
    innovation = observation - predicted.mean(-2)
    spread = predicted.var(-2) + variance
    nis, log_spread = innovation.square() / spread, spread.log() + math.log(2 * math.pi)
    if observed is not None:
        log_spread = torch.where(observed, log_spread, 0)
    nis = nis.sum(-1, keepdim=True)
    return innovation, nis, -0.5 * (nis + log_spread.sum(-1, keepdim=True))
