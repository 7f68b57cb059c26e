"""Estimates the latency between a recording's images and its states, in rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from torch_denkf.data.episodes import rows_of

if TYPE_CHECKING:
    from torch_denkf.data.lerobot.replay import LeRobotReplay

__all__ = ["lag_errors"]

_SMALL = (30, 40)  # size of the grey images for the regression, pixels
_RIDGE = 0.02  # relative to the principal components' variances


def lag_errors(
    data: LeRobotReplay,
    lags: Sequence[int] = range(-6, 7),
    *,
    dims: Sequence[int] | None = None,
    components: int = 150,
    folds: int = 5,
) -> dict[int, float]:
    """Returns, for each lag, the error of predicting from images the states that are recorded ``lag`` rows later.

    The camera and the joints of a robot may reach the recorder with different latencies. The lag with the smallest
    error, ``lag = min(errors, key=errors.get)``, is the argument ``lag`` of :class:`~torch_denkf.data.LeRobotReplay`.
    If the minimum is at an edge, try larger lags; if it is flat, the lag hardly matters.

    The predictor is a ridge regression from principal components of small grey images, cross-validated by episodes, on
    the same rows for every lag. Rows that are not observed are left out.

    Args:
        data: data set of training episodes only, opened with ``lag=0``, and with ``repeats="mask"`` if images repeat.
        lags: lags to try, in rows; k compares the image of row t with the state of row t + k.
        dims: components of the state to predict; by default all that vary.
        components: number of principal components of the images.
        folds: number of folds of the cross-validation.

    Returns:
        Root mean square error by lag, in standard deviations of the state's components.

    Raises:
        ValueError: if the data set has a lag already, fewer than two episodes, or episodes too short for the lags.

    Examples:
        >>> from torch_denkf.data import LeRobotReplay
        >>> data = LeRobotReplay("g1", repeats="mask")  # doctest: +SKIP
        >>> errors = lag_errors(data, dims=range(7, 14))  # doctest: +SKIP
        >>> data = LeRobotReplay("g1", repeats="mask", lag=min(errors, key=errors.get))  # doctest: +SKIP
    """
    if data.lag:
        raise ValueError(f"the data set is opened with lag={data.lag} already; open it with lag=0 to estimate it")
    early, late = max(-min(lags), 0), max(*lags, 0)
    shortest = min(episode.length for episode in data.episodes)
    if len(data.episodes) < 2 or shortest <= early + late:
        raise ValueError(
            f"lags {min(lags)} to {max(lags)} need two episodes, each of more than {early + late} rows; the data set "
            f"has {len(data.episodes)}, the shortest of {shortest} rows"
        )
    everything = data.storage[:]
    seen, state = everything["observed"].squeeze(-1), everything["state"].double()
    inner = [torch.arange(e.start + early, e.start + e.length - late) for e in data.episodes]
    fold = torch.cat([torch.full((len(rows),), k % folds) for k, rows in enumerate(inner)])
    index = torch.cat(inner)
    fold, index = fold[seen[index]], index[seen[index]]
    inputs = _principal_components(_small_pictures(data, index), components)
    scale = state[rows_of(data.episodes)].std(0)
    chosen = [k for k in (range(state.shape[-1]) if dims is None else dims) if scale[k] > 1e-6]
    targets = {lag: state[index + lag][:, chosen] / scale[chosen] for lag in lags}
    squares = dict.fromkeys(lags, 0.0)
    for number in range(folds):
        out = fold == number
        if not out.any():
            continue
        a = inputs[~out]
        system = a.mT @ a + _RIDGE * len(a) * torch.eye(a.shape[-1], dtype=a.dtype)
        for lag, target in targets.items():
            mean = target[~out].mean(0)
            weights = torch.linalg.solve(system, a.mT @ (target[~out] - mean))
            squares[lag] += float((inputs[out] @ weights + mean - target[out]).square().mean(-1).sum())
    return {lag: (total / len(index)) ** 0.5 for lag, total in squares.items()}


def _small_pictures(data: LeRobotReplay, index: Tensor) -> Tensor:
    """Returns small grey images of some rows, ``[n, pixels]``."""
    parts = [adaptive_avg_pool2d(data[rows]["pixels"].mean(1, keepdim=True), _SMALL) for rows in index.split(256)]
    return torch.cat(parts).flatten(1)


def _principal_components(pictures: Tensor, count: int) -> Tensor:
    """Returns principal components with variance one, ``[n, count or less]``."""
    pictures = pictures - pictures.mean(0)
    count = min(count, len(pictures) // 2, pictures.shape[-1])
    values, vectors = torch.linalg.eigh((pictures.mT @ pictures).double() / len(pictures))
    values, vectors = values.flip(0)[:count], vectors.flip(1)[:, :count]
    used = values > 1e-6 * values[0]
    return pictures.double() @ vectors[:, used] / values[used].sqrt()
