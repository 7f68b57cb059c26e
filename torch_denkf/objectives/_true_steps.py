"""Steps of a filter's transition from true states, each from the one before."""

from __future__ import annotations

from math import log

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

from torch_denkf.filters import Filter
from torch_denkf.filters._structure import previous_key
from torch_denkf.modules._call import Call, Entries
from torch_denkf.modules._running import reads, run_module, run_modules

__all__ = ["forecasts_from_truth", "has_members", "members_of", "one_earlier"]


def has_members(filter: Filter, belief: str) -> bool:
    """Whether a filter carries members, and not a mean and a covariance.

    Raises:
        ValueError: if it carries neither below the prefix ``belief``.
    """
    carry = filter.structure.carry
    members = (belief, "ensemble") in carry
    if not members and not {(belief, "mean"), (belief, "cov")} <= set(carry):
        raise ValueError(
            f"A step from a true state needs {(belief, 'ensemble')}, or {(belief, 'mean')} and {(belief, 'cov')}; the "
            f"filter carries {list(carry)}. Name the prefix of its belief, belief=..."
        )
    return members


def forecasts_from_truth(
    filter: Filter, tensordict: TensorDictBase, truth: Tensor, belief: str, *, spread: Tensor, members: int | None
) -> Entries:
    """What the transition writes at every time of ``[*B, T]`` where the state before was the true one.

    What else the belief carries is read where it is stored, and taken from the initial belief of that time where not.

    Args:
        filter: the filter.
        tensordict: actions, which are read one step earlier, and what else the transition reads.
        truth: ``[*B, T, S]``; that of the first time stands for the one before it, too.
        belief: prefix of the belief.
        spread: standard deviation of members around the truth, or of the Gaussian, ``[S]`` or one number.
        members: E.

    Returns:
        What it writes, by the names of the belief: ``(belief, "ensemble")`` and so on.
    """
    structure, size = filter.structure, tensordict.batch_size
    place, transition = structure.transition
    time, call = len(size) - 1, Call(size, time=True)
    entries = filter.entries_of(tensordict)
    must, may = reads(transition)
    if not {*must, *may}.isdisjoint(structure.frame_keys):
        with torch.no_grad():  # these parts are not the ones that are trained
            entries.update(run_modules(structure.frames, entries, call))
    carried = _belief_at(truth, belief, structure.carry, spread, members)
    others = [key for key in structure.carry if key not in carried and key not in entries]
    if others:
        with torch.no_grad():
            start = run_module(filter.initial, _without(entries, structure.belief), call.part("initial"))
        entries.update({key: start[key] for key in others})
    entries.update(carried)
    for key in structure.carry:
        entries[key] = one_earlier(entries[key], time)
    for key in structure.controls:
        stored = entries.get(previous_key(key))
        if stored is not None:
            entries[key] = stored
        elif key in entries:
            entries[key] = one_earlier(entries[key], time)
    written = run_module(transition, entries, call.part(place))
    return {key: written[forecast] for key, forecast in structure.forecast_of.items()}


def members_of(filter: Filter, members: int | None) -> int:
    """E: what was asked for, or what the initial belief has.

    Raises:
        ValueError: if neither says.
    """
    members = getattr(filter.initial, "ensemble_size", None) if members is None else members
    if members is None:
        raise ValueError(
            f"{type(filter.initial).__name__} does not say how many members the belief has; pass members=..."
        )
    return members


def _belief_at(truth: Tensor, belief: str, carry, spread: Tensor, members: int | None) -> Entries:
    spread = spread.to(truth.dtype).expand(truth.shape[-1])
    mean = truth.unsqueeze(-2)
    if (belief, "ensemble") not in carry:
        cov = spread.square().diag_embed().expand(*truth.shape, truth.shape[-1])
        values = {(belief, "mean"): truth, (belief, "cov"): cov}
    else:
        if members is None:
            raise ValueError(f"The filter carries {(belief, 'ensemble')!r}: say of how many members, members=...")
        ensemble = mean.expand(*truth.shape[:-1], members, truth.shape[-1])
        if spread.any():
            ensemble = ensemble + spread * torch.randn_like(ensemble)
        values = {
            (belief, "ensemble"): ensemble,
            (belief, "log_weight"): torch.full_like(ensemble[..., 0], -log(members)),
            (belief, "mean"): truth,
            (belief, "var"): spread.square().expand_as(truth),
        }
    return {key: value for key, value in values.items() if key in carry}


def _without(entries: Entries, keys: tuple[NestedKey, ...]) -> Entries:
    return {key: value for key, value in entries.items() if unravel_key(key) not in keys}


def one_earlier(value: Tensor, time: int) -> Tensor:
    """Every element from one step before; the first stays where it is."""
    count = value.shape[time]
    return torch.cat([value.narrow(time, 0, 1), value.narrow(time, 0, count - 1)], time)
