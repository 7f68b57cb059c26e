r"""
Training, and what can go wrong
===============================

A filter may be trained without an error message and still be wrong. This page trains one small filter in several ways,
and compares what comes out. It looks at three questions: where the windows of the training begin, how many steps they
have, and which score is minimised. At the end it looks at *calibration*: is the truth as often inside the filter's
intervals as these intervals say?

The filter's *belief* is an *ensemble*: 32 guesses of the state, whose mean is the estimate and whose spread says how
sure the filter is. In each step the *transition* moves all guesses on (the *forecast*), and a reading corrects them
(the *analysis*).
"""

# %%
# Data, and a filter that knows little
# ------------------------------------
# A mass swings on a spring, and gusts push it. The state is [position in m, speed in m/s]. A sensor reads the position,
# ten times a second; each reading is 0.15 m off (a standard deviation).
#
# The filter learns the motion, a matrix. It also learns *R*, how far off readings are, and *Q*, the noise of the motion
# in one step. All three begin at wrong values.

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict

from torch_denkf import DEnKF, DEnKFLoss
from torch_denkf.metrics import ensemble_interval_coverage, spread_skill_ratio, state_errors
from torch_denkf.modules import (
    AroundState,
    ConstantNoise,
    GaussianPrior,
    LearnedTransition,
    Select,
)
from torch_denkf.plots import plot_bands, plot_calibration

DT, GUST, NOISE, MEMBERS = 0.1, 0.1, 0.15, 32  # s; m/s in each step; m; guesses


def record(swings: int, steps: int) -> TensorDict:
    """True states and readings, [swings, steps]."""
    position, speed, states = torch.randn(swings), 2.0 * torch.randn(swings), []
    for _ in range(steps):
        speed = speed - DT * (4.0 * position + 0.2 * speed) + GUST * torch.randn(swings)
        position = position + DT * speed
        states.append(torch.stack([position, speed], -1))
    state = torch.stack(states, 1)
    reading = state[..., :1] + NOISE * torch.randn(swings, steps, 1)
    return TensorDict({"state": state, "reading": reading}, [swings, steps])


torch.manual_seed(0)
train, unseen = record(300, 60), record(80, 60)
loc, scale = train["state"].mean((0, 1)), train["state"].std((0, 1))
anywhere = GaussianPrior(loc, scale, ensemble_size=MEMBERS)  # the belief before the first reading
at_truth = AroundState([0.01, 0.01], ensemble_size=MEMBERS)  # a belief that knows the first state


def make() -> DEnKF:
    """A filter before its training."""
    torch.manual_seed(1)
    change = torch.nn.Linear(2, 2, bias=False)
    torch.nn.init.zeros_(change.weight)  # the state stays as it is
    return DEnKF(
        transition=LearnedTransition(change),
        sensor=None,
        observation=Select([0]),
        noise=ConstantNoise([0.5], trainable=True, in_key="reading"),
        initial=anywhere,
        process_noise=ConstantNoise(
            [0.3, 0.3], trainable=True, in_key=("belief", "mean"), out_key=("forecast", "noise")
        ),
        observation_key="reading",
    )


# %%
# Five trainings
# --------------
# A training draws *windows* of the recordings: some successive steps. ``DEnKFLoss`` runs the filter over each window,
# and compares its ensembles with the true states. The gradient goes back through all steps of the window. ``initial``
# is what the filter believes at the beginning of a window.
#
# * The *squared error* (``score="mse"``) scores the mean of the ensemble alone.
# * The *continuous ranked probability score* (CRPS, the default) also scores the spread: it is small where the ensemble
#   is near the truth and as wide as it is wrong.
# * The *likelihood* of the readings (``nll``) says how well the forecast told the next reading, and how sure it was.


def fit(length: int, initial: torch.nn.Module, updates: int = 110, **options) -> DEnKF:
    """Trains a new filter on windows of some length."""
    filter = make().with_modules(initial=initial)
    loss = DEnKFLoss(filter, state_scale=scale, **options)
    noises = [parameter for name, parameter in loss.named_parameters() if "log_variance" in name]
    others = [parameter for name, parameter in loss.named_parameters() if "log_variance" not in name]
    optimiser = torch.optim.Adam([{"params": others}, {"params": noises}])
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, [2e-2, 2e-1], total_steps=updates)
    for _ in range(updates):
        rows, start = torch.randint(len(train), (32, 1)), torch.randint(train.shape[1] - length, (32, 1))
        terms = loss(train[rows, start + torch.arange(length)])
        optimiser.zero_grad()
        sum(terms.values()).backward()
        torch.nn.utils.clip_grad_norm_(filter.parameters(), 1.0)
        optimiser.step()
        schedule.step()
    return filter.with_modules(initial=anywhere)  # a filter that is used does not know where it begins


filters = {
    "no training": make(),
    "1 step from the truth": fit(2, at_truth),
    "1 step from anywhere": fit(2, anywhere),
    "16 steps from the truth": fit(17, at_truth),
    "16 steps, squared error": fit(17, anywhere, score="mse"),
    "16 steps, CRPS": fit(17, anywhere),
}

