"""Parallel-in-time filtering and smoothing by an associative scan, with log2 T levels instead of T steps.

The Rauch-Tung-Striebel step to t is affine in the smoothed moments m and P of t + 1: the mean is E m + g, the
covariance E P Eᵀ + L. Two such steps compose to one, so pairs of steps are joined, then pairs of pairs. All work is in
batched products. A step of a Kalman filter is such an element, too: the Gaussian of the state given the previous state
and the reading, and the likelihood of the previous state.

Source: Särkkä & García-Fernández 2021, IEEE T-AC 66.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torch_denkf.compilation.compiled import filled
from torch_denkf.filters.scan import Steps
from torch_denkf.filters.structure import FROM_STORED
from torch_denkf.functional.gaussian import hide, kalman_update, solve_for_gain
from torch_denkf.functional.linalg import as_covariance
from torch_denkf.functional.smoothing.rts import smoothing_gain
from torch_denkf.modules.kalman import KalmanAnalysis, LinearTransition
from torch_denkf.modules.variance_ceiling import VarianceCeiling
from torch_denkf.smoothers.past_moments import CrossTransition
from torch_denkf.submodel import Call, Entries

if TYPE_CHECKING:
    from torch_denkf.filters.base import Filter

__all__ = ["InTime", "prefixes", "rts_in_time"]

_Elements = tuple[Tensor, ...]


def prefixes(join: Callable[[_Elements, _Elements], _Elements], elements: _Elements) -> _Elements:
    """Returns e_0, e_0 e_1, e_0 e_1 e_2, ... of an associative product.

    Args:
        join: product of elements ``[N, ...]``: earlier ones, later ones.
        elements: ``[T, ...]``, in one tensor or several.

    Example:
        >>> prefixes(lambda one, other: (one[0] + other[0],), (torch.arange(5),))[0].tolist()
        [0, 1, 3, 6, 10]
    """
    count = len(elements[0])
    if count == 1:
        return elements
    odd = prefixes(join, join(tuple(e[: count - 1 : 2] for e in elements), tuple(e[1::2] for e in elements)))
    found = [torch.empty_like(e) for e in elements]
    for whole, first, second in zip(found, elements, odd, strict=True):
        whole[0], whole[1::2] = first[0], second
    if count > 2:
        later = tuple(e[2::2] for e in elements)
        for whole, value in zip(found, join(tuple(e[: len(later[0])] for e in odd), later), strict=True):
            whole[2::2] = value
    return tuple(found)


def rts_in_time(
    mean: Tensor,
    cov: Tensor,
    forecast_mean: Tensor,
    forecast_cov: Tensor,
    cross: Tensor,
    open_cov: Tensor | None = None,
    *,
    follows: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Smooths like :func:`~torch_denkf.functional.smoothing.rts.rts_smooth`, for vectors and a fixed interval.

    It needs three times the arithmetic of sequential steps, and one call for each level instead of one for each step.

    Args:
        mean: means of the filter's beliefs, ``[*B, T, S]``.
        cov: their covariances, ``[*B, T, S, S]``.
        forecast_mean: forecast of each time, ``[*B, T, S]``.
        forecast_cov: its covariance, ``[*B, T, S, S]``.
        cross: cross-covariance of the previous state and the state at each time, ``[*B, T, S, S]``.
        open_cov: see :func:`~torch_denkf.functional.smoothing.rts.rts_smooth`, ``[*B, T, S, S]``.
        follows: mask of elements that are one step after their predecessor, ``[*B, T]``; ``None`` for all.

    Returns:
        The smoothed means ``[*B, T, S]`` and covariances ``[*B, T, S, S]``.
    """
    batch, count = mean.shape[:-2], mean.shape[-2]
    gain, last = smoothing_gain(cross[..., 1:, :, :], forecast_cov[..., 1:, :, :]), torch.zeros_like(cov[..., :1, :, :])
    own = cov[..., :-1, :, :]
    rest = own - gain @ cross[..., 1:, :, :].mT if open_cov is None else open_cov[..., 1:, :, :]
    shift = mean[..., :-1, :] - (gain @ forecast_mean[..., 1:, :].unsqueeze(-1)).squeeze(-1)
    ends = torch.ones(*batch, count, dtype=torch.bool, device=mean.device)
    ends[..., :-1] = False if follows is None else ~follows[..., 1:]
    shift = torch.where(ends[..., :-1].unsqueeze(-1), mean[..., :-1, :], shift)
    rest = torch.where(ends[..., :-1, None, None], own, rest)
    steps = (
        torch.cat([gain, last], -3),
        torch.cat([shift, mean[..., -1:, :]], -2).unsqueeze(-1),
        torch.cat([rest, cov[..., -1:, :, :]], -3),
        ends[..., None, None],
    )
    _, moved, left, _ = prefixes(_one_after_the_other, tuple(_backwards(value, len(batch)) for value in steps))
    left = (left + left.mT) / 2
    return moved.squeeze(-1).flip(0).movedim(0, -2), left.flip(0).movedim(0, -3)


