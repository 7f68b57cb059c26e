"""Base of the updates of an ensemble, with its inputs and outputs."""

from __future__ import annotations

from numbers import Real
from typing import Literal, TypedDict

import torch
from tensordict import NestedKey, unravel_key
from torch import Tensor, nn

from torch_denkf._checks import check_choice, check_number, check_values
from torch_denkf.functional.inflation import random_rotation
from torch_denkf.functional.manifolds import Space, check_space
from torch_denkf.modules.spaces import narrowed_mask
from torch_denkf.submodel import Call, Entries, Update

__all__ = ["EnsembleAnalysisKeys", "EnsembleOptions", "EnsembleUpdate", "Rotated"]


class EnsembleAnalysisKeys(TypedDict, total=False):
    """The keys of an ensemble update.

    Attributes:
        forecast_key: forecast ensemble ``[*B, E, S]``; ``("forecast", "ensemble")`` by default.
        predicted_key: predicted observations ``[*B, E, O]``; ``("forecast", "observation")`` by default.
        observation_key: learned observations ``[*B, E, O]``, or one reading ``[*B, O]``; ``("sensor", "ensemble")`` by
            default.
        noise_variance_key: variances ``[*B, O]``; ``("sensor", "noise")`` by default.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``, ``True`` where observed; ``"observed"`` by default.
        belief_prefix: prefix of the outputs ``ensemble`` ``[*B, E, S]``, ``mean`` and ``var`` ``[*B, S]``;
            ``"belief"`` by default.
        info_prefix: prefix of the diagnostics: ``innovation`` ``[*B, O]``, ``nis`` and ``log_likelihood`` ``[*B, 1]``;
            ``"info"`` by default. If a filter has several analyses of one prefix, each writes to
            ``(info_prefix, place, ...)``, and ``nis`` and ``log_likelihood`` under the prefix are their sums.
    """

    forecast_key: NestedKey
    predicted_key: NestedKey
    observation_key: NestedKey
    noise_variance_key: NestedKey
    observed_key: NestedKey
    belief_prefix: str
    info_prefix: str


class EnsembleOptions(EnsembleAnalysisKeys, total=False):
    """Arguments of every ensemble update in addition to its keys.

    Attributes:
        inflation: factor of the analysis anomalies where anything is observed; 1, by default, for none.
        relaxation: relaxation to prior spread in [0, 1]; 0, by default, for none.
        rotate: random mean-preserving rotation of the anomalies.
        reading_space: space of the reading; ``None`` for plain numbers.
        localisation: ``"significance"`` or ``None``.
        threshold: threshold of ``"significance"``, in standard deviations; 1.5 by default.
    """

    inflation: float
    relaxation: float
    rotate: bool
    reading_space: Space | None
    localisation: Literal["significance"] | None
    threshold: float | Tensor


