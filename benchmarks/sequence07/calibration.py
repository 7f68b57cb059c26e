"""Finds the numbers of ``chosen.py`` by drive 0022, which has no poses.

``python -m benchmarks.sequence07.calibration`` finds first the lens and then the corners' noise, by the likelihood of
the corners themselves. Then what is wrong for many rows, by halves of the corners and by KITTI's lens. Last the
filter's noises, by the likelihood of its readings. ``... calibration noises`` finds these alone. Each part starts from
``chosen.py``: fill in what the parts before have found.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.sequence07.chosen import CAMERA, CORNERS, FILTER
from benchmarks.sequence07.filters import car_filter, prepared
from benchmarks.sequence07.task import calibrated, drive, readings
from torch_denkf.applications.car.corners.camera import StereoCamera
from torch_denkf.applications.car.corners.motion import CornerNoise, corner_motions, started_by_ransac
from torch_denkf.functional.manifolds import SE3

FOLDER = Path("../shared/data")


def _named(values: Tensor) -> tuple[tuple, CornerNoise]:
    """Lens and noise of numbers ``[10 + 10]``: three of the radius, seven of the disparity, logarithms of the noise."""
    noise = dict(zip(CORNERS, values[10:].exp().unbind(), strict=True))
    return (values[:3].unbind(), values[3:10].unbind()), CornerNoise(**noise)


def corner_likelihood(
    values: Tensor, rows: TensorDict, camera: StereoCamera, start: Tensor, steps: int = 3, memory: bool = True
) -> tuple[Tensor, Tensor]:
    """Mean log-likelihood of a corner in the later row, in the tracker's own pixels; and the motions ``[T, 7]``."""
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
    """The lens by gradients, each row alone: found on the even rows, checked on the odd ones."""
    found = drive(folder, "0022")
    rows = found.rows[found.rows["motion_observed"].squeeze(-1)]
    before, after = (found.camera.corners(rows["corners"][:, :, row]) for row in (0, 1))
    start, _ = started_by_ransac(before, after, rows["seen"], found.camera)
    noise = torch.tensor(list(CORNERS.values())).log()
    plain = torch.cat([torch.zeros(10), noise])
    scale = torch.cat([torch.tensor([0.001, 0.01, 0.01, 0.1, 0.1, 0.2, 0.5, 0.5, 1.0, 2.0]), torch.full((10,), 0.3)])
    away = torch.zeros(20, requires_grad=True)
    optimiser = torch.optim.Adam([away], lr=0.1)
    for update in range(updates):
        value, motion = corner_likelihood(plain + scale * away, rows[::2], found.camera, start[::2], 2, memory=False)
        optimiser.zero_grad()
        (-value).backward()
        optimiser.step()
        optimiser.param_groups[0]["lr"] *= 0.985
        start[::2] = motion.detach()
        if update % 20 == 0:
            print(update, f"{value.item():.4f}", flush=True)
    values = (plain + scale * away).detach()
    with torch.no_grad():
        odd = rows[1::2], found.camera, start[1::2], 8, False
        after, before = (corner_likelihood(tried, *odd)[0].item() for tried in (values, plain))
    print("radial", [round(value, 4) for value in values[:3].tolist()])
    print("disparity_offset", [round(value, 3) for value in values[3:10].tolist()])
    print({name: round(value, 4) for name, value in zip(CORNERS, values[10:].exp().tolist(), strict=True)})
    print(f"odd rows {after:.4f}, with KITTI's lens {before:.4f}")


