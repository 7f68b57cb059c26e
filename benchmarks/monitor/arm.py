"""The UR5 at its table with a camera and noisy encoders, one of which fails silently."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from benchmarks.monitor.scores import Run, afterwards, detection, false_alarms
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.envs.collect import collect_ur5_demos
from torch_denkf.applications.ur5.train import UNIT
from torch_denkf.filters import Filter
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, Select
from torch_denkf.monitoring import Gated, InnovationMonitor, MonitoredSensor
from torch_denkf.pretrained import from_pretrained

JOINTS, STEPS = 7, 320
ENCODER = 0.01  # rad: noise of the encoders
FIRST, LAST = 120, 180  # steps of a fault
OWN, OWN_SEED = 70, 1  # number of the study's demos, and their seed, which differs from the training's
MOVED = 0.005  # share of white: a change of a pixel by more than one grey level of 255
FAULTS = ("camera pushed", "encoder slipped")


@dataclass(frozen=True)
class ArmGuard:
    """Settings that are chosen on validation demos, see :mod:`benchmarks.monitor.choice`.

    Attributes:
        rate: false alarms per step that the monitor is calibrated for, before the margin.
        margin: factor on its limits.
        reference: of its cumulative sums.
        gate_margin: factor on the gates' limits.
    """

    rate: float = 0.03
    margin: float = 1.6
    reference: float = 2.0
    gate_margin: float = 1.0


CHOSEN = ArmGuard()


class Beliefs(NamedTuple):
    """Readings and beliefs of the study's own demos.

    Attributes:
        known: clean readings for calibration.
        clean: the filter's beliefs on them.
        tested: readings of other demos, by fault.
        plain: the filter's beliefs on those.
    """

    known: TensorDict
    clean: TensorDict
    tested: dict[str, TensorDict]
    plain: dict[str, TensorDict]


def arm_filter() -> Filter:
    """Returns the trained filter without its camera sensor, with a second update by the encoders of all joints."""
    model = from_pretrained("ur5-table")
    parts = {name: model[name] for name in model.module if name != "sensor"}
    parts["analysis"] = EnsembleAnalysis("sensor", inflation=model.inflation, belief_prefix="seen")
    parts["encoder_noise"] = ConstantNoise([ENCODER] * JOINTS, in_key="encoder", out_key=("encoders", "noise"))
    parts["read"] = Select(range(JOINTS), in_key=("seen", "ensemble"), out_key=("seen", "joints"))
    parts["encoders"] = EnsembleAnalysis(
        "etkf",
        forecast_key=("seen", "ensemble"),
        predicted_key=("seen", "joints"),
        observation_key="encoder",
        noise_variance_key=("encoders", "noise"),
    )
    return Filter(parts, initial=model.initial, update_at_reset=True)


def arm_sensors() -> dict[str, MonitoredSensor]:
    """Returns the monitored sensors."""
    return {
        "camera": MonitoredSensor(
            ("info", "analysis"), 10, noise_key=("sensor", "noise"), sign_key="moved", signs=1, floor=MOVED
        ),
        "encoders": MonitoredSensor(("info", "encoders"), JOINTS),
    }


@torch.no_grad()
def read_demos(folder: Path, split: str, fault: str, cache: Path) -> TensorDict:
    """Returns readings of camera and encoders in whole demos ``[N, T]``, with ``"fault"`` ``[N, T, 1]``."""
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
        # Camera and background are fixed, so that three pixels in four keep their value from the start.
        change = (demo["pixels"] - demo["pixels"][:1]).abs().amax(1).flatten(1)
        demo["moved"] = change.quantile(0.75, dim=1, keepdim=True)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            read = torch.cat([model["sensor"](part) for part in demo.split(80)])
        demos.append(read.exclude("pixels").set("fault", hit))
    return torch.stack(demos)


def pushed(pictures: Tensor, number: int) -> Tensor:
    """Returns images ``[T, 3, H, W]`` of a camera that was pushed: 8 % to one side, and turned by 5 degrees."""
    side = 1.0 if number % 2 else -1.0
    turn, way = torch.tensor(side * 5.0).deg2rad(), 2 * side * 0.08  # the image's coordinates reach from -1 to 1
    matrix = torch.tensor([[turn.cos(), -turn.sin(), way], [turn.sin(), turn.cos(), 0.0]]).expand(len(pictures), 2, 3)
    grid = affine_grid(matrix, list(pictures.shape), align_corners=False)
    return grid_sample(pictures, grid, padding_mode="border", align_corners=False)


def error_of(out: TensorDict) -> Tensor:
    """Returns the error of the belief's mean in units ``UNIT``, averaged over the state, ``[N, T]``."""
    return ((out["belief", "mean"] - out["state"]).abs() / UNIT).mean(-1)


