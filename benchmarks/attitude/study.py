"""The study: its options, its rows, its table."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import NormalDist
from typing import Literal

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.attitude.baselines import error_state_filter, integrate, mahony
from benchmarks.attitude.filters import GivenNoise, attitude_filter, inertial_filter, prepared
from benchmarks.attitude.pictures import draw
from benchmarks.attitude.task import DT, Sensors, simulated, tilt_error, walking
from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import head, line, records, write_page, write_table
from torch_denkf.functional import crps_gaussian
from torch_denkf.functional.manifolds import SO3, rotate, rotation_matrix
from torch_denkf.modules import DiagonalNoise, SubModel
from torch_denkf.smoothers import EnRTS, RTSSmoother

SETTLED = 5.0  # s of a simulated run that are not scored
STEADY = slice(50, 1168)  # rows of iCub's log that are scored, without its ends, as in studies of its velocity
PULLS = (0.1, 0.2, 0.5, 1.0)  # 1/s; Mahony's integral gain is a twentieth of it
#: Rad, of one reading of the accelerometer's direction. They are large, because its errors last for many rows.
UP_NOISES = (0.3, 0.5, 1.0, 2.0)
#: m/s, of one of ten zero-velocity readings per second. They are large, because a velocity lasts for many of them.
REST_NOISES = (1.0, 2.0, 3.0, 5.0)
#: rad/s/sqrt(Hz): the data sheet's; for iCub set by us, because the times of its rows jitter by milliseconds.
GYRO_NOISES = {"simulated": Sensors().gyro_noise, "iCub": 5e-3}
LEVEL = 0.9  # of the intervals
SCORES = ("tilt", "largest", "full", "claimed", "nees", "held", "ms")
KEYS = ("data", "reads", "filter")
IMU, PLACE = "gyro, accelerometer", "and that it stays about a place"
COMPASS, FEET = "and a magnetometer", "and the standing foot"
READS = [IMU, PLACE, COMPASS, f"{PLACE}, {COMPASS}", FEET]
#: Name, kind and members of the filters of several sensors.
FUSED = (
    ("FusedFilter, EKF", "EKF", 64),
    ("FusedFilter, DEnKF, 32 members", "etkf", 32),
    ("FusedFilter, DEnKF, 64 members", "etkf", 64),
)


@dataclass(frozen=True)
class Study:
    """Estimates the tilt of a body from a gyro and an accelerometer."""

    out: Path | None = None  # folder for attitude.csv, attitude.md and attitude.png
    icub: Path = Path("../shared/data/icub")  # with walking.npz and model.urdf; skipped if they are missing
    runs: int = 24  # simulated
    seconds: float = 20.0  # of a simulated run
    updates: int = 25  # of the learned noise
    seed: int = 0
    only: str = ""  # run only filters whose name begins so, with the settings of attitude.csv; other rows stay
    data: tuple[Literal["simulated", "iCub"], ...] = ("simulated", "iCub")  # rows of the others stay, with only
    smoke: bool = False  # one short run: does it run?


def scores(orientation: Tensor, data: TensorDict, rows: slice, cov: Tensor | None = None) -> dict[str, float]:
    """Returns errors in degrees, and their consistency with a filter's covariance.

    Args:
        orientation: ``[R, T, 4]``.
        data: with the true ``"orientation"``.
        rows: to score.
        cov: of the orientation's error ``[R, T, 3, 3]``, rotations about the body's axes.

    Returns:
        ``"tilt"`` and ``"full"``, root mean square errors of the tilt and of the orientation; ``"largest"``, of the
        tilt. With a covariance ``"claimed"``, the root of its mean for the tilt; ``"nees"``, the tilt's squared error
        in its units over its expectation; ``"held"``, the share within the intervals of the tilt about x and about y.
    """
    truth = SO3().normalise(data["orientation"].to(orientation))
    error = tilt_error(orientation, truth)[:, rows].rad2deg()
    found = {"tilt": error.square().mean().sqrt().item(), "largest": error.max().item()}
    found["full"] = SO3().distance(orientation, truth)[:, rows].square().mean().sqrt().rad2deg().item()
    if cov is not None:
        to_world = rotation_matrix(orientation[:, rows]).double()
        away = (to_world @ SO3().minus(truth, orientation)[:, rows].double().unsqueeze(-1))[..., :2, :]
        cov = (to_world @ cov[:, rows].double() @ to_world.mT)[..., :2, :2]
        variance = cov.diagonal(dim1=-2, dim2=-1)
        found["claimed"] = variance.sum(-1).mean().sqrt().rad2deg().item()
        found["nees"] = (away.mT @ torch.linalg.solve(cov, away)).mean().item() / 2
        half = NormalDist().inv_cdf((1 + LEVEL) / 2) * variance.sqrt()
        found["held"] = (away.squeeze(-1).abs() <= half).double().mean().item()
    return found


def baseline_rows(name: str, data: TensorDict, rows: slice) -> Iterator[dict]:
    """Yields rows of filters in plain numpy, which start from the first row's true orientation and zero bias."""
    log = {key: data[key].double().numpy() for key in ("gyro", "accelerometer", "dt", "orientation")}
    inputs = log["gyro"], log["accelerometer"], log["dt"], log["orientation"][:, 0]

    def scored(label: str, orientation, cov=None, **setting) -> dict:
        found = scores(torch.as_tensor(orientation), data, rows, cov)
        return {"data": name, "reads": IMU, "filter": f"{label}, numpy", **setting, **found}

    yield scored("gyro alone", integrate(inputs[0], *inputs[2:]))
    for pull in PULLS:
        yield scored("Mahony", mahony(*inputs, proportional=pull, integral=pull / 20), setting=pull)
    for up_noise in UP_NOISES:
        noises = GYRO_NOISES[name], Sensors().gyro_walk, up_noise
        orientation, _, cov = error_state_filter(*inputs, *noises)
        yield scored("error-state EKF", orientation, torch.as_tensor(cov)[..., :3, :3], setting=up_noise)


