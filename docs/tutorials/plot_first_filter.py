r"""
A first filter
==============

A camera films a pendulum from the side. It measures how far the bob is to the left or right, with noise. Nobody
measures the speed of the pendulum, and nobody knows its equation of motion. There are recordings of 300 swings with
the true angle and speed, and a new swing is to be tracked.

This page trains a *differentiable ensemble Kalman filter* (DEnKF) on the recordings. The filter's *belief* is an
*ensemble*: 32 guesses of the state, whose mean is the estimate and whose spread says how sure the filter is. In each
time step a network moves every guess (the *forecast*), and the reading pulls the guesses towards itself (the
*analysis*).
"""

# %%
# The data
# --------
# Any arrays will do, as long as time is the last batch dimension. Here a simulation stands in for the laboratory. The
# state is [angle in rad, angular speed in rad/s], the reading is the sine of the angle, with noise of standard
# deviation 0.1.

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict

from torch_denkf import DEnKF, DEnKFLoss
from torch_denkf.modules import ConstantNoise, GaussianPrior, LearnedObservation, LearnedTransition, StochasticMLP
from torch_denkf.plots import plot_bands

torch.manual_seed(0)
DT, NOISE = 0.1, 0.1  # s; the standard deviation of a reading


def record(swings: int, steps: int) -> TensorDict:
    """Swings of a damped pendulum that the wind pushes."""
    angle, speed = 1.2 * torch.randn(swings), 1.0 * torch.randn(swings)
    states = []
    for _ in range(steps):
        speed = speed + DT * (-4.0 * angle.sin() - 0.2 * speed) + 0.05 * torch.randn(swings)
        angle = angle + DT * speed
        states.append(torch.stack([angle, speed], -1))
    state = torch.stack(states, 1)
    reading = state[..., :1].sin() + NOISE * torch.randn(swings, steps, 1)
    return TensorDict({"state": state, "reading": reading}, [swings, steps])


train, unseen = record(300, 60), record(50, 100)

# %%
# The filter
# ----------
# A filter is put together from parts. Three of them answer the questions of every filter:
#
# * ``transition``: where does a state go in one step? Here a network learns it. Its hidden units are dropped at random,
#   also after training; that is where the spread of the forecast comes from.
# * ``observation``: what would the camera read in this state? Here it is known, the sine of the angle.
# * ``noise``: how far off are readings? Here it is known, too.
#
# ``initial`` says what the filter believes before the first reading.


class BobPosition(torch.nn.Module):
    """Predicts what the camera reads of a state: [..., 2] to [..., 1]."""

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        """The sine of the angle."""
        return state[..., :1].sin()


loc, scale = train["state"].mean((0, 1)), train["state"].std((0, 1))
denkf = DEnKF(
    transition=LearnedTransition(StochasticMLP(2, 2, (64, 64), output_gain=0.1), loc=loc, scale=scale),
    sensor=None,  # the reading is used as it is
    observation=LearnedObservation(BobPosition()),
    noise=ConstantNoise([NOISE], in_key="reading"),
    initial=GaussianPrior(loc, scale, ensemble_size=32),
    observation_key="reading",
)
print(denkf.carry_keys, "goes on from step to step;", sum(p.numel() for p in denkf.parameters()), "parameters")

# %%
# The training
# ------------
# ``DEnKFLoss`` runs the filter over windows of the recordings and compares its ensembles with the true states. The
# score is the *continuous ranked probability score* (CRPS): it is small where the ensemble is near the truth and as
# wide as it is wrong.

loss = DEnKFLoss(denkf, state_scale=scale)
optimiser = torch.optim.Adam(denkf.parameters())
UPDATES, LENGTH = 150, 16
schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 6e-3, total_steps=UPDATES)
history = []
for _ in range(UPDATES):
    rows = torch.randint(train.shape[0], (32, 1))
    times = torch.randint(train.shape[1] - LENGTH + 1, (32, 1)) + torch.arange(LENGTH)
    total = sum(loss(train[rows, times]).values())
    optimiser.zero_grad()
    total.backward()
    torch.nn.utils.clip_grad_norm_(denkf.parameters(), 1.0)
    optimiser.step()
    schedule.step()
    history.append(total.item())
print(f"CRPS of belief and forecast, summed: {history[0]:.3f} before, {sum(history[-20:]) / 20:.3f} after")

# %%
# The result
# ----------
# ``sequence`` filters whole recordings. On 50 unseen swings we compare the mean of the belief with the true state,
# from the second second on. The speed, which nobody measures, is compared with differences of the readings.

with torch.no_grad():
    tracked = denkf.sequence(unseen.clone())
mean, std = tracked["belief", "mean"], tracked["belief", "var"].sqrt()
error = (mean - unseen["state"])[:, 20:]
differences = unseen["reading"].diff(dim=1)[..., 0] / DT
rmse = error.square().mean((0, 1)).sqrt()
inside = (error.abs() <= 1.645 * std[:, 20:]).float().mean((0, 1))
print(f"angle: RMSE {rmse[0]:.3f} rad;  90 % coverage {100 * inside[0]:.0f} %")
print(f"speed: RMSE {rmse[1]:.3f} rad/s; 90 % coverage {100 * inside[1]:.0f} %")
crude = (differences - unseen["state"][:, 1:, 1])[:, 20:].square().mean().sqrt()
print(f"differences of the readings: RMSE {crude:.3f} rad/s")
assert rmse[1] < 0.3 * crude
assert (inside - 0.9).abs().max() < 0.1

# %%
# One of the swings. The reading is the sine of the angle; it is drawn as the angle that it means. Beyond a quarter turn
# a sine belongs to two angles, and the dots are left out. There the filter is least sure, and worst.

figure, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained")
shown, seconds = tracked[0], DT * torch.arange(unseen.shape[1])
angle = torch.where(shown["state"][:, 0].abs() < torch.pi / 2, shown["reading"][:, 0].clamp(-1, 1).asin(), torch.nan)
plot_bands(shown, dims=[0], names=["angle, rad"], readings={0: angle}, time=seconds, ax=axes[0])
plot_bands(shown, dims=[1], names=["angular speed, rad/s"], time=seconds, legend=False, ax=axes[1])
axes[0].set_xlabel("")
plt.show()

# %%
# From here
# ---------
# * Videos and tables of your own, pictures instead of the reading: :doc:`plot_own_recordings`.
# * A sensor of your own: give ``sensor=ImageSensor(...)``, see :doc:`/how_to/own_sensor`.
# * The known equation instead of the network: see :doc:`/how_to/own_dynamics`.
# * The same filter in an environment or in a policy: see :doc:`plot_policy` and :doc:`/start/three_ways`.
