"""Composes, trains and tunes a filter; the registry."""

from __future__ import annotations

from collections import OrderedDict
from copy import deepcopy

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from benchmarks.common.arms import ArmRecipe, AtRest
from benchmarks.common.recipes import Registry
from benchmarks.ur5.demos import JOINTS, STATE
from benchmarks.ur5.motion import ACCELERATIONS, ERRORS, FADING, NOISY, RATES, SIZE, ArmMotion, BiasedReading
from benchmarks.ur5.sensors import MEMBERS, NearForecast, Preset, Statistics
from torch_denkf.filters import Filter
from torch_denkf.modules import DiagonalNoise, ImageSensor, LearnedObservation, ScaledNoise, SubModel
from torch_denkf.monitoring import BlackIsMissing

WHITE = 0.7  # of the sensor's errors so much is new in each frame, and as much stays: 0.7^2 + 0.7^2 = 1
INITIAL = 0.05  # standard deviation of the belief at the start of an episode, in those of the training states


FILTERS = Registry()
register = FILTERS.register


class UR5Recipe(ArmRecipe):
    """A filter of an arm: all read the same sensor and begin with the same motion, and all carry the table's ten
    numbers in the first ten entries of their mean.

    What is inflated is all noise: Q, R, and the sensor's samples around their mean. Gains stay, and spreads grow by it.
    Inflating the belief itself would do harm here: only the sum of a number and its bias is seen, and what they differ
    by would grow.

    Args:
        sensor: whose trunk stays as it is, and whose head is trained with the filter.
        preset: what it reads of a state.
        facts: statistics of the training demos.
        motion: trained before; the filter gets a copy.
        error: root mean square error of what the sensor says of the state, ``[10]``, on demos it has not seen. It sets
            how far R, bias and start are off before training.
        ensemble_size: members of an ensemble.
    """

    dims, unit, scaled = range(STATE), ERRORS, (ScaledNoise, NearForecast)
    rates, moved = ACCELERATIONS, (range(JOINTS), RATES)

    def __init__(
        self,
        sensor: ImageSensor,
        preset: Preset,
        facts: Statistics,
        motion: ArmMotion,
        error: Tensor,
        ensemble_size: int = MEMBERS,
    ):
        self.sensor, self.preset, self.facts, self.motion = sensor, preset, facts, deepcopy(motion)
        self.ensemble_size, self.error = ensemble_size, error
        self.encoding = sensor.module["head"].layers[-1].in_features

    def belief(self, std: Tensor, state_key: str) -> TensorDictModuleBase:
        """The belief around a state ``[*B, S]``."""
        raise NotImplementedError

    def noise(self):
        keys = {"in_features": self.encoding, "in_key": ("sensor", "encoding")}
        return ScaledNoise(DiagonalNoise(STATE, r=WHITE * self.error, **keys))

    @property
    def noisy(self) -> list[int]:
        """Dimensions of the state that the process noise acts on."""
        return [*NOISY, *range(SIZE, SIZE + STATE)]

    def observation(self) -> SubModel:
        """H of the near reading."""
        return LearnedObservation(BiasedReading())

    @property
    def process_std(self) -> Tensor:
        """Returns what motion and bias do not know before training: 0.5 mm, usual jerks; biases stay as large."""
        slow = (1 - FADING**2) ** 0.5 * WHITE * self.error
        return torch.cat([torch.full((3,), 0.0005), self.facts.jerk, slow])

    def _process_noise(self) -> SubModel:
        facts = self.facts
        return DiagonalNoise(
            len(self.noisy),
            r=self.process_std,
            in_features=self.size,
            loc=torch.cat([facts.loc, torch.zeros(2 * JOINTS + STATE)]),
            scale=torch.cat([facts.scale, facts.rate, facts.acceleration, torch.full((STATE,), torch.inf)]),
            in_key=("belief", "mean"),
            out_key=("forecast", "noise"),
        )

    @property
    def start_std(self) -> Tensor:
        """Returns how wrong training windows begin, ``[24]``."""
        # As far as a filter is off in the long run, or it learns to hold on to where it began.
        wrong = torch.maximum(2 * INITIAL * self.facts.scale, self.error)
        return torch.cat([wrong, 0.3 * self.facts.rate, 0.5 * self.facts.acceleration])

    def _with_bias(self, std: Tensor) -> Tensor:
        return torch.cat([std, WHITE * self.error])

    def initial(self) -> TensorDictModuleBase:
        """The belief at the start of an episode: near the true state, at rest."""
        std = torch.cat([INITIAL * self.facts.scale, torch.zeros(SIZE - STATE)])
        return AtRest(self.belief(self._with_bias(std), "state"), self.size, STATE)

    def build(self) -> Filter:
        """The whole filter, from pictures on."""
        black = BlackIsMissing(observed_key="arrived", out_key="observed")
        parts = OrderedDict(black=black, sensor=self.sensor, **self.modules())
        return Filter(parts, initial=self.initial())

    def behind(self, model: Filter, *, training: bool = False) -> Filter:
        """Returns the same filter, sharing all parameters, on readings; from a wrong ``"start"`` in training."""
        parts = OrderedDict((name, model[name]) for name in model.module if name not in ("black", "sensor"))
        if not training:
            return Filter(parts, initial=model.initial)
        belief = self.belief(self._with_bias(self.start_std), "start")
        return Filter(parts, initial=AtRest(belief, self.size, STATE, "start"))