class Rotated(Update):
    """An update of an ensemble that may rotate its anomalies at random.

    Attributes:
        rotate: whether it rotates them.
    """

    rotate: bool = False

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Names the rotations, if wanted."""
        return ("",) if self.rotate else ()

    def draw_noise(self, batch_size, *, members=None, device=None, dtype=None, generator=None, **_):
        """Draws rotations ``[*B, E, E]``, which keep the mean."""
        if not self.rotate or members is None:
            return None
        return random_rotation(members, tuple(batch_size), device=device, dtype=dtype, generator=generator)

    def noise_sizes(self, ensemble, *_):
        """Returns E, from the ensemble."""
        return {"members": ensemble.shape[-2]}

    def rotated(self, ensemble: Tensor, rotation: Tensor | None) -> Tensor:
        """Returns the ensemble with its anomalies rotated; unchanged without a rotation."""
        if rotation is None:
            return ensemble
        mean = ensemble.mean(-2, keepdim=True)
        return mean + rotation @ (ensemble - mean)


class EnsembleUpdate(Rotated):
    """Reads a forecast ensemble, its predicted observations and a reading, writes the belief and the diagnostics.

    Args:
        space: space of the state; ``None`` for plain numbers.
        covariance: also write the belief's sample covariance ``cov`` ``[*B, S, S]``.
        **options: see :class:`EnsembleOptions`.

    Raises:
        ValueError: if ``inflation`` or ``threshold`` is not positive, ``relaxation`` is outside [0, 1], or
            ``localisation`` is not known.
    """

    def __init__(
        self,
        *,
        inflation: float = 1.0,
        relaxation: float = 0.0,
        rotate: bool = False,
        space: Space | None = None,
        reading_space: Space | None = None,
        covariance: bool = False,
        localisation: Literal["significance"] | None = None,
        threshold: float | Tensor = 1.5,
        forecast_key: NestedKey = ("forecast", "ensemble"),
        predicted_key: NestedKey = ("forecast", "observation"),
        observation_key: NestedKey = ("sensor", "ensemble"),
        noise_variance_key: NestedKey = ("sensor", "noise"),
        observed_key: NestedKey = "observed",
        belief_prefix: str = "belief",
        info_prefix: str = "info",
    ):
        moments = [(belief_prefix, name) for name in ("ensemble", "mean", "var")]
        diagnostics = [(info_prefix, name) for name in ("innovation", "nis", "log_likelihood")]
        super().__init__(
            nn.Identity(),
            [forecast_key, predicted_key, observation_key, noise_variance_key],
            [*moments, *diagnostics, *[(belief_prefix, "cov")] * covariance],
            optional_keys=[observed_key],
        )
        check_number("inflation", inflation, above=0)
        check_number("relaxation", relaxation, least=0, most=1)
        self.inflation, self.relaxation, self.rotate = inflation, relaxation, rotate
        self.info_prefix = info_prefix
        self.space, self.reading_space = check_space("space", space), check_space("reading_space", reading_space)
        check_choice("localisation", localisation, ("significance", None))
        if localisation is not None:
            if not isinstance(threshold, Real | Tensor):
                raise TypeError(f"threshold is a number or a tensor; got {threshold!r}")
            check_values("threshold", torch.as_tensor(threshold), above=0)
        self.localisation = localisation
        if isinstance(threshold, Tensor) and not isinstance(threshold, nn.Parameter):
            self.register_buffer("threshold", threshold.detach().clone())
        else:
            self.threshold = threshold
        self.predicted_key, self.reading_keys = self.in_keys[1], self.in_keys[2:]
        self.observed_key = unravel_key(observed_key)

    @property
    def significance(self) -> float | Tensor | None:
        """Returns the threshold of the localisation by significance; ``None`` without one."""
        return None if self.localisation is None else self.threshold

    def on_entries(self, entries, call):
        """Returns the belief and the diagnostics."""
        return super().on_entries(entries if self.reading_space is None else self.aligned(entries), call)

    def aligned(self, entries: Entries) -> Entries:
        """Maps predictions and the reading to plain numbers, see :meth:`~torch_denkf.functional.manifolds.Space.align`.

        They can then be averaged, spread and subtracted like other numbers. A wrapper that changes them before the
        analysis must do so here, and pass them to :meth:`on_aligned`: a second alignment would fold a spread of more
        than one turn.
        """
        if self.reading_space is None:
            return entries
        keys, observed = self.in_keys[1:3], narrowed_mask(self.reading_space, entries.get(self.observed_key))
        predicted, reading = (self.required(entries, key) for key in keys)
        aligned = dict(zip(keys, self.reading_space.align(predicted, reading, observed), strict=True))
        return {**entries, **aligned, **({} if observed is None else {self.observed_key: observed})}

    def on_aligned(self, entries: Entries, call: Call) -> Entries:
        """Returns the belief and the diagnostics for the entries of :meth:`aligned`."""
        return super().on_entries(entries, call)
