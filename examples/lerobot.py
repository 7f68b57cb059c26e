"""From a LeRobot folder to a belief on one page: a robot's joints from one of its cameras, also while the camera fails.

    python examples/lerobot.py                                                      # makes a small folder first
    python examples/lerobot.py --root FOLDER --camera top --state observation.state --joints 7:14

It reads any folder of LeRobot 2.0, 2.1 or 3.0. The sensor reads the joints from single images. Recorded commands, if
any, drive the filter's motion, which is learned. The page prints errors on unseen episodes next to those of baselines,
and writes a plot and a video to --out. ``kitti.py``, ``ur5.py`` and ``own_recordings.py`` are the same
page for other robots. It needs pyarrow: ``pip install "torch_denkf[lerobot,plots]"``.

Without --root it takes a minute of one core. Unseen episodes, no images in one second of four, mean absolute error of
two joints: 0.024 rad for the filter, 0.096 for the last reading, 0.047 for the filter without a camera, 0.47 for the
mean pose; 90 % coverage is 88 %. A Unitree G1's right arm takes four minutes with --updates 1000 300 200:
0.0096 rad, 0.0447, 0.0091 (its commands suffice), 0.1415; 84 %. A synthetic crane of two joints, 20 episodes at 15 Hz
with images two rows late, takes 1.5 minutes: 0.86 degrees, 2.92, 1.86, 27.6; 90 %.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
from collections.abc import Sequence
from fnmatch import fnmatch
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from torch_denkf import DEnKF, DEnKFTransform, Filter
from torch_denkf.data import Episode, EpisodeReplay, LeRobotReplay, lag_errors
from torch_denkf.envs import ReplayEnv
from torch_denkf.metrics import interval_coverage
from torch_denkf.modules import (
    ConstantNoise,
    DiagonalNoise,
    EnsembleAnalysis,
    FromSensor,
    ImageSensor,
    KeypointTrunk,
    LearnedTransition,
    ScaledNoise,
    Select,
    StochasticMLP,
)
from torch_denkf.monitoring import BlackIsMissing
from torch_denkf.objectives import DEnKFLoss, SensorLoss, TransitionLoss
from torch_denkf.plots import belief_video, plot_bands
from torch_denkf.training import FilterTrainer, Stage, choose, hold_last


def write_folder(root: Path, episodes: int, rows: int) -> None:
    """Writes a LeRobot 2.1 folder of a two-joint arm that follows its commands with a lag, drawn by OpenCV."""
    import pyarrow
    from pyarrow import parquet

    rng, lines = np.random.default_rng(0), []
    for folder in ("meta", "data", "videos/top"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    for episode in range(episodes):
        name, k = f"episode_{episode:06d}", np.arange(rows)
        waves = rng.uniform(0.01, 0.03, (2, 3)), rng.uniform(0, 6.28, (2, 3))
        action = 0.5 * np.sin(2 * np.pi * waves[0] * k[:, None, None] + waves[1]).sum(-1)
        state, angles = [], rng.uniform(-1, 1, 2)
        video = cv2.VideoWriter(f"{root}/videos/top/{name}.mp4", cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (64, 64))
        for command in action:
            state.append(angles)
            elbow = np.array([32, 32]) + 16 * np.array([np.cos(angles[0]), np.sin(angles[0])])
            tip = elbow + 12 * np.array([np.cos(angles.sum()), np.sin(angles.sum())])
            points = [tuple(int(16 * x) for x in point) for point in ((32, 32), elbow, tip)]  # in sixteenths of a pixel
            picture = (110 + rng.normal(0, 20, (64, 64, 3))).clip(0, 255).astype(np.uint8)
            cv2.line(picture, points[0], points[1], (40, 60, 220), 5, cv2.LINE_AA, 4)
            cv2.line(picture, points[1], points[2], (220, 160, 30), 3, cv2.LINE_AA, 4)
            video.write(picture)
            angles = angles + 0.3 * (command - angles) + 0.03 * rng.normal(size=2)
        video.release()
        numbers = {"observation.state": np.array(state), "action": action}
        table = {key: pyarrow.array(list(value.astype(np.float32))) for key, value in numbers.items()}
        table |= {"timestamp": k / 10, "frame_index": k, "episode_index": np.full(rows, episode)}
        parquet.write_table(pyarrow.table(table), root / f"data/{name}.parquet")
        lines.append(json.dumps({"episode_index": episode, "length": rows}))
    (root / "meta/episodes.jsonl").write_text("\n".join(lines))
    vector = {"dtype": "float32", "shape": [2], "names": ["shoulder", "elbow"]}
    features = {"observation.state": vector, "action": vector, "top": {"dtype": "video", "shape": [64, 64, 3]}}
    paths = {"data_path": "data/episode_{episode_index:06d}.parquet"}
    paths["video_path"] = "videos/{video_key}/episode_{episode_index:06d}.mp4"
    info = {"codebase_version": "v2.1", "fps": 10, "features": features, **paths}
    (root / "meta/info.json").write_text(json.dumps(info))


def places_of(asked: Sequence[str], names: Sequence[str]) -> list[int]:
    """Returns indices in the state for ``7:14``, ``3``, ``gripper`` or ``right_*``."""
    places: list[int] = []
    for each in asked:
        first, colon, last = each.partition(":")
        number = range(int(first or 0), int(last or len(names))) if colon else [int(each)] if each.isdigit() else None
        found = [place for place, name in enumerate(names) if fnmatch(name, each)] if number is None else number
        if not found:
            raise SystemExit(f"--joints {each}: there is none among {', '.join(names)}")
        places += found
    return places


def dead(rows: TensorDict) -> torch.Tensor:
    """Returns the mask of the camera's failure, one second of four, ``[*B, 1]``."""
    return rows["time"] % 4 >= 3


