"""The UR5 at its table, watched by a camera and by noisy encoders, of which one fails without a word."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from benchmarks.monitor.scores import Run, afterwards, detection, false_alarms
from torch_denkf.data import UR5ExperienceReplay
from torch_denkf.filters import Filter, Gated
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, InnovationMonitor, MonitoredSensor, Select
from torch_denkf.pretrained import from_pretrained
from torch_denkf.pretrained.train.ur5_table import UNIT

__all__ = ["FAULTS", "arm_filter", "arm_rows", "arm_sensors", "error_of", "read_demos"]

JOINTS, STEPS = 7, 320
ENCODER = 0.01  # rad: noise of the encoders
FIRST, LAST = 120, 180  # steps of a fault
MARGIN = 2.0  # on what the clean demos show: they are few
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


def arm_sensors() -> dict[str, MonitoredSensor]:
    """What to watch."""
    return {
        "camera": MonitoredSensor(("info", "analysis"), 10, noise_key=("sensor", "noise")),
        "encoders": MonitoredSensor(("info", "encoders"), JOINTS),
    }


@torch.no_grad()
def read_demos(folder: Path, split: str, fault: str, cache: Path) -> TensorDict:
    """What camera and encoders read of whole demos ``[N, T]``, with ``"fault"`` ``[N, T, 1]``."""
    model = from_pretrained("ur5-table")
    data = UR5ExperienceReplay(folder, split=split, cache=cache, progress=False)
    generator, demos = torch.Generator().manual_seed(0), []
    hit = torch.zeros(STEPS, 1, dtype=torch.bool)
    hit[FIRST:LAST] = fault != "none"
    for number, episode in enumerate(data.episodes):
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


def arm_rows(folder: Path, cache: Path, draws: int) -> list[dict]:
    """A row for each fault, over the demos of the test side; thresholds from demos that the training left out."""
    model = arm_filter()
    whole = read_demos(folder, "train", "none", cache)
    clean = whole[: max(len(whole) // 5, 1)]  # on which the training chose its inflation, and nothing else
    tested = {fault: read_demos(folder, "test", fault, cache) for fault in ("none", *FAULTS)}
    monitor = InnovationMonitor(arm_sensors(), window=3, reference=2.0)
    monitor.calibrate([believe(model, clean, draws)], margin=MARGIN)
    gate = Gated(model, 10, places=["analysis"], response="reject", rate=1e-4, patience=10)
    gate = Gated(gate, JOINTS, places=["encoders"], response="reject", rate=1e-4, patience=100, by_component=True)
    gate.calibrate([clean], margin=MARGIN)
    plain = {fault: believe(model, data, draws) for fault, data in tested.items()}
    gated = {fault: believe(gate, data, draws) for fault, data in tested.items()}
    alarms = false_alarms(runs_of(monitor, plain["none"]))
    rows = [{"task": "ur5", "fault": "none", **alarms, **errors(plain["none"], gated["none"])}]
    for fault in FAULTS:
        hit = tested[fault]["fault"][0, :, 0]
        after, sound = (afterwards(error_of(gated[name]), hit) for name in (fault, "none"))
        ratio = float(after.mean() / sound.mean())
        row = {**detection(runs_of(monitor, plain[fault])), **alarms, "error_ratio": ratio}
        rows.append({"task": "ur5", "fault": fault, **row, **errors(plain[fault], gated[fault], hit)})
    return rows


@torch.no_grad()
def believe(model: Filter, demos: TensorDict, draws: int, seed: int = 0) -> TensorDict:
    """Beliefs on demos ``[N, T]``, each so many times, ``[draws N, T]``."""
    torch.manual_seed(seed)
    return model.sequence(torch.cat([demos] * draws).clone())


def runs_of(monitor: InnovationMonitor, beliefs: TensorDict) -> list[Run]:
    """What a monitor says of beliefs ``[N, T]``."""
    said = monitor.replay(beliefs)["monitor"]
    evidence = torch.maximum(said["camera", "evidence"], said["encoders", "evidence"])
    parts = (evidence, said["alarm"], beliefs["fault"])
    return [Run(*row) for row in zip(*(part.squeeze(-1) for part in parts), strict=True)]


def errors(plain: TensorDict, gated: TensorDict, during: Tensor | None = None) -> dict[str, float]:
    """Mean errors of the filter and of the gated one, over the steps ``[T]`` that are marked."""
    rows = slice(1, None) if during is None else during
    return {"error": float(error_of(plain)[:, rows].mean()), "error_gated": float(error_of(gated)[:, rows].mean())}
