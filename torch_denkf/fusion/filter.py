"""Filter of several sensors, each with its own rate, noise, mask and delay."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Unpack

import torch
from tensordict.nn import TensorDictModuleBase

from torch_denkf._checks import check_count
from torch_denkf.filters.base import Filter
from torch_denkf.filters.options import FilterOptions
from torch_denkf.filters.parts import check_kind
from torch_denkf.fusion._updates import Updates
from torch_denkf.fusion.joint_moments import JOINT_PAST, JointForecast, PresentOfJoint, joint_space
from torch_denkf.fusion.parts import LinearMembers, OfOwnErrors
from torch_denkf.fusion.sensor import FusedSensor, wire
from torch_denkf.modules import (
    EKFAnalysis,
    EKFTransition,
    EnsembleAnalysis,
    LinearTransition,
    NoisyTransition,
    UKFAnalysis,
    UKFTransition,
)
from torch_denkf.modules.ensemble import EnsembleUpdate
from torch_denkf.modules.gaussian import GaussianAnalysis, GaussianTransition
from torch_denkf.modules.process_noise import as_process_noise
from torch_denkf.running import check_module, writes
from torch_denkf.smoothers.past import ENSEMBLE_PAST, EnsemblePast, LaggedBelief, with_past
from torch_denkf.smoothers.past_moments import CrossTransition
from torch_denkf.submodel import Initial, role

__all__ = ["FusedFilter"]


class FusedFilter(Filter):
    """Fuses any number of sensors, each with its own rate, noise, mask and delay.

    The kind of belief is that of ``initial``: an ensemble, or a mean and a covariance (a Kalman, extended or unscented
    Kalman filter). In each step the transition forecasts, and the observed readings correct the forecast: sequentially,
    or in one joint update. For linear Gaussian systems both give the same. Sequential updates cost less for many
    sensors, and each sensor linearises at the belief after the sensors before it.

    Delayed readings need the last L states in addition to the belief, where L is the largest delay. An ensemble carries
    them like :class:`~torch_denkf.smoothers.FixedLag`; a mean and a covariance carry one joint Gaussian, which for
    linear systems gives the result of readings in order. For an ensemble with process noise, sampling errors of the
    covariances make delayed readings differ from readings in order, less so with more members; :class:`Refiltering`
    avoids this. With a delay, the belief of L steps ago is stored under ``("smoothed", ...)``. A reading of a time
    before the episode is not observed.

    Inflation and relaxation of an analysis spread the present belief, once in each update with an observation. A
    delayed reading would have to inflate an earlier belief, after later updates: with a delay both raise, and also with
    a lag of a mean and a covariance. :class:`Refiltering` and :class:`~torch_denkf.smoothers.FixedLag` take them.

    Diagnostics of the sensors are stored under ``("info", NAME, ...)``, their sums under ``("info", "nis")`` and
    ``("info", "log_likelihood")``; with one sensor, or a joint update, ``("info", ...)``.

    Args:
        transition: transition of an ensemble; or, for a mean and a covariance,
            :class:`~torch_denkf.modules.LinearTransition`, :class:`~torch_denkf.modules.EKFTransition` or
            :class:`~torch_denkf.modules.UKFTransition`, or a transition of ensembles, which an extended Kalman filter
            linearises.
        sensors: by name, in the order of their updates.
        initial: the initial belief.
        process_noise: Q of the motion: standard deviations ``[S]`` (a number for all), or a module that writes Q.
        joint: whether all readings are in one update.
        analysis: constructor of the update of each sensor, or of the joint update. For an ensemble it gets the keyword
            arguments of :class:`~torch_denkf.modules.EnsembleAnalysis`, and is ``partial(EnsembleAnalysis, "etkf")`` by
            default; for a mean and a covariance it also gets an observation model first, like
            :class:`~torch_denkf.modules.EKFAnalysis`.
        weights: network of the readings' weights, :class:`~torch_denkf.fusion.SensorAttention`; the weights ``[*B, 1]``
            are stored under ``("weight", NAME)``. ``None``: the noise alone weights the readings.
        lag: L; by default the largest delay.
        **kwargs: ``control_keys``, ``init_key``, ``update_at_reset``, ``forecast_keys``, ``variance_ceiling``,
            ``check_finite`` and ``prefix`` of :class:`Filter`.

    Raises:
        ValueError: if there is no sensor, a delay is negative or beyond the lag, process noise is missing or given
            twice, an analysis inflates or relaxes together with a delay or lag, or names a ``reading_space``, or a
            sensor with coloured noise has readings on a space.
        TypeError: for particles, sensors that are no dict, an analysis module instead of its constructor, or an
            analysis that cannot correct earlier states.

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
        >>> drive["gps_observed"] = torch.arange(20).unsqueeze(-1) % 10 == 3  # one fix per second, 0.3 s late
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
        _check_motion(transition, process_noise, initial, gaussian)
        transition, process_noise, initial, sensors = _with_errors(transition, process_noise, initial, sensors)
        transition = _moving(transition, process_noise, initial, gaussian)
        modules: OrderedDict[str, TensorDictModuleBase] = OrderedDict()
        wired = {}
        for name, sensor in sensors.items():
            wired[name] = wire(name, sensor)
            modules.update(wired[name].modules)
        age = -1 if kwargs.get("update_at_reset") else 0
        space = role(initial, Initial).space
        size = (role(initial, Initial).state_dim if space is None else space.point_dim) or 0
        if lag and not size:
            raise ValueError(f"{type(initial).__name__} does not say its state_dim, which a delay needs.")
        prefix = "forecast"
        if gaussian and lag:
            modules["transition"], modules["past"] = CrossTransition(transition), JointForecast()
            initial, prefix = with_past(initial, lag, JOINT_PAST, age=age), "joint"
        elif lag:
            modules["transition"], modules["past"] = transition, EnsemblePast()
            initial = with_past(initial, lag, ENSEMBLE_PAST, age=age)
        else:
            modules["transition"] = transition
        made = _analysis_for(transition, gaussian) if analysis is None else analysis
        build = Updates(gaussian, lag, size, made, joint_space(space, lag) if gaussian else space)
        if weights is not None:
            modules.update(build.weighted(prefix, sensors, wired, weights))
        last = "fused" if gaussian and lag else "belief"
        updates = (build.joint if joint else build.in_turn)(prefix, last, sensors, wired)
        _check_inflation(updates, any(sensor.delay for sensor in sensors.values()), gaussian and lag > 0)
        modules.update(updates)
        if lag:
            modules["smoothed"] = PresentOfJoint(lag + 1, last) if gaussian else LaggedBelief(space=space)
        super().__init__(modules, initial=initial, **kwargs)
        self.sensors, self.lag = tuple(sensors), lag


