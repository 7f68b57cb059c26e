"""How to compose, train and tune a filter; the registry."""

from __future__ import annotations

from collections import OrderedDict
from copy import deepcopy

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from benchmarks.common.recipes import Recipe, Registry
from benchmarks.g1.motion import FADING, AtRest, BiasedReading, Motion, transition
from benchmarks.g1.sensors import Statistics
from benchmarks.g1.targets import Target
from torch_denkf.filters import Filter
from torch_denkf.modules import DiagonalNoise, LearnedObservation, ScaledNoise, SubModel

WHITE = 0.7  # of the sensor's errors so much is new in each frame, and as much stays: 0.7^2 + 0.7^2 = 1
MEMBERS = 64  # of the ensemble filters, which read as many samples of the sensor

FILTERS = Registry()
register = FILTERS.register


class G1Recipe(Recipe):
    """A filter of D numbers of a robot, behind a trained sensor. All carry them in the first D entries of their mean.

    Args:
        target: what is estimated.
        facts: statistics of the training episodes.
        motion: trained before; the filter gets a copy.
        error: root mean square error of the sensor, ``[D]``, on episodes that it has not seen.
        start: standard deviation of where episodes begin, ``[D]``.
        encoding: features of the sensor's encoding.
        ensemble_size: members of an ensemble.
    """

    actions = False  # whether the motion reads the commands
    encoders = False  # whether some joints have noisy encoders
    bias = True  # whether the state holds the sensor's slow errors
    members = MEMBERS

    def __init__(self, target: Target, facts: Statistics, motion: Motion, error: Tensor, start: Tensor, encoding: int):
        self.target, self.facts, self.motion = target, facts, deepcopy(motion)
        self.error, self.start, self.encoding = error, start, encoding
        self.dims, self.unit = range(target.size), torch.full((target.size,), target.unit)

    def belief(self, std: Tensor) -> TensorDictModuleBase:
        """The belief around the state ``"start"``."""
        raise NotImplementedError

    def noise(self):
        keys = {"in_features": self.encoding, "in_key": ("sensor", "encoding")}
        return ScaledNoise(DiagonalNoise(self.target.size, r=WHITE * self.error, num_cells=(32, 32), **keys))

    @property
    def size(self) -> int:
        """S, of the state."""
        return self.target.size * (3 if self.bias else 2)

    @property
    def noisy(self) -> list[int]:
        """Dimensions of the state that the process noise acts on: the numbers follow from their rates."""
        return list(range(self.target.size, self.size))

    def transition(self) -> SubModel:
        """The learned motion, with a copy of its pre-trained parameters."""
        return transition(self.motion, self.bias)

    def observation(self) -> SubModel:
        """H."""
        return LearnedObservation(BiasedReading(self.target.size, self.target.encoders if self.encoders else ()))

    @property
    def process_std(self) -> Tensor:
        """What motion and bias do not know before training: usual accelerations; biases stay as large."""
        slow = (1 - FADING**2) ** 0.5 * WHITE * self.error
        return torch.cat([self.motion.acceleration, slow])[: len(self.noisy)]

    def process_noise(self) -> SubModel:
        """Q of rates and bias, from the belief's mean."""
        return ScaledNoise(self._process_noise())

    def _process_noise(self) -> SubModel:
        motion, blind = self.motion, self.size - 2 * self.target.size
        return DiagonalNoise(
            len(self.noisy),
            r=self.process_std,
            in_features=self.size,
            loc=torch.cat([motion.loc, torch.zeros(self.target.size + blind)]),
            scale=torch.cat([motion.scale, motion.rate, torch.full((blind,), torch.inf)]),
            in_key=("belief", "mean"),
            out_key=("forecast", "noise"),
        )

    @property
    def state_scale(self) -> Tensor:
        """Units of the loss; rates and biases do not count."""
        return torch.cat([self.unit, torch.full((self.size - self.target.size,), torch.inf)])

    def _initial(self, std: Tensor, rates: float) -> TensorDictModuleBase:
        whole = torch.cat([std, rates * self.motion.rate, WHITE * self.error])[: self.size]
        return AtRest(self.belief(whole), self.size)

    def build(self) -> Filter:
        """The filter, on readings; episodes begin somewhere where those of the training do."""
        return Filter(self.modules(), initial=self._initial(self.start, 0.3))

    def for_training(self, model: Filter) -> Filter:
        """The same filter, sharing all parameters, for windows that begin at a wrong state."""
        parts = OrderedDict((name, model[name]) for name in model.module)
        return Filter(parts, initial=self._initial(1.5 * self.error, 1.0))
