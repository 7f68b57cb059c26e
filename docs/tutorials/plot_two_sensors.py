r"""
Two sensors at different rates
==============================

A cart drives on a rail. Its wheel has an encoder, which reads the speed 50 times a second. The encoder alone cannot say
where the cart is: each reading is a little off, and the errors add up. A camera next to the rail sees four lamps, whose
brightness depends on where the cart is. It sees the place, but only ten times a second, and somebody walks through the
picture now and then.

This page puts both sensors into one filter. The filter's *belief* is an *ensemble*: 64 guesses of the state, whose mean
is the estimate and whose spread says how sure the filter is. In each time step the filter moves all guesses on (the
*forecast*). Then each sensor that has a new reading corrects them (an *analysis*).
"""

# %%
# The recordings
# --------------
# The filter runs at 50 Hz, the rate of the faster sensor. A *mask* says in which steps a reading is there: a boolean
# entry next to each sensor's readings. Where the mask is False, the reading may hold anything. Here it holds NaN.
#
# The state is [position in m, speed in m/s]. The camera's four numbers are a curved function of the position, which the
# filter does not know. It is learned.

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict

from torch_denkf import DEnKFLoss, Filter, SensorLoss
from torch_denkf.metrics import interval_coverage, state_errors
from torch_denkf.modules import (
    ConstantNoise,
    DiagonalNoise,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedTransition,
    NoisyTransition,
    Select,
    VectorSensor,
)
from torch_denkf.plots import plot_bands

torch.manual_seed(0)
DT, EVERY, MEMBERS = 0.02, 5, 64  # s between two steps; a picture in every fifth step; guesses
PUSH, WHEEL = 0.03, 0.3  # m/s: how much the speed changes in a step, and the error of an encoder's reading
LAMPS = torch.tensor([-3.0, -1.0, 1.0, 3.0])  # m


def record(carts: int, steps: int, reach: float) -> TensorDict:
    """True states, readings and masks, [carts, steps], of carts that start less than ``reach`` m from the middle."""
    position, speed, states = reach * (2 * torch.rand(carts) - 1), 0.3 * torch.randn(carts), []
    for _ in range(steps):
        speed = 0.99 * speed + PUSH * torch.randn(carts)
        position = position + DT * speed
        states.append(torch.stack([position, speed], -1))
    state = torch.stack(states, 1)
    lamps = (-(state[..., :1] - LAMPS).square() / 3).exp() + 0.03 * torch.randn(carts, steps, 4)
    wheel = state[..., 1:] + WHEEL * torch.randn(carts, steps, 1)
    time = torch.arange(steps)
    camera_seen = (time % EVERY == 0).repeat(carts, 1).unsqueeze(-1)
    camera_seen[:, (time >= 100) & (time < 200)] = False  # somebody walks through the picture for 2 s
    wheel_seen = ((time < 225) | (time >= 250)).repeat(carts, 1).unsqueeze(-1)  # the encoder's plug is loose for 0.5 s
    entries = {"state": state, "target_observation": state[..., :1], "camera_seen": camera_seen}
    entries |= {"lamps": torch.where(camera_seen, lamps, torch.nan), "wheel_seen": wheel_seen}
    return TensorDict(entries | {"wheel": torch.where(wheel_seen, wheel, torch.nan)}, [carts, steps])


train, unseen = record(200, 50, reach=3.0), record(40, 300, reach=1.5)
shares = [unseen[mask].float().mean().item() for mask in ("camera_seen", "wheel_seen")]
print("steps with a picture: {:.0%}; with a reading of the encoder: {:.0%}".format(*shares))

# %%
# One filter, two analyses
# ------------------------
# ``Filter`` takes a dictionary from *place* to module, in the order in which the modules run. Each sensor has its own
# entries, and each analysis has its own mask, ``observed_key``. The first analysis writes its result under
# ``"middle"``. The second analysis reads that instead of the forecast, and writes the ``"belief"``.
#
# ``VectorSensor`` is a network that turns the lamps into a position, with one sample for each guess. ``DiagonalNoise``
# learns how far off that position is. The encoder needs no network: its reading is a speed already, and the error of a
# reading is known.

