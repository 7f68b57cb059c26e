"""``denkf train``: a car's filter, from drives with known poses.

::

    denkf train --rendered 20 --out runs/car                             # no recordings needed
    denkf train --root KITTI --test 09 10 --rendered 20 --out runs/car   # and recorded drives, two of them unseen

See :func:`torch_denkf.applications.car.odometry.training.train_car_filter`, which does the work.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.cli.command import Command, alone_in, say

__all__ = ["Train"]


@dataclass
class Train(Command):
    """Train a car's filter on recorded drives, rendered ones, or both; a repeated command resumes where it stopped."""

    out: Path  # folder of the filter, with everything that its training needs
    root: Path | None = None  # folder of recorded drives in KITTI's layout, with sequences/ and poses/
    drives: tuple[str, ...] = ()  # names below --root to learn from; all by default
    test: tuple[str, ...] = ()  # names of drives below --root that must not be seen
    rendered: int = 0  # drives to render and learn from, too
    frames: int = 160  # of a rendered drive
    size: tuple[int, int] = (100, 300)  # (height, width) that images are scaled to
    height: float = KITTI_HEIGHT  # of the recording camera over the road, m
    sensor_updates: int = 3000  # training steps of the sensor alone
    filter_updates: int = 300  # of the filter on its readings
    end_to_end_updates: int = 40  # of both together
    length: int = 24  # steps of the windows that the filter learns from
    seed: int = 0  # of all random numbers
    device: str = "cpu"  # that the networks run on
    threads: int = 1  # of torch and OpenCV; the networks are small
    processes: int = 1  # that render at a time

    name, resumable = "train", True
    example = "denkf train --rendered 20 --out runs/car"

    def run(self) -> None:
        """Trains the filter, and prints its validation score."""
        if self.root is None and self.rendered < 3:
            raise ValueError("nothing to learn from: pass --root FOLDER, or --rendered N with three drives or more")
        import torch

        from torch_denkf.applications.car.commands._car import set_threads
        from torch_denkf.applications.car.odometry.training import Updates, train_car_filter

        try:
            torch.empty(0, device=self.device)
        except (AssertionError, RuntimeError) as error:
            raise ValueError(f"--device {self.device} cannot be used here: {str(error).splitlines()[0]}") from error
        set_threads(self.threads)
        with alone_in(self.out):
            train_car_filter(
                self.out,
                root=self.root,
                drives=self.drives,
                leave_out=self.test,
                rendered=self.rendered,
                frames=self.frames,
                size=self.size,
                height=self.height,
                updates=Updates(self.sensor_updates, self.filter_updates, self.end_to_end_updates, self.length),
                seed=self.seed,
                device=self.device,
                processes=self.processes,
                command=self.command_line,
            )
        config = json.loads((self.out / "config.json").read_text())
        training = config["training"]
        say(f"{self.out}: trained; roles: " + "; ".join(f"{k}: {' '.join(v)}" for k, v in training["roles"].items()))
        say(
            f"validation CRPS {training['validation_crps']:.3g} of a good sensor's error, inflation "
            f"{config['settings']['inflation']:g}"
        )
        tests = f" --root {self.root} --drives {' '.join(self.test)}" if self.test else " --root KITTI"
        say(f"next: denkf evaluate --checkpoint {self.out}{tests} --out {self.out}/evaluation")
