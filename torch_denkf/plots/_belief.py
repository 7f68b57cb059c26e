"""Reads belief, truth and observed masks of a roll-out for plots."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torch_denkf.functional.manifolds import Space
from torch_denkf.functional.moments import ensemble_cov, ensemble_mean, ensemble_var
from torch_denkf.functional.weighted import weighted_mean, weighted_var

TensorOrKey: TypeAlias = Tensor | NestedKey | None


class Belief(NamedTuple):
    """Belief for plots: detached, in float64 and on the CPU; missing entries are ``None``.

    Attributes:
        mean: ``[*B, S]``.
        var: ``[*B, S]``.
        cov: ``[*B, S, S]``.
        ensemble: ``[*B, E, S]``.
        log_weight: weights of particles, ``[*B, E]``.
        truth: ``[*B, S']``; S' may be smaller than S.
        observed: ``[*B, O]`` bool.
        known: ``[*B]`` bool, False if a fixed-lag smoother has no estimate of the state; all other entries are NaN
            there.
        name: name in legends.
    """

    mean: Tensor
    var: Tensor | None = None
    cov: Tensor | None = None
    ensemble: Tensor | None = None
    log_weight: Tensor | None = None
    truth: Tensor | None = None
    observed: Tensor | None = None
    known: Tensor = torch.tensor(True)
    name: str = "belief"

    @property
    def ensemble_size(self) -> int | None:
        """Returns E of an ensemble with equal weights, else ``None``."""
        return None if self.ensemble is None or self.log_weight is not None else self.ensemble.shape[-2]


def read_belief(
    run: TensorDictBase | Tensor,
    truth: TensorOrKey = None,
    observed: TensorOrKey = None,
    *,
    belief: NestedKey = "belief",
    one_sequence: bool = False,
    space: Space | None = None,
) -> Belief:
    """Reads ``("belief", ...)``, the truth and the observed mask.

    Args:
        run: a roll-out with ``("belief", "mean")`` or ``("belief", "ensemble")``; or the belief itself, with
            ``"mean"`` or ``"ensemble"``, such as ``rollout["forecast"]``; or means ``[*B, S]``.
        truth: a tensor ``[*B, S']``, a key of the roll-out, or ``None`` for ``"state"`` if it exists.
        observed: a tensor ``[*B, O]`` or ``[*B]`` bool, a key, or ``None`` for ``"observed"`` if it exists.
        belief: key of the belief in the roll-out, such as ``"smoothed"``. A belief of the state ``"age"`` steps ago,
            from :class:`~torch_denkf.smoothers.FixedLag`, is moved to the row of that state.
        one_sequence: whether ``*B`` must be ``T``.
        space: space of the states, points ``[*B, P]``; variances are those of tangents ``[*B, D]``.

    Raises:
        KeyError: if the roll-out has no belief, or lacks a given key.
        ValueError: if the shapes do not match.
    """
    age, last = None, belief if isinstance(belief, str) else belief[-1]
    if isinstance(run, Tensor):
        parts: dict[str, Tensor] = {"mean": number(run)}
    else:
        root = run.get(belief, run if belief == "belief" else {})
        names = ("mean", "var", "cov", "ensemble", "log_weight")
        parts = {name: number(root[name]) for name in names if name in set(root.keys())}
        if not {"mean", "ensemble"} & parts.keys():
            raise KeyError(
                f'no ("{last}", "mean") and no ("{last}", "ensemble") among {list(run.keys(True, True))}; pass what '
                'a filter\'s sequence or a roll-out of an environment with DEnKFTransform gives, or its "next"'
            )
        age = root.get("age", None)
        if age is not None and (weight := run.get(("belief", "log_weight"), None)) is not None:
            parts.setdefault("log_weight", number(weight))  # past particles have the present weights
    parts = _summarise(parts, space)
    if space is None and "var" in parts and parts["var"].shape != parts["mean"].shape:
        raise ValueError(
            f"the mean is {list(parts['mean'].shape)} and the variance {list(parts['var'].shape)}: if the states are "
            "points of a space, pass space="
        )
    batch = parts["mean"].shape[:-1]
    known = torch.ones(batch, dtype=torch.bool)
    if age is not None:
        parts, known = _to_rows_of_states(parts, age.detach().cpu().long().reshape(batch))
    optional = {"truth": entry_of(run, truth, "state"), "observed": entry_of(run, observed, "observed")}
    given = {name: number(value) for name, value in optional.items() if value is not None}
    read = Belief(**parts, **given, known=known, name="belief" if last == "belief" else f"{last} belief")
    if one_sequence and len(batch) != 1:
        raise ValueError(f"one sequence [T, S] is drawn at a time, got means {list(read.mean.shape)}; index the batch")
    if read.observed is not None:
        seen = read.observed.bool()
        read = read._replace(observed=seen.unsqueeze(-1) if seen.shape == batch else seen)
    for name in ("truth", "observed"):
        value = getattr(read, name)
        if value is not None and (value.ndim < 1 or value.shape[:-1] != batch):
            raise ValueError(f"{name} must be [*B, ...] with *B = {list(batch)}; got {list(value.shape)}")
    return read


def covariance_at(read: Belief, step: int, dims: list[int]) -> Tensor:
    """Returns the belief's covariance ``[len(dims), len(dims)]`` of dimensions at one step; needs ``read.var``."""
    assert read.var is not None
    if read.cov is not None:
        return read.cov[step][dims][:, dims]
    if read.ensemble is None or read.ensemble.shape[-2] < 2:
        return read.var[step, dims].diag()
    members = read.ensemble[step][:, dims]
    if read.log_weight is None:
        return ensemble_cov(members)
    share = read.log_weight[step].softmax(-1).unsqueeze(-1)
    centred = members - (share * members).sum(0)
    return (share * centred).mT @ centred


def number(value: Tensor) -> Tensor:
    """Returns the tensor detached, on the CPU, in float64; masks stay masks."""
    value = torch.as_tensor(value).detach().cpu()
    return value if value.dtype == torch.bool else value.double()


def dims_of(read: Belief, dims: object) -> list[int]:
    """Checks dimensions of the state; all by default.

    Raises:
        IndexError: if there is no such dimension.
    """
    size = read.mean.shape[-1]
    chosen = list(range(size)) if dims is None else [int(dim) for dim in dims]  # type: ignore[attr-defined]
    for dim in chosen:
        if not 0 <= dim < size:
            raise IndexError(f"dims names dimension {dim} of a state of {size} dimensions")
    return chosen


def with_truth(read: Belief, dims: list[int]) -> Tensor:
    """Returns the truth of the chosen dimensions, ``[*B, len(dims)]``.

    Raises:
        ValueError: without a truth, or if it lacks the dimensions.
    """
    if read.truth is None:
        raise ValueError('the truth is missing: pass truth=, or a roll-out with "state"')
    if read.truth.shape[-1] <= max(dims):
        raise ValueError(f"the truth has {read.truth.shape[-1]} dimensions, but {dims} are to be drawn")
    return read.truth[..., dims]


def entry_of(source: TensorDictBase | Tensor, value: Any, default: str) -> Any:
    """Returns a given tensor or array, the entry of a given key, or the ``default`` entry if the roll-out has it.

    Raises:
        KeyError: if there is no such key, or the roll-out is a tensor.
    """
    if isinstance(value, (Tensor, np.ndarray)):
        return value
    if isinstance(source, Tensor):
        if value is not None:
            raise KeyError(f"{value!r} is a key, but the belief is a tensor; pass a tensor")
        return None
    found = source.get(default if value is None else value, None)
    if found is None and value is not None:
        raise KeyError(f"no {value!r} among {list(source.keys(True, True))}")
    return found


def _to_rows_of_states(parts: dict[str, Tensor], age: Tensor) -> tuple[dict[str, Tensor], Tensor]:
    """Moves the smoothed entries of row t to the row of their time, t - age; later rows have priority.

    Returns:
        The parts, NaN in rows without an estimate, and the mask of rows with one, ``[*B]``.
    """
    time = age.ndim - 1
    rows = torch.arange(age.shape[-1]).expand_as(age)
    state = rows - age
    latest = torch.full_like(age, -1).scatter_reduce(-1, state.clamp(min=0), rows.where(state >= 0, -1), "amax")
    moved = {}
    for name, value in parts.items():
        row = latest.reshape(*age.shape, *[1] * (value.ndim - age.ndim))
        moved[name] = torch.take_along_dim(value, row.clamp(min=0), time).where(row >= 0, torch.nan)
    return moved, latest >= 0


def _summarise(parts: dict[str, Tensor], space: Space | None) -> dict[str, Tensor]:
    """Adds mean and variance if they can be computed."""
    if space is not None:
        space.check(**{name: parts[name] for name in ("mean", "ensemble") if name in parts})
    ensemble, weight, cov = parts.get("ensemble"), parts.get("log_weight"), parts.get("cov")
    out = dict(parts)
    if cov is not None:
        out.setdefault("var", cov.diagonal(dim1=-2, dim2=-1))
    if ensemble is not None and space is not None:
        out.setdefault("mean", space.mean(ensemble, None if weight is None else weight.softmax(-1)))
        ensemble = space.minus(ensemble, out["mean"].unsqueeze(-2))
    if ensemble is not None and weight is None:
        out.setdefault("mean", ensemble_mean(ensemble))
        if ensemble.shape[-2] > 1:
            out.setdefault("var", ensemble_var(ensemble))
    elif ensemble is not None and weight is not None:
        out.setdefault("mean", weighted_mean(ensemble, weight))
        out.setdefault("var", weighted_var(ensemble, weight))
    return out
