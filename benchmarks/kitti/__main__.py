"""Visual odometry on KITTI: the paper's protocol, with every filter that is registered.

    python examples/kitti_odometry.py table --root KITTI --out runs/kitti          # leave one drive out, all conditions
    python examples/kitti_odometry.py train --root KITTI --test 09 --out runs/09   # one fold
    python examples/kitti_odometry.py evaluate --checkpoint runs/09/folds/09-denkf-flow-0 --root KITTI --test 09

KITTI is the folder with ``sequences`` and ``poses``, from cvlibs.net/datasets/kitti; without it:
``python -m torch_denkf.data.render_kitti --out KITTI``. A study that is broken off goes on where it stopped.

Every fold trains a sensor alone, then the filter on the readings that the frozen sensor makes of drives it has not
seen, then both end to end; see benchmarks.kitti/training.py. With ``--rendered N`` the sensor is first trained on N rendered
drives along invented paths, for where real drives are few. ``torchrun --nproc_per_node=2 examples/kitti_odometry.py
train ...`` trains one fold in several processes.
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

from benchmarks.kitti.folds import Part, with_disturbances
from benchmarks.kitti.recipes import FILTERS
from benchmarks.kitti.sensors import SENSORS
from benchmarks.kitti.streams import find_streams, prepare, spans
from benchmarks.kitti.study import Study, describe, evaluate_and_draw, make_jobs, prepare_jobs, read_rows, run_jobs
from benchmarks.kitti.tables import markdown, write_csv
from benchmarks.kitti.training import Budget, load_filter

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
    parser.add_argument("--checkpoint", type=Path, help="of evaluate: a folder below --out/folds")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--rendered", type=int, default=0, help="drives to render for a first training of the sensor")
    parser.add_argument("--size", type=int, nargs=2, default=(125, 414), help="rows and columns to compute the flow at")
    parser.add_argument("--processes", type=int, default=1, help="folds side by side")
    for name, value in Budget().__dict__.items():
        help = "see Budget in benchmarks.kitti/training.py"
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value), default=value, help=help)
    parser.add_argument("--smoke", action="store_true", help="a tiny run of everything, on rendered drives")
    return parser.parse_args()


def smoke(args: argparse.Namespace) -> None:
    """Everything once, on four small drives that are rendered for it."""
    folder = Path(tempfile.mkdtemp(prefix="kitti_odometry-"))
    args.root, args.out, args.size, args.seeds, args.processes = folder / "kitti", folder / "out", (50, 150), 1, 1
    names = write_drives(args.root, ["a", "b", "c", "d"], frames=60, seed=0)
    args.drives, args.test, args.sensors = names, names[:1], ["flow", "image"]
    args.sensor, args.fine_tuning, args.filter, args.end_to_end, args.length = 6, 2, 4, 3, 8


def write_table(args: argparse.Namespace, rows: list[dict], begun: float) -> None:
    """Leaves the rows as table.csv and table.md, and prints the latter."""
    write_csv(rows, args.out / "table.csv")
    minutes = (time.time() - begun) / 60
    header = f"`{' '.join(['python', *sys.argv])}`: {minutes:.0f} min, {args.processes} process(es)"
    (args.out / "table.md").write_text(markdown(rows, header))
    print((args.out / "table.md").read_text())


def table(args: argparse.Namespace, study: Study) -> None:
    """Trains and tests every filter and sensor on every fold."""
    begun = time.time()
    jobs = make_jobs(study, args.filters, args.sensors, args.seeds, args.test)
    (args.out / "settings.json").write_text(json.dumps(describe(study), indent=1))
    run_jobs(jobs, args.processes)
    write_table(args, read_rows(args.out), begun)


def train(args: argparse.Namespace, study: Study) -> None:
    """Trains filters on the folds that leave the --test drives out, without testing them."""
    jobs = make_jobs(study, args.filters, args.sensors, args.seeds, args.test)
    prepare_jobs(jobs, args.processes)
    for job in jobs:
        base = job.base()
        for name in job.filters:
            job.train(name, base)
            print(f"{job.out(name)}: evaluate --checkpoint {job.out(name)} --test {job.fold.name}")


def evaluate(args: argparse.Namespace, study: Study) -> None:
    """Tests one trained filter on any drives, those of another folder, too."""
    begun = time.time()
    if args.checkpoint is None:
        raise SystemExit("evaluate needs --checkpoint: a folder that train or table left in --out/folds")
    recipe, model, name, sensor = load_filter(args.checkpoint)
    streams = find_streams(args.root, tuple(args.size), list(args.test) or None)
    parts = with_disturbances([Part(stream) for stream in streams])
    prepare([each for part in parts for each in spans(part.stream, sensor)], study.cache, args.processes)
    names = {"filter_name": name, "kind": sensor, "seed": 0}
    write_table(args, evaluate_and_draw(recipe, model, streams, study.cache, args.out / "plots", **names), begun)


def main() -> None:
    args = parse()
    torch.set_num_threads(1)  # of small matrices; folds run side by side instead
    if args.smoke:
        smoke(args)
    if args.root is None:
        raise SystemExit("--root is missing: the folder with 'sequences' and 'poses' (or --smoke)")
    args.out.mkdir(parents=True, exist_ok=True)
    budget = Budget(**{name: getattr(args, name) for name in Budget().__dict__})
    study = Study(args.root, args.out, tuple(args.size), tuple(args.drives), args.rendered, budget, args.processes)
    {"table": table, "train": train, "evaluate": evaluate}[args.command](args, study)
    if args.smoke:
        args.checkpoint = next((args.out / "folds").iterdir())
        evaluate(args, study)


if __name__ == "__main__":
    main()
