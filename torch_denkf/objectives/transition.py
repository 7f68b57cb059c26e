"""The training objective of a transition alone: one step from true states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from torch_denkf._arguments import check_key
from torch_denkf._checks import check_count
from torch_denkf.filters import Filter
from torch_denkf.filters._one_sequence import refuse_unmarked_slices
from torch_denkf.modules._running import reads
from torch_denkf.objectives._base import FilterLoss
from torch_denkf.objectives._options import Scale
from torch_denkf.objectives._part import PartLoss
from torch_denkf.objectives._scores import GAUSSIAN_SCORES, MEMBER_SCORES, score_gaussian, score_members
from torch_denkf.objectives._true_steps import forecasts_from_truth, has_members, members_of, one_earlier

__all__ = ["TransitionLoss"]


class TransitionLoss(PartLoss):
    r"""Scores the forecast of one step from the true state at t-1 against the true state at t, on ``[*B, T]``.

    Nothing is filtered: all steps are made at once, each from the truth. The members of an ensemble filter are all at
    the truth, or around it by ``spread``; the transition's own noise makes them differ. A filter with a mean and a
    covariance starts from N(truth, spread²). The one term is ``loss_transition``. The first element of a sequence, and
    those where an episode begins, do not count. Nor do those with gaps in their labels: a step starts where all of the
    state is known, and is scored against what is known one step later, see :class:`SequenceOptions`. The parameters of
    the loss are those of the transition.

    Args:
        filter: the filter whose transition is trained.
        score: ``"crps"``, ``"energy"`` or ``"mse"`` of members, as in :class:`~torch_denkf.objectives.DEnKFLoss`;
            ``"crps"``, ``"nll"`` or ``"mse"`` of a Gaussian, as in :class:`~torch_denkf.objectives.GaussianLoss`. A
            transition without noise has no spread but ``spread``: teach it by ``"mse"``.
        spread: standard deviation around the truth, in the state's units: a number or ``[S]``. Members are drawn anew
            in each call.
        members: E; by default as many as the initial belief has. One is a point, for ``"mse"`` alone.
        dims: state dimensions that count; all by default.
        state_scale: one for each of ``dims``; errors of the state are divided by it, so that dimensions with different
            units count alike. A dimension with infinite scale does not count: means are taken over the others.
        angles: state dimensions that are angles in radians; their errors are wrapped to [-pi, pi).
        belief: prefix of the carried ``ensemble``, or of ``mean`` and ``cov``.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` (``[*B, T]``, zero where an element does not count).

    Raises:
        ValueError: on an unknown score, a scale that is not positive, a negative spread, too few members, a filter that
            carries neither members nor moments, labels of a part of the state, a batch without time, or slices that
            are not marked.
        KeyError: if an entry is missing.

    Example:
        >>> import torch
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
            state_observed: where it is known, ``[*B, T, 1]`` or ``[*B, T, S]``.
        """

    default_keys = _AcceptedKeys

    def __init__(
        self,
        filter: Filter,
        *,
        score: Literal["crps", "energy", "nll", "mse"] = "crps",
        spread: float | Sequence[float] | Tensor = 0.0,
        members: int | None = None,
        dims: Sequence[int] | None = None,
        state_scale: Scale = None,
        angles: Sequence[int] = (),
        belief: str = "belief",
        reduction: Literal["mean", "sum", "none"] = "mean",
    ):
        check_key("belief", belief)
        self.SCORES = MEMBER_SCORES if has_members(filter, belief) else GAUSSIAN_SCORES
        if members is not None:
            check_count(
                "members", members, least=1 if score == "mse" else 2, cure='One member has no spread: score it by "mse"'
            )
        super().__init__(
            filter,
            {"transition": 1.0},
            score=score,
            dims=dims,
            state_scale=state_scale,
            angles=angles,
            reduction=reduction,
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
        truth = self._whole_state(tensordict, tensordict).values
        # Whatever else reads the true state finds no NaN either.
        known = tensordict.copy().set(self.tensor_keys.state, truth)
        written = forecasts_from_truth(self.filter, known, truth, self.belief, spread=self.spread, members=self.members)
        return TensorDict(written, tensordict.batch_size)

    def _counts(self, tensordict: TensorDictBase) -> Tensor:
        # Without a stored belief, which would let the first element of a slice count: its truth before is unknown.
        stepped = self.filter.stepped(tensordict.exclude("previous"))
        return stepped & one_earlier(self._whole_state(tensordict, tensordict).rows, tensordict.ndim - 1)

    def _transition(self, tensordict, out):
        estimate = out[self.belief, "mean" if self.members is None else "ensemble"]
        labels = self._state_labels(tensordict, estimate.shape[-1])
        errors = labels.errors(estimate, self.angles)
        if self.members is not None:
            return score_members(errors, labels.mask, self.score), labels.rows
        return score_gaussian(errors, labels.mask, out[self.belief, "cov"], self.score, labels.scale), labels.rows
