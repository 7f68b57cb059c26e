r"""
Sensors that are slow, late or wrong
====================================

A delivery robot drives along a street. Its wheels tell its speed ten times a second, badly. A laser finds the next lamp
post every other second. Its GPS works out two positions a second, and takes half a second for each, so that a fix is
old when it comes. And now and then the GPS is wrong by metres, because a house reflects the signals.

:class:`~torch_denkf.fusion.FusedFilter` puts all of them into one filter. Each sensor has its own rate, its own mask,
its own delay. This page shows what a delay means, what each sensor brings, and how weights between the sensors are
learned that see which one is wrong.
"""

# %%
# The drives
# ----------
# The state is [position in m, speed in m/s] along the street. A *mask* ``NAME_observed`` says in which steps a reading
# is there. Row t holds what *arrives* at t. So the GPS fix in row t was taken five rows before.

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict

from torch_denkf import FusedFilter, FusedSensor, GaussianLoss
from torch_denkf.fusion import SensorAttention
from torch_denkf.modules import LinearTransition, MomentPrior, Select

torch.manual_seed(0)
DT, LATE = 0.1, 5  # s between two steps; steps by which a fix is old
PUSH = 0.5  # m/s: how much the speed changes in a step
SENSORS = {  # what it reads of the state, standard deviation, steps between two readings
    "wheels": (1, 2.0, 1),
    "laser": (0, 0.2, 20),
    "gps": (0, 0.5, 5),
}
MOVE = torch.tensor([[1.0, DT], [0.0, 0.98]])


def drive(robots: int, steps: int = 100, *, reflected: float = 0.0) -> TensorDict:
    """True states, and readings when they arrive; of a share ``reflected`` the GPS is wrong for three seconds."""
    state, states = torch.zeros(robots, 2), []
    for _ in range(steps):
        state = state @ MOVE.mT + torch.tensor([0.0, PUSH]) * torch.randn(robots, 2)
        states.append(state)
    data = TensorDict({"state": torch.stack(states, 1)}, [robots, steps])
    time = torch.arange(steps)
    start = torch.randint(steps // 4, steps // 2, (robots, 1))
    data["wrong"] = (time >= start) & (time < start + 30) & (torch.rand(robots, 1) < reflected)
    for name, (component, noise, every) in SENSORS.items():
        data[name] = data["state"][..., component : component + 1] + noise * torch.randn(robots, steps, 1)
        data[f"{name}_observed"] = (time % every == 0).reshape(1, steps, 1).expand(robots, steps, 1).clone()
    data["gps"] = torch.where(data["wrong"].unsqueeze(-1), data["gps"] + 8.0, data["gps"])
    for key in ("gps", "gps_observed", "wrong"):  # taken then, here now
        data[key] = data[key].roll(LATE, 1)
        data[key][:, :LATE] = False
    return data


drives = drive(40)

# %%
# One filter
# ----------
# Motion and readings are linear, so a mean and a covariance say all: the filter is a Kalman filter. An ensemble
# (``GaussianPrior`` and a ``LearnedTransition``) goes into the same filter. ``delay`` says how old a reading is. The
# filter then also carries its last states, and a late reading corrects the state that it belongs to. What it says of
# that state, it says of the present one through their covariance.


def fuse(delay: int = LATE, weights: torch.nn.Module | None = None) -> FusedFilter:
    """The filter of all three sensors."""
    sensors = {name: FusedSensor(Select([component]), [noise]) for name, (component, noise, _) in SENSORS.items()}
    sensors["gps"] = FusedSensor(Select([0]), [SENSORS["gps"][1]], delay=delay)
    motion = LinearTransition(MOVE, torch.diag(torch.tensor([0.0, PUSH**2])))
    start = MomentPrior(torch.zeros(2), 0.01 * torch.eye(2))
    return FusedFilter(motion, sensors, initial=start, weights=weights)


@torch.no_grad()
def run(filter: FusedFilter, data: TensorDict, *hidden: str) -> TensorDict:
    """Filters the drives without some sensors: a mask that is False everywhere switches a sensor off."""
    data = data.copy()
    for name in hidden:
        data[f"{name}_observed"] = torch.zeros_like(data[f"{name}_observed"])
    return filter.sequence(data)


def error(out: TensorDict, rows=...) -> float:
    """Root mean square error of the position, m."""
    return (out["belief", "mean"] - out["state"])[..., 0][rows].square().mean().sqrt().item()


# %%
# What a delay means
# ------------------
# Without the laser the position hangs on the GPS. A fix that is half a second old and is taken for a new one draws the
# position back by what the robot has driven since. Put where it belongs, it is nearly as good as a fix that comes at
# once: what is missing is what the robot did in the last half second.


def in_time(data: TensorDict) -> TensorDict:
    """The drives with each fix in the row in which it was taken."""
    data = data.copy()
    for key in ("gps", "gps_observed"):
        data[key] = data[key].roll(-LATE, 1)
    data["gps_observed"][:, -LATE:] = False
    return data


errors = {
    "no GPS at all": error(run(fuse(), drives, "laser", "gps")),
    "half a second old, taken for new": error(run(fuse(delay=0), drives, "laser")),
    "half a second old, put where it belongs": error(run(fuse(), drives, "laser")),
    "in time": error(run(fuse(delay=0), in_time(drives), "laser")),
}
for name, value in errors.items():
    print(f"{name:40s} {value:.2f} m")
assert errors["half a second old, put where it belongs"] < 0.6 * errors["half a second old, taken for new"]
assert errors["half a second old, put where it belongs"] < 1.5 * errors["in time"]

# %%
# What each sensor brings
# -----------------------

print("wheels, and")
for hidden in (("laser", "gps"), ("laser",), ("gps",), ()):
    names = " + ".join(name for name in ("laser", "gps") if name not in hidden) or "nothing else"
    print(f"  {names:14s} {error(run(fuse(), drives, *hidden)):.2f} m")

# %%
# A sensor that is wrong
# ----------------------
# A house reflects the GPS' signals: for three seconds each fix is 8 m off, and no mask says so. The filter believes it
# as much as ever.
#
# :class:`~torch_denkf.fusion.SensorAttention` gives each reading a weight between 0 and 1, by which its variance is
# divided. The weight follows from the innovations of all sensors (a reading minus what the forecast predicted, in
# standard deviations), so it is learned what "the GPS disagrees while the laser agrees" means. It learns from drives in
# which the GPS fails; nobody tells it when. ``GaussianLoss`` scores the belief against the true state.

weights = SensorAttention(dict.fromkeys(SENSORS, 1))
learning = fuse(delay=0, weights=weights)  # faster: weights do not depend on when a fix comes
loss = GaussianLoss(learning, transition=0.0, sensor=0.0)
optimiser, updates = torch.optim.Adam(weights.parameters()), 30
schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 1e-2, total_steps=updates)
for update in range(updates):
    value = loss(in_time(drive(32, steps=40, reflected=0.5)))["loss_state"]
    optimiser.zero_grad()
    value.backward()
    optimiser.step()
    schedule.step()
    if update % 10 == 9:
        print(f"update {update + 1}: CRPS {value.item():.3f}")

