"""The base class of all losses, and of their terms: it runs a filter once over a batch, and returns weighted terms."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Literal, TypedDict, Unpack

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor, nn
from torchrl.objectives import LossModule

from torch_denkf._arguments import Checked, check_key
from torch_denkf._checks import check_choice, check_number
from torch_denkf.filters import Filter
from torch_denkf.filters.finish import Record
from torch_denkf.functional.manifolds import Space, check_space
from torch_denkf.modules.tensors import as_floating, check_dims
from torch_denkf.objectives._labels import Keys, Reading, Targets

__all__ = ["FilterLoss", "ReadingsOptions", "Scale", "SequenceKeys", "SequenceOptions", "StateOptions", "Term"]


#: A scale of each dimension; infinite for a dimension that is not scored.
Scale = Sequence[float] | Tensor | None


class ReadingsOptions(TypedDict, total=False):
    """Options of every loss that scores readings.

    Labels, true states and true observations, may have gaps: NaN, and elements that a mask of labels marks as missing.
    The mask is named like the labels with ``_observed`` appended (``"state_observed"``; ``[*B, 1]``, or one value for
    each dimension). A gap has no value and no gradient: a score is over the dimensions that have a label, and means
    are over the elements that have one. For a batch without labels the loss is zero.

    Attributes:
        observation_scale: ``[O]``; errors of observations are divided by it, so that dimensions with different units
            have equal weight. A dimension with infinite scale is not scored: means are over the others. A term that
            is a likelihood stays a density in the observation's own units.
        reading_space: space of observations, made of numbers and angles, such as ``Euclidean(1) * Circle()``; errors
            of angles are wrapped to [-pi, pi). ``None`` for plain numbers.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``: the shape of the batch, zero for elements that are
            not scored.
    """

    observation_scale: Scale
    reading_space: Space | None
    reduction: Literal["mean", "sum", "none"]


class StateOptions(TypedDict, total=False):
    """Options of every loss that scores the state.

    The true state may have fewer dimensions than the belief: its labels are of the leading ones, or of ``dims``.

    Attributes:
        dims: scored state dimensions; all that have labels by default. N labels are of the leading N dimensions; or of
            ``dims``, in their order, if ``dims`` has N dimensions of which one is beyond the leading N.
        state_scale: one for each of ``dims``, else of the labels' dimensions; errors of the state are divided by it. A
            dimension with infinite scale is not scored.
        space: the space of the states, such as ``Product(SO3(), Euclidean(3))``, or
            ``Flat(5, circular=[2])`` for numbers of which one is an angle, whose errors are wrapped to [-pi, pi). By
            default it is that of the filter's initial belief. Errors are then tangents ``[D]``, to whose components
            ``dims`` and ``state_scale`` refer; the belief's covariance is of tangents at its mean. A part of the
            space has a label if all of its components have one. Scores of members compare tangents at the members'
            mean, which makes them proper; a Gaussian's density is that of the tangent from its mean to the truth, in
            the units of tangents.
    """

    dims: Sequence[int] | None
    state_scale: Scale
    space: Space | None


class SequenceOptions(ReadingsOptions, StateOptions, total=False):
    """Options of losses of a whole filter, in addition to :class:`ReadingsOptions` and :class:`StateOptions`.

    Attributes:
        detach_every: truncated back-propagation: steps after which the belief is detached.
    """

    detach_every: int | None


class Term(nn.Module):
    """A term of a loss, ``loss_<name>``; a subclass implements :meth:`forward`.

    A term may have parameters and buffers of its own: they are the loss's, too.

    Args:
        weight: its weight; zero for a term that is neither computed nor returned. ``None`` is 1 if :meth:`exists`
            finds anything to score, else 0.

    Attributes:
        name: its name, after ``loss_``.
        of_frames: whether all elements that have its labels are scored, and not only those that are results of a
            step.
        needs_state: whether it needs the true state.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import KalmanFilter
        >>> class Absolute(Term):
        ...     name = "absolute"
        ...     def forward(self, out, truth):
        ...         mean = out["belief", "mean"]
        ...         labels = truth.state(mean.shape[-1])
        ...         return labels.mean(labels.errors(mean).abs()), labels.rows
        >>> one = torch.eye(1)
        >>> plain = KalmanFilter(one, one, process_noise=[1.0], noise=[1.0], mean=torch.zeros(1), cov=one)
        >>> loss = FilterLoss(plain, [Absolute()])
        >>> loss(TensorDict({"observation": torch.zeros(8, 1), "state": torch.ones(8, 1)}, [8]))["loss_absolute"]
        tensor(1.)
    """

    name: str
    of_frames = False
    needs_state = True

    def __init__(self, weight: float | None = 1.0):
        super().__init__()
        if weight is not None:
            check_number(self.name, weight, least=0, cure="It is a term's weight")
        self.weight = weight

    def forward(self, out: TensorDictBase, truth: Targets) -> tuple[Tensor, Tensor | None]:
        """Returns the term's value in each element.

        Args:
            out: the batch ``[*B]`` with the outputs of the filter.
            truth: the labels: ``truth.state(S)`` and ``truth.observation(target, O)`` return known true values, and
                errors with the loss's scales and spaces.

        Returns:
            Its values ``[*B]``, or one number; and a mask of the scored elements, ``[*B]`` bool (``None``: all).
        """
        raise NotImplementedError

    def exists(self, loss: FilterLoss) -> bool:
        """Tells whether the term has anything to score, for a weight of ``None``."""
        return True


@dataclass
class SequenceKeys(Keys):
    """The input keys of losses of whole filters, in addition to those of all losses.

    Attributes:
        belief: prefix of the belief's entries: ``mean`` and ``cov``, or ``ensemble`` and ``log_weight``.
        forecast: prefix of the forecast's entries, with the same names.
        log_likelihood: key of the log-likelihood of the innovation, or of the reading.
    """

    belief: NestedKey = "belief"
    forecast: NestedKey = "forecast"
    log_likelihood: NestedKey = ("info", "log_likelihood")


class FilterLoss(Checked, LossModule):
    """Runs a filter once over sequences ``[*B, T]``, and returns weighted terms: ``loss_<name>`` for each.

    The other losses add their own terms to this one. Terms with weight zero are neither computed nor returned; the
    others are returned with their weight applied, so that their sum is the objective. Only elements that are results
    of a step are scored; the first of a sequence and those with ``is_init`` have an initial belief. A mask of padding
    in the data, such as ``("collector", "mask")``, leaves elements out of every term. Slices in a flat ``[N]``, as
    torchrl's ``SliceSampler`` returns them, must be marked.

    Args:
        filter: the filter; its parameters are the loss's.
        terms: the terms, see :class:`Term`.
        score: one of the class's ``SCORES``, if it has any.
        **options: ``dims``, scales, ``space``, ``reading_space``, ``detach_every`` and ``reduction``, see
            :class:`SequenceOptions`.

    Raises:
        TypeError: if an argument is no filter, no term or no space.
        ValueError: on an unknown score, two terms of one name, a scale that is not positive, infinite in all
            dimensions, or of another length than the scored dimensions, a space of another size, a
            ``reading_space`` of another kind, labels of another shape, or slices that are not marked.

    Example:
        >>> from torch_denkf.filters import KalmanFilter
        >>> class Square(Term):
        ...     name = "square"
        ...     def forward(self, out, truth):
        ...         labels = truth.state(1)
        ...         return labels.mean(labels.errors(out["belief", "mean"]).square()), labels.rows
        >>> one = torch.eye(1)
        >>> plain = KalmanFilter(one, one, process_noise=[1.0], noise=[1.0], mean=torch.zeros(1), cov=one)
        >>> loss = FilterLoss(plain, [Square(0.5)])
        >>> loss(TensorDict({"observation": torch.zeros(8, 1), "state": torch.ones(8, 1)}, [8]))["loss_square"]
        tensor(0.5000)
    """

    _AcceptedKeys: type[Keys] = SequenceKeys
    default_keys: type[Keys] = SequenceKeys
    SCORES: Sequence[str] = ()
    #: The filter keeps its parameters.
    functional = False

    def __init__(
        self, filter: Filter, terms: Sequence[Term], *, score: str = "crps", **options: Unpack[SequenceOptions]
    ):
        if self.SCORES:
            check_choice("score", score, self.SCORES)
        if not isinstance(filter, Filter):
            raise TypeError(f"filter must be a torch_denkf Filter; got {filter!r}"[:200])
        dims, reduction = options.get("dims"), options.get("reduction", "mean")
        check_choice("reduction", reduction, ("mean", "sum", "none"))
        if dims is not None:
            check_dims("dims", dims, once=True)
            if not len(dims):
                raise ValueError("dims must have at least one dimension of the state; got none. Pass None for all.")
        space = check_space("space", filter.structure.space if options.get("space") is None else options["space"])
        if space is not None and dims is not None and max(dims) >= space.tangent_dim:
            raise ValueError(
                f"dims={list(dims)} has component {max(dims)}, but tangents have {space.tangent_dim}, from 0."
            )
        super().__init__()
        self.space, self.reading_space = space, check_space("reading_space", options.get("reading_space"), flat=True)
        self.dims = None if dims is None else [int(dim) for dim in dims]
        self.filter, self.score, self.reduction = filter, score, reduction
        self.detach_every = options.get("detach_every")
        self.register_buffer("state_scale", _checked_scale("state_scale", options.get("state_scale")))
        self.register_buffer("observation_scale", _checked_scale("observation_scale", options.get("observation_scale")))
        if self.state_scale is not None:
            self._check_entries("state_scale", self.state_scale)
        self.terms = nn.ModuleList(_checked_terms(terms))
        self._choose_terms()

    def register_buffer(self, name: str, tensor: Tensor | None, persistent: bool = True) -> None:
        """Registers a constant on the filter's device."""
        like = self.filter.like()
        super().register_buffer(name, tensor if tensor is None or like is None else tensor.to(like.device), persistent)

    def _check_entries(self, name: str, value: Tensor) -> None:
        """Raises a ``ValueError`` unless a value has one entry for each of ``dims``, if these are given."""
        if self.dims is not None and value.numel() != len(self.dims):
            raise ValueError(f"{name} has one entry for each of dims={self.dims}; got {value.numel()}.")

    @property
    def in_keys(self) -> list[NestedKey]:
        """Lists the required keys."""
        return self._needed()

    @in_keys.setter
    def in_keys(self, value) -> None:
        raise AttributeError("in_keys are determined by the filter; rename the state with set_keys(state=...).")

    def set_keys(self, **kwargs: NestedKey | None) -> None:
        """Sets the keys of input entries, see the class's ``_AcceptedKeys``; ``None`` for the default.

        Raises:
            TypeError: if a key is neither a string nor a tuple of strings.
            ValueError: if the loss has no such entry.
        """
        known = [field.name for field in fields(self._AcceptedKeys)]
        for name, key in kwargs.items():
            if name not in known:
                raise ValueError(f"{type(self).__name__} reads no {name!r}; set_keys takes {', '.join(known)}")
            if key is not None:
                check_key(name, key)
        super().set_keys(**kwargs)
        self._choose_terms()

    def _choose_terms(self) -> None:
        self.reading = Reading.of(self.filter, self.tensor_keys)
        given = {term.name: float(term.exists(self)) if term.weight is None else term.weight for term in self.terms}
        self.weights = {name: weight for name, weight in given.items() if weight}
        self.out_keys = [f"loss_{name}" for name in self.weights]

    def named_parameters(self, prefix: str = "", recurse: bool = True) -> Iterator[tuple[str, nn.Parameter]]:
        """Returns the trained parameters, with their names in the loss."""
        found, parts = super().named_parameters(prefix, recurse), self._trained()
        if parts is None:
            return found
        own = {id(parameter) for part in parts for parameter in part.parameters()}
        return ((name, value) for name, value in found if id(value) in own)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns the weighted terms; ``tensordict`` is not changed."""
        out = self._run(tensordict)
        truth, losses = Targets(self, tensordict, out), TensorDict({}, batch_size=[])
        for term in self.terms:
            if term.name not in self.weights:
                continue
            value, mask = term(out, truth)
            if mask is None or not term.of_frames:
                mask = truth.counts if mask is None else mask & truth.counts
            if value.ndim and self.reduction == "none":
                value = self._reduce_loss(torch.where(mask, value, 0), tensordict)
            elif value.ndim:
                value = self._reduce_loss(value, tensordict, mask=mask)
            losses[f"loss_{term.name}"] = self.weights[term.name] * value
        return losses

    # --------------------------------------------------------------------------- overridden by losses of a part

    def _run(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns the batch with the outputs of the filter, or of its part."""
        self.filter.observe(Record("data", tensordict, tensordict.batch_size, {}, {}))
        return self.filter.inside(self._filters().sequence(tensordict.copy(), detach_every=self.detach_every))

    def _filters(self):
        """Returns the filter that runs over the sequences."""
        return self.filter

    def _counts(self, tensordict: TensorDictBase) -> Tensor:
        """Marks the elements that are results of a step, ``[*B]``."""
        return self.filter.stepped(tensordict)

    def _needed(self) -> list[NestedKey]:
        """Lists the inputs of the filter in addition to its belief, and the true state."""
        structure = self.filter.structure
        needed = [*structure.needed, *structure.controls]
        supervised = any(term.needs_state for term in self.terms if term.name in self.weights)
        needed += [self.tensor_keys.target_visible] if "visible" in self.weights else []
        return [*needed, self.tensor_keys.state] if supervised else needed

    def _trained(self) -> Iterable[nn.Module] | None:
        """Returns the trained modules; ``None`` for all.

        The whole filter is registered, so that it moves with the loss to another device, and its names stay in the
        state dict.
        """
        return None


def _checked_scale(name: str, scale: Scale) -> Tensor | None:
    if scale is None:
        return None
    scale = as_floating(scale, name)
    if scale.ndim > 1:
        raise ValueError(f"{name} is one number per dimension; got {list(scale.shape)}.")
    if not ((scale > 0).all() and scale.isfinite().any()):
        raise ValueError(f"{name} must be positive; infinite leaves a dimension out, but not all. Got {scale}.")
    return scale


def _checked_terms(terms: Sequence[Term]) -> list[Term]:
    names = set()
    for term in terms:
        if not isinstance(term, Term):
            raise TypeError(f"terms must be instances of sub-classes of torch_denkf's Term; got {term!r}"[:200])
        if term.name in names:
            raise ValueError(f"Two terms are called {term.name!r}; give one of them another name.")
        names.add(term.name)
    return list(terms)
