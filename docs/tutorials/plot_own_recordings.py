r"""
Your own files: a video and a table
===================================

A camera films a pendulum, and an encoder at the pendulum's axis writes a table. On the robot there will be the camera
alone. A filter is to tell the angle and the speed from the pictures, also while something hides the pendulum.

This page goes all the way: from files to a data set, from pictures to a learned sensor, from there to a trained filter,
and into an environment that replays a recording which the filter has not seen. The filter is a *differentiable ensemble
Kalman filter* (DEnKF). Its *belief* is an *ensemble*: 32 guesses of the state, whose mean is the estimate and whose
spread says how sure the filter is. In each time step a network moves every guess (the *forecast*), and what the sensor
reads from the picture pulls the guesses towards itself (the *analysis*).
"""

# %%
# The files
# ---------
# This block stands for your laboratory: it writes 14 recordings of 8 s. Each is a video with 20 images per second and a
# CSV table with 50 rows per second. Both clocks start at the same time. The pictures are small, grey and noisy.

import csv
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from torch_denkf import DEnKF, DEnKFTransform
from torch_denkf.data import Recording, RecordingReplay, Table, Video
from torch_denkf.envs import ReplayEnv
from torch_denkf.metrics import ensemble_interval_coverage, state_errors
from torch_denkf.modules import DiagonalNoise, GaussianPrior, ImageSensor, LearnedTransition, Select, StochasticMLP
from torch_denkf.modules.sensor import convolutional_trunk
from torch_denkf.objectives import DEnKFLoss, SensorLoss
from torch_denkf.plots import plot_bands, write_video
from torch_denkf.training import FilterTrainer, Stage

torch.manual_seed(0)
FPS, RATE, SECONDS, SIZE = 20, 50, 8, (24, 32)  # pictures per second; rows per second; s; height and width of a picture
folder = Path(tempfile.mkdtemp())


