r"""
All filters on one system
=========================

Which filter should I take? This page runs each filter of the library on the same small system, a pendulum that a camera
films from the side, and compares errors, calibration and time.

The motion of the pendulum is known here, and so is the noise. The filters that learn parts of their model can
learn more than this page shows; :doc:`plot_first_filter` does.
"""

# %%
# The system
# ----------
# The state is [angle in rad, angular speed in rad/s]. Wind pushes the pendulum in each step of 0.1 s. The reading is
# the sine of the angle, with noise of standard deviation 0.1.

import time

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict

from torch_denkf.baselines import BackpropKF, LSTMFilter
from torch_denkf.filters import DPF, EKF, UKF, DEnKF, KalmanFilter, ParticleFilter
from torch_denkf.functional import crps_ensemble, crps_gaussian
from torch_denkf.modules import (
    ConstantNoise,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedLikelihood,
    LearnedObservation,
    LearnedTransition,
    LocalEnsembleAnalysis,
    MomentPrior,
    NoisyTransition,
)
from torch_denkf.objectives import GaussianLoss, MixtureLoss

torch.manual_seed(0)
DT, WIND, NOISE = 0.1, 0.05, 0.1
PRIOR = [0.4, 0.6]  # standard deviations of the state at the start, around zero


def swing(state: torch.Tensor) -> torch.Tensor:
    """States ``[*, 2]``, one step later."""
    angle, speed = state.unbind(-1)
    speed = speed + DT * (-4.0 * angle.sin() - 0.2 * speed)
    return torch.stack([angle + DT * speed, speed], -1)


def record(swings: int, steps: int) -> TensorDict:
    """Swings, and what the camera reads."""
    states = [torch.tensor(PRIOR) * torch.randn(swings, 2)]
    for _ in range(steps - 1):
        push = WIND * torch.randn(swings, 1) * torch.tensor([0.0, 1.0])
        states.append(swing(states[-1]) + push)
    state = torch.stack(states, 1)
    reading = state[..., :1].sin() + NOISE * torch.randn(swings, steps, 1)
    return TensorDict({"state": state, "reading": reading}, [swings, steps])


unseen = record(50, 100)

# %%
# The filters
# -----------
# They share their parts. ``moments`` is the initial belief of the filters with a mean and a covariance, ``members`` and
# ``particles`` are those of the filters with an ensemble or particles.
#
# The Kalman filter and the Backprop KF need a linear system: they get the pendulum at rest, where the sine of the angle
# is nearly the angle.

motion, side = LearnedTransition(swing, residual=False), LearnedObservation(lambda state: state[..., :1].sin())
noise, wind = ConstantNoise([NOISE], in_key="reading"), [0.0, WIND]
moments = MomentPrior(torch.zeros(2), torch.tensor(PRIOR).square().diag())
members = GaussianPrior([0.0, 0.0], PRIOR, ensemble_size=64)
particles = GaussianPrior([0.0, 0.0], PRIOR, ensemble_size=200)
at_rest = torch.tensor([[1 - 0.4 * DT, 0.98 * DT], [-0.4, 0.98]])
look, push = torch.eye(1, 2), torch.tensor(wind).square().diag()
gaussian = {"initial": moments, "observation_key": "reading"}


def ensemble(analysis) -> DEnKF:
    """An ensemble filter with an analysis."""
    return DEnKF(motion, None, side, noise, analysis, initial=members, process_noise=wind)


likelihood = LearnedLikelihood(
    1, 1, num_cells=(32, 32), encoding_key="reading", observation_key="reading", scale=[NOISE]
)
windy = NoisyTransition(motion, wind)
filters = {
    "KalmanFilter, at rest": KalmanFilter(
        at_rest,
        look,
        process_noise_cov=push,
        noise=[NOISE],
        mean=moments.mean,
        cov=moments.cov,
        observation_key="reading",
    ),
    "BackpropKF, at rest": BackpropKF(at_rest, None, look, noise, process_noise_cov=push, **gaussian),
    "EKF": EKF(motion, None, side, noise, process_noise=wind, **gaussian),
    "UKF": UKF(motion, None, side, noise, process_noise=wind, **gaussian),
    "DEnKF, etkf": ensemble(EnsembleAnalysis("etkf", observation_key="reading")),
    "DEnKF, perturbed": ensemble(EnsembleAnalysis("perturbed", observation_key="reading")),
    "DEnKF, sakov": ensemble(EnsembleAnalysis("sakov", observation_key="reading")),
    "DEnKF, local": ensemble(LocalEnsembleAnalysis(torch.ones(2, 1), observation_key="reading")),
    "ParticleFilter": ParticleFilter(
        motion, None, side, noise=noise, initial=particles, process_noise=wind, observation_key="reading"
    ),
    "DPF": DPF(windy, None, side, likelihood, initial=particles),
    "LSTMFilter": LSTMFilter(None, features=1, state_dim=2, encoding_key="reading", hidden_size=32, scale=[0.35, 0.7]),
}

