"""The study: its options, its rows, its table."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import head, line, report
from benchmarks.sequence07.filters import BIAS, POSE, SPACE, car_filter, pose_of, prepared
from benchmarks.sequence07.pictures import draw
from benchmarks.sequence07.task import CONDITIONS, ROWS, chained, naive, readings, truth
from torch_denkf import Filter
from torch_denkf.applications.car.metrics.devkit import kitti_devkit_error
from torch_denkf.functional.manifolds import SE3
from torch_denkf.smoothers import EnRTS, RTSSmoother

LEVEL = 0.9  # of the intervals
STEPS = (1, 10, 100)  # rows of the relative motions
EVERY = 40  # rows between two starts of relative motions
HELD = tuple(f"held_{step}" for step in STEPS)
DRAWS = 5  # of an ensemble
SPREADS = ("translation_spread", "rotation_spread")  # standard deviation over draws
SCORES = ("translation", "rotation", *HELD, "ms", *SPREADS)


@dataclass(frozen=True)
class Study:
    """Measures the path error of a car with stereo corners and turn rates, on KITTI's odometry sequence 07."""

    data: Path = Path("../shared/data")  # with kitti_inertial/0027.npz and kitti/poses/07.txt
    out: Path | None = None  # folder for sequence07.csv, sequence07.md and sequence07.png
    seed: int = 0
    ukf: bool = False  # also the UKF, whose results equal the EKF's
    smoke: bool = False  # a few rows and filters: does it run?


class Claim(NamedTuple):
    """Relative motions by a filter, with their variances and the truth.

    Attributes:
        mean: points of SE3, ``[*B, K, 7]``.
        var: of their tangents ``[*B, K, 6]``.
        truth: ``[*B, K, 7]``.
    """

    mean: Tensor
    var: Tensor
    truth: Tensor

    def away(self) -> Tensor:
        """Returns the tangent's errors, in standard deviations, ``[*B, K, 6]``."""
        return SE3().minus(self.truth, self.mean) / self.var.sqrt()

    def held(self, level: float = LEVEL) -> Tensor:
        """Returns the coverage of the tangent's intervals at a level, ``[K]``."""
        inside = self.away().abs() <= NormalDist().inv_cdf((1 + level) / 2)
        return inside.double().mean(-1).flatten(0, -2).mean(0)


def windows(data: TensorDict, states: Tensor, poses: Tensor) -> tuple[TensorDict, Tensor]:
    """Returns windows that start from a known pose.

    Args:
        data: a filter's inputs, ``[C, T]``.
        states: means of a filter over the whole drive, ``[C, T, 26]``. A window starts from its twist.
        poses: true poses ``[T, 7]``.

    Returns:
        A filter's inputs in each window, ``[C, W, K]`` with K two more than the last of ``STEPS``, and the true
        motions since the start ``[W, K, 7]``.
    """
    length = STEPS[-1] + 2
    first = torch.arange(EVERY, data.shape[1] - length + 1, EVERY)
    rows = first.unsqueeze(-1) + torch.arange(length)
    origin = SPACE.neutral(states).expand(len(states), len(first), -1).clone()
    origin[..., POSE.stop : BIAS.stop] = states[:, first, POSE.stop : BIAS.stop]
    part = prepared(data[:, rows], start=origin)
    for key in ("motion_observed", "gyro_observed"):  # the first reading is in the initial belief already
        part[key] = part[key].clone()
        part[key][:, :, 0] = False
    true = poses[rows]
    return part, SE3().compose(SE3().inverse(true[:, :1]).expand_as(true), true)


def claimed(out: TensorDict, true: Tensor, prefix: str = "belief") -> Claim:
    """Returns a filter's relative motions in windows ``[W, K]``, over each of ``STEPS``."""
    mean, var = pose_of(out, prefix)
    at = torch.tensor(STEPS)
    return Claim(mean[:, at], var[:, at], true[:, at])


@torch.no_grad()
def run(model: Filter, data: TensorDict) -> TensorDict:
    """Runs a filter with a fixed seed, and returns the entries that the study needs."""
    torch.manual_seed(0)
    wanted = {("belief", "mean"), ("forecast", "mean"), ("forecast", "cov"), ("forecast", "ensemble")}
    return model.sequence(data.clone(), keep=[key for key in model.out_keys if key in wanted])


def and_one_more(data: TensorDict) -> TensorDict:
    """Appends a row without readings: ``[C, T + 1]``."""
    last = data[:, -1:].clone()
    for key in ("motion_observed", "gyro_observed"):
        last[key] = torch.zeros_like(last[key])
    return torch.cat([data, last], 1)


