"""Pictures of the beliefs that a table left: joints with bands, and videos of the recording beside its belief.

Plots hold no frame of the recording. Videos do: they stay in --out.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from benchmarks.common.plots import save
from benchmarks.g1.recordings import NAMES, Recordings
from torch_denkf.plots import belief_video, plot_bands

LABELS = [f"{name.replace('_', ' ')}, deg" for name in NAMES]
DEGREES = [180 / np.pi] * len(NAMES)
SHOWN = (("clean", 0), ("black20_unannounced", 1))  # condition, and which of the saved episodes


def read_belief(file: Path, condition: str, which: int) -> TensorDict:
    """One episode's belief ``[T]`` of a file that :func:`benchmarks.g1.evaluation.save_beliefs` wrote.

    Raises:
        FileNotFoundError: without the file.
    """
    if not file.is_file():
        raise FileNotFoundError(f"no beliefs in {file}; run the table first, with the filter denkf and the state arm")
    with np.load(file) as saved:
        length = int(saved[f"{condition}_length"][which])
        keys = ("mean", "var", "truth", "observed", "reading", "begin")
        parts = {key: torch.from_numpy(saved[f"{condition}_{key}"][which : which + 1]) for key in keys}
        number = int(saved["episodes"][which])
    belief = TensorDict({"belief": {key: parts[key][0, :length] for key in ("mean", "var")}}, batch_size=[length])
    belief["state"], belief["reading"] = parts["truth"][0, :length], parts["reading"][0, :length]
    belief["observed"] = parts["observed"][0, :length].unsqueeze(-1)
    step = torch.arange(length)
    belief["black"] = ((step >= parts["begin"]) & (step < parts["begin"] + 20)).unsqueeze(-1)
    belief["black"] &= condition.startswith("black20")
    belief["episode"] = torch.full((length,), number)
    return belief


def draw_all(study: Recordings) -> Iterator[Path]:
    """Draws the joints, with and without black frames, and two videos; yields the files.

    Raises:
        FileNotFoundError: without beliefs.
    """
    file = study.out / "beliefs" / "denkf-arm-glimpse-0.npz"
    for condition, which in SHOWN:
        belief = read_belief(file, condition, which)
        yield draw_joints(belief, study.data.fps, study.out / f"joints-{condition}.png", condition)
        yield draw_video(belief, study, study.out / f"episode-{condition}.mp4", condition)


def _title(belief: TensorDict, condition: str) -> str:
    error = (belief["belief", "mean"] - belief["state"])[1:].abs().mean().rad2deg()
    text = f"episode {int(belief['episode'][0])}, unseen in training: {error:.2f} deg on average"
    return text + ("; shaded: 20 black frames that nothing announces" if condition != "clean" else "")


def draw_joints(belief: TensorDict, fps: float, path: Path, condition: str) -> Path:
    """All joints over time: truth, mean, 90 % band, and the sensor's readings."""
    joints = len(NAMES)
    readings = {dim: belief["reading"][:, dim] for dim in range(joints)}
    axes = plot_bands(
        belief,
        dims=range(joints),
        names=LABELS,
        factors=DEGREES,
        readings=readings,
        observed=~belief["black"],
        time=1 / fps,
        band="variance",
    )
    figure = axes[0].figure
    figure.set_size_inches(9, 12)
    figure.suptitle(_title(belief, condition))
    save(figure, path)
    return path


def draw_video(belief: TensorDict, study: Recordings, path: Path, condition: str) -> Path:
    """The recording with truth and belief of three joints beside it; black where the camera was."""
    data = study.data
    number = int(belief["episode"][0])
    episode = next(e for e in data.episodes if e.number == number)
    pixels = data[torch.arange(episode.start, episode.start + episode.length)]["pixels"]
    pixels = pixels * ~belief["black"].view(-1, 1, 1, 1)
    dims = (0, 3, 6)
    belief_video(
        path,
        belief.exclude("observed"),
        pixels,
        observed=~belief["black"],
        time=1 / data.fps,
        bands={
            "dims": dims,
            "names": [LABELS[dim] for dim in dims],
            "factors": [DEGREES[dim] for dim in dims],
            "band": "variance",
        },
        title=_title(belief, condition),
        every=2,
        size=(11, 5),
    )
    return path
