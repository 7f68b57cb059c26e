"""One filter of several sensors, each with its own rate, noise, mask and delay."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Unpack

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase

from torch_denkf._checks import check_count
from torch_denkf.filters._options import FilterOptions
from torch_denkf.filters.base import Filter
from torch_denkf.modules import (
    ConstantNoise,
    CrossTransition,
    EKFAnalysis,
    EKFTransition,
    EnsembleAnalysis,
    EnsemblePast,
    JoinedObservation,
    JoinedReading,
    JointForecast,
    LaggedAnalysis,
    LaggedBelief,
    LinearTransition,
    NoisyTransition,
    PresentOfJoint,
    Renamed,
    SensorWeights,
    StateObservation,
    UKFAnalysis,
    UKFTransition,
    WeightedNoise,
    WithEnsemblePast,
    WithJointMoments,
    as_process_noise,
)
from torch_denkf.modules._base import check_module, writes
from torch_denkf.modules._gaussian import GaussianTransition

__all__ = ["FusedFilter", "FusedSensor"]


@dataclass(frozen=True)
class FusedSensor:
    """One sensor of a :class:`FusedFilter`.

    The keys of its modules need not be chosen: what they write is put under ``("sensor", NAME, ...)``.

    Attributes:
        observation: h, what the sensor would read in a state: :class:`~torch_denkf.modules.Select`,
            :class:`~torch_denkf.modules.LinearObservation`, :class:`~torch_denkf.modules.LearnedObservation`.
        noise: R: standard deviations ``[O]``, or a module that writes variances ``[*B, O]``.
        sensor: a module that reads frames and writes the reading, such as an image sensor; ``None`` where the reading
            is in the data.
        reading: its key in the data, ``[*B, O]``; by default the sensor's name.
        observed: its mask, ``[*B, 1]`` or ``[*B, O]``, True where there is a reading; by default NAME_observed. A
            sensor with a lower rate than the filter's has it True in every n-th step.
        delay: by how many steps its readings come late. Each then corrects the state that it belongs to, and through
            the covariances all since.
        late: key of an entry ``[*B, 1]``, int64, that says it for each reading, 0 to ``delay``, where delays vary.
        angles: components of the reading that are angles in radians.
        features: an entry ``[*B, F]`` that tells how good a reading is, for the filter's ``weights``: one of the data,
            or one that ``sensor`` writes, such as its encoding, under the sensor's own key.
        analysis: makes the sensor's own update, see :class:`FusedFilter`; ``None`` for the filter's.
    """

    observation: TensorDictModuleBase
    noise: TensorDictModuleBase | Sequence[float] | torch.Tensor
    sensor: TensorDictModuleBase | None = None
    reading: NestedKey | None = None
    observed: NestedKey | None = None
    delay: int = 0
    late: NestedKey | None = None
    angles: Sequence[int] = ()
    features: NestedKey | None = None
    analysis: Callable[..., TensorDictModuleBase] | None = None


@dataclass(frozen=True)
class _Wired:
    """A sensor's modules under keys of their own, and those keys."""

    modules: dict[str, TensorDictModuleBase]
    reading: NestedKey
    noise: NestedKey
    observed: NestedKey
    features: NestedKey | None