# %%
# Two of them hold networks that must be trained: the likelihood of the DPF, and all of the LSTM. A short training will
# do to see where they stand.

train = record(256, 40)
for loss, updates, rate in (
    (MixtureLoss(filters["DPF"]), 30, 3e-3),
    (GaussianLoss(filters["LSTMFilter"]), 120, 1e-2),
):
    optimiser = torch.optim.Adam(loss.parameters(), rate)
    for _ in range(updates):
        batch = train[torch.randint(256, (32,)), :20].clone()
        value = sum(v for key, v in loss(batch).items() if key.startswith("loss"))
        optimiser.zero_grad()
        value.backward()
        optimiser.step()

# %%
# The comparison
# --------------
# * The *error* is the root mean square of the belief's mean against the truth.
# * The *CRPS* also looks at the spread: a belief that is too sure or too doubtful scores worse. Its unit is that of the
#   state.
# * *NIS* is the normalised innovation squared. Its mean is 1 if the filter knows how far off readings will be. A filter
#   that is too sure of itself has a larger one.
# * The *time* is that of one step of one pendulum, eagerly. ``filter.compile()`` makes it shorter, see
#   :doc:`/results/speed`.


def crps(out: TensorDict) -> torch.Tensor:
    """Of the belief, whatever it is made of, ``[*B, 2]``."""
    belief, truth, names = out["belief"], out["state"], set(out["belief"].keys())
    if "log_weight" in names:
        return crps_ensemble(belief["ensemble"], truth, belief["log_weight"])
    if "ensemble" in names:
        return crps_ensemble(belief["ensemble"], truth)
    return crps_gaussian(belief["mean"], belief["var"], truth)


table, runs = {}, {}
for name, filter in filters.items():
    with torch.no_grad():
        out = runs[name] = filter.sequence(unseen.clone())[:, 10:]
        row = filter.initialise(unseen[0, 0].clone())
        begin = time.perf_counter()
        for _ in range(20):
            row = filter.step(row)
    milliseconds = 1000 * (time.perf_counter() - begin) / 20
    error = (out["belief", "mean"] - out["state"]).square().mean((0, 1)).sqrt()
    nis = out["info", "nis"].mean().item() if ("info", "nis") in out.keys(True) else float("nan")
    table[name] = [*error.tolist(), *crps(out).mean((0, 1)).tolist(), nis, milliseconds]

print(f"{'':22}  error rad  rad/s  CRPS rad  rad/s   NIS   ms")
for name, values in table.items():
    print("{:22}  {:9.3f}  {:5.3f}  {:8.3f}  {:5.3f}  {:4.1f}  {:3.1f}".format(name, *values))

# %%
# The filters with the true motion are alike, because the belief of this system is nearly a Gaussian. The filters for
# linear systems pay a little for the angle in place of its sine. DPF and LSTM had to learn in a few seconds what the
# others were given; they have no NIS, because nothing in them predicts a reading and its variance.

figure, axes = plt.subplots(figsize=(8, 3.6), layout="constrained")
names = list(table)
axes.barh(names, [table[name][2] for name in names], color="tab:blue")
axes.invert_yaxis()
axes.set_xlabel("CRPS of the angle, rad (smaller is better)")
plt.show()

# %%
# What to take
# ------------
# =======================================================  =========================================================
# you have                                                 take
# =======================================================  =========================================================
# a linear system                                          ``KalmanFilter``, exact
# a smooth motion, a belief with one bump                  ``EKF`` or ``UKF``
# a network for motion or sensor, images, many components  ``DEnKF``; ``"etkf"`` for readings used as they are
# a field of thousands of components                       ``DEnKF`` with ``LocalEnsembleAnalysis``
# beliefs with several bumps, few dimensions               ``ParticleFilter``, or the learned ``DPF``
# no idea of the motion, many recordings                   ``LSTMFilter``, as a rival
# =======================================================  =========================================================