def _backwards(value: Tensor, time: int) -> Tensor:
    return value.movedim(time, 0).flip(0)


def _one_after_the_other(later: Sequence[Tensor], earlier: Sequence[Tensor]) -> _Elements:
    """Combines steps backward in time; nothing, not even NaN, passes the end of an episode."""
    (gain, shift, rest, ends), (own_gain, own_shift, own_rest, own_ends) = later, earlier
    moved, left = own_gain @ shift + own_shift, own_gain @ rest @ own_gain.mT + own_rest
    return (
        torch.where(own_ends, own_gain, own_gain @ gain),
        torch.where(own_ends, own_shift, moved),
        torch.where(own_ends, own_rest, left),
        own_ends | ends,
    )


class InTime:
    """Strategy for long logs of a :class:`~torch_denkf.filters.KalmanFilter`: filters all times in parallel.

    Steps are sequential if back-propagation is truncated, in a policy's data, or if a variance reaches the filter's
    ceiling.

    Args:
        options: ``mode="in time"``.
    """

    chunk = None

    def __init__(self, options: dict[str, Any]):
        if len(options) > 1:
            raise ValueError(f'mode="in time" compiles nothing and takes no options; got {sorted(options)}.')
        self.options = dict(options)

    def of(self, filter: Filter, steps: Steps | None = None) -> StepsInTime:
        """Returns the filter's steps.

        Raises:
            TypeError: if its transition, observation model or noise covariances are not constant matrices.
        """
        steps = filter.steps if steps is None else steps
        transition, updates = steps.structure.transition[1], [module for _, module in steps.structure.update]
        # No subclass and no other wrapper, which may change more than the matrices.
        motion = transition.module if type(transition) is CrossTransition else transition
        (update,) = updates if len(updates) == 1 else (None,)
        linear = type(motion) is LinearTransition and isinstance(motion.noise, Tensor)
        linear = linear and type(update) is KalmanAnalysis and update.noise is not None
        if not linear or update.reading_space is not None or update.inflation != 1:
            raise TypeError(
                f'mode="in time" is for a KalmanFilter of plain numbers and constant matrices; {type(filter).__name__} '
                f"moves by {type(transition).__name__} and updates by {[type(each).__name__ for each in updates]}. "
                "filter.compile(chunk=0) goes back to one step after the other."
            )
        return StepsInTime(steps, motion, update)