class FusedFilter(Filter):
    """A filter of any number of sensors, each with its own rate, noise, mask and delay.

    The belief follows from ``initial``: an ensemble, or a mean and a covariance (a Kalman, extended or unscented Kalman
    filter). In each step the transition forecasts, and the readings that are there correct the forecast: one sensor
    after the other, or all in one update. For linear Gaussian systems both give the same. The first takes less where
    sensors are many, and lets each linearise at the belief that the sensors before it left.

    Readings that come late need the last L states beside the belief, L the largest delay. An ensemble carries them as
    :class:`~torch_denkf.smoothers.FixedLag` does; a mean and a covariance as one joint Gaussian, which for linear
    systems gives what readings in their order give. With process noise and few members, the sample covariances of an
    ensemble make a difference between late and in order, which falls with more members; with :class:`Refiltering` there
    is none. Where there is a delay, the belief of L steps ago stands under ``("smoothed", ...)``. A reading that
    belongs to the time before the episode is not observed.

    Diagnostics of the sensors stand under ``("info", NAME, ...)``, their sums under ``("info", "nis")`` and
    ``("info", "log_likelihood")``; with one sensor, or a joint update, ``("info", ...)``.

    Args:
        transition: forecasts an ensemble; or, for a mean and a covariance,
            :class:`~torch_denkf.modules.LinearTransition`, :class:`~torch_denkf.modules.EKFTransition` or
            :class:`~torch_denkf.modules.UKFTransition`, or a transition of ensembles, which becomes that of an extended
            Kalman filter.
        sensors: by name, in the order of their updates.
        initial: the initial belief.
        process_noise: Q of the motion: standard deviations ``[S]`` (a number for all), or a module that writes Q.
        joint: whether all readings make one update.
        analysis: makes the update of each sensor, or of all. For an ensemble it gets keys as
            :class:`~torch_denkf.modules.EnsembleAnalysis` takes them, ``partial(EnsembleAnalysis, "etkf")`` by default;
            for a mean and a covariance an observation model in front of them, as
            :class:`~torch_denkf.modules.EKFAnalysis`.
        weights: a network that says how much each reading counts, :class:`~torch_denkf.modules.SensorAttention`; the
            weights ``[*B, 1]`` stand under ``("weight", NAME)``. ``None``: readings count as their noise says.
        lag: L; by default the largest delay.
        **kwargs: ``control_keys``, ``init_key``, ``update_at_reset``, ``forecast_keys``, ``variance_ceiling``,
            ``check_finite`` and ``reject`` of :class:`Filter`.

    Raises:
        ValueError: if there is no sensor, a delay is negative or beyond the lag, or process noise is missing or given
            twice.
        TypeError: for particles, sensors that are no dict, or an analysis that cannot correct earlier states.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import LinearTransition, MomentPrior, Select
        >>> move, noise = torch.tensor([[1.0, 0.1], [0.0, 1.0]]), torch.diag(torch.tensor([0.0, 0.01]))
        >>> cart = FusedFilter(
        ...     LinearTransition(move, noise),
        ...     {"wheel": FusedSensor(Select([1]), [0.3]), "gps": FusedSensor(Select([0]), [1.0], delay=3)},
        ...     initial=MomentPrior(torch.zeros(2), torch.eye(2)),
        ... )
        >>> drive = TensorDict({"wheel": torch.ones(20, 1), "gps": torch.ones(20, 1)}, [20])
        >>> drive["gps_observed"] = torch.arange(20).unsqueeze(-1) % 10 == 3  # a fix a second, 0.3 s late
        >>> cart.sequence(drive)["info", "gps", "nis"].count_nonzero()
        tensor(2)
    """

    def __init__(
        self,
        transition: TensorDictModuleBase,
        sensors: Mapping[str, FusedSensor],
        *,
        initial: TensorDictModuleBase,
        process_noise: TensorDictModuleBase | Sequence[float] | float | None = None,
        joint: bool = False,
        analysis: Callable[..., TensorDictModuleBase] | None = None,
        weights: torch.nn.Module | None = None,
        lag: int | None = None,
        **kwargs: Unpack[FilterOptions],
    ):
        check_module("transition", transition)
        check_module("initial", initial)
        if not isinstance(sensors, Mapping) or not all(isinstance(one, FusedSensor) for one in sensors.values()):
            raise TypeError(f"sensors is a dict, {{name: FusedSensor(...)}}; got {type(sensors).__name__}: {sensors}")
        if not sensors:
            raise ValueError("FusedFilter needs at least one sensor: sensors={name: FusedSensor(...)}.")
        gaussian = _is_gaussian(initial)
        lag = _lag_of(sensors, lag)
        transition = _moving(transition, process_noise, initial, gaussian)
        modules: OrderedDict[str, TensorDictModuleBase] = OrderedDict()
        wired = {}
        for name, sensor in sensors.items():
            wired[name] = _wire(name, sensor)
            modules.update(wired[name].modules)
        age = -1 if kwargs.get("update_at_reset") else 0
        size = getattr(initial, "state_dim", 0)
        if lag and not size:
            raise ValueError(f"{type(initial).__name__} does not say its state_dim, which a delay needs.")
        prefix = "forecast"
        if gaussian and lag:
            modules["transition"], modules["past"] = CrossTransition(transition), JointForecast()
            initial, prefix = WithJointMoments(initial, lag, age=age), "joint"
        elif lag:
            modules["transition"], modules["past"] = transition, EnsemblePast()
            initial = WithEnsemblePast(initial, lag, age=age)
        else:
            modules["transition"] = transition
        build = _Updates(gaussian, lag, size, _analysis_for(transition, gaussian) if analysis is None else analysis)
        if weights is not None:
            modules.update(build.weighted(prefix, sensors, wired, weights))
        last = "fused" if gaussian and lag else "belief"
        modules.update((build.joint if joint else build.in_turn)(prefix, last, sensors, wired))
        if lag:
            modules["smoothed"] = PresentOfJoint(size, last) if gaussian else LaggedBelief()
        super().__init__(modules, initial=initial, **kwargs)
        self.sensors, self.lag = tuple(sensors), lag


