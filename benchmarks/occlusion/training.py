"""Training: the camera by itself, then each filter on what it reads in runs that it was not trained on."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict
from torch import nn

from benchmarks.occlusion.task import camera, drawn
from torch_denkf.filters import Filter
from torch_denkf.imperfect import FadingBias
from torch_denkf.modules import ImageSensor
from torch_denkf.objectives import DEnKFLoss, GaussianLoss, MixtureLoss, SensorLoss

__all__ = ["fit_camera", "fit_filter", "fit_frames", "lasting_error"]


def fit_camera(data: TensorDict, epochs: int, seed: int) -> ImageSensor:
    """A camera that was told the true place in every picture, also behind the pillar."""
    torch.manual_seed(seed)
    sensor, places = camera(), data["state"][..., :2].flatten(0, -2)
    pictures, batch = drawn(data["state"], seed).flatten(0, 1), 64
    total = epochs * math.ceil(len(pictures) / batch)
    optimiser = torch.optim.Adam(sensor.parameters(), 2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=total)
    for _ in range(epochs):
        for rows in torch.randperm(len(pictures)).split(batch):
            read = sensor(TensorDict({"pixels": pictures[rows]}, [len(rows)]))["sensor", "ensemble"].squeeze(-2)
            loss = nn.functional.smooth_l1_loss(read, places[rows])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return sensor.requires_grad_(False)


def lasting_error(data: TensorDict, *, seen: bool) -> FadingBias:
    """How large the camera's errors are and how long they last: where it sees, or everywhere."""
    errors = data["reading"] - data["state"][..., :2]
    return FadingBias.from_residuals(torch.where(data["visible"] == 1, errors, torch.nan) if seen else errors)[0]


def fit_frames(filter: Filter, data: TensorDict, *, labels: bool, iterations: int) -> None:
    """Trains what a filter learns of single readings: how far off they are, and with labels whether the camera sees."""
    loss = SensorLoss(filter, sensor=0.0, noise=1.0, visible=float(labels))
    loss.set_keys(sensor="reading")
    optimiser, frames = torch.optim.Adam(loss.parameters(), 5e-3), data.reshape(-1)
    for _ in range(iterations):
        total = sum(loss(frames[torch.randint(len(frames), (512,))]).values())
        optimiser.zero_grad()
        total.backward()
        optimiser.step()


def fit_filter(
    filter: Filter, data: TensorDict, *, labels: bool, iterations: int, window: int, batch: int, seed: int
) -> Filter:
    """The filter, trained on single readings, and then on windows of them by the CRPS of the true place and speed."""
    torch.manual_seed(seed)
    if any(place == "noise" for place, _ in filter.structure.frames):
        fit_frames(filter, data, labels=labels, iterations=5 * iterations)
    weights = {"visible": 0.1} if labels else {}
    scale = {"dims": [0, 1, 2, 3], "state_scale": [4.0, 4.0, 0.4, 0.4]}
    if ("belief", "log_weight") in filter.belief_keys:
        loss: nn.Module = MixtureLoss(filter, score="crps", **scale, **weights)
    elif ("belief", "ensemble") in filter.belief_keys:
        loss = DEnKFLoss(filter, transition=0.0, sensor=0.0, **scale, **weights)
    else:
        loss = GaussianLoss(filter, transition=0.0, sensor=0.0, **scale, **weights)
    optimiser = torch.optim.Adam(loss.parameters(), 5e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 5e-3, total_steps=iterations)
    for _ in range(iterations):
        rows, begin = torch.randint(len(data), (batch,)), int(torch.randint(data.shape[1] - window + 1, ()))
        total = sum(loss(data[rows, begin : begin + window]).values())
        optimiser.zero_grad()
        total.backward()
        nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
        optimiser.step()
        schedule.step()
    return filter
