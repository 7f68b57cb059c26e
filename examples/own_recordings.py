"""From a folder of recordings to a belief on one page: a cart on a rail, its encoder and a camera.

    python examples/own_recordings.py                    # simulates recordings first
    python examples/own_recordings.py --root FOLDER      # your own runs, in files of the same names

A run is three files: ``RUN.mp4`` from the camera, ``RUN-encoder.csv`` (time, speed) from an encoder on a wheel, and
``RUN-truth.csv`` (time, position, speed) from a reference, such as a tracker, for training and scores. Each has a
different rate, here 10, 100 and 50 Hz, on one clock in s. The camera observes the position, the encoder the speed,
with gaps. ``examples/kitti.py``, ``ur5.py`` and ``lerobot.py`` are the same page for other robots.

Without --root it takes about a minute and a half of one core. Three unseen runs, 30 % of the frames missing: the filter
has errors of about 2 cm and 10 cm/s, the last readings of about 6 cm and 19 cm/s (root mean squared errors). The
coverage of the 90 % intervals is 97 % for the position and 88 % for the speed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
from torchrl.envs import TransformedEnv

from torch_denkf import (
    DEnKFLoss,
    DEnKFTransform,
    Filter,
    FilterTrainer,
    MissingFrames,
    Recording,
    RecordingReplay,
    ReplayEnv,
    SensorLoss,
    Stage,
    Table,
    Video,
)
from torch_denkf.metrics import interval_coverage
from torch_denkf.modules import (
    ConstantNoise,
    DiagonalNoise,
    EnsembleAnalysis,
    FromSensor,
    ImageSensor,
    KeypointTrunk,
    LearnedTransition,
    NoisyTransition,
    Select,
    StochasticMLP,
)
from torch_denkf.plots import plot_bands
from torch_denkf.training import hold_last

RATE = 20.0  # rows per second of the data set


def make_recordings(root: Path, runs: int, seconds: float) -> None:
    """Simulates recordings, in place of yours: a cart that is pushed along a rail of 1.2 m between two springs."""
    root.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    for run in range(runs):
        position, speed, rows = rng.uniform(-0.4, 0.4), 0.0, []
        for k in range(int(seconds * 100)):
            rows.append((0.01 * k, position, speed))
            speed += 0.01 * (-4.0 * position - 0.3 * speed) + 0.05 * rng.normal()
            position += 0.01 * speed
        truth = np.array(rows)
        encoder = truth[:, [0, 2]] + [0.0, 0.05] * rng.normal(size=(len(truth), 2))
        for begin in rng.uniform(1, seconds - 1, 3):  # no readings for a second
            encoder = encoder[(encoder[:, 0] < begin) | (encoder[:, 0] > begin + 1)]
        name = root / f"run{run:02d}"
        options = {"delimiter": ",", "comments": "", "fmt": "%.6f"}
        np.savetxt(f"{name}-truth.csv", truth[::2], header="time,position,speed", **options)
        np.savetxt(f"{name}-encoder.csv", encoder, header="time,speed", **options)
        video = cv2.VideoWriter(f"{name}.mp4", cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (96, 32))
        background = rng.integers(90, 160, (32, 96, 3))
        for _, x, _ in truth[::10]:
            picture = (background + rng.normal(0, 25, background.shape)).clip(0, 255).astype(np.uint8)
            left = round(48 + 50 * x)
            cv2.rectangle(picture, (left - 6, 12), (left + 6, 20), (40, 60, 200), -1)
            video.write(picture)
        video.release()


def read(root: Path, **options) -> RecordingReplay:
    """Returns the runs of a folder on one clock; a hash of a run's name decides its split."""
    runs = [
        Recording(
            name=video.stem,
            camera=Video(video),
            encoder=Table(root / f"{video.stem}-encoder.csv", ["speed"]),
            state=Table(root / f"{video.stem}-truth.csv", ["position", "speed"], sample="linear"),
        )
        for video in sorted(root.glob("*.mp4"))
    ]
    return RecordingReplay(runs, clock=RATE, size=(32, 96), test_share=0.25, **options)


