"""The training objective of a transition alone: one step from true states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from torch_denkf._checks import check_count
from torch_denkf.filters import Filter
from torch_denkf.filters._one_sequence import refuse_unmarked_slices
from torch_denkf.modules._running import reads
from torch_denkf.objectives._base import FilterLoss
from torch_denkf.objectives._options import Scale
from torch_denkf.objectives._part import PartLoss
from torch_denkf.objectives._scores import GAUSSIAN_SCORES, MEMBER_SCORES, score_gaussian, score_members
from torch_denkf.objectives._true_steps import forecasts_from_truth, has_members, members_of

__all__ = ["TransitionLoss"]


class TransitionLoss(PartLoss):
    r"""Scores the forecast of one step from the true state at t-1 against the true state at t, on ``[*B, T]``.

    Nothing is filtered: all steps are made at once, each from the truth. The members of an ensemble filter are all at
    the truth, or around it by ``spread``; the transition's own noise makes them differ. A filter with a mean and a
    covariance starts from N(truth, spread²). The one term is ``loss_transition``. The first element of a sequence, and
    those where an episode begins, do not count. The parameters of the loss are those of the transition.

    Args:
        filter: the filter whose transition is trained.
        score: ``"crps"``, ``"energy"`` or ``"mse"`` of members, as in :class:`~torch_denkf.objectives.DEnKFLoss`;
            ``"crps"``, ``"nll"`` or ``"mse"`` of a Gaussian, as in :class:`~torch_denkf.objectives.GaussianLoss`. A
            transition without noise has no spread but ``spread``: teach it by ``"mse"``.
        spread: standard deviation around the truth, in the state's units: a number or ``[S]``. Members are drawn anew
            in each call.
        members: E; by default as many as the initial belief has. One is a point, for ``"mse"`` alone.
        state_scale: ``[S]``; errors of the state are divided by it, so that dimensions with different units count
            alike. A dimension with infinite scale does not count: means are taken over the others.
        angles: state dimensions that are angles in radians; their errors are wrapped to [-pi, pi).
        belief: prefix of the carried ``ensemble``, or of ``mean`` and ``cov``.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` (``[*B, T]``, zero where an element does not count).

    Raises:
        ValueError: on an unknown score, a scale that is not positive, a negative spread, too few members, a filter that
            carries neither members nor moments, a batch without time, or slices that are not marked.
        KeyError: if an entry is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> loss = TransitionLoss(KalmanFilter(one, one, one, one, mean=torch.zeros(1), cov=one), score="mse")
        >>> loss(TensorDict({"state": torch.tensor([[0.0], [1.0], [3.0]])}, [3]))["loss_transition"]  # (1 + 4) / 2
        tensor(2.5000)
    """

    @dataclass
    class _AcceptedKeys(FilterLoss._AcceptedKeys):
        """The entries that the loss reads.

        Attributes:
            state: true state ``[*B, T, S]``.
        """

    default_keys = _AcceptedKeys

    def __init__(
        self,
        filter: Filter,
        *,
        score: Literal["crps", "energy", "nll", "mse"] = "crps",
        spread: float | Sequence[float] | Tensor = 0.0,
        members: int | None = None,
        state_scale: Scale = None,
        angles: Sequence[int] = (),
        belief: str = "belief",
        reduction: Literal["mean", "sum", "none"] = "mean",
    ):
        self.SCORES = MEMBER_SCORES if has_members(filter, belief) else GAUSSIAN_SCORES
        if members is not None:
            check_count(
                "members", members, least=1 if score == "mse" else 2, cure='One member has no spread: score it by "mse"'
            )
        super().__init__(
            filter, {"transition": 1.0}, score=score, state_scale=state_scale, angles=angles, reduction=reduction
        )
        self.belief, self.members = belief, members_of(filter, members) if has_members(filter, belief) else None
        self.register_scale("spread", spread)
        if not ((self.spread >= 0) & self.spread.isfinite()).all():
            raise ValueError(f"spread is a standard deviation, finite and not negative; got {spread}.")

    def _trained(self):
        return [self.filter.transition_module]

    def _needed(self) -> list[NestedKey]:
        """What the transition reads beside the belief, and the true state."""
        structure = self.filter.structure
        needed = [*structure.needed, *structure.controls]
        read = reads(self.filter.transition_module)[0]
        if not set(read).isdisjoint(structure.frame_keys):
            read = needed
        return [*(key for key in needed if key in read), self.tensor_keys.state]

    def _run(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not tensordict.ndim:
            raise ValueError("A step needs two times, the last batch dimension; this tensordict has batch_size [].")
        refuse_unmarked_slices(tensordict, self.filter.init_key)
        truth = self._finite_where_unused(tensordict)
        written = forecasts_from_truth(
            self.filter, tensordict, truth, self.belief, spread=self.spread, members=self.members
        )
        return TensorDict(written, tensordict.batch_size)

    def _counts(self, tensordict: TensorDictBase) -> Tensor:
        # Without a stored belief, which would let the first element of a slice count: its truth before is unknown.
        return self.filter.stepped(tensordict.exclude("previous"))

    def _transition(self, tensordict, out):
        target = self._finite_where_unused(tensordict)
        if self.members is not None:
            ensemble = out[self.belief, "ensemble"]
            return score_members(self._state_error(ensemble, target.unsqueeze(-2)), self.score), None
        error = self._state_error(out[self.belief, "mean"], target)
        cov = self._counting("state", out[self.belief, "cov"], -1, -2)
        return score_gaussian(error, cov, self.score, self._scale("state")), None

    def _finite_where_unused(self, tensordict: TensorDictBase) -> Tensor:
        """The true state; padding may hold anything, and is a start of forecasts here."""
        state, used = self._true_state(tensordict), None
        for key in self._loss_mask_keys():
            mask = tensordict.get(key, None)
            if mask is not None:
                mask = mask.reshape(*tensordict.batch_size, 1)
                used = mask if used is None else used & mask
        return state if used is None else torch.where(used, state, state.nan_to_num(0.0, 0.0, 0.0))
