"""What all objectives of filters share: weighted terms, labels, scales, angles, and how a term is reduced."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torchrl.objectives import LossModule

from torch_denkf._arguments import Checked, check_key
from torch_denkf._checks import check_number
from torch_denkf.filters import Filter
from torch_denkf.modules._tensors import as_floating, check_dims
from torch_denkf.objectives._labels import Labels, labels_of, mask_of, true_values
from torch_denkf.objectives._options import Scale

#: Which objective is for which belief, for messages.
BELIEFS = (
    "DEnKFLoss scores members that count alike, MixtureLoss particles with weights, GaussianLoss a mean and a "
    "covariance. "
)


class FilterLoss(Checked, LossModule):
    """Runs a filter, or a part of it, and returns weighted terms: ``loss_<name>`` for each weight that is not zero.

    A subclass writes :meth:`_run`, and for each of its terms a method ``_<name>(tensordict, out)``, which returns its
    value ``[*B]`` and which elements have what it scores (``None``: all). Terms in ``OF_FRAMES`` count there, the
    others where :meth:`_counts`, too. A mask of padding in the data, such as ``("collector", "mask")``, leaves elements
    out of every term.

    Args:
        filter: the filter; its parameters are the loss's.
        weights: of the terms, by name; ``None`` for 1 where :meth:`_has` what the term scores, else 0.
        score: one of the class's ``SCORES``.
        dims: state dimensions that count; all that have labels by default.
        state_scale: one for each of ``dims``, else of the labels' dimensions; errors of the state are divided by it. A
            dimension with infinite scale does not count: means are taken over the others.
        observation_scale: ``[O]``, likewise, for observations.
        angles: state dimensions that are angles in radians; their errors are wrapped to [-pi, pi).
        observation_angles: likewise, dimensions of observations.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` (``[*B]``, zero where an element does not count).

    Raises:
        ValueError: on an unknown score, a scale that is not positive, infinite in all dimensions, or of another length
            than what is scored, or labels of another shape.
    """

    @dataclass
    class _AcceptedKeys:
        """The entries that all objectives read.

        Attributes:
            state: true state ``[*B, N]``, of the leading N components of the state; NaN where it is not known. Of
                sequences ``*B`` ends with time, here and below.
            state_observed: which of them are known, ``[*B, 1]`` or ``[*B, N]``, bool; by default the state's name and
                ``_observed``, as data sets write it. It may be missing.
            target_observation: true observation ``[*B, O]``; where it is missing and the filter's observation model has
                no parameters, it is that model's observation of the true state.
            target_observed: likewise, of the true observation.
            observed: mask of the reading, ``[*B, 1]`` or ``[*B, O]``.
            sensor: the sensor's samples ``[*B, E, O]`` or readings ``[*B, O]``.
        """

        state: NestedKey = "state"
        state_observed: NestedKey | None = None
        target_observation: NestedKey = "target_observation"
        target_observed: NestedKey | None = None
        observed: NestedKey = "observed"
        sensor: NestedKey = ("sensor", "ensemble")

    default_keys = _AcceptedKeys
    SCORES: Sequence[str] = ()
    #: Terms of frames alone, whether they were stepped to or not.
    OF_FRAMES: Sequence[str] = ("sensor", "noise", "observation")

    def __init__(
        self,
        filter: Filter,
        weights: Mapping[str, float | None],
        *,
        score: str,
        dims: Sequence[int] | None = None,
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
        if dims is not None:
            check_dims("dims", dims, once=True)
            if not len(dims):
                raise ValueError("dims names the dimensions of the state that count; got none. Pass None for all.")
        super().__init__()
        self.dims = None if dims is None else [int(dim) for dim in dims]
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
        if self.dims is not None and self.state_scale is not None and self.state_scale.numel() != len(self.dims):
            raise ValueError(f"state_scale has one entry for each of dims={self.dims}; got {self.state_scale.numel()}.")
        self._choose_terms()

    def register_scale(self, name: str, scale: Scale | float) -> None:
        """Keeps a scale as a buffer, or ``None``."""
        self.register_buffer(name, None if scale is None else as_floating(scale, name))

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

    def set_keys(self, **kwargs: NestedKey | None) -> None:
        """Names entries otherwise, see the class's ``_AcceptedKeys``; ``None`` for the default.

        Raises:
            TypeError: for what is no key: a string, or a tuple of strings.
            ValueError: for entries that the loss does not read.
        """
        for name, key in kwargs.items():
            if key is not None:
                check_key(name, key)
        super().set_keys(**kwargs)

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
            if mask is None:
                mask = counts
            elif name not in self.OF_FRAMES:
                mask = mask & counts
            if term.ndim:
                term = self._reduce_term(term, mask, tensordict)
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

    # ----------------------------------------------------------------------------------------------------- labels

    def _state_labels(self, tensordict: TensorDictBase, size: int) -> Labels:
        """The true state as far as it counts, against an estimate of ``size`` dimensions."""
        known, given = self._true_state(tensordict, size)
        dims = range(min(given, size)) if self.dims is None else self.dims
        return labels_of(known, dims, "state_scale", self.state_scale)

    def _observation_labels(self, tensordict: TensorDictBase, target: Tensor, size: int) -> Labels:
        """The true observation as far as it counts, against readings of ``size`` dimensions."""
        known = self._known(tensordict, "target_observation", "target_observed", target, size)
        return labels_of(known, range(min(target.shape[-1], size)), "observation_scale", self.observation_scale)

    def _true_state(self, tensordict: TensorDictBase, size: int) -> tuple[Tensor, int]:
        """The true state ``[*B, size]``, NaN where it is not known, and how many dimensions its labels have."""
        values = self._entry(tensordict, self.tensor_keys.state)
        return self._known(tensordict, "state", "state_observed", values, size, self.dims), values.shape[-1]

    def _whole_state(self, tensordict: TensorDictBase, out: TensorDictBase) -> Labels:
        """The true state for what reads all of it; ``mask`` ``[*B, 1]`` says where that is known.

        Raises:
            ValueError: if the labels lack dimensions.
        """
        values = self._entry(tensordict, self.tensor_keys.state)
        given = values.shape[-1]
        size = self._state_dim(out) or given
        known = self._known(tensordict, "state", "state_observed", values, size)
        if given < size:
            raise ValueError(
                f"{type(self).__name__} needs the whole true state of {size} dimensions, but "
                f"{self.tensor_keys.state!r} has {given}. Add the others, with NaN in the rows that have no label"
            )
        labels = labels_of(known, range(size), "", None)
        return labels._replace(mask=labels.mask.all(-1, keepdim=True))

    def _known(
        self,
        tensordict: TensorDictBase,
        name: str,
        observed_name: str,
        values: Tensor,
        size: int,
        dims: Sequence[int] | None = None,
    ) -> Tensor:
        key, observed_key = getattr(self.tensor_keys, name), getattr(self.tensor_keys, observed_name)
        observed_key = mask_of(key) if observed_key is None else observed_key
        padding = (tensordict.get(mask, None) for mask in self._loss_mask_keys())
        return true_values(
            key,
            values,
            size,
            tensordict.batch_size,
            observed=tensordict.get(observed_key, None),
            observed_key=observed_key,
            padding=[mask for mask in padding if mask is not None],
            dims=dims,
        )

    @property
    def _written(self) -> list[NestedKey]:
        """What the filter writes, by the names of its modules: what stands before them is taken off."""
        structure = self.filter.structure
        return [*structure.frame_keys, *structure.step_keys]

    def _state_dim(self, out: TensorDictBase) -> int | None:
        """S, of the belief where there is one; ``None`` where nobody says."""
        for key in self.filter.structure.carry:
            value = out.get(key, None) if key[-1] in ("ensemble", "mean") else None
            if value is not None:
                return value.shape[-1]
        return getattr(self.filter.initial, "state_dim", None)

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

    def _entry(self, tensordict: TensorDictBase, key: NestedKey, cure: str = "") -> Tensor:
        value = tensordict.get(key, None)
        if value is None:
            present = ", ".join(sorted(map(str, tensordict.keys(True, True))))
            raise KeyError(
                f"{type(self).__name__} reads {key!r}, which is missing; there are {present}. {cure}Rename it with "
                "loss.set_keys(...)."
            )
        return value