def belief_of(out: TensorDict, prefix: str = "belief") -> tuple[Tensor, Tensor]:
    """Returns orientations ``[R, T, 4]`` and their covariances ``[R, T, 3, 3]``, from moments or members."""
    mean = out[prefix, "mean"][..., :4]
    if "cov" in out[prefix]:
        return mean, out[prefix, "cov"][..., :3, :3]
    away = SO3().minus(out[prefix, "ensemble"][..., :4], mean.unsqueeze(-2))
    return mean, away.mT @ away / (away.shape[-2] - 1)


@torch.no_grad()
def run(model: nn.Module, data: TensorDict, prefix: str = "belief") -> tuple[Tensor, Tensor, float]:
    """Returns orientations, their covariances, and processor milliseconds per step of all runs at once."""
    torch.manual_seed(0)
    began = time.process_time()
    out = model.sequence(data.clone())
    return *belief_of(out, prefix), 1e3 * (time.process_time() - began) / data.shape[1]


def library_rows(
    name: str,
    data: TensorDict,
    rows: slice,
    up_noise: float,
    rest_noise: float,
    learned: SubModel,
    smoke: bool = False,
    only: str = "",
) -> Iterator[dict]:
    """Yields rows of the library's filters and smoothers; an empty row for each name that ``only`` excludes.

    Args:
        name: of the data.
        data: of :func:`prepared`.
        rows: to score.
        up_noise: standard deviation of the accelerometer's direction, in rad.
        rest_noise: standard deviation of the zero-velocity reading, in m/s.
        learned: the noise of the accelerometer's direction that :func:`learned_noise` trained.
        smoke: run only a few of them.
        only: first characters of the names to run.
    """
    gyro = GYRO_NOISES[name]

    def scored(reads: str, label: str, model: nn.Module, prefix: str = "belief", **setting) -> dict:
        if not label.startswith(only):
            return {}
        orientation, cov, ms = run(model, data, prefix)
        return {
            "data": name,
            "reads": reads,
            "filter": label,
            **setting,
            **scores(orientation, data, rows, cov),
            "ms": ms,
        }

    up = {"setting": up_noise}
    for kind in ("EKF", "UKF"):
        yield scored(IMU, kind, attitude_filter(kind, gyro, up_noise), **up)
    learns = attitude_filter("EKF", gyro, learned)
    yield scored(IMU, "EKF, learned noise", learns)
    for members in (32,) if smoke else (32, 64):
        yield scored(IMU, f"DEnKF, {members} members", attitude_filter("etkf", gyro, up_noise, members=members), **up)
    yield scored(IMU, "RTS smoother", RTSSmoother(attitude_filter("EKF", gyro, up_noise)), "smoothed", **up)
    yield scored(IMU, "RTS smoother, learned noise", RTSSmoother(learns), "smoothed")
    if smoke:
        return
    yield scored(IMU, "EnRTS, 64 members", EnRTS(attitude_filter("etkf", gyro, up_noise)), "smoothed", **up)
    rest = {"setting": rest_noise}
    for label, kind, members in FUSED:
        yield scored(PLACE, label, inertial_filter(kind, gyro, rest_noise, members=members), **rest)
    model = RTSSmoother(inertial_filter("EKF", gyro, rest_noise))
    yield scored(PLACE, "RTS smoother", model, "smoothed", **rest)
    if "magnetometer" in data:
        for label, kind, members in FUSED:
            model = attitude_filter(kind, gyro, up_noise, members=members, magnetometer=True)
            yield scored(COMPASS, label, model, **up)
        for label, kind, members in FUSED:
            model = inertial_filter(kind, gyro, rest_noise, members=members, magnetometer=True)
            yield scored(f"{PLACE}, {COMPASS}", label, model, **rest)
    if "leg" in data:
        for label, kind, members in FUSED:
            yield scored(FEET, label, inertial_filter(kind, gyro, rest_noise, members=members, feet=True))
        model = RTSSmoother(inertial_filter("EKF", gyro, rest_noise, feet=True))
        yield scored(FEET, "RTS smoother", model, "smoothed")


