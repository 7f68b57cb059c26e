"""Lorenz-96 with unknown forcing and model noise: simulated records, the filter, and its training."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from tensordict import TensorDict
from torch import nn
from torch.optim.lr_scheduler import CosineAnnealingLR

from benchmarks.common.descent import minimise
from benchmarks.common.lorenz96 import lorenz96_step
from torch_denkf.filters import DEnKF
from torch_denkf.functional.localisation import gaspari_cohn
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, FromSensor, LearnedTransition, Select
from torch_denkf.objectives import DEnKFLoss

FORCING, NOISE, R = 8.0, 0.2, 1.0  # of the true system: F; model noise and observation noise, standard deviations
START, NOISE_START = 5.0, 1.0  # F and model noise before training
BATCH, WARM_UP, WINDOW = 8, 20, 40  # windows in an update; steps before a window, and in it
SPIN_UP = 500  # steps from a random state to the attractor


class Lorenz96(nn.Module):
    """One step of the system for states ``[*, N]``; its only parameter is the forcing F."""

    def __init__(self, forcing: float) -> None:
        super().__init__()
        self.forcing = nn.Parameter(torch.tensor(forcing))

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        """Returns the states 0.05 time units later."""
        return lorenz96_step(state, forcing=self.forcing)


def tapers(dims: Sequence[int], variables: int, radius: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns factors on the covariances of all with observed variables ``[N, O]``, and among observed ``[O, O]``.

    With few members, correlations of distant variables are spurious; AD-EnKF tapers them in gain and likelihood.

    Args:
        dims: the observed variables, of those on the circle.
        variables: N, on the circle.
        radius: distance at which the factor is 5/24; it is zero from about twice that on.
    """
    observed, places = torch.as_tensor(dims), torch.arange(variables)
    return tuple(gaspari_cohn(on_circle(first, observed, variables), radius * 0.3**0.5) for first in (places, observed))


def on_circle(first: torch.Tensor, second: torch.Tensor, variables: int) -> torch.Tensor:
    """Returns distances ``[len(first), len(second)]`` between places on a circle."""
    distance = (first.unsqueeze(-1) - second).abs()
    return torch.minimum(distance, variables - distance)


def simulate(variables: int, steps: int, records: int, rng: torch.Generator) -> torch.Tensor:
    """Returns true states ``[records, steps, variables]`` on the attractor."""
    state = FORCING + torch.randn(records, variables, generator=rng)
    states = []
    for _ in range(SPIN_UP + steps):
        state = lorenz96_step(state, forcing=FORCING) + NOISE * torch.randn(state.shape, generator=rng)
        states.append(state)
    return torch.stack(states[SPIN_UP:], 1)


def observe(states: torch.Tensor, every: int, rng: torch.Generator) -> TensorDict:
    """Returns the filter's only input: ``observation`` ``[*B, T, variables / every]``."""
    seen = states[..., ::every]
    return TensorDict({"observation": seen + R * torch.randn(seen.shape, generator=rng)}, states.shape[:-1])


def make_filter(
    variables: int,
    every: int,
    ensemble_size: int,
    *,
    climate: tuple[float, float],
    radius: float | None,
    learn_noise: bool = False,
) -> DEnKF:
    """Returns an ensemble Kalman filter of the system with a wrong forcing.

    Args:
        variables: N.
        every: one variable in so many is observed.
        ensemble_size: E.
        climate: mean and standard deviation of one variable, for the initial belief of unobserved variables.
        radius: of the taper, see :func:`tapers`; ``None`` for none.
        learn_noise: whether the model noise is a parameter with one variance per variable, from a wrong start.
    """
    dims = list(range(0, variables, every))
    noise = ConstantNoise(
        [NOISE_START if learn_noise else NOISE] * variables,
        trainable=learn_noise,
        in_key=("belief", "ensemble"),
        out_key=("forecast", "noise"),
    )
    mean, std = climate
    taper = None if radius is None else tapers(dims, variables, radius)
    return DEnKF(
        transition=LearnedTransition(Lorenz96(START), residual=False),
        sensor=None,
        observation=Select(dims),
        noise=ConstantNoise([R] * len(dims), in_key="observation"),
        process_noise=noise,
        analysis=EnsembleAnalysis("perturbed", taper=taper, observation_key="observation"),
        initial=FromSensor(
            dims, [mean] * variables, [std] * variables, ensemble_size=ensemble_size, observation_key="observation"
        ),
    )


def climate_of(record: TensorDict) -> tuple[float, float]:
    """Returns mean and standard deviation of a variable, from observations whose variance includes R."""
    observation = record["observation"]
    return observation.mean().item(), (observation.var().item() - R**2) ** 0.5


def forcing_of(denkf: DEnKF) -> torch.Tensor:
    """Returns the parameter F."""
    return denkf["transition"].module["transition"].module.forcing


def noise_of(denkf: DEnKF) -> torch.Tensor:
    """Returns the standard deviation of the model noise of each variable."""
    return (0.5 * denkf["transition"].module["noise"].log_variance).exp().detach()


def learn(denkf: DEnKF, record: TensorDict, updates: int, rng: torch.Generator, rate: float = 0.1) -> None:
    """Maximises the likelihood on windows of the ``record`` ``[records, steps]``, in place.

    A window begins with the belief of the present filter after a warm-up from the window's first observation, because
    the likelihood under the wide initial belief has little information about F. ``rng`` draws the windows, and torch's
    global generator the noise of the filter.
    """
    loss = DEnKFLoss.ad_enkf(denkf, detach_every=10)

    def batch_loss() -> torch.Tensor:
        rows = torch.randint(record.shape[0], (BATCH,), generator=rng).tolist()
        starts = torch.randint(record.shape[1] - WARM_UP - WINDOW, (BATCH,), generator=rng).tolist()
        places = zip(rows, starts, strict=True)
        frames = torch.stack([record[row, start : start + WARM_UP + WINDOW + 1] for row, start in places])
        with torch.no_grad():
            warm = denkf.sequence(frames[:, : WARM_UP + 1].copy()).select(*denkf.belief_keys)
        frames = frames[:, WARM_UP:].copy()
        # A stored belief needs an entry for every time; only the first is read, because there is no reset in between.
        frames.update(warm[:, -1:].expand(BATCH, WINDOW + 1))
        return loss(frames)["loss_nll"]

    cosine = partial(CosineAnnealingLR, T_max=updates, eta_min=0.01 * rate)
    minimise(denkf.parameters(), batch_loss, updates, rate, schedule=cosine, clip=10.0)


@torch.no_grad()
def evaluate(denkf: DEnKF, states: torch.Tensor, record: TensorDict, skip: int) -> float:
    """Returns the RMSE of the belief's mean on an unseen record, whose true states no training uses."""
    mean = denkf.sequence(record.copy())["belief", "mean"]
    return (mean - states)[:, skip:].square().mean().sqrt().item()