# %%
# What each training made of R and Q
# ----------------------------------
# All filters now track the same 80 unseen swings. None is told where a swing begins. *RMSE* is the root of the mean
# squared error. *Spread over error* divides the predicted spread by the RMSE: 1 for a filter that knows how wrong it
# is, less for a filter that is too sure of itself. *Inside* is the *coverage*: the share of the truth that lies in the
# belief's 90 % intervals. The first 2 s of each swing are left out.

runs, table = {}, {}
print(f"{'':23s}  R, m   Q, m/s  RMSE, m  m/s   spread over error  inside")
for name, filter in filters.items():
    with torch.no_grad():
        runs[name] = filter.sequence(unseen.clone())[:, 20:]
        noises = {key: value.exp().sqrt()[-1] for key, value in filter.named_parameters() if "log_variance" in key}
    (r, q), out = noises.values(), runs[name]
    rmse = state_errors(out["belief", "mean"], out["state"]).rmse
    ratio = spread_skill_ratio(out["belief", "mean"], out["belief", "var"], out["state"], MEMBERS)
    inside = ensemble_interval_coverage(out["belief", "ensemble"], out["state"], level=0.9)
    table[name] = {"r": r, "q": q, "rmse": rmse, "ratio": ratio, "inside": inside}
    print(
        f"{name:23s}  {r:.2f}   {q:.2f}    {rmse[0]:.2f}     {rmse[1]:.2f}  {ratio[0]:.2f}, {ratio[1]:.2f}"
        f"         {inside[0]:.0%}, {inside[1]:.0%}"
    )
print(f"{'the truth':23s}  {NOISE:.2f}   {GUST:.2f}")

# %%
# * **One step from the truth.** The filter begins where the mass really is, and its forecast is nearly perfect. A
#   reading can only spoil that. So the training makes R too large, and the filter listens too little to its sensor. Q
#   is right: the error of a forecast from the truth is just what Q describes.
# * **One step from anywhere.** The belief at the beginning of a window is wide, and one reading of the position says
#   nothing about the speed. So the training learns little about the motion, and the speed is wrong.
# * **Sixteen steps from the truth.** R is much better: within some steps the belief gets worse, and the sensor matters.
# * **Sixteen steps, squared error.** The means are good. The spread of the speed is too large, because no term of the
#   loss asks for it.
# * **Sixteen steps from anywhere, CRPS.** R and Q are both about right, and so is the spread. A window begins with a
#   wrong state, and the filter has to find the truth by its readings. That is what it has to do when it is used.
#
# If R and Q move too slowly, a larger learning rate for them helps (``fit`` above has it), and so does a little of the
# likelihood of the readings: ``DEnKFLoss(filter, nll=0.1)``.

good = table["16 steps, CRPS"]
assert abs(good["r"] - NOISE) < 0.03
assert abs(good["q"] - GUST) < 0.03
assert (good["inside"] - 0.9).abs().max() < 0.06
assert (good["ratio"] - 1).abs().max() < 0.3
assert table["1 step from the truth"]["r"] > 1.4 * NOISE
assert table["16 steps from the truth"]["r"] < 0.85 * table["1 step from the truth"]["r"]
assert table["1 step from anywhere"]["rmse"][1] > 3 * good["rmse"][1]
assert table["16 steps, squared error"]["ratio"][1] > good["ratio"][1] + 0.1

# %%
# Calibration, before and after
# -----------------------------
# A *rank histogram* asks where the truth lies among the guesses, from below all (0) to above all (1). The *probability
# integral transform* (PIT) asks the same of a normal distribution with the belief's mean and variance. Both are flat
# for a filter that is calibrated. They are high at both ends if it is too sure of itself, and high in the middle if it
# is too careful. In the grey band all bars of a calibrated filter end, up to chance. Errors of neighbouring steps are
# alike, so every tenth step counts.

figure, axes = plt.subplots(2, 4, figsize=(11, 5), layout="constrained")
columns = ("no training", "1 step from the truth", "1 step from anywhere", "16 steps, CRPS")
rows = (("rank", 0, "rank of the true position"), ("pit", 1, "PIT of the true speed"))
for column, name in zip(axes.T, columns, strict=True):
    for axis, (kind, dim, label) in zip(column, rows, strict=True):
        plot_calibration(runs[name], dims=[dim], names=[""], kind=kind, bins=8, every=10, legend=False, ax=axis)
        axis.set(ylabel="", xlabel=label, xticks=(0, 0.5, 1))
    column[0].set_title(name)
for axis in axes[:, 0]:
    axis.set_ylabel("share of steps, %")
plt.show()

# %%
# The fastest of the swings, from the third second on: above the filter that learned from single steps, below the one
# that learned from sixteen.

swing = int(unseen["state"][:, 20:, 1].abs().amax(1).argmax())
figure, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained")
for axis, name in zip(axes, ("1 step from anywhere", "16 steps, CRPS"), strict=True):
    plot_bands(
        runs[name][swing],
        dims=[1],
        names=["speed, m/s"],
        time=DT * torch.arange(20, 60),
        legend=axis is axes[0],
        ax=axis,
    )
    axis.set_title(name, loc="right", fontsize="medium")
axes[0].set_xlabel("")
plt.show()

# %%
# From here
# ---------
# * What a filter that is wrong looks like without true states: :doc:`plot_diagnostics`.
# * A loss of your own: :doc:`/how_to/own_loss`.
# * Training in stages, which continues after a kill: :py:obj:`~torch_denkf.training.FilterTrainer`.
