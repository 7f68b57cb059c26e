"""Recipes of filters of an arm: the DEnKF, and the baselines that carry mean and covariance."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from benchmarks.common.arm.motion import ArmMotion, BiasedReading, WithBias
from benchmarks.common.recipes import Recipe
from torch_denkf import modules as m
from torch_denkf.filters import Filter
from torch_denkf.modules.around import AroundInitial


class AtRest(AroundInitial):
    """Initial belief around the components that a sensor reads, at rest.

    Args:
        initial: a belief around the filters' state.
        size: of the filters' state; further components are zero.
        input_dim: D.
        state_key: ``[*B, D]``, or the filters' state.
    """

    place = "initial"

    def __init__(self, initial: TensorDictModuleBase, size: int, input_dim: int, state_key: NestedKey):
        super().__init__(initial, [state_key], optional_keys=())
        self.size = self.state_dim = size
        self.input_dim = input_dim

    def on_entries(self, entries, call):
        """Returns the belief."""
        (key,) = self.in_keys
        state = self.required(entries, key)
        return self.run_inside({**entries, key: nn.functional.pad(state, (0, self.size - state.shape[-1]))}, call)


class ArmRecipe(Recipe):
    """A filter whose motion was trained before; the first entries of its mean are the components that the sensor reads.

    Attributes:
        actions: whether the motion reads the commands.
        bias: whether the state has the sensor's biases.
        motion: trained before.
        members: of an ensemble.
        process_std: process noise of motion and bias in a step before training, for each of ``noisy``.
        bias_std: of the bias.
        noisy: dimensions of the state that the process noise acts on.
        rates: those of ``noisy`` that are rates or accelerations, one for each of ``moved``.
        moved: groups of dimensions that the noise of ``rates`` moves in the same step; by default the first ones.
        first_key: entry with the state around which a sequence begins.
        first_std: standard deviations of that state, for each component of the motion's state.
        start_std: standard deviations of ``"start"``, around which windows of the training begin.
        taper: factors on the ensemble's covariances of state and readings, and of the readings.
        scheme: of the ensemble's update.
        threshold: of the localisation by significance; ``None`` for none.
    """

    actions = False
    bias = True
    motion: ArmMotion
    members: int
    process_std: Tensor
    bias_std: Tensor
    noisy: list[int]
    rates: list[int]
    first_key: NestedKey = "start"
    first_std: Tensor
    start_std: Tensor
    taper: tuple[Tensor, Tensor] | None = None
    scheme = "sensor"
    threshold: float | None = None

    @property
    def moved(self) -> Sequence[Sequence[int]]:
        """Returns the first dimensions of the state, as many as there are rates."""
        return (range(len(self.rates)),)

    @property
    def size(self) -> int:
        """Returns S, the dimension of the state."""
        return self.motion.size + self.motion.read * self.bias

    def transition(self) -> m.SubModel:
        """Returns the learned motion as a transition of ensembles."""
        network = WithBias(self.motion) if self.bias else self.motion
        return m.LearnedTransition(network, residual=False, action_key="action" if self.actions else None)

    def process_noise(self) -> m.SubModel:
        """Returns the process noise Q of the dimensions ``noisy``."""
        return m.ScaledNoise(self._process_noise())

    def _process_noise(self) -> m.SubModel:
        raise NotImplementedError

    def observation(self) -> m.SubModel:
        """Returns the measurement model."""
        return m.LearnedObservation(BiasedReading(self.motion))

    def belief(self, std: Tensor, state_key: NestedKey) -> TensorDictModuleBase:
        """Returns an initial belief around a state ``[*B, S]``."""
        raise NotImplementedError

    def initial(self, std: Tensor, state_key: NestedKey) -> TensorDictModuleBase:
        """Returns the initial belief around a reading, at rest, or around a whole state."""
        whole = torch.cat([std, self.bias_std])[: self.size]
        return AtRest(self.belief(whole, state_key), self.size, self.motion.read, state_key)

    def build(self) -> Filter:
        """Returns the filter, with the sensor's readings as input."""
        return Filter(self.modules(), initial=self.initial(self.first_std, self.first_key))

    def behind(self, model: Filter, *, training: bool = False) -> Filter:
        """Returns the filter without its sensor, with shared parameters; in training, windows begin at ``"start"``."""
        parts = OrderedDict((name, model[name]) for name in model.module if name != "sensor")
        return Filter(parts, initial=self.initial(self.start_std, "start") if training else model.initial)

    def begun(self, windows: TensorDict, generator: torch.Generator) -> TensorDict:
        """Adds to windows the loss's ``"target"``, with zero biases, and the ``"start"`` of their beliefs."""
        unknown = self.size - windows["motion"].shape[-1]
        windows["target"] = nn.functional.pad(windows["motion"], (0, unknown))
        windows["start"] = self.start(windows, generator)
        return windows

    def start(self, windows: TensorDict, generator: torch.Generator) -> Tensor:
        """Returns the states ``[B, T, D]`` around which windows begin."""
        raise NotImplementedError

    @property
    def state_scale(self) -> Tensor:
        """Returns the units of the loss, infinite for components without a weight in it."""
        return torch.cat([self.unit, torch.full((self.size - len(self.unit),), torch.inf)])


