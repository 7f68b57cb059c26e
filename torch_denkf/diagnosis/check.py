"""Checks an analysis against the exact Kalman update of a linear Gaussian system."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_denkf.functional import kalman_update
from torch_denkf.functional.gaussian import GaussianUpdate
from torch_denkf.functional.moments import ensemble_cov, ensemble_mean
from torch_denkf.functional.weighted import weighted_mean
from torch_denkf.running import in_sequences, random_parts, reads
from torch_denkf.submodel import Update, role

__all__ = ["check_analysis"]

_ROUNDING = 1e-3  # tolerance of deterministic results, in standard deviations; far above float32 rounding


def check_analysis(
    analysis: TensorDictModuleBase,
    *,
    state_dim: int = 3,
    observation_dim: int = 2,
    members: int = 4000,
    samples: bool = False,
    observation_key: NestedKey = ("sensor", "ensemble"),
    noise_variance_key: NestedKey = ("sensor", "noise"),
    observed_key: NestedKey | None = "observed",
    belief_prefix: str = "belief",
    info_prefix: str = "info",
    tolerance: float = 0.1,
    seed: int = 0,
) -> dict[str, float]:
    r"""Compares an analysis with the Kalman update, and checks its mask, shapes, gradient and noise.

    The forecast is Gaussian with the ensemble ``("forecast", "ensemble")``, its sample moments ``("forecast", "mean")``
    and ``("forecast", "cov")``, and equal ``("forecast", "log_weight")``. The observation is the first O components of
    the state, ``("forecast", "observation")``, so that an analysis with an observation model of its own needs
    ``LinearObservation(torch.eye(O, S))``. These properties are checked, as far as the analysis has the outputs:

    * mean, variances, covariance of the ensemble, innovation, NIS and log-likelihood are those of the Kalman update;
    * ``reading_keys`` names the reading, so that a filter can leave it out;
    * where nothing is observed, the belief is the forecast, and NaN behind the mask spoils no value and no gradient;
      where some components are observed, the belief is that of the Kalman update with these alone;
    * batches ``[]``, ``[3]`` and ``[2, 3]`` give beliefs of these shapes, and inputs are left as they are;
    * the derivative of the mean by the reading is the gain;
    * noise is drawn by ``draw_noise`` from the sizes that a filter knows beforehand, and by torch's generator.

    Args:
        analysis: a sub-model, or a ``TensorDictSequential`` of several, such as a likelihood and a particle analysis.
        state_dim: S.
        observation_dim: O, at most S.
        members: E; with it the errors of stochastic updates fall, like :math:`1/\sqrt{E}`.
        samples: whether the reading is learned observations ``[*B, E, O]``, and not one, ``[*B, O]``.
        observation_key: the reading.
        noise_variance_key: its variances ``[*B, O]``.
        observed_key: the mask; ``None`` if the analysis reads none, because its reading is never missing.
        belief_prefix: prefix of what is written.
        info_prefix: prefix of the diagnostics.
        tolerance: what may be off, in standard deviations of the exact belief, and as a share of the exact variances.
            Exact updates are off by rounding; of 4000 members 0.1 is three standard errors. An update that is right for
            small gains alone, like ``"sakov"``, needs 0.2: the gain here is about 0.4.
        seed: of the forecast and the reading; torch's global generator is left as it was.

    Returns:
        how far each number is off, by name.

    Raises:
        AssertionError: that lists all that failed.

    Example:
        >>> from torch_denkf.modules import EnsembleAnalysis
        >>> off = check_analysis(EnsembleAnalysis("etkf"))
        >>> off["mean"] < 1e-3, off["gain"] < 1e-3
        (True, True)
    """
    keys = _Keys(observation_key, noise_variance_key, observed_key, belief_prefix, info_prefix)
    own = next((v for v in (*analysis.parameters(), *analysis.buffers()) if v.is_floating_point()), None)
    case = _Case(
        state_dim, observation_dim, members, samples, keys, torch.get_default_dtype() if own is None else own.dtype
    )
    found: dict[str, float] = {}
    failures: list[str] = []
    broken: Exception | None = None
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        try:
            for name, off, allowed in _checks(analysis, case, tolerance):
                found[name] = max(off, found.get(name, 0.0))
                if not off <= allowed:  # NaN fails, too
                    failures.append(f"{name} is off by {off:.3g}, of which {allowed:g} is allowed")
        except Exception as error:  # what was found before may be its reason
            if not failures:
                raise
            broken = error
            failures.append(f"then it raised {type(error).__name__}: {error}")
    if failures:
        raise AssertionError(f"{type(analysis).__name__} fails:\n  " + "\n  ".join(failures)) from broken
    return found


class _Keys(NamedTuple):
    """The entries' names."""

    reading: NestedKey
    variance: NestedKey
    observed: NestedKey | None
    belief: str
    info: str


