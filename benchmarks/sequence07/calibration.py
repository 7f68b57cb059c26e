"""Estimates the parameters of ``chosen.py`` from drive 0022, which has no poses.

``python -m benchmarks.sequence07.calibration`` estimates first the lens and then the corners' noise, by the likelihood
of the corners. Then it estimates the slip, from halves of the corners and from KITTI's lens, and last the filter's
noises, by the likelihood of its readings. ``... calibration noises`` estimates only the latter. Each part starts from
``chosen.py``: fill in the results of the parts before.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.optim.lr_scheduler import ExponentialLR

from benchmarks.common.descent import minimise
from benchmarks.sequence07.chosen import CAMERA, CORNERS, FILTER
from benchmarks.sequence07.filters import car_filter, prepared
from benchmarks.sequence07.task import calibrated, drive, readings
from torch_denkf.applications.car.corners.camera import StereoCamera
from torch_denkf.applications.car.corners.motion import CornerNoise, corner_motions, started_by_ransac
from torch_denkf.functional.manifolds import SE3

FOLDER = Path("../shared/data")


def _named(values: Tensor) -> tuple[tuple, CornerNoise]:
    """Returns lens and noise of ``[10 + 10]`` values: three radial, seven of the disparity, ten logarithms of noise."""
    noise = dict(zip(CORNERS, values[10:].exp().unbind(), strict=True))
    return (values[:3].unbind(), values[3:10].unbind()), CornerNoise(**noise)


def corner_likelihood(
    values: Tensor, rows: TensorDict, camera: StereoCamera, start: Tensor, steps: int = 3, memory: bool = True
) -> tuple[Tensor, Tensor]:
    """Returns the mean log-likelihood of a corner in the later row, in pixels, and the motions ``[T, 7]``."""
    (radial, short), noise = _named(values)
    lens = replace(camera, radial=radial, disparity_offset=short)
    found = corner_motions(rows, lens, noise, start=start, steps=steps, memory=memory)
    away = (rows["corners"][:, :, 1, :2] - torch.tensor(camera.center)) / camera.focal
    square = away.square().sum(-1)
    along = 1 - radial[0] - 3 * radial[1] * square - 5 * radial[2] * square**2
    change = ((1 - radial[0] - radial[1] * square - radial[2] * square**2) * along).log()  # of a pixel's area
    change = torch.where(rows["seen"], change, 0.0).sum(-1) / rows["seen"].sum(-1).clamp_min(1)
    likelihood = (found.log_likelihood + change)[rows["motion_observed"].squeeze(-1)].mean()
    return likelihood, found.motion


def lens(folder: Path = FOLDER, updates: int = 100) -> None:
    """Estimates the lens by gradients, each row alone: fitted on the even rows, checked on the odd ones."""
    found = drive(folder, "0022")
    rows = found.rows[found.rows["motion_observed"].squeeze(-1)]
    before, after = (found.camera.corners(rows["corners"][:, :, row]) for row in (0, 1))
    start, _ = started_by_ransac(before, after, rows["seen"], found.camera)
    noise = torch.tensor(list(CORNERS.values())).log()
    plain = torch.cat([torch.zeros(10), noise])
    scale = torch.cat([torch.tensor([0.001, 0.01, 0.01, 0.1, 0.1, 0.2, 0.5, 0.5, 1.0, 2.0]), torch.full((10,), 0.3)])
    away = torch.zeros(20, requires_grad=True)

    def loss() -> Tensor:
        value, motion = corner_likelihood(
            plain + scale * away, rows[::2], found.camera, start[::2].clone(), 2, memory=False
        )
        start[::2] = motion.detach()
        return -value

    minimise([away], loss, updates, 0.1, schedule=partial(ExponentialLR, gamma=0.985))
    values = (plain + scale * away).detach()
    with torch.no_grad():
        odd = rows[1::2], found.camera, start[1::2], 8, False
        after, before = (corner_likelihood(tried, *odd)[0].item() for tried in (values, plain))
    print("radial", [round(value, 4) for value in values[:3].tolist()])
    print("disparity_offset", [round(value, 3) for value in values[3:10].tolist()])
    print({name: round(value, 4) for name, value in zip(CORNERS, values[10:].exp().tolist(), strict=True)})
    print(f"odd rows {after:.4f}, with KITTI's lens {before:.4f}")


def searched(score: Callable[[Tensor], Tensor], values: Tensor, step: float, least: float, rounds: int) -> Tensor:
    """Maximises by pattern search: tries each value up and down, then all improvements together.

    Args:
        score: maps a batch of choices ``[B, N]`` to scores ``[B]``.
        values: initial values, ``[N]``.
        step: initial step of each value, halved without an improvement; the search ends when all are below an eighth.
        least: smallest gain that counts as an improvement.
        rounds: at most.
    """
    steps = torch.full_like(values, step)
    for number in range(rounds):
        moves = torch.cat([torch.zeros(1, len(values)), torch.diag(steps), -torch.diag(steps)])
        scores = score(values + moves)
        up, down = (scores[1:] - scores[0]).unflatten(0, (2, -1))
        better = torch.maximum(up, down) > least
        move = torch.where(better, torch.where(up > down, 1, -1) * steps, 0)
        steps = torch.where(better, steps, steps / 2)
        together = torch.stack([values + share * move for share in (0.0, 0.3, 0.6, 1.0)])
        options = torch.cat([together, (values + moves)[scores.argmax()].unsqueeze(0)])
        after = score(options)
        values = options[after.argmax()]
        print(number, f"{after.max().item():.4f}", flush=True)
        if steps.max() < step / 8:
            break
    return values


@torch.no_grad()
def corners(folder: Path = FOLDER, rounds: int = 8, rows: int = 400) -> None:
    """Estimates the corners' noise, given their earlier errors: fitted on the first rows, checked on the others."""
    found = drive(folder, "0022")
    camera = calibrated(found.camera)
    before, after = (camera.corners(found.rows["corners"][:, :, row]) for row in (0, 1))
    start, _ = started_by_ransac(before, after, found.rows["seen"], camera)
    fixed = torch.tensor([*CAMERA["radial"], *CAMERA["disparity_offset"]])

    def scores(tried: Tensor, part: slice) -> Tensor:
        def one(noise: Tensor) -> Tensor:
            return corner_likelihood(torch.cat([fixed, noise]), found.rows[part], found.camera, start[part])[0]

        return torch.func.vmap(one)(tried).nan_to_num(-torch.inf)

    values = torch.tensor(list(CORNERS.values())).log()
    values = searched(partial(scores, part=slice(0, rows)), values, 0.3, 1e-4, rounds)
    print({name: round(value, 4) for name, value in zip(CORNERS, values.exp().tolist(), strict=True)})
    print(f"other rows {scores(values.unsqueeze(0), slice(rows, None)).item():.4f}")


