"""From a LeRobot folder to a belief on one page: a robot's joints from one of its cameras.

    python examples/lerobot.py                                                      # a small folder that is made here
    python examples/lerobot.py --root FOLDER --camera top --state observation.state

Any folder of LeRobot 2.0, 2.1 or 3.0 will do. The sensor reads the state from single pictures. Where commands were
recorded, they drive the filter's motion, which is learned. ``examples/kitti.py``, ``ur5.py`` and ``own_recordings.py``
are the same page for other robots. Needs pyarrow: ``pip install "torch_denkf[lerobot]"``.

Without --root it takes about a minute. Unseen episodes, 30 % of the frames missing, mean absolute error of two joints:
about 0.06 rad for the filter, 0.07 for the last reading, 0.47 for the mean pose. The 90 % intervals hold 97 %: they are
wider than they need be. A folder of a real robot wants many more updates than the default.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from torchrl.envs import ExcludeTransform, TransformedEnv

from torch_denkf import DEnKF, DEnKFTransform, MissingFrames
from torch_denkf.data import LeRobotReplay
from torch_denkf.envs import ReplayEnv
from torch_denkf.metrics import interval_coverage
from torch_denkf.modules import DiagonalNoise, FromSensor, ImageSensor, LearnedTransition, Select, StochasticMLP
from torch_denkf.modules.keypoints import KeypointTrunk
from torch_denkf.objectives import DEnKFLoss, SensorLoss
from torch_denkf.plots import plot_bands
from torch_denkf.training import FilterTrainer, Stage, hold_last


def write_folder(root: Path, episodes: int, rows: int) -> None:
    """A LeRobot 2.1 folder of a two-joint arm that follows its commands with a lag; OpenCV draws it."""
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


def make_filter(data: LeRobotReplay) -> DEnKF:
    """Learned motion, under the commands where there are any, and a sensor that reads the state from one picture."""
    facts, row = data.statistics, data[0]
    loc, scale = facts["state", "mean"], facts["state", "std"].clamp_min(1e-3)  # a joint may never move
    joints, image = len(loc), tuple(row["pixels"].shape)
    commands = row["action"].shape[-1] if "action" in row else 0
    return DEnKF(
        transition=LearnedTransition(
            StochasticMLP(joints + commands, joints, output_gain=0.1),
            loc=loc,
            scale=scale,
            action_key="action" if commands else None,
        ),
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
        noise=DiagonalNoise(joints, r=0.3 * scale, loc=loc, scale=scale),
        initial=FromSensor(range(joints), mean=loc, std=scale, ensemble_size=32),
        process_noise=(0.03 * scale).tolist(),
    )


def train(denkf: DEnKF, data: LeRobotReplay, out: Path, updates: tuple[int, int]) -> None:
    """The sensor alone, then all of the filter through 16 steps; resumes where it was broken off."""
    scale = denkf.initial.std
    of_sensor = SensorLoss(denkf, observation_scale=scale)
    of_filter = DEnKFLoss(denkf, state_scale=scale, observation_scale=scale, nll=0.02)
    stages = [
        Stage("sensor", of_sensor, data.draw, updates[0], lengths={0: 4}),
        Stage("filter", of_filter, data.draw, updates[1], lr=1e-3, lengths={0: 8, updates[1] // 2: 16}),
    ]
    FilterTrainer(denkf, stages, out=out, device="cpu", keep="last").fit()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, help="LeRobot folder; a small one is made by default")
    parser.add_argument("--camera", help="of the folder, where it has several")
    parser.add_argument("--state", default="observation.state", help="feature that the belief is about")
    parser.add_argument("--size", nargs=2, type=int, default=(64, 64), help="height and width to scale pictures to")
    parser.add_argument("--out", type=Path, default=Path("runs/lerobot-page"))
    parser.add_argument("--updates", nargs=2, type=int, default=(300, 150), help="of the sensor and of the filter")
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
        args.out, args.updates = args.out.with_name("lerobot-smoke"), (2, 2)
    if args.root is None:
        args.root = args.out / "folder"
        write_folder(args.root, 10 if args.smoke else 30, rows=20 if args.smoke else 100)

    # The data set: of five episodes one is for tests, drawn by a hash of its number.
    options = {"state_key": args.state, "size": tuple(args.size), "cache": args.out / "cache"}
    folder = partial(LeRobotReplay, args.root, camera=args.camera, **options)
    data = folder(num_slices=8, slice_len=16)
    denkf = make_filter(data)
    train(denkf, data, args.out / "training", tuple(args.updates))

    # The replay environment, with the filter in it: any torchrl code can step it. Commands are replayed, too.
    unseen, mean, rollouts = folder(split="test"), data.statistics["state", "mean"], []
    for episode in unseen.episodes[:5]:
        env = TransformedEnv(ReplayEnv(unseen, episodes=episode.name))
        env.append_transform(MissingFrames(0.3))
        env.append_transform(DEnKFTransform(denkf, diagnostics=[("sensor", "ensemble")]))
        env.append_transform(ExcludeTransform("pixels"))  # they have been read
        torch.manual_seed(0)
        rollouts.append(env.rollout(episode.length)["next"])
    # The same sensor without a filter: its last reading is held where a frame is missing.
    readings = [hold_last(seen["sensor", "ensemble"].mean(-2), seen["observed"], mean) for seen in rollouts]
    seen, reading = torch.cat(rollouts), torch.cat(readings)
    belief, truth = seen["belief", "mean"], seen["state"]
    print(f"{len(rollouts)} unseen episodes, 30 % of the frames missing: mean absolute error in the folder's units")
    for name, states in (("DEnKF", belief), ("last reading", reading), ("mean pose", mean.expand_as(truth))):
        print(f"  {name:<15}{(states - truth).abs().mean():.4f}")
    holds = interval_coverage(belief, seen["belief", "var"], truth, level=0.9)
    print(f"  the 90 % intervals hold {100 * holds.mean():.0f} % of the truth")
    draw(rollouts[0], readings[0], unseen, args.out / f"{unseen.episodes[0].name}.png")


def draw(seen, reading: torch.Tensor, data: LeRobotReplay, file: Path) -> None:
    """The four numbers of the state that move most, with their 90 % bands, the truth and the last readings."""
    dims = sorted(data.statistics["state", "std"].argsort(descending=True)[:4].tolist())
    names = [data.names[dim] if data.names else f"state {dim}" for dim in dims]
    axes = plot_bands(seen, dims=dims, names=names, readings={dim: reading[:, dim] for dim in dims}, time=1 / data.fps)
    axes[0].figure.savefig(file, dpi=110)
    print(f"  {file}")


if __name__ == "__main__":
    main()
