"""Sensors and filters by name. A filter of your own: one function here, with ``@register``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictSequential
from torch import nn

from kitti_study.streams import LONGEST
from torch_denkf.filters import DEnKF, Filter
from torch_denkf.modules import (
    AroundState,
    DiagonalNoise,
    EnsembleAnalysis,
    FlowSensor,
    ImageSensor,
    LearnedObservation,
    PairObservation,
    StochasticMLP,
    SubModel,
    UnicycleMotion,
    UnicycleTransition,
    WithHistory,
    convolutional_trunk,
)

ENSEMBLE, VELOCITIES = 32, [3, 4]  # members; dimensions of v and theta_dot in [x, y, theta, v, theta_dot]
REACH = 3.1  # m between the two frames of a pair that the flow sensor can read
INITIAL_STD = [0.0, 0.0, 0.0, 0.3, 0.02]  # m, m, rad, m/s, rad/s: the pose is where the drive starts
# Standard deviations of (v, theta_dot) over the training drives' that a good sensor leaves: units of the losses.
UNITS = (0.1, 0.03)


@dataclass
class Statistics:
    """Means and standard deviations of the training drives alone."""

    loc: torch.Tensor  # of (v m/s, theta_dot rad/s); theta_dot's is 0, because every drive counts mirrored, too
    scale: torch.Tensor
    pixel_loc: torch.Tensor  # of a grey frame and of its difference to the one before
    pixel_scale: torch.Tensor
    dt: float  # s

    @property
    def unit(self) -> torch.Tensor:
        """What counts as an error of one, in (m/s, rad/s)."""
        return self.scale * torch.tensor(UNITS)


def flow_sensor(statistics: Statistics) -> SubModel:
    """Optical flow and road correlation."""
    return FlowSensor(dt=statistics.dt, ensemble_size=ENSEMBLE)


def image_sensor(statistics: Statistics) -> SubModel:
    """The paper's: Table I on a grey frame and its difference to the one before."""
    return ImageSensor(
        2,
        image_shape=(2, 50, 150),
        trunk=convolutional_trunk(2),
        ensemble_size=ENSEMBLE,
        loc=statistics.loc,
        scale=statistics.scale,
        pixel_loc=statistics.pixel_loc,
        pixel_scale=statistics.pixel_scale,
        encoding_key=("sensor", "encoding"),
    )


SENSORS: dict[str, Callable[[Statistics], SubModel]] = {"flow": flow_sensor, "image": image_sensor}
FILTERS: dict[str, Callable[[SubModel | None, Statistics], Filter]] = {}


def register(build: Callable[[SubModel | None, Statistics], Filter]):
    """Makes a filter available to all commands under its function's name."""
    FILTERS[build.__name__] = build
    return build


class SensorCurve(nn.Module):
    """h of the paper: what the sensor reads at a true speed; one that hedges reads slow as faster, fast as slower."""

    def __init__(self, loc: torch.Tensor, scale: torch.Tensor):
        super().__init__()
        self.correction = StochasticMLP(1, 1, (), layer="none", output_gain=0.0)  # linear; starts at "as it is"
        self.register_buffer("loc", loc[:1].clone())
        self.register_buffer("scale", scale[:1].clone())

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        """Predicts (v, theta_dot) ``[*, 2]``."""
        v, theta_dot = state[..., VELOCITIES].split(1, -1)
        return torch.cat([v + self.scale * self.correction((v - self.loc) / self.scale), theta_dot], -1)


@register
def denkf(sensor: SubModel, statistics: Statistics) -> Filter:
    """The differentiable ensemble Kalman filter with known motion of the pose."""
    pairs = isinstance(sensor, FlowSensor)
    encoding = sensor.encoding_features if pairs else sensor.module["head"].layers[-1].in_features
    # The flow sensor reads metres, from pairs of frames with a gap between them, too. One that was trained on grey
    # values hedges, and h is the curve by which it does.
    if pairs:
        observation = PairObservation([REACH / statistics.dt, torch.inf])
        keys = {"forecast_key": ("forecast", "clone"), "observed_key": ("forecast", "observed")}
    else:
        observation, keys = LearnedObservation(SensorCurve(statistics.loc, statistics.scale)), {}
    # Innovations correct the velocities, and each member's pose moves with them.
    motion = UnicycleMotion(statistics.dt, history_key=("belief", "history") if pairs else None)
    initial = AroundState(INITIAL_STD, ensemble_size=ENSEMBLE)
    return DEnKF(
        transition=UnicycleTransition(
            # Flipout perturbs the last layer's bias, too: process noise that does not depend on the velocity.
            StochasticMLP(2, 2, layer="flipout", output_gain=0.1),
            dt=statistics.dt,
            loc=statistics.loc,
            scale=statistics.scale,
            drift=False,
        ),
        sensor=sensor,
        observation=observation,
        noise=DiagonalNoise(2, r=statistics.unit, in_features=encoding, in_key=("sensor", "encoding")),
        analysis=TensorDictSequential(EnsembleAnalysis("sensor", belief_key="analysis", **keys), motion),
        initial=WithHistory(initial, LONGEST - 1) if pairs else initial,
    )


def analysis_of(model: Filter) -> EnsembleAnalysis:
    """The module that updates the ensemble."""
    return next(module for module in model.modules() if isinstance(module, EnsembleAnalysis))


def parts_of(model: Filter, *, sensor: bool, start_std: torch.Tensor | None = None) -> Filter:
    """The same filter, sharing all parameters, with or without its sensor; windows may start from a wrong velocity."""
    parts = {name: model[name] for name in ("transition", "observation", "noise", "analysis")}
    initial = model.initial
    if start_std is not None:
        initial = AroundState(start_std, ensemble_size=ENSEMBLE, state_key="start")
        if isinstance(model.initial, WithHistory):
            initial = WithHistory(initial, model.initial.lags)
    return DEnKF(sensor=model["sensor"] if sensor else None, **parts, initial=initial)
