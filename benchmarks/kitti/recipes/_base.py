"""Base class of the recipes, and their registry."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from benchmarks.common.recipes import Recipe, Registry
from benchmarks.kitti.folds import VELOCITIES, Statistics
from torch_denkf.applications.car import FlowSensor, UnicycleTransition
from torch_denkf.applications.car.modules.pairs import PairObservation
from torch_denkf.filters import Filter
from torch_denkf.modules import DiagonalNoise, StochasticMLP, SubModel

REACH = 3.1  # m, largest distance between the two frames of a pair for the flow sensor
HISTORY = ("belief", "history")  # velocities of the past steps
INITIAL_STD = [0.0, 0.0, 0.0, 0.3, 0.02]  # m, m, rad, m/s, rad/s: the pose is where the drive starts
FILTERS = Registry()
register = FILTERS.register


class KITTIRecipe(Recipe):
    """A filter of a vehicle, whose mean begins with the state [x m, y m, theta rad, v m/s, theta_dot rad/s].

    Args:
        sensor: the fold's.
        facts: statistics of its training drives.
    """

    dims = VELOCITIES

    def __init__(self, sensor: SubModel, facts: Statistics):
        self.sensor, self.facts, self.unit = sensor, facts, facts.unit
        self.flow = isinstance(sensor, FlowSensor)
        self.encoding = sensor.encoding_features if self.flow else sensor.module["head"].layers[-1].in_features

    def initial(self, std: Sequence[float] | Tensor, state_key: str) -> TensorDictModuleBase:
        """Returns an initial belief around a state ``[*B, 5]``."""
        raise NotImplementedError

    def noise(self):
        return DiagonalNoise(2, r=self.unit, in_features=self.encoding, in_key=("sensor", "encoding"))

    def observation(self, **kwargs) -> PairObservation:
        """Returns the measurement model of pairs of frames; that of the image sensor corrects its shrunken speeds."""
        if self.flow:
            return PairObservation([REACH / self.facts.dt, torch.inf], curve=SpeedGain(), **kwargs)
        return PairObservation(curve=SensorCurve(self.facts.loc, self.facts.scale), **kwargs)

    def set_gain(self, model: Filter, logarithm: float) -> None:
        """Sets the logarithm of the flow sensor's scale factor of the speed."""
        for module in model.modules():
            if isinstance(module, SpeedGain):
                module.logarithm.fill_(logarithm)

    def transition(self, network: nn.Module) -> SubModel:
        """Returns the known motion of the pose; the velocities are random walks with a trend."""
        facts = self.facts
        keys = {"history_key": HISTORY, "drift": False}
        return UnicycleTransition(network, dt=facts.dt, loc=facts.loc, scale=facts.scale, **keys)

    @property
    def state_scale(self) -> Tensor:
        """Returns the units of the loss; the pose follows from the velocities and does not count."""
        return torch.cat([torch.full((3,), torch.inf), self.unit])

    def build(self) -> Filter:
        """Returns the whole filter."""
        return Filter(OrderedDict(sensor=self.sensor, **self.modules()), initial=self.initial(INITIAL_STD, "state"))

    def part(self, model: Filter, *, sensor: bool, start_std: Tensor | None = None) -> Filter:
        """Returns the filter with shared parameters, with or without its sensor, or around a noisy ``"start"``."""
        names = [name for name in model.module if sensor or name != "sensor"]
        initial = model.initial if start_std is None else self.initial(start_std, "start")
        return Filter(OrderedDict((name, model[name]) for name in names), initial=initial)


class SpeedGain(nn.Module):
    """Measurement model h of a sensor with a scale error of the speed, whose logarithm is measured."""

    def __init__(self):
        super().__init__()
        self.register_buffer("logarithm", torch.zeros(()), persistent=False)  # saved next to the weights

    def forward(self, velocity: torch.Tensor) -> torch.Tensor:
        """Predicts (v, theta_dot) ``[*, 2]``."""
        return velocity * torch.stack([self.logarithm.exp(), torch.ones_like(self.logarithm)])


class SensorCurve(nn.Module):
    """Measurement model h of the paper, for a sensor whose readings of the speed are biased towards their mean."""

    def __init__(self, loc: torch.Tensor, scale: torch.Tensor):
        super().__init__()
        self.correction = StochasticMLP(1, 1, (), layer="none", output_gain=0.0)  # linear; starts as the identity
        self.register_buffer("loc", loc[:1].clone())
        self.register_buffer("scale", scale[:1].clone())

    def forward(self, velocity: torch.Tensor) -> torch.Tensor:
        """Predicts (v, theta_dot) ``[*, 2]``."""
        v, theta_dot = velocity.split(1, -1)
        return torch.cat([v + self.scale * self.correction((v - self.loc) / self.scale), theta_dot], -1)
