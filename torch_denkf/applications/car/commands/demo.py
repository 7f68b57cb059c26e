"""``denkf demo``: a car's path with its uncertainty, while its camera fails; nothing is trained.

::

    denkf demo --out runs/demo                                # a rendered drive
    denkf demo --root KITTI --drive 09 --out runs/demo        # a recorded one

The filter ``car-odometry`` comes with the library; it has not seen the drive.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from torch_denkf._checks import check_count
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.cli.command import Command, alone_in, say
from torch_denkf.deployment.files import replacing
from torch_denkf.deployment.progress import progress_bar

__all__ = ["Demo"]

_NAMES = {
    "missing": "lost frames (announced)",
    "black": "black frames (unannounced)",
    "box": "box in the way (unannounced)",
}


@dataclass
class Demo(Command):
    """Track a car by one camera that fails, with a pretrained filter: a picture and an animation."""

    out: Path = Path("runs/demo")  # folder for demo.png and demo.gif
    root: Path | None = None  # folder in KITTI's layout; without it a drive is rendered
    drive: str | None = None  # name of a drive below --root
    height: float = KITTI_HEIGHT  # of the camera of --root over the road, m
    frames: int = 240  # of the drive, at most
    seed: int = 2032  # of the rendered drive; the training's was 0
    every: int = 4  # n-th frame that the animation shows
    threads: int = 1  # of torch and OpenCV

    name, example = "demo", "denkf demo --out runs/demo"

    def run(self) -> None:
        """Renders, tracks and draws."""
        if (self.root is None) != (self.drive is None):
            raise ValueError("pass --root and --drive together, or neither")
        check_count("--frames", self.frames, least=30)
        check_count("--every", self.every)
        check_count("--seed", self.seed, least=0)
        if find_spec("matplotlib") is None or find_spec("PIL") is None:  # before a minute of work
            raise ImportError('pictures need matplotlib and pillow: pip install "torch_denkf[plots]"')
        with alone_in(self.out):
            self._leave()

    def _leave(self) -> None:
        import numpy as np

        from torch_denkf.applications.car.commands._car import load_car, set_threads
        from torch_denkf.applications.car.kitti.drive import read_kitti_drive
        from torch_denkf.applications.car.kitti.render import render_drives
        from torch_denkf.applications.car.odometry.failing_drive import (
            drive_scores,
            track_failing_drive,
            usual_failures,
        )
        from torch_denkf.applications.car.odometry.failures import fail_frames
        from torch_denkf.applications.car.pictures import BANDS, NamedSpan, drive_picture, named_frames, path_options
        from torch_denkf.plots import belief_video

        set_threads(self.threads)
        out, root, name, size = self.out, self.root, self.drive, (100, 300)
        if root is None or name is None:
            root, name = out / "drives", "demo"
            with progress_bar("rendering a drive", self.frames, unit=" frames", every=3) as bar:
                options = {"size": size, "seed": self.seed, "overwrite": True, "progress": bar.update}
                render_drives(root, names=name, frames=self.frames, **options)
        drive = read_kitti_drive(root, name, size=size, cache=None)[: self.frames]
        failures = usual_failures(len(drive))
        car = load_car("car-odometry")
        with progress_bar("tracking the car", len(drive), unit=" frames", every=3) as bar:
            tracked = track_failing_drive(car, drive, failures, height=self.height, progress=bar.update)
        images = [image.permute(1, 2, 0).numpy() for image in drive["image"]]
        # A lost frame is drawn as a grey one.
        shown = [image if image is not None else 0 * images[0] + 225 for image in fail_frames(images, failures)]
        spans = [NamedSpan(_NAMES[failure.kind], failure.first, failure.last) for failure in failures]
        title = "Where is the car? One camera, which fails three times"
        with replacing(out / "demo.png") as beside:
            drive_picture(tracked, shown, spans, title).savefig(beside, dpi=90)
        moving = tracked[1:]  # one picture alone shows no motion
        belief_video(
            out / "demo.gif",
            moving,
            np.stack(named_frames(shown, spans)[1:]),
            time=moving["time"],
            path=path_options(moving),
            bands=BANDS,
            title=title,
            every=self.every,
            fps=6,
            size=(8, 5),
        )
        say(_table(drive_scores(tracked)))
        say(f"{out}: demo.png, demo.gif")


def _table(scores: dict[str, float]) -> str:
    """Formats the errors and the coverage of a drive."""
    way = scores["way_m"]
    lines = [f"{'':16}{'end-point error':>18}{'mean error':>18}   after {way:.0f} m with a camera that failed 3 times"]
    for label, name in (("DEnKF", "filter"), ("dead reckoning", "reckoned")):
        end, mean = scores[f"{name}_end_m"], scores[f"{name}_mean_m"]
        lines.append(f"{label:16}{f'{end:.1f} m ({100 * end / way:.1f} %)':>18}{f'{mean:.1f} m':>18}")
    coverage = f"speed {100 * scores['held_v']:.0f} %, turn rate {100 * scores['held_theta_dot']:.0f} %"
    return "\n".join([*lines, f"90 % coverage of the DEnKF: {coverage}."])
