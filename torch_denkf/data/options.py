"""Options of all data sets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypedDict

from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.writers import Writer
from torchrl.envs.transforms import Transform

from torch_denkf._checks import check_count
from torch_denkf.data.episodes import Split
from torch_denkf.data.slices import choose_sampler

__all__ = ["ReplayOptions", "check_options"]


class ReplayOptions(TypedDict, total=False):
    """Arguments of every data set's constructor besides its source; see :class:`torch_denkf.data.EpisodeReplay`."""

    split: Split
    validation_share: float
    batch_size: int | None
    num_slices: int | None
    slice_len: int | None
    strict_length: bool
    sampler: Sampler | None
    writer: Writer | None
    collate_fn: Callable | None
    pin_memory: bool
    prefetch: int | None
    transform: Transform | Callable | None
    cache: str | Path | bool | None
    progress: bool


def check_options(options: Mapping[str, Any]) -> None:
    """Checks options before any data are read, which may take long.

    Raises:
        TypeError: for an unknown option.
        ValueError: for an unknown split, a share out of range, and options that contradict each other.
    """
    unknown = sorted(set(options) - set(ReplayOptions.__annotations__))
    if unknown:
        raise TypeError(
            f"data sets have no option {', '.join(unknown)}; there are {list(ReplayOptions.__annotations__)}"
        )
    split, share = options.get("split", "train"), options.get("validation_share", 0.0)
    if split not in ("train", "validation", "test", "all"):
        raise ValueError(f"split is 'train', 'validation', 'test' or 'all', got {split!r}")
    if not isinstance(share, (int, float)) or not 0 <= share < 1:
        raise ValueError(f"validation_share is a share of the training episodes, in [0, 1), got {share!r}")
    for name in ("batch_size", "num_slices", "slice_len"):
        if options.get(name) is not None:
            check_count(name, options[name], cure="It is a number of rows or slices, or None")
    if split == "validation" and not share:
        raise ValueError(
            "split='validation' is empty without a validation_share; pass validation_share=0.1, and the same to the "
            "data set with split='train', which then leaves these episodes out"
        )
    choose_sampler(options)
