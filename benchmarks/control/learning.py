"""Trains a filter on a policy's data: from readings and actions alone, or with the simulator's states."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torch_denkf.filters import DEnKF, Filter
from torch_denkf.modules import ConstantNoise, GaussianPrior
from torch_denkf.objectives import DEnKFLoss

PARTS = ("transition", "observation", "noise", "analysis")
LEAST = 0.01  # floor of the noises, in the readings' and the states' units: without noise an ensemble collapses


@dataclass(frozen=True)
class Learning:
    """Settings of a filter's training.

    Attributes:
        window: steps of a training window; ``None`` for whole episodes, which begin with the filter's initial belief.
        windows: in an update.
        first: updates before the policy acts, on one batch of random actions.
        further: updates after each of the policy's batches.
        noise_lr: learning rate of the noises' logarithms; that of the rest is 1e-2.
        pieces: number of windows that an episode is cut into; with 1, windows begin anywhere in it. Must be 1 with
            ``window=None``.
        within: pieces in which the first entry of a reading is larger are dropped.
        guess: whether the readings' noise begins at the estimate of :func:`between` from the first episodes, instead
            of the filter's value.

    Raises:
        ValueError: if ``window`` is ``None`` and ``pieces`` is not 1.
    """

    window: int | None = 16
    windows: int = 32
    first: int = 150
    further: int = 10
    noise_lr: float = 3e-2
    pieces: int = 1
    within: float = math.inf
    guess: bool = False

    def __post_init__(self):
        if self.window is None and self.pieces > 1:
            raise ValueError(f"window=None takes whole episodes: give pieces=1, not {self.pieces}, or a window's steps")


class Learner:
    """Trains a filter on random windows of a replay buffer of episodes.

    Windows that begin anywhere in an episode are filtered with the same parts and a wide prior, whole episodes with the
    filter's initial belief.

    Args:
        filter: trained in place.
        prior: mean and standard deviations of a state anywhere in an episode, ``[S]``.
        episodes: number of episodes to come.
        settings: the task's.
        taught: whether the true states are scored (fair CRPS), and not the likelihood of the readings.
    """

    def __init__(
        self,
        filter: DEnKF,
        prior: tuple[Sequence[float], Sequence[float]],
        episodes: int,
        settings: Learning,
        taught: bool = False,
    ):
        self.filter, self.length, self.settings = filter, settings.window, settings
        members = filter.initial.ensemble_size
        start = filter.initial if settings.window is None else GaussianPrior(*prior, ensemble_size=members)
        parts = {name: filter[name] for name in PARTS}
        within = DEnKF(sensor=None, **parts, initial=start, update_at_reset=True)
        scale = torch.tensor(prior[1])
        self.loss = DEnKFLoss(within, sensor=0.0, state_scale=scale) if taught else DEnKFLoss.ad_enkf(within)
        noises = [module.log_variance for module in filter.modules() if isinstance(module, ConstantNoise)]
        others = [p for p in filter.parameters() if all(p is not noise for noise in noises)]
        self.optimiser = torch.optim.Adam([{"params": others}, {"params": noises, "lr": settings.noise_lr}], lr=1e-2)
        self.noises = noises
        self.schedule = torch.optim.lr_scheduler.ExponentialLR(self.optimiser, 0.997)
        storage = LazyTensorStorage(episodes * settings.pieces)
        self.episodes = ReplayBuffer(storage=storage, batch_size=settings.windows)

    def add(self, data: TensorDict) -> None:
        """Stores episodes ``[B, T]``."""
        data = data.select("observation", "observed", "action", "state")
        if self.settings.guess and not len(self.episodes):
            own, found = self.filter["noise"].log_variance, between(data["observation"]).log()
            with torch.no_grad():
                own.copy_(torch.where(found.isnan(), own, found))  # NaN where no two neighbouring readings came
        if self.settings.pieces > 1:
            data = data[:, : self.settings.pieces * self.length].reshape(-1, self.length)
            data = data[~(data["observation"][..., 0].abs() > self.settings.within).any(-1)]  # missing readings are NaN
        if len(data):  # all pieces of a batch may have been dropped
            self.episodes.extend(data)

    def update(self, updates: int) -> float:
        """Runs some updates, none without episodes; returns the last one's loss."""
        value = torch.zeros(())
        for _ in range(updates if len(self.episodes) else 0):
            episodes = self.episodes.sample()
            length = self.length or episodes.shape[1]
            start = torch.randint(episodes.shape[1] - length + 1, ())
            value = sum(self.loss(episodes[:, start : start + length]).values())
            self.optimiser.zero_grad()
            value.backward()
            nn.utils.clip_grad_norm_(self.filter.parameters(), 1.0)
            self.optimiser.step()
            self.schedule.step()
            with torch.no_grad():
                for log_variance in self.noises:
                    log_variance.clamp_(min=2 * math.log(LEAST))
        return value.item()


def between(readings: Tensor) -> Tensor:
    """Returns the readings' variance ``[O]``: half the mean square difference of neighbours in ``[B, T, O]``.

    It includes half the mean square step of the true value. NaN if no two neighbouring readings came.
    """
    return (readings.diff(dim=1).square().nanmean((0, 1)) / 2).clamp_min(LEAST**2)


def refiltered(filter: Filter, data: TensorDict) -> TensorDict:
    """Filters whole episodes ``[B, T]`` again, and returns them with means and variances of the new belief."""
    after = data["next"][:, -1:]
    frames = {key: torch.cat([data[key], after[key]], 1) for key in ("observation", "observed")}
    frames["action"] = torch.cat([data["action"], torch.zeros_like(data["action"][:, :1])], 1)
    with torch.no_grad():
        belief = filter.sequence(TensorDict(frames, [*data.shape[:-1], data.shape[-1] + 1]))["belief"]
    belief = belief.select("mean", "var")
    return (
        data.clone(False)
        .set("belief", belief[:, :-1])
        .set("next", data["next"].clone(False).set("belief", belief[:, 1:]))
    )
