"""Filters by name. To add a filter, decorate a :class:`UR5Recipe` with ``@register``."""

from __future__ import annotations

from collections import OrderedDict
from copy import deepcopy

import torch
from torch import Tensor

from benchmarks.common.arm import JOINTS, recipes
from benchmarks.common.arm.recipes import ArmRecipe
from benchmarks.common.arm.sensors import Statistics
from benchmarks.common.recipes import Registry
from benchmarks.ur5.demos import STATE
from benchmarks.ur5.motion import ACCELERATIONS, RATES, SIZE, Motion
from benchmarks.ur5.sensors import MEMBERS, NEAR, NearForecast, Preset, unit_of
from torch_denkf.filters import Filter
from torch_denkf.modules import DiagonalNoise, ImageSensor, ScaledNoise, SubModel

WHITE = 0.7  # share of the sensor's errors that is white; the slow share is equal: 0.7^2 + 0.7^2 = 1
INITIAL = 0.05  # standard deviation of the belief at the start of an episode, in those of the training states
ARM_TAPER, PLACE_TAPER = 0.7, 0.8  # between joints, and between joints and place: chosen on the validation demos
GRIPPER = JOINTS - 1  # its opening is independent of the other components

FILTERS = Registry()
register = FILTERS.register


class UR5Recipe(ArmRecipe):
    """A filter of an arm: all read the same sensor and begin with the same motion, near the true state.

    Inflation multiplies all noise: Q, R, and the sensor's samples around their mean, so that gains stay and spreads
    grow. Inflation of the belief itself would do harm here: only the sum of a component and its bias is observed, and
    their difference would grow.

    Args:
        sensor: with a frozen trunk, and a head that is trained with the filter.
        preset: of the sensor.
        facts: statistics of the training demos.
        motion: trained before; the filter gets a copy.
        error: root mean square error of the sensor's state, ``[10]``, on validation demos. It sets R, bias and start
            before training.
        members: of an ensemble.
    """

    dims, unit, scaled = range(STATE), unit_of(STATE), (ScaledNoise, NearForecast)
    rates, moved, observation_key, first_key = ACCELERATIONS, (range(JOINTS), RATES), NEAR, "state"
    # Place, accelerations and biases; joints and rates follow from the accelerations.
    noisy = [*range(JOINTS, STATE), *ACCELERATIONS, *range(SIZE, SIZE + STATE)]  # noqa: RUF012
    forecast_key = ("forecast", "mean")

    def __init__(
        self, sensor: ImageSensor, preset: Preset, facts: Statistics, motion: Motion, error: Tensor, members=MEMBERS
    ):
        self.sensor, self.preset, self.facts, self.motion = sensor, preset, facts, deepcopy(motion)
        self.members, self.error, self.bias_std = members, error, WHITE * error
        self.encoding = sensor.module["head"].layers[-1].in_features
        self.first_std = torch.cat([INITIAL * facts.scale, torch.zeros(SIZE - STATE)])
        # As large as a filter's error in the long run, or the filter learns to trust its start.
        wrong = torch.maximum(2 * INITIAL * facts.scale, error)
        self.start_std = torch.cat([wrong, 0.3 * facts.rate, 0.5 * facts.acceleration])

    def start(self, windows, generator):
        noise = torch.randn(len(windows), 1, len(self.start_std), generator=generator)
        return windows["motion"] + self.start_std * noise

    def noise(self):
        keys = {"in_features": self.encoding, "in_key": ("sensor", "encoding")}
        return ScaledNoise(DiagonalNoise(STATE, r=WHITE * self.error, **keys))

    def readings(self):
        return OrderedDict(near=NearForecast(self.preset, self.forecast_key))

    @property
    def process_std(self) -> Tensor:
        """Returns the process noise before training: 0.5 mm, usual jerks, and noise that keeps the biases' variance."""
        slow = (1 - self.motion.fading**2) ** 0.5 * self.bias_std
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

    def build(self) -> Filter:
        """Returns the filter, including its sensor."""
        model = super().build()
        parts = OrderedDict(sensor=self.sensor, **{name: model[name] for name in model.module})
        return Filter(parts, initial=model.initial)


@register
class DEnKF(recipes.DEnKF, UR5Recipe):
    """The differentiable ensemble Kalman filter, with innovations of the sensor's samples.

    Attributes:
        factors: whether ``taper`` damps covariances.
    """

    forecast_key = ("forecast", "ensemble")
    factors = True

    @property
    def taper(self) -> tuple[Tensor, Tensor] | None:
        """Returns factors on the covariances of the state and the ten readings, and of the readings.

        128 members have spurious correlations of 0.09. Joints and place are related only by the kinematics; the
        gripper's opening is independent of the others. Rates, accelerations and biases have the factors of their joint.
        """
        if not self.factors:
            return None
        readings = torch.full((STATE, STATE), ARM_TAPER)
        readings[JOINTS:], readings[:, JOINTS:], readings[JOINTS:, JOINTS:] = PLACE_TAPER, PLACE_TAPER, 1.0
        readings[GRIPPER], readings[:, GRIPPER] = 0.0, 0.0
        readings.fill_diagonal_(1.0)
        return torch.cat([readings, readings[:JOINTS], readings[:JOINTS], readings]), readings


@register
class DEKF(recipes.DEKF, UR5Recipe):
    """See :class:`benchmarks.common.arm.recipes.DEKF`."""


@register
class DUKF(recipes.DUKF, UR5Recipe):
    """See :class:`benchmarks.common.arm.recipes.DUKF`."""


@register
class BKF(recipes.BKF, UR5Recipe):
    """See :class:`benchmarks.common.arm.recipes.BKF`."""
