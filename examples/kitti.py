"""From a data set to a belief on one page: a car's motion from its camera, on drives in KITTI's layout.

    python examples/kitti.py                                                   # renders the drives first
    python examples/kitti.py --root KITTI --train 00 02 05 08 --test 09        # KITTI's odometry benchmark

A data set, a filter, its training, a replay environment with the filter in it, errors, a plot: each is a few lines
of ``main``. ``examples/ur5.py``, ``lerobot.py`` and ``own_recordings.py`` are the same page for other robots. The full
study, with every filter and disturbance, is ``python -m benchmarks.kitti``.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import torch
from tensordict.nn import TensorDictSequential
from torchrl.envs import TransformedEnv

from torch_denkf import DEnKF, DEnKFLoss, DEnKFTransform, FilterTrainer, MissingFrames, SensorLoss, Stage
from torch_denkf.applications.car import (
    FlowSensor,
    KITTIOdometryExperienceReplay,
    dead_reckoning,
    with_motion,
    write_drives,
)
from torch_denkf.applications.car.metrics.odometry import kitti_endpoint_error
from torch_denkf.applications.car.modules.unicycle import UnicycleMotion, UnicycleTransition
from torch_denkf.envs import ReplayEnv
from torch_denkf.metrics import interval_coverage
from torch_denkf.modules import AroundState, DiagonalNoise, EnsembleAnalysis, Select, StochasticMLP
from torch_denkf.plots import plot_bands, plot_path

VELOCITIES = [3, 4]  # v in m/s and theta_dot in rad/s, of the state [x, y, theta, v, theta_dot]


def make_filter(data: KITTIOdometryExperienceReplay) -> DEnKF:
    """Returns the filter: known motion of the pose, learned change of the velocities, read from optical flow."""
    dt = float(data[0]["dt"])
    loc, scale = data.statistics["velocity", "mean"], data.statistics["velocity", "std"]
    return DEnKF(
        transition=UnicycleTransition(StochasticMLP(2, 2, output_gain=0.1), dt=dt, loc=loc, scale=scale),
        sensor=FlowSensor(dt=dt),
        observation=Select(VELOCITIES),
        noise=DiagonalNoise(2, r=0.2 * scale, loc=loc, scale=scale),
        # Innovations correct the velocities, and each member's pose moves with them.
        analysis=TensorDictSequential(EnsembleAnalysis("sensor", belief_prefix="analysis"), UnicycleMotion(dt)),
        initial=AroundState([0.0, 0.0, 0.0, *(0.2 * scale).tolist()], ensemble_size=32),  # around the true start
        process_noise=[0.0, 0.0, 0.0, *(0.1 * scale).tolist()],  # random change of the velocities in a step
    )


def train(denkf: DEnKF, data: KITTIOdometryExperienceReplay, out: Path, updates: tuple[int, int]) -> None:
    """Trains the sensor alone, then the whole filter through 16 steps; resumes after an interruption."""
    scale = data.statistics["velocity", "std"]
    of_sensor = SensorLoss(denkf, observation_scale=scale)
    # The pose follows from the velocities: an infinite scale removes its errors. nll trains the noise model.
    of_filter = DEnKFLoss(denkf, state_scale=[float("inf")] * 3 + scale.tolist(), observation_scale=scale, nll=0.02)
    stages = [
        Stage("sensor", of_sensor, data.draw, updates[0], lengths={0: 1}),  # single rows, 160 in a batch, see main
        Stage("filter", of_filter, data.draw, updates[1], lr=1e-3, lengths={0: 8, updates[1] // 2: 16}),
    ]
    FilterTrainer(denkf, stages, out=out, device="cpu", keep="last").fit()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, help="folder with sequences and poses; rendered drives by default")
    parser.add_argument("--train", nargs="+", default=["00", "01", "02", "03", "04", "05", "06", "07"])
    parser.add_argument("--test", nargs="+", default=["08", "09"])
    parser.add_argument("--out", type=Path, default=Path("runs/kitti-page"))
    parser.add_argument("--updates", nargs=2, type=int, default=(600, 150), help="of the sensor and of the filter")
    parser.add_argument("--smoke", action="store_true", help="a tiny run of everything")
    args = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(2)
    if args.smoke:
        args.out, args.train, args.test, args.updates = args.out.with_name("kitti-tiny"), ["00"], ["08"], (2, 2)
    size, cache = (100, 300), args.out / "cache"
    if args.root is None:
        args.root = args.out / "drives"
        write_drives(args.root, [*args.train, *args.test], frames=20 if args.smoke else 150, size=size)

    # The data set: optical flow and the road's correlation of all frames, computed once and cached.
    flow = partial(with_motion, keep_images=False, cache=cache)
    drives = partial(KITTIOdometryExperienceReplay, args.root, colour=False, size=size, flow=flow, cache=cache)
    data = drives(args.train, mirrored=True, num_slices=8 if args.smoke else 32, slice_len=16)
    denkf = make_filter(data)
    train(denkf, data, args.out / "training", tuple(args.updates))

    # The replay environment, with the filter in it: any torchrl code can step it.
    unseen = drives(args.test)
    for drive in unseen.episodes:
        env = TransformedEnv(ReplayEnv(unseen, episodes=drive.name))
        env.append_transform(MissingFrames(0.3, in_keys=("flow", "road")))
        env.append_transform(DEnKFTransform(denkf))
        torch.manual_seed(0)
        seen = env.rollout(drive.length)["next"]
        belief, truth = seen["belief", "mean"], seen["state"]
        dt = float(unseen[0]["dt"])
        # The same sensor without a filter, with a zero-order hold for missing frames.
        with torch.no_grad():
            reading = denkf["sensor"](seen.clone())["sensor", "ensemble"].mean(-2)
        for t in range(1, len(reading)):
            reading[t] = torch.where(seen["observed"][t], reading[t], reading[t - 1])
        reckoned = dead_reckoning(reading, truth[0, :3], dt)
        holds = interval_coverage(*(x[:, VELOCITIES] for x in (belief, seen["belief", "var"], truth)), level=0.9)
        window = min(100, len(truth) - 1)
        print(f"{drive.drive}: end point error over {window} steps, m/m and deg/m, 30 % of the frames missing")
        for name, path in (("DEnKF", belief), ("dead reckoning", reckoned)):
            error = kitti_endpoint_error(path[:, :3], truth[:, :3], window=window)
            print(f"  {name:<15}{error.translation.item():.3f}  {error.rotation.item():.3f}")
        print(f"  90 % coverage: v {100 * holds[0]:.0f} %, theta_dot {100 * holds[1]:.0f} %")
        draw(seen, reckoned, args.out / f"{drive.drive}.png")


def draw(seen, reckoned: torch.Tensor, file: Path) -> None:
    """Draws the path with its ensemble, the truth and dead reckoning; the velocities with their 90 % bands."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplot_mosaic([["path", "v"], ["path", "turn"]], figsize=(11, 6), layout="constrained")
    plot_path(seen, others={"dead reckoning": reckoned}, forward_up=True, ax=axes["path"])
    names = ["v, m/s", "theta_dot, rad/s"]
    plot_bands(seen, dims=VELOCITIES, names=names, observed=seen["observed"], ax=[axes["v"], axes["turn"]])
    figure.savefig(file, dpi=110)
    plt.close(figure)
    print(f"  {file}")


if __name__ == "__main__":
    main()
