r"""
From the notebook to the robot
==============================

A filter is trained on a workstation, and used on a robot. The robot's computer is slow, it has no time for surprises,
and it may lack the libraries of the training. This page trains a small filter, makes its step fast, writes the step
into a file, and runs the file in a loop as a robot does. It measures how long a step takes, and checks that all ways
give the same numbers.

The robot's joint has an encoder, which reads the angle 100 times a second. The filter is to tell the joint's speed,
which nobody measures. Its *belief* is an *ensemble*: 32 guesses of [angle in rad, speed in rad/s], whose mean is the
estimate and whose spread says how sure the filter is.
"""

# %%
# A small training
# ----------------
# The joint swings with friction, and its load changes. In each step a network moves all guesses (the *forecast*), and
# the reading corrects them (the *analysis*). ``TransitionLoss`` trains the network alone: one step from each recorded
# true state. :doc:`plot_training` trains whole filters.

import json
import tempfile
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import onnxruntime
import torch
from tensordict import TensorDict

from torch_denkf import DEnKF, TransitionLoss, export_step, load_step
from torch_denkf.metrics import state_errors
from torch_denkf.modules import ConstantNoise, GaussianPrior, LearnedTransition, Select
from torch_denkf.plots import plot_bands

torch.manual_seed(0)
DT, NOISE, MEMBERS = 0.01, 0.02, 32  # s; rad; guesses


def record(swings: int, steps: int) -> TensorDict:
    """True states and readings, [swings, steps]."""
    angle, speed, states = 0.5 * torch.randn(swings), 2.0 * torch.randn(swings), []
    for _ in range(steps):
        speed = speed - DT * (40.0 * angle + 1.0 * speed) + 0.1 * torch.randn(swings)
        angle = angle + DT * speed
        states.append(torch.stack([angle, speed], -1))
    state = torch.stack(states, 1)
    encoder = state[..., :1] + NOISE * torch.randn(swings, steps, 1)
    return TensorDict({"state": state, "encoder": encoder}, [swings, steps])


scale = torch.tensor([0.5, 2.0])  # about the standard deviations of angle and speed; the network works in these units
change = torch.nn.Linear(2, 2)  # what a step adds to a state
torch.nn.init.zeros_(change.weight)
torch.nn.init.zeros_(change.bias)
denkf = DEnKF(
    transition=LearnedTransition(change, scale=scale),
    sensor=None,
    observation=Select([0]),
    noise=ConstantNoise([NOISE], in_key="encoder"),
    initial=GaussianPrior([0.0, 0.0], scale, ensemble_size=MEMBERS),
    process_noise=[0.002, 0.1],
    observation_key="encoder",
)
train, unseen = record(100, 200), record(1, 400)[0]
loss, updates = TransitionLoss(denkf, score="mse", state_scale=scale), 200
optimiser = torch.optim.Adam(loss.parameters())
schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-2, total_steps=updates)
for _ in range(updates):
    total = sum(loss(train[torch.randint(100, (16,))]).values())
    optimiser.zero_grad()
    total.backward()
    optimiser.step()
    schedule.step()
learned = (scale.unsqueeze(-1) * change.weight / scale).detach()
print("a step adds to [angle, speed]:", learned, sep="\n")
assert abs(learned[0, 1] - DT) < 0.002
assert abs(learned[1, 0] + 40 * DT) < 0.15

# %%
# The same random numbers everywhere
# ----------------------------------
# The filter draws random numbers in each step. ``draw_noise`` writes them next to the reading, and whatever runs the
# step then uses these numbers instead of its own. So several ways to run a step can be compared to the last digits.
# Here the numbers of all steps are drawn in advance.

denkf.requires_grad_(False)
frames = [denkf.draw_noise(TensorDict({"encoder": reading})) for reading in unseen["encoder"]]
frames = [frame.exclude(("noise", "initial")) for frame in frames]  # for the first belief, which comes next
start = denkf.initialise(TensorDict({}))


