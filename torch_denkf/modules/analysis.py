"""The measurement update of an ensemble as a TensorDict module (the paper's eqs. 6 to 12)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, Unpack

import torch

from torch_denkf._checks import check_choice, check_values
from torch_denkf.functional import analyse
from torch_denkf.functional.draws import exact_draws, is_exact
from torch_denkf.functional.inflation import inflate, relax_to_prior_spread
from torch_denkf.functional.manifolds import Space, is_flat
from torch_denkf.functional.moments import ensemble_cov, ensemble_mean, ensemble_var
from torch_denkf.modules.ensemble import EnsembleOptions, EnsembleUpdate
from torch_denkf.modules.spaces import mean_and_tangents
from torch_denkf.modules.tensors import as_floating, check_dims

__all__ = ["EnsembleAnalysis"]


class EnsembleAnalysis(EnsembleUpdate):
    """Updates the forecast ensemble with the observation; the mathematics is :func:`~torch_denkf.functional.analyse`.

    Args:
        scheme: ``"sensor"`` (the paper: innovations from the sensor's samples), ``"perturbed"`` (the sensor's mean
            plus N(0, R)), ``"etkf"`` (symmetric square root) or ``"sakov"`` (Sakov & Oke's deterministic update).
        inflation: factor of the analysis anomalies where anything is observed; 1 for none.
        inflated: components of the state to inflate; ``None`` for all. Exclude components that no reading observes,
            and the lag window, which is not forecast again: inflation would accumulate in them.
        relaxation: relaxation to prior spread in [0, 1]; 0 for none.
        rotate: random mean-preserving rotation of the anomalies (``"etkf"`` only).
        taper: localisation: factors of the covariances of state and observation ``[S, O]`` and of the observations
            ``[O, O]``, see :func:`~torch_denkf.functional.analyse`; ``None`` for none. Use a factor of 0 for an
            observation without information about a component, so that chance correlations of E members are ignored.
        localisation: ``"significance"`` uses covariances of state and observation according to their significance,
            see :func:`~torch_denkf.functional.analysis.significant`. It prevents overconfidence of ensembles that are
            too small for exact draws, if fast sensors make thousands of updates. ``None`` uses all covariances.
        threshold: threshold of ``"significance"``, in standard deviations: one number or ``[S]``; a ``Parameter`` is
            trained. Choose it larger if many updates come between two readings of a component. A threshold trained
            beyond sqrt(E - 1) ignores all readings, and gets no gradient any more.
        space: space of the state, such as ``Product(SO3(), Euclidean(3))``: members are points, the update uses
            the tangents at the forecast's mean, and ``var`` is of the tangents at the belief's mean. See
            :mod:`torch_denkf.functional.manifolds`.
        reading_space: space of the reading, such as ``Circle()`` for an angle; innovation and R are tangents.
        covariance: also write the belief's sample covariance ``cov`` ``[*B, S, S]``.
        draws: draws of ``"perturbed"``, ``"exact"`` or ``"random"``, see
            :func:`~torch_denkf.functional.draws.exact_draws`.
        **options: common options of ensemble updates, see :class:`~torch_denkf.modules.ensemble.EnsembleOptions`, and
            the keys, :class:`~torch_denkf.modules.ensemble.EnsembleAnalysisKeys`. The scheme ``"sensor"`` needs
            learned observations, not one reading.

    Raises:
        ValueError: on an unknown scheme, an ``inflation`` that is not positive, a ``relaxation`` outside [0, 1], a
            ``taper`` with ``"etkf"``, and a ``taper`` that is not finite or requires a gradient.
        KeyError: if an entry is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({
        ...     "forecast": {"ensemble": torch.randn(32, 3), "observation": torch.randn(32, 2)},
        ...     "sensor": {"ensemble": torch.randn(32, 2), "noise": torch.ones(2)},
        ... })
        >>> EnsembleAnalysis("sensor")(td)["belief", "mean"].shape
        torch.Size([3])
    """

    _formula: Callable[..., Any] = staticmethod(analyse)

    def __init__(
        self,
        scheme: Literal["sensor", "perturbed", "etkf", "sakov"] = "sensor",
        *,
        inflated: Sequence[int] | None = None,
        taper: tuple[torch.Tensor, torch.Tensor] | None = None,
        space: Space | None = None,
        covariance: bool = False,
        draws: Literal["exact", "random"] = "exact",
        **options: Unpack[EnsembleOptions],
    ):
        pair = isinstance(taper, tuple) and len(taper) == 2 and all(isinstance(part, torch.Tensor) for part in taper)
        if taper is not None and not pair:
            raise TypeError(f"taper is two tensors, [S, O] and [O, O], or None; got {type(taper).__name__}")
        check_choice("scheme", scheme, ("sensor", "perturbed", "etkf", "sakov"))
        if taper is not None and scheme == "etkf":
            raise ValueError('taper is for scheme "sensor", "perturbed" or "sakov"; "etkf" has none.')
        if options.get("rotate") and scheme != "etkf":
            raise ValueError(f'rotate=True belongs to scheme="etkf"; got {scheme!r}.')
        super().__init__(space=space, covariance=covariance, **options)
        check_dims("inflated", inflated or [])
        self.exact = is_exact(draws)
        self.inflated = None if inflated is None else list(inflated)
        self.scheme, self.covariance = scheme, covariance
        for name, factors in zip(("state_taper", "observation_taper"), taper or (None, None), strict=True):
            if factors is not None:
                check_values(name.replace("_", "'s "), factors)
            self.register_buffer(name, None if factors is None else as_floating(factors, "taper"), persistent=False)

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Names the perturbations or rotations, if the scheme needs any."""
        return ("",) if self.rotate or self.scheme == "perturbed" else ()

    def draw_noise(self, batch_size, *, members=None, observation_dim=None, generator=None, **where):
        """Draws standard-normal perturbations ``[*B, E, O]`` or rotations ``[*B, E, E]``."""
        if self.scheme != "perturbed":
            return super().draw_noise(batch_size, members=members, generator=generator, **where)
        if None in (members, observation_dim):
            return None
        where = {name: where.get(name) for name in ("device", "dtype")}
        return torch.randn((*batch_size, members, observation_dim), generator=generator, **where)

    def _noise(self, entries, values, call):
        """Makes perturbations exact here, so that :meth:`compute` and :meth:`move_past` have the same ones."""
        noise = super()._noise(entries, values, call)
        if self.scheme != "perturbed" or not self.exact or not isinstance(noise, torch.Tensor):
            return noise
        if noise.shape[-1] >= noise.shape[-2]:  # only the mean could be exact, and analyse() removes it
            return noise
        forecast, predicted = values[:2]
        observed = entries.get(self.observed_key)
        if observed is not None:  # masked predictions may be NaN
            predicted = torch.where(observed.unsqueeze(-2) | predicted.isfinite(), predicted, 0)
        if self.space is not None:
            forecast = self.space.minus(forecast, self.space.near(forecast).unsqueeze(-2))
        size = noise.shape[-2]  # analyse() rescales after it removes the mean
        return exact_draws(noise, predicted, forecast) * ((size - 1) / size) ** 0.5

    def noise_sizes(self, forecast, predicted, *_):
        """Returns E and O, from the ensemble and its predicted observations."""
        size = predicted.shape[-1] if self.reading_space is None else self.reading_space.tangent_dim
        return {**super().noise_sizes(forecast), "observation_dim": size}

    def reading_dims(self, entries, call):
        """Returns the sizes of the reading and its noise; of samples, ``(E, O)``."""
        (dim, *others), forecast = super().reading_dims(entries, call), entries.get(self.in_keys[0])
        return [dim if self.scheme != "sensor" or forecast is None else (forecast.shape[-2], dim), *others]

    def compute(self, forecast, predicted, observation, variance, observed=None, *, noise):
        """Returns the belief and the diagnostics."""
        center = None
        if self.space is not None:
            center = self.space.near(forecast).unsqueeze(-2)
            forecast = self.space.minus(forecast, center)
        ensemble, innovation, nis, log_likelihood = self._formula(
            forecast, predicted, observation, variance, observed=observed, **self._options(noise, self.state_taper)
        )
        if self.relaxation:
            ensemble = relax_to_prior_spread(ensemble, forecast, self.relaxation)
        if self.inflation != 1.0:
            inflated = inflate(ensemble, self._factor(ensemble))
            if observed is not None:  # without an analysis inflation would only accumulate
                inflated = torch.where(self._any(observed)[..., None, None], inflated, ensemble)
            ensemble = inflated
        mean, away = ensemble_mean(ensemble), ensemble
        var = ensemble_var(ensemble, mean)
        if self.space is not None and center is not None:
            ensemble, mean = self.space.plus(center, ensemble), self.space.plus(center.squeeze(-2), mean)
            if not is_flat(self.space):
                mean, away = mean_and_tangents(self.space, ensemble, mean)
                var = ensemble_var(away)
        cov = (ensemble_cov(away),) if self.covariance else ()
        return ensemble, mean, var, innovation, nis, log_likelihood, *cov

    def _factor(self, ensemble) -> float | torch.Tensor:
        """Returns the factor of the inflation, one for all components, or ``[*B, 1, S]``."""
        if self.inflated is None:
            return self.inflation
        factor = torch.ones_like(ensemble[..., :1, :])
        factor[..., self.inflated] = self.inflation
        return factor

    def move_past(self, past, predicted, observation, variance, observed=None, *, noise=None):
        """Overrides :meth:`Update.move_past`; the lag window is neither inflated nor relaxed."""
        center = None
        if self.space is not None:
            center = self.space.near(past.movedim(-3, -2)).unsqueeze(-3)  # of each time
            past = self.space.minus(past, center)
        lag, dim = past.shape[-2:]
        # The analysis may also have past states, such as velocities; the state's components come first.
        taper = None if self.state_taper is None else self.state_taper[:dim].repeat(lag, 1)
        options = self._options(noise, taper)
        threshold = self.significance
        if isinstance(threshold, torch.Tensor) and threshold.numel() > 1:
            options["significance"] = threshold[:dim].repeat(lag)
        moved = self._formula(past.flatten(-2), predicted, observation, variance, observed=observed, **options)
        ensemble = moved.ensemble.unflatten(-1, past.shape[-2:])
        return ensemble if self.space is None or center is None else self.space.plus(center, ensemble)

    def _any(self, observed):
        """Marks rows in which anything is observed, ``[*B]``."""
        return observed.any(-1)

    def _options(self, noise: torch.Tensor | None, taper: torch.Tensor | None) -> dict[str, Any]:
        """Returns the options of :func:`analyse`."""
        if self.scheme == "perturbed" and noise is None:
            raise ValueError('the scheme "perturbed" has no deterministic forward; use "etkf" or "sakov".')
        return {
            "scheme": self.scheme,
            "perturbation": noise if self.scheme == "perturbed" else None,
            "rotation": noise if self.rotate else None,
            "taper": None if taper is None else (taper, self.observation_taper),
            **({} if self.localisation is None else {"significance": self.significance}),
        }
