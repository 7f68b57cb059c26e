"""A linear Gaussian model of each quantity, fitted on validation recordings, and the library's Kalman filter for it.

A quantity x is a random walk with a rate c, which decays to zero; if a target u is sent, x moves a share of the
distance to it. The sensor reads x + b with white noise; the bias b is the slow part of its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.optim.lr_scheduler import CosineAnnealingLR

from benchmarks.common.descent import minimise
from torch_denkf.filters import KalmanFilter
from torch_denkf.functional import kalman_predict, kalman_update
from torch_denkf.functional.smoothing.rts import rts_smooth

Parameters = dict[str, Tensor]  # for each quantity, [D]: logarithms of standard deviations, logits of shares


class Series(NamedTuple):
    """Readings of recordings of one length, in double precision.

    Attributes:
        truth: ``[N, T, D]``.
        reading: the mean of the sensor's samples, ``[N, T, D]``.
        observed: ``[N, T, 1]``.
        target: command at each time, ``[N, T, D]``; ``None`` for none.
    """

    truth: Tensor
    reading: Tensor
    observed: Tensor
    target: Tensor | None


class Model(NamedTuple):
    """F, B, Q and R of each quantity, and mean and covariance of the first state [x, c, b]."""

    transition: Tensor  # [D, 3, 3]
    control: Tensor  # [D, 3, 1]
    noise: Tensor  # [D, 3, 3]
    reading_noise: Tensor  # [D, 1]
    mean: Tensor  # [D, 3]
    cov: Tensor  # [D, 3, 3]


WINDOW, BURN_IN = 60, 10  # steps of a window in the fit, and its first steps, which are not scored
OBSERVATION = torch.tensor([[1.0, 0.0, 1.0]], dtype=torch.float64)


def model_of(parameters: Parameters, series: Sequence[Series]) -> Model:
    """Returns the matrices; the mean of the first x is that of the series."""
    p = parameters
    keeps_change, keeps_error, share = (p[name].sigmoid() for name in ("keeps_change", "keeps_error", "share"))
    walk, change, error, white = (p[name].exp().square() for name in ("walk", "change", "error", "white"))
    nothing, one = torch.zeros_like(share), torch.ones_like(share)
    if series[0].target is None:
        share = nothing
    rows = [(one - share, one, nothing), (nothing, keeps_change, nothing), (nothing, nothing, keeps_error)]
    truth = torch.cat([each.truth.flatten(0, 1) for each in series])
    first = (4 * truth.var(0), change / (1 - keeps_change.square()), error)
    return Model(
        torch.stack([torch.stack(row, -1) for row in rows], -2),
        torch.stack([share, nothing, nothing], -1).unsqueeze(-1),
        torch.stack([walk, change, error * (1 - keeps_error.square())], -1).diag_embed(),
        white.unsqueeze(-1),
        torch.stack([truth.mean(0), nothing, nothing], -1),
        torch.stack(first, -1).diag_embed(),
    )


def believe(model: Model, series: Series, lag: int) -> tuple[Tensor, Tensor]:
    """Returns differentiable means of x, filtered and smoothed, ``[N, T, D]``."""
    count, steps, size = series.truth.shape
    mean, cov = model.mean.expand(count, size, 3), model.cov.expand(count, size, 3, 3)
    transition, process = (value.expand(count, size, 3, 3) for value in (model.transition, model.noise))
    noise = model.reading_noise.expand(count, size, 1)
    forecast, cross, kept = (mean, cov), cov, []
    for t in range(steps):
        if t:
            cross = cov @ transition.mT
            forecast = kalman_predict(mean, cov, transition, process)
            if series.target is not None:
                sent = series.target[:, t - 1, :, None, None]
                forecast = (forecast[0] + (model.control @ sent).squeeze(-1), forecast[1])
        reading, observed = series.reading[:, t].unsqueeze(-1), series.observed[:, t, :, None].expand(-1, size, 1)
        mean, cov = kalman_update(*forecast, reading, OBSERVATION, noise, observed=observed)[:2]
        kept.append((mean, cov, *forecast, cross))
    means, covs, *rest = (torch.stack(value, 2) for value in zip(*kept, strict=True))
    smoothed, _ = rts_smooth(means, covs, *rest, lag=lag)
    return means[..., 0].mT, smoothed[..., 0].mT


def fit(series: Sequence[Series], lag: int, updates: int) -> Parameters:
    """Returns the parameters with the least error of x, given ``lag`` later readings; a lag of 0 fits a filter."""
    steps = torch.cat([each.truth.diff(dim=1).flatten(0, 1) for each in series]).square().mean(0).sqrt()
    errors = torch.cat([(each.reading - each.truth)[:, 1:].flatten(0, 1) for each in series]).square().mean(0).sqrt()
    zero = torch.zeros_like(steps)
    parameters = {
        "walk": (0.3 * steps).log(),
        "change": (0.3 * steps).log(),
        "keeps_change": zero,
        "error": (0.5 * errors).log(),
        "keeps_error": zero + 2,
        "white": (0.7 * errors).log(),
        "share": zero,
    }
    parameters = {name: value.clone().requires_grad_() for name, value in parameters.items()}
    cut = [windows_of(each) for each in series]

    def loss() -> Tensor:
        model, scores = model_of(parameters, series), []
        for each, (count, steps, size) in zip(cut, (each.truth.shape for each in series), strict=True):
            error = (believe(model, each, lag)[1] - each.truth)[:, min(BURN_IN, steps // 4) : -lag or None]
            scores.append(error.square().reshape(count, -1, size).mean(1).log())
        return torch.cat(scores).mean()

    minimise(parameters.values(), loss, updates, 0.2, schedule=partial(CosineAnnealingLR, T_max=updates))
    return {name: value.detach() for name, value in parameters.items()}


def windows_of(series: Series) -> Series:
    """Cuts recordings into windows; the remainder at the end is dropped."""
    steps = series.truth.shape[1]
    length = min(WINDOW, steps)

    def cut(value: Tensor) -> Tensor:
        return value[:, : steps // length * length].reshape(-1, length, value.shape[-1])

    return Series(*(None if value is None else cut(value) for value in series))


def kalman_filter(model: Model) -> KalmanFilter:
    """Returns the library's filter of all quantities; the state is [x, c, b] of the first, of the second, ..."""

    def joined(value: Tensor) -> Tensor:
        return torch.block_diag(*value)

    return KalmanFilter(
        joined(model.transition),
        joined(OBSERVATION.expand(len(model.mean), 1, 3)),
        process_noise_cov=joined(model.noise),
        noise=model.reading_noise.flatten().sqrt(),
        mean=model.mean.flatten(),
        cov=joined(model.cov),
        control=joined(model.control),
        update_at_reset=True,
    )
