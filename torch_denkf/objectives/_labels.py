"""Labels of losses: the known true values, and their components.

Labels ``[*B, N]`` are of the leading N components, or of the components ``dims``. NaN, masked and padded entries are
no labels: they have no value and no gradient, and are left out of means.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

from torch_denkf._checks import check_mask
from torch_denkf._registered import diagnosis
from torch_denkf.beliefs import is_samples
from torch_denkf.functional.manifolds import Euclidean, Space, is_flat, whole_parts
from torch_denkf.running import writes
from torch_denkf.submodel import Initial, Update, in_role, role

if TYPE_CHECKING:
    from torch_denkf.filters import Filter
    from torch_denkf.objectives.filter_loss import FilterLoss

__all__ = ["Keys", "Labels", "Reading", "Targets", "check_row_mask", "mean_of"]


@dataclass
class Keys:
    """The common input keys of all losses.

    Attributes:
        state: true state ``[*B, N]``, of the leading N components of the state; NaN where it is not known. For
            sequences ``*B`` ends with time, here and below.
        state_observed: mask of its known components, ``[*B, 1]`` or ``[*B, N]``, bool; by default the state's name
            and ``_observed``, as in data sets. It may be missing.
        target_observation: true observation ``[*B, O]``; if it is missing and the filter's observation model has
            no parameters, that model's observation of the true state is used.
        target_observed: mask of the known components of the true observation, ``[*B, 1]`` or ``[*B, O]``, bool.
        observed: mask of the reading, ``[*B, 1]`` or ``[*B, O]``; by default that of the sensor's update.
        sensor: the sensor's samples ``[*B, E, O]`` or readings ``[*B, O]``, or the name of one of several sensors; by
            default the output of the filter's only sensor.
        visible: probability that the reading is of the state, ``[*B, 1]``, from a head of the sensor.
        target_visible: whether it is, ``[*B, 1]``, bool or 0 and 1; NaN if that is not known.
        visible_observed: mask of its known elements, ``[*B, 1]``, bool; by default its name and ``_observed``.
    """

    state: NestedKey = "state"
    state_observed: NestedKey | None = None
    target_observation: NestedKey = "target_observation"
    target_observed: NestedKey | None = None
    observed: NestedKey | None = None
    sensor: NestedKey | None = None
    visible: NestedKey = ("sensor", "visible")
    target_visible: NestedKey = "visible"
    visible_observed: NestedKey | None = None


class Reading(NamedTuple):
    """A reading that a loss scores.

    Attributes:
        samples: its key.
        observed: key of its mask.
        noise: key of its R.
        model: the observation model, with an ``observe()`` method; ``None`` if there is none.
    """

    samples: NestedKey = ("sensor", "ensemble")
    observed: NestedKey = "observed"
    noise: NestedKey = ("sensor", "noise")
    model: Any = None

    @classmethod
    def of(cls, filter: Filter, keys: Keys) -> Reading:
        """Finds the reading of the sensor in ``keys``, or of the only one; without a model for several sensors."""
        found: dict[NestedKey, Update] = {}
        default, observed = cls(), keys.observed
        for _, module in filter.structure.update:
            for part in in_role(module, Update):
                found.update((key, part) for key in map(unravel_key, part.reading_keys[:1]) if key not in found)
        names = [key for key in filter.structure.frame_keys if is_samples(key)] or [default.samples]
        if keys.sensor is not None:
            name = unravel_key(keys.sensor)
            names = [key for key in found if key[:-1] == ("sensor", name)] or [name]
        read = [key for key in names if key in found]
        parts = [found[key] for key in read] or list(found.values())
        if len(parts) > 1:
            return default if observed is None else cls(names[0], observed)
        part, owners = parts[0] if parts else role(None, Update), [module for _, module in filter.structure.update]
        if len(found) > 1:
            owners = [part, *(module for module in owners if unravel_key(part.predicted_key) in writes(module))]
        model = next((part for module in owners for part in module.modules() if hasattr(part, "observe")), None)
        noise = unravel_key((*part.reading_keys[1:], default.noise)[0])
        return cls((read or names)[0], observed or part.observed_key or default.observed, noise, model)


class Labels(NamedTuple):
    """True values that are known and scored.

    Attributes:
        values: ``[*B, N]``; zero without a label. On a space points ``[*B, P]``, neutral without a label.
        mask: ``[*B, N]``, True where there is a label. On a space N is the dimension of tangents.
        dims: scored components among the N.
        scale: ``[N]``, finite, by which errors are divided; ``None`` for one.
        space: space of the values; ``None`` for plain numbers.
    """

    values: Tensor
    mask: Tensor
    dims: Sequence[int]
    scale: Tensor | None = None
    space: Space | None = None

    @property
    def rows(self) -> Tensor:
        """Marks the elements that have a label, ``[*B]``."""
        return self.mask.any(-1)

    def errors(self, estimate: Tensor, weights: Tensor | None = None, *, each: bool = False) -> Tensor:
        """Returns scaled errors of an estimate ``[*B, N]``, or of members ``[*B, E, N]``; zero without a label.

        On a space they are tangents. Tangents of members and of the truth are taken at the members' mean, and
        subtracted: if members and truth have the same distribution, so have their tangents, and the score is proper.
        At the truth the axes would rotate with it, and the best score would have a wrong spread. The mean is a constant
        to the gradient, because it only defines the axes.

        Args:
            estimate: on a space points ``[*B, P]``, or ``[*B, E, P]``.
            weights: weights of members, ``[*B, E]``, for their mean; ``None`` for equal weights.
            each: whether errors of members are taken in the tangent space at the truth.
        """
        values, mask, space = self.values, self.mask, self.space
        members = estimate.ndim > values.ndim
        if members:
            values, mask = values.unsqueeze(-2), mask.unsqueeze(-2)
        if space is None:
            errors = estimate - values
        elif each or not members or space.flat is not None:
            errors = space.minus(estimate, values)
        else:
            center = space.mean(estimate.detach(), None if weights is None else weights.detach()).unsqueeze(-2)
            errors = space.minus(estimate, center) - space.minus(values, center)
        return torch.where(mask, errors if self.scale is None else errors / self.scale, 0)

    def mean(self, scores: Tensor) -> Tensor:
        """Returns the mean of scores ``[*B, N]`` over the components that have a label, ``[*B]``."""
        return mean_of(scores, self.mask)

    def in_all_components(self, name: str, value: Tensor) -> Tensor:
        """Expands a value to each of the N components, with 1 for components without one.

        Args:
            name: name of the value, for the message.
            value: one number, or one for each of ``dims``; if these are the leading ones, also one for each of N.

        Raises:
            ValueError: if the number of values is different.
        """
        size = self.mask.shape[-1]
        if value.numel() == 1 or (value.numel() == size and isinstance(self.dims, range)):
            return value.expand(size)
        if value.numel() != len(self.dims):
            raise ValueError(
                f"{name} has {value.numel()} entries, but {len(self.dims)} dimensions are scored; pass one for each"
            )
        out = value.new_ones(size)
        out[list(self.dims)] = value
        return out

    def scaled(self, name: str, scale: Tensor | None) -> Labels:
        """Sets a scale, see :meth:`in_all_components`; components with an infinite scale are no labels."""
        if scale is None:
            return self
        scale = self.in_all_components(name, scale)
        mask = self.mask & scale.isfinite()
        scale = torch.where(scale.isfinite(), scale, 1)
        values = torch.where(mask, self.values, 0) if is_flat(self.space) else self.values
        return self._replace(values=values, mask=mask, scale=scale)


class Targets:
    """Labels of a batch for the terms, together with the filter's outputs.

    Args:
        loss: the loss, with its keys, dimensions, scales and spaces.
        data: the batch.
        out: the batch with the outputs of the filter, or of its part.
    """

    def __init__(self, loss: FilterLoss, data: TensorDictBase, out: TensorDictBase):
        self.loss, self.keys, self.data, self.out = loss, loss.tensor_keys, data, out

    def entry(self, key: NestedKey, cure: str = "", *, given: bool = False) -> Tensor:
        """Returns an output of the filter, or an entry of the batch with ``given``.

        Raises:
            KeyError: if it is missing; the message ends with the ``cure``.
        """
        source = self.data if given else self.out
        value = source.get(key, None)
        if value is None:
            cure = f"{cure}Rename it with loss.set_keys(...)."
            raise diagnosis().missing_entry(type(self.loss).__name__, [key], source.keys(True, True), cure)
        return value

    @cached_property
    def counts(self) -> Tensor:
        """Marks the elements that are results of a step, ``[*B]``."""
        return self.loss._counts(self.data)

    def state(self, size: int) -> Labels:
        """Returns the labels of the true state, for an estimate of ``size`` components."""
        labels = self._labels("state", self.entry(self.keys.state, given=True), size, self.loss.dims)
        return labels.scaled("state_scale", self.loss.state_scale)

    def observation(self, target: Tensor, size: int) -> Labels:
        """Returns the labels of true observations ``target``, for readings of ``size`` components."""
        return self._labels("target", target, size).scaled("observation_scale", self.loss.observation_scale)

    def visible(self) -> Labels:
        """Returns the labels of visibility, ``[*B, 1]``, for elements with a reading."""
        values, mask = self.entry(self.keys.target_visible, given=True), self.out.get(self.loss.reading.observed, None)
        values = values if values.is_floating_point() else values.to(torch.get_default_dtype())
        labels = self._labels("visible", values, 1)
        return labels if mask is None else labels._replace(mask=labels.mask & mask.any(-1, keepdim=True))

    def whole_state(self) -> Labels:
        """Returns the true state for models that read all of it; ``mask`` ``[*B, 1]`` marks elements with all of it.

        Raises:
            ValueError: if the labels lack dimensions.
        """
        values = self.entry(self.keys.state, given=True)
        given = values.shape[-1]
        size = self.state_size() or given
        labels = self._labels("state", values, size)
        if given < size:
            raise ValueError(
                f"{type(self.loss).__name__} needs the whole true state of {size} dimensions, but "
                f"{self.keys.state!r} has {given}. Add the others, with NaN in the rows that have no label"
            )
        return labels._replace(mask=labels.mask.all(-1, keepdim=True))

    def observed_state(self, observe: Callable[[Tensor], Tensor]) -> Tensor:
        """Applies an observation model to the true state; NaN in the result is no label."""
        # On a space, dims are components of tangents, and points are complete.
        values, dims = self.entry(self.keys.state, given=True), self.loss.dims if is_flat(self.loss.space) else None
        size = max(self.state_size() or 0, values.shape[-1], 1 + max(dims or [0]))
        return observe(self._known("state", values, size, dims))

    def state_size(self) -> int | None:
        """Returns S of the belief, or P of a space; ``None`` if neither is known."""
        filter = self.loss.filter
        if self.loss.space is not None:
            return self.loss.space.point_dim
        values = (self.out.get(kind.carry[0], None) for kind in filter.structure.kinds if kind.carried)
        sizes = (value.shape[-1] for value in values if value is not None)
        return next(sizes, role(filter.initial, Initial).state_dim)

    def _labels(self, name: str, values: Tensor, size: int, dims: Sequence[int] | None = None) -> Labels:
        space = {"state": self.loss.space, "target": self.loss.reading_space}.get(name)
        if space is not None and size != space.point_dim:
            raise ValueError(f"a point of {space} has {space.point_dim} components, but the estimate has {size}")
        on: Space = space or Euclidean(size)
        flat = is_flat(space)
        known = self._known(name, values, size, dims if flat else None)
        whole, mask = whole_parts(on, ~known.isnan())
        if dims is None:
            given = torch.arange(size) < values.shape[-1]
            dims = range(int(whole_parts(on, given)[1].sum()))
        counting = torch.zeros(on.tangent_dim, dtype=torch.bool, device=known.device)
        counting[list(dims)] = True
        points = torch.where(whole, known, on.neutral(known))
        return Labels(points if flat else on.normalise(points), mask & counting, dims, space=space)

    def _known(self, name: str, values: Tensor, size: int, dims: Sequence[int] | None) -> Tensor:
        """Returns labels ``[*B, N]`` at the indices of their components, ``[*B, size]``, NaN without a label.

        They are of the leading N components; or of ``dims``, in their order, if ``dims`` has N components of which the
        last is not among the first N.

        Raises:
            ValueError: if values or mask have another shape, or ``dims`` has components that do not exist.
        """
        keys = self.keys
        key = {"state": keys.state, "target": keys.target_observation, "visible": keys.target_visible}[name]
        batch, given = list(self.data.batch_size), values.shape[-1] if values.ndim else 0
        if list(values.shape) != [*batch, given] or not given:
            raise ValueError(
                f"{key!r} must be [*B, N] = {[*batch, 'N']}, N labels in each element of the batch; got "
                f"{list(values.shape)}. Reshape it, e.g. by unsqueeze(-1)"
            )
        last = given - 1 if dims is None else max(dims)
        if last >= size:
            what = f"{key!r} is {list(values.shape)}" if dims is None else f"dims={list(dims)} has component {last}"
            raise ValueError(
                f"{what}, but the estimate has {size} components. Labels are of the leading ones, at most "
                f"{size}, or of dims=..., counted from 0"
            )
        if dims is not None and last >= given != len(dims):
            raise ValueError(
                f"dims={list(dims)} has component {last}, but {key!r} has {given}, which are used as the leading "
                f"ones, from 0; pass these, or one for each of dims"
            )
        known = torch.ones_like(values[..., :1], dtype=torch.bool)
        observed_key = getattr(self.keys, f"{name}_observed") or mask_of(key)
        observed = self.data.get(observed_key, None)
        if observed is not None:
            check_row_mask(observed_key, observed, values)
            known = known & observed
        for mask_key in self.loss._loss_mask_keys():
            padding = self.data.get(mask_key, None)
            if padding is not None:
                known = known & padding.reshape(*batch, 1)
        values = torch.where(known, values, torch.nan)
        places = range(min(given, size)) if dims is None or last < given else dims
        placed = values.new_full((*batch, size), torch.nan)
        placed[..., list(places)] = values[..., : len(places)]
        return placed


def check_row_mask(key: NestedKey, mask: Tensor, values: Tensor) -> None:
    """Raises unless a mask is ``[*B, 1]`` or ``[*B, N]``, bool, for values ``[*B, N]``."""
    check_mask(repr(key), mask)
    batch, count = list(values.shape[:-1]), values.shape[-1]
    if list(mask.shape) not in ([*batch, 1], [*batch, count]):
        raise ValueError(
            f"{key!r} must be [*B, 1] = {[*batch, 1]} or [*B, N] = {[*batch, count]}; got {list(mask.shape)}"
        )


def mask_of(key: NestedKey) -> NestedKey:
    """Returns the key of the mask that data sets store with an entry.

    Example:
        >>> mask_of("state"), mask_of(("truth", "x"))
        ('state_observed', ('truth', 'x_observed'))
    """
    key = unravel_key(key)
    return f"{key}_observed" if isinstance(key, str) else (*key[:-1], f"{key[-1]}_observed")


def mean_of(values: Tensor, mask: Tensor) -> Tensor:
    """Returns the masked mean over the last dimension, ``[*]``; zero if all is masked.

    Example:
        >>> mean_of(torch.tensor([1.0, 5.0]), torch.tensor([False, True]))
        tensor(5.)
    """
    return torch.where(mask, values, 0).sum(-1) / mask.sum(-1).clamp(min=1)
