r"""Update under a contaminated Gaussian likelihood, in which a share of the readings are outliers.

.. math:: p(y \mid x) = (1 - \epsilon)\, N(y; h(x), R) + \epsilon\, N(y; h(x), W)

with :math:`\epsilon` the share of outliers, and W their noise, :math:`w^2 R` or given. For a Gaussian forecast the
posterior is a mixture of two: the update with R, and the update with W, weighted by their evidence.

Source: the contaminated Gaussian: Tukey 1960 ("A survey of sampling from contaminated distributions"); Box & Tiao 1968,
Biometrika 55. Its filter, with one Gaussian for the mixture: Alspach & Sorenson 1972, IEEE Trans. Automatic Control 17
(Gaussian sums); Pena & Guttman 1988, in Spall, "Bayesian Analysis of Time Series and Dynamic Models".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torch_denkf._checks import check_number, check_shape, check_values
from torch_denkf.filters.scan import where_rows
from torch_denkf.imperfect.mixed import (
    MixedUpdate,
    kind_of_update,
    wider_forecast,
    wider_past,
    with_draws,
    with_noise_from,
)
from torch_denkf.imperfect.mixture import log_mixture, responsibility
from torch_denkf.modules.kalman import KalmanAnalysis
from torch_denkf.modules.likelihood import GaussianLikelihood
from torch_denkf.modules.spaces import narrowed_mask
from torch_denkf.modules.tensors import as_floating, register_constant
from torch_denkf.running import check_module, reads, run_module, writes
from torch_denkf.submodel import Call, Entries, Update

__all__ = ["Contaminated"]

_CLAIMED = ("contaminated", "claimed")  # the noise that a Kalman analysis holds itself
_DIVERGED = 3.0  # times as wide as the forecast says


class Contaminated(MixedUpdate):
    r"""Wraps an analysis: update under a contaminated Gaussian likelihood.

    The analysis runs twice, with the noise R and with the noise W of outliers. With the posterior probability q that
    the reading is an outlier, the belief is the mixture of the first, weighted by 1 - q, and the second, weighted by q:

    =====================  =============================================================================================
    belief                 posterior
    =====================  =============================================================================================
    mean and covariance    the mixture's, that of both means' distance included; on a space those of the tangents at the
                           forecast's mean. For a linear Gaussian system that is the exact posterior's
    ensemble               members with the mixture's mean and sample covariance, see
                           :func:`~torch_denkf.imperfect.mixture.mix_members`; a lag window that is corrected, too
    particles              the exact posterior: each particle's likelihood is the mixture. The analysis runs three times
    =====================  =============================================================================================

    A share of 0 is the analysis alone, bit for bit; a share of 1 with a large W is a missing observation. A reading is
    an outlier as a whole: components with independent outliers need a sensor each,
    :class:`~torch_denkf.fusion.FusedFilter`.

    ``(info_prefix, "log_likelihood")`` is that of the mixture, so that the term ``nll`` of the losses learns share and
    width without true states. ``(info_prefix, "outlier")`` ``[*B, 1]`` is q, 0 where nothing is observed. ``nis`` is
    the mean of both runs' by q; under the model its expectation is the number of observed components.

    Share, width and noise are each numbers, the key of an entry, or a module that writes one entry. A module is run in
    the update: next to frames and forecast it may read what the analysis writes with R, such as ``("info",
    "innovation")`` and ``("info", "nis")``.

    Args:
        analysis: of an ensemble, of a mean and a covariance, or of particles with a Gaussian likelihood. Its keys and
            its noise are kept.
        share: :math:`\epsilon` in [0, 1], ``[*B, 1]`` in an entry.
        width: w, factor on the standard deviations of R for outliers, ``[*B, 1]`` in an entry.
        noise: W, instead of ``width``: standard deviations ``[O]``; in an entry variances ``[*B, O]``.
        divergence: probability that the filter has diverged, 0.01 for example: a good reading then is expected from a
            forecast of three times the standard deviations. One Gaussian for a mixture forgets the smaller peak; where
            that was the true one, it may take many good readings for outliers. It costs a third run.
        trainable: whether those that are numbers are parameters: the logit of the share, logarithms of the others.

    Raises:
        TypeError: for another analysis, whose forecast or reading is not known, or a module that is none.
        ValueError: if the share is outside [0, 1], or at its ends and trained; if width or noise is not positive; for a
            divergence outside [0, 1), or of particles.
        KeyError: if an entry is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import KalmanAnalysis
        >>> update = Contaminated(KalmanAnalysis(torch.eye(1), torch.ones(1)), 0.2, width=10.0)
        >>> for reading in (1.0, 9.0):
        ...     forecast = {"mean": torch.zeros(1), "cov": torch.eye(1)}
        ...     td = update(TensorDict({"forecast": forecast, "observation": torch.tensor([reading])}))
        ...     print(f"{td['info', 'outlier'].item():.2f} {td['belief', 'mean'].item():.2f}")
        0.04 0.48
        1.00 0.09
    """

    claimed: Tensor | None

    def __init__(
        self,
        analysis: Update,
        share: float | NestedKey | TensorDictModuleBase = 0.1,
        *,
        width: float | NestedKey | TensorDictModuleBase = 10.0,
        noise: Sequence[float] | Tensor | NestedKey | TensorDictModuleBase | None = None,
        divergence: float = 0.0,
        trainable: bool = False,
    ):
        kind, claimed = kind_of_update(analysis, "Contaminated"), None
        if isinstance(analysis, KalmanAnalysis) and analysis.noise is not None:
            claimed, analysis = analysis.noise, with_noise_from(_CLAIMED, analysis)
        quantities = {"share": _Quantity("share", share, torch.logit, torch.sigmoid, trainable)}
        if noise is None:
            quantities["width"] = _Quantity("width", width, torch.log, torch.exp, trainable)
        else:
            quantities["noise"] = _Quantity("noise", noise, torch.log, _exp_twice, trainable)
        own = [key for key in analysis.in_keys if key != _CLAIMED]
        known = {*own, *analysis.out_keys, *analysis.optional_keys}
        further, optional = (
            [key for one in quantities.values() for key in keys(one) if key not in known]
            for keys in (lambda one: one.in_keys, lambda one: one.optional_keys)
        )
        super().__init__(
            analysis,
            list(dict.fromkeys([*own, *further])),
            [*analysis.out_keys, (analysis.info_prefix, "outlier")],
            optional_keys=list(dict.fromkeys([*analysis.optional_keys, *optional])),
        )
        self.register_buffer("claimed", claimed)
        check_number("divergence", divergence, least=0, below=1)
        if divergence and kind == "particles":
            raise ValueError("divergence is for beliefs that keep mean and covariance: particles keep several peaks.")
        self.kind, self.quantities, self.divergence = kind, nn.ModuleDict(quantities), divergence
        self.noise_key = unravel_key(analysis.in_keys[5 if kind == "particles" else 3])
        # What entries say of a reading comes and goes with it; of a Kalman analysis it would be taken for the noise.
        entries = {one.key: name for name, one in quantities.items() if one.key is not None and one.head is None}
        self.said_by_entries = {} if claimed is not None else entries
        self.reading_keys = [*(key for key in analysis.reading_keys if key != _CLAIMED), *self.said_by_entries]
        if kind == "particles":
            predicted, reading, variance = analysis.in_keys[3:6]
            self.likelihood = GaussianLikelihood(
                reading_space=analysis.reading_space,
                predicted_key=predicted,
                observation_key=reading,
                noise_variance_key=variance,
                observed_key=analysis.observed_key,
                out_key=analysis.in_keys[2],
            )

    def parts(self):
        """Returns the analysis, and the modules that write share, width or noise."""
        heads = {name: one.head for name, one in self.quantities.items() if one.head is not None}
        return {"": self.module, **heads}

    def reading_dims(self, entries, call):
        """Returns the sizes of ``reading_keys`` in the analysis."""
        dims = [*self.module.reading_dims(entries, call)][: len(self.reading_keys)]
        return [*dims, *(dims[-1] if name == "noise" else 1 for name in self.said_by_entries.values())]

    def on_entries(self, entries, call):
        """Returns the belief and the diagnostics."""
        if self.claimed is not None:
            mean = self.required(entries, self.module.in_keys[0])
            entries = {**entries, _CLAIMED: self.claimed.expand(*mean.shape[:-1], *self.claimed.shape)}
        entries = with_draws(self.module, self.with_mask(entries, call), call)
        if self.kind == "members":
            entries = self.module.aligned(entries)
        mask = None if self.observed_key is None else narrowed_mask(self.reading_space, entries.get(self.observed_key))
        seen = None if mask is None else mask.any(-1, keepdim=True)
        out = self._of_sound(entries, call, seen)
        known, like = {**entries, **out}, out[self.info_prefix, "nis"]
        sound = 1 - self._said("share", known, call, seen, like).expand_as(like)
        wide = self._with(entries, self._outlier_noise(known, call, seen))
        other = self._run(wide, call)
        both, share = self._either(entries, sound, out, other, seen)
        if self.kind == "particles":
            key = self.module.in_keys[2]
            mixed = log_mixture(sound, entries[key], wide[key])
            mixed = mixed if seen is None else torch.where(seen, mixed, entries[key])  # nothing, not even rounding
            both = {**self._run({**entries, key: mixed}, call), **both}
        outlier = 1 - share if seen is None else torch.where(seen, 1 - share, 0)
        return {**out, **both, (self.info_prefix, "outlier"): outlier}

    def _run(self, entries: Entries, call: Call) -> Entries:
        """Returns the outputs of the analysis; an ensemble's predictions and reading are vectors already."""
        return (self.module.on_aligned if self.kind == "members" else self.module.on_entries)(entries, call)

    def _of_sound(self, entries: Entries, call: Call, seen: Tensor | None) -> Entries:
        """Returns the outputs of the analysis with R, of the forecast and of the one that has diverged."""
        out = self._run(entries, call)
        if not self.divergence:
            return out
        like, members = out[self.info_prefix, "nis"], self.kind == "members"
        factor = torch.full_like(like, _DIVERGED**2)
        wide = wider_past(self.module, wider_forecast(self.module, entries, factor, members=members), factor)
        known = torch.full_like(like, 1 - self.divergence)
        return {**out, **self._either(entries, known, out, self._run(wide, call), seen)[0]}

    def _either(
        self, entries: Entries, probability: Tensor, out: Entries, other: Entries, seen: Tensor | None
    ) -> tuple[Entries, Tensor]:
        """Returns belief and scores of a mixture of two runs, and the share of the first; of particles no belief."""
        (nis, first), (other_nis, second) = (
            (run[self.info_prefix, "nis"], run[self.info_prefix, "log_likelihood"]) for run in (out, other)
        )
        share = responsibility(probability, first, second)
        scores = {
            "nis": share * nis + (1 - share) * other_nis,
            "log_likelihood": log_mixture(probability, first, second),
        }
        if seen is not None:
            scores = {name: torch.where(seen, value, 0) for name, value in scores.items()}
        belief = {} if self.kind == "particles" else self.mixed(entries, probability, share, out, other, seen)
        return {**belief, **{(self.info_prefix, name): value for name, value in scores.items()}}, share

    def _said(self, name: str, entries: Entries, call: Call, seen: Tensor | None, like: Tensor) -> Tensor:
        """Returns share, width or noise, the latter as variances; 0, and 1, where nothing is observed."""
        quantity, nothing = cast(_Quantity, self.quantities[name]), float(name != "share")
        if quantity.key is not None and quantity.head is None and seen is not None and quantity.key not in entries:
            return torch.full_like(like, nothing)  # a step without the reading
        if quantity.head is not None and seen is not None:  # NaN that is hidden below would be NaN in its gradient
            read = [key for key in (*quantity.in_keys, *quantity.optional_keys) if key in entries]
            hidden = {key: where_rows(seen, entries[key], torch.zeros_like(entries[key])) for key in read}
            entries = {**entries, **hidden}
        value = quantity(self, entries, call)
        if quantity.key is not None:
            size, layout = (value.shape[-1:], "[*B, O]") if name == "noise" else ((1,), "[*B, 1]")
            check_shape(f"{name} {quantity.key!r}", value, (*like.shape[:-1], *size), layout)
        return value if seen is None or quantity.key is None else torch.where(seen, value, nothing)

    def _outlier_noise(self, entries: Entries, call: Call, seen: Tensor | None) -> Tensor:
        """Returns W, variances ``[*B, O]``, or a covariance ``[*B, O, O]`` where R is one."""
        noise, like = self.required(entries, self.noise_key), entries[self.info_prefix, "nis"]
        if "noise" in self.quantities:
            variance = self._said("noise", entries, call, seen, like).to(noise.dtype)
            return variance.expand(*like.shape[:-1], max(noise.shape[-1], variance.shape[-1]))
        factor = self._said("width", entries, call, seen, like).square().expand_as(like)
        return noise * (factor.unsqueeze(-1) if noise.ndim > like.ndim else factor)

    def _with(self, entries: Entries, noise: Tensor) -> Entries:
        """Returns the entries with another noise of the reading, and with the particles' likelihood under it."""
        entries = {**entries, self.noise_key: noise}
        if self.kind == "particles":
            entries.update(self.likelihood.on_entries(entries, Call(noise.shape[:-1])))
        return entries


