"""Track a car from its camera: train a DEnKF, append it to an environment, roll out unseen drives.

    python examples/quickstart.py                                                  # renders the drives first
    python examples/quickstart.py --root KITTI --train 00 02 05 --test 09          # real KITTI odometry drives

Four steps, each a function below:

1. ``read_drives``    frames and true states of the drives, in KITTI's layout
2. ``train_sensor``   the image sensor alone: (v, theta_dot) from a frame and its difference to the one before
3. ``train_filter``   transition, sensor curve h and noise model on held-out drives, through 32 steps
4. ``track``          DEnKFTransform in a replay environment of each test drive, 30 % of the frames missing

It prints a comparison with the sensor alone and with dead reckoning, and writes a plot to ``--out``.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.envs import TransformedEnv
from tqdm import tqdm

from torch_denkf import DEnKF, DEnKFLoss, DEnKFTransform, KITTIReplayEnv
from torch_denkf.applications.car import (
    UnicycleMotion,
    UnicycleTransition,
    dead_reckoning,
    read_kitti_drive,
    write_drives,
)
from torch_denkf.applications.car.kitti.frames import drive_frames
from torch_denkf.applications.car.metrics.odometry import kitti_endpoint_error
from torch_denkf.functional import crps_ensemble
from torch_denkf.metrics import interval_coverage
from torch_denkf.modules import (
    AroundState,
    DiagonalNoise,
    EnsembleAnalysis,
    ImageSensor,
    LearnedObservation,
    StochasticMLP,
    convolutional_trunk,
)
from torch_denkf.plots import plot_bands, plot_path
from torch_denkf.training import hold_last

TRUNK = ((24, 5, 2), (32, 3, 2), (48, 3, 2), (64, 3, 2))  # a third of the work of Table I's, which is the default
ENSEMBLE, VELOCITIES = 32, [3, 4]  # members; dimensions of v and theta_dot in [x, y, theta, v, theta_dot]
INITIAL_STD = [0.0, 0.0, 0.0, 0.3, 0.02]  # m, m, rad, m/s, rad/s: the pose is where the drive starts


def read_drives(args: argparse.Namespace) -> tuple[list[TensorDict], list[TensorDict]]:
    """Returns the training and the test drives; generates them without ``--root``."""
    if args.root is None:
        args.pixel_noise = 0.05 if args.pixel_noise is None else args.pixel_noise
        args.root, names = args.out / "drives", [f"{i:02d}" for i in range(args.drives + 4)]
        args.train, args.test = names[:-4], names[-4:]
        for name in tqdm(names, desc="rendering drives", disable=None):
            write_drives(args.root, [name], frames=args.frames, seed=args.seed)
    names = tqdm([*args.train, *args.test], desc="reading drives", disable=None)
    drives = [with_noise(read_kitti_drive(args.root, name), args.pixel_noise or 0.0) for name in names]
    return drives[: len(args.train)], drives[len(args.train) :]


def with_noise(drive: TensorDict, std: float) -> TensorDict:
    """Adds white noise to every image, as from a cheap camera; ``std`` is a share of full scale."""
    drive = drive.clone()  # in memory, because the drive is a memory map
    for image in drive["image"]:
        image.copy_((image + 255 * std * torch.randn(image.shape)).clamp(0, 255).round())
    return drive


def make_filter(frames: TensorDict, dt: float) -> DEnKF:
    """Returns the paper's filter for visual odometry: known motion of the pose, learned change of the velocities."""
    velocity = frames["state"][:, VELOCITIES]
    loc, scale = velocity.mean(0), velocity.std(0)
    image_shape = tuple(frames["pixels"].shape[1:])
    return DEnKF(
        transition=UnicycleTransition(StochasticMLP(2, 2, output_gain=0.1), dt=dt, loc=loc, scale=scale),
        sensor=ImageSensor(
            2,
            image_shape=image_shape,
            trunk=convolutional_trunk(image_shape[0], TRUNK),
            loc=loc,
            scale=scale,
            pixel_loc=frames["pixels"].mean((0, 2, 3)),
            pixel_scale=frames["pixels"].std((0, 2, 3)),
        ),
        observation=LearnedObservation(SensorCurve(loc, scale)),
        noise=DiagonalNoise(2, r=0.3 * scale, loc=loc, scale=scale),
        # Innovations correct the velocities, and each member's pose moves with them.
        analysis=TensorDictSequential(EnsembleAnalysis("sensor", belief_prefix="analysis"), UnicycleMotion(dt)),
        initial=AroundState(INITIAL_STD, ensemble_size=ENSEMBLE),
    )


