"""Filters by name. To add a filter, decorate a :class:`G1Recipe` with ``@register``."""

from __future__ import annotations

from collections import OrderedDict
from copy import deepcopy

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from benchmarks.common.arm import JOINTS, recipes
from benchmarks.common.arm.recipes import ArmRecipe, AtRest
from benchmarks.common.recipes import Particles, Registry
from benchmarks.g1.motion import Motion
from benchmarks.g1.sensors import JOINT_UNIT
from torch_denkf.baselines import LSTMFilter
from torch_denkf.baselines.lstm_cell import with_memory
from torch_denkf.modules import AroundState, DiagonalNoise, GaussianAround, NoisyTransition, ScaledNoise, SubModel
from torch_denkf.modules.particles import with_weights
from torch_denkf.objectives import GaussianLoss

# Shares of the sensor's errors that are white and slow: on validation episodes neighbours correlate by 0.97 to 0.98.
WHITE, SLOW = 0.4, 0.92  # 0.4^2 + 0.92^2 = 1
SURPRISE = 3.0  # factor on the training episodes' accelerations for the process noise, see the README
MEMBERS = 128  # of the ensemble filters, which read as many samples of the sensor
TAPER = 0.5  # factor on the covariances of different joints
SPREAD_CELLS = (16,)  # hidden layers of the sensor's spread
HIDDEN = 128  # of the LSTM

FILTERS = Registry()
register = FILTERS.register


class RatesAndBias(SubModel):
    """Process noise of the rates, from the belief's mean, and of the biases, from the sensor's encoding.

    A box over the hand makes a sensor wrong for as long as it is there, so that the bias grows, not only R.

    Args:
        rates: reads the belief's mean.
        bias: reads the sensor's encoding.
    """

    def __init__(self, rates: DiagonalNoise, bias: DiagonalNoise):
        parts = nn.ModuleDict({"rates": rates, "bias": bias})
        super().__init__(parts, [*rates.in_keys, *bias.in_keys], rates.out_keys)

    def compute(self, mean, encoding, *, batch_size):
        """Returns variances ``[*B, 2D]``."""
        rates = self.module["rates"].compute(mean, batch_size=batch_size)
        return torch.cat([rates, self.module["bias"].compute(encoding, batch_size=batch_size)], -1)


class G1Recipe(ArmRecipe):
    """A filter of an arm's joints behind a trained sensor.

    Args:
        motion: trained before; the filter gets a copy.
        error: root mean square error of the sensor, ``[D]``, on validation episodes.
        first: standard deviation of the first joints of episodes, ``[D]``.
        spread: the variance of the sensor's errors as a function of its encoding, fitted before.

    Attributes:
        longer: factor on the number of updates.
    """

    members, longer = MEMBERS, 1
    dims, unit = range(JOINTS), torch.full((JOINTS,), JOINT_UNIT)
    rates = list(range(JOINTS, 2 * JOINTS))  # noqa: RUF012

    def __init__(self, motion: Motion, error: Tensor, first: Tensor, spread: DiagonalNoise):
        self.motion, self.error, self.spread = deepcopy(motion), error, spread
        self.encoding, self.bias_std = len(spread.loc), SLOW * error
        self.first_std = torch.cat([first, 0.3 * motion.rate])
        self.start_std = torch.cat([2**0.5 * error, motion.rate])

    def start(self, windows, generator):
        # The start must be less certain than the sensor, or a filter learns to trust it, which fails in whole episodes.
        near = windows["sensor", "ensemble"][:, 0].mean(-2)
        near = near + self.error * torch.randn(near.shape, generator=generator)
        return near.unsqueeze(1).expand_as(windows["state"])

    def noise(self):
        # Without a bias in the state, all of the sensor's errors are white.
        return ScaledNoise(self._of_sensor(WHITE if self.bias else 1.0, ("sensor", "noise")))

    def _of_sensor(self, share: float, out_key: NestedKey) -> DiagonalNoise:
        """Returns the sensor's noise model, scaled by ``share`` and initialised with its fit."""
        root = (self.spread.variance + self.spread.floor).sqrt()
        keys = {"in_features": self.encoding, "in_key": ("sensor", "encoding"), "out_key": out_key}
        noise = DiagonalNoise(JOINTS, r=share * root, num_cells=SPREAD_CELLS, **keys)
        noise.module.load_state_dict(self.spread.module.state_dict())
        return noise

    @property
    def noisy(self) -> list[int]:
        """Returns the dimensions with process noise: rates and biases. The joints follow from their rates."""
        return list(range(JOINTS, self.size))

    @property
    def process_std(self) -> Tensor:
        """Returns the process noise before training: accelerations, and noise that keeps the biases' variance."""
        slow = (1 - self.motion.fading**2) ** 0.5 * self.bias_std
        return torch.cat([SURPRISE * self.motion.acceleration, slow])[: len(self.noisy)]

    def _process_noise(self) -> SubModel:
        motion, blind = self.motion, self.size - 2 * JOINTS
        rates = DiagonalNoise(
            JOINTS,
            r=self.process_std[:JOINTS],
            in_features=self.size,
            loc=torch.cat([motion.loc, torch.zeros(JOINTS + blind)]),
            scale=torch.cat([motion.scale, motion.rate, torch.full((blind,), torch.inf)]),
            in_key=("belief", "mean"),
            out_key=("forecast", "noise"),
        )
        share = (1 - motion.fading**2) ** 0.5 * SLOW
        return RatesAndBias(rates, self._of_sensor(share, ("forecast", "noise"))) if self.bias else rates


