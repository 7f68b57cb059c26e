"""Golden values of filters, smoothers, losses, monitors, shipped weights and studies, under fixed seeds."""

from __future__ import annotations

import tempfile
from contextlib import redirect_stdout
from os import devnull
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.lorenz96 import lorenz96_step
from benchmarks.fusion import study as fusion
from benchmarks.lorenz96 import schemes
from benchmarks.odometry.__main__ import Study as Odometry
from benchmarks.odometry.__main__ import track
from benchmarks.smoothing import ours as smoothing
from benchmarks.smoothing.cases import CASES
from tests.filters.factories import linear_denkf, linear_kalman, toy_denkf, toy_frames
from tests.filters.gaussian_for_tests import linear_filter
from tests.filters.test_contract import FILTERS, particles, readings
from tests.pretrained.beliefs import all_beliefs
from torch_denkf.applications.car import read_kitti_drive, write_drives
from torch_denkf.applications.car.kitti.render import render_drives
from torch_denkf.applications.car.odometry.failing_drive import track_failing_drive, usual_failures
from torch_denkf.baselines import IEnKS
from torch_denkf.filters import ParticleFilter
from torch_denkf.modules import GaussianLikelihood, GaussianPrior
from torch_denkf.monitoring import Gated, InnovationMonitor, Monitored, MonitoredSensor
from torch_denkf.objectives import (
    DEnKFLoss,
    GaussianLoss,
    MixtureLoss,
    ObservationLoss,
    SensorLoss,
    TransitionLoss,
)
from torch_denkf.pretrained import from_pretrained
from torch_denkf.smoothers import EnKS, EnRTS, FixedLag, ParticleSmoother, RTSSmoother

__all__ = ["FILE", "values"]

FILE = Path(__file__).parent / "values.json"

MEAN, VAR = ("belief", "mean"), ("belief", "var")


def values() -> dict[str, list[float]]:
    """Returns all golden values, by name."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        found = {**of_filters(), **of_smoothers(), **of_losses(), **of_monitors()}
    finally:
        torch.set_default_dtype(before)
    return {**found, **of_weights(), **of_studies()}


def numbers(*parts: Tensor) -> list[float]:
    """Returns the numbers of some tensors, one after the other."""
    return [float(f"{value:.12g}") for part in parts for value in part.detach().double().flatten()]


def of_filters() -> dict[str, list[float]]:
    """Returns the last belief of a sequence, and that of one more step."""
    out = {}
    for name, make in FILTERS.items():
        torch.manual_seed(1)
        filter = make()
        frames = filter.draw_noise(readings(2, 6), generator=torch.Generator().manual_seed(2))
        done = filter.sequence(frames[:, :5].copy())
        row = frames[:, 5].copy().update(done[:, 4].select(*filter.carry_keys))
        step = filter.step(row)
        out[f"filter: {name}"] = numbers(done[MEAN][:, -1], done[VAR][:, -1], step[MEAN], step[VAR])
    torch.manual_seed(3)
    learned = toy_denkf("perturbed", "flipout")
    frames = learned.draw_noise(toy_frames((2, 5)), generator=torch.Generator().manual_seed(4))
    out["filter: learned"] = numbers(learned.sequence(frames)[MEAN])
    return out


def of_smoothers() -> dict[str, list[float]]:
    """Returns the smoothed means of a sequence."""
    torch.manual_seed(5)
    frames = TensorDict({"observation": torch.randn(2, 6, 2)}, [2, 6])
    plain = linear_denkf()
    parts = [plain["transition"], None, plain["observation"], plain["noise"]]
    keys = {"initial": plain.initial, "observation_key": "observation", "process_noise": [0.1, 0.2]}
    makes = {
        "RTS": lambda: RTSSmoother(linear_kalman()),
        "RTS of an EKF": lambda: RTSSmoother(linear_filter("EKF")),
        "RTS of a UKF": lambda: RTSSmoother(linear_filter("UKF")),
        "EnRTS": lambda: EnRTS(linear_denkf()),
        "EnKS": lambda: EnKS(linear_denkf(), lag=2),
        "particles": lambda: ParticleSmoother(moved_particles()),
        "fixed lag": lambda: FixedLag(linear_kalman(), 2),
        "iterated": lambda: IEnKS(*parts, **keys),
    }
    out = {}
    for name, make in makes.items():
        torch.manual_seed(6)
        done = make().sequence(frames.copy())
        out[f"smoother: {name}"] = numbers(done["smoothed", "mean"], done["smoothed", "var"])
    return out


def moved_particles() -> ParticleFilter:
    """Particles whose motion has a density."""
    plain = linear_denkf()
    return ParticleFilter(
        plain["transition"],
        None,
        plain["observation"],
        GaussianLikelihood(observation_key="observation"),
        noise=plain["noise"],
        initial=GaussianPrior([0.5, -0.25], [1.0, 1.0], ensemble_size=16),
        process_noise=[0.3, 0.2],
    )


def of_losses() -> dict[str, list[float]]:
    """Returns each term, and the norm of its gradient."""
    torch.manual_seed(7)
    frames = TensorDict({"observation": torch.randn(3, 5, 2), "state": torch.randn(3, 5, 2)}, [3, 5])
    rich = toy_frames((3, 5), resets=False).set("state", torch.randn(3, 5, 3))
    rich["target_observation"] = torch.randn(3, 5, 2)
    losses = {
        "crps": lambda: (DEnKFLoss(toy_denkf(), observation=1.0, nll=1.0, kl=1.0), rich),
        "energy": lambda: (DEnKFLoss(toy_denkf(), score="energy"), rich),
        "paper": lambda: (DEnKFLoss.paper(toy_denkf()), rich),
        "smoothed": lambda: (DEnKFLoss(toy_denkf("etkf"), smoothed=1.0, smoother=EnRTS), rich),
        "gaussian": lambda: (GaussianLoss(linear_kalman(), nll=1.0), frames),
        "mixture": lambda: (MixtureLoss(particles("soft")), frames),
        "sensor": lambda: (SensorLoss(toy_denkf()), rich),
        "observation": lambda: (ObservationLoss(toy_denkf()), rich),
        "transition": lambda: (TransitionLoss(toy_denkf()), rich),
    }
    out = {}
    for name, make in losses.items():
        torch.manual_seed(8)
        loss, data = make()
        torch.manual_seed(9)
        terms = loss(data.copy())
        for term in sorted(terms.keys()):
            loss.zero_grad()
            if terms[term].requires_grad:
                terms[term].backward(retain_graph=True)
            gradients = [value.grad.square().sum() for value in loss.parameters() if value.grad is not None]
            size = torch.stack(gradients).sum().sqrt() if gradients else torch.zeros(())
            out[f"loss: {name}, {term}"] = numbers(terms[term], size)
    return out


def of_monitors() -> dict[str, list[float]]:
    """Watches innovations, and answers to them."""
    torch.manual_seed(10)
    data = TensorDict({"observation": torch.randn(2, 9, 2)}, [2, 9])
    data["observation"][:, 5] += 6.0
    watched = Monitored(linear_kalman(), InnovationMonitor({"gps": MonitoredSensor("info", 2)}).double())
    out = watched.sequence(data.copy())["monitor", "gps"]
    found = {"monitor": numbers(out["p_value"], out["whiteness"], out["evidence"])}
    for response in ("reject", "student", "huber"):
        for name, filter in (("Kalman", linear_kalman()), ("ensemble", linear_denkf())):
            options = {"response": response, "rate": 0.05, "adapt_noise": 0.1}
            done = Gated(filter, 2, **options).double().sequence(data.copy())
            found[f"gate: {response}, {name}"] = numbers(done[MEAN][:, -1], done["gate", "log_noise"])
    return found


def of_weights() -> dict[str, list[float]]:
    """Runs the pretrained filters on random readings; the car's also on a rendered drive with faults."""
    out = {f"weights: {name}": found for name, found in all_beliefs().items()}
    with tempfile.TemporaryDirectory() as folder:
        render_drives(Path(folder), names="drive", frames=30, size=(100, 300), seed=2032)
        drive = read_kitti_drive(folder, "drive", size=(100, 300), cache=None)
        tracked = track_failing_drive(from_pretrained("car-odometry"), drive, usual_failures(len(drive)))
    out["weights: the car on a drive"] = numbers(tracked[MEAN][-1], tracked[VAR][-1])
    return out