class _Case(NamedTuple):
    """A forecast and a reading of a linear Gaussian system."""

    state_dim: int
    observation_dim: int
    members: int
    samples: bool
    keys: _Keys
    dtype: torch.dtype

    @property
    def matrix(self) -> Tensor:
        """Returns H, the first O of S components."""
        return torch.eye(self.observation_dim, self.state_dim, dtype=self.dtype)

    def draw(self, batch: Sequence[int], members: int | None = None) -> TensorDict:
        """Draws inputs of an analysis, ``[*batch]``, without a mask."""
        size = self.members if members is None else members
        mixing = torch.eye(self.state_dim, dtype=self.dtype) + 0.3 * torch.randn(
            *batch, self.state_dim, self.state_dim, dtype=self.dtype
        )
        center = torch.randn(*batch, 1, self.state_dim, dtype=self.dtype)
        ensemble = center + torch.randn(*batch, size, self.state_dim, dtype=self.dtype) @ mixing.mT
        predicted = ensemble @ self.matrix.mT
        # A reading half a standard deviation off, of 1.5 times the forecast's variance: the gain is about 0.4.
        spread = predicted.var(-2)
        reading, variance = predicted.mean(-2) + 0.5 * spread.sqrt(), 1.5 * spread
        if self.samples:
            draws = torch.randn(predicted.shape, dtype=self.dtype)
            draws = (draws - draws.mean(-2, keepdim=True)) / draws.std(-2, keepdim=True)
            reading = reading.unsqueeze(-2) + variance.sqrt().unsqueeze(-2) * draws
        forecast = {"ensemble": ensemble, "observation": predicted}
        forecast |= {"mean": ensemble_mean(ensemble), "cov": ensemble_cov(ensemble)}
        forecast["log_weight"] = torch.full(ensemble.shape[:-1], 1 / size, dtype=self.dtype).log()
        td = TensorDict({"forecast": TensorDict(forecast, batch)}, batch)
        return td.set(self.keys.reading, reading).set(self.keys.variance, variance)

    def hide(self, td: TensorDict, observed: Tensor) -> TensorDict:
        """Adds a mask, and NaN behind it."""
        assert self.keys.observed is not None
        td, shown = td.clone(), observed
        reading = td[self.keys.reading]
        shown = shown.unsqueeze(-2) if self.samples else shown
        td[self.keys.reading] = torch.where(shown, reading, torch.nan)
        return td.set(self.keys.observed, observed)

    def exact(self, td: TensorDictBase, reading: Tensor | None = None) -> GaussianUpdate:
        """Returns the Kalman update of the forecast's sample moments."""
        reading = td[self.keys.reading] if reading is None else reading
        observed = None if self.keys.observed is None else td.get(self.keys.observed, None)
        mean, cov = td["forecast", "mean"], td["forecast", "cov"]
        reading = reading.mean(-2) if self.samples else reading
        return kalman_update(mean, cov, reading, self.matrix, td[self.keys.variance], observed=observed)


def _checks(analysis: TensorDictModuleBase, case: _Case, tolerance: float) -> Iterator[tuple[str, float, float]]:
    """Yields names of numbers, how far they are off, and how far they may be."""
    keys, td = case.keys, case.draw((2,))
    yield from _moments("", analysis, case, td, tolerance)
    for batch in ((), (3,), (2, 3)):
        small = case.draw(batch, members=16)
        out, size = analysis(small.clone()), (case.state_dim,)
        wrong = [name for name in ("mean", "var") if out.get((keys.belief, name)).shape != (*batch, *size)]
        yield f"shape of the belief in a batch {list(batch)}", float(len(wrong)), 0
        changed = [key for key in small.keys(True, True) if not small[key].equal(out[key])]
        yield "what was read, changed in place", float(len(changed)), 0
    yield from _gain(analysis, case, tolerance)
    yield from _noise(analysis, case)
    if keys.observed is not None:
        read = {key for some in reads(analysis) for key in some}
        named = [key for part in in_sequences(analysis) for key in map(unravel_key, role(part, Update).reading_keys)]
        yield f"the reading {keys.reading!r}, named in reading_keys", float(unravel_key(keys.reading) not in named), 0
        yield f"the mask {keys.observed!r}, read", float(unravel_key(keys.observed) not in read), 0
        width, nothing = case.observation_dim, torch.zeros(2, 1, dtype=torch.bool)
        first = torch.arange(width) > 0 if width > 1 else torch.ones(1, dtype=torch.bool)
        for name, observed in (
            ("where nothing is observed: ", nothing),
            ("where one row is observed: ", torch.tensor([[True], [False]])),
            ("where some components are observed: ", first.expand(2, width)),
        ):
            yield from _moments(name, analysis, case, case.hide(td, observed), tolerance)
        yield from _forecast("where nothing is observed: ", case, td, analysis(case.hide(td, nothing)))


