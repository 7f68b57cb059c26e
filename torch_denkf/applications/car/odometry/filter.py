"""The filter of a car: a DEnKF over optical flow, with known motion of the pose."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, fields, replace

import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor

from torch_denkf._checks import check_count, check_number
from torch_denkf.applications.car.modules.flow_sensor import FlowSensor
from torch_denkf.applications.car.modules.member_gain import MemberGain
from torch_denkf.applications.car.modules.pairs import PairObservation, with_history
from torch_denkf.applications.car.modules.unicycle import UnicycleMotion, UnicycleTransition
from torch_denkf.applications.car.vision.poses import KITTI_DT
from torch_denkf.filters import Filter
from torch_denkf.modules import AroundState, DiagonalNoise, EnsembleAnalysis, StochasticMLP
from torch_denkf.modules.tensors import as_vector

__all__ = ["CarFilter", "CarSettings", "VELOCITIES", "car_filter"]

VELOCITIES = [3, 4]  # dimensions of v and theta_dot in [x, y, theta, v, theta_dot]
_HISTORY = ("belief", "history")  # velocities of the past steps
_UNITS = (0.1, 0.03)  # errors of a good sensor, in standard deviations of (v, theta_dot)
_START = 0.2  # uncertainty of the first velocities, in the same unit


@dataclass(frozen=True)
class CarSettings:
    """Settings of a :class:`CarFilter`.

    Attributes:
        dt: time between two frames, in s.
        velocity_mean: mean of (v m/s, theta_dot rad/s) over the training drives.
        velocity_std: standard deviation of (v m/s, theta_dot rad/s) over the training drives.
        ensemble_size: members, E.
        lags: number of past steps that an innovation corrects.
        longest: largest number of steps between the frames of a pair, after missing frames.
        reach: largest distance travelled between the two frames of a pair in the sensor's range, in m.
        features: size of the sensor's code of the flow.
        num_cells: hidden layers of the sensor's head.
        two_view: whether the sensor reads tracked corners, too (``"two_view"``, see
            :func:`torch_denkf.applications.car.vision.epipolar.two_view_motion`).
        size: (H, W) of the scaled images.
        focal: focal length of the training images, in pixels; images with a longer one are scaled down to it. ``None``
            for any.
        inflation: factor on the belief's spread in each step, chosen on validation drives.
    """

    dt: float = KITTI_DT
    velocity_mean: tuple[float, float] = (9.0, 0.0)
    velocity_std: tuple[float, float] = (4.0, 0.15)
    ensemble_size: int = 32
    lags: int = 4
    longest: int = 3
    reach: float = 3.1
    features: int = 32
    num_cells: tuple[int, ...] = (32, 32)
    two_view: bool = False
    size: tuple[int, int] = (100, 300)
    focal: float | None = None
    inflation: float = 1.0

    def __post_init__(self):
        for name in ("dt", "reach", "inflation"):
            check_number(name, getattr(self, name), above=0)
        for name in ("lags", "longest", "features", "ensemble_size"):
            check_count(name, getattr(self, name), least=2 if name == "ensemble_size" else 1)
        as_vector("velocity_mean", self.velocity_mean, 2)
        as_vector("velocity_std", self.velocity_std, 2, above=0)
        if len(self.size) != 2 or not all(isinstance(side, int) and side > 0 for side in self.size):
            raise ValueError(f"size is (height, width) in pixels, positive; got {self.size!r}.")
        if self.focal is not None:
            check_number("focal", self.focal, above=0, cure="It is in pixels")
        if not 1 <= self.longest <= self.lags + 1:
            raise ValueError(f"longest is 1 to lags + 1 = {self.lags + 1} steps; got {self.longest}.")

    @property
    def unit(self) -> Tensor:
        """Returns the unit of the error, in (m/s, rad/s): ``[2]``."""
        return torch.tensor(self.velocity_std) * torch.tensor(_UNITS)

    @property
    def start_std(self) -> Tensor:
        """Returns the standard deviation of the first state ``[5]``: zero for the pose, positive for the velocities."""
        return torch.cat([torch.zeros(3), _START * torch.tensor(self.velocity_std)])


def velocity_analysis(lags: int) -> EnsembleAnalysis:
    """Returns the analysis of a car's velocities, and those of the last ``lags`` steps, by readings of frame pairs.

    A taper removes spurious correlations between speed and turn rate. Inflation acts only on the present velocities, as
    those of past steps would be inflated again in each step.
    """
    own = torch.cat([torch.zeros(3, 2), torch.eye(2).repeat(1 + lags, 1)])
    return EnsembleAnalysis(
        "sensor",
        taper=(own, torch.eye(2)),
        inflated=VELOCITIES,
        forecast_key=("forecast", "clone"),
        observed_key=("forecast", "observed"),
        belief_prefix="analysis",
    )


class CarFilter(Filter):
    """A DEnKF for a car with one camera, built by :func:`car_filter`.

    It reads ``"flow"`` and ``"road"``, with the setting ``two_view`` also ``"two_view"`` (see
    :func:`torch_denkf.applications.car.with_motion`), ``"observed"`` and ``"steps"``, and at the beginning of an
    episode ``"start"`` ``[*B, 5]``, the first state. The state is [x m forward, y m to the left, theta rad to the left,
    v m/s, theta_dot rad/s].

    Args:
        settings: sizes and constants.

    Attributes:
        builder: name of its builder function in a saved folder.
    """

    builder = "car"

    def __init__(self, settings: CarSettings):
        s = settings
        mean, std = torch.tensor(s.velocity_mean), torch.tensor(s.velocity_std)
        sensor = FlowSensor(
            dt=s.dt,
            ensemble_size=s.ensemble_size,
            features=s.features,
            num_cells=s.num_cells,
            two_view_key="two_view" if s.two_view else None,
        )
        analysis = velocity_analysis(s.lags)
        analysis.inflation = s.inflation
        modules = OrderedDict(
            sensor=sensor,
            noise=DiagonalNoise(2, r=s.unit, in_features=sensor.encoding_features, in_key=("sensor", "encoding")),
            # Flipout perturbs the last layer's bias, too: process noise that does not depend on the velocity.
            transition=UnicycleTransition(
                StochasticMLP(2, 2, layer="flipout", output_gain=0.1),
                dt=s.dt,
                loc=mean,
                scale=std,
                history_key=_HISTORY,
                drift=False,
            ),
            observation=PairObservation([s.reach / s.dt, torch.inf]),
            # Most of the sensor's error is constant over a drive: each member has a constant gain.
            gain=MemberGain([0.05, 0.02], ensemble_size=s.ensemble_size, in_key=("forecast", "observation")),
            analysis=TensorDictSequential(analysis, UnicycleMotion(s.dt, history_key=_HISTORY, smooth=True)),
        )
        start = AroundState(s.start_std, ensemble_size=s.ensemble_size, state_key="start")
        super().__init__(modules, initial=with_history(start, s.lags))
        self._settings = settings

    @property
    def settings(self) -> CarSettings:
        """Returns the settings, with the present inflation."""
        return replace(self._settings, inflation=self.inflation)

    @property
    def sensor(self) -> FlowSensor:
        """Returns the sensor of velocities from flow and road, which can be trained and run alone."""
        return self["sensor"]

    @property
    def inflation(self) -> float:
        """Returns the factor on the belief's spread in each step."""
        return self._ensemble_analysis.inflation

    @inflation.setter
    def inflation(self, factor: float) -> None:
        self._ensemble_analysis.inflation = factor

    @property
    def _ensemble_analysis(self) -> EnsembleAnalysis:
        return next(module for module in self.modules() if isinstance(module, EnsembleAnalysis))

    def without_sensor(self) -> Filter:
        """Returns this filter without its sensor, for precomputed readings; parameters are shared."""
        names = [name for name in self.module if name != "sensor"]
        return Filter(OrderedDict((name, self[name]) for name in names), initial=self.initial)