LEAST = 0.3  # m, least motion of a row; errors are per metre


@torch.no_grad()
def slip(folder: Path = FOLDER, seed: int = 0) -> None:
    """Estimates the slip: the corners are split at random over all their rows, and each half gives a motion.

    The error of the halves' mean is half of their difference. Its mean square and its correlation over rows fit a
    first-order process that is reset when the tracker finds new corners.
    """
    found, random = drive(folder, "0022"), torch.Generator().manual_seed(seed)
    rows, motions = found.rows, []
    half = torch.rand(rows["seen"].shape, generator=random) < 0.5
    for row in range(1, len(rows)):
        came = rows["came_from"][row]
        half[row] = torch.where(came >= 0, half[row - 1][came], half[row])
    use = rows["motion_observed"].squeeze(-1)
    for part in (half, ~half):
        some = rows.clone()
        some["seen"] = rows["seen"] & part
        use = use & (some["seen"].sum(-1) >= 8)
        motions.append(corner_motions(some, calibrated(found.camera), CornerNoise(**CORNERS)).motion)
    use = use & (motions[0][:, 6] > LEAST)
    error = SE3().minus(*motions) / 2 / motions[0][:, 6:]
    limit = 10 * error[use].abs().median(0).values  # a half may follow another car
    use = use & (error.abs() < limit).all(-1)
    corners = (~rows["motion_observed"].squeeze(-1)).cumsum(0)

    def product(lag: int) -> Tensor:
        both = use[lag:] & use[: len(use) - lag] & (corners[lag:] == corners[: len(use) - lag])
        return (error[lag:] * error[: len(use) - lag])[both].mean(0)

    kept = (product(6) / product(1)).mean() ** (1 / 5)
    std = (product(1) / kept).sqrt()
    print("HALVES", [float(f"{value:.2g}") for value in std.tolist()], "SLIP_KEPT", round(kept.item(), 3))


@torch.no_grad()
def other_lens(folder: Path = FOLDER) -> None:
    """Estimates the error per metre from KITTI's lens, as a measure for the lens of another day."""
    found = drive(folder, "0022")
    lenses = calibrated(found.camera), found.camera
    motions = [corner_motions(found.rows, lens, CornerNoise(**CORNERS)).motion for lens in lenses]
    use = found.rows["motion_observed"].squeeze(-1) & (motions[0][:, 6] > LEAST)
    error = SE3().minus(*motions) / motions[0][:, 6:]
    print("LENS", [float(f"{value:.2g}") for value in error[use].square().mean(0).sqrt().tolist()])


@torch.no_grad()
def noises(folder: Path = FOLDER, rounds: int = 14) -> None:
    """Estimates the filter's noises by the EKF's log-likelihood of all readings but the first."""
    data, lost = readings(folder, "0022")[0], torch.tensor([name.startswith("kept") for name in FILTER])
    start = torch.tensor(list(FILTER.values()))

    def numbers(logs: Tensor) -> Tensor:
        """Maps logarithms to values; a decay factor k is searched as the logarithm of 1 - k."""
        return torch.where(lost, (1 - 2.0**logs).clamp(0, 0.999), 2.0**logs)

    def likelihoods(tried: Tensor) -> Tensor:
        several = data.expand(len(tried), *data.shape).contiguous()
        choices = dict(zip(FILTER, numbers(tried).unbind(-1), strict=True))
        out = car_filter("EKF").sequence(prepared(several, choices), keep=[("info", "log_likelihood")])
        return out["info", "log_likelihood"][:, 20:].sum((1, 2)).nan_to_num(-torch.inf)

    found = searched(likelihoods, torch.where(lost, 1 - start, start).log2(), 0.8, 0.05, rounds)
    print({name: round(value, 6) for name, value in zip(FILTER, numbers(found).tolist(), strict=True)})


if __name__ == "__main__":
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    for part in (lens, corners, slip, other_lens, noises):
        if part.__name__ in sys.argv[1:] or not sys.argv[1:]:
            part()
