"""A UR5 that one camera watches: joints, gripper and end effector, with every filter that is registered.

    python examples/ur5_manipulation.py collect --processes 2      # demos into --root, by default runs/ur5-demos
    python examples/ur5_manipulation.py --out runs/ur5             # collects what is missing, trains, tests: table.md
    python examples/ur5_manipulation.py --filters denkf --sensors glimpse --trainings sim
    python examples/ur5_manipulation.py pictures --out runs/ur5    # videos with ghosts, joints, paths, ensemble sizes

A sensor is trained on 16 frames each of many demos; a motion on true states; then each filter on the readings that the
frozen sensor makes of whole demos it has not seen, and at last together with the sensor's head. ``real_like`` is a
stand-in for a real arm: there the study compares 20 demos alone, the simulator's weights as they are, and these
fine-tuned on the 20. What is broken off goes on where it stopped. Beliefs of some test demos are left in --out/beliefs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parent))  # the parts of this example, wherever it is started from

from benchmarks.ur5.demos import Collections
from benchmarks.ur5.gallery import draw_all
from benchmarks.ur5.recipes import FILTERS
from benchmarks.ur5.sensors import SENSORS
from benchmarks.ur5.study import TRAININGS, Study, read_rows, run_jobs
from benchmarks.ur5.tables import markdown, write_csv
from benchmarks.ur5.training import Budget


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", nargs="?", choices=["collect", "table", "pictures"], default="table")
    parser.add_argument("--root", type=Path, default=Path("runs/ur5-demos"), help="folder of the demos")
    parser.add_argument("--out", type=Path, default=Path("runs/ur5"), help="checkpoints, logs, table, beliefs")
    parser.add_argument("--filters", nargs="+", default=sorted(FILTERS), choices=sorted(FILTERS))
    parser.add_argument("--sensors", nargs="+", default=["glimpse", "paper"], choices=sorted(SENSORS))
    parser.add_argument("--trainings", nargs="+", default=list(TRAININGS), choices=TRAININGS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--size", type=int, default=224, help="side of the pictures in pixels")
    parser.add_argument("--demos", type=int, default=2000, help="in the simulator, few frames each")
    parser.add_argument("--sequences", type=int, default=220, help="of these, whole")
    parser.add_argument("--real", type=int, default=130, help="demos of real_like, whole")
    parser.add_argument("--processes", type=int, default=1, help="that collect")
    for name, value in Budget().__dict__.items():
        help = "see Budget in benchmarks.ur5/training.py"
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value), default=value, help=help)
    parser.add_argument("--smoke", action="store_true", help="a tiny run of everything")
    return parser.parse_args()


def smoke(args: argparse.Namespace) -> dict:
    """Everything once, on few short demos with small pictures."""
    folder = Path(tempfile.mkdtemp(prefix="ur5_manipulation-"))
    args.root, args.out, args.size = folder / "demos", folder / "out", 32
    args.demos, args.sequences, args.real = 12, 10, 10  # of these 9 is the first that is tested on
    args.sensors = ["glimpse", "paper"]
    args.sensor, args.fine_tuning, args.motion, args.filter, args.end_to_end = 3, 2, 5, 2, 1
    args.length, args.batch = 6, 4
    return {"frames": 2, "steps": 30, "real_train": 9}


def main() -> None:
    args = parse()
    torch.set_num_threads(1)  # of small matrices
    if args.command == "pictures" and not args.smoke:
        for file in draw_all(args.out):
            print(file)
        return
    extra = smoke(args) if args.smoke else {}
    collections = Collections(
        args.root, args.out / "cache", args.size, args.demos, sequences=args.sequences, real=args.real
    )
    collections, begun = replace(collections, **extra), time.time()
    try:
        collections.collect(args.processes, real=args.command == "collect" or args.trainings != ["sim"])
    except (ImportError, RuntimeError) as error:
        if not args.smoke:
            raise
        print(f"skipped: no demos without OpenGL and mujoco: {error}")
        return
    if args.command == "collect":
        return
    budget = Budget(**{name: getattr(args, name) for name in Budget().__dict__})
    study = Study(collections, args.out, budget, **({"sizes": (4, 8)} if args.smoke else {}))
    for seed in args.seeds:
        for kind in args.sensors:
            first = kind == args.sensors[0]
            trainings = [name for name in args.trainings if first or name == "sim"]
            for training in trainings:  # all filters with the first sensor in the simulator, DEnKF everywhere
                chosen = [name for name in args.filters if name == "denkf" or (first and training == "sim")]
                run_jobs(study, chosen, kind, training, seed, changed=first and len(trainings) > 1)
    rows = read_rows(args.out)
    write_csv(rows, args.out / "table.csv")
    header = f"`{' '.join(['python', *sys.argv])}`: {(time.time() - begun) / 60:.0f} min"
    (args.out / "table.md").write_text(markdown(rows, header))
    print((args.out / "table.md").read_text())
    if args.smoke:
        print(*draw_all(args.out))


if __name__ == "__main__":
    main()