# %%
# On drives that it has not seen, the filter with the learned weights is as good while the GPS is wrong as the filter
# that never had a GPS. The weight of the GPS falls with its first wrong fix, and rises again when fixes fit.

unseen = drive(40, reflected=1.0)
runs = {"believed": run(fuse(), unseen), "weighed": run(fuse(weights=weights), unseen)}
runs["never had a GPS"] = run(fuse(), unseen, "gps")
wrong = unseen["wrong"]
for name, out in runs.items():
    print(f"GPS {name:16s} {error(out, wrong):.2f} m while it is wrong, {error(out, ~wrong):.2f} m else")
assert error(runs["weighed"], wrong) < 0.5 * error(runs["believed"], wrong)
assert error(runs["weighed"], wrong) < 1.5 * error(runs["never had a GPS"], wrong)

time, one = DT * torch.arange(unseen.shape[1]), 0
figure, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained", height_ratios=[2, 1])
for (name, out), colour in zip(runs.items(), ("tab:orange", "tab:blue", "tab:gray"), strict=True):
    off = (out["belief", "mean"] - out["state"])[one, :, 0]
    axes[0].plot(time, off, color=colour, label=f"GPS {name}")
seen = unseen["gps_observed"][one, :, 0]
taken = torch.where(seen, unseen["gps"][one, :, 0], torch.nan) - unseen["state"][one, :, 0].roll(LATE)
axes[0].plot(time, taken, "k.", label="fixes, when they come")
axes[0].set_ylabel("error of the position, m")
axes[0].legend(fontsize=8)
weight = torch.where(seen, runs["weighed"]["weight", "gps"][one, :, 0], torch.nan)
axes[1].semilogy(time, weight, "o", color="tab:blue", markersize=4)
axes[1].set(ylabel="weight of a fix", xlabel="time, s")
for axis in axes:
    axis.axvspan(*(DT * torch.where(wrong[one])[0][[0, -1]]).tolist(), color="tab:gray", alpha=0.15)
plt.show()

# %%
# From here
# ---------
# * All that ``FusedFilter`` can do: :doc:`/how_to/several_sensors`.
# * To notice a wrong sensor, and say which one it is: :doc:`plot_monitor`.
# * A simulated arm and real drives of KITTI, each sensor late, wrong or missing: :doc:`/results/fusion`.
