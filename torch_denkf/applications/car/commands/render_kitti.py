"""``denkf render-kitti``: drives in KITTI's layout.

::

    denkf render-kitti --poses kitti/poses --out rendered        # along recorded poses
    denkf render-kitti --names a b c --frames 1000 --out town    # along invented ones

A repeated or interrupted command continues with the drives that are missing. See
:func:`torch_denkf.applications.car.kitti.render.render_drives`, which does the work. From Python:

>>> import tempfile
>>> RenderKITTI.main(["--out", tempfile.mkdtemp(), "--names", "a", "--frames", "3", "--processes", "1"])
1 drives in ...: a
0
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from torch_denkf._checks import check_count
from torch_denkf.applications.car.street.camera import KITTI_FOCAL
from torch_denkf.cli.command import Command, say
from torch_denkf.deployment.progress import progress_bar

__all__ = ["RenderKITTI"]


@dataclass
class RenderKITTI(Command):
    """Render drives in KITTI's layout, along pose files or along invented trajectories."""

    out: Path  # folder that gets sequences/ and poses/
    poses: Path | None = None  # folder of pose files NAME.txt; without it the drives are invented
    names: tuple[str, ...] | None = None  # of drives: all pose files, or 00 to 10 when invented
    size: tuple[int, int] = (50, 150)  # (height, width) of the images
    frames: int | None = None  # at most so many images a drive; 300 when invented
    seed: int = 0  # another one gives other scenes
    camera: str = "image_2"  # image_0 is grey
    focal: float = KITTI_FOCAL  # focal length as a share of the width
    processes: int | None = None  # that draw at a time; one a core by default
    overwrite: bool = False  # replace rendered drives of other options
    traffic: bool = True  # no moving cars, steady exposure

    name, resumable = "render-kitti", True
    example = "denkf render-kitti --names a b c --frames 1000 --out town"

    def run(self) -> None:
        """Renders."""
        from torch_denkf.applications.car.kitti.render import render_drives

        check_count("--seed", self.seed, least=0)
        with progress_bar("rendering", None, unit=" images") as bar:
            names = render_drives(**asdict(self), progress=bar.update)
        say(f"{len(names)} drives in {self.out}: {', '.join(names)}")
