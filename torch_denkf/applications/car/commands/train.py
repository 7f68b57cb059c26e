"""``denkf train``: a car's filter, from drives with known poses.

::

    denkf train --rendered 20 --out runs/car                             # no recordings needed
    denkf train --root KITTI --test 09 10 --rendered 20 --out runs/car   # and recorded drives, two of them unseen

See :func:`torch_denkf.applications.car.odometry.training.train_car_filter`, which does the work.
"""

from __future__ import annotations

import argparse

from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.cli._command import Command, alone_in, path, say, whole

__all__ = ["main"]


def _arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--out", required=True, type=path, help="folder of the filter, with everything that its training needs")
    add("--root", type=path, help="folder of recorded drives in KITTI's layout, with sequences/ and poses/")
    add("--drives", nargs="+", metavar="NAME", help="drives below --root to learn from; all by default")
    add("--test", nargs="+", default=[], metavar="NAME", help="drives below --root that must not be seen")
    add("--rendered", type=int, default=0, metavar="N", help="drives to render and learn from, too")
    add("--frames", type=int, default=160, help="of a rendered drive")
    add("--size", nargs=2, type=int, default=(100, 300), metavar=("H", "W"), help="that images are scaled to")
    add("--height", type=float, default=KITTI_HEIGHT, help="of the recording camera over the road, m")
    add("--sensor-updates", type=int, default=3000, help="training steps of the sensor alone")
    add("--filter-updates", type=int, default=300, help="of the filter on its readings")
    add("--end-to-end-updates", type=int, default=40, help="of both together")
    add("--length", type=int, default=24, help="steps of the windows that the filter learns from")
    add("--seed", type=whole(0), default=0, help="of all random numbers")
    add("--device", default="cpu", help="that the networks run on")
    add("--threads", type=whole(1), default=1, help="of torch and OpenCV; the networks are small")
    add("--processes", type=int, default=1, help="that render at a time")


def _run(args: argparse.Namespace) -> None:
    if args.root is None and args.rendered < 3:
        raise ValueError("nothing to learn from: pass --root FOLDER, or --rendered N with three drives or more")
    import cv2
    import torch

    from torch_denkf.applications.car.odometry.checkpoint import read_config
    from torch_denkf.applications.car.odometry.training import Updates, train_car_filter

    try:
        torch.empty(0, device=args.device)
    except (AssertionError, RuntimeError) as error:
        raise ValueError(f"--device {args.device} cannot be used here: {str(error).splitlines()[0]}") from error
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    with alone_in(args.out):
        train_car_filter(
            args.out,
            root=args.root,
            drives=args.drives,
            leave_out=args.test,
            rendered=args.rendered,
            frames=args.frames,
            size=tuple(args.size),
            height=args.height,
            updates=Updates(args.sensor_updates, args.filter_updates, args.end_to_end_updates, args.length),
            seed=args.seed,
            device=args.device,
            processes=args.processes,
            command=args.command_line,
        )
    config = read_config(args.out)
    training = config["training"]
    say(f"{args.out}: trained; roles: " + "; ".join(f"{k}: {' '.join(v)}" for k, v in training["roles"].items()))
    say(
        f"validation CRPS {training['validation_crps']:.3g} of a good sensor's error, inflation "
        f"{config['settings']['inflation']:g}"
    )
    tests = f" --root {args.root} --drives {' '.join(args.test)}" if args.test else " --root KITTI"
    say(f"next: denkf evaluate --checkpoint {args.out}{tests} --out {args.out}/evaluation")


main = Command(
    "train",
    "Train a car's filter on recorded drives, rendered ones, or both; a repeated command goes on where it stopped.",
    "denkf train --rendered 20 --out runs/car",
    _arguments,
    _run,
    resumable=True,
)

if __name__ == "__main__":
    raise SystemExit(main())