def fail(rows: TensorDict) -> TensorDict:
    """Returns rows whose images are missing while the camera fails."""
    return rows.set("observed", rows["observed"] & ~dead(rows))


def go_black(rows: TensorDict) -> TensorDict:
    """Returns rows whose images are black while the camera fails, which is detected from the images."""
    rows = BlackIsMissing()(rows.set("pixels", rows["pixels"] * ~dead(rows)[..., None, None]))
    return rows.set("observed", rows["seen"])


def make_filter(data: LeRobotReplay) -> DEnKF:
    """Returns the filter: learned motion, driven by commands if there are any; a sensor that reads single images."""
    facts, row = data.statistics, data[0]
    loc, scale = facts["state", "mean"], facts["state", "std"].clamp_min(1e-3)  # a joint may never move
    joints, image, driven = len(loc), tuple(row["pixels"].shape), "action" in row
    commands = {"action_key": "action", "action_loc": facts["action", "mean"]} if driven else {}
    if driven:
        commands["action_scale"] = facts["action", "std"].clamp_min(1e-3)
    # Linear: joints follow their commands, and stay where they are without commands. Widths such as (64, 64) instead
    # of () learn other motions, too.
    motion = StochasticMLP(joints + (row["action"].shape[-1] if driven else 0), joints, (), output_gain=0.0)
    motion.requires_grad_(driven)
    wind = (0.1 if driven else 0.3) * scale  # process noise of the joints, before training
    wind = ConstantNoise(wind, trainable=True, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    return DEnKF(
        transition=LearnedTransition(motion, loc=loc, scale=scale, **commands),
        sensor=ImageSensor(
            joints,
            image_shape=image,
            trunk=KeypointTrunk(image[0], channels=(16, 24, 32, 48)),
            num_cells=(64,),
            loc=loc,
            scale=scale,
            pixel_loc=facts["pixels", "mean"].flatten(),
            pixel_scale=facts["pixels", "std"].flatten(),
        ),
        observation=Select(range(joints)),
        noise=ScaledNoise(DiagonalNoise(joints, r=0.5 * scale, loc=loc, scale=scale)),
        # The spread follows from R, as the samples' spread is that on training images.
        analysis=EnsembleAnalysis("etkf"),
        initial=FromSensor(range(joints), mean=loc, std=scale, ensemble_size=32),
        process_noise=ScaledNoise(wind),
    )


@torch.no_grad()
def read(denkf: DEnKF, data: LeRobotReplay, **options) -> EpisodeReplay:
    """Reads every image by the sensor once: a filter learns many times as fast from readings as from images."""
    parts = [denkf["sensor"](data[rows]).exclude("pixels") for rows in torch.arange(len(data)).split(256)]
    return EpisodeReplay(torch.cat(parts), data.episodes, for_tests=lambda episode: False, **options)


def train(denkf: DEnKF, data: LeRobotReplay, held_out: LeRobotReplay, out: Path, updates: Sequence[int]) -> None:
    """Trains the sensor and the motion, then the noise models on held-out episodes."""
    scale, trainer = denkf.initial.std, {"device": "cpu", "keep": "last"}
    of_sensor = SensorLoss(denkf, observation_scale=scale)
    of_motion = TransitionLoss(denkf, state_scale=scale)
    stages = [
        Stage("sensor", of_sensor, data.draw, updates[0], weight_decay=0.02, lengths={0: 1}),
        Stage("motion", of_motion, data.draw, updates[1], lengths={0: 2}),
    ]
    FilterTrainer(denkf, stages, out=out / "parts", **trainer).fit()  # resumes after an interruption

    # The filter without its sensor: the same modules, for precomputed readings.
    behind = Filter({name: denkf[name] for name in denkf.module if name != "sensor"}, initial=denkf.initial)
    shortest = min(episode.length for episode in held_out.episodes)
    readings = read(denkf, held_out, num_slices=12, slice_len=min(48, shortest), transform=fail)
    of_filter = DEnKFLoss(behind, sensor=0.0, state_scale=scale)
    stage = Stage("filter", of_filter, readings.draw, updates[2], lr=4e-3)
    FilterTrainer(behind, [stage], out=out / "filter", **trainer).fit()

    # One factor on all noise sets the coverage of the 90 % intervals to 90 %.
    runs = readings.draw(torch.Generator().manual_seed(0), shortest)

    def coverage_error() -> float:
        torch.manual_seed(0)
        with torch.no_grad():
            beliefs = behind.sequence(runs.copy())["belief"]
        return abs(interval_coverage(beliefs["mean"], beliefs["var"], runs["state"], level=0.9).mean().item() - 0.9)

    noises = [module for module in denkf.modules() if isinstance(module, ScaledNoise)]
    candidates = (0.4, 0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.4, 1.7, 2.0, 2.4, 2.8, 3.3, 4.0)
    factor = choose(candidates, lambda by: [setattr(noise, "factor", by) for noise in noises], coverage_error)
    print(f"noise times {factor}, chosen on {len(held_out.episodes)} episodes that the sensor has not seen")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, help="LeRobot folder; a small one is made by default")
    parser.add_argument("--camera", help="of the folder, if it has several")
    parser.add_argument("--state", default="observation.state", help="feature that the belief is about")
    parser.add_argument(
        "--joints", nargs="+", default=[":"], help="of the state: 7:14, 3, gripper, right_*; default all"
    )
    parser.add_argument("--action", default="action", help="feature of the commands")
    parser.add_argument("--no-commands", action="store_true", help="ignore recorded commands")
    parser.add_argument("--episodes", nargs="+", type=int, help="numbers of the episodes to read; all by default")
    parser.add_argument("--lag", type=int, help="rows by which states are later than images; estimated by default")
    parser.add_argument("--size", nargs=2, type=int, default=(96, 128), help="height and width to scale images to")
    parser.add_argument(
        "--held-out", type=float, default=0.2, help="share of the episodes without training of the sensor"
    )
    parser.add_argument(
        "--updates", nargs=3, type=int, help="of sensor, motion, filter; by default from the size of the data"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/lerobot-page"))
    parser.add_argument("--smoke", action="store_true", help="a tiny run of everything")
    args = parser.parse_args()
    if importlib.util.find_spec("pyarrow") is None:
        message = 'LeRobot keeps its numbers in parquet files: pip install "torch_denkf[lerobot]", for pyarrow'
        if not args.smoke:
            raise SystemExit(message)
        print(message)
        return
    torch.manual_seed(0)
    torch.set_num_threads(1)  # small steps: a second thread gains little
    if args.smoke:
        args.out, args.updates = args.out.with_name("lerobot-smoke"), (2, 2, 2)
    if args.root is None:
        args.root, args.size = args.out / "folder", (64, 64)
        write_folder(args.root, 10 if args.smoke else 40, rows=50 if args.smoke else 100)

    # The data: a hash assigns one episode of five to the tests. A repeated image has no new information.
    options = {"state_key": args.state, "size": tuple(args.size), "cache": args.out / "cache", "repeats": "mask"}
    options |= {"action_key": None if args.no_commands else args.action, "validation_share": args.held_out}
    options["episodes"] = args.episodes
    folder = partial(LeRobotReplay, args.root, camera=args.camera, **options)
    whole = folder()
    width = whole[0]["state"].shape[-1]
    names = whole.names or [f"state {place}" for place in range(width)]
    joints = places_of(args.joints, names)
    alike = "action" in whole[0] and whole[0]["action"].shape[-1] == width  # then commands to other joints are noise
    folder = partial(folder, dims=joints, action_dims=joints if alike else None)
    if args.lag is None:
        errors = lag_errors(folder())
        args.lag = min(errors, key=errors.get)
    folder = partial(folder, lag=args.lag)
    data, held_out = folder(num_slices=64, slice_len=2), folder(split="validation")
    print(f"{len(data.episodes)} episodes, {len(data)} rows, {data.repeats_masked} of them with repeated pictures;")
    print(f"{len(joints)} of {width} numbers of the state, which are {args.lag} rows later than the pictures")
    args.updates = args.updates or (min(max(8 * len(data) // 64, 300), 3000), 400, 200)
    digest = hashlib.sha256(repr(sorted(vars(args).items())).encode()).hexdigest()[
        :8
    ]  # other options have another training
    denkf = make_filter(data)
    train(denkf, data, held_out, args.out / f"training-{digest}", args.updates)

    # The replay environment, with the filter in it: any torchrl code can step it. Commands are replayed, too.
    unseen, blind = folder(split="test", transform=go_black), folder(split="test", transform=no_picture)
    mean, seen, readings, alone = data.statistics["state", "mean"], [], [], []
    for episode in unseen.episodes[:5]:
        seen.append(believe(denkf, unseen, episode))
        # The same sensor without a filter, with a zero-order hold; and the same filter without a camera.
        reading = seen[-1]["sensor", "ensemble"].mean(-2)
        readings.append(hold_last(reading, seen[-1]["observed"], mean))
        alone.append(believe(denkf, blind, episode)["belief", "mean"])
        seen[-1] = (
            seen[-1] if len(seen) == 1 else seen[-1].exclude("pixels")
        )  # only those of the first episode are shown
    names = [names[place] for place in joints]
    report(seen, {"last reading": readings, "no camera": alone}, mean, names)
    draw(seen[0], readings[0], data, names, args.out / unseen.episodes[0].name)


def no_picture(rows: TensorDict) -> TensorDict:
    """Returns rows of a robot without a camera."""
    return rows.set("observed", torch.zeros_like(rows["observed"]))


def believe(denkf: DEnKF, data: LeRobotReplay, episode: Episode) -> TensorDict:
    """Replays an episode, and returns it with the belief in each row."""
    env = TransformedEnv(ReplayEnv(data, episodes=episode.name))
    env.append_transform(DEnKFTransform(denkf, diagnostics=[("sensor", "ensemble")]))
    torch.manual_seed(0)
    return env.rollout(episode.length)["next"]


def report(seen: list[TensorDict], others: dict[str, list], mean: torch.Tensor, names: Sequence[str]) -> None:
    """Prints mean absolute errors and coverage of the intervals, joint by joint."""
    rows = torch.cat([run.exclude("pixels") for run in seen])
    belief, truth = rows["belief", "mean"], rows["state"]
    ways = {"DEnKF": belief, **{name: torch.cat(runs) for name, runs in others.items()}, "mean pose": mean}
    errors = torch.stack([(way - truth).abs().mean(0) for way in ways.values()], -1)
    holds = interval_coverage(belief, rows["belief", "var"], truth, level=0.9)
    print(f"{len(seen)} unseen episodes, no pictures in one second of four: mean absolute error in the folder's units")
    print(" " * 24 + "".join(f"{name:>14}" for name in ways) + "  90 % holds")
    for name, row, share in zip([*names, "all"], [*errors, errors.mean(0)], [*holds, holds.mean()], strict=True):
        print(f"{name:<24}" + "".join(f"{error:14.4f}" for error in row.tolist()) + f"{100 * share:10.0f} %")


def draw(seen: TensorDict, reading: torch.Tensor, data: LeRobotReplay, names: Sequence[str], stem: Path) -> None:
    """Draws a plot and a video of the four joints that move most: 90 % bands, truth, readings; shaded if no images."""
    dims = sorted(data.statistics["state", "std"].argsort(descending=True)[:4].tolist())
    bands = {"dims": dims, "names": [names[dim] for dim in dims]}
    shared = {"observed": ~dead(seen), "time": seen["time"].flatten()}
    dots = {dim: reading[:, dim].where(seen["observed"][:, 0], torch.nan) for dim in dims}
    axes = plot_bands(seen, readings=dots, **bands, **shared)
    axes[0].figure.savefig(stem.with_suffix(".png"), dpi=110)
    print(f"  {stem.with_suffix('.png')}")
    every = max(round(data.fps / 15), 1)
    print(f"  {belief_video(stem.with_suffix('.mp4'), seen, seen['pixels'], bands=bands, every=every, **shared)}")


if __name__ == "__main__":
    main()
