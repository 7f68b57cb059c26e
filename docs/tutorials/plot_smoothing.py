r"""
Smoothing: where was the robot?
===============================

A robot drives through a hall. It counts the turns of its wheels, so it knows how far it drives and how much it turns in
each step, up to small errors. Every four seconds it passes a marker, which tells it where it is. In between, the errors
of the wheels add up.

A *filter* answers at each moment: where is the robot, given all readings up to now? At each marker its answer jumps,
because it had drifted. A *smoother* answers later: where was the robot, given also what was read afterwards? The next
marker tells how wrong the path to it was, so the smoothed path has no jumps.

This page filters the drives, smooths them as recordings, and then smooths them while the robot runs.
"""

# %%
# The drives
# ----------
# The state is [x in m, y in m, heading in rad]. ``"wheels"`` is the distance and the turn of each step as the wheels
# counted them. ``"marker"`` is the place, and its mask ``"observed"`` is True where the robot passes a marker.

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict

from torch_denkf import DEnKF, EnKS, EnRTS, FixedLag
from torch_denkf.metrics import interval_coverage
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, GaussianPrior, Select, Transition
from torch_denkf.plots import plot_path

torch.manual_seed(0)
DT, EVERY, STEPS, MEMBERS = 0.1, 40, 241, 100  # s; steps between two markers; steps of a drive; members
SLIP = torch.tensor([0.02, 0.02])  # standard deviations of what the wheels do not notice in a step: m, rad
MARKER = 0.05  # m


def moved(state: torch.Tensor, wheels: torch.Tensor) -> torch.Tensor:
    """The state one step later: turn by half, drive, turn by the other half."""
    distance, turn = wheels.unbind(-1)
    x, y, heading = state.unbind(-1)
    middle = heading + turn / 2
    return torch.stack([x + distance * middle.cos(), y + distance * middle.sin(), heading + turn], -1)


def drive(robots: int) -> TensorDict:
    """True states, what the wheels counted, and markers, ``[robots, STEPS]``."""
    time = DT * torch.arange(STEPS)
    turn = 0.08 * (0.35 * time + 6.28 * torch.rand(robots, 1)).sin()
    wheels = torch.stack([torch.full_like(turn, 0.1), turn], -1)
    states = [torch.zeros(robots, 3)]
    for step in range(1, STEPS):
        states.append(moved(states[-1], wheels[:, step - 1] + SLIP * torch.randn(robots, 2)))
    state = torch.stack(states, 1)
    seen = (torch.arange(STEPS) % EVERY == 0).reshape(1, STEPS, 1).expand(robots, STEPS, 1)
    marker = state[..., :2] + MARKER * torch.randn(robots, STEPS, 2)
    entries = {"state": state, "wheels": wheels, "marker": torch.where(seen, marker, torch.nan), "observed": seen}
    return TensorDict(entries, [robots, STEPS])


drives = drive(20)

# %%
# The filter
# ----------
# The motion is known, so no network is trained here. What the filter knows, its *belief*, is an *ensemble* of 100
# members: possible states, which the motion moves on. Each member slips by an amount of its own. In this way the
# ensemble spreads, and shows how the error of the heading becomes an error of the place.
#
# ``control_keys`` says that ``"wheels"`` is an action: what is in row t moves the state of t to that of t + 1.


class Wheels(Transition):
    """Moves each member by what the wheels counted, and by a slip of its own."""

    noise_names = ("",)

    def __init__(self):
        super().__init__(torch.nn.Identity(), [("belief", "ensemble"), "wheels"], [("forecast", "ensemble")])

    def noise_sizes(self, ensemble, *_):
        """Tells how many members there are."""
        return {"members": ensemble.shape[-2]}

    def draw_noise(self, batch_size, *, members=None, device=None, dtype=None, generator=None, **_):
        """Draws the slips in standard deviations, ``[*B, E, 2]``."""
        if members is None:
            return None
        return torch.randn(*batch_size, members, 2, device=device, dtype=dtype, generator=generator)

    def compute(self, ensemble, wheels, *, noise):
        """The forecast."""
        return moved(ensemble, wheels.unsqueeze(-2) + SLIP * noise)


robot = DEnKF(
    transition=Wheels(),
    sensor=None,
    observation=Select([0, 1]),
    noise=ConstantNoise([MARKER, MARKER], in_key="marker"),
    analysis=EnsembleAnalysis("etkf", observation_key="marker"),
    initial=GaussianPrior([0.0, 0.0, 0.0], [0.01, 0.01, 0.01], ensemble_size=MEMBERS),
    control_keys=["wheels"],
)