class _Quantity(nn.Module):
    """A quantity that is a constant, a parameter, an entry, or the output of a module.

    Args:
        name: for messages, and of the place of the module's noise.
        value: one of these.
        inverse: maps numbers to what is kept of them.
        link: maps what is kept back.
        trainable: whether numbers are a parameter.
    """

    raw: Tensor | None

    def __init__(
        self,
        name: str,
        value: Any,
        inverse: Callable[[Tensor], Tensor],
        link: Callable[[Tensor], Tensor],
        trainable: bool,
    ):
        super().__init__()
        self.name, self.link, self.head = name, link, None
        self.key: NestedKey | None = None
        self.in_keys: list[NestedKey] = []
        self.optional_keys: list[NestedKey] = []
        kept = None
        if isinstance(value, nn.Module):
            check_module(name, value)
            self.head, self.key = value, writes(value)[0]
            self.in_keys, self.optional_keys = reads(value)
        elif isinstance(value, str) or (isinstance(value, tuple) and all(isinstance(part, str) for part in value)):
            self.key = unravel_key(value)
            self.in_keys = [self.key]
        else:
            numbers = as_floating(value, name)
            if name == "noise" and numbers.ndim != 1:
                raise ValueError(f"noise must be a list of standard deviations [O]; got {list(numbers.shape)}")
            if name != "noise" and numbers.numel() != 1:
                raise ValueError(
                    f"{name} is one number, as a reading is an outlier as a whole; got {list(numbers.shape)}. Give "
                    "components that fail apart a FusedSensor each, and rows that differ the key of an entry [*B, 1]."
                )
            if name != "share":
                check_values(name, numbers, above=0)
            elif trainable:
                check_values(name, numbers, above=0, below=1)
            else:
                check_values(name, numbers, least=0, most=1)
            kept = inverse(numbers)
        register_constant(self, "raw", kept, trainable=trainable)

    def forward(self, owner: Contaminated, entries: Entries, call: Call) -> Tensor:
        """Returns the quantity."""
        if self.raw is not None:
            return self.link(self.raw)
        if self.head is not None:
            return run_module(self.head, entries, call.part(self.name))[self.key]
        return owner.required(entries, self.key)


def _exp_twice(log_std: Tensor) -> Tensor:
    """Returns the variance of a logarithm of a standard deviation."""
    return (2 * log_std).exp()
