"""``denkf evaluate``: errors of a trained car filter on drives with known poses.

::

    denkf evaluate --checkpoint runs/car --root KITTI --drives 09 10 --out runs/car/evaluation

See :func:`torch_denkf.applications.car.odometry.evaluation.evaluate_car_filter`, which does the work.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

from torch_denkf._checks import check_count
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.cli.command import Command, alone_in, say
from torch_denkf.deployment.files import write_text

__all__ = ["Evaluate"]


@dataclass
class Evaluate(Command):
    """Errors of a trained car filter on drives with known poses, next to dead reckoning on the same readings."""

    root: Path  # folder in KITTI's layout, with sequences/ and poses/
    checkpoint: str = "car-odometry"  # that of the library, or a folder that denkf train left
    drives: tuple[str, ...] = ()  # names below --root; all by default
    out: Path | None = None  # folder for evaluation.csv and evaluation.md, and a cache of the optical flow
    camera: str | None = None  # folder of the images; the first that has any by default
    size: tuple[int, int] | None = None  # (height, width) to scale images to; that of the training by default
    height: float = KITTI_HEIGHT  # of the camera over the road, m
    pitch: float = 0.0  # how far the camera looks up, rad
    missing: float = 0.0  # share of the frames to lose
    draws: int = 8  # of the filter's noise, over which errors are averaged
    window: int = 100  # steps of the end point errors
    seed: int = 0  # of the noise
    threads: int = 1  # of torch and OpenCV

    name, resumable = "evaluate", True
    example = "denkf evaluate --checkpoint runs/car --root KITTI --drives 09 10 --out runs/car/evaluation"

    def run(self) -> None:
        """Evaluates, and writes the results."""
        from torch_denkf.applications.car.commands._car import load_car, set_threads
        from torch_denkf.applications.car.kitti.episodes import find_drives
        from torch_denkf.applications.car.odometry.evaluation import evaluate_car_filter, markdown_table, write_rows

        set_threads(self.threads)
        check_count("--seed", self.seed, least=0)
        car = load_car(self.checkpoint)
        drives = find_drives(self.root, self.drives or None)
        with nullcontext() if self.out is None else alone_in(self.out):
            rows, _ = evaluate_car_filter(
                car,
                self.root,
                drives,
                cache=True if self.out is None else self.out / "cache",
                camera=self.camera,
                size=self.size,
                height=self.height,
                pitch=self.pitch,
                missing=self.missing,
                draws=self.draws,
                window=self.window,
                seed=self.seed,
            )
            table = markdown_table(rows)
            say(table)
            if self.out is not None:
                write_rows(rows, self.out / "evaluation.csv")
                write_text(self.out / "evaluation.md", f"`{self.command_line}`\n\n{table}")
                say(f"{self.out / 'evaluation.csv'}, {self.out / 'evaluation.md'}")
