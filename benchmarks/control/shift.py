"""Readings that get noisier after training: the names of these cells, and a filter that is told."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from torch_denkf.filters import Filter

NOT_TRAINED = "not trained"
SHIFTED = f"{{}}, {NOT_TRAINED}"
LEFT = f"{SHIFTED}, R as learned"


@contextmanager
def told(filter: Filter | None, noise: float) -> Iterator[None]:
    """Sets R of a filter, which nothing else is told, to the square of ``noise`` for a while."""
    if filter is None:
        yield
        return
    log_variance = filter["noise"].log_variance
    learned = log_variance.detach().clone()
    with torch.no_grad():
        log_variance.fill_(2 * math.log(noise))
    try:
        yield
    finally:
        with torch.no_grad():
            log_variance.copy_(learned)
