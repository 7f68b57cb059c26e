"""The study: its options, its rows, its table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.attitude.baselines import error_state_filter, integrate, mahony
from benchmarks.attitude.task import DT, Sensors, simulated, tilt_error, walking
from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import Columns, head, line, write_page
from torch_denkf.functional.manifolds import SO3, rotate, skew

SETTLED = 5.0  # s of a simulated run that are not scored
STEADY = slice(50, 1168)  # rows of iCub's log that are scored; studies of its velocity leave the ends out, too
PULLS = (0.1, 0.2, 0.5, 1.0)  # 1/s; Mahony's integral gain is a twentieth of it
#: In rad, of one reading: the accelerometer's direction is off while the body is pushed, for many rows in the same way.
UP_NOISES = (0.3, 1.0, 3.0)
#: rad/s/sqrt(Hz): the data sheet's; of iCub set by us, because the times of its rows jitter by milliseconds.
GYRO_NOISES = {"simulated": Sensors().gyro_noise, "iCub": 5e-3}
COLUMNS = Columns(
    names=("data", "filter", "setting", "tilt", "largest", "claimed"),
    text=("data", "filter"),
    whole=(),
    order=lambda row: (row["data"], row["filter"], row.get("setting", 0.0)),
)


@dataclass(frozen=True)
class Study:
    """Which way is up, by a gyro and an accelerometer?"""

    out: Path | None = None  # folder for attitude.csv and attitude.md
    icub: Path = Path("../shared/data/icub")  # with walking.npz and model.urdf; left out where they are missing
    runs: int = 8  # simulated
    seconds: float = 60.0  # of a simulated run
    seed: int = 0
    smoke: bool = False  # one short run: does it run?


def scores(orientation: Tensor, data: TensorDict, rows: slice, cov: Tensor | None = None) -> dict[str, float]:
    """Root mean square and largest error of the tilt, in degrees, and what a filter claims it to be.

    Args:
        orientation: ``[R, T, 4]``.
        data: with the true ``"orientation"``.
        rows: that are scored.
        cov: of the orientation's error ``[R, T, 3, 3]``, turns about the body's axes.
    """
    error = tilt_error(orientation, data["orientation"].to(orientation))[:, rows].rad2deg()
    found = {"tilt": error.square().mean().sqrt().item(), "largest": error.max().item()}
    if cov is not None:
        up = skew(rotate(SO3().inverse(orientation), torch.tensor([0.0, 0.0, 1.0]).to(orientation)))
        variance = (up @ cov @ up.mT).diagonal(dim1=-2, dim2=-1).sum(-1)
        found["claimed"] = variance[:, rows].mean().sqrt().rad2deg().item()
    return found


def baseline_rows(name: str, data: TensorDict, rows: slice) -> Iterator[dict]:
    """Of filters in plain numpy, which start from the true orientation of the first row and know of no bias."""
    log = {key: data[key].double().numpy() for key in ("gyro", "accelerometer", "dt", "orientation")}
    inputs = log["gyro"], log["accelerometer"], log["dt"], log["orientation"][:, 0]

    def scored(label: str, orientation, cov=None, **setting) -> dict:
        found = scores(torch.as_tensor(orientation), data, rows, cov)
        return {"data": name, "filter": label, **setting, **found}

    yield scored("gyro alone", integrate(inputs[0], *inputs[2:]))
    for pull in PULLS:
        yield scored("Mahony", mahony(*inputs, proportional=pull, integral=pull / 20), setting=pull)
    for up_noise in UP_NOISES:
        noises = GYRO_NOISES[name], Sensors().gyro_walk, up_noise
        orientation, _, cov = error_state_filter(*inputs, *noises)
        yield scored("error-state EKF", orientation, torch.as_tensor(cov)[..., :3, :3], setting=up_noise)


def page(rows: list[dict], study: Study) -> str:
    """The table."""
    lines = [
        "# Which way is up",
        "",
        f"Error of the tilt, the angle between where up is and where it is thought to be. Simulated: {study.runs} runs "
        f"of {study.seconds:g} s, without their first {SETTLED:g} s. iCub: a walk of 12 s. All filters read gyro and "
        "accelerometer, and nothing else.",
        "",
        *head("data", "filter", "setting", "root mean square, deg", "largest, deg", "claimed, deg"),
    ]
    for row in rows:
        numbers = [f"{row[key]:.2f}" if key in row else "" for key in ("tilt", "largest", "claimed")]
        lines.append(line(row["data"], row["filter"], f"{row['setting']:g}" if "setting" in row else "", *numbers))
    lines += [
        "",
        "The setting of Mahony's filter is its pull towards the accelerometer's up, in 1/s; of the Kalman filter, the "
        "standard deviation of a reading of up, in rad. All settings that were tried are in the table.",
        "",
        *made_by("attitude"),
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Runs the study."""
    study = parse(Study)
    if study.smoke:
        study = replace(study, runs=1, seconds=1.0)
    settled = min(round(SETTLED / DT), round(study.seconds / DT) // 2)
    logs = {"simulated": (simulated(study.runs, study.seconds, study.seed), slice(settled, None))}
    if (study.icub / "walking.npz").exists() and not study.smoke:
        logs["iCub"] = walking(study.icub), STEADY
    rows = [row for name, (data, scored) in logs.items() for row in baseline_rows(name, data, scored)]
    if study.out is not None:
        study.out.mkdir(parents=True, exist_ok=True)
        COLUMNS.write(rows, study.out / "attitude.csv")
    write_page(page(rows, study), None if study.out is None else study.out / "attitude.md")
