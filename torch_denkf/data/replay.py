"""Base class of all data sets: concatenated episodes, sampled as slices, with pixels added when sampled."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Unpack, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, SliceSampler, TensorStorage
from torchrl.data.datasets.common import BaseDatasetExperienceReplay
from torchrl.envs.transforms import Transform

from torch_denkf.data.episodes import ROW, Episode, check_rows, hashed_tests, roles_of, rows_of, select_episodes
from torch_denkf.data.options import ReplayOptions, check_options
from torch_denkf.data.pictures import float_pictures
from torch_denkf.data.slices import check_episode_lengths, choose_sampler, slices_of
from torch_denkf.data.statistics import mean_and_std, picture_statistics

__all__ = ["EpisodeReplay"]

Pictures = Callable[[Tensor], Mapping[str, Tensor]]


class EpisodeReplay(BaseDatasetExperienceReplay):
    """Read-only replay buffer of episodes: base class of all data sets, with their common keys, splits and options.

    ===================== ============ ===========================================================================
    key                   shape        content
    ===================== ============ ===========================================================================
    ``episode``           [n]          int64, a number in ``episodes``
    ``step``              [n,1]        int64, the row within its episode, from 0
    ``time``              [n,1]        float64, s since the start of the episode
    ``state``             [n,S]        float32, the ground truth, if it is known
    readings              [n,...]      such as ``pixels`` [n,C,H,W] float32, ``action`` [n,A], ``flow``, ``road``; the
                                       action of a row leads to the next
    ``observed``          [n,1]        bool: the row has an image; ``pixels`` is zero if it is missing
    ``is_init``           [n,1]        bool: the first row of an episode, or of a slice
    ``next``: ``done``,   [n,1]        bool: ``truncated`` and ``done`` in the last row of an episode, or of a slice;
    ``truncated``,                     never ``terminated``. The three at the root are False.
    ``terminated``
    ===================== ============ ===========================================================================

    The next observation is the next row's. Pixels are converted to float32 when rows are sampled.

    **Samples.** With slices of equal length, ``sample()`` is ``[B, T]``: B slices of T rows, the input of filters and
    losses. Single rows are ``[n]``. With ``strict_length=False``, slices of different lengths are concatenated in a
    flat ``[n]``, and ``is_init`` marks their beginnings. ``data[index]`` has the index's shape.

    A stage of :class:`~torch_denkf.training.FilterTrainer` takes ``sample=lambda generator, length: data.sample()``:
    the trainer seeds the sampler. Leave ``prefetch`` out if a training must resume exactly.

    **Splits** are by episode. A hash of an episode's number or name assigns it to a split, so that later episodes do
    not change the assignment. ``"train"`` has all episodes that are not for tests; a ``validation_share`` moves this
    share of them to ``"validation"``. Pass the same share to both.

    :class:`~torch_denkf.envs.ReplayEnv` replays any data set as an environment.

    Args:
        rows: rows of the whole data set, ``[N]``, with ``step`` and ``time``; the rows of an episode are consecutive.
        episodes: all episodes, in the order of the rows.
        for_tests: predicate that selects the test episodes.
        pictures: maps indices of ``rows``, int64 ``[m]``, to entries that are not stored in them, ``[m, ...]`` each.
        single: bool ``[N]``: selects rows, each of which becomes an episode of one row.
        root: folder of the data set; None without a folder.
        **options: as follows.

            * ``split``: ``"train"``, ``"validation"``, ``"test"`` or ``"all"``.
            * ``validation_share``: of the episodes that are not for tests, in [0, 1); none by default.
            * ``batch_size``: rows of a sample, over all slices.
            * ``num_slices``: slices of a sample, each of ``batch_size / num_slices`` consecutive rows.
            * ``slice_len``: rows of a slice. Together with ``num_slices``, ``batch_size`` is their product.
            * ``strict_length``: False returns episodes that are shorter than a slice as short slices.
            * ``sampler``: by default slices if ``num_slices`` or ``slice_len`` is given, else single rows at random.
            * ``writer``: by default one that raises.
            * ``collate_fn``: as in torchrl's buffers, like ``pin_memory`` and ``prefetch``.
            * ``pin_memory``: whether samples are pinned.
            * ``prefetch``: samples to prepare in advance, by threads.
            * ``transform``: applied to each sample after the pixels are added, in the sample's shape. Begin and end of
              each slice are marked after it.
            * ``cache``: folder of decoded pictures; True for ``$TORCH_DENKF_CACHE`` or else ``~/.cache/torch_denkf``;
              None or False for none: all pictures are then in memory. Entries may be deleted at any time.
            * ``progress``: whether to show a progress bar of the decoding.

    Attributes:
        episodes: :class:`~torch_denkf.data.Episode` of each number in ``"episode"``: name, first row and length.
        sequential: False with ``single``, whose rows are not consecutive.

    Raises:
        TypeError: for an unknown option.
        KeyError: for rows without ``step`` or ``time``.
        ValueError: for options out of range or that contradict each other, episodes that do not fit the rows, a split
            without episodes, and episodes that are shorter than the sampler's slices.

    Examples:
        >>> import torch
        >>> step = torch.arange(10).repeat(3).unsqueeze(-1)
        >>> rows = TensorDict({"step": step, "time": step * 0.1, "state": torch.rand(30, 2)}, [30])
        >>> episodes = [Episode(name, 10 * k, 10) for k, name in enumerate("abc")]
        >>> for_tests = lambda episode: episode.name == "b"
        >>> data = EpisodeReplay(rows, episodes, for_tests=for_tests, num_slices=4, slice_len=5)
        >>> [(episode.name, episode.start) for episode in data.episodes]
        [('a', 0), ('c', 10)]
        >>> data.sample()["state"].shape, data.statistics["state", "mean"].shape
        (torch.Size([4, 5, 2]), torch.Size([2]))
    """

    #: Entries of the rows to compute statistics of.
    _numbers: Sequence[str] = ("state", "action")
    _stored: Tensor | None = None  # pictures of rollouts, uint8 ``[N, C, H, W]``

    def __init__(
        self,
        rows: TensorDictBase,
        episodes: Sequence[Episode],
        *,
        for_tests: Callable[[Any], bool],
        pictures: Pictures | None = None,
        single: Tensor | None = None,
        root: Path | None = None,
        **options: Unpack[ReplayOptions],
    ):
        check_options(options)
        sampler, batch_size = choose_sampler(options)
        self.sequential = single is None
        if not self.sequential and isinstance(sampler, SliceSampler):
            raise ValueError("slices are cut out of whole sequences, but this data set offers single rows alone")
        self.root: Path | None = root
        check_rows(rows, episodes)
        self._all_rows, self._all_episodes = rows, tuple(episodes)
        self._roles = roles_of(self._all_episodes, for_tests, options.get("validation_share", 0.0))
        split = options.get("split", "train")
        chosen = [e for e, role in zip(self._all_episodes, self._roles, strict=True) if split in ("all", role)]
        if not chosen:
            raise ValueError(
                f"none of the {len(self._all_episodes)} episodes {self._source} is in the split {split!r}, as a hash "
                "of their names has it; pass split='all', or add episodes"
            )
        stored, self.episodes = select_episodes(rows, chosen, single)
        check_episode_lengths(self.episodes, sampler, batch_size)
        self._add_pictures = _AddPictures(pictures)
        writer, transform = options.get("writer"), options.get("transform")
        super().__init__(
            storage=TensorStorage(stored),
            sampler=sampler,
            sample_unit=slices_of(sampler),
            writer=ImmutableDatasetWriter() if writer is None else writer,
            batch_size=batch_size,
            transform=self._add_pictures,
            collate_fn=options.get("collate_fn"),
            pin_memory=options.get("pin_memory", False),
            prefetch=options.get("prefetch"),
        )
        if transform is not None:
            self.append_transform(transform)

    @classmethod
    def from_rollouts(
        cls, rollouts: Iterable[TensorDictBase], dt: float, *, test_share: float = 0.0, **options: Unpack[ReplayOptions]
    ) -> EpisodeReplay:
        """Returns a data set of rollouts, with statistics of all floating vectors and of the images.

        The rows are the root entries, each with the action that leads to the next one; after
        :class:`~torch_denkf.envs.LateActions` that is the delayed action. Outputs of a filter in the environment are
        left out.

        Args:
            rollouts: ``[T]`` each, one episode; or a batch ``[B, T]``.
            dt: seconds of a step.
            test_share: share of the episodes in the test split, by a hash of their numbers.
            **options: options of the class.

        Raises:
            ValueError: if an episode ends within a rollout, or ``"pixels"`` are not uint8 ``[T, C, H, W]``.

        Example:
            >>> from torch_denkf.envs import NoisyPendulumEnv
            >>> rollouts = NoisyPendulumEnv(noise=0.1, batch_size=[3]).rollout(20)
            >>> data = EpisodeReplay.from_rollouts(rollouts, dt=0.05, num_slices=4, slice_len=5)
            >>> data.sample()["observation"].shape, sorted(data.statistics.keys())
            (torch.Size([4, 5, 2]), ['action', 'observation', 'state'])
        """
        parts, episodes = [], []
        for number, rollout in enumerate(rollouts):
            if rollout.ndim == 1:  # split_trajectories pads, and marks the valid rows
                rollout = rollout[rollout.get(("collector", "mask"), ...)]
            if rollout.ndim != 1 or rollout["next", "done"][:-1].any():
                raise ValueError(
                    f"A rollout is one episode, [T]; that of number {number} is {list(rollout.shape)}, or ends before "
                    "its last row: roll out with break_when_any_done=True, or split it there."
                )
            step = torch.arange(len(rollout)).unsqueeze(-1)
            times = {"step": step, "time": dt * step.double()}
            kept = rollout.exclude("next", "collector", "done", "terminated", "truncated", "is_init", "step_count")
            late = kept.get(("under_way", "action"), None)
            if late is not None:
                kept.set("action", late[..., 0, :])
            kept = kept.exclude("under_way", "belief", "previous", "ahead", "drawn")  # a belief would start each slice
            parts.append(kept.detach().cpu().apply(lambda x: x.float() if x.is_floating_point() else x).update(times))
            episodes.append(Episode(str(number), sum(map(len, parts[:-1])), len(rollout)))
        rows = cast(TensorDictBase, torch.cat(parts))
        pixels, pictures = rows.pop("pixels", None), None
        if pixels is not None:
            if pixels.dtype != torch.uint8 or pixels.ndim != 4 or pixels.shape[1] > pixels.shape[3]:
                raise ValueError(
                    f"'pixels' of a rollout are uint8 [T, C, H, W]; got {pixels.dtype} {list(pixels.shape)}. Leave "
                    "ToTensorImage out; PermuteTransform((-1, -3, -2)) brings the channels to the front."
                )
            pictures = partial(float_pictures, pixels)
        data = cls(rows, episodes, for_tests=hashed_tests(test_share), pictures=pictures, **options)
        numbers = {key: value for key, value in rows.items(True, True) if isinstance(value, Tensor) and value.ndim == 2}
        data._numbers = [key for key, value in numbers.items() if value.is_floating_point() and key != "time"]
        data._stored = pixels
        return data

    def draw(self, generator: torch.Generator, length: int | None = None) -> TensorDictBase:
        """Draws a sample with all randomness from a generator, for a :class:`torch_denkf.training.Stage`.

        Args:
            generator: on the CPU; with the same state it draws the same rows.
            length: rows of a slice in this sample, with the same number of slices; by default the data set's.

        Returns:
            As :meth:`sample`, ``[B, T]`` for slices.

        Raises:
            ValueError: if ``length`` is given without slices, an episode is shorter, or samples are drawn in advance.

        Example:
            >>> import torch
            >>> step = torch.arange(10).unsqueeze(-1)
            >>> rows = TensorDict({"step": step, "time": step * 0.1}, [10])
            >>> data = EpisodeReplay(rows, [Episode("a", 0, 10)], for_tests=lambda _: False, num_slices=2, slice_len=5)
            >>> data.draw(torch.Generator().manual_seed(0), length=3).shape
            torch.Size([2, 3])
        """
        if self._prefetch:
            raise ValueError("with prefetch=... samples are drawn in advance, by no generator of yours; leave it out")
        self.set_rng(generator)
        if length is None:
            return self.sample()
        sampler = self.sampler
        if not isinstance(sampler, SliceSampler) or self.batch_size is None:
            raise ValueError("length is that of slices: open the data set with num_slices=... or slice_len=...")
        own = sampler.slice_len
        rows = (sampler.num_slices or self.batch_size // own) * length
        try:
            sampler.slice_len = None if own is None else length
            check_episode_lengths(self.episodes, sampler, rows)
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Got conflicting batch_sizes")  # the other length is intended
                return self.sample(rows)
        finally:
            sampler.slice_len = own

    @property
    def _source(self) -> str:
        return "in memory" if self.root is None else f"in {self.root}"

    @property
    def _training_index(self) -> Tensor:
        """Returns rows of the training episodes, numbered in the whole data set, ``[n]``."""
        training = [e for e, role in zip(self._all_episodes, self._roles, strict=True) if role == "train"]
        if not training:
            raise ValueError(f"none of the episodes {self._source} is in the training split; add episodes")
        return rows_of(training)

    @cached_property
    def statistics(self) -> TensorDict:
        """Returns means and standard deviations over the **training** episodes, for every split.

        They standardise inputs and outputs of a network without information from other episodes.

        ========================== ============ ======================================================================
        key                        shape        of
        ========================== ============ ======================================================================
        ``("state", "mean")``      [S]          all rows; also ``std``, which is 0 for a joint that never moves
        ``("action", "mean")``     [A]          actions, if there are any; also ``std``
        ``("pixels", "mean")``     [C,1,1]      each channel, over observed rows; also ``std``
        ========================== ============ ======================================================================

        Standard deviations divide by the number of values. Readings with a mask, ``NAME_observed``, count only if it is
        True. Statistics of pixels are computed once, in a pass over all images.

        Raises:
            ValueError: if no episode is in the training split.
        """
        index = self._training_index
        statistics = self._number_statistics(self._all_rows.select(*self._numbers_with_masks, strict=False)[index])
        pixels = self._picture_statistics(index)
        if pixels is not None:
            statistics["pixels"] = pixels
        return TensorDict(statistics).float()

    @property
    def _numbers_with_masks(self) -> list[str]:
        return [key for name in self._numbers for key in (name, f"{name}_observed")]

    def _number_statistics(self, rows: TensorDictBase) -> dict[str, Any]:
        """Returns statistics of vectors in the training rows."""
        statistics = {}
        for key in self._numbers:
            if key in rows:
                mask = rows.get(f"{key}_observed", None)
                statistics[key] = mean_and_std(rows[key] if mask is None else rows[key][mask.squeeze(-1)])
        return statistics

    def _picture_statistics(self, index: Tensor) -> dict[str, Tensor] | None:
        """Returns statistics of the pixels of some rows of the whole data set; None without images."""
        if self._stored is None:
            return None
        seen = self._all_rows.get("observed", None)
        return picture_statistics(self._stored, index if seen is None else index[seen.any(-1)[index]])

    def _is_downloaded(self) -> bool:
        return self.root is None or self.root.is_dir()

    @property
    def data_path(self) -> Path | None:
        """Returns the folder of the data set; None without a folder."""
        return self.root

    @property
    def data_path_root(self) -> Path | None:
        """Returns the same folder, as splits have no folders."""
        return self.root

    def delete(self) -> None:
        """Raises ``RuntimeError``, as the data set did not write its files.

        Raises:
            RuntimeError: always.
        """
        raise RuntimeError(f"the recordings {self._source} were not written by this data set; delete them by hand")

    def __getstate__(self) -> dict[str, Any]:
        # TorchRL shares a storage's counters with spawned processes, which fails when workers of environments are
        # pickled. The buffer is read-only, so that each process may have a copy of the storage.
        writer = copy(self._writer)
        writer.register_storage(None)
        return {**super().__getstate__(), "_storage": self._storage.get(slice(None)), "_writer": writer}

    def __setstate__(self, state: dict[str, Any]) -> None:
        storage = TensorStorage(state["_storage"])
        state["_writer"].register_storage(storage)
        super().__setstate__({**state, "_storage": storage})

    def preprocess(self, fn: Callable[[TensorDictBase], TensorDictBase], *args, **kwargs) -> TensorStorage:
        """Runs TorchRL's ``preprocess``: ``fn`` gets rows with their pixels, and its result is stored in ``dest``."""
        return super().preprocess(partial(_then, self._add_pictures, fn), *args, **kwargs)


def _then(first: Transform, fn: Callable, rows: TensorDictBase) -> TensorDictBase:
    return fn(first(rows))


class _AddPictures(Transform):
    """Adds entries, such as pixels, that are not stored in the rows.

    Args:
        pictures: see :class:`EpisodeReplay`.
    """

    def __init__(self, pictures: Pictures | None):
        super().__init__()
        self.pictures = pictures

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds images to rows."""
        tensordict = tensordict.copy()  # data[:] returns the storage itself
        row = tensordict.pop(ROW)
        if self.pictures is not None:
            for key, value in self.pictures(row.reshape(-1)).items():
                tensordict.set(key, value.reshape(*tensordict.batch_size, *value.shape[1:]))
        return tensordict
