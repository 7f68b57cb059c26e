"""The UR5 at its table, watched by a camera and by noisy encoders, of which one fails without a word."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from torch_denkf.data import UR5ExperienceReplay
from torch_denkf.filters import Filter
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, MonitoredSensor, Select
from torch_denkf.pretrained import from_pretrained
from torch_denkf.pretrained.train.ur5_table import UNIT, whole_demos

__all__ = ["FAULTS", "arm_filter", "arm_sensors", "error_of", "read_demos"]

JOINTS, STEPS = 7, 320
ENCODER = 0.01  # rad: noise of the encoders
FIRST, LAST = 120, 180  # steps of a fault
FAULTS = ("camera pushed", "encoder slipped")


def arm_filter() -> Filter:
    """The trained filter behind its camera, with a second update by the encoders of all joints."""
    model = from_pretrained("ur5-table")
    parts = {name: model[name] for name in model.module if name != "sensor"}
    parts["analysis"] = EnsembleAnalysis("sensor", inflation=model.inflation, belief_key="seen")
    parts["encoder_noise"] = ConstantNoise([ENCODER] * JOINTS, in_key="encoder", out_key=("encoders", "noise"))
    parts["read"] = Select(range(JOINTS), in_key=("seen", "ensemble"), out_key=("seen", "joints"))
    parts["encoders"] = EnsembleAnalysis(
        "etkf",
        forecast_key=("seen", "ensemble"),
        predicted_key=("seen", "joints"),
        sensor_key="encoder",
        noise_variance_key=("encoders", "noise"),
    )
    return Filter(parts, initial=model.initial, update_at_reset=True)


def arm_sensors(gated: bool) -> dict[str, MonitoredSensor]:
    """What to watch; of a gated filter what its gates saw."""
    camera, encoders = (f"gate_{name}" if gated else ("info", name) for name in ("analysis", "encoders"))
    return {
        "camera": MonitoredSensor(camera, 10, noise_key=("sensor", "noise")),
        "encoders": MonitoredSensor(encoders, JOINTS),
    }


@torch.no_grad()
def read_demos(folder: Path, split: str, fault: str, cache: Path, limit: int | None = None) -> TensorDict:
    """What camera and encoders read of whole demos ``[N, T]``, with ``"fault"`` ``[N, T, 1]``; the demos are collected
    where they are missing."""
    model = from_pretrained("ur5-table")
    data = UR5ExperienceReplay(whole_demos(folder, progress=False), split=split, cache=cache, progress=False)
    generator, demos = torch.Generator().manual_seed(0), []
    hit = torch.zeros(STEPS, 1, dtype=torch.bool)
    hit[FIRST:LAST] = fault != "none"
    for number, episode in enumerate(data.episodes[:limit]):
        demo = data[torch.arange(episode.start, episode.start + STEPS)].select("pixels", "state", "action")
        demo["encoder"] = demo["state"][:, :JOINTS] + ENCODER * torch.randn(STEPS, JOINTS, generator=generator)
        if fault == "camera pushed":
            demo["pixels"][FIRST:LAST] = pushed(demo["pixels"][FIRST:LAST], number)
        elif fault == "encoder slipped":
            demo["encoder"][FIRST:LAST, number % 6] += 0.1 if number % 2 else -0.1  # rad
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            read = torch.cat([model["sensor"](part) for part in demo.split(80)])
        demos.append(read.exclude("pixels").set("fault", hit))
    return torch.stack(demos)


def pushed(pictures: Tensor, number: int) -> Tensor:
    """Pictures ``[T, 3, H, W]`` of a camera that was pushed: 8 % to one side, and turned by 5 degrees."""
    side = 1.0 if number % 2 else -1.0
    turn, way = torch.tensor(side * 5.0).deg2rad(), 2 * side * 0.08  # the picture's coordinates reach from -1 to 1
    matrix = torch.tensor([[turn.cos(), -turn.sin(), way], [turn.sin(), turn.cos(), 0.0]]).expand(len(pictures), 2, 3)
    grid = affine_grid(matrix, list(pictures.shape), align_corners=False)
    return grid_sample(pictures, grid, padding_mode="border", align_corners=False)


def error_of(out: TensorDict) -> Tensor:
    """Error of the belief's mean in units of what counts as one, mean over the state, ``[N, T]``."""
    return ((out["belief", "mean"] - out["state"]).abs() / UNIT).mean(-1)