def _moments(
    where: str, analysis: TensorDictModuleBase, case: _Case, td: TensorDict, tolerance: float
) -> Iterator[tuple[str, float, float]]:
    """Compares belief and diagnostics with the Kalman update."""
    keys, out, exact = case.keys, analysis(td.clone()), case.exact(td)
    variance = exact.cov.diagonal(dim1=-2, dim2=-1)
    std = variance.sqrt()
    mean = out[keys.belief, "mean"]
    yield f"{where}mean", _largest((mean - exact.mean) / std), tolerance
    yield f"{where}var", _largest(out[keys.belief, "var"] / variance - 1), tolerance
    scale = std.unsqueeze(-1) * std.unsqueeze(-2)
    ensemble, weights = out.get((keys.belief, "ensemble"), None), out.get((keys.belief, "log_weight"), None)
    if ensemble is not None:
        weights = td["forecast", "log_weight"] if weights is None else weights
        center = weighted_mean(ensemble, weights)
        anomalies = ensemble - center.unsqueeze(-2)
        size = anomalies.shape[-2]
        cov = (anomalies * weights.exp().unsqueeze(-1)).mT @ anomalies * (size / (size - 1))
        yield f"{where}covariance of the ensemble", _largest((cov - exact.cov) / scale), tolerance
        yield f"{where}mean of the ensemble", _largest((center - mean) / std), _ROUNDING
    elif out.get((keys.belief, "cov"), None) is not None:
        yield f"{where}cov", _largest((out[keys.belief, "cov"] - exact.cov) / scale), tolerance
    predicted = td["forecast", "observation"].var(-2) + td[keys.variance]
    scales = {"innovation": predicted.sqrt(), "nis": 1 + exact.nis, "log_likelihood": torch.ones_like(exact.nis)}
    for name, unit in scales.items():
        value = out.get((keys.info, name), None)
        if value is not None:
            yield f"{where}{name}", _largest((value - getattr(exact, name)) / unit), tolerance


def _forecast(where: str, case: _Case, td: TensorDict, out: TensorDictBase) -> Iterator[tuple[str, float, float]]:
    """Compares the belief with the forecast, member by member."""
    std = td["forecast", "cov"].diagonal(dim1=-2, dim2=-1).sqrt()
    for name, scale in (("mean", std), ("ensemble", std.unsqueeze(-2)), ("log_weight", 1.0)):
        value = out.get((case.keys.belief, name), None)
        if value is not None:
            yield f"{where}{name}, next to the forecast's", _largest((value - td["forecast", name]) / scale), _ROUNDING


def _gain(analysis: TensorDictModuleBase, case: _Case, tolerance: float) -> Iterator[tuple[str, float, float]]:
    """Compares the derivative of the mean by the reading with the gain; with a mask it must be finite."""
    keys, td = case.keys, case.draw((2,))
    reading = td[keys.reading].clone().requires_grad_()
    expected = torch.autograd.grad(case.exact(td, reading).mean.sum(), reading)[0]
    mean = analysis(td.clone().set(keys.reading, reading))[keys.belief, "mean"]
    ours = torch.autograd.grad(mean.sum(), reading, allow_unused=True)[0] if mean.requires_grad else None
    if ours is None:
        yield "gain: the mean has no gradient by the reading, which", float("nan"), tolerance
        return
    if case.samples:
        expected, ours = expected.sum(-2), ours.sum(-2)
    yield "gain", _largest((ours - expected) / expected.abs().amax(-1, keepdim=True)), tolerance
    if keys.observed is not None:
        hidden = case.hide(td, torch.tensor([[True], [False]]))
        inputs = [hidden["forecast", "ensemble"].requires_grad_(), hidden["forecast", "mean"].requires_grad_()]
        hidden["forecast", "observation"] = inputs[0] @ case.matrix.mT
        out = analysis(hidden)[keys.belief, "mean"].sum()
        gradients = torch.autograd.grad(out, inputs, allow_unused=True) if out.requires_grad else [None]
        sizes = [_largest(0 * gradient) for gradient in gradients if gradient is not None]
        yield "gradient by the forecast where one row is hidden", max(sizes, default=float("nan")), 0


def _noise(analysis: TensorDictModuleBase, case: _Case) -> Iterator[tuple[str, float, float]]:
    """Checks that noise can be drawn beforehand, and follows torch's generator."""
    state, width = case.state_dim, case.observation_dim
    for place, part in random_parts(analysis, "self"):
        lacks = part.draw_noise((2,), members=16, state_dim=state, observation_dim=width, dtype=case.dtype) is None
        yield f"draw_noise of {type(part).__name__} at {place!r}: what it did not draw", float(lacks), 0
    td, means = case.draw((2,), members=16), []
    for _ in range(2):
        generator = torch.get_rng_state()
        means.append(analysis(td.clone())[case.keys.belief, "mean"])
        torch.set_rng_state(generator)
    yield "belief for the same seed", _largest(means[1] - means[0]), 0


def _largest(value: Tensor) -> float:
    return float(value.detach().abs().max())