def car_filter(settings: CarSettings | None = None, **changes) -> CarFilter:
    """Returns a DEnKF for a car with one camera, untrained.

    :class:`torch_denkf.applications.car.FlowSensor` reads speed and turn rate from optical flow and the road's
    correlation; the pose moves by the known motion of a unicycle; an ensemble analysis corrects the velocities, and the
    path of the past few steps with them.

    Args:
        settings: sizes and constants; the defaults are those of the KITTI study's DEnKF.
        **changes: single settings to replace.

    Returns:
        The filter; its sensor is ``filter.sensor``, the other modules are ``filter.without_sensor()``.

    Raises:
        TypeError: for an unknown setting.
        ValueError: for settings out of range.

    Example:
        >>> car = car_filter(ensemble_size=8)
        >>> from tensordict import TensorDict
        >>> frames = {"flow": torch.zeros(6, 3, 25, 79), "road": torch.zeros(6, 13, 69), "start": torch.zeros(6, 5)}
        >>> car.sequence(TensorDict(frames, [6]))["belief", "mean"].shape
        torch.Size([6, 5])
    """
    known = [field.name for field in fields(CarSettings)]
    if unknown := [name for name in changes if name not in known]:
        raise TypeError(f"{', '.join(unknown)} is no setting of a car filter; there are {', '.join(known)}")
    return CarFilter(replace(settings or CarSettings(), **changes))