def chosen(make: Callable, noises: Sequence[float], data: TensorDict, rows: slice) -> float:
    """Returns the standard deviation with the least root mean square tilt; all are tried at once."""
    several = torch.cat([data] * len(noises))
    several["std"] = torch.tensor(noises).repeat_interleave(len(data)).reshape(-1, 1, 1).expand(*several.shape, 1)
    orientation, _, _ = run(make("EKF", GYRO_NOISES["simulated"], GivenNoise()), several)
    parts = zip(orientation.chunk(len(noises)), noises, strict=True)
    tilts = {noise: scores(part, data, rows)["tilt"] for part, noise in parts}
    print(f"{make.__name__}, validation:", {noise: round(tilt, 2) for noise, tilt in tilts.items()}, flush=True)
    return min(tilts, key=tilts.__getitem__)


def learned_noise(data: TensorDict, up_noise: float, updates: int, window: int = 250) -> DiagonalNoise:
    """Returns the accelerometer's direction noise as a network of the reading, trained through the EKF.

    The score is the CRPS of the tilt about x and about y, which are tangents at the filter's mean.

    Args:
        data: of :func:`prepared`.
        up_noise: standard deviation before training, in rad.
        updates: each by one window of all runs.
        window: rows.
    """
    loc, scale = data["features"].mean((0, 1)), data["features"].std((0, 1))
    noise = DiagonalNoise(3, r=up_noise, in_features=3, floor=1e-3, loc=loc, scale=scale, in_key="features")
    model = attitude_filter("EKF", GYRO_NOISES["simulated"], noise)
    space, std = model.initial.space, model.initial.std
    optimiser = torch.optim.Adam(noise.parameters(), lr=0.02)
    for update in range(updates):
        first = int(torch.randint(data.shape[1] - window + 1, ()))
        part = data[:, first : first + window].clone()
        start = part["attitude"][:, 0]
        start[:, 4:] = part["gyro_bias"][:, 0]
        start = space.perturb(start, std, torch.randn(len(data), space.tangent_dim))
        part["attitude"] = start.unsqueeze(1).expand_as(part["attitude"])
        orientation, cov = belief_of(model.sequence(part))
        to_world = rotation_matrix(orientation)
        away = rotate(orientation, SO3().minus(SO3().normalise(part["orientation"]), orientation))[..., :2]
        variance = (to_world @ cov @ to_world.mT).diagonal(dim1=-2, dim2=-1)[..., :2]
        loss = crps_gaussian(torch.zeros_like(away), variance, away)[:, 1:].mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if update % 5 == 0 or update == updates - 1:
            print(f"learned noise, update {update}: CRPS {loss.rad2deg().item():.3f} degrees", flush=True)
    return noise.requires_grad_(False)


def picture(data: TensorDict, pull: float, path: Path) -> None:
    """Draws roll and pitch of iCub's walk, by an EKF that reads the standing foot, and by Mahony's filter."""
    model = inertial_filter("EKF", GYRO_NOISES["iCub"], REST_NOISES[0], feet=True)
    orientation, cov, _ = run(model, prepared(data))
    log = [data[key].double().numpy() for key in ("gyro", "accelerometer", "dt", "orientation")]
    other = torch.as_tensor(mahony(*log[:3], log[3][:, 0], proportional=pull, integral=pull / 20))
    draw(data[0], orientation[0], cov[0], other[0], path, name="EKF with the standing foot", level=LEVEL)


