r"""
A sensor that fails silently
==================================

An arm's joint has an encoder. One day the encoder slips: for a while it reads a few degrees too much. Nothing in the
data says so. A filter follows its sensor, and is wrong without a sign of it.

This page notices. A *monitor* watches the *innovations*, each reading minus what the filter's forecast predicted, and
raises an alarm. A *gate* goes further: it keeps the filter from believing what the innovations speak against. And the
page says which faults are too small to be noticed at all.
"""

# %%
# The joint
# ---------
# The state is [angle in degrees, its rate in degrees a step]. The joint swings at random. The encoder reads the angle,
# with 0.5 degrees of noise. ``slip`` is added from step 100 to step 130.

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict

from torch_denkf import Gated, KalmanFilter, Monitored
from torch_denkf.monitoring import InnovationMonitor, MonitoredSensor

torch.manual_seed(0)
STEPS, FROM, TO, NOISE, PUSH = 200, 100, 130, 0.5, 0.02
MOVE = torch.tensor([[1.0, 1.0], [0.0, 0.98]])


def swing(runs: int, slip: float = 0.0) -> TensorDict:
    """True states and readings, ``[runs, STEPS]``."""
    state, states = torch.zeros(runs, 2), []
    for _ in range(STEPS):
        state = state @ MOVE.mT + torch.tensor([0.0, PUSH]) * torch.randn(runs, 2)
        states.append(state)
    truth = torch.stack(states, 1)
    reading = truth[..., :1] + NOISE * torch.randn(runs, STEPS, 1)
    reading[:, FROM:TO] += slip
    return TensorDict({"state": truth, "encoder": reading}, [runs, STEPS])


def joint() -> KalmanFilter:
    """A Kalman filter: motion and reading are linear, and their noise is known."""
    noises = {"process_noise": [0.0, PUSH], "noise": [NOISE]}
    start = {"mean": torch.zeros(2), "cov": 0.01 * torch.eye(2)}
    return KalmanFilter(MOVE, torch.eye(1, 2), **noises, observation_key="encoder", **start)


# %%
# What to watch
# -------------
# While the filter's model is right, the innovation's square in standard deviations of what the filter expects (the
# *normalised innovation squared*, NIS) is a chi-square variable. :class:`~torch_denkf.monitoring.InnovationMonitor`
# tests three things at each step, and its false alarms are as rare as you ask for:  * the sum of the NIS over a
# *window*: finds what is large; * a cumulative sum, *CUSUM*, of by how much the NIS exceed what is usual: finds what
# stays; * with ``whiteness=True`` the correlation of one innovation with the next.  ``calibrate`` takes the
# distributions from clean recordings. Here they are those of theory; a filter with few members or learned parts has
# wider ones.

monitor = InnovationMonitor({"encoder": MonitoredSensor("info", 1)}, window=10, false_alarm_rate=1e-3)
with torch.no_grad():
    watched = Monitored(joint(), monitor).calibrate([swing(100)])
    sound, slipped = watched.sequence(swing(100)), watched.sequence(swing(100, slip=4.0))
alarms = 1000 * sound["monitor", "alarm"].float().mean()
delay = slipped["monitor", "alarm"][:, FROM:TO, 0].float().argmax(1).float()
print(f"encoder without faults: an alarm in {alarms:.1f} of 1,000 steps")
print(f"slipped by 4 degrees: alarm {delay.median():.0f} steps later (median of 100 runs)")
assert alarms < 4
assert delay.median() <= 3

# %%
# What is too small
# -----------------
# A filter follows its sensor, so that a bias shows in the innovations for a short time only.
# :meth:`~torch_denkf.monitoring.InnovationMonitor.detectable_bias` says which bias *of the innovations* the window
# finds in nine of ten cases. The figure shows what this means for the slip: one of one degree, which is two standard
# deviations of a reading, is hardly ever found. Read such a curve before you take silence for a good sign.

smallest = monitor.detectable_bias()["encoder"]
print(f"smallest bias of the innovations that is found: {smallest:.1f} standard deviations")
slips, found = [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0], []
with torch.no_grad():
    for slip in slips:
        alarm = watched.sequence(swing(60, slip=slip))["monitor", "alarm"][:, FROM:TO, 0]
        found.append(alarm.any(1).float().mean().item())
