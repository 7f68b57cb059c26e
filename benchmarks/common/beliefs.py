"""Beliefs of whole episodes that a study leaves on disk, and their pictures: numbers with bands, and videos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.plots import save
from torch_denkf.plots import belief_video, plot_bands
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint


def save_belief(file: Path, mean: Tensor, var: Tensor, state: Tensor, observed: Tensor, **others: Tensor) -> None:
    """Leaves a belief ``[T, D]`` of one episode, its truth, and where the camera was seen ``[T, 1]``."""
    entries = {"mean": mean, "var": var, "state": state, "observed": observed, **others}
    write_checkpoint(file, {key: value.clone() for key, value in entries.items()})  # without the rest of a batch


def read_belief(file: Path) -> TensorDict:
    """A belief that :func:`save_belief` left, ``[T]``: ``("belief", "mean")``, ``("belief", "var")``, and the others.

    Raises:
        FileNotFoundError: without the file; says which command makes it.
    """
    if not file.is_file():
        raise FileNotFoundError(f"no belief in {file}; run the study's table first, with the filter denkf")
    saved = {key: value for key, value in read_checkpoint(file).items() if isinstance(value, Tensor)}
    belief = {key: saved.pop(key) for key in ("mean", "var")}
    return TensorDict({"belief": belief, **saved}, batch_size=[len(belief["mean"])])


@dataclass(frozen=True)
class Numbers:
    """The numbers of a state, as pictures show them.

    Args:
        names: with their units.
        factors: into these.
        time: s of a row.
    """

    names: Sequence[str]
    factors: Sequence[float]
    time: float

    def draw(self, belief: TensorDict, path: Path, title: str) -> Path:
        """All numbers over time: truth, mean, 90 % band, and the sensor's ``"reading"`` where there is one."""
        dims = range(len(self.names))
        readings = {dim: belief["reading"][:, dim] for dim in dims} if "reading" in belief else None
        axes = plot_bands(belief, readings=readings, time=self.time, **self._bands(dims))
        figure = axes[0].figure
        figure.set_size_inches(9, 1 + 1.6 * len(dims))
        figure.suptitle(title)
        save(figure, path)
        return path

    def film(self, belief: TensorDict, pixels: Tensor, dims: Sequence[int], path: Path, title: str) -> Path:
        """The pictures ``[T, C, H, W]``, black where none was seen, with truth and belief of some numbers beside."""
        pixels = pixels * belief["observed"].view(-1, 1, 1, 1)
        settings = {"bands": self._bands(dims), "title": title, "every": 2, "size": (11, 5)}
        return belief_video(path, belief, pixels, time=self.time, **settings)

    def _bands(self, dims: Sequence[int]) -> dict:
        names, factors = ([part[dim] for dim in dims] for part in (self.names, self.factors))
        return {"dims": dims, "names": names, "factors": factors, "band": "variance"}