def page(rows: list[dict], study: Study) -> str:
    """Returns the results page."""
    lines = [
        "# Attitude from an inertial sensor",
        "",
        "Tilt is the angle between where up is and where it is thought to be; orientation is the angle of the whole "
        f"error, heading included. Root mean squares. Simulated: {study.runs} runs of {study.seconds:g} s, without "
        f"their first {SETTLED:g} s. iCub: a walk of 12 s. NEES is the squared error of the tilt in units of the "
        f"filter's covariance, over its expectation: above 1 a filter is too sure. The {LEVEL:.0%} intervals are those "
        "of the tilt about x and about y.",
    ]
    titles = ("filter", "setting", "tilt, deg", "largest, deg", "orientation, deg", "NEES", "coverage", "ms per step")
    for data, reads in dict.fromkeys((row["data"], row["reads"]) for row in rows):
        lines += ["", f"## {data}: {reads}", "", *head(*titles)]
        for row in rows:
            if (row["data"], row["reads"]) == (data, reads):
                digits = {"tilt": 2, "largest": 1, "full": 1, "nees": 2, "held": 2, "ms": 1}
                numbers = [f"{row[key]:.{places}f}" if key in row else "" for key, places in digits.items()]
                lines.append(line(row["filter"], f"{row['setting']:g}" if "setting" in row else "", *numbers))
    lines += [
        "",
        "The setting of Mahony's filter is its pull towards the accelerometer's up, in 1/s; of filters that read up, "
        "the standard deviation of one reading, in rad; of those that are told that the body stays about a place, the "
        "standard deviation of a velocity that is read to be zero, in m/s. The library's filters have one setting, "
        "chosen on simulated runs that are not in the table. All settings of the baselines are in it.",
        "",
        "Ensembles draw exactly.",
        "",
        "Milliseconds are those of the processor for a step of all runs at once, without compilation, one thread.",
        "",
        *made_by("attitude"),
    ]
    return "\n".join(lines) + "\n"


def found_settings(study: Study, settled: slice) -> tuple[float, float, DiagonalNoise]:
    """Returns both settings, chosen on other runs, and the learned noise."""
    others = study.runs // 3 + 1
    validation = prepared(simulated(others, study.seconds, study.seed + 1))
    up_noise = chosen(attitude_filter, UP_NOISES[-2:] if study.smoke else UP_NOISES, validation, settled)
    rest_noise = REST_NOISES[0] if study.smoke else chosen(inertial_filter, REST_NOISES, validation, settled)
    training = prepared(simulated(3 * others, min(study.seconds, 10.0), study.seed + 2))
    return up_noise, rest_noise, learned_noise(training, up_noise, study.updates, min(250, training.shape[1]))


def main() -> None:
    """Runs the study."""
    study = parse(Study)
    if study.smoke:
        study = replace(study, runs=1, seconds=1.0, updates=1)
    torch.set_num_threads(1)
    torch.manual_seed(study.seed)
    settled = slice(min(round(SETTLED / DT), round(study.seconds / DT) // 2), None)
    logs = {"simulated": (partial(simulated, study.runs, study.seconds, study.seed), settled)}
    if (study.icub / "walking.npz").exists() and not study.smoke:
        logs["iCub"] = partial(walking, study.icub), STEADY
    rows: list[dict] = []
    if study.only:
        rows = records(study.out / "attitude.csv")
        settings = {
            row["reads"]: row["setting"]
            for row in rows
            if row["filter"] in ("EKF", "FusedFilter, EKF") and "setting" in row
        }
        options = settings[IMU], settings[PLACE], GivenNoise()
    else:
        options = found_settings(study, settled)
    for name, (make, scored) in logs.items():
        if name not in study.data:
            continue
        data = make()
        if not study.only:
            rows += baseline_rows(name, data, scored)
        for row in library_rows(name, prepared(data), scored, *options, study.smoke, study.only):
            if not row:
                continue
            rows = [other for other in rows if any(other[key] != row[key] for key in KEYS)] + [row]
            numbers = {key: f"{row[key]:.3g}" for key in SCORES}
            print(name, row["reads"], row["filter"], numbers, flush=True)
    rows.sort(key=lambda row: (row["data"] == "iCub", READS.index(row["reads"])))
    if study.out is not None:
        study.out.mkdir(parents=True, exist_ok=True)
        write_table(rows, study.out / "attitude.csv", (*KEYS, "setting"))
        if "iCub" in logs and not study.only:
            mahonys = [row for row in rows if row["data"] == "simulated" and row["filter"].startswith("Mahony")]
            pull = min(mahonys, key=lambda row: row["tilt"])["setting"]
            picture(logs["iCub"][0](), pull, study.out / "attitude.png")
    write_page(page(rows, study), None if study.out is None else study.out / "attitude.md")
