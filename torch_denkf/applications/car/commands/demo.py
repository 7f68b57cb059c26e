"""``denkf demo``: a car's path with its uncertainty, while its camera fails; nothing is trained.

::

    denkf demo --out runs/demo                                # a rendered drive
    denkf demo --root KITTI --drive 09 --out runs/demo        # a recorded one

The filter ``car-odometry`` comes with the library; it has not seen the drive.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from torch_denkf._files import replacing
from torch_denkf._progress import progress_bar
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.cli._command import Command, alone_in, path, say, whole

__all__ = ["main"]

_NAMES = {
    "missing": "lost frames\n(announced)",
    "black": "black frames\n(unannounced)",
    "box": "box in the way\n(unannounced)",
}


def _arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--out", type=path, default=Path("runs/demo"), help="folder for demo.png and demo.gif")
    add("--root", type=path, help="folder in KITTI's layout; without it a drive is rendered")
    add("--drive", help="name of a drive below --root")
    add("--height", type=float, default=KITTI_HEIGHT, help="of the camera of --root over the road, m")
    add("--frames", type=int, default=240, help="of the drive, at most")
    add("--seed", type=whole(0), default=2032, help="of the rendered drive; the training's was 0")
    add("--every", type=int, default=4, help="n-th frame that the animation shows")
    add("--threads", type=whole(1), default=1, help="of torch and OpenCV")


def _run(args: argparse.Namespace) -> None:
    if (args.root is None) != (args.drive is None):
        raise ValueError("pass --root and --drive together, or neither")
    if args.frames < 30 or args.every < 1:
        raise ValueError(f"--frames is at least 30, --every at least 1; got {args.frames} and {args.every}")
    from importlib.util import find_spec

    if find_spec("matplotlib") is None or find_spec("PIL") is None:  # before a minute of work
        raise ImportError('pictures need matplotlib and pillow: pip install "torch_denkf[plots]"')
    with alone_in(args.out):
        _leave(args)


def _leave(args: argparse.Namespace) -> None:
    """Renders, tracks and draws."""
    import cv2
    import torch

    from torch_denkf.applications.car.commands._car import load_car
    from torch_denkf.applications.car.kitti.drive import read_kitti_drive
    from torch_denkf.applications.car.kitti.render import render_drives
    from torch_denkf.applications.car.odometry.failing_drive import drive_scores, track_failing_drive, usual_failures
    from torch_denkf.applications.car.odometry.failures import fail_frames
    from torch_denkf.applications.car.pictures import NamedSpan, drive_animation, drive_picture

    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    size = (100, 300)
    if args.root is None:
        args.root, args.drive = args.out / "drives", "demo"
        with progress_bar("rendering a drive", args.frames, unit=" frames", every=3) as bar:
            render_drives(
                args.root,
                names=args.drive,
                frames=args.frames,
                size=size,
                seed=args.seed,
                overwrite=True,
                progress=bar.update,
            )
    drive = read_kitti_drive(args.root, args.drive, size=size, cache=None)[: args.frames]
    failures = usual_failures(len(drive))
    with progress_bar("tracking the car", len(drive), unit=" frames", every=3) as bar:
        tracked = track_failing_drive(
            load_car("car-odometry"),
            drive,
            failures,
            height=args.height,
            progress=bar.update,
        )
    images = [image.permute(1, 2, 0).numpy() for image in drive["image"]]
    shown = [image if image is not None else 0 * images[0] + 225 for image in fail_frames(images, failures)]
    spans = [NamedSpan(_NAMES[failure.kind], failure.first, failure.last) for failure in failures]
    title = "Where is the car? One camera, which fails three times"
    with replacing(args.out / "demo.png") as beside:
        drive_picture(tracked, shown, spans, title).savefig(beside, dpi=90)
    with progress_bar("drawing", None, unit=" frames", every=3) as bar:
        drive_animation(
            args.out / "demo.gif", tracked, shown, spans, title=title, every=args.every, progress=bar.update
        )
    say(_table(drive_scores(tracked)))
    say(f"{args.out}: demo.png, demo.gif")


def _table(scores: dict[str, float]) -> str:
    """Three lines on a drive."""
    way = scores["way_m"]
    lines = [
        f"{'':16}{'off at the end':>18}{'off on average':>18}   after {way:.0f} m with a camera that failed 3 times"
    ]
    for label, name in (("DEnKF", "filter"), ("dead reckoning", "reckoned")):
        end, mean = scores[f"{name}_end_m"], scores[f"{name}_mean_m"]
        lines.append(f"{label:16}{f'{end:.1f} m ({100 * end / way:.1f} %)':>18}{f'{mean:.1f} m':>18}")
    held = (
        f"{100 * scores['held_v']:.0f} % of the true speeds, {100 * scores['held_theta_dot']:.0f} % of the turn rates"
    )
    return "\n".join([*lines, f"The DEnKF's 90 % intervals hold {held}."])


main = Command(
    "demo",
    "Track a car by one camera that fails, with a filter that comes with the library: a picture and an animation.",
    "denkf demo --out runs/demo",
    _arguments,
    _run,
)

if __name__ == "__main__":
    raise SystemExit(main())