def run(step, state: TensorDict | dict, frames: list, key) -> tuple[torch.Tensor, torch.Tensor]:
    """Takes a step with each frame; returns the beliefs' ensembles [T, E, 2] and the milliseconds of each step [T]."""
    ensembles, milliseconds = [], []
    for frame in frames:
        state.update(frame.copy())
        begun = time.perf_counter()
        state = step(state)
        milliseconds.append(1e3 * (time.perf_counter() - begun))
        ensembles.append(state[key])
    return torch.stack(ensembles), torch.tensor(milliseconds)


ways = {"eager": run(denkf.step, start.copy(), frames, ("belief", "ensemble"))}

# %%
# Compile it
# ----------
# ``compile`` puts all further steps through torch's compiler. The first step then takes some seconds, because it is
# compiled; ``compile(chunk=0)`` goes back. Without ``chunk=1`` sequences are compiled, too, four steps at a time.

denkf = denkf.compile(chunk=1)
begun = time.perf_counter()
run(denkf.step, start.copy(), frames[:2], ("belief", "ensemble"))
print(f"compiled in {time.perf_counter() - begun:.0f} s")
ways["compiled"] = run(denkf.step, start.copy(), frames, ("belief", "ensemble"))
denkf = denkf.compile(chunk=0)

# %%
# Write it into a file
# --------------------
# ``export_step`` writes one step into a file. It gets an example: the entries that the step is to read, in the shapes
# of the real ones. Noise that stands in the example becomes an input of the file; without it, the file draws its own.
#
# ``compiled=False`` writes the graph of the step, which any machine with torch can run. By default ``export_step`` also
# compiles it for the processor. That takes about half a minute, and the step is then several times faster. This page
# leaves it out to be built quickly.

folder = Path(tempfile.mkdtemp())
package = export_step(denkf, frames[0].clone().update(start), folder / "checked.pt2", compiled=False)
free = export_step(denkf, TensorDict({"encoder": torch.zeros(1)}), folder / "step.pt2", compiled=False)
print(f"{free.name}: {free.stat().st_size / 1e3:.0f} kB")

# %%
# On the robot
# ------------
# From here on nothing of the training is needed: ``load_step`` imports torch alone. A step takes a dictionary of
# tensors and returns one. ``inputs`` says what it needs, and ``carry`` names what continues to the next step. Names of
# nested entries have dots.

step = load_step(free)
print("inputs:", {name: shape for name, (shape, _) in step.inputs.items()})
print("carried on:", step.carry, " returned:", step.outputs)

state = {"belief.ensemble": 0.5 * torch.randn(MEMBERS, 2) * torch.tensor([1.0, 4.0])}
belief, late = [], 0
with torch.inference_mode():
    for reading in unseen["encoder"]:  # stands for the robot's encoder
        begun = time.perf_counter()
        out = step({**state, "encoder": reading})
        state = {name: out[name] for name in step.carry}
        late += time.perf_counter() - begun > DT
        belief.append(TensorDict({name: out[f"belief.{name}"] for name in ("ensemble", "mean", "var")}))
tracked = TensorDict({"belief": torch.stack(belief), "state": unseen["state"]}, unseen.shape)
error = state_errors(tracked["belief", "mean"][50:], unseen["state"][50:]).rmse
crude = (unseen["encoder"].diff(dim=0)[:, 0] / DT - unseen["state"][1:, 1])[50:].square().mean().sqrt()
print(f"RMSE: angle {error[0]:.3f} rad, speed {error[1]:.2f} rad/s; speed by differences of readings {crude:.2f} rad/s")
print(f"{late} of {len(belief)} steps took longer than {1e3 * DT:.0f} ms")
assert error[1] < 0.3 * crude

