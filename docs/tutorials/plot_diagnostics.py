r"""
Reading the diagnostics
=======================

A filter says what it believes, and how sure it is. Is it right about both? This page makes one filter that is right and
four that are wrong, each in another way. It shows by which numbers and pictures the faults are told apart. Most of
these numbers need no true state, so they can be watched on a robot, too.

The filter's *belief* is an *ensemble*: 100 guesses of the state, whose mean is the estimate and whose spread says how
sure the filter is. In each step the filter moves all guesses on (the *forecast*), and a reading corrects them (the
*analysis*).
"""

# %%
# A system that is known exactly
# ------------------------------
# A mass swings on a spring. The state is [position in m, speed in m/s], and gusts push the mass. A sensor reads the
# position, ten times a second, and every third reading is lost. ``LinearGaussianEnv`` simulates such systems, so we
# know all that a filter has to know: the motion, the gusts' strength, and the error of a reading. Two names are common:
# *Q* is the noise of the motion in one step, the *process noise*; *R* is the noise of a reading.

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict

from torch_denkf import DEnKF, LinearGaussianEnv
from torch_denkf.metrics import interval_coverage, spread_skill_ratio, state_errors
from torch_denkf.modules import ConstantNoise, GaussianPrior, LearnedTransition, Select
from torch_denkf.plots import plot_calibration, plot_spread_error

torch.manual_seed(0)
DT, GUST, NOISE, MEMBERS = 0.1, 0.1, 0.3, 100  # s; m/s in each step; m; guesses


def motion(stiffness: float) -> torch.Tensor:
    """The matrix that moves [position, speed] by a step."""
    return torch.tensor([[1.0, DT], [-stiffness * DT, 1.0 - 0.2 * DT]])


world = LinearGaussianEnv(
    transition=motion(1.0),
    observation=torch.tensor([[1.0, 0.0]]),
    transition_std=[0.0, GUST],
    observation_std=[NOISE],
    missing=0.33,
    max_steps=300,
    batch_size=[40],
    seed=1,
)
runs = world.rollout(300)["next"].select("state", "observation", "observed")

# %%
# One filter, four faults
# -----------------------
# ``make`` builds a filter; its arguments are what we get wrong. The biased sensor is not a fault of the filter: all its
# readings are 0.4 m too large, and nobody told the filter.


def make(r: float = NOISE, q: float = GUST, stiffness: float = 1.0) -> DEnKF:
    """The filter of the mass on the spring."""
    move = torch.nn.Linear(2, 2, bias=False)
    move.weight.data = motion(stiffness)
    return DEnKF(
        transition=LearnedTransition(move, residual=False),
        sensor=None,
        observation=Select([0]),
        noise=ConstantNoise([r], in_key="observation"),
        initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=MEMBERS),
        process_noise=[0.0, q],
        observation_key="observation",
    )


def track(filter: DEnKF, bias: float = 0.0) -> TensorDict:
    """Filters all runs, and leaves the first 5 s out."""
    data = runs.clone()
    data["observation"] += bias
    with torch.no_grad():
        return filter.sequence(data)[:, 50:]


cases = {
    "right": track(make()),
    "R too small": track(make(r=0.1 * NOISE)),
    "Q zero": track(make(q=0.0)),
    "biased sensor": track(make(), bias=0.4),
    "wrong motion": track(make(stiffness=3.0)),
}

# %%
# What the readings tell
# ----------------------
# The *innovation* is a reading minus the filter's forecast of it. Innovations of a filter that is right are on average
# zero, as large as the filter expects, and independent of each other. So there are three things to look at:
#
# * the mean of the innovations, in the sensor's unit;
# * the *normalised innovation squared* (NIS), the innovation's square divided by its expected square. For a reading of
#   one number its average is 1. One value in twenty lies above 3.84, the 95 % quantile of the *chi-square distribution*
#   with one degree of freedom;
# * the correlation of an innovation with the one a step before.


def from_readings(out: TensorDict) -> dict[str, float]:
    """Diagnostics without any true state."""
    seen, innovation, nis = (out[key][..., 0] for key in ("observed", ("info", "innovation"), ("info", "nis")))
    both = seen[:, 1:] & seen[:, :-1]
    now, before = innovation[:, 1:][both], innovation[:, :-1][both]
    return {
        "innovation, m": innovation[seen].mean().item(),
        "NIS": nis[seen].mean().item(),
        "NIS > 3.84": (nis[seen] > 3.84).float().mean().item(),
        "correlation": torch.corrcoef(torch.stack([now, before]))[0, 1].item(),
    }


told = {name: from_readings(out) for name, out in cases.items()}
print(f"{'':14s}", *told["right"], sep="  ")
for name, numbers in told.items():
    print(f"{name:14s}", *(f"{value:{len(key)}.2f}" for key, value in numbers.items()), sep="  ")

