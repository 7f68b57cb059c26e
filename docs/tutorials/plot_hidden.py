r"""
A ball behind a pillar
======================

A camera looks at a ball that rolls about in a box. A pillar stands in front. While the ball is behind it, the camera
still reads some place: a network gives a number for every picture. It is wrong for a second, always in the same
direction, and a filter that takes this for noise becomes sure of it.

This page gives the filter a *visibility*: a small network that says how likely the camera's reading is about the ball
at all. :doc:`/how_to/hidden` has the options.
"""

# %%
# Runs and pictures
# -----------------
# The state is the ball's place and speed. The ball bounces off the walls. A label says whether it is seen: 1, 0, or NaN
# where a part of it is behind the pillar.

import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf import DEnKF
from torch_denkf.imperfect import Visibility
from torch_denkf.modules import AroundState, DiagonalNoise, EnsembleAnalysis, ImageSensor, LearnedTransition, Select
from torch_denkf.objectives import SensorLoss

torch.manual_seed(0)
WIDTH, HEIGHT, RADIUS, PUSH = 64, 48, 3.0, 0.02  # pixels; and pixels a step, of what pushes the ball at random
LEFT, RIGHT = 24, 40  # of the pillar
LOW, HIGH = torch.tensor([RADIUS, RADIUS]), torch.tensor([WIDTH, HEIGHT]) - RADIUS


def roll(state):
    """The states ``[*, 4]`` one step later."""
    place, speed = state[..., :2] + state[..., 2:], state[..., 2:]
    inside = place.clamp(LOW, HIGH)
    return torch.cat([2 * inside - place, torch.where(inside == place, speed, -speed)], -1)


def record(runs, steps):
    """States of runs that begin anywhere, and whether the ball is seen."""
    place = LOW + torch.rand(runs, 2) * (HIGH - LOW)
    way = torch.pi / 4 * (2 * torch.rand(runs) - 1) + torch.pi * torch.randint(2, (runs,))
    speed = (0.7 + 0.9 * torch.rand(runs, 1)) * torch.stack([way.cos(), way.sin()], -1)
    state, states = torch.cat([place, speed], -1), []
    for _ in range(steps):
        states.append(state)
        state = roll(state) + nn.functional.pad(PUSH * torch.randn(runs, 2), (2, 0))
    data = TensorDict({"state": torch.stack(states, 1)}, [runs, steps])
    x = data["state"][..., :1]
    hidden, seen = (x - RADIUS >= LEFT) & (x + RADIUS <= RIGHT), (x + RADIUS <= LEFT) | (x - RADIUS >= RIGHT)
    data["visible"] = torch.where(seen, 1.0, torch.where(hidden, 0.0, torch.nan))
    data["start"] = data["state"]
    return data


def draw(states):
    """Pictures ``[*, 1, 48, 64]``: a bright ball, a grey pillar in front of it, noise."""
    noise, pictures = np.random.default_rng(0), []
    for x, y in states[..., :2].reshape(-1, 2).tolist():
        picture = np.full((HEIGHT, WIDTH), 60, np.uint8)
        cv2.circle(picture, (round(16 * x), round(16 * y)), round(16 * RADIUS), 220, -1, cv2.LINE_AA, shift=4)
        picture[:, LEFT:RIGHT] = 120
        pictures.append((picture + noise.normal(0, 10, picture.shape)).clip(0, 255).astype(np.uint8))
    return torch.from_numpy(np.stack(pictures)).reshape(*states.shape[:-1], 1, HEIGHT, WIDTH)


learning, tuning, test = record(60, 60), record(60, 60), record(60, 100)

# %%
# The camera
# ----------
# A small network learns to read the place from a picture. It is told the true place in all pictures, also where no ball
# is to be seen. There it learns to say the middle of the pillar.

trunk = nn.Sequential(
    *(nn.Conv2d(1, 8, 5, 2, 2), nn.ReLU(), nn.Conv2d(8, 16, 3, 2, 1), nn.ReLU()),
    *(nn.Conv2d(16, 16, 3, 2, 1), nn.ReLU(), nn.Flatten(), nn.Linear(16 * 6 * 8, 64), nn.ReLU()),
)
camera = ImageSensor(
    2,
    image_shape=(1, HEIGHT, WIDTH),
    ensemble_size=1,
    trunk=trunk,
    num_cells=(32,),
    layer="none",
    loc=[WIDTH / 2, HEIGHT / 2],
    scale=[16.0, 12.0],
    encoding_key=("sensor", "encoding"),
)
pictures, places = draw(learning["state"]).flatten(0, 1), learning["state"][..., :2].flatten(0, 1)
optimiser = torch.optim.Adam(camera.parameters(), 2e-3)
for _ in range(8):
    for rows in torch.randperm(len(pictures)).split(64):
        read = camera(TensorDict({"pixels": pictures[rows]}, [len(rows)]))["sensor", "ensemble"].squeeze(-2)
        loss = nn.functional.smooth_l1_loss(read, places[rows])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