def write_recording(name: str) -> None:
    """Writes NAME.mp4 and NAME.csv."""
    angle, speed, fine = 2.0 * torch.rand(()) - 1.0, 4.0 * torch.rand(()) - 2.0, 100  # simulated at 100 Hz
    states = []
    for _ in range(SECONDS * fine):
        speed = speed + (-8.0 * angle.sin() - 0.2 * speed) / fine + 0.05 * torch.randn(())
        angle = angle + speed / fine
        states.append(torch.stack([angle, speed]))
    states = torch.stack(states)
    rows, columns = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    bob = states[:: fine // FPS, :1, None]
    x, y = SIZE[1] / 2 + 13 * bob.sin(), 4 + 15 * bob.cos()
    pictures = 0.2 + 0.7 * (-((columns - x).square() + (rows - y).square()) / 6).exp()
    write_video(folder / f"{name}.mp4", (pictures + 0.08 * torch.randn(pictures.shape)).clamp(0, 1), FPS)
    with open(folder / f"{name}.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["t", "angle", "speed"])
        for row, state in enumerate(states[:: fine // RATE].tolist()):
            table.writerow([row / RATE, *(round(number, 4) for number in state)])


names = [f"run{number:02d}" for number in range(14)]
for name in names:
    write_recording(name)
print(sorted(path.name for path in folder.iterdir())[:4], "...")
print(*(folder / "run00.csv").read_text().splitlines()[:3], sep="\n")

# %%
# The data set
# ------------
# A ``Recording`` names the streams of one episode. ``RecordingReplay`` reads them and brings them onto one clock, here
# the camera's: one row for each picture. The table has other times; ``sample="linear"`` takes straight lines between
# its rows. What comes out is one of torchrl's replay buffers. ``slice_len=16`` asks for slices of 16 successive rows.


def read(names: list[str], **options) -> RecordingReplay:
    """Some of the recordings as a data set."""
    recordings = [
        Recording(
            camera=Video(folder / f"{name}.mp4"),
            state=Table(folder / f"{name}.csv", time="t", columns=["angle", "speed"], sample="linear"),
        )
        for name in names
    ]
    return RecordingReplay(recordings, clock="camera", size=SIZE, cache=False, progress=False, **options)


def hide(rows: TensorDict) -> TensorDict:
    """Somebody stands before the camera in the fourth second."""
    hidden = (rows["time"] >= 3.0) & (rows["time"] < 4.0)
    return rows.set("observed", rows["observed"] & ~hidden)


train, validation = read(names[:10], num_slices=16, slice_len=16), read(names[10:12])
unseen = read(names[12:], transform=hide)
batch = train.sample()
print({key: tuple(batch[key].shape) for key in ("pixels", "state", "observed", "time")})

# sphinx_gallery_thumbnail_number = 2
figure, axes = plt.subplots(1, 5, figsize=(8, 1.45), layout="constrained")
for axis, frame in zip(axes, batch[0, ::3], strict=False):
    axis.imshow(frame["pixels"].permute(1, 2, 0))
    axis.set(xticks=[], yticks=[], title=f"{frame['time'].item():.2f} s")
plt.show()

# %%
# The filter
# ----------
# * ``sensor``: some convolutions read a picture once. Then a small network reads the angle off what they found, once
#   for each guess. Some of its units are dropped at random, so the samples differ. ``loc`` and ``scale`` say in which
#   range angles lie; they come from the training recordings.
# * ``noise``: how far off the sensor is. It is learned.
# * ``transition``: where a state goes in one step. A network learns it, and drops units at random, too.
# * ``process_noise``: the wind changes the speed by about 0.1 rad/s in a step.
# * ``observation``: which part of a state the sensor reads, here number 0, the angle.

statistics = train.statistics
loc, scale = statistics["state", "mean"], statistics["state", "std"]
denkf = DEnKF(
    transition=LearnedTransition(StochasticMLP(2, 2, (64, 64), output_gain=0.1), loc=loc, scale=scale),
    sensor=ImageSensor(
        1,
        image_shape=(3, *SIZE),
        trunk=convolutional_trunk(3, ((8, 5, 2), (16, 3, 2))),
        num_cells=(64, 32),
        rate=0.05,
        loc=loc[:1],
        scale=scale[:1],
        pixel_loc=statistics["pixels", "mean"].flatten(),
        pixel_scale=statistics["pixels", "std"].flatten(),
    ),
    observation=Select([0]),
    noise=DiagonalNoise(1, r=0.1),
    initial=GaussianPrior(loc, scale, ensemble_size=32),
    process_noise=[0.0, 0.1],
)

# %%
# The training
# ------------
# ``FilterTrainer`` runs two stages. The first one trains the sensor alone, on single pictures. The second one freezes
# the sensor, and trains the motion and the noise on slices of 16 steps. Both losses score samples by the *continuous
# ranked probability score* (CRPS): it is small where the samples are near the truth and as wide as they are wrong.
# After some updates the trainer validates, and at the end it keeps the parameters with the smallest validation error:
# that of the samples' mean in the first stage, that of the belief in the second. *RMSE* is the root of the mean squared
# error. A training that is killed continues from ``out`` when it is started again.


def sensor_error() -> dict[str, float]:
    """Of the sensor alone, on the recordings for validation."""
    frames = validation[:]
    samples = denkf["sensor"](frames)["sensor", "ensemble"]
    return {"rmse": state_errors(samples.mean(-2), frames["state"][:, :1]).rmse.item()}


def filter_error() -> dict[str, float]:
    """Of the filter, each component in units of its standard deviation."""
    runs = denkf.sequence(validation[:].reshape(2, -1))
    return {"rmse": (state_errors(runs["belief", "mean"], runs["state"]).rmse / scale).mean().item()}


def pictures(generator: torch.Generator, length: None) -> TensorDict:
    """Single rows of the recordings for the training."""
    return train[torch.randint(len(train), (64,), generator=generator)]


def slices(generator: torch.Generator, length: None) -> TensorDict:
    """Slices of 16 rows; the trainer seeds what the data set draws."""
    return train.sample()


rest = [*denkf["transition"].parameters(), *denkf["noise"].parameters()]
sensor_loss = SensorLoss(denkf, noise=0.1, observation_scale=scale[:1])
filter_loss = DEnKFLoss(denkf, sensor=0.0, nll=0.1, state_scale=scale)
stages = [
    Stage("sensor", sensor_loss, pictures, updates=120, lr=4e-3, validate=sensor_error),
    Stage("filter", filter_loss, slices, updates=60, lr=1e-2, parameters=rest, validate=filter_error),
]
trainer = FilterTrainer(denkf, stages, out=folder / "out", validate_every=30, device="cpu", progress=False)
for name, best in trainer.fit().items():
    print(f"stage {name}: smallest validation error {best['value']:.3f}, after {best['update']} updates")

# %%
# An environment that replays a recording
# ---------------------------------------
# ``ReplayEnv`` shows a recording row by row, as a robot would have seen it. ``DEnKFTransform`` appends the belief to
# each row. On a robot another environment takes the place of ``ReplayEnv``, and nothing else changes. In these
# recordings nobody sees the pendulum in the fourth second: ``hide`` set ``"observed"`` to False there.

env = TransformedEnv(
    ReplayEnv(unseen, batch_size=[2]), DEnKFTransform(denkf, diagnostics=[("sensor", "ensemble"), ("info", "nis")])
)
run = env.rollout(1000)["next"]  # ends with the recordings
print("steps:", run.shape[1], " belief:", tuple(run["belief", "ensemble"].shape))

late, seen = run[:, FPS:], run["observed"][:, FPS:, 0]  # without the first second
error = state_errors(late["belief", "mean"], late["state"]).rmse
reading = run["sensor", "ensemble"].mean(-2)[..., 0]
alone = (reading[:, FPS:] - late["state"][..., 0])[seen].square().mean().sqrt()
pairs = seen[:, 1:] & seen[:, :-1]
differences = FPS * reading[:, FPS:].diff(dim=1)
crude = (differences - late["state"][:, 1:, 1])[pairs].square().mean().sqrt()
inside = ensemble_interval_coverage(late["belief", "ensemble"], late["state"], level=0.9)
print(f"sensor alone, where it sees: angle {alone:.3f} rad, speed by differences {crude:.2f} rad/s")
print(f"filter, hidden second too:   angle {error[0]:.3f} rad, speed {error[1]:.2f} rad/s")
print(f"90 % coverage: angles {inside[0]:.0%}, speeds {inside[1]:.0%}")
assert alone < 0.15
assert error[0] < 0.12
assert error[1] < 0.7 * crude
assert (inside - 0.9).abs().max() < 0.15

# %%
# One of the unseen recordings. While nobody sees the pendulum, the network swings all guesses on. They drift apart, so
# the band grows; the first picture after that pulls them together.

figure, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained")
shown = run[0]
options = {"time": shown["time"][:, 0]}
plot_bands(shown, dims=[0], names=["angle, rad"], readings={0: reading[0]}, **options, ax=axes[0])
plot_bands(shown, dims=[1], names=["speed, rad/s"], **options, legend=False, ax=axes[1])
axes[0].set_xlabel("")
plt.show()

# %%
# From here
# ---------
# * Folders of images, Parquet files, clocks that start at different times: :py:obj:`~torch_denkf.data.Images`,
#   :py:obj:`~torch_denkf.data.Table`, :py:obj:`~torch_denkf.data.Video`.
# * An encoder that the robot has, too: :doc:`plot_two_sensors`.
# * A network for the pictures of your own: :doc:`/how_to/own_sensor`.
# * The filter on the robot: :doc:`plot_to_robot`.