# %%
# Without torch
# -------------
# A robot may have no room for torch. ``format="onnx"`` writes the step as an `ONNX <https://onnx.ai>`_ model, which
# `onnxruntime <https://onnxruntime.ai>`_ runs from Python, C++, C# or Java. Writing one needs
# ``pip install "torch_denkf[onnx]"``.
#
# All noise is an input of the model, here standard normal numbers. The model's description says what its outputs are
# called, and which of them go on to the next step. Between the first line and the last three, numpy and onnxruntime
# are all that is needed.

model = export_step(denkf, frames[0].clone().update(start), folder / "step.onnx", format="onnx")

session = onnxruntime.InferenceSession(model)
names = json.loads(session.get_modelmeta().custom_metadata_map["torch_denkf"])
noises = {entry.name: entry.shape for entry in session.get_inputs() if entry.name.startswith("noise.")}
rng = np.random.default_rng(0)
ensemble = rng.standard_normal((MEMBERS, 2), np.float32) * np.array([0.5, 2.0], np.float32)
carried, speeds = {"belief.ensemble": ensemble}, []
for reading in unseen["encoder"].numpy():  # stands for the robot's encoder
    noise = {name: rng.standard_normal(shape, np.float32) for name, shape in noises.items()}
    out = dict(zip(names["outputs"], session.run(None, {**carried, **noise, "encoder": reading}), strict=True))
    carried = {name: out[name] for name in names["carry"]}
    speeds.append(out["belief.mean"][1])
off = (torch.from_numpy(np.stack(speeds)) - unseen["state"][:, 1])[50:].square().mean().sqrt()
print(f"{model.name}: {model.stat().st_size / 1e3:.0f} kB, noise {noises}; RMSE of the speed {off:.2f} rad/s")
assert off < 0.3 * crude

# %%
# Does it give the same, and how long does it take?
# -------------------------------------------------
# With the same noise, the compiled step and both files give the eager filter's ensembles, up to rounding.
# ``load_step`` reads an ONNX model, too. The times are those of the machine that built this page. What counts on a
# robot is the slow end: *p99* is the time within which 99 of 100 steps are done.

flat = [dict(frame.flatten_keys(".").items()) for frame in frames]
for name, path in {"file": package, "ONNX": model}.items():
    ways[name] = run(load_step(path), dict(start.flatten_keys(".").items()), flat, "belief.ensemble")
for name, (ensembles, milliseconds) in ways.items():
    difference = (ensembles - ways["eager"][0]).abs().max()
    median, slow = torch.quantile(milliseconds, torch.tensor([0.5, 0.99])).tolist()
    print(f"{name:8s}: median {median:.2f} ms, p99 {slow:.2f} ms; largest difference from eager {difference:.1e}")
    assert difference < 1e-3

# %%
# The first second and a half of the joint, as the robot saw it. Then the share of steps that were done within a time.
# On a computer that other programs use, too, the slow end is mostly theirs.

figure, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained")
shown, seconds = tracked[:150], DT * torch.arange(150)
plot_bands(shown, dims=[0], names=["angle, rad"], readings={0: unseen["encoder"][:150, 0]}, time=seconds, ax=axes[0])
plot_bands(shown, dims=[1], names=["speed, rad/s"], time=seconds, legend=False, ax=axes[1])
axes[0].set_xlabel("")
plt.show()

figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
for name, (_, milliseconds) in ways.items():
    axis.plot(milliseconds.sort().values, 100 * torch.linspace(0, 1, len(milliseconds)), label=name)
axis.set(xscale="log", xlabel="time of a step, ms", ylabel="steps done, %")
axis.set_xticks([0.2, 0.5, 1, 2, 5, 10], ["0.2", "0.5", "1", "2", "5", "10"])
axis.minorticks_off()
axis.legend(frameon=False, loc="lower right")
axis.grid(alpha=0.2)
plt.show()

# %%
# From here
# ---------
# * A program for a loop at 1 kHz, whose robot's side imports torch alone: ``examples/deploy.py``.
# * Readings that are missing, and errors in the loop: :doc:`/how_to/online_loop`.
# * Is the filter still right on the robot? :doc:`plot_diagnostics`.
