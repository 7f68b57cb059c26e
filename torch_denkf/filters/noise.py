"""Draws the noise of all modules of a filter in bulk; one trial step tells which module draws what."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from torch_denkf.submodel import RECORDERS, Entries, SubModel, flat_noise

__all__ = ["Drawn", "draw_noise", "recorded_draws"]

#: The sub-models that draw noise, by place, and the sizes that they asked for.
Drawn = dict[str, tuple[SubModel, dict[str, Any]]]


@contextmanager
def recorded_draws(filter: nn.Module, parts: Sequence[tuple[str, SubModel]]) -> Iterator[Drawn]:
    """Records the sizes that sub-models ask for when they draw noise, without a trace of that.

    Forward hooks are not called meanwhile. Networks are in evaluation mode: a batch normalisation of one row raises,
    and one of several would count them.

    Args:
        filter: whose modules they are.
        parts: sub-models that draw noise, and their places.
    """
    drawn: Drawn = {}
    places = dict(parts)

    def record(place: str, part: SubModel, sizes: dict[str, Any]) -> None:
        own = [place] if place in places else [name for name, other in parts if other is part]  # in its own forward
        drawn.update(dict.fromkeys(own, (part, sizes)))

    before = [(part, part._forward_hooks, part._forward_pre_hooks, part.training) for part in filter.modules()]
    RECORDERS.append(record)
    try:
        for part, *_ in before:
            part._forward_hooks, part._forward_pre_hooks = OrderedDict(), OrderedDict()
            part.training = part.training and isinstance(part, SubModel)  # whose noise may depend on it
        yield drawn
    finally:
        RECORDERS.remove(record)
        for part, hooks, pre_hooks, training in before:
            part._forward_hooks, part._forward_pre_hooks, part.training = hooks, pre_hooks, training


def draw_noise(
    drawn: Drawn,
    given: Mapping,
    batch_size: torch.Size,
    *,
    places: Iterable[str] | None = None,
    like: Tensor | None = None,
    time: bool = False,
    generator: torch.Generator | None = None,
) -> Entries:
    """Draws the noise that is not among what is given, of ``batch_size`` elements; of some modules, or of all.

    Args:
        drawn: which module draws what.
        given: entries, some of which may be noise.
        batch_size: ``[*B]``, or ``[*B, T]``.
        places: of the modules in the filter.
        like: has the precision and device of the noise.
        time: whether the last of ``batch_size`` is time.
        generator: source of randomness; torch's global one by default.
    """
    out: Entries = {}
    where: dict[str, Any] = {} if like is None else {"device": like.device, "dtype": like.dtype}
    chosen = None if places is None else tuple(places)
    for place, (part, sizes) in drawn.items():
        if chosen is None or place.split(".")[0] in chosen:
            keys = [("noise", place, name) if name else ("noise", place) for name in part.noise_names]
            if not all(key in given for key in keys):
                noise = part.draw_noise(batch_size, time=time, generator=generator, **where, **sizes)
                out.update(flat_noise(noise, place))
    return out