def own_demos(out: Path, count: int = OWN) -> Path:
    """Returns the folder of demos outside of training and test; collects the missing ones."""
    collect_ur5_demos(out / "ur5", count, size=(64, 64), frames=0, seed=OWN_SEED)
    return out / "ur5"


def chosen_on(folder: Path, cache: Path) -> Beliefs:
    """Returns readings and beliefs of own demos: a third for calibration, the others with the faults."""
    model = arm_filter()
    tested = {fault: read_demos(folder, "all", fault, cache) for fault in ("none", *FAULTS)}
    third = max(len(tested["none"]) // 3, 1)
    known = tested["none"][:third]
    tested = {fault: data[third:] for fault, data in tested.items()}
    plain = {fault: believe(model, data, 1) for fault, data in tested.items()}
    return Beliefs(known, believe(model, known, 1), tested, plain)


def arm_monitor(clean: TensorDict, guard: ArmGuard = CHOSEN) -> InnovationMonitor:
    """Returns a monitor, calibrated on beliefs of clean demos."""
    options = {"window": 3, "reference": guard.reference, "false_alarm_rate": guard.rate}
    return InnovationMonitor(arm_sensors(), **options).calibrate([clean], margin=guard.margin)


def arm_gate(known: TensorDict, guard: ArmGuard = CHOSEN) -> Filter:
    """Returns the filter with two gates, calibrated on clean readings."""
    gate = Gated(arm_filter(), 10, places=["analysis"], response="reject", rate=1e-4, patience=10)
    gate = Gated(gate, JOINTS, places=["encoders"], response="reject", rate=1e-4, patience=100, by_component=True)
    return gate.calibrate([known], margin=guard.gate_margin)


def demo_runs(monitor: InnovationMonitor, beliefs: dict[str, TensorDict]) -> dict[str, list[Run]]:
    """Returns the monitor's output by fault."""
    return {fault: runs_of(monitor, each) for fault, each in beliefs.items()}


def gated_errors(beliefs: Beliefs, guard: ArmGuard) -> dict[str, float]:
    """Returns the mean error with the gate by fault, over the steps of the fault."""
    gate, out = arm_gate(beliefs.known, guard), {}
    for fault, data in beliefs.tested.items():
        rows = slice(1, None) if fault == "none" else data["fault"][0, :, 0]
        out[fault] = float(error_of(believe(gate, data, 1))[:, rows].mean())
    return out


def arm_rows(folder: Path, own: Path, cache: Path, draws: int) -> list[dict]:
    """Returns a row for each fault, over the test demos; the limits come from the study's own demos."""
    model = arm_filter()
    known = read_demos(own, "all", "none", cache)
    tested = {fault: read_demos(folder, "test", fault, cache) for fault in ("none", *FAULTS)}
    monitor, gate = arm_monitor(believe(model, known, draws)), arm_gate(known)
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
    """Returns beliefs on demos ``[N, T]``, repeated ``draws`` times, ``[draws N, T]``."""
    torch.manual_seed(seed)
    return model.sequence(torch.cat([demos] * draws).clone())


def runs_of(monitor: InnovationMonitor, beliefs: TensorDict) -> list[Run]:
    """Returns a monitor's output on beliefs ``[N, T]``."""
    said = monitor.replay(beliefs)["monitor"]
    evidence = torch.maximum(said["camera", "evidence"], said["encoders", "evidence"])
    parts = (evidence, said["alarm"], beliefs["fault"])
    return [Run(*row) for row in zip(*(part.squeeze(-1) for part in parts), strict=True)]


def errors(plain: TensorDict, gated: TensorDict, during: Tensor | None = None) -> dict[str, float]:
    """Returns the mean errors of the filter and of the gated filter, over the steps of the mask ``[T]``."""
    rows = slice(1, None) if during is None else during
    return {"error": float(error_of(plain)[:, rows].mean()), "error_gated": float(error_of(gated)[:, rows].mean())}