# %%
# A recording, smoothed
# ---------------------
# :class:`~torch_denkf.smoothers.EnRTS` runs the filter over a recording, and then goes back through it. In each row it
# leaves the filter's belief and, under ``"smoothed"``, the belief of the same time given the whole recording.
#
# Halfway between two markers the smoother is several times nearer to the truth. Its intervals are narrower, too, and
# hold the truth as often as they should. In the rows with a marker both know the place well.

with torch.no_grad():
    out = EnRTS(robot)(drives.copy())


def error(name: str, rows: torch.Tensor) -> float:
    """Root mean square distance from the true place in some rows, m."""
    return (out[name, "mean"] - drives["state"])[:, rows, :2].square().sum(-1).mean().sqrt().item()


since = torch.arange(STEPS) % EVERY
# The stretch after the last marker has no later marker, and there is nothing to look back from.
for name in ("belief", "smoothed"):
    rows = (since > 0) & (torch.arange(STEPS) < STEPS - EVERY)
    inside = interval_coverage(
        out[name, "mean"][:, rows], out[name, "var"][:, rows], drives["state"][:, rows], level=0.9
    )
    print(f"{name:8s} {error(name, rows):.2f} m off between markers; 90 % coverage {inside[:2].mean():.0%}")
assert error("smoothed", rows) < 0.6 * error("belief", rows)
assert 0.8 < inside[:2].mean() < 0.98

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained", width_ratios=[1.3, 1])
one = out[3]
filtered = {"filter: jumps at each marker": one["belief", "mean"]}
plot_path(one, belief="smoothed", others=filtered, spread="ellipses", legend=False, ax=left)
left.plot(*one["marker"].unbind(-1), "k^", label="markers")
left.set(title="One drive")
left.legend(fontsize=8)
steps = torch.arange(EVERY)
rows = steps.reshape(1, -1) + EVERY * torch.arange(1, STEPS // EVERY - 1).reshape(-1, 1)
for name, colour in (("belief", "tab:orange"), ("smoothed", "tab:blue")):
    squares = (out[name, "mean"] - drives["state"])[..., :2].square().sum(-1)[:, rows]
    spread = out[name, "var"][..., :2].sum(-1)[:, rows]
    right.plot(DT * steps, squares.mean((0, 1)).sqrt(), color=colour, label=f"{name}: error")
    right.plot(DT * steps, spread.mean((0, 1)).sqrt(), color=colour, linestyle=":", label="what it says itself")
right.set(xlabel="time since the last marker, s", ylabel="m", title="All drives", ylim=(0, None))
right.legend(fontsize=8)
plt.show()

# %%
# While the robot runs
# --------------------
# Nothing later is known yet. :class:`~torch_denkf.smoothers.FixedLag` makes a filter that says, at each step, what it
# believes of the state L steps ago: ``("smoothed", "mean")`` in row t is the state of t - L. The answer gets better
# with each step that you can wait. After a whole stretch between two markers it is nearly as good as that of the
# recording.

print(" lag, s   error, m")
lags, errors = [5, 10, 20, 40], []
for lag in lags:
    with torch.no_grad():
        online = FixedLag(robot, lag).sequence(drives.copy())["smoothed", "mean"][:, lag:]
    difference = (online - drives["state"][:, :-lag])[:, : STEPS - EVERY, :2]
    errors.append(difference.square().sum(-1).mean().sqrt().item())
    print(f"{DT * lag:6.1f}   {errors[-1]:.2f}")
assert errors == sorted(errors, reverse=True)

# %%
# Two ways to go back
# -------------------
# :class:`~torch_denkf.smoothers.EnRTS` goes back step by step. :class:`~torch_denkf.smoothers.EnKS` lets each reading
# correct all earlier members at once, by how they vary together with what was read. Both find the same path here. With
# few members they differ: chance correlations between now and long ago harm EnKS, which is why it takes a lag.

with torch.no_grad():
    other = EnKS(robot, lag=EVERY)(drives.copy())
apart = (other["smoothed", "mean"] - out["smoothed", "mean"])[:, :-EVERY, :2].norm(dim=-1).mean().item()
print(f"The two smoothed paths are {100 * apart:.1f} cm apart, on average.")
assert apart < 0.5 * error("smoothed", torch.arange(STEPS) > 0)

# %%
# From here
# ---------
# * Which smoother for which filter, masks, late readings, training through a smoother: :doc:`/how_to/smoothing`.
# * Errors next to those of DAPPER, a library for data assimilation: :doc:`/results/smoothing`.