def _is_gaussian(initial: TensorDictModuleBase) -> bool:
    written = writes(initial)
    if ("belief", "log_weight") in written:
        raise TypeError("FusedFilter has no particles; give ParticleFilter one likelihood of all readings.")
    return ("belief", "ensemble") not in written


def _check_inflation(updates: Mapping[str, TensorDictModuleBase], late: bool, joint_past: bool) -> None:
    """Raises if an update with inflation or relaxation would spread states other than the observed present one."""
    if late:
        why = "belongs to the step at which a reading is taken, and with delay= others have been made since"
        cure = "Leave delay= out and let Refiltering make them again"
    elif joint_past:
        why = "would spread the past again with each reading: with lag= it is one Gaussian with the present"
        cure = "Leave lag= out and put FixedLag(filter, lag) around the filter"
    else:
        return
    for name, update in updates.items():
        for part in update.modules():
            inflates = isinstance(part, EnsembleUpdate | GaussianAnalysis) and part.inflation != 1
            if inflates or (isinstance(part, EnsembleUpdate) and part.relaxation):
                raise ValueError(
                    f"The inflation or relaxation of {name!r} {why}. {cure}, or say by process_noise what the motion "
                    "does not know."
                )


def _lag_of(sensors: Mapping[str, FusedSensor], lag: int | None) -> int:
    """Returns L: the given lag, or the largest delay."""
    for name, sensor in sensors.items():
        check_count(f"delay of {name!r}", sensor.delay, least=0)
        if sensor.late_key is not None and sensor.delay < 1:
            raise ValueError(f"{name!r} has late_key={sensor.late_key!r}; say how late its readings can be: delay=...")
    longest = max(sensor.delay for sensor in sensors.values())
    if lag is not None and lag < longest:
        raise ValueError(f"A reading comes up to {longest} steps late, beyond lag={lag}.")
    return longest if lag is None else lag


def _with_errors(transition, process_noise, initial, sensors):
    """Augments the state of transition, process noise, initial belief and sensors by the sensors' biases."""
    given = [sensor.sensor_error for sensor in sensors.values() if sensor.sensor_error is not None]
    for error in given:
        check_kind("sensor_error", error)
    total = sum(map(len, given))
    if not total:
        return transition, process_noise, initial, sensors
    moments = transition
    if isinstance(moments, LinearTransition):
        transition = LinearMembers(moments)
        process_noise = transition.process_noise()
    elif isinstance(moments, GaussianTransition):
        transition, process_noise = moments.module, moments.process_noise
    made, begin = {}, 0
    for name, sensor in sensors.items():
        observation, end = sensor.observation, begin
        if sensor.sensor_error is not None:
            transition, observation, process_noise, initial = sensor.sensor_error.augmented(
                transition, observation, process_noise, initial, sensor.reading_space
            )
            end += len(sensor.sensor_error)
        made[name] = replace(sensor, observation=OfOwnErrors(observation, range(begin, end), total))
        begin = end
    if isinstance(moments, GaussianTransition):  # the same transition of the augmented state
        whole = copy(moments)
        whole._modules = {**moments._modules, "module": transition, "process_noise": process_noise}
        transition, process_noise = whole, None
    return transition, process_noise, initial, made


def _check_motion(transition, process_noise, initial, gaussian):
    """Raises unless the transition fits the kind of belief, and process noise is given exactly once."""
    moments = isinstance(transition, LinearTransition | GaussianTransition)
    if moments and not gaussian:
        raise ValueError(
            f"{type(transition).__name__} moves a mean and a covariance, and {type(initial).__name__} writes an "
            "ensemble: use MomentPrior or GaussianAround, or a transition of ensembles."
        )
    if moments and process_noise is not None:
        raise ValueError(f"{type(transition).__name__} has its process noise already; leave process_noise out.")
    if gaussian and not moments and process_noise is None:
        raise ValueError("A mean and a covariance need process_noise=..., standard deviations [S] or a module.")


def _moving(transition, process_noise, initial, gaussian):
    """Returns the transition with its process noise."""
    if process_noise is None:
        return transition
    start = role(initial, Initial)
    noise, space = as_process_noise(process_noise, start.state_dim), start.space
    made = EKFTransition if gaussian else NoisyTransition
    return made(transition, noise, space=space)


def _analysis_for(transition: TensorDictModuleBase, gaussian: bool) -> Callable[..., TensorDictModuleBase]:
    if not gaussian:
        return partial(EnsembleAnalysis, "etkf")
    if isinstance(transition, UKFTransition):
        return partial(UKFAnalysis, alpha=transition.alpha, beta=transition.beta, kappa=transition.kappa)
    return EKFAnalysis
