"""Evaluation of the beliefs of a sequence: errors, coverage, CRPS and NEES, in the filter's own space."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

from torch_denkf.beliefs import Ensemble, Particles, kinds_of
from torch_denkf.diagnosis.errors import entry_of
from torch_denkf.filters import Filter
from torch_denkf.functional import crps_ensemble, crps_gaussian
from torch_denkf.functional.moments import ensemble_cov
from torch_denkf.metrics.calibration import ensemble_interval_coverage, interval_coverage
from torch_denkf.metrics.consistency import NEES, nees
from torch_denkf.metrics.state import known_tangents, mean_of_known, state_difference, state_errors

__all__ = ["Evaluation", "evaluate"]


class Evaluation(NamedTuple):
    """Holds the results of :func:`evaluate`, one number for each component of the state, of tangents on a space.

    Attributes:
        rmse: root mean square error, ``[D]``, in each component's units.
        mae: mean absolute error, ``[D]``.
        coverage: share of the truth inside the central interval of probability ``level``, ``[D]``.
        crps: continuous ranked probability score, ``[D]``, in each component's units: lower is better.
        nees: normalised estimation error squared of the components whose truth is known, over the elements where all of
            these are: their number for a consistent filter. ``None`` without a covariance, or with no more members
            than components. Draws that are random (``draws="random"``) make that of E members larger, by
            (E + 1) (E - 1) / (E (E - D - 2)) for D components. Its bounds take elements to be independent.
        known: elements whose truth is known, ``[D]``.
    """

    rmse: Tensor
    mae: Tensor
    coverage: Tensor
    crps: Tensor
    nees: NEES | None
    known: Tensor


@torch.no_grad()
def evaluate(
    filter: Filter,
    data: TensorDictBase,
    truth: Tensor | NestedKey = "state",
    *,
    level: float = 0.9,
    belief: str = "belief",
) -> Evaluation:
    """Compares the beliefs of sequences with the truth, in the space that the filter's states live in.

    On a space errors, variances and covariances are those of tangents at the mean. Plain differences of points would be
    of other axes: those of the world, where ``var`` of a pose is of the body's.

    Elements count that the filter stepped to: the first of a sequence, and of each episode, holds an initial belief.

    Args:
        filter: the filter.
        data: sequences ``[*B, T]`` of frames, which are filtered; or what the filter, or a smoother, wrote for them.
        truth: true states ``[*B, T, N]`` of the leading N components, on a space points of its leading parts; or their
            key. What is NaN is not known, nor what a mask named like the key with ``_observed`` behind leaves out.
        level: probability of the intervals, and of the bounds of the NEES.
        belief: prefix of the beliefs, ``"smoothed"`` for those of a smoother.

    Returns:
        An :class:`Evaluation`. Members that count alike are scored as an ensemble, particles with weights by their
        moments and the CRPS of their weights, all others as a Gaussian.

    Raises:
        TypeError: for what is no filter.
        KeyError: if an entry is missing.
        ValueError: if the truth has another shape or is nowhere known, members are too few for ``level``, or a belief
            is NaN.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> kf = KalmanFilter(one, one, process_noise=[1.0], noise=[1.0], mean=torch.zeros(1), cov=one)
        >>> walk = torch.randn(200, 100, 1, generator=torch.Generator().manual_seed(0)).cumsum(1)
        >>> noise = torch.randn(200, 100, 1, generator=torch.Generator().manual_seed(1))
        >>> result = evaluate(kf, TensorDict({"observation": walk + noise, "state": walk}, [200, 100]))
        >>> result.rmse.round(decimals=1), result.coverage.round(decimals=1), result.nees.mean.round(decimals=1)
        (tensor([0.8000]), tensor([0.9000]), tensor(1.))
    """
    if not isinstance(filter, Filter):
        raise TypeError(f"filter must be a torch_denkf Filter; got {filter!r}"[:200])
    held = filter.inside(data).get(belief, None)
    if held is None and (belief,) in [kind.prefix for kind in filter.structure.kinds]:
        held = filter.inside(data := filter.sequence(data.copy())).get(belief)
    if held is None:
        raise KeyError(f"{type(filter).__name__} writes no {belief!r}: pass what its smoother wrote.")
    space = filter.structure.space
    (kind,) = kinds_of([(belief, name) for name in list(held.keys())], space)
    mean, var = (entry_of(held, name, "evaluate", "Keep it in the sequence.") for name in ("mean", "var"))
    truth = _known(filter, data, truth, mean)
    broken = (mean.isnan() & ~truth.isnan()).any(-1)
    if broken.any():
        raise ValueError(
            f"{(belief, 'mean')!r} is NaN in {int(broken.sum())} of the elements whose truth is known. A step "
            "names the cause. RejectReadings in front of the filter makes readings that are not finite missing ones."
        )
    error, known = state_difference(truth, mean, space=space), known_tangents(truth, space)
    dims = (~known.isnan()).flatten(0, -2).any(0).nonzero().flatten()
    if not len(dims):
        raise ValueError("the truth is nowhere known where the filter stepped to")
    covered = interval_coverage(mean, var, truth, level=level, space=space)
    cov = held.get("cov", None)
    if isinstance(kind, Ensemble | Particles):
        members = held["ensemble"]
        around = mean.unsqueeze(-2)
        away = members - around if space is None else space.minus(members, around)
    if isinstance(kind, Ensemble):
        covered = ensemble_interval_coverage(members, truth, level=level, space=space)
        crps, cov = crps_ensemble(away, error), ensemble_cov(away) if away.shape[-2] > len(dims) else None
    elif isinstance(kind, Particles):
        crps = crps_ensemble(away, error, held["log_weight"])
        cov = away.mT @ (held["log_weight"].exp().unsqueeze(-1) * away)
    else:
        crps = crps_gaussian(torch.zeros_like(error), var, error)
    consistency = None
    if cov is not None:
        rows = ~known[..., dims].isnan().any(-1)
        error, cov = error[rows][:, dims], cov[rows][:, dims][:, :, dims]
        consistency = nees(torch.zeros_like(error), cov, error, level=level)
    count = (~known.isnan()).flatten(0, -2).sum(0)
    return Evaluation(*state_errors(mean, truth, space=space), covered, mean_of_known(crps, known), consistency, count)


def _known(filter: Filter, data: TensorDictBase, truth: Tensor | NestedKey, mean: Tensor) -> Tensor:
    """Returns the true states in the shape of the mean, NaN where they are not known or do not count."""
    counts = filter.stepped(data).unsqueeze(-1)
    if not isinstance(truth, Tensor):
        key = unravel_key(truth)
        mask = f"{key}_observed" if isinstance(key, str) else (*key[:-1], f"{key[-1]}_observed")
        observed = data.get(mask, None)
        counts = counts if observed is None else counts & observed
        truth = entry_of(data, key, "evaluate", "Pass the true states, or their key.")
    if truth.shape[:-1] != mean.shape[:-1] or truth.shape[-1] > mean.shape[-1]:
        raise ValueError(
            f"truth is [*B, T, N], at most {list(mean.shape)} as the means; got {list(truth.shape)}. Of a part of the "
            "state it has the leading components."
        )
    out = torch.full_like(mean, torch.nan)
    out[..., : truth.shape[-1]] = torch.where(counts, truth.to(mean), torch.nan)
    return out
