"""Draws the noise of all modules of a filter in bulk; one trial step finds the modules and sizes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from torchrl.modules import set_recurrent_mode

from torch_denkf.running import random_parts, reads, run_module
from torch_denkf.submodel import EXPLAINED, RECORDERS, Call, Entries, Initial, SubModel, flat_noise, role

if TYPE_CHECKING:
    from torch_denkf.filters.base import Filter

__all__ = ["Drawn", "Draws", "recorded_draws"]

#: The sub-models that draw noise, by place, and the requested sizes.
Drawn = dict[str, tuple[SubModel, dict[str, Any]]]


@contextmanager
def recorded_draws(filter: nn.Module, parts: Sequence[tuple[str, SubModel]]) -> Iterator[Drawn]:
    """Records the sizes that sub-models request when they draw noise, without side effects.

    Forward hooks are not called meanwhile. Networks are in evaluation mode: a batch normalisation of one row raises,
    and several rows would change its running statistics.

    Args:
        filter: the filter of the sub-models.
        parts: sub-models that draw noise, with their places.
    """
    drawn: Drawn = {}
    places = dict(parts)

    def record(place: str, part: SubModel, sizes: dict[str, Any]) -> None:
        # A sub-model that overrides forward() draws without its place in the filter.
        own = [place] if place in places else [name for name, other in parts if other is part]
        drawn.update(dict.fromkeys(own, (part, sizes)))

    before = [(part, part._forward_hooks, part._forward_pre_hooks, part.training) for part in filter.modules()]
    RECORDERS.append(record)
    try:
        for part, *_ in before:
            part._forward_hooks, part._forward_pre_hooks = OrderedDict(), OrderedDict()
            part.training = part.training and isinstance(part, SubModel)  # a sub-model's noise may depend on it
        yield drawn
    finally:
        RECORDERS.remove(record)
        for part, hooks, pre_hooks, training in before:
            part._forward_hooks, part._forward_pre_hooks, part.training = hooks, pre_hooks, training


class Draws:
    """Draws the noise of a filter's modules.

    Args:
        filter: the filter of the modules.

    Attributes:
        places: places of the modules that draw noise.
    """

    def __init__(self, filter: Filter):
        placed = (*filter.structure.modules, ("initial", filter.initial))
        self.filter, self._random = filter, [found for place, part in placed for found in random_parts(part, place)]
        self.places = {place for place, _ in self._random}
        self._drawn: dict[tuple, Drawn] = {}
        self._sizes: Drawn = {}

    def missing(
        self,
        entries: Entries,
        size: torch.Size,
        *,
        places: Iterable[str] | None = None,
        time: bool = False,
        generator: torch.Generator | None = None,
    ) -> Entries:
        """Draws the noise that is not among the entries, with the sizes of one trial step.

        Args:
            entries: inputs of the modules, possibly with some noise.
            size: ``[*B]``, or ``[*B, T]``.
            places: places of the modules in the filter; by default those of a step.
            time: whether the last of ``size`` is time.
            generator: source of randomness; torch's global one by default.
        """
        if not self._random:
            return {}
        shapes = {
            key: value.shape[len(size) :] for key, value in entries.items() if key[0] not in ("noise", "previous")
        }
        # Modules may draw at some times only, such as under `deterministic`.
        kind = (*sorted(shapes.items(), key=str), *(part.noise_names for _, part in self._random))
        if kind not in self._drawn:
            self._drawn[kind] = self._trial(entries, size)
        out: Entries = {}
        chosen, like = set(dict(self.filter.structure.modules) if places is None else places), self.filter.like()
        where: dict[str, Any] = {} if like is None else {"device": like.device, "dtype": like.dtype}
        for place, (part, sizes) in self._drawn[kind].items():
            keys = [("noise", place, name) if name else ("noise", place) for name in part.noise_names]
            if place.split(".")[0] in chosen and not all(key in entries for key in keys):
                noise = part.draw_noise(size, time=time, generator=generator, **where, **sizes)
                out.update(flat_noise(noise, place))
        return out

    def nothing(self, batch_size: Sequence[int]) -> Entries:
        """Returns zeros for the inputs of the initial belief, for runs that need only shapes."""
        told, like = role(self.filter.initial, Initial), self.filter.like()
        like = torch.zeros(()) if like is None else like
        zeros = like.new_zeros(*batch_size, told.input_dim or told.state_dim or 1)
        return {key: zeros.clone() for key in reads(self.filter.initial)[0]}

    @torch.no_grad()
    def _trial(self, entries: Entries, size: torch.Size) -> Drawn:
        """Finds the modules that draw noise, and the sizes, by one step of the first element."""
        row = {key: value for key, value in entries.items() if key[0] != "noise"}
        if size.numel():
            row = {key: value.flatten(0, len(size) - 1)[:1] if size else value for key, value in row.items()}
        else:
            row = {key: value.new_zeros(1, *value.shape[len(size) :]) for key, value in row.items()}
        call = Call(torch.Size([1] if size else []))
        devices = [*dict.fromkeys(value.device for value in row.values() if value.is_cuda)]
        with (
            torch.random.fork_rng(devices=devices),
            set_recurrent_mode(False),
            recorded_draws(self.filter, self._random) as drawn,
        ):
            start = run_module(self.filter.initial, {**self.nothing(call.batch_size), **row}, call.part("initial"))
            # If an entry is missing, the modules that read it keep their sizes; the step itself raises.
            with suppress(KeyError, *EXPLAINED):
                self.filter.steps.step({**start, **row}, call, partial=True)
        self._sizes |= drawn
        return {place: self._sizes[place] for place, _ in self._random if place in self._sizes}
