r"""Visibility estimates of a sensor, and updates that use them.

An occluded camera still gives a reading. :class:`Visibility` is a head of a sensor with the probability p that the
reading is about the state. :class:`Visible` wraps an analysis; its density of a reading is

.. math:: p\, N(y; h(x), S) + (1 - p)\, b(y)

with b broad, and the belief has the mean and the covariance of the mixture of update and forecast. Both are
differentiable, so that p is learned from labels, or from the likelihood of the readings.

Source: the probabilistic data association filter, with one reading and one target (Bar-Shalom & Tse 1975, Automatica
11); mixtures with a broad component against outliers: Box & Tiao 1968, Biometrika 55.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torch_denkf._checks import check_count, check_number
from torch_denkf.functional.weighted import weighted_innovation
from torch_denkf.imperfect.mixed import MixedUpdate, kind_of_update
from torch_denkf.imperfect.mixture import log_mixture, responsibility
from torch_denkf.modules.spaces import narrowed_mask
from torch_denkf.modules.stochastic import StochasticMLP
from torch_denkf.modules.tensors import mean_of_members
from torch_denkf.submodel import Call, Entries, Sensor, Update

__all__ = ["Visibility", "Visible"]


class Visibility(Sensor):
    r"""Predicts the probability that a reading is about the state from the sensor's encoding.

    With labels, it is trained by the term ``visible`` of the losses, a binary cross entropy. Without, it is trained by
    the likelihood of the readings, ``nll``, or another score of the belief.

    Args:
        encoding_dim: F, size of the encoding.
        num_cells: hidden layers.
        start: p before training, the same for all encodings.
        floor: p stays between ``floor`` and ``1 - floor``: no reading is certainly visible or hidden. With a smaller
            floor, an overconfident filter recovers sooner.
        encoding_key: an entry ``[*B, F]``, or of members ``[*B, E, F]``, whose mean is used.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``; encodings of frames of which nothing is observed may be
            NaN.
        out_key: p, ``[*B, 1]``.

    Raises:
        ValueError: if ``floor`` is not in (0, 0.5), or ``start`` not between it and 1 - ``floor``.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({("sensor", "encoding"): torch.randn(3, 16)}, [3])
        >>> Visibility(16)(td)["sensor", "visible"].flatten()
        tensor([0.9000, 0.9000, 0.9000], grad_fn=...)
    """

    judges_reading = True

    def __init__(
        self,
        encoding_dim: int,
        *,
        num_cells: Sequence[int] = (32,),
        start: float = 0.9,
        floor: float = 1e-6,
        encoding_key: NestedKey = ("sensor", "encoding"),
        observed_key: NestedKey = "observed",
        out_key: NestedKey = ("sensor", "visible"),
    ):
        check_count("encoding_dim", encoding_dim)
        check_number("floor", floor, above=0, below=0.5)
        check_number("start", start, above=floor, below=1 - floor)
        network = StochasticMLP(encoding_dim, 1, num_cells, layer="none", output_gain=0.0)
        share = (start - floor) / (1 - 2 * floor)
        with torch.no_grad():
            cast(nn.Linear, network.layers[-1]).bias.fill_(math.log(share / (1 - share)))
        super().__init__(network, [encoding_key], [out_key], optional_keys=[observed_key])
        self.floor = floor

    def compute(self, encoding, observed=None, *, batch_size):
        """Returns the probability."""
        encoding = mean_of_members(encoding, batch_size)
        if observed is not None:
            encoding = torch.where(observed.any(-1, keepdim=True), encoding, 0)
        return self.floor + (1 - 2 * self.floor) * self.module(encoding).sigmoid()

    def heeded_by(self, analysis: TensorDictModuleBase) -> Visible:
        """Returns :class:`Visible` around an analysis: readings are weighted by this head."""
        return Visible(cast(Update, analysis), visible_key=self.out_keys[0])


class Visible(MixedUpdate):
    r"""Weights a reading by the probability that it is about the state.

    The analysis runs once. With the posterior probability q that the reading is about the state, the belief is the
    mixture of the updated belief, weighted by q, and the forecast, weighted by 1 - q:

    =====================  =============================================================================================
    belief                 what becomes of it
    =====================  =============================================================================================
    mean and covariance    the mixture's, q (1 - q) d dᵀ of the way d between both means included; on a space those of
                           the tangents at the forecast
    ensemble               members with the mixture's mean and sample covariance, see
                           :func:`~torch_denkf.imperfect.mixture.mix_members`; a lag window that is corrected, too
    particles              the exact mixture: each particle's likelihood is one
    =====================  =============================================================================================

    With p = 1 that is the analysis alone, with p = 0 the forecast. ``(info_prefix, "log_likelihood")`` is that of the
    mixture, and ``(info_prefix, "visible")`` ``[*B, 1]`` is q, 0 where nothing is observed. Innovation and ``nis`` are
    those of the unweighted reading. b is the predictive Gaussian of the reading, ``broad`` times as wide: it is in the
    reading's unit, and grows without visible readings. A reading of O components that fits the forecast speaks for
    itself with up to ``broad`` to the power O: with many components, leave out the readings that p says are hidden.

    Args:
        analysis: of an ensemble, of a mean and a covariance, or of particles with a Gaussian likelihood. Its keys and
            its noise are kept.
        broad: factor on the standard deviations of b; above 1. About the range of possible readings, divided by the
            error of visible readings.
        visible_key: p, ``[*B, 1]``, see :class:`Visibility`.

    Raises:
        TypeError: for another analysis, whose forecast or reading is not known.
        ValueError: if ``broad`` is not above 1.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import KalmanAnalysis
        >>> update = Visible(KalmanAnalysis(torch.eye(1), torch.ones(1)))
        >>> for reading in (1.0, 9.0):
        ...     td = TensorDict({
        ...         "forecast": {"mean": torch.zeros(1), "cov": torch.eye(1)},
        ...         "observation": torch.tensor([reading]),
        ...         "sensor": {"visible": torch.tensor([0.5])},
        ...     })
        ...     td = update(td)
        ...     print(f"{td['info', 'visible'].item():.2f} {td['belief', 'mean'].item():.2f}")
        0.89 0.44
        0.00 0.00
    """

    def __init__(self, analysis: Update, *, broad: float = 10.0, visible_key: NestedKey = ("sensor", "visible")):
        check_number("broad", broad, above=1)
        kind = kind_of_update(analysis, "Visible")
        super().__init__(
            analysis,
            [*analysis.in_keys, visible_key],
            [*analysis.out_keys, (analysis.info_prefix, "visible")],
        )
        self.kind, self.broad, self.visible_key = kind, broad, unravel_key(visible_key)

    def on_entries(self, entries, call):
        """Returns the belief and the diagnostics."""
        if self.observed_key is not None:
            entries = self.with_mask(entries, call)
        mask = None if self.observed_key is None else narrowed_mask(self.reading_space, entries.get(self.observed_key))
        visible = entries.get(self.visible_key)
        if visible is None:  # where a step is taken without the reading, nothing says whether it sees
            like = self.required(entries, self.in_keys[0])
            visible = like.new_ones(*call.batch_size, 1)
            if mask is None:
                self.required(entries, self.visible_key)
        seen = None if mask is None else mask.any(-1, keepdim=True)
        if seen is not None:  # of a frame that is hidden p may be anything
            visible = torch.where(seen, visible, 1)
        if self.kind == "particles":
            return self._particles(entries, call, visible, mask, seen)
        out = self.module.on_entries(entries, call)
        nis, own, innovation = (out[self.info_prefix, name] for name in ("nis", "log_likelihood", "innovation"))
        count = torch.full_like(nis, innovation.shape[-1])
        if mask is not None:
            count = mask.expand(innovation.shape).sum(-1, keepdim=True, dtype=nis.dtype)
        other = own + 0.5 * nis * (1 - self.broad**-2) - count * math.log(self.broad)
        share = responsibility(visible, own, other)
        analysis, held = self.module, 2 if self.kind == "moments" else 1
        forecast = {key: entries[name] for key, name in zip(analysis.out_keys[:held], analysis.in_keys, strict=False)}
        mixed = self.mixed(entries, visible, share, out, {**entries, **forecast}, seen)
        if seen is not None:
            share = torch.where(seen, share, 0)
        scores = {"log_likelihood": log_mixture(visible, own, other), "visible": share}
        return {**out, **mixed, **{(self.info_prefix, name): value for name, value in scores.items()}}

    def _particles(
        self, entries: Entries, call: Call, visible: Tensor, mask: Tensor | None, seen: Tensor | None
    ) -> Entries:
        """Returns the posterior under likelihoods that are mixtures."""
        prior, likelihood = (self.required(entries, key) for key in self.module.in_keys[1:3])
        predicted, reading, variance = (self.required(entries, key) for key in self.module.in_keys[3:6])
        if self.module.reading_space is not None:
            predicted, reading = self.module.reading_space.align(predicted, reading, mask)
        if reading.ndim == predicted.ndim:
            reading = reading.mean(-2)
        innovation, nis, log_det = weighted_innovation(predicted, prior, reading, variance, observed=mask)
        count = torch.full_like(nis, innovation.shape[-1])
        if mask is not None:
            count = mask.expand(innovation.shape).sum(-1, keepdim=True, dtype=nis.dtype)
        other = -0.5 * (nis / self.broad**2 + log_det + count * math.log(2 * math.pi * self.broad**2))
        mixed = log_mixture(visible, likelihood, other)
        if seen is not None:
            mixed = torch.where(seen, mixed, likelihood)
        out = self.module.on_entries({**entries, self.module.in_keys[2]: mixed}, call)
        share = responsibility(visible, torch.logsumexp(prior + likelihood, -1, keepdim=True), other)
        return {**out, (self.info_prefix, "visible"): share if seen is None else torch.where(seen, share, 0)}