figure, axis = plt.subplots(figsize=(6, 3), layout="constrained")
axis.plot(slips, found, "o-")
axis.set(xlabel="slip, degrees", ylabel="share that is found while it lasts", ylim=(0, 1.05))
plt.show()
assert found[0] < 0.3
assert found[-1] > 0.95

# %%
# The gate
# --------
# :class:`~torch_denkf.monitoring.Gated` sums up the NIS of the last three readings before it lets the latest one
# correct the belief. With ``response="reject"`` a reading above the limit is left out. ``"student"`` and ``"huber"``
# enlarge its variance instead. That is right for single outliers. But a sensor that stays wrong draws the belief over,
# a little in each step.  A gate that rejects continues from the motion alone, and its uncertainty grows. ``patience``
# says for how many readings. Here the encoder slips by 10 degrees. A slip of 4 would get in: after 25 steps without a
# reading the forecast is so uncertain that a reading 4 degrees off fits it.

data = swing(100, slip=10.0)
filters = {"no gate": joint()}
for response in ("student", "reject"):
    filters[response] = Gated(joint(), response=response, rate=1e-4, patience=80)
with torch.no_grad():
    outs = {name: filter.sequence(data.copy()) for name, filter in filters.items()}
errors = {}
for name, out in outs.items():
    off = (out["belief", "mean"] - out["state"])[..., 0].abs()
    errors[name] = [off[:, rows].mean().item() for rows in (slice(50, FROM), slice(FROM, TO), slice(TO + 10, None))]
    before, during, after = errors[name]
    print(f"{name:8s} degrees off: {before:.2f} before, {during:.2f} during the slip, {after:.2f} afterwards")
assert errors["reject"][1] < 0.6 * errors["no gate"][1]

# %%
# One run. Grey: the encoder is off. The alarm comes within a few steps. Then the plain filter has followed the encoder,
# the innovations are small again, and the alarm ends: an alarm says that something *changed*. The gate's belief stays
# with the truth, with growing uncertainty, for as long as its forecast is good.

figure, axes = plt.subplots(3, 1, figsize=(8, 6.5), sharex=True, layout="constrained")
one, steps = 2, torch.arange(STEPS)
with torch.no_grad():
    plain = watched.sequence(data.copy())[one]
axes[0].semilogy(steps, plain["info", "nis"][:, 0].clamp_min(1e-2), color="tab:gray", linewidth=0.8)
axes[0].set_ylabel("NIS")
axes[1].plot(steps, plain["monitor", "encoder", "cusum"][:, 0], label="CUSUM")
axes[1].axhline(monitor.cusum_limit.item(), color="black", linestyle=":", label="its limit")
top = axes[1].get_ylim()[1]
axes[1].fill_between(
    steps, 0, top * plain["monitor", "alarm"][:, 0].float(), color="tab:red", alpha=0.25, label="alarm"
)
axes[1].legend(fontsize=8, loc="upper left")
for (name, out), colour in zip(outs.items(), ("tab:orange", "tab:green", "tab:blue"), strict=True):
    off, spread = (out["belief", "mean"] - out["state"])[one, :, 0], out["belief", "cov"][one, :, 0, 0].sqrt()
    axes[2].plot(steps, off, color=colour, label=name)
    if name == "reject":
        axes[2].fill_between(steps, off - 1.645 * spread, off + 1.645 * spread, color=colour, alpha=0.2)
axes[2].set(ylabel="error, degrees", xlabel="step", ylim=(-6, 12))
axes[2].legend(fontsize=8, loc="upper left")
for axis in axes:
    axis.axvspan(FROM, TO, color="tab:gray", alpha=0.15)
plt.show()

# %%
# From here
# ---------
# * Several sensors, calibration, all options: :doc:`/how_to/monitor`.
# * Weights between sensors that are learned: :doc:`plot_late_readings`.
# * Detection and errors of a simulated arm and of a car with one camera: :doc:`/results/monitor`.