def make_filter(data: RecordingReplay) -> Filter:
    """Returns a filter of learned motion, the camera's sensor and analysis, and the encoder's analysis after it."""
    facts = data.statistics
    loc, scale = facts["state", "mean"], facts["state", "std"]
    transition = LearnedTransition(StochasticMLP(2, 2, output_gain=0.1), loc=loc, scale=scale)
    pushes = (torch.tensor([0.01, 0.2]) * scale).tolist()  # process noise of a step
    initial = FromSensor([0], mean=loc, std=scale, ensemble_size=32)
    encoder = {"observation_key": "encoder", "observed_key": "encoder_observed"}
    encoder |= {"predicted_key": "encoder_predicted", "noise_variance_key": "encoder_noise"}
    return Filter(
        {
            "sensor": ImageSensor(
                1,
                image_shape=(3, 32, 96),
                trunk=KeypointTrunk(3, channels=(16, 24, 32)),
                num_cells=(64,),
                loc=loc[:1],
                scale=scale[:1],
                pixel_loc=facts["pixels", "mean"].flatten(),
                pixel_scale=facts["pixels", "std"].flatten(),
            ),
            "camera_noise": DiagonalNoise(1, r=0.2 * scale[:1], loc=loc[:1], scale=scale[:1]),
            "encoder_noise": ConstantNoise([0.05], trainable=True, in_key="encoder", out_key="encoder_noise"),
            "transition": NoisyTransition(transition, pushes),
            "h_camera": Select([0]),
            "by_camera": EnsembleAnalysis("etkf", belief_prefix="middle"),
            "h_encoder": Select([1], in_key=("middle", "ensemble"), out_key="encoder_predicted"),
            "by_encoder": EnsembleAnalysis("etkf", forecast_key=("middle", "ensemble"), **encoder),
        },
        initial=initial,
    )


def train(model: Filter, data: RecordingReplay, out: Path, updates: tuple[int, int]) -> None:
    """Trains the sensor alone, then the whole filter through 20 steps; resumes after an interruption."""
    scale = data.statistics["state", "std"]
    loss = DEnKFLoss(model, state_scale=scale, observation_scale=scale[:1], nll=0.02)
    sensor = Stage("sensor", SensorLoss(model, observation_scale=scale[:1]), data.draw, updates[0], lengths={0: 8})
    whole = Stage("filter", loss, data.draw, updates[1], lr=1e-3, lengths={0: 10, updates[1] // 2: 20})
    FilterTrainer(model, [sensor, whole], out=out, device="cpu", keep="last").fit()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--updates", nargs=2, type=int, default=(250, 150), help="of the sensor and of the filter")
    parser.add_argument("--root", type=Path, help="folder of runs; made by default")
    parser.add_argument("--out", type=Path, default=Path("runs/own-recordings-page"))
    parser.add_argument("--smoke", action="store_true", help="a tiny run of everything")
    args = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)  # small steps: a second thread gains little
    if args.smoke:
        args.out, args.updates = args.out.with_name("own-recordings-smoke"), (2, 2)
    if args.root is None:
        args.root = args.out / "recordings"
        make_recordings(args.root, runs=24, seconds=4.0 if args.smoke else 20.0)

    # The data set: rows 20 times a second; every second row has a new image.
    cache = args.out / "cache"
    data = read(args.root, cache=cache, num_slices=8, slice_len=20)
    model = make_filter(data)
    train(model, data, args.out / "training", tuple(args.updates))

    # The replay environment, with the filter in it: any torchrl code can step it. Each run is an element of the batch.
    unseen = read(args.root, cache=cache, split="test")
    shortest = min(run.length for run in unseen.episodes)
    env = TransformedEnv(ReplayEnv(unseen, batch_size=[len(unseen.episodes)], length=shortest))
    env.append_transform(MissingFrames(0.3))
    env.append_transform(DEnKFTransform(model, diagnostics=[("sensor", "ensemble")]))
    torch.manual_seed(0)
    seen = env.rollout(shortest)["next"]
    belief, truth = seen["belief", "mean"], seen["state"]
    # The same sensors without a filter, with a zero-order hold.
    start = data.statistics["state", "mean"].expand(len(seen), 2)
    position = hold_last(seen["sensor", "ensemble"].mean(-2), seen["observed"], start[:, :1])
    reading = torch.cat([position, hold_last(seen["encoder"], seen["encoder_observed"], start[:, 1:])], -1)
    print(f"{len(unseen.episodes)} unseen runs, 30 % of the frames missing: root mean squared error, cm and cm/s")
    for name, states in (("filter", belief), ("last readings", reading)):
        error = 100 * (states - truth).square().mean((0, 1)).sqrt()
        print(f"  {name:<15}{error[0]:.1f}  {error[1]:.1f}")
    holds = 100 * interval_coverage(belief, seen["belief", "var"], truth, level=0.9)
    print(f"  90 % coverage: position {holds[0]:.0f} %, speed {holds[1]:.0f} %")
    draw(seen[0], reading[0], args.out / f"{unseen.episodes[0].name}.png")


def draw(seen, reading: torch.Tensor, file: Path) -> None:
    """Draws position and speed with their 90 % bands, truth and readings; shaded in gaps of the encoder."""
    reading = reading.where(torch.cat([seen["observed"], seen["encoder_observed"]], -1), torch.nan)
    dots, names = {dim: reading[:, dim] for dim in (0, 1)}, ["position, cm", "speed, cm/s"]
    shaded = {"observed": "encoder_observed", "time": 1 / RATE}
    axes = plot_bands(seen, names=names, factors=[100, 100], readings=dots, **shaded)
    axes[0].figure.savefig(file, dpi=110)
    print(f"  {file}")


if __name__ == "__main__":
    main()
