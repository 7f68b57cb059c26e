"""Visual odometry on KITTI: the paper's protocol, with every filter that is registered.

    python examples/kitti_odometry.py table --root KITTI --out runs/kitti          # leave one drive out, all conditions
    python examples/kitti_odometry.py train --root KITTI --test 09 --out runs/09   # one fold
    python examples/kitti_odometry.py evaluate --out runs/09 --root KITTI --test 09

KITTI is the folder with ``sequences`` and ``poses``, from cvlibs.net/datasets/kitti; without it:
``python -m torch_denkf.data.render_kitti --out KITTI``. A study that is broken off goes on where it stopped.

Every fold trains a sensor alone, then the filter on the readings that the frozen sensor makes of drives it has not
seen, then both end to end; see kitti_study/training.py. With ``--rendered N`` the sensor is first trained on N rendered
drives along invented paths, for where real drives are few. ``torchrun --nproc_per_node=2 examples/kitti_odometry.py train
...`` trains one fold in several processes.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parent))  # the parts of this example, wherever it is started from

from kitti_study.evaluation import evaluate
from kitti_study.filters import FILTERS, SENSORS
from kitti_study.fold import statistics
from kitti_study.study import Study, describe, make_jobs, run_jobs
from kitti_study.tables import TITLES, markdown, pick, write_csv
from kitti_study.training import Budget, load, pretrain  # noqa: F401

from torch_denkf.data import write_drives


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", nargs="?", choices=["train", "evaluate", "table"], default="table")
    parser.add_argument("--root", type=Path, help="folder with sequences and poses")
    parser.add_argument("--out", type=Path, default=Path("runs/kitti"), help="checkpoints, logs, table and plots")
    parser.add_argument("--drives", nargs="+", default=(), help="drives of the study; all that are found")
    parser.add_argument("--test", nargs="+", default=(), help="drives to leave out, one after the other; all")
    parser.add_argument("--filters", nargs="+", default=["denkf"], choices=sorted(FILTERS))
    parser.add_argument("--sensors", nargs="+", default=["flow"], choices=sorted(SENSORS))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--rendered", type=int, default=0, help="drives to render for a first training of the sensor")
    parser.add_argument("--size", type=int, nargs=2, default=(125, 414), help="rows and columns to compute the flow at")
    parser.add_argument("--processes", type=int, default=1, help="folds side by side")
    for name, value in Budget().__dict__.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=value, help="updates (length: steps)")
    parser.add_argument("--smoke", action="store_true", help="a tiny run of everything, on rendered drives")
    return parser.parse_args()


def smoke(args: argparse.Namespace) -> None:
    """Everything once, on four small drives that are rendered for it."""
    folder = Path(tempfile.mkdtemp(prefix="kitti_odometry-"))
    args.root, args.out, args.size, args.seeds, args.processes = folder / "kitti", folder / "out", (50, 150), 1, 1
    names = write_drives(args.root, ["a", "b", "c", "d"], frames=60, seed=0)
    args.drives, args.test, args.sensors = names, names[:1], ["flow", "image"]
    args.sensor, args.fine_tuning, args.filter, args.end_to_end, args.length = 6, 2, 4, 3, 8


def main() -> None:
    args = parse()
    if args.smoke:
        smoke(args)
    if args.root is None:
        raise SystemExit("--root is missing: the folder with 'sequences' and 'poses' (or --smoke)")
    begun = time.time()
    budget = Budget(**{name: getattr(args, name) for name in Budget().__dict__})
    study = Study(args.root, args.out, tuple(args.size), tuple(args.drives), args.rendered, budget)
    jobs = make_jobs(study, args.filters, args.sensors, args.seeds, args.test)
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "settings.json").write_text(json.dumps(describe(study), indent=1))
    rows = run_jobs(jobs, args.processes)
    minutes = (time.time() - begun) / 60
    write_csv(rows, args.out / "table.csv")
    header = f"`{' '.join(['python', *sys.argv])}`: {minutes:.0f} min, {args.processes} process(es)"
    (args.out / "table.md").write_text(markdown(rows, header))
    print((args.out / "table.md").read_text())


if __name__ == "__main__":
    main()