class SensorCurve(nn.Module):
    """Measurement model h of the paper, for a sensor whose readings of the speed are biased towards their mean."""

    def __init__(self, loc: torch.Tensor, scale: torch.Tensor):
        super().__init__()
        self.correction = StochasticMLP(1, 1, (), layer="none", output_gain=0.0)  # linear; starts as the identity
        self.register_buffer("loc", loc[:1])
        self.register_buffer("scale", scale[:1])

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        v, theta_dot = state[..., VELOCITIES].split(1, -1)
        return torch.cat([v + self.scale * self.correction((v - self.loc) / self.scale), theta_dot], -1)


def mirror(frames: TensorDict) -> TensorDict:
    """Flips frames left to right, and with them the signs of y, theta and theta_dot."""
    frames = frames.copy()
    frames["pixels"] = frames["pixels"].flip(-1)
    frames["state"] = frames["state"] * torch.tensor([1.0, -1.0, -1.0, 1.0, -1.0])
    return frames


def train_sensor(denkf: DEnKF, frames: TensorDict, updates: int) -> None:
    """Fits the sensor's samples to the true velocities, scored by the CRPS."""
    sensor, frames = denkf["sensor"], frames[frames["observed"].squeeze(-1)]
    optimiser = torch.optim.AdamW(sensor.parameters(), lr=2e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=updates, pct_start=0.1)
    for _ in (bar := tqdm(range(updates), desc="training the sensor", disable=None)):
        batch = frames[torch.randint(len(frames), (64,))]
        batch = torch.cat([batch[:32], mirror(batch[32:])])
        samples = sensor(batch)["sensor", "ensemble"]
        loss = (crps_ensemble(samples, batch["state"][:, VELOCITIES]) / sensor.scale).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        bar.set_postfix(crps=f"{loss.item():.3f}")


def read_windows(sensor: ImageSensor, drives: list[TensorDict], length: int) -> tuple[TensorDict, torch.Tensor]:
    """Returns all windows of the sensor's readings, also mirrored, and the standard deviation of its errors."""
    with torch.no_grad():  # the sensor reads every frame once; the filter without it trains on the readings
        readings = [sensor(d.copy()).exclude("pixels", "is_init") for drive in drives for d in (drive, mirror(drive))]
    for reading in readings:
        reading["target_observation"] = reading["sensor", "ensemble"].mean(1)  # the target of h
    errors = torch.cat([reading["target_observation"] - reading["state"][:, VELOCITIES] for reading in readings])
    windows = [r[i : i + length] for r in readings for i in range(1, len(r) - length + 1)]
    return torch.stack(windows), errors.std(0)


