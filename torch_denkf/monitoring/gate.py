"""Analysis with gating: rejects outliers, or enlarges their variances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypedDict, TypeGuard, get_args

import torch
from tensordict import TensorDictBase, unravel_key
from torch import Tensor, nn

from torch_denkf._checks import check_count, check_number
from torch_denkf.imperfect import Visible
from torch_denkf.imperfect.mixed import wider_forecast, wider_past, with_draws, with_noise_from
from torch_denkf.modules.around import Around
from torch_denkf.modules.kalman import KalmanAnalysis
from torch_denkf.monitoring._calibration import IDENTITY, check_observation_dim, chi_square_table, empirical_quantile
from torch_denkf.monitoring.chi_square import chi_square_quantile
from torch_denkf.monitoring.gating import Response, adapt, disbelief
from torch_denkf.monitoring.innovation_tests import interpolate
from torch_denkf.submodel import Call, Entries, Update

__all__ = ["GateOptions", "GatedAnalysis"]

_USUAL = 0.05  # p-value of the sum at which a closed gate opens
_LARGEST_FACTOR = 1e6  # bound of adapted factors on variances, and of their inverse


class GateOptions(TypedDict, total=False):
    """Arguments of :class:`GatedAnalysis` besides the analysis.

    Attributes:
        response: response to an outlier: ``"reject"`` masks it, ``"student"`` and ``"huber"`` enlarge its variances,
            see :func:`~torch_denkf.monitoring.gating.disbelief`; ``"student"`` by default. ``"reject"`` may mistake
            large motions for faults, after which the belief diverges.
        window: observed steps whose normalised innovations squared are summed up; 3 by default.
        rate: false-alarm rate, the probability that a fault-free sensor exceeds its limit; 1e-3 by default. 0 turns
            the gate off.
        freedom: degrees of freedom of Student's t; 4 by default.
        patience: number of successive rejections after which the gate opens: forecast and lag window are inflated until
            they cover the reading, and the window of innovations is emptied. Choose more than the longest fault has
            readings; 50 by default.
        by_component: whether each component of the reading is gated separately; only for ensembles, False by default.
        adapt_noise: rate of adapting the reading's variances to its innovations, about the inverse of the memory in
            steps; 0 by default, for none.
        adapt_inflation: rate of inflating the forecast's spread according to the innovations, by a factor of at least
            1; also 0 by default. It acts on steps with a reading, on the forecast, not on the lag window. Innovations
            do not tell which of the two is too small: use only one.
        gate_prefix: prefix of the state, ``"gate"`` by default.
    """

    response: Response
    window: int
    rate: float
    freedom: float
    patience: int
    by_component: bool
    adapt_noise: float
    adapt_inflation: float
    gate_prefix: str


def can_be_gated(analysis: nn.Module) -> TypeGuard[Update]:
    """Returns True for an analysis with known keys of forecast, reading and diagnostics."""
    if isinstance(analysis, Visible):
        return analysis.kind != "particles" and can_be_gated(analysis.module)
    wrapped = isinstance(analysis, Around) and not analysis.updates_ensemble
    if not isinstance(analysis, Update) or analysis.observed_key is None or wrapped:
        return False
    read = [unravel_key(key) for key in analysis.reading_keys]
    scores = {(analysis.info_prefix, name) for name in ("nis", "innovation")}
    in_place = [unravel_key(key) for key in analysis.in_keys[2 : 2 + len(read)]] == read
    return bool(read) and in_place and scores <= set(map(unravel_key, analysis.out_keys))


class GatedAnalysis(Around):
    """Gates a reading by the innovations of the last steps, including its own.

    The analysis runs twice: first unchanged, for the innovation, and then with the resulting variances, mask and
    spread. With ``rate=0`` and no adaptation the result equals that of the analysis exactly.

    It writes further entries, where K is the number of components with ``by_component``, else 1:

    ========================= ============ ============================================================================
    entry                     shape        content
    ========================= ============ ============================================================================
    (key, ``terms``)          ``[W,K,2]``  normalised innovations squared of the last observed steps, the latest first,
                                           and their degrees of freedom
    (key, ``shut``)           ``[K]``      steps in a row at which a reading was rejected
    (key, ``log_noise``)      ``[K]``      logarithm of the adapted factor on the variances
    (key, ``log_inflation``)  ``[1]``      logarithm of the adapted factor on the forecast's variances
    (key, ``factor``)         ``[K]``      factor of the gate on the variances; infinite for a rejection
    (key, ``nis``)            ``[1]``      of the ungated reading, for an :class:`InnovationMonitor`
    (key, ``innovation``)     ``[O]``      its innovation
    (key, ``part_nis``)       ``[K]``      of each component separately
    ========================= ============ ============================================================================

    Hysteresis: after a rejection, readings are accepted again when the sum falls below its 95 % quantile.

    The diagnostics of the analysis, such as ``("info", "nis")``, are those of the second run. The filter must
    initialise the state: :class:`~torch_denkf.monitoring.Gated` does.

    Args:
        analysis: :class:`EnsembleAnalysis`, :class:`LocalEnsembleAnalysis`, :class:`KalmanAnalysis`,
            :class:`EKFAnalysis` or :class:`UKFAnalysis`; :class:`~torch_denkf.imperfect.Visible` of one of these, whose
            readings the gate ignores while their probability of visibility is below one half; or a
            :class:`LaggedAnalysis`, whose lag window is gated, too. Its keys and its noise do not change.
        observation_dim: O, components of the reading.
        **options: see :class:`GateOptions`.

    Raises:
        TypeError: for another analysis, whose variances and forecast are not known.
        ValueError: if a number is out of range, or ``by_component`` is used with a mean and a covariance.

    Source:
        Student's t and Huber's loss in filters: Agamennoni, Nieto & Nebot 2012, IEEE Trans. Signal Processing 60;
        adaptation by innovations: Mehra 1970, IEEE Trans. Automatic Control 15; Anderson 2009, Tellus A 61.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import EnsembleAnalysis
        >>> gate = GatedAnalysis(EnsembleAnalysis("etkf"), 1, response="reject", window=1)
        >>> members = torch.tensor([[-1.0], [1.0]])
        >>> td = TensorDict({
        ...     "forecast": {"ensemble": members, "observation": members},
        ...     "sensor": {"ensemble": torch.tensor([40.0]), "noise": torch.tensor([2.0])},
        ... })
        >>> for key, value in zip(gate.state_keys, gate.initial_state([]), strict=True):
        ...     td[key] = value
        >>> gate(td)["belief", "mean"], td["gate", "factor"]
        (tensor([0.]), tensor([inf]))
    """

    tables: Tensor
    slack: Tensor
    limits: Tensor
    usual: Tensor
    claimed: Tensor | None
    observation_dim: int

    reading_dims = Update.reading_dims  # O is known here; the variances inside a Kalman analysis are not counted

    def __init__(
        self,
        analysis: Update,
        observation_dim: int,
        *,
        response: Response = "student",
        window: int = 3,
        rate: float = 1e-3,
        freedom: float = 4.0,
        patience: int = 50,
        by_component: bool = False,
        adapt_noise: float = 0.0,
        adapt_inflation: float = 0.0,
        gate_prefix: str = "gate",
    ):
        if not can_be_gated(analysis):
            raise TypeError(
                f"{type(analysis).__name__} does not say where its variances and its forecast are. A gate goes around "
                "an EnsembleAnalysis, LocalEnsembleAnalysis, KalmanAnalysis, EKFAnalysis or UKFAnalysis, or Visible of "
                "one of these, or one of your own: its in_keys begin with two of the forecast and its reading_keys, it "
                "names its observed_key, and it writes nis and innovation under its info_prefix."
            )
        inside = analysis.module if isinstance(analysis, Visible) else analysis
        of_ensemble = inside.updates_ensemble
        if by_component and not of_ensemble:
            raise ValueError("by_component is for ensembles: an update of mean and covariance is judged as a whole")
        if response not in get_args(Response):
            raise ValueError(f"response is one of {', '.join(get_args(Response))}; got {response!r}")
        check_count("observation_dim", observation_dim)
        check_count("window", window)
        check_count("patience", patience)
        check_number("rate", rate, least=0, below=1)
        check_number("freedom", freedom, above=0)
        check_number("adapt_noise", adapt_noise, least=0, below=1)
        check_number("adapt_inflation", adapt_inflation, least=0, below=1)
        claimed = None
        if isinstance(inside, KalmanAnalysis) and inside.noise is not None:
            claimed, read = inside.noise, with_noise_from((gate_prefix, "claimed"), inside)
            analysis = analysis.around(read) if isinstance(analysis, Visible) else read
        state = [(gate_prefix, name) for name in ("terms", "shut", "log_noise", "log_inflation")]
        further = [(gate_prefix, name) for name in ("factor", "nis", "innovation", "part_nis")]
        in_keys = [key for key in analysis.in_keys if claimed is None or key != analysis.in_keys[3]]
        out_keys = [*analysis.out_keys, *state, *further]
        super().__init__(analysis, [*in_keys, *state], out_keys)
        self.register_buffer("claimed", claimed)
        self.state_keys, self._further, self.of_ensemble = state, further, of_ensemble
        self.response, self.window, self.rate, self.freedom = response, window, rate, freedom
        self.patience, self.by_component = patience, by_component
        self.adapt_noise, self.adapt_inflation = adapt_noise, adapt_inflation
        self.gate_prefix = gate_prefix
        self.reading_keys = [key for key in analysis.reading_keys if key in in_keys]
        self.noise_variance_key = unravel_key(analysis.in_keys[3])
        self.observation_dim, self.parts_count = observation_dim, observation_dim if by_component else 1
        self.register_buffer("tables", IDENTITY.repeat(self.parts_count, 1, 1))
        self.register_buffer("slack", torch.ones(self.parts_count))
        most = window * observation_dim // self.parts_count
        limits = [torch.inf] + [chi_square_quantile(rate, n) if rate else torch.inf for n in range(1, most + 1)]
        self.register_buffer("limits", torch.tensor(limits))
        usual = [chi_square_quantile(max(rate, _USUAL), n) for n in range(1, most + 1)]
        self.register_buffer("usual", torch.tensor([torch.inf, *usual]))

    def initial_state(self, batch_size: Sequence[int], *, device=None, dtype=None) -> list[Tensor]:
        """Returns the state before anything was observed, in the order of ``state_keys``."""
        count = self.parts_count
        sizes = ((self.window, count, 2), (count,), (count,), (1,))
        return [torch.zeros(*batch_size, *size, device=device, dtype=dtype) for size in sizes]

    # ------------------------------------------------------------------------------------------------------ one step

    def on_entries(self, entries, call):
        """Returns the belief, the diagnostics and the state."""
        terms, shut, log_noise, log_inflation = (self.required(entries, key) for key in self.state_keys)
        plain = self.with_mask(self._with_noise(entries, call), call)
        if self.of_ensemble:
            plain = self.module.aligned(plain)
        if self.adapt_noise:
            plain = self._noisier(plain, log_noise.exp())
        entries, inflation = plain, torch.ones_like(log_inflation)
        if self.adapt_inflation:
            mask = plain.get(self.observed_key)
            inflation = log_inflation.exp()
            if mask is not None:  # without a reading, inflation would accumulate
                inflation = torch.where(mask.any(-1, keepdim=True), inflation, 1)
            entries = self._wider(plain, inflation)
        out = self._analyse(entries, call)
        nis, innovation = (out[self.info_prefix, name] for name in ("nis", "innovation"))
        check_observation_dim(self.observation_dim, innovation, f"the gate {self.gate_prefix!r}")
        part, freedom = self._parts(entries, nis, innovation)
        dtype = nis.dtype
        calibrated = interpolate(part, *self.tables.to(dtype).unbind(1)).clamp_min(0)
        seen = freedom > 0
        term = torch.stack([calibrated, freedom], -1).unsqueeze(-3)
        terms = torch.where(seen[..., None, :, None], torch.cat([term, terms[..., :-1, :, :]], -3), terms)
        rejects = self.response == "reject"
        if self.rate:
            evidence, total = terms.sum(-3).unbind(-1)
            limit = self.limits[total.long()] * self.slack
            if rejects:  # hysteresis: a lower limit for accepting again
                limit = torch.where(shut > 0, self.usual[total.long()], limit)
            limit = limit.to(dtype)
            factor = torch.where(seen, disbelief(evidence, limit, self.response, freedom=self.freedom), 1)
            doubted = factor > 1
            opens = doubted & (shut >= self.patience)
            doubted = doubted & ~opens
            factor = torch.where(opens, 1, factor)
            terms = torch.where(opens[..., None, :, None], 0, terms)
            shut = torch.where(doubted, shut + 1, torch.where(seen, 0, shut))
            reach = torch.where(opens, (calibrated / freedom.clamp_min(1)).clamp_min(1), 1).amax(-1, keepdim=True)
            wider = inflation * reach
            if rejects:
                seen = seen & ~doubted  # outliers must not adapt the noise
                wider = torch.where(seen.any(-1, keepdim=True), wider, 1)
            inside = self.module.module if isinstance(self.module, Visible) else self.module
            spread = wider_past(inside, self._wider(plain, wider), reach)
            out = (
                self._without(spread, call, doubted) if rejects else self._analyse(self._noisier(spread, factor), call)
            )
        else:
            factor = torch.ones_like(part)
        if self.adapt_noise:
            bound = math.log(_LARGEST_FACTOR)
            log_noise = adapt(log_noise, calibrated, seen * freedom, self.adapt_noise).clamp(-bound, bound)
        if self.adapt_inflation:
            used = seen * freedom
            whole = (seen * calibrated).sum(-1, keepdim=True)
            grown = adapt(log_inflation, whole, used.sum(-1, keepdim=True), self.adapt_inflation)
            log_inflation = grown.clamp(0, math.log(_LARGEST_FACTOR))
        own = (terms, shut, log_noise, log_inflation, factor, nis, innovation, part)
        return {**out, **dict(zip((*self.state_keys, *self._further), own, strict=True))}

    def _analyse(self, entries: Entries, call: Call) -> Entries:
        """Returns the outputs of the analysis; an ensemble's predictions and readings are aligned already."""
        return (self.module.on_aligned if self.of_ensemble else self.module.on_entries)(entries, call)

    def _with_noise(self, entries: Entries, call: Call) -> Entries:
        """Returns the entries with the random numbers for both runs, and the variances of a Kalman analysis."""
        entries = dict(entries)
        if self.claimed is not None:
            mean = self.required(entries, self.in_keys[0])
            entries[self.noise_variance_key] = self.claimed.expand(*mean.shape[:-1], *self.claimed.shape)
        return with_draws(self.module, entries, call)

    def _parts(self, entries: Entries, nis: Tensor, innovation: Tensor) -> tuple[Tensor, Tensor]:
        """Returns normalised innovations squared ``[*B, K]``, and the number of observed components in each."""
        mask = entries.get(self.observed_key)
        observed = torch.ones_like(innovation) if mask is None else mask.expand(innovation.shape).to(nis.dtype)
        if isinstance(self.module, Visible):  # occluded readings are no evidence about the sensor
            visible = entries.get(self.module.visible_key)
            observed = observed if visible is None else torch.where(visible >= 0.5, observed, 0)
        if not self.by_component:
            return torch.where(observed.any(-1, keepdim=True), nis, 0), observed.sum(-1, keepdim=True)
        predicted, variance = entries[self.module.in_keys[1]], entries[self.noise_variance_key]
        seen = observed > 0  # unobserved components may be NaN
        predicted = predicted.var(-2) if predicted.shape[-2] > 1 else torch.zeros_like(innovation)
        spread = torch.where(seen, predicted, 0) + torch.where(seen, variance, 1)
        return torch.where(seen, innovation.square() / spread, 0), observed

    def _noisier(self, entries: Entries, factor: Tensor) -> Entries:
        """Returns the entries with variances ``[*B, O]`` or a covariance ``[*B, O, O]`` times a factor ``[*B, K]``."""
        noise = self.required(entries, self.noise_variance_key)
        if noise.ndim > factor.ndim:
            factor = factor.unsqueeze(-1)
        return {**entries, self.noise_variance_key: noise * factor}

    def _wider(self, entries: Entries, factor: Tensor) -> Entries:
        """Returns the entries with the forecast's covariance times a factor ``[*B, 1]``."""
        return wider_forecast(self.module, entries, factor, members=self.of_ensemble)

    def _without(self, entries: Entries, call: Call, rejected: Tensor) -> Entries:
        """Runs the analysis without the rejected readings ``[*B, K]``."""
        mask = entries.get(self.observed_key)
        kept = ~rejected if mask is None else mask & ~rejected
        return self._analyse({**entries, self.observed_key: kept}, call)

    # --------------------------------------------------------------------------------------------------- calibration

    @torch.no_grad()
    def calibrate(self, clean: Sequence[TensorDictBase], *, margin: float = 1.0) -> GatedAnalysis:
        """Calibrates the distribution of the innovations, and of their windowed sums, on clean data.

        Args:
            clean: recordings ``[*B, T]``, time last, of ``(gate_prefix, "part_nis")``: outputs of the filter with the
                gate off.
            margin: factor on the limits.

        Returns:
            This analysis.

        Raises:
            ValueError: if fewer than 50 steps were observed.
        """
        columns = [each[self.gate_prefix, "part_nis"] for each in clean]
        freedom = self.observation_dim // self.parts_count
        for part in range(self.parts_count):
            values = torch.cat([column[..., part].flatten() for column in columns]).double()
            values = values[values > 0]  # 0 at a reset, or if nothing is observed
            if len(values) < 50:
                raise ValueError(f"calibrate needs 50 steps at which part {part} is observed; there are {len(values)}")
            self.tables[part] = chi_square_table(values, freedom)
        ratios = []
        for column in columns:
            calibrated = interpolate(column, *self.tables.to(column.dtype).unbind(1)).clamp_min(0)
            steps = calibrated.unfold(-2, min(self.window, column.shape[-2]), 1).sum(-1)
            ratios.append(steps.flatten(0, -2) / self.limits[freedom * min(self.window, column.shape[-2])])
        ratio = torch.cat(ratios).double()
        for part in range(self.parts_count):
            found = float(empirical_quantile(ratio[:, part], torch.tensor([1 - self.rate])))
            self.slack[part] = margin * max(1.0, found)
        return self
