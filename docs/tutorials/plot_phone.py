r"""
A phone's log to its orientation
================================

A phone has a gyro, an accelerometer and a magnetometer. The gyro says how fast the phone turns, and is a little off:
its angles drift away. The accelerometer says where up is, but also reads each push of the hand. The magnetometer says
where north is, ten times a second.

This page makes one filter of the three. It tells roll, pitch and yaw with bands, and finds out how far off the gyro is.
The state is an *orientation*, which is no list of plain numbers: :doc:`/how_to/orientation` has the convention.
"""

# %%
# The log
# -------
# Twelve seconds at 50 Hz. A hand turns the phone about, and pushes it by about 1 m/s^2 for a few tenths of a second. In
# place of this simulation you would read a file: the gyro in rad/s, the accelerometer in m/s^2 with gravity in it, the
# magnetometer in microtesla, all in the phone's axes.

from functools import partial

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict

from torch_denkf import FusedFilter, FusedSensor
from torch_denkf.functional.manifolds import SO3, Flat, rotate
from torch_denkf.modules import AroundState, EnsembleAnalysis
from torch_denkf.motions import AttitudeMotion, Gravity, Magnetic
from torch_denkf.plots import plot_bands

torch.manual_seed(0)
DT, ROWS, MEMBERS = 0.02, 600, 64
FIELD = [0.0, 20.0, -44.0]  # microtesla; the world's x points east, y north, z up
BIAS = torch.tensor([0.03, -0.02, 0.01])  # rad/s: what the gyro reads too much


def wandering(size: float, seconds: float) -> torch.Tensor:
    """Three numbers that wander about zero, [ROWS, 3]: how far, and for how long they stay."""
    keep = 1 - DT / seconds
    value, values = size * torch.randn(3), []
    for _ in range(ROWS):
        value = keep * value + size * (1 - keep**2) ** 0.5 * torch.randn(3)
        values.append(value)
    return torch.stack(values)


rates, pushes = wandering(0.6, 1.0), wandering(1.0, 0.3)
turns = [SO3().exp(torch.tensor([0.3, -0.2, 0.8]))]
for row in range(1, ROWS):
    turns.append(SO3().plus(turns[-1], DT * rates[row]))
truth = torch.stack(turns)

motion = AttitudeMotion(DT, gyro_noise=1e-3, gyro_walk=1e-4)
gravity, magnetic = Gravity(motion.space), Magnetic(motion.space, FIELD)
to_body = SO3().inverse(truth)
data = TensorDict({"gyro": rates + BIAS + 1e-3 / DT**0.5 * torch.randn(ROWS, 3)}, [ROWS])
data["accelerometer"] = gravity.observe(truth) + rotate(to_body, pushes) + 0.03 * torch.randn(ROWS, 3)
data["magnetometer"] = magnetic.observe(truth) + 0.5 * torch.randn(ROWS, 3)
data["magnetometer_observed"] = (torch.arange(ROWS) % 5 == 0).unsqueeze(-1)

# %%
# The filter
# ----------
# ``AttitudeMotion`` turns the orientation by what the gyro reads, less its bias. The state is a quaternion and that
# bias, seven numbers. Errors have six: three of a small turn, three of the bias. So standard deviations have six, too.
#
# A push lasts for many readings, which are then wrong in the same way. The filter takes errors for independent ones. So
# the accelerometer's standard deviation is several times the size of a push.
#
# The start is a guess: 0.3 rad off in an unknown direction, and no bias.

guess = torch.cat([SO3().perturb(truth[0], torch.tensor(0.3), torch.randn(3)), torch.zeros(3)])
data["guess"] = guess.expand(ROWS, 7)
phone = FusedFilter(
    motion,
    {"accelerometer": FusedSensor(gravity, [6.0] * 3), "magnetometer": FusedSensor(magnetic, [1.0] * 3)},
    initial=AroundState([0.3] * 3 + [0.03] * 3, ensemble_size=MEMBERS, state_key="guess", space=motion.space),
    process_noise=motion.process_noise,
    analysis=partial(EnsembleAnalysis, "etkf", localisation="significance"),
)
with torch.no_grad():
    out = phone.sequence(data.clone())

error = SO3().distance(out["belief", "mean"][:, :4], truth).rad2deg()
print(f"after one second {error[50]:.1f} degrees; later {error[100:].square().mean().sqrt():.1f}, root mean square")
bias, spread = out["belief", "mean"][-1, 4:], out["belief", "var"][-1, 3:].sqrt()
print("bias in rad/s:", [f"{a:.3f} +- {b:.3f}" for a, b in zip(bias, spread, strict=True)])
assert error[100:].square().mean().sqrt() < 3
assert ((bias - BIAS).abs() < 4 * spread + 0.005).all()

# %%
# Roll, pitch and yaw
# -------------------
# The members are guesses of the orientation, so any number that an orientation has can be told of each of them: here
# three angles. The bands are the members' quantiles.


def angles(q: torch.Tensor) -> torch.Tensor:
    """Roll, pitch and yaw [*, 3] in rad of quaternions [*, 4]."""
    w, x, y, z = q.unbind(-1)
    roll = torch.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = torch.asin((2 * (w * y - x * z)).clamp(-1, 1))
    return torch.stack([roll, pitch, torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))], -1)


members = angles(out["belief", "ensemble"][..., :4])
shown = TensorDict({"belief": {"ensemble": members, "mean": angles(out["belief", "mean"][:, :4])}}, [ROWS])
shown["belief", "var"] = members.var(-2)
shown["state"] = angles(truth)

figure, axes = plt.subplots(3, 1, figsize=(8, 6), sharex=True, layout="constrained")
plot_bands(
    shown,
    names=["roll, degrees", "pitch, degrees", "yaw, degrees"],
    space=Flat(3, circular=[0, 1, 2]),
    time=DT,
    ax=axes,
)
plt.show()

# %%
# From here
# ---------
# * Conversions, readings that are orientations, and what cannot be done: :doc:`/how_to/orientation`.
# * Velocity and position besides: :class:`~torch_denkf.motions.InertialMotion`.
# * Other rates, delays, and sensors that fail: :doc:`/how_to/several_sensors`.