def train_filter(denkf: DEnKF, drives: list[TensorDict], updates: int, length: int = 32) -> None:
    """Fits transition, h and noise model end to end through ``length`` steps, on the frozen sensor's readings."""
    windows, error_std = read_windows(denkf["sensor"], drives, length)
    # Windows start from a noisy velocity: a filter that always starts at the truth learns to trust its start.
    start_std = torch.cat([torch.zeros(3), 0.3 * denkf["sensor"].scale])
    recursion = DEnKF(
        sensor=None,
        **{name: denkf[name] for name in ("transition", "observation", "noise", "analysis")},
        initial=AroundState(start_std, ensemble_size=ENSEMBLE, state_key="start"),
    )
    scale = torch.cat([torch.full((3,), torch.inf), error_std])  # the pose follows from the velocities
    weights = {"state": 0.4, "transition": 0.4, "observation": 1.0}
    loss = DEnKFLoss(recursion, **weights, sensor=0.0, state_scale=scale, observation_scale=error_std)
    optimiser = torch.optim.Adam(recursion.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=updates)
    for _ in (bar := tqdm(range(updates), desc="training the filter", disable=None)):
        batch = windows[torch.randint(len(windows), (64,))]
        batch["start"] = batch["state"] + start_std * torch.randn(64, 1, 5)
        kept = torch.rand(64, length + 1, 1) >= 0.5 * torch.rand(64, 1, 1)  # frames; a pair needs both of its frames
        batch["observed"] = batch["observed"] & kept[:, 1:] & kept[:, :-1]
        terms = loss(batch)
        optimiser.zero_grad()
        sum(terms.values()).backward()
        torch.nn.utils.clip_grad_norm_(recursion.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        bar.set_postfix({name: f"{value.item():.3f}" for name, value in terms.items()})


def track(denkf: DEnKF, drive: TensorDict, missing: float) -> TensorDict:
    """Removes some frames of a drive, appends the filter to its replay, and rolls it out."""
    drive = drive.clone()
    drive["frame_valid"] &= torch.rand(len(drive), 1) >= missing
    env = TransformedEnv(KITTIReplayEnv(drive), DEnKFTransform(denkf, diagnostics=[("sensor", "ensemble")]))
    return env.rollout(len(drive))["next"]


def estimate(rollout: TensorDict, mean_velocity: torch.Tensor, dt: float) -> dict[str, torch.Tensor]:
    """Returns the states [T, 5] of one drive by the filter, the sensor alone and dead reckoning."""
    start, readings, observed = rollout["state"][0, :3], rollout["sensor", "ensemble"].mean(1), rollout["observed"]
    held = hold_last(readings, observed, rollout["state"][0, VELOCITIES])

    def integrated(velocity: torch.Tensor) -> torch.Tensor:
        return torch.cat([dead_reckoning(velocity, start, dt), velocity], -1)

    return {
        "sensor alone (training mean where it is blind)": integrated(readings.where(observed, mean_velocity)),
        "dead reckoning (last reading where it is blind)": integrated(held),
        "**DEnKF**": rollout["belief", "mean"],
        "floor: dead reckoning with the true velocities": integrated(rollout["state"][:, VELOCITIES]),
    }


def compare(rollouts: list[TensorDict], estimates: list[dict], window: int) -> str:
    """Returns a Markdown table of errors, averaged over the drives."""
    lines = [
        f"| | translation, m/m over {window} steps | rotation, deg/m | v, RMSE m/s | theta_dot, RMSE deg/s |",
        "|---|---|---|---|---|",
    ]
    for name in estimates[0]:
        scores = []
        for rollout, states in zip(rollouts, estimates, strict=True):
            error = kitti_endpoint_error(states[name][:, :3], rollout["state"][:, :3], window=window)
            velocity = (states[name] - rollout["state"])[:, VELOCITIES].square().mean(0).sqrt()
            scores.append([float(error.translation), float(error.rotation), *velocity.tolist()])
        translation, rotation, v, theta_dot = torch.tensor(scores).mean(0).tolist()
        lines.append(f"| {name} | {translation:.3f} | {rotation:.3f} | {v:.2f} | {theta_dot * 57.2958:.2f} |")
    together = torch.cat([r.select("state", "belief") for r in rollouts])
    belief, truth = together["belief"], together["state"]
    v, theta_dot = 100 * interval_coverage(belief["mean"], belief["var"], truth, level=0.9)[VELOCITIES]
    blind = 100 * (1 - torch.cat([r["observed"] for r in rollouts]).float().mean())
    lines.append(f"\nThe sensor is blind in {blind:.0f} % of the steps. 90 % coverage of the DEnKF: v {v:.0f} %, ")
    return "\n".join(lines) + f"theta_dot {theta_dot:.0f} %."


def draw(rollout: TensorDict, estimates: dict, dt: float, file: Path) -> None:
    """Draws the path on the ground plane with its ensemble, and the velocities over time with their 90 % bands."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot as plt

    fig, axes = plt.subplot_mosaic("pv;pw", figsize=(13, 6), width_ratios=[1, 1.4], layout="constrained")
    plot_path(rollout, others={"sensor alone": next(iter(estimates.values()))}, forward_up=True, ax=axes["p"])
    readings = rollout["sensor", "ensemble"].mean(1)
    plot_bands(
        rollout,
        dims=VELOCITIES,
        names=["v, m/s", "theta_dot, deg/s"],
        factors=[1.0, 57.2958],
        readings={dim: readings[:, number] for number, dim in enumerate(VELOCITIES)},
        time=dt,
        ax=[axes["v"], axes["w"]],
    )
    unseen = 100 * (1 - rollout["observed"].float().mean())
    fig.suptitle(f"An unseen drive; missing frames leave the sensor blind in {unseen:.0f} % of the steps")
    fig.savefig(file, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, help="folder in KITTI odometry layout; drives are generated without it")
    parser.add_argument("--train", nargs="+", help="drives to train on; the last quarter trains the filter alone")
    parser.add_argument("--test", nargs="+", help="unseen drives")
    parser.add_argument("--pixel-noise", type=float, help="camera noise, share of full scale; 0.05 on generated drives")
    parser.add_argument("--missing", type=float, default=0.3, help="probability that a test frame is missing")
    parser.add_argument("--sensor-updates", type=int, default=1000, help="training steps of the sensor")
    parser.add_argument("--updates", type=int, default=200, help="training steps of the filter")
    parser.add_argument("--drives", type=int, default=24, help="generated drives to train on")
    parser.add_argument("--frames", type=int, default=250, help="frames of a generated drive")
    parser.add_argument("--window", type=int, default=100, help="steps of the endpoint error")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/quickstart"))
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs")
    args = parser.parse_args()
    if args.smoke:
        args.sensor_updates, args.updates, args.drives, args.frames, args.window = 5, 5, 3, 40, 20
        args.out = args.out / "small"
    if args.root is not None and (not args.train or len(args.train) < 2 or not args.test):
        parser.error("--root needs --train with two drives or more, and --test")
    torch.manual_seed(args.seed)
    torch.set_num_threads(max(1, (os.cpu_count() or 2) // 2))  # small steps: more threads would wait for cores
    args.out.mkdir(parents=True, exist_ok=True)

    training, tests = read_drives(args)
    dt = float(tests[0]["dt"][0])
    frames = [drive_frames(drive) for drive in training]
    held = max(1, len(frames) // 4)  # held-out drives, on which the sensor's errors are those on new data
    sensor_frames = torch.cat(frames[:-held])
    denkf = make_filter(sensor_frames, dt)
    train_sensor(denkf, sensor_frames, args.sensor_updates)
    train_filter(denkf, frames[-held:], args.updates)
    rollouts = [track(denkf, drive, args.missing) for drive in tests]
    estimates = [estimate(rollout, denkf["sensor"].loc, dt) for rollout in rollouts]
    table = compare(rollouts, estimates, args.window)
    draw(rollouts[0], estimates[0], dt, args.out / "quickstart.png")
    (args.out / "table.md").write_text(table + "\n")
    print(f"\nUnseen drives {' '.join(args.test)}, {args.missing:.0%} of the frames missing:\n\n{table}\n")
    print(f"Picture of drive {args.test[0]}: {args.out / 'quickstart.png'}")


if __name__ == "__main__":
    main()