class StepsInTime(NamedTuple):
    """Parallel-in-time sequences of one filter, and its unchanged single steps.

    Attributes:
        steps: steps of the filter.
        motion: transition with F, B and Q.
        update: analysis with H and R.
    """

    steps: Steps
    motion: LinearTransition
    update: KalmanAnalysis

    def step(self, entries: Entries, call: Call) -> Entries:
        """Takes one step."""
        return self.steps.step(entries, call)

    def scan(self, carry, inputs, call: Call, resets, starts, cuts, keep) -> tuple[Entries, Entries]:
        """Returns the result of :meth:`Steps.scan`: the beliefs of all times, then each step from its predecessor."""
        structure, time, count = self.steps.structure, len(call.batch_size), len(cuts)
        given = carry, inputs, call, resets, starts, cuts, keep
        if any(cuts) or FROM_STORED in inputs:
            return self.steps.scan(*given)
        row = {key: value.select(time, 0) for key, value in inputs.items()}
        self.steps.step({**row, **carry}, call, frames=False)  # the modules raise for invalid readings
        begin = None
        if resets is not None:
            resets = filled(resets, time, count, False)
            starts = {key: filled(value, time, count) for key, value in starts.items()}
            begin = [starts[key] for key in self.motion.in_keys[:2]]
        elements = [value.movedim(time, 0) for value in self._elements(inputs, time, resets, begin)]
        first = [carry[key].unsqueeze(0) for key in self.motion.in_keys[:2]]
        zero, nothing = torch.zeros_like(first[1]), torch.zeros_like(first[0]).unsqueeze(-1)
        whole = [zero, first[0].unsqueeze(-1), first[1], nothing, zero, torch.ones_like(zero[..., :1, :1]).bool()]
        joined = tuple(torch.cat([one, other]) for one, other in zip(whole, elements, strict=True))
        _, means, covs, *_ = prefixes(_one_step_more, joined)
        ceiling = structure.posterior[-1][1]
        most = ceiling.ceiling if isinstance(ceiling, VarianceCeiling) else torch.inf
        if bool((covs.diagonal(dim1=-2, dim2=-1) > most).any()):
            return self.steps.scan(*given)
        before = means[:-1].squeeze(-1).movedim(0, time), ((covs + covs.mT) / 2)[:-1].movedim(0, time)
        entries = {**inputs, **dict(zip(self.motion.in_keys[:2], before, strict=True))}
        own = call._replace(batch_size=torch.Size((*call.batch_size, count)))
        out = self.steps.step(entries, own, frames=False, reset=resets, start=starts)
        last = {key: out[key].select(time, -1) for key in structure.carry}
        return last, {key: out[key] for key in keep}

    def _elements(self, inputs: Entries, time: int, resets: Tensor | None, begin: Sequence[Tensor] | None):
        """Returns A, b, C, eta, J and the mask of resets, ``[*B, T, ...]``."""
        move, q, matrix, r = self.motion.matrix, self.motion.noise, self.update.matrix, self.update.noise
        reading = inputs[self.update.in_keys[2]]
        if reading.ndim > time + 2:
            reading = reading.mean(-2)
        size, observed = reading.shape, inputs.get(self.update.observed_key)
        r = as_covariance(r.expand(*size[:-1], *r.shape), reading)
        h = matrix.expand(*size, matrix.shape[-1])
        drift = torch.zeros_like(q[0]).expand(*size[:-1], -1)
        if self.motion.control is not None:
            drift = inputs[self.motion.action_key].to(q.dtype) @ self.motion.control.mT
        plain = reading
        if observed is not None:
            mask, r_seen, _ = hide(observed, r, size)
            plain, h_seen = torch.where(mask, reading, 0), torch.where(mask.unsqueeze(-1), h, 0)
        else:
            r_seen, h_seen = r, h
        away = plain.unsqueeze(-1) - h_seen @ drift.unsqueeze(-1)
        spread = h_seen @ q @ h_seen.mT + r_seen
        gain = solve_for_gain(spread, h_seen @ q, plain)[0]
        told = solve_for_gain(spread, h_seen @ move, plain)[0]  # for the previous state
        keep = torch.eye(len(q), dtype=q.dtype, device=q.device) - gain @ h_seen
        values = [keep @ move, drift.unsqueeze(-1) + gain @ away, keep @ q, told @ away, told @ h_seen @ move]
        ends = torch.zeros(*size[:-1], 1, 1, dtype=torch.bool, device=reading.device)
        if resets is not None and begin is not None:
            ends = resets.unsqueeze(-1)
            mean, cov = begin
            if self.steps.update_at_reset:
                mean, cov, *_ = kalman_update(mean, cov, reading, h, r, observed=observed)
            fixed = [torch.zeros_like(cov), mean.unsqueeze(-1), cov, 0 * drift.unsqueeze(-1), torch.zeros_like(cov)]
            values = [torch.where(ends, one, other) for one, other in zip(fixed, values, strict=True)]
        return [*values, ends]


def _one_step_more(before: Sequence[Tensor], behind: Sequence[Tensor]) -> _Elements:
    """Combines steps of a Kalman filter; nothing, not even NaN, passes a reset."""
    (move, mean, cov, told, known, ends), (own_move, own_mean, own_cov, own_told, own_known, own_ends) = before, behind
    inverse = torch.linalg.inv(torch.eye(move.shape[-1], dtype=move.dtype, device=move.device) + cov @ own_known)
    on, back = own_move @ inverse, move.mT @ inverse.mT
    joined = (
        on @ move,
        on @ (mean + cov @ own_told) + own_mean,
        on @ cov @ own_move.mT + own_cov,
        back @ (own_told - own_known @ mean) + told,
        back @ own_known @ move + known,
    )
    apart = (own_move, own_mean, own_cov, told, known)
    return (*(torch.where(own_ends, one, other) for one, other in zip(apart, joined, strict=True)), own_ends | ends)