move = torch.nn.Linear(2, 2, bias=False)
move.weight.data = torch.tensor([[1.0, 0.99 * DT], [0.0, 0.99]])  # the position moves with the new speed
process_noise = ConstantNoise([0.0, PUSH], in_key=("belief", "ensemble"), out_key=("forecast", "noise"))
wheel = {"predicted_key": "wheel_predicted", "observation_key": "wheel", "observed_key": "wheel_seen"}
wheel["noise_variance_key"] = "wheel_noise"
fused = Filter(
    {
        "camera": VectorSensor(
            4,
            1,
            ensemble_size=MEMBERS,
            num_cells=(32, 32),
            rate=0.02,
            in_key="lamps",
            out_key=("camera", "ensemble"),
            observed_key="camera_seen",
        ),
        "camera_noise": DiagonalNoise(1, r=0.1, in_key=("camera", "ensemble"), out_key=("camera", "noise")),
        "wheel_noise": ConstantNoise([WHEEL], in_key="wheel", out_key="wheel_noise"),
        "transition": NoisyTransition(LearnedTransition(move.requires_grad_(False), residual=False), process_noise),
        "h_camera": Select([0], out_key=("camera", "predicted")),
        "by_camera": EnsembleAnalysis(
            "sensor",
            predicted_key=("camera", "predicted"),
            observation_key=("camera", "ensemble"),
            noise_variance_key=("camera", "noise"),
            observed_key="camera_seen",
            belief_prefix="middle",
        ),
        "h_wheel": Select([1], in_key=("middle", "ensemble"), out_key="wheel_predicted"),
        "by_wheel": EnsembleAnalysis("etkf", forecast_key=("middle", "ensemble"), **wheel),
    },
    initial=GaussianPrior([0.0, 0.0], [1.0, 0.3], ensemble_size=MEMBERS),
)

# %%
# The training
# ------------
# ``SensorLoss`` runs the learned sensor alone, on single pictures, and scores its samples against
# ``"target_observation"``; ``noise`` also teaches ``DiagonalNoise`` how far off the samples' mean is. Then
# ``DEnKFLoss`` runs the whole filter over windows of 20 steps, and scores its ensembles against the true states. The
# score is the *continuous ranked probability score* (CRPS): it is small where the ensemble is near the truth and as
# wide as it is wrong. ``nll`` adds a little of the likelihood of the readings, which teaches the noise. A loss finds
# the samples of the learned sensor, and the mask and noise that its update reads; with several learned sensors
# ``set_keys(sensor="camera")`` names one.

alone, together = SensorLoss(fused, noise=0.1), DEnKFLoss(fused, nll=0.1)
pictures = train[train["camera_seen"][..., 0]]


def fit(loss: torch.nn.Module, sample, updates: int, lr: float) -> None:
    """Minimises the sum of the loss's terms."""
    optimiser = torch.optim.Adam(loss.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, lr, total_steps=updates)
    for _ in range(updates):
        terms = loss(sample())
        optimiser.zero_grad()
        sum(terms.values()).backward()
        torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
        optimiser.step()
        schedule.step()
    print(type(loss).__name__, {name: round(value.item(), 3) for name, value in terms.items()})


fit(alone, lambda: pictures[torch.randint(len(pictures), (128,))], 250, 1e-2)
fit(together, lambda: train[torch.randint(len(train), (32,)), :20], 30, 3e-3)

# %%
# What each sensor brings
# -----------------------
# A mask that is False everywhere switches a sensor off. So the same filter, without another training, tells what each
# sensor is good for.