@register
class DEnKF(recipes.DEnKF, G1Recipe):
    """The differentiable ensemble Kalman filter, with innovations of the sensor's samples."""

    @property
    def taper(self) -> tuple[Tensor, Tensor]:
        """Returns factors that damp spurious correlations between joints. Rates and biases count as their joint."""
        readings = torch.where(torch.eye(JOINTS) > 0, 1.0, TAPER)
        return readings.repeat(self.size // JOINTS, 1), readings


@register
class DEnKFActions(DEnKF):
    """Reads the commands, too."""

    actions = True


@register
class DEKF(recipes.DEKF, G1Recipe):
    """See :class:`benchmarks.common.arm.recipes.DEKF`."""


@register
class DUKF(recipes.DUKF, G1Recipe):
    """See :class:`benchmarks.common.arm.recipes.DUKF`."""


@register
class BKF(recipes.BKF, G1Recipe):
    """See :class:`benchmarks.common.arm.recipes.BKF`."""


@register
class DPF_M(Particles, G1Recipe):
    """Kloss et al. 2021: Gaussian likelihood, soft resampling. Particles move by the learned motion."""

    bias = False  # a hundred particles are too few for seven more dimensions

    def noisy_motion(self):
        return NoisyTransition(self.transition(), self.process_noise(), self.noisy, before=True)

    def belief(self, std, state_key):
        return with_weights(AroundState(std, ensemble_size=self.particles, state_key=state_key))


@register
class LSTM(G1Recipe):
    """LSTM on the sensor's encoding and reading, without a motion model and with more updates."""

    bias = False
    longer = 6

    def modules(self):
        motion = self.motion
        whole = LSTMFilter(
            None,
            features=self.encoding,
            state_dim=JOINTS,
            initial=GaussianAround(self.first_std[:JOINTS]),
            loc=motion.loc,
            scale=motion.scale,
            hidden_size=HIDDEN,
            observation_dim=JOINTS,
            observation_loc=motion.loc,
            observation_scale=motion.scale,
        )
        return OrderedDict((name, whole[name]) for name in ("transition", "lstm"))

    def initial(self, std, state_key):
        return with_memory(AtRest(GaussianAround(std[:JOINTS], state_key=state_key), JOINTS, JOINTS, state_key), HIDDEN)

    def loss(self, model):
        return GaussianLoss(model, transition=0.0, sensor=0.0, dims=self.dims, state_scale=self.unit)

    def set_inflation(self, model, factor):
        model["lstm"].inflation = factor
