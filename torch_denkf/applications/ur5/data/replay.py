"""Demonstrations of the UR5 table as a data set of torchrl."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Unpack

from torch import Tensor

from torch_denkf.applications.ur5.data.cache import read_demos, read_entries
from torch_denkf.applications.ur5.data.rows import UR5Episode, demo_episodes, demo_rows, is_for_tests
from torch_denkf.data.options import ReplayOptions, check_options
from torch_denkf.data.pictures import JoinedPictures, float_pictures
from torch_denkf.data.replay import EpisodeReplay
from torch_denkf.deployment.progress import progress_bar

__all__ = ["UR5ExperienceReplay"]


class UR5ExperienceReplay(EpisodeReplay):
    """Demos that ``denkf collect-ur5`` collected, as a replay buffer of their steps.

    An episode is a demo. Keys, samples and splits are those of :class:`~torch_denkf.data.EpisodeReplay`; here the
    readings are

    ===================== ============ ===========================================================================
    key                   shape        content
    ===================== ============ ===========================================================================
    ``pixels``            [n,3,H,W]    float32 in [0, 1], zero where not observed; not in collections without any
    ``observed``          [n,1]        bool: this step was rendered
    ``state``             [n,10]       float32, the truth, see :class:`torch_denkf.applications.ur5.UR5TableEnv`: J1 to
                                       J6 and the gripper's opening in rad, x, y, z in m
    ``action``            [n,7]        float32, rad: sent in that state, it leads to the next one
    ``success``           [n,1]        bool: the task is done in that state
    ``task``              [n,1]        int64: 0 pick, 1 push, 2 put-down
    ===================== ============ ===========================================================================

    Steps are 0.08 s apart. With ``frames_only`` the rows are the rendered ones, each as an episode (``is_init`` and
    ``next``/``done`` True everywhere); their ``step`` is that in the demo.

    At the first use, all demos are decoded, verified by their checksums and scaled into a memory-mapped cache. 2,000
    demos at 112 px take 0.6 GB with 8 frames each, 26 GB with all.

    The split depends on a hash of a demo's number only: a fifth of all demos is in ``"test"``, at every size and in
    both domains.

    Args:
        root: folder of the demos.
        size: (H, W) of the images after scaling by area averages; by default the stored size.
        frames_only: True for only the rows with an image, to train a sensor.
        **options: of :class:`~torch_denkf.data.EpisodeReplay`.

    Attributes:
        episodes: list of the episodes, with the number of the ``demo`` and its ``task``.

    Raises:
        FileNotFoundError: without the folder, its manifest or a demo's file.
        ValueError: for options out of range, a split without demos, files that were cut or changed, that are no demos
            or differ in size, slices of ``frames_only``, and demos that are shorter than a slice.
        OSError: if the cache cannot be written.

    Examples:
        >>> from torch_denkf.applications.ur5.envs.collect import collect_ur5_demos
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> made = collect_ur5_demos(folder, 2, frames=None, max_steps=60)
        >>> data = UR5ExperienceReplay(folder, split="all", num_slices=4, slice_len=5, cache=None)
        >>> len(data), data.episodes[1].task
        (120, 'push')
        >>> data.sample()["state"].shape
        torch.Size([4, 5, 10])
    """

    episodes: tuple[UR5Episode, ...]

    def __init__(
        self,
        root: str | Path,
        *,
        size: tuple[int, int] | None = None,
        frames_only: bool = False,
        **options: Unpack[ReplayOptions],
    ):
        check_options(options)
        folder = Path(root).expanduser().resolve()
        entries = read_entries(folder)
        with progress_bar("reading demos", len(entries), unit=" demos", shown=options.get("progress", True)) as bar:
            demos = read_demos(folder, entries, size, options.get("cache", True), bar.update)
        self._frames, self._frame = demos.get("frames", None), demos["rows", "frame"].squeeze(-1)
        if frames_only and self._frames is None:
            raise ValueError(f"the demos in {folder} have no pictures; collect them without --no-pixels")
        super().__init__(
            demo_rows(demos["rows"]),
            demo_episodes(demos["rows"], entries),
            for_tests=lambda episode: is_for_tests(episode.demo),
            pictures=None
            if self._frames is None
            else partial(_pixels, JoinedPictures([self._frames["pixels"]]), self._frame),
            single=self._frame >= 0 if frames_only else None,
            root=folder,
            **options,
        )

    def _picture_statistics(self, index: Tensor) -> dict[str, Tensor] | None:
        """Returns them from the sums over each image in the cache."""
        shots = self._frame[index]
        shots = shots[shots >= 0]
        if not len(shots):
            return None
        count = len(shots) * self._frames["pixels"][0, 0].numel()
        mean, square = (self._frames[key][shots].sum(0).double() / count for key in ("sum", "square"))
        std = (square - mean.square()).clamp_min(0).sqrt()
        return {"mean": mean[:, None, None] / 255, "std": std[:, None, None] / 255}


def _pixels(pictures: JoinedPictures, frame: Tensor, row: Tensor) -> dict[str, Tensor]:
    return float_pictures(pictures, frame[row])