class DEnKF(ArmRecipe):
    """The differentiable ensemble Kalman filter, with innovations of the sensor's samples."""

    def modules(self):
        localised = {} if self.threshold is None else {"localisation": "significance", "threshold": self.threshold}
        keys = {"observation_key": self.observation_key}
        return OrderedDict(
            noise=self.noise(),
            transition=m.NoisyTransition(self.transition(), self.process_noise(), self.noisy, before=True),
            **self.readings(),
            observation=self.observation(),
            analysis=m.EnsembleAnalysis(self.scheme, taper=self.taper, **localised, **keys),
        )

    def belief(self, std, state_key):
        return m.AroundState(std, ensemble_size=self.members, state_key=state_key)

    def loss(self, model):
        loss = self.ensemble_loss(model)
        loss.set_keys(state="target")
        return loss


class DEKF(ArmRecipe):
    """Differentiable extended Kalman filter (Kloss et al. 2021), Jacobians through the learned motion.

    Noise of the rates moves the joints in the same step, as it does the members of an ensemble.
    """

    Analysis: type = m.EKFAnalysis

    def forecast(self, noise: m.SubModel) -> m.SubModel:
        """Returns the EKF's prediction; its Jacobian is a constant to the gradient, as in Kloss et al."""
        return m.EKFTransition(self.transition(), noise, stop_jacobian_gradient=True)

    def modules(self):
        matrix = torch.eye(self.size)[:, self.noisy]
        for rows in self.moved:
            matrix[list(rows), [self.noisy.index(rate) for rate in self.rates]] = 1.0
        return OrderedDict(
            noise=self.noise(),
            transition=self.forecast(m.MappedNoise(self.process_noise(), matrix)),
            **self.readings(),
            analysis=self.Analysis(self.observation(), observation_key=self.observation_key),
        )

    def belief(self, std, state_key):
        return m.GaussianAround(std, state_key=state_key)


class DUKF(DEKF):
    """Differentiable unscented Kalman filter (Kloss et al. 2021)."""

    Analysis = m.UKFAnalysis

    def forecast(self, noise: m.SubModel) -> m.SubModel:
        """Returns the UKF's prediction."""
        return m.UKFTransition(self.transition(), noise)


class BKF(DEKF):
    """Backprop-KF (Haarnoja et al. 2016): R from the frame, Q a learned constant with all covariances."""

    def _process_noise(self) -> m.SubModel:
        keys = {"in_key": ("belief", "mean"), "out_key": ("forecast", "noise")}
        return m.CholeskyNoise(len(self.noisy), r=self.process_std, in_features=self.size, **keys)