class _Updates:
    """Makes the modules behind the forecast.

    Args:
        gaussian: whether the belief is a mean and a covariance.
        lag: L.
        size: S.
        analysis: makes an update.
    """

    def __init__(self, gaussian: bool, lag: int, size: int, analysis: Callable[..., TensorDictModuleBase]):
        self.gaussian, self.lag, self.size, self.analysis = gaussian, lag, size, analysis

    def in_turn(self, prefix, last, sensors, wired):
        """An update for each sensor."""
        modules, names = {}, list(sensors)
        for name, sensor in sensors.items():
            to = last if name == names[-1] else f"after_{name}"
            model = self._model(prefix, name, sensor, wired[name])
            keys = {"reading": wired[name].reading, "noise": wired[name].noise, "observed": wired[name].observed}
            if model.state_dim is not None:
                keys["observed"] = model.out_keys[1]
            modules.update(self._update(name, model, prefix, to, sensor.angles, sensor.analysis, **keys))
            prefix = to
        return modules

    def joint(self, prefix, last, sensors, wired):
        """One update for all sensors."""
        own = [name for name, sensor in sensors.items() if sensor.analysis is not None]
        if own:
            raise ValueError(f"A joint update is one for all sensors, and {own} have an analysis of their own.")
        models = {name: self._model(prefix, name, sensor, wired[name]) for name, sensor in sensors.items()}
        keys = {
            "reading": ("sensor", "joint"),
            "noise": ("sensor", "joint_noise"),
            "observed": ("forecast", "observed"),
        }
        join = JoinedReading(
            [wired[name].reading for name in sensors],
            [wired[name].noise for name in sensors],
            [sensor.angles for sensor in sensors.values()],
            reading_key=keys["reading"],
            noise_key=keys["noise"],
        )
        model = JoinedObservation(models, predicted_key=("forecast", "observation"), observed_key=keys["observed"])
        angles = _joint_angles(sensors)
        return {"readings": join, **self._update("analysis", model, prefix, last, angles, None, **keys)}

    def weighted(self, prefix, sensors, wired, weights):
        """The sensors' weights, and their noise after them."""
        models = {name: self._model(prefix, name, sensor, wired[name]) for name, sensor in sensors.items()}
        modules = {
            "weights": SensorWeights(
                weights,
                models,
                {name: wired[name].reading for name in sensors},
                {name: wired[name].noise for name in sensors},
                {name: wired[name].features for name in sensors if wired[name].features is not None},
                {name: sensor.angles for name, sensor in sensors.items()},
                state_key=(prefix, "ensemble"),
                moments=prefix if self.gaussian else None,
            )
        }
        for name, sensor in sensors.items():
            key, size = ("sensor", name, "weighted_noise"), _observation_dim(sensor)
            modules[f"{name}_weighted"] = WeightedNoise(wired[name].noise, ("weight", name), key, observation_dim=size)
            wired[name] = replace(wired[name], noise=key)
        return modules

    def _model(self, prefix: str, name: str, sensor: FusedSensor, wired: _Wired) -> StateObservation:
        ensemble = (prefix, "ensemble")
        # Without a delay only the mask of a state with a past must be told apart; a past elsewhere is not looked at.
        late = self.lag > 0 and (sensor.delay > 0 or sensor.late is not None or self.gaussian)
        return StateObservation(
            sensor.observation,
            ensemble,
            ("forecast", name, "observation"),
            reading_keys=[wired.reading, wired.noise],
            observed_key=wired.observed,
            delay=sensor.delay,
            late_key=sensor.late,
            past_key=None if self.gaussian or not late else ("forecast", "past"),
            state_dim=self.size if late else None,
            # An update of a mean and a covariance runs the model inside, and reads the mask behind it.
            seen_key=wired.observed if self.gaussian else ("forecast", name, "observed"),
        )

    def _update(self, name, model, prefix, to, angles, analysis, *, reading, noise, observed):
        make = self.analysis if analysis is None else analysis
        keys = {"noise_variance_key": noise, "observed_key": observed, "belief_key": to, "angles": list(angles)}
        predicted = unravel_key(model.out_keys[0])
        if self.gaussian:
            keys |= {"observation_key": reading, "forecast_key": prefix}
            return {name: make(model, ensemble_key=(prefix, "ensemble"), predicted_key=predicted, **keys)}
        update = make(forecast_key=(prefix, "ensemble"), predicted_key=predicted, sensor_key=reading, **keys)
        return {f"{name}_observation": model, name: LaggedAnalysis(update) if self.lag else update}


