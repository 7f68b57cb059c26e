"""Runs every pair in a separate process, one after the other, and writes the report.

python -m benchmarks.speed                      # all pairs: results/speed.{md,json}
python -m benchmarks.speed --only against_textbook packaged_step
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
#: Modules of this package: one for each peer, with rows(seconds) -> list[Row].
PAIRS = (
    "tensordict_cost",
    "against_textbook",
    "against_cuthbert",
    "against_dynamax",
    "against_filterpy",
    "against_dapper",
    "packaged_step",
    "one_row",
    "log_of_attitude",
    "training_step",
    "transform_cost",  # also a separate command
)
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
#: Number of processes, one after the other, that measure a pair whose ratio varies; the result is their median.
RUNS = {"against_cuthbert": 3}
LIMIT_S = 2400  # for a pair: four compiled filters take twenty minutes next to other jobs


def in_this_process(name: str, seconds: float, out: Path) -> None:
    """Runs one pair and writes its rows."""
    import torch

    torch.set_num_threads(1)
    torch.manual_seed(0)
    if hasattr(os, "sched_setaffinity"):  # on two cores jax moves small steps between threads, which is slower
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if name == "machine":
        from benchmarks.speed.machine import measure

        result = measure()
    else:
        result = [row.as_dict() for row in importlib.import_module(f"benchmarks.speed.{name}").rows(seconds)]
    out.write_text(json.dumps(result))


def in_own_process(name: str, seconds: float) -> list[dict] | dict:
    """Runs one pair in a new process; on failure, returns a row without a ratio, with the reason in its note."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "rows.json"
        command = [sys.executable, "-m", "benchmarks.speed", "--pair", name, str(out), "--seconds", str(seconds)]
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, **ONE_THREAD},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        try:
            _, errors = process.communicate(timeout=LIMIT_S)
        except BaseException as error:  # also Ctrl-C: compilers and workers must not outlive us
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
            errors = f"no result after {LIMIT_S} s"
        if out.exists():
            return json.loads(out.read_text())
    reason = next((line for line in reversed(errors.strip().splitlines()) if line.strip()), "no message")
    return [{"name": name.replace("_", " "), "ratio": None, "target": None, "note": f"not run: {reason.strip()}"}]


def measured(name: str, seconds: float) -> list[dict]:
    """Returns the rows of a pair; for several runs the median ratio, and the lowest and the highest as ``range``."""
    runs = [{row["name"]: row for row in in_own_process(name, seconds)} for _ in range(RUNS.get(name, 1))]
    rows = []
    for row in runs[0]:
        found = sorted((run[row] for run in runs if run.get(row, {}).get("ratio")), key=lambda row: row["ratio"])
        if not found:
            rows.append(runs[0][row])
            continue
        outer = [found[0]["ratio"], found[-1]["ratio"]] if len(runs) > 1 else None
        rows.append({**found[len(found) // 2], "range": outer})
    return rows


def smoke() -> None:
    """Runs tiny versions of the pairs that need no other package."""
    from benchmarks.speed import against_textbook, training_step, transform_cost

    transform_cost.TransformCost(smoke=True)()
    os.environ["SPEED_COMPILE"] = "0"
    for row in (*training_step.rows(0.1, 1, 2, 2), *against_textbook.rows(0.1)):
        print(row)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=12.0, help="to spend on each comparison (default: 12)")
    parser.add_argument("--only", nargs="+", default=PAIRS, choices=PAIRS, help="run these pairs, keep other rows")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results", help="folder of the results")
    parser.add_argument(
        "--no-compile", action="store_true", help="leave out compiled sequences: minutes each to compile"
    )
    parser.add_argument(
        "--plain", action="store_true", help="measure the compiled rows with plain inductor, as a column of its own"
    )
    parser.add_argument("--pair", nargs=2, metavar=("NAME", "JSON"), help="run one pair in this process")
    parser.add_argument("--smoke", action="store_true", help="a tiny run of some, nothing written: does it run?")
    args = parser.parse_args()
    if args.pair:
        in_this_process(args.pair[0], args.seconds, Path(args.pair[1]))
        return
    if args.smoke:
        smoke()
        return
    if args.no_compile:
        os.environ["SPEED_COMPILE"] = "0"
    os.environ["SPEED_PLAIN"] = "1" if args.plain else "0"
    from benchmarks.speed.report import number, write

    begun = time.perf_counter()
    machine = in_own_process("machine", args.seconds)
    names = args.only
    command = "make bench" if set(names) >= set(PAIRS) else "python -m benchmarks.speed --only " + " ".join(names)
    command += " --no-compile" * args.no_compile + " --plain" * args.plain
    known, order = args.out / "speed.json", PAIRS
    for name in names:
        print(f"{name} ...", flush=True)
        new = [{**row, "pair": name} for row in measured(name, args.seconds)]
        for row in new:
            print(f"  {row['name']}: {number(row['ratio']) or row.get('note')} (target {number(row.get('target'))})")
        # Rows of other pairs stay, and an interrupted run keeps the rows that it has measured.
        old = json.loads(known.read_text()) if known.exists() else []
        if args.plain:
            plain = {row["name"]: row["ratio"] for row in new if row["name"].startswith("compiled")}
            rows = [{**row, "plain": plain.get(row["name"], row.get("plain"))} for row in old]
        else:
            plain = {row["name"]: row.get("plain") for row in old}
            rows = [row for row in old if row.get("pair") != name]
            rows += [{**row, "plain": plain.get(row["name"])} for row in new]
        rows.sort(key=lambda row: order.index(row["pair"]) if row.get("pair") in order else len(order))
        write(rows, machine, command, time.perf_counter() - begun, args.out)


if __name__ == "__main__":
    main()
