"""``denkf evaluate``: errors of a trained car filter on drives with known poses.

::

    denkf evaluate --checkpoint runs/car --root KITTI --drives 09 10 --out runs/car/evaluation

See :func:`torch_denkf.applications.car.odometry.evaluation.evaluate_car_filter`, which does the work.
"""

from __future__ import annotations

import argparse
from contextlib import nullcontext

from torch_denkf._files import write_text
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.cli._command import Command, alone_in, filled, path, say, whole

__all__ = ["main"]


def _arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--checkpoint",
        type=filled,
        default="car-odometry",
        help="that of the library, or a folder that denkf train left",
    )
    add("--root", required=True, type=path, help="folder in KITTI's layout, with sequences/ and poses/")
    add("--drives", nargs="+", metavar="NAME", help="drives below --root; all by default")
    add("--out", type=path, help="folder for evaluation.csv and evaluation.md, and a cache of the optical flow")
    add("--camera", help="folder of the images; the first that has any by default")
    add("--size", nargs=2, type=int, metavar=("H", "W"), help="to scale images to; that of the training by default")
    add("--height", type=float, default=KITTI_HEIGHT, help="of the camera over the road, m")
    add("--pitch", type=float, default=0.0, help="how far the camera looks up, rad")
    add("--missing", type=float, default=0.0, help="share of the frames to lose")
    add("--draws", type=whole(1), default=8, help="of the filter's noise, over which errors are averaged")
    add("--window", type=whole(1), default=100, help="steps of the end point errors")
    add("--seed", type=whole(0), default=0, help="of the noise")
    add("--threads", type=whole(1), default=1, help="of torch and OpenCV")


def _run(args: argparse.Namespace) -> None:
    import cv2
    import torch

    from torch_denkf.applications.car.commands._car import load_car
    from torch_denkf.applications.car.kitti.drive import list_kitti_drives
    from torch_denkf.applications.car.odometry.evaluation import evaluate_car_filter, markdown_table, write_rows

    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    car = load_car(args.checkpoint)
    drives = args.drives or list_kitti_drives(args.root)
    if not drives:
        lacking = ", ".join(sorted(f"poses/{folder.name}.txt" for folder in (args.root / "sequences").glob("*/")))
        raise FileNotFoundError(
            f"no drive below --root {args.root} has both images and poses; expected images in sequences/NAME/image_2 "
            f"and {lacking or 'poses/NAME.txt'}"
        )
    with nullcontext() if args.out is None else alone_in(args.out):
        rows, _ = evaluate_car_filter(
            car,
            args.root,
            drives,
            cache=True if args.out is None else args.out / "cache",
            camera=args.camera,
            size=None if args.size is None else tuple(args.size),
            height=args.height,
            pitch=args.pitch,
            missing=args.missing,
            draws=args.draws,
            window=args.window,
            seed=args.seed,
        )
        table = markdown_table(rows)
        say(table)
        if args.out is not None:
            write_rows(rows, args.out / "evaluation.csv")
            write_text(args.out / "evaluation.md", f"`{args.command_line}`\n\n{table}")
            say(f"{args.out / 'evaluation.csv'}, {args.out / 'evaluation.md'}")


main = Command(
    "evaluate",
    "Errors of a trained car filter on drives with known poses, beside dead reckoning on the same readings.",
    "denkf evaluate --checkpoint runs/car --root KITTI --drives 09 10 --out runs/car/evaluation",
    _arguments,
    _run,
    resumable=True,
)

if __name__ == "__main__":
    raise SystemExit(main())