# %%
# Each fault leaves another trace:
#
# * **R too small.** The filter expects readings to be better than they are. NIS is far above 1. The filter runs after
#   each reading, and in the next step the innovation points back: the correlation is negative.
# * **Q zero.** The filter believes that its motion is perfect. The spread shrinks from step to step, and readings no
#   longer count. NIS is far above 1, and the innovations of neighbouring steps are alike: the correlation is positive.
# * **Biased sensor.** NIS is only a little higher. The mean of the innovations is not zero, though smaller than the
#   bias: the filter has followed its sensor most of the way. Readings alone cannot show the whole bias.
# * **Wrong motion.** The innovations' mean is zero. NIS is above 1, and neighbouring innovations are alike.

right = told["right"]
assert abs(right["innovation, m"]) < 0.03
assert abs(right["NIS"] - 1) < 0.1
assert abs(right["NIS > 3.84"] - 0.05) < 0.02
assert abs(right["correlation"]) < 0.1
assert told["R too small"]["NIS"] > 3
assert told["R too small"]["correlation"] < -0.1
assert told["Q zero"]["NIS"] > 3
assert told["Q zero"]["correlation"] > 0.3
assert 0.05 < told["biased sensor"]["innovation, m"] < 0.4
assert told["wrong motion"]["NIS"] > 1.1
assert told["wrong motion"]["correlation"] > 0.1

# %%
# What the true state tells
# -------------------------
# In a simulation, or with motion capture, the belief can be compared with the truth. *Spread over error* divides the
# predicted spread by the error's root mean square: 1 for a filter that knows how wrong it is. *Inside* is the share of
# the truth that lies in the belief's 90 % intervals.

inside = {}
for name, out in cases.items():
    mean, var, truth = out["belief", "mean"], out["belief", "var"], out["state"]
    rmse, ratio = state_errors(mean, truth).rmse, spread_skill_ratio(mean, var, truth, MEMBERS)
    inside[name] = interval_coverage(mean, var, truth, level=0.9)
    print(
        f"{name:14s}  RMSE {rmse[0]:.2f} m, {rmse[1]:.2f} m/s;  spread over error {ratio[0]:.2f}, {ratio[1]:.2f};"
        f"  inside {inside[name][0]:.0%}, {inside[name][1]:.0%}"
    )
assert (inside["right"] - 0.9).abs().max() < 0.03
assert all(inside[name][0] < 0.8 for name in cases if name != "right")

# %%
# Two pictures show the same at a glance. The first one asks where the truth lies among the guesses, from below all (0)
# to above all (1). The bars are flat if the filter is right. They are high at both ends if it is too sure of itself,
# and high at one end if its belief is off to one side. In the grey band all bars of a right filter end, up to chance.
# Errors of neighbouring steps are alike, so every 15th step counts.

figure, axes = plt.subplots(1, 5, figsize=(11, 2.9), sharex=True, layout="constrained")
for axis, (name, out) in zip(axes, cases.items(), strict=True):
    plot_calibration(out, dims=[0], names=["position"], bins=8, every=15, legend=False, ax=axis)
    axis.set(title=name, xlabel="rank of the truth", ylabel="", xticks=(0, 0.5, 1))
axes[0].set_ylabel("share of steps, %")
plt.show()

# %%
# The second one sorts all steps by their spread, and draws the error over the spread in each eighth of them. On the
# diagonal the filter knows how wrong it is; above it, it is too sure. The spread varies here, because readings are
# lost: after a gap the filter is less sure, and a filter that is right is then also less exact.

figure, axes = plt.subplots(1, 5, figsize=(11, 2.9), layout="constrained")
for axis, (name, out) in zip(axes, cases.items(), strict=True):
    plot_spread_error(out, dims=[0], names=["position, m"], legend=False, ax=axis)
    axis.set(title=name, xlabel="spread, m", ylabel="")
axes[0].set_ylabel("error, m")
plt.show()

# %%
# What to do
# ----------
# ================================================  ================================================================
# what you see                                      what to try
# ================================================  ================================================================
# NIS above 1, negative correlation                 a larger R, or learn it: ``DEnKFLoss(..., nll=0.1)``
# NIS above 1, positive correlation                 a larger ``process_noise``, or a better ``transition``
# NIS below 1, bars high in the middle              a smaller R or Q
# the mean of the innovations is not zero           calibrate the sensor, or make its bias a part of the state
# single NIS far above all others                   a reading that is an outlier: leave such a step out
# ================================================  ================================================================
#
# How a training gets Q and R right: :doc:`plot_training`. The numbers in a loop of your own:
# :doc:`/how_to/online_loop`.
