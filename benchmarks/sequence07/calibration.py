"""Finds the numbers of ``chosen.py`` by drive 0022, which has no poses: ``python -m benchmarks.sequence07.calibration``.

First the lens and the corners' noise, by the likelihood of the corners themselves. Then the filter's noises, by the
likelihood of its readings.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.sequence07.chosen import CAMERA, CORNERS, FILTER
from benchmarks.sequence07.filters import car_filter, prepared
from benchmarks.sequence07.task import drive, readings
from torch_denkf.applications.car.corners.camera import StereoCamera
from torch_denkf.applications.car.corners.motion import CornerNoise, corner_motion, started_by_ransac

FOLDER = Path("../shared/data")


def corner_likelihood(rows, camera: StereoCamera, noise: CornerNoise, start: Tensor, steps: int = 6) -> float:
    """Mean log-likelihood of a corner in the later row, in the tracker's own pixels."""
    before, after = (camera.corners(rows["corners"][:, :, row]) for row in (0, 1))
    offset = rows["corners"][:, :, 0, 1] - rows["corners"][:, :, 0, 3]
    found = corner_motion(before, after, rows["seen"], camera, noise, offset=offset, start=start, steps=steps)
    square = ((rows["corners"][:, :, 1, :2] - torch.tensor(camera.center)) / camera.focal).square().sum(-1)
    first, second = camera.radial
    scale = (1 - first * square - second * square**2) * (1 - 3 * first * square - 5 * second * square**2)
    change = (torch.where(rows["seen"], scale, 1.0).log().sum(-1) / rows["seen"].sum(-1)).mean()
    return found.log_likelihood.mean().item() + change.item()


def climb(score: Callable[[dict], float], start: dict, steps: dict, sweeps: int = 3) -> tuple[dict, float]:
    """Changes one number after the other as long as the score grows; steps halve from sweep to sweep."""
    best, found, steps = score(start), dict(start), dict(steps)
    for _ in range(sweeps):
        for name in start:
            for sign in (1, -1):
                for _ in range(4):
                    tried = {**found, name: found[name] + sign * steps[name]}
                    value = score(tried)
                    if not value > best + 1e-4:
                        break
                    best, found = value, tried
        steps = {name: step / 2 for name, step in steps.items()}
    return found, best


def corners(folder: Path = FOLDER) -> None:
    """Lens, tracker and corners: chosen on the even rows, and checked on the odd ones."""
    found = drive(folder, "0022")
    keep = found.rows["motion_observed"].squeeze(-1)
    rows = found.rows[keep]
    before, after = (found.camera.corners(rows["corners"][:, :, row]) for row in (0, 1))
    start, _ = started_by_ransac(before, after, rows["seen"], found.camera)

    def score(values: dict, part: slice = slice(0, None, 2)) -> float:
        camera = replace(found.camera, radial=(values["k1"], values["k2"]), disparity_offset=values["short"])
        noise = CornerNoise(**{name: 2.0 ** values[name] for name in CORNERS})
        return corner_likelihood(rows[part], camera, noise, start[part])

    begin = {name: torch.tensor(value).log2().item() for name, value in CORNERS.items()}
    plain = {**begin, "k1": 0.0, "k2": 0.0, "short": 0.0}
    begin |= {"k1": CAMERA["radial"][0], "k2": CAMERA["radial"][1], "short": CAMERA["disparity_offset"]}
    steps = dict.fromkeys(CORNERS, 0.4) | {"k1": 0.005, "k2": 0.01, "short": 0.1}
    values, best = climb(score, begin, steps)
    odd = slice(1, None, 2)
    print({name: round(2.0 ** values[name], 4) for name in CORNERS})
    print({name: round(values[name], 4) for name in ("k1", "k2", "short")})
    print(f"even rows {best:.4f}; odd rows {score(values, odd):.4f}, with KITTI's lens {score(plain, odd):.4f}")


@torch.no_grad()
def filter_likelihoods(tried: list[dict], folder: Path = FOLDER, skip: int = 20) -> Tensor:
    """Log-likelihood of all readings of 0022 under the extended Kalman filter, for each of several choices ``[B]``."""
    data = readings(folder, "0022")
    data = data.expand(len(tried), *data.shape).contiguous()
    together = {name: torch.tensor([values[name] for values in tried], dtype=torch.float64) for name in tried[0]}
    out = car_filter("EKF").sequence(prepared(data, together), keep=[("info", "log_likelihood")])
    return out["info", "log_likelihood"][:, skip:].sum((1, 2)).nan_to_num(-torch.inf)


def noises(rounds: int = 14) -> None:
    """The filter's noises: all numbers one step up and down at once, then all steps that helped, together and halved."""
    found, best = dict(FILTER), -torch.inf
    steps = dict.fromkeys(found, 0.8)

    def moved(values: dict, name: str, step: float) -> dict:
        if name.startswith("kept"):  # on the scale of what is lost
            odds = max(1 - values[name], 1e-3) * 2.0**step
            return {**values, name: max(0.0, 1 - odds)}
        return {**values, name: values[name] * 2.0**step}

    for number in range(rounds):
        tried = [dict(found)] + [moved(found, name, sign * steps[name]) for name in found for sign in (1, -1)]
        scores = filter_likelihoods(tried)
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
        after = filter_likelihoods(options)
        best, found = after.max().item(), options[int(after.argmax())]
        print(number, f"{best:.1f}", {name: round(value, 6) for name, value in found.items()}, flush=True)
        if max(steps.values()) < 0.1:
            break


if __name__ == "__main__":
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    if "corners" in sys.argv[1:] or not sys.argv[1:]:
        corners()
    if "noises" in sys.argv[1:] or not sys.argv[1:]:
        noises()
