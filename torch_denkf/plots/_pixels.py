"""Where the pictures of a roll-out are."""

from __future__ import annotations

import numpy as np
from tensordict import NestedKey, TensorDictBase
from torch import Tensor


def find_pixels(
    belief: TensorDictBase | Tensor, pixels: Tensor | np.ndarray | NestedKey | None, steps: int
) -> Tensor | np.ndarray | None:
    """Pictures ``[T, ...]``: those that are passed, those of a key, or ``"pixels"`` where the roll-out has it.

    Raises:
        KeyError: if the roll-out lacks the key.
        ValueError: if there is not a picture a step.
    """
    if not isinstance(pixels, (Tensor, np.ndarray)):
        if isinstance(belief, Tensor):
            if pixels is not None:
                raise KeyError(f"{pixels!r} is a key, but the belief is a tensor; pass a tensor")
            return None
        found = belief.get("pixels" if pixels is None else pixels, None)
        if found is None and pixels is not None:
            raise KeyError(f"no {pixels!r} among {list(belief.keys(True, True))}")
        pixels = found
    if pixels is not None and len(pixels) != steps:
        raise ValueError(f"pixels must have a picture a step, {steps}; got {len(pixels)}")
    return pixels