@torch.no_grad()
def corners(folder: Path = FOLDER, rounds: int = 8, rows: int = 400) -> None:
    """The corners' noise, with what corners have shown before: found on the first rows, checked on the others."""
    found = drive(folder, "0022")
    camera = calibrated(found.camera)
    before, after = (camera.corners(found.rows["corners"][:, :, row]) for row in (0, 1))
    start, _ = started_by_ransac(before, after, found.rows["seen"], camera)
    fixed = torch.tensor([*CAMERA["radial"], *CAMERA["disparity_offset"]])
    names, values = list(CORNERS), torch.tensor(list(CORNERS.values())).log()
    steps = torch.full((len(names),), 0.3)

    def scores(tried: Tensor, part: slice) -> Tensor:
        def one(noise: Tensor) -> Tensor:
            return corner_likelihood(torch.cat([fixed, noise]), found.rows[part], found.camera, start[part])[0]

        return torch.func.vmap(one)(tried).nan_to_num(-torch.inf)

    for number in range(rounds):
        moves = torch.cat([torch.zeros(1, len(names)), torch.diag(steps), -torch.diag(steps)])
        score = scores(values + moves, slice(0, rows))
        up, down = (score[1:] - score[0]).unflatten(0, (2, -1))
        better = torch.maximum(up, down) > 1e-4
        steps, move = (
            torch.where(better, steps, steps / 2),
            torch.where(better, torch.where(up > down, 1, -1) * steps, 0),
        )
        options = torch.stack([values, values + 0.3 * move, values + 0.6 * move, values + move])
        options = torch.cat([options, (values + moves)[score.argmax()].unsqueeze(0)])
        after = scores(options, slice(0, rows))
        values = options[after.argmax()]
        noise = {name: round(value, 4) for name, value in zip(names, values.exp().tolist(), strict=True)}
        print(number, f"{after.max().item():.4f}", noise, flush=True)
    print(f"other rows {scores(values.unsqueeze(0), slice(rows, None)).item():.4f}")


LEAST = 0.3  # m that a row moves; errors are those of each meter


@torch.no_grad()
def slip(folder: Path = FOLDER, seed: int = 0) -> None:
    """Errors that last: the corners are split at random, each with all its rows, and each half shows a motion.

    The mean of both has half the error of their difference. Its square and how much of it is left some rows later are
    those of a process that forgets a share from row to row, and all where the tracker finds new corners.
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
    """What KITTI's lens does to each meter: the lens of another day may be as far off."""
    found = drive(folder, "0022")
    lenses = calibrated(found.camera), found.camera
    motions = [corner_motions(found.rows, lens, CornerNoise(**CORNERS)).motion for lens in lenses]
    use = found.rows["motion_observed"].squeeze(-1) & (motions[0][:, 6] > LEAST)
    error = SE3().minus(*motions) / motions[0][:, 6:]
    print("LENS", [float(f"{value:.2g}") for value in error[use].square().mean(0).sqrt().tolist()])


@torch.no_grad()
def filter_likelihoods(tried: list[dict], data: TensorDict, skip: int = 20) -> Tensor:
    """Log-likelihood of all readings ``[T]`` under the extended Kalman filter, for each of several choices ``[B]``."""
    data = data.expand(len(tried), *data.shape).contiguous()
    together = {name: torch.tensor([values[name] for values in tried], dtype=torch.float64) for name in tried[0]}
    out = car_filter("EKF").sequence(prepared(data, together), keep=[("info", "log_likelihood")])
    return out["info", "log_likelihood"][:, skip:].sum((1, 2)).nan_to_num(-torch.inf)


def noises(folder: Path = FOLDER, rounds: int = 14) -> None:
    """The filter's noises: each number a step up and down at once, then all steps that helped, together."""
    found, best, data = dict(FILTER), -torch.inf, readings(folder, "0022")[0]
    steps = dict.fromkeys(found, 0.8)

    def moved(values: dict, name: str, step: float) -> dict:
        if name.startswith("kept"):  # on the scale of what is lost
            odds = max(1 - values[name], 1e-3) * 2.0**step
            return {**values, name: max(0.0, 1 - odds)}
        return {**values, name: values[name] * 2.0**step}

    for number in range(rounds):
        tried = [dict(found)] + [moved(found, name, sign * steps[name]) for name in found for sign in (1, -1)]
        scores = filter_likelihoods(tried, data)
        gains = (scores[1:] - scores[0]).reshape(-1, 2)
        together = {}
        for name, (up, down) in zip(found, gains.tolist(), strict=True):
            if max(up, down) > 0.05:
                together[name] = steps[name] if up > down else -steps[name]
            else:
                steps[name] /= 2
        options = []
        for share in (1.0, 0.6, 0.3):
            values = dict(found)
            for name, step in together.items():
                values = moved(values, name, share * step)
            options.append(values)
        options.append(tried[int(scores.argmax())])
        after = filter_likelihoods(options, data)
        best, found = after.max().item(), options[int(after.argmax())]
        print(number, f"{best:.1f}", {name: round(value, 6) for name, value in found.items()}, flush=True)
        if max(steps.values()) < 0.1:
            break


if __name__ == "__main__":
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    for part in (lens, corners, slip, other_lens, noises):
        if part.__name__ in sys.argv[1:] or not sys.argv[1:]:
            part()
