"""Composes, trains and tunes a filter; the registry."""

from __future__ import annotations

from collections import OrderedDict
from copy import deepcopy

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from benchmarks.common.arms import ArmRecipe, AtRest
from benchmarks.common.recipes import Registry
from benchmarks.g1.baselines import SPREAD_CELLS
from benchmarks.g1.motion import FADING, BiasedReading, Motion
from benchmarks.g1.recordings import JOINTS
from benchmarks.g1.sensors import JOINT_UNIT, Statistics
from torch_denkf.filters import Filter
from torch_denkf.modules import DiagonalNoise, LearnedObservation, ScaledNoise, SubModel

# Of the sensor's errors little is new in each frame: on validation episodes neighbours correlate by 0.97 to 0.98.
WHITE, SLOW = 0.4, 0.92  # 0.4^2 + 0.92^2 = 1
SURPRISE = 3.0  # changes of a rate, of those in the training episodes: what comes next is not white. See the README.
MEMBERS = 128  # of the ensemble filters, which read as many samples of the sensor

FILTERS = Registry()
register = FILTERS.register


class RatesAndBias(SubModel):
    """Q of the rates from the belief's mean, and of the biases from what the sensor sees.

    A box over the hand makes a sensor wrong for as long as it is there: then the bias is large, not only R.

    Args:
        rates: reads the belief's mean.
        bias: reads the sensor's encoding.
    """

    def __init__(self, rates: DiagonalNoise, bias: DiagonalNoise):
        parts = nn.ModuleDict({"rates": rates, "bias": bias})
        super().__init__(parts, [*rates.in_keys, *bias.in_keys], rates.out_keys)

    def compute(self, mean, encoding, *, batch_size):
        """Variances ``[*B, 2D]``."""
        rates = self.module["rates"].compute(mean, batch_size=batch_size)
        return torch.cat([rates, self.module["bias"].compute(encoding, batch_size=batch_size)], -1)


class G1Recipe(ArmRecipe):
    """A filter of an arm's joints behind a trained sensor. All carry them in the first entries of their mean.

    Args:
        facts: statistics of the training episodes.
        motion: trained before; the filter gets a copy.
        error: root mean square error of the sensor, ``[D]``, on episodes that it has not seen.
        start: standard deviation of where episodes begin, ``[D]``.
        encoding: features of the sensor's encoding.
        spread: the variance of the sensor's errors as a function of the encoding, fitted before.
    """

    members = MEMBERS
    longer = 1  # times as many updates as others

    def __init__(
        self,
        facts: Statistics,
        motion: Motion,
        error: Tensor,
        start: Tensor,
        encoding: int,
        spread: DiagonalNoise,
    ):
        self.facts, self.motion = facts, deepcopy(motion)
        self.error, self.start, self.encoding, self.spread = error, start, encoding, spread
        self.dims, self.unit = range(JOINTS), torch.full((JOINTS,), JOINT_UNIT)

    def belief(self, std: Tensor) -> TensorDictModuleBase:
        """The belief around the state ``"start"``."""
        raise NotImplementedError

    def noise(self):
        return ScaledNoise(self._of_sensor(self.white, ("sensor", "noise")))

    def _of_sensor(self, share: float, out_key: NestedKey) -> DiagonalNoise:
        """A share of the sensor's errors, from what it sees; before training as it was fitted."""
        root = (self.spread.variance + self.spread.floor).sqrt()
        keys = {"in_features": self.encoding, "in_key": ("sensor", "encoding"), "out_key": out_key}
        noise = DiagonalNoise(JOINTS, r=share * root, num_cells=SPREAD_CELLS, **keys)
        noise.module.load_state_dict(self.spread.module.state_dict())
        return noise

    @property
    def white(self) -> float:
        """Returns R's share of the sensor's errors before training: all, where the state holds no bias."""
        return WHITE if self.bias else 1.0

    @property
    def noisy(self) -> list[int]:
        """Dimensions of the state that the process noise acts on: the numbers follow from their rates."""
        return list(range(JOINTS, self.size))

    @property
    def rates(self) -> list[int]:
        """Dimensions of the state that are rates."""
        return list(range(JOINTS, 2 * JOINTS))

    def observation(self) -> SubModel:
        """H."""
        return LearnedObservation(BiasedReading())

    @property
    def process_std(self) -> Tensor:
        """Returns what motion and bias do not know before training: accelerations; biases stay as large."""
        slow = (1 - FADING**2) ** 0.5 * SLOW * self.error
        return torch.cat([SURPRISE * self.motion.acceleration, slow])[: len(self.noisy)]

    def _process_noise(self) -> SubModel:
        motion, size = self.motion, JOINTS
        blind = self.size - 2 * size
        rates = DiagonalNoise(
            size,
            r=self.process_std[:size],
            in_features=self.size,
            loc=torch.cat([motion.loc, torch.zeros(size + blind)]),
            scale=torch.cat([motion.scale, motion.rate, torch.full((blind,), torch.inf)]),
            in_key=("belief", "mean"),
            out_key=("forecast", "noise"),
        )
        if not self.bias:
            return rates
        slow = self._of_sensor((1 - FADING**2) ** 0.5 * SLOW, ("forecast", "noise"))
        return RatesAndBias(rates, slow)

    def _initial(self, std: Tensor, rates: float) -> TensorDictModuleBase:
        whole = torch.cat([std, rates * self.motion.rate, SLOW * self.error])[: self.size]
        return AtRest(self.belief(whole), self.size, JOINTS, "start")

    def build(self) -> Filter:
        """The filter, on readings; episodes begin somewhere where those of the training do."""
        return Filter(self.modules(), initial=self._initial(self.start, 0.3))

    def for_training(self, model: Filter) -> Filter:
        """Returns the same filter, sharing all parameters, for windows that begin near what the sensor says."""
        parts = OrderedDict((name, model[name]) for name in model.module)
        return Filter(parts, initial=self._initial(2**0.5 * self.error, 1.0))
