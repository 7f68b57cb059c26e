"""Demonstrations of the UR5 table as one of torchrl's data sets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Literal

import torch
from tensordict import TensorDict
from torchrl.data import SliceSampler
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.writers import Writer
from torchrl.envs.transforms import Transform

from torch_denkf._progress import progress_bar
from torch_denkf.data.replay import EpisodeReplay, choose_sampler
from torch_denkf.data.ur5.cache import read_demos, read_entries
from torch_denkf.data.ur5.files import MANIFEST
from torch_denkf.data.ur5.rows import SampledPixels, UR5Episode, episode_rows, split_of

__all__ = ["UR5ExperienceReplay"]


class UR5ExperienceReplay(EpisodeReplay):
    """Demos that ``python -m torch_denkf.envs.ur5.collect`` collected, as a replay buffer of their steps.

    Demos lie one behind the other, so that torchrl's slice samplers cut sub-sequences out of them. A sample, batch size
    ``[n]``, has

    ===================== ============ ===========================================================================
    key                   shape        content
    ===================== ============ ===========================================================================
    ``pixels``            [n,3,H,W]    float32 in [0, 1], zero where not observed; not in collections without any
    ``observed``          [n,1]        bool: this step was drawn
    ``state``             [n,10]       float32, the truth, see :class:`torch_denkf.envs.UR5TableEnv`: J1..J6 rad, the
                                       gripper's opening rad, x, y, z m
    ``action``            [n,7]        float32, rad: sent in that state, it leads to the next row's
    ``success``           [n,1]        bool: the task is done in that state
    ``task``              [n,1]        int64: 0 pick, 1 push, 2 put-down
    ``step``              [n,1]        int64, from 0, 0.08 s each
    ``is_init``           [n,1]        bool: the first row of a demo, or of a slice
    ``episode``           [n]          int64, a number in ``episodes``
    ``next``: ``done``,   [n,1]        bool: ``truncated`` and ``done`` in the last row of a demo, or of a slice;
    ``truncated``,                     never ``terminated``. The three at the root are False.
    ``terminated``
    ===================== ============ ===========================================================================

    The next state is the next row's. With ``frames_only`` the rows are those that were drawn, each on its own
    (``is_init`` and ``next``/``done`` True everywhere).

    The first time, all demos are decoded, compared with their checksums and scaled into a memory-mapped cache; pixels
    become float when rows are sampled. 2,000 demos at 112 px take 0.6 GB with 8 frames each, 26 GB with all.

    **Splits** are by demo, never within one: a hash of its number alone puts a fifth of all demos into ``"test"``. So a
    demo stays on its side however many there are, at every size and in both domains.

    Args:
        root: folder of the demos.
        split: ``"train"``, ``"test"`` or ``"all"``.
        size: (H, W) to scale pictures to, by averages over areas; as they are stored by default.
        frames_only: True for the rows with a picture alone, to train a sensor on.
        batch_size: rows of a sample.
        num_slices: slices of a sample, each of ``batch_size / num_slices`` rows in a sequence; reshape the sample to
            ``[num_slices, -1]``. Exclusive with ``slice_len`` and ``sampler``.
        slice_len: rows of a slice, instead.
        strict_length: False lets demos that are shorter than a slice come as short slices.
        sampler: by default slices if they are asked for, else single rows at random.
        writer: by default one that refuses to write.
        collate_fn: as in torchrl's buffers, like ``pin_memory`` and ``prefetch``.
        pin_memory: whether samples are pinned.
        prefetch: samples to prepare in advance, by threads.
        transform: applied to each sample after the pixels are made.
        cache: folder of the cache; True for ``$TORCH_DENKF_CACHE`` or else ``~/.cache/torch_denkf``; None or False for
            none: all pictures are then in memory. Entries may be deleted at any time.
        progress: whether a bar shows the demos that are decoded.

    Attributes:
        episodes: what each ``"episode"`` is: demo, task, first row and length.

    Raises:
        FileNotFoundError: without the folder, its manifest or a demo's file.
        ValueError: for options out of range, a split without demos, files that were cut or changed, that are no demos
            or differ in size, slices of ``frames_only``, and demos that are shorter than a slice.
        OSError: if the cache cannot be written.

    Examples:
        >>> from torch_denkf.envs.ur5.collect import collect_ur5_demos
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> made = collect_ur5_demos(folder, 2, frames=None, max_steps=60)
        >>> data = UR5ExperienceReplay(folder, split="all", batch_size=20, num_slices=4, cache=None)
        >>> len(data), data.episodes[1].task
        (120, 'push')
        >>> data.sample().reshape(4, -1)["state"].shape
        torch.Size([4, 5, 10])
    """

    episodes: tuple[UR5Episode, ...]

    def __init__(
        self,
        root: str | Path,
        *,
        split: Literal["train", "test", "all"] = "train",
        size: tuple[int, int] | None = None,
        frames_only: bool = False,
        batch_size: int | None = None,
        num_slices: int | None = None,
        slice_len: int | None = None,
        strict_length: bool = True,
        sampler: Sampler | None = None,
        writer: Writer | None = None,
        collate_fn: Callable | None = None,
        pin_memory: bool = False,
        prefetch: int | None = None,
        transform: Transform | Callable | None = None,
        cache: str | Path | bool | None = True,
        progress: bool = True,
    ):
        if split not in ("train", "test", "all"):
            raise ValueError(f"split is 'train', 'test' or 'all', got {split!r}")
        sampler = choose_sampler(sampler, num_slices, slice_len, strict_length)
        if frames_only and isinstance(sampler, SliceSampler):
            raise ValueError("slices are cut out of whole sequences, frames_only leaves single rows: pass one of them")
        self.root = Path(root).expanduser().resolve()
        entries = read_entries(self.root)
        chosen = [split in ("all", split_of(entry.demo)) for entry in entries]
        if not any(chosen):
            raise ValueError(f"none of the {len(entries)} demos in {self.root} is in the split {split!r}; collect more")
        with progress_bar("reading demos", len(entries), unit=" demos", shown=progress) as bar:
            self._demos = read_demos(self.root, entries, size, cache, bar.update)
        self._in_training = torch.tensor([split_of(entry.demo) == "train" for entry in entries])
        self._row_counts = torch.tensor([entry.rows for entry in entries])
        self._frame_counts = torch.tensor([entry.frames for entry in entries])
        if frames_only and "frames" not in self._demos:
            raise ValueError(f"the demos in {self.root} have no pictures; collect them without --no-pixels")
        rows, episodes = episode_rows(self._demos["rows"], entries, chosen, frames_only)
        super().__init__(
            rows,
            episodes,
            SampledPixels(self._demos.get(("frames", "pixels"), None)),
            sampler=sampler,
            batch_size=batch_size,
            writer=writer,
            transform=transform,
            collate_fn=collate_fn,
            pin_memory=pin_memory,
            prefetch=prefetch,
        )

    def _say_short(self, short: Sequence[UR5Episode]) -> str:
        return f"demos {[e.demo for e in short][:8]} have {min(e.length for e in short)};"

    @cached_property
    def statistics(self) -> TensorDict:
        """Means and standard deviations over the **training** demos, whichever split and rows this data set has.

        ========================== ============ ======================================================================
        key                        shape        of
        ========================== ============ ======================================================================
        ``("state", "mean")``      [10]         all rows of the training demos
        ``("state", "std")``       [10]
        ``("pixels", "mean")``     [3,1,1]      each channel of their pictures, if there are any
        ``("pixels", "std")``      [3,1,1]
        ========================== ============ ======================================================================

        Standard deviations divide by the number of values.

        Raises:
            ValueError: if none of the demos is in the training split.
        """
        training = self._in_training
        if not training.any():
            raise ValueError(f"none of the demos in {self.root} is in the training split; collect more")
        state = self._demos["rows", "state"][training.repeat_interleave(self._row_counts)].double()
        statistics = {"state": {"mean": state.mean(0), "std": state.std(0, correction=0)}}
        shots = training.repeat_interleave(self._frame_counts)
        if shots.any():
            frames = self._demos["frames"]
            count = shots.sum() * frames["pixels"][0, 0].numel()
            mean, square = (frames[key][shots].sum(0).double() / count for key in ("sum", "square"))
            std = (square - mean.square()).clamp_min(0).sqrt()
            statistics["pixels"] = {"mean": mean[:, None, None] / 255, "std": std[:, None, None] / 255}
        return TensorDict(statistics).float()

    def _is_downloaded(self) -> bool:
        return (self.root / MANIFEST).is_file()

    @property
    def _not_ours(self) -> str:
        return f"the demos in {self.root} were not written by this data set; delete them by hand"
