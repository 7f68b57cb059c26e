"""A filter that learns from what a policy collects: from readings and actions alone, or with the simulator's states."""

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
LEAST = 0.01  # of the noises, in the readings' and the states' units: without any, an ensemble collapses


@dataclass(frozen=True)
class Learning:
    """Of a filter.

    Attributes:
        window: steps of a window that is learned from; ``None`` for whole episodes, which begin as the filter's own do.
        windows: in an update.
        first: updates before the policy moves, on one batch of random actions.
        further: updates after each of the policy's batches.
        noise_lr: learning rate of the noises' logarithms; that of the rest is 1e-2.
        pieces: windows that an episode is cut into, if more than one; otherwise windows begin anywhere in it.
            With ``window=None`` one.
        within: pieces in which the first entry of a reading is larger are left out.
        guess: whether the readings' noise begins at the value that :func:`between` finds in the first episodes, and not
            at the filter's own.

    Raises:
        ValueError: on pieces of whole episodes.
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

    A window that begins anywhere in an episode, where little is known, has a filter of the same parts with a wide
    prior. A whole episode has the filter's own start.

    Args:
        filter: trained in place.
        prior: mean and standard deviations of a state anywhere in an episode, ``[S]``.
        episodes: that will come.
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
        """Keeps episodes ``[B, T]``."""
        data = data.select("observation", "observed", "action", "state")
        if self.settings.guess and not len(self.episodes):
            own, found = self.filter["noise"].log_variance, between(data["observation"]).log()
            with torch.no_grad():
                own.copy_(torch.where(found.isnan(), own, found))  # NaN where no two neighbouring readings came
        if self.settings.pieces > 1:
            data = data[:, : self.settings.pieces * self.length].reshape(-1, self.length)
            data = data[~(data["observation"][..., 0].abs() > self.settings.within).any(-1)]  # NaN where none came
        if len(data):  # of a batch, all pieces may be left out
            self.episodes.extend(data)

    def update(self, updates: int) -> float:
        """Makes some updates; the last one's loss. Without episodes none."""
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

    The true value's own mean square step adds half of itself. NaN where no two neighbouring readings came.
    """
    return (readings.diff(dim=1).square().nanmean((0, 1)) / 2).clamp_min(LEAST**2)


def refiltered(filter: Filter, data: TensorDict) -> TensorDict:
    """Returns whole episodes ``[B, T]`` with means and variances of a filter's belief."""
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