def track(**masks: bool) -> TensorDict:
    """Filters the unseen carts; ``camera_seen=False`` hides all pictures."""
    data = unseen.clone()
    for mask, value in masks.items():
        data[mask] &= value
    with torch.no_grad():
        return fused.sequence(data)


time = DT * torch.arange(unseen.shape[1])
settled, hidden = time >= 1.0, (time >= 2.0) & (time < 4.0)
runs = {"encoder alone": track(camera_seen=False), "camera alone": track(wheel_seen=False), "both": track()}
rmse = {}
for name, run in runs.items():
    mean, var, truth = run["belief", "mean"], run["belief", "var"], unseen["state"]
    parts = {"with pictures": settled & ~hidden, "without": hidden}
    rmse[name] = {part: state_errors(mean[:, rows], truth[:, rows]).rmse for part, rows in parts.items()}
    inside = interval_coverage(mean[:, settled], var[:, settled], truth[:, settled], level=0.9)
    errors = "; ".join(f"{part} {error[0]:.2f} m, {error[1]:.2f} m/s" for part, error in rmse[name].items())
    print(f"{name:13s}: RMSE {errors}; 90 % coverage {inside[0]:.0%}, {inside[1]:.0%}")
assert rmse["both"]["with pictures"][0] < 0.2 * rmse["encoder alone"]["with pictures"][0]
assert (rmse["both"]["with pictures"] < 0.9 * rmse["camera alone"]["with pictures"]).all()
assert rmse["both"]["without"][0] < 0.9 * rmse["camera alone"]["without"][0]

# %%
# The entries of each analysis
# ----------------------------
# The *innovation* is a reading minus what the forecast predicted. The *normalised innovation squared* (NIS) compares it
# with what the filter expected: 1 on average for one number that is read, if the filter knows how wrong it is. Both are
# kept for each analysis, under the name of its place. ``("info", "nis")`` is the sum over the analyses. Where a sensor
# saw nothing, its NIS is 0.
#
# The encoder's NIS is about 1. The camera's is smaller: the samples of the learned sensor differ from guess to guess,
# the learned noise comes on top, and so the filter expects larger innovations than it gets.

both = runs["both"]
for place, mask in (("by_camera", "camera_seen"), ("by_wheel", "wheel_seen")):
    nis, seen = both["info", place, "nis"], unseen[mask]
    print(f"{place:9s}: NIS {nis[seen].mean():.2f} where there is a reading, {nis[~seen].mean():.2f} elsewhere")
    assert (nis[~seen] == 0).all()
    assert 0.3 < nis[seen].mean() < 1.5
parts = both["info", "by_camera", "nis"] + both["info", "by_wheel", "nis"]
assert torch.allclose(both["info", "nis"], parts)

# %%
# One of the carts. The grey stripe of the position is the time without pictures, the one of the speed the time without
# encoder. Without pictures the position is carried on by the speed, and its band grows. The first picture after that
# pulls the band together. Without encoder the band of the speed grows.

figure, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained")
cart, first = 1, 25
shown = both[cart, first:]
readings = [both["camera", "ensemble"].mean(-2)[cart, first:, 0], unseen["wheel"][cart, first:, 0]]
readings[0] = torch.where(shown["camera_seen"][:, 0], readings[0], torch.nan)
seen = [~hidden[first:], shown["wheel_seen"]]  # the steps between two pictures are no gap
for dim, name in enumerate(("position, m", "speed, m/s")):
    plot_bands(
        shown,
        dims=[dim],
        names=[name],
        readings={dim: readings[dim]},
        observed=seen[dim],
        time=time[first:],
        legend=dim == 0,
        ax=axes[dim],
    )
axes[0].set_xlabel("")
plt.show()

# %%
# From here
# ---------
# * More ways to put filters together: :doc:`/start/three_ways`.
# * Files of your own, each stream with its own rate: :doc:`plot_own_recordings`.
# * What innovations tell of faults: :doc:`plot_diagnostics`.