def _is_gaussian(initial: TensorDictModuleBase) -> bool:
    written = writes(initial)
    if ("belief", "log_weight") in written:
        raise TypeError("FusedFilter has no particles; give ParticleFilter one likelihood of all readings.")
    return ("belief", "ensemble") not in written


def _lag_of(sensors: Mapping[str, FusedSensor], lag: int | None) -> int:
    """L: what is given, or the largest delay."""
    for name, sensor in sensors.items():
        check_count(f"delay of {name!r}", sensor.delay, least=0)
        if sensor.late is not None and sensor.delay < 1:
            raise ValueError(f"{name!r} has late={sensor.late!r}; say how late its readings can be: delay=...")
    longest = max(sensor.delay for sensor in sensors.values())
    if lag is not None and lag < longest:
        raise ValueError(f"A reading comes up to {longest} steps late, beyond lag={lag}.")
    return longest if lag is None else lag


def _moving(transition, process_noise, initial, gaussian):
    """The transition with its process noise."""
    moments = isinstance(transition, LinearTransition | GaussianTransition)
    if moments and not gaussian:
        raise ValueError(
            f"{type(transition).__name__} moves a mean and a covariance, and {type(initial).__name__} writes an "
            "ensemble: use MomentPrior or GaussianAround, or a transition of ensembles."
        )
    if moments and process_noise is not None:
        raise ValueError(f"{type(transition).__name__} has its process noise already; leave process_noise out.")
    if moments:
        return transition
    if process_noise is None:
        if gaussian:
            raise ValueError("A mean and a covariance need process_noise=..., standard deviations [S] or a module.")
        return transition
    noise = as_process_noise(process_noise, initial)
    return EKFTransition(transition, noise) if gaussian else NoisyTransition(transition, noise)


def _analysis_for(transition: TensorDictModuleBase, gaussian: bool) -> Callable[..., TensorDictModuleBase]:
    if not gaussian:
        return partial(EnsembleAnalysis, "etkf")
    if isinstance(transition, UKFTransition):
        return partial(UKFAnalysis, alpha=transition.alpha, beta=transition.beta, kappa=transition.kappa)
    return EKFAnalysis


def _wire(name: str, sensor: FusedSensor) -> _Wired:
    """Puts what a sensor's modules write under ``("sensor", name, ...)``."""
    reading = unravel_key(name if sensor.reading is None else sensor.reading)
    observed = unravel_key(f"{name}_observed" if sensor.observed is None else sensor.observed)
    names: dict[NestedKey, NestedKey] = {"observed": observed}
    modules: dict[str, TensorDictModuleBase] = {}
    if sensor.sensor is None:
        names["sensor", "ensemble"] = reading
    else:
        for key in writes(sensor.sensor):
            names[key] = ("sensor", name, key if isinstance(key, str) else key[-1])
        reading = names[unravel_key(sensor.sensor.out_keys[0])]
        modules[f"{name}_sensor"] = Renamed(sensor.sensor, names)
    own = ("sensor", name, "noise")
    noise = sensor.noise if isinstance(sensor.noise, TensorDictModuleBase) else ConstantNoise(sensor.noise)
    names[writes(noise)[0]] = own
    modules[f"{name}_noise"] = Renamed(noise, names)
    features = None if sensor.features is None else unravel_key(sensor.features)
    return _Wired(modules, reading, own, observed, names.get(features, features))


def _joint_angles(sensors: Mapping[str, FusedSensor]) -> list[int]:
    """The angles among the readings side by side."""
    found, begin = [], 0
    for name, sensor in sensors.items():
        if not any(other.angles for other in sensors.values()):
            return []
        size = _observation_dim(sensor)
        if size is None:
            raise ValueError(f"The size of {name!r}'s readings is not known, so angles cannot be found side by side.")
        found += [begin + dim for dim in sensor.angles]
        begin += size
    return found


def _observation_dim(sensor: FusedSensor) -> int | None:
    noise = sensor.noise
    if isinstance(noise, TensorDictModuleBase):
        return getattr(noise, "observation_dim", getattr(noise, "dim", None))
    return len(noise)
