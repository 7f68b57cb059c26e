"""The noise of all modules of a filter, drawn in bulk. One trial step tells which module draws what."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from torch_denkf.submodel import Entries, SubModel, flat_noise

__all__ = ["Drawn", "draw_noise"]

#: The sub-models that draw noise, by place, and the sizes that they asked for.
Drawn = dict[str, tuple[SubModel, dict[str, Any]]]


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
    """The noise that is not among what is given, of ``batch_size`` elements; of some modules, or of all."""
    out: Entries = {}
    where = {} if like is None else {"device": like.device, "dtype": like.dtype}
    chosen = None if places is None else tuple(places)
    for place, (part, sizes) in drawn.items():
        if chosen is None or place.split(".")[0] in chosen:
            keys = [("noise", place, name) if name else ("noise", place) for name in part.noise_names]
            if not all(key in given for key in keys):
                noise = part.draw_noise(batch_size, time=time, generator=generator, **where, **sizes)
                out.update(flat_noise(noise, place))
    return out