def of_studies() -> dict[str, list[float]]:
    """Computes the studies' smoke settings by their own code; those named so in single precision."""
    before = torch.get_default_dtype()
    try:
        found = {**of_chaotic_systems(), **of_fusion_and_odometry()}
    finally:
        torch.set_default_dtype(before)
    return {f"study: {name}": values for name, values in found.items()}


def of_chaotic_systems() -> dict[str, list[float]]:
    """Returns errors of smoothers, and of the schemes on a truth of few cycles: chaos would make rounding visible."""
    out = {}
    for case in CASES:
        rows = smoothing.rows(case, [0, 1], cycles=26)
        measure = "rmse_filter" if case.method in ("IEnKS", "particles") else "rmse_smoother"
        scored = [row[measure] for row in rows]
        out[f"smoothing, {case.name}"] = numbers(torch.tensor(scored))
    random = schemes.Random(2, stream=0)
    states = [8 + random.randn(schemes.VARIABLES)]
    for _ in range(20):
        states.append(lorenz96_step(states[-1]))
    truth = torch.stack(states)
    readings = torch.stack([state + random.randn(schemes.VARIABLES) for state in states])
    for case in schemes.CASES:
        errors, spreads = schemes.assimilate(case, truth, readings)
        out[f"lorenz96, {case.name}"] = numbers(errors.mean(0), spreads.mean(0))
    return out


def of_fusion_and_odometry() -> dict[str, list[float]]:
    """Returns errors of fused sensors before any training, and of the path of a rendered drive."""
    torch.set_default_dtype(torch.float32)
    torch.manual_seed(11)
    task = fusion.arm_task(demos=(2, 2), steps=3)
    rows = [row for row in fusion.rows(task, fusion.make_weights(task, 0)) if row["method"] == "plain"]
    with tempfile.TemporaryDirectory() as folder, open(devnull, "w") as nowhere, redirect_stdout(nowhere):
        root = Path(folder)
        write_drives(root, ["town"], frames=12, size=(100, 300))
        study = Odometry(root=root, out=root / "out")
        found = track(study, root, "town", study.heights[0])
    measures = ("translation_m_per_m", "rotation_deg_per_m", "scale")
    return {
        "single: fusion": numbers(torch.tensor([row["error"] for row in rows])),
        "single: odometry": numbers(torch.tensor([found[name] for name in measures])),
    }
