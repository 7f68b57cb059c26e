"""Pictures of the beliefs that a table left: joints with bands, and videos of the recording beside its belief.

Plots hold no frame of the recording. Videos do: they stay in --out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import torch
from tensordict import TensorDict

from benchmarks.common.beliefs import Numbers, read_belief
from benchmarks.g1.recordings import NAMES, Recordings

LABELS = [f"{name.replace('_', ' ')}, deg" for name in NAMES]
SHOWN = (("clean", 0), ("black20", 1), ("black20_unannounced", 1))  # condition, and which of the saved episodes
FILMED = (0, 3, 6)  # joints in a video


def draw_all(study: Recordings) -> Iterator[Path]:
    """Draws the joints, with and without black frames, and videos; yields the files.

    Raises:
        FileNotFoundError: without beliefs.
    """
    data, test = study.data, study.roles(0).test
    numbers = Numbers(LABELS, [180 / math.pi] * len(LABELS), 1 / data.fps)
    for condition, which in SHOWN:
        belief = read_belief(study.out / "beliefs" / f"denkf-arm-glimpse-0-{condition}-{test[which]}.pt")
        title = _title(belief, test[which], condition)
        yield numbers.draw(belief, study.out / f"joints-{condition}.png", title)
        episode = next(e for e in data.episodes if e.number == test[which])
        pixels = data[torch.arange(episode.start, episode.start + episode.length)]["pixels"]
        yield numbers.film(belief, pixels, FILMED, study.out / f"episode-{condition}.mp4", title)


def _title(belief: TensorDict, number: int, condition: str) -> str:
    error = (belief["belief", "mean"] - belief["state"])[1:].abs().mean().rad2deg()
    text = f"episode {number}, unseen in training: {error:.2f} deg on average"
    if condition == "clean":
        return text
    return text + "; shaded: 20 black frames" + ", which nothing announces" * condition.endswith("unannounced")
