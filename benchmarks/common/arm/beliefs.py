"""Saves beliefs of whole sequences, and plots them with bands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.plots import save
from torch_denkf.plots import plot_bands
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint


def save_belief(file: Path, mean: Tensor, var: Tensor, state: Tensor, observed: Tensor, **others: Tensor) -> None:
    """Saves a belief ``[T, D]`` of one sequence, its truth, and the observed mask of the camera ``[T, 1]``."""
    entries = {"mean": mean, "var": var, "state": state, "observed": observed, **others}
    write_checkpoint(file, {key: value.clone() for key, value in entries.items()})  # without the rest of a batch


def draw_beliefs(out: Path, names: Sequence[str], factors: Sequence[float], time: float) -> Iterator[Path]:
    """Draws all components over time: truth, mean, 90 % band, and the sensor's ``"reading"`` if there is one.

    Args:
        out: folder of the study.
        names: of the components, with their units.
        factors: that convert to these units.
        time: s of a row.

    Yields:
        the plots' files, in ``out/pictures``.

    Raises:
        FileNotFoundError: without beliefs.
    """
    files, dims = sorted((out / "beliefs").glob("*.pt")), range(len(names))
    if not files:
        raise FileNotFoundError(f"no beliefs in {out / 'beliefs'}; run the table first, with the filter denkf")
    (out / "pictures").mkdir(exist_ok=True)
    for file in files:
        saved = read_checkpoint(file)
        belief = {key: saved.pop(key) for key in ("mean", "var")}
        belief = TensorDict({"belief": belief, **saved}, batch_size=[len(belief["mean"])])
        readings = {dim: belief["reading"][:, dim] for dim in dims} if "reading" in belief else None
        bands = {"dims": dims, "names": names, "factors": factors, "band": "variance"}
        figure = plot_bands(belief, readings=readings, time=time, **bands)[0].figure
        figure.set_size_inches(9, 1 + 1.6 * len(dims))
        figure.suptitle(file.stem)
        path = out / "pictures" / f"{file.stem}.png"
        save(figure, path)
        yield path
