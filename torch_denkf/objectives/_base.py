"""What all objectives of filters share: weighted terms, scales, angles, masks, and how a term is reduced."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torchrl.objectives import LossModule

from torch_denkf._checks import check_number
from torch_denkf.filters import Filter
from torch_denkf.functional import wrap_angles
from torch_denkf.modules._tensors import as_floating, check_dims
from torch_denkf.objectives._options import Scale


class FilterLoss(LossModule):
    """Runs a filter, or a part of it, and returns weighted terms: ``loss_<name>`` for each weight that is not zero.

    A subclass writes :meth:`_run`, and for each of its terms a method ``_<name>(tensordict, out)``, which returns its
    value ``[*B]`` and which elements count (``None``: those of :meth:`_counts`). A mask of padding in the data, such as
    ``("collector", "mask")``, leaves elements out of every term.

    Args:
        filter: the filter; its parameters are the loss's.
        weights: of the terms, by name; ``None`` for 1 where :meth:`_has` what the term scores, else 0.
        score: one of the class's ``SCORES``.
        state_scale: ``[S]``; errors of the state are divided by it. A dimension with infinite scale does not count:
            means are taken over the others.
        observation_scale: ``[O]``, likewise, for observations.
        angles: state dimensions that are angles in radians; their errors are wrapped to [-pi, pi).
        observation_angles: likewise, dimensions of observations.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` (``[*B]``, zero where an element does not count).

    Raises:
        ValueError: on an unknown score, or a scale that is not positive, infinite in all dimensions, or of another
            length than what is scored.
    """

    @dataclass
    class _AcceptedKeys:
        """The entries that all objectives read.

        Attributes:
            state: true state ``[*B, S]``; of sequences ``*B`` ends with time, here and below.
            target_observation: true observation ``[*B, O]``; where it is missing and the filter's observation model has
                no parameters, it is that model's observation of the true state.
            observed: mask ``[*B, 1]`` or ``[*B, O]``.
            sensor: the sensor's samples ``[*B, E, O]`` or readings ``[*B, O]``.
        """

        state: NestedKey = "state"
        target_observation: NestedKey = "target_observation"
        observed: NestedKey = "observed"
        sensor: NestedKey = ("sensor", "ensemble")

    default_keys = _AcceptedKeys
    SCORES: Sequence[str] = ()

    def __init__(
        self,
        filter: Filter,
        weights: Mapping[str, float | None],
        *,
        score: str,
        state_scale: Scale = None,
        observation_scale: Scale = None,
        angles: Sequence[int] = (),
        observation_angles: Sequence[int] = (),
        reduction: Literal["mean", "sum", "none"] = "mean",
    ):
        if score not in self.SCORES:
            *others, last = (f'"{name}"' for name in self.SCORES)
            raise ValueError(f"score is {', '.join(others)} or {last}; got {score!r}.")
        if not isinstance(filter, Filter):
            raise TypeError(f"filter must be a torch_denkf Filter; got {filter!r}"[:200])
        for name, weight in weights.items():
            if weight is not None:
                check_number(name, weight, least=0, cure="It is a term's weight")
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f'reduction is "mean", "sum" or "none"; got {reduction!r}.')
        check_dims("angles", angles)
        check_dims("observation_angles", observation_angles)
        super().__init__()
        self.filter, self.score, self.reduction = filter, score, reduction
        self.angles, self.observation_angles = list(angles), list(observation_angles)
        self._given_weights = dict(weights)
        for name, scale in (("state_scale", state_scale), ("observation_scale", observation_scale)):
            self.register_scale(name, scale)
            scale = getattr(self, name)
            if scale is not None and scale.ndim > 1:
                raise ValueError(f"{name} is one number a dimension; got {list(scale.shape)}.")
            if scale is not None and not ((scale > 0).all() and scale.isfinite().any()):
                raise ValueError(
                    f"{name} is positive, and infinite where a dimension does not count; one must. Got {scale}."
                )
        self.choose_dimensions()
        self.register_load_state_dict_post_hook(_choose_dimensions)
        self._choose_terms()

    def register_scale(self, name: str, scale: Scale | float) -> None:
        """Keeps a scale as a buffer, or ``None``."""
        self.register_buffer(name, None if scale is None else as_floating(scale, name))

    def choose_dimensions(self) -> None:
        """Finds which dimensions count. Done once: a boolean index in forward would wait for the device."""
        for name in ("state", "observation"):
            scale = getattr(self, f"{name}_scale")
            finite = None if scale is None or scale.isfinite().all() else scale.isfinite().nonzero().flatten()
            self.register_buffer(f"{name}_counting", finite, persistent=False)

    @property
    def functional(self) -> bool:
        """The filter keeps its parameters."""
        return False

    @property
    def in_keys(self) -> list[NestedKey]:
        """What must be there."""
        return self._needed()

    @in_keys.setter
    def in_keys(self, value) -> None:
        raise AttributeError("in_keys follow from the filter; rename the state with set_keys(state=...).")

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        # set_keys calls this after it has renamed.
        self._choose_terms()

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns the weighted terms; ``tensordict`` is left as it is."""
        out, counts = self._run(tensordict), self._counts(tensordict)
        losses = TensorDict({}, batch_size=[])
        for name, weight in self.weights.items():
            term, mask = getattr(self, f"_{name}")(tensordict, out)
            if term.ndim:
                term = self._reduce_term(term, counts if mask is None else mask, tensordict)
            losses[f"loss_{name}"] = weight * term
        return losses

    # ------------------------------------------------------------------------------------- what a subclass writes

    def _run(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The tensordict with what the filter, or its part, writes."""
        raise NotImplementedError

    def _needed(self) -> list[NestedKey]:
        """What must be there."""
        raise NotImplementedError

    def _counts(self, tensordict: TensorDictBase) -> Tensor:
        """Which elements count, ``[*B]``: all."""
        return torch.ones(tensordict.batch_size, dtype=torch.bool, device=tensordict.device)

    def _has(self, term: str) -> bool:
        """Whether there is what a term scores."""
        return True

    # ----------------------------------------------------------------------------------------------------- errors

    def _state_error(self, estimate: Tensor, target: Tensor) -> Tensor:
        """Scaled errors of states ``[*, S]`` in the dimensions that count."""
        return self._scaled("state", wrap_angles(estimate - target, self.angles))

    def _observation_error(self, estimate: Tensor, target: Tensor) -> Tensor:
        """Scaled errors of observations ``[*, O]`` in the dimensions that count."""
        return self._scaled("observation", wrap_angles(estimate - target, self.observation_angles))

    def _scaled(self, name: str, errors: Tensor) -> Tensor:
        scale = getattr(self, f"{name}_scale")
        if scale is None:
            return errors
        if scale.numel() not in (1, errors.shape[-1]):
            raise ValueError(
                f"{name}_scale has {scale.numel()} entries, but {errors.shape[-1]} dimensions of the {name} are "
                "scored; pass one entry for each"
            )
        return self._counting(name, errors) / self._counting(name, scale)

    def _scale(self, name: str) -> Tensor | None:
        """The scale of the dimensions that count."""
        scale = getattr(self, f"{name}_scale")
        return None if scale is None else self._counting(name, scale)

    def _counting(self, name: str, value: Tensor, *dims: int) -> Tensor:
        """The dimensions that count, of ``value`` along ``dims``; the last by default."""
        index = getattr(self, f"{name}_counting")
        for dim in (dims or (-1,)) if index is not None else ():
            value = value.index_select(dim, index)
        return value

    # -------------------------------------------------------------------------------------------------- reduction

    def _choose_terms(self) -> None:
        weights = {name: self._has(name) * 1.0 if w is None else w for name, w in self._given_weights.items()}
        self.weights = {name: weight for name, weight in weights.items() if weight}
        self.out_keys = [f"loss_{name}" for name in self.weights]

    def _reduce_term(self, term: Tensor, mask: Tensor, tensordict: TensorDictBase) -> Tensor:
        if self.reduction == "none":
            return self._reduce_loss(torch.where(mask, term, torch.zeros_like(term)), tensordict)
        return self._reduce_loss(term, tensordict, mask=mask)

    # ---------------------------------------------------------------------------------------------------- entries

    def _true_state(self, tensordict: TensorDictBase) -> Tensor:
        return self._entry(tensordict, self.tensor_keys.state)

    def _entry(self, tensordict: TensorDictBase, key: NestedKey, cure: str = "") -> Tensor:
        value = tensordict.get(key, None)
        if value is None:
            present = ", ".join(sorted(map(str, tensordict.keys(True, True))))
            raise KeyError(
                f"{type(self).__name__} reads {key!r}, which is missing; there are {present}. {cure}Rename it with "
                "loss.set_keys(...)."
            )
        return value


def _choose_dimensions(loss: FilterLoss, _) -> None:
    """A loaded scale may be infinite elsewhere."""
    loss.choose_dimensions()