for data in (tuning, test):
    with torch.no_grad():
        out = camera(TensorDict({"pixels": draw(data["state"])}, data.batch_size))
    data["reading"], data["encoding"] = out["sensor", "ensemble"].squeeze(-2), out["sensor", "encoding"]
seen, hidden = test["visible"].squeeze(-1) == 1, test["visible"].squeeze(-1) == 0
off = (test["reading"] - test["state"][..., :2]).norm(dim=-1)
print(
    f"the camera is off by {off[seen].mean():.1f} pixels where it sees the ball, by {off[hidden].mean():.1f} elsewhere"
)

# %%
# Two filters
# -----------
# Both know the motion, and learn from single readings how wrong those are, on runs that the camera has not seen. The
# noise may grow where the pictures show no ball. The second filter has a visibility, too, and learns it from the
# labels. Behind the pillar it leaves the reading out, as far as it is sure of that.


def make(visibility):
    """A DEnKF of the camera's readings."""
    filter = DEnKF(
        LearnedTransition(roll, residual=False),
        None,
        Select([0, 1]),
        DiagonalNoise(2, r=1.0, in_features=32, in_key="encoding"),
        EnsembleAnalysis("etkf", observation_key="reading"),
        initial=AroundState([2.0, 2.0, 0.5, 0.5], ensemble_size=64, state_key="start"),
        process_noise=[0.0, 0.0, 0.08, 0.08],  # more than the pushes: when the ball bounces is not known well
        visibility=visibility,
    )
    loss = SensorLoss(filter, sensor=0.0, noise=1.0, visible=0.0 if visibility is None else 1.0)
    loss.set_keys(sensor="reading")
    optimiser, frames = torch.optim.Adam(loss.parameters(), 5e-3), tuning.reshape(-1)
    for _ in range(300):
        total = sum(loss(frames[torch.randint(len(frames), (256,))]).values())
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
    return filter


filters = {"believes all": make(None), "knows when it sees": make(Visibility(32, encoding_key="encoding"))}
outs = {}
for name, filter in filters.items():
    with torch.no_grad():
        outs[name] = filter.sequence(test.clone())
    mean, std = outs[name]["belief", "mean"][..., :2], outs[name]["belief", "var"][..., :2].sqrt()
    error = mean - test["state"][..., :2]
    for when, rows in (("seen", seen), ("hidden", hidden)):
        inside = (error.abs() < 1.645 * std)[rows].float().mean()
        print(f"{name}, {when}: off by {error[rows].norm(dim=-1).mean():.1f} pixels, 90 % coverage {inside:.0%}")

# %%
# One run
# -------
# Behind the pillar the band of the second filter opens, and closes when the ball comes out. The lower plot has what the
# visibility says of each picture.

run = int((hidden[:, 20:80].sum(1) - 20).abs().argmin())  # about 20 steps behind the pillar
shown = torch.arange(0, 100, 13)
figure, axes = plt.subplots(3, 1, figsize=(8, 7), height_ratios=[1, 3, 1], layout="constrained")
axes[0].imshow(torch.cat([draw(test["state"][run, t])[0] for t in shown], -1), cmap="gray", vmin=0, vmax=255)
axes[0].set_xticks([WIDTH * (n + 0.5) for n in range(len(shown))], [f"step {t}" for t in shown.tolist()])
axes[0].set_yticks([])
steps = torch.arange(100)
for name, out in outs.items():
    mean, std = out["belief", "mean"][run, :, 0], out["belief", "var"][run, :, 0].sqrt()
    (line,) = axes[1].plot(steps, mean, label=name)
    axes[1].fill_between(steps, mean - 1.645 * std, mean + 1.645 * std, alpha=0.25, color=line.get_color())
axes[1].plot(steps, test["reading"][run, :, 0], ".", color="gray", markersize=4, label="camera")
axes[1].plot(steps, test["state"][run, :, 0], "k--", linewidth=1, label="truth")
axes[1].axhspan(LEFT, RIGHT, color="gray", alpha=0.15)
axes[1].set(ylabel="x, pixels", ylim=(-5, WIDTH + 5))
axes[1].legend(ncols=4, fontsize="small")
axes[2].plot(steps, outs["knows when it sees"]["sensor", "visible"][run, :, 0])
axes[2].set(xlabel="step", ylabel="does it see?", ylim=(-0.05, 1.05))
plt.show()

# %%
# From here
# ---------
# * :doc:`/how_to/hidden`: labels, what to do without them, and coloured noise while the camera sees.