def filter_rows(
    label: str, kind: str, data: TensorDict, poses: Tensor, smoother: str = "", **options
) -> Iterator[tuple[dict, Tensor, Claim]]:
    """Yields rows, paths ``[T, 7]`` and relative motions for each condition, of a filter and of its smoother if named.

    An ensemble's row is the mean over ``DRAWS``; the path is that of the first draw.
    """
    around = EnRTS if kind == "DEnKF" else RTSSmoother
    draws = DRAWS if kind == "DEnKF" else 1
    models = [car_filter(kind, again=again, **options) for again in (False, True)]
    some = prepared(data[:1, :50])
    began = time.process_time()
    run(models[0], some)
    ms = 1e3 * (time.process_time() - began) / some.shape[1]
    if smoother:
        models = [around(model) for model in models]
    named = {"belief": label, "smoothed": smoother} if smoother else {"belief": label}
    data = torch.cat([data] * draws)
    out = run(models[0], prepared(and_one_more(data)))
    part, true = windows(data, out["belief", "mean"], poses)
    found = run(models[1], part.flatten(0, 1)).unflatten(0, part.shape[:2])
    for number, condition in enumerate(CONDITIONS):
        for prefix, name in named.items():
            each = slice(number, None, len(CONDITIONS))
            paths = pose_of(out[each], prefix)[0]
            claim = claimed(found[each].flatten(0, 1), true.repeat(draws, 1, 1), prefix)
            drifts = torch.tensor([list(drift(path, poses).values()) for path in paths])
            row = {"condition": condition, "filter": name}
            row |= dict(zip(("translation", "rotation"), drifts.mean(0).tolist(), strict=True))
            if draws > 1:
                row |= dict(zip(SPREADS, drifts.std(0).tolist(), strict=True))
            row |= dict(zip(HELD, claim.held().tolist(), strict=True))
            yield row if prefix == "smoothed" else {**row, "ms": ms}, paths[0], claim


def drift(path: Tensor, poses: Tensor) -> dict[str, float]:
    """Returns the official errors: % and degrees in 100 m."""
    error = kitti_devkit_error(path, poses)
    return {"translation": error.translation.item(), "rotation": 100 * error.rotation.item()}


def alone(study: Study, data: TensorDict, poses: Tensor, count: int) -> Iterator[tuple[dict, Tensor]]:
    """Yields rows and paths of chained motions without a filter, with zero-order hold for missing motions."""
    for number, condition in enumerate(CONDITIONS):
        seen = data[number]["motion_observed"].squeeze(-1)
        motions, found = naive(study.data, "0027", condition, count, study.seed)
        for label, steps, there in (
            ("OpenCV, RANSAC", motions, found & seen),
            ("corners' motion alone", data[number]["motion"], seen),
        ):
            path = chained(steps, there, data[number]["dt"])
            yield {"condition": condition, "filter": label, **drift(path, poses)}, path


def page(rows: Sequence[dict], count: int) -> str:
    """Returns the table."""
    lines = [
        "# Sequence 07 of KITTI",
        "",
        f"Odometry sequence 07, {count} rows: stereo corners and turn rates. Errors are KITTI's own, in six "
        f"dimensions, over 100 to 800 m. *Coverage*: the share of errors within the {LEVEL:.0%} intervals, for "
        f"the six components of the motion over 1, 10 and 100 rows; a reset every {EVERY} rows. Rows of ensembles are "
        f"means over {DRAWS} seeds, with their standard deviation.",
    ]
    titles = ("filter", "translation, %", "rotation, deg/100 m", *(f"coverage, {step}" for step in STEPS), "ms per row")
    for condition in CONDITIONS:
        lines += ["", f"## {condition.capitalize()}", "", *head(*titles)]
        for row in rows:
            if row["condition"] == condition:
                digits = {"translation": 2, "rotation": 2, **dict.fromkeys(HELD, 2), "ms": 1}
                numbers = [f"{row[key]:.{places}f}" if key in row else "" for key, places in digits.items()]
                for at, spread in enumerate(SPREADS):
                    numbers[at] += f" ± {row[spread]:.2f}" if spread in row else ""
                lines.append(line(row["filter"], *numbers))
    lines += [
        "",
        "*Dropout*: no corners for 10 rows in each 100. *Outliers*: 20 % of the corners of the later row have an error "
        "of up to 30 pixels, different in both images.",
        "",
        "Milliseconds are processor time for one row of one drive, not compiled, one thread. The estimation of the "
        "corners' motion is not included.",
        "",
        *made_by("sequence07"),
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Runs the study."""
    study = parse(Study)
    torch.set_default_dtype(torch.float64)
    torch.manual_seed(study.seed)
    count = 250 if study.smoke else ROWS
    poses = truth(study.data, count)
    data = readings(study.data, "0027", CONDITIONS, count, study.seed)
    rows, paths, claims = [], {}, {}
    models = [("EKF", "EKF", "RTS smoother", {})]
    if study.ukf:
        models.append(("UKF", "UKF", "", {}))
    models.append(("DEnKF, 32 members", "DEnKF", "", {"members": 32}))
    models.append(("DEnKF, 32 members, no slip", "DEnKF", "", {"members": 32, "slip": False}))
    models.append(("DEnKF, 64 members", "DEnKF", "EnRTS, 64 members", {"members": 64}))
    for row, path in alone(study, data, poses, count):
        rows.append(row)
        paths[row["condition"], row["filter"]] = path
    for label, kind, smoother, options in models[:1] if study.smoke else models:
        for row, path, claim in filter_rows(label, kind, data, poses, smoother, **options):
            rows.append(row)
            paths[row["condition"], row["filter"]], claims[row["condition"], row["filter"]] = path, claim
    for row in rows:
        print({key: f"{value:.3g}" if isinstance(value, float) else value for key, value in row.items()}, flush=True)
    report(study.out, rows, page(rows, count), "sequence07")
    if study.out is not None:
        draw(paths, claims, poses, STEPS, study.out / "sequence07.png")
