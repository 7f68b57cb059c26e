"""Sensor of a fused filter: its model, noise, mask and delay, and its modules with keys of their own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase

from torch_denkf._arguments import Checked
from torch_denkf.functional.manifolds import Space
from torch_denkf.fusion.parts import Renamed
from torch_denkf.imperfect import FadingBias
from torch_denkf.modules import ConstantNoise
from torch_denkf.running import marks_of, reading_of, writes

__all__ = ["FusedSensor", "Wired", "noise_key_of", "wire"]


@dataclass(frozen=True)
class FusedSensor(Checked):
    """One sensor of a :class:`FusedFilter`.

    The keys of its modules need not be unique: their outputs are moved to ``("sensor", NAME, ...)``.

    Attributes:
        observation: observation model h: :class:`~torch_denkf.modules.Select`,
            :class:`~torch_denkf.modules.LinearObservation`, :class:`~torch_denkf.modules.LearnedObservation`.
        noise: R: standard deviations ``[O]``; a module that writes variances ``[*B, O]``; or the key of an entry with
            the variances of each reading, or, for a mean and a covariance, its covariance ``[*B, O, O]``.
        sensor: module that computes the reading from frames, such as an image sensor; ``None`` if the reading is in the
            data.
        observation_key: key of the reading in the data, ``[*B, O]``; by default the sensor's name.
        observed_key: key of the observed mask in the data, ``[*B, 1]`` or ``[*B, O]``; by default NAME_observed. For a
            sensor at a lower rate than the filter's it is True in every n-th step. If ``sensor`` derives another mask
            from it, like :class:`~torch_denkf.monitoring.BlackIsMissing`, the update uses the derived mask.
        delay: latency of the readings in steps. Each then corrects the state at its time, and through the covariances
            all later ones.
        late_key: for varying delays, the key of each reading's latency, ``[*B, 1]`` int64, 0 to ``delay``.
        reading_space: space of the reading, such as ``Circle()`` for an angle; ``None`` for vectors. R is of tangents.
        features_key: key of features ``[*B, F]`` of a reading's quality, for the filter's ``weights``: an entry of the
            data, or an output of ``sensor``, such as its encoding, under the sensor's own key.
        analysis: constructor of this sensor's update, see :class:`FusedFilter`; ``None`` for the filter's.
        sensor_error: coloured errors of the sensor, :class:`~torch_denkf.imperfect.FadingBias`: they augment the state
            after its S components and the errors of previous sensors. All other arguments are for the S components
            only. A constant offset is an error with a ``time`` far longer than the recordings.
    """

    observation: TensorDictModuleBase
    noise: TensorDictModuleBase | Sequence[float] | torch.Tensor | NestedKey
    sensor: TensorDictModuleBase | None = None
    observation_key: NestedKey | None = None
    observed_key: NestedKey | None = None
    delay: int = 0
    late_key: NestedKey | None = None
    reading_space: Space | None = None
    features_key: NestedKey | None = None
    analysis: Callable[..., TensorDictModuleBase] | None = None
    sensor_error: FadingBias | None = None


@dataclass(frozen=True)
class Wired:
    """Modules of a sensor with keys of their own, and these keys."""

    modules: dict[str, TensorDictModuleBase]
    reading: NestedKey
    noise: NestedKey
    observed: NestedKey
    features: NestedKey | None


def noise_key_of(sensor: FusedSensor) -> NestedKey | None:
    """Returns the key of each reading's noise in the data; ``None`` if it is not in the data."""
    noise = sensor.noise
    named = isinstance(noise, str) or (isinstance(noise, tuple) and all(isinstance(part, str) for part in noise))
    return unravel_key(noise) if named else None


def wire(name: str, sensor: FusedSensor) -> Wired:
    """Moves the outputs of a sensor's modules to ``("sensor", name, ...)``."""
    reading = unravel_key(name if sensor.observation_key is None else sensor.observation_key)
    observed = unravel_key(f"{name}_observed" if sensor.observed_key is None else sensor.observed_key)
    names: dict[NestedKey, NestedKey] = {"observed": observed}
    modules: dict[str, TensorDictModuleBase] = {}
    if sensor.sensor is None:
        names["sensor", "ensemble"] = reading
    else:
        for key in writes(sensor.sensor):
            names[key] = ("sensor", name, key if isinstance(key, str) else key[-1])
        reading = names[reading_of(sensor.sensor)]
        modules[f"{name}_sensor"] = Renamed(sensor.sensor, names)
        marks = marks_of(sensor.sensor)
        if observed in marks or any(read not in ("observed", observed, *marks) for read in marks.values()):
            raise ValueError(
                f"The sensor {name!r} makes the mask {list(marks)} of {list(marks.values())}, and observed_key= names "
                f"{observed!r}, which it would not read. That is the mask of the data, by default "
                f"'{name}_observed'; leave observed_key of the module that makes the mask at its default."
            )
        observed = next((names[key] for key in marks), observed)
    own = noise_key_of(sensor)
    if own is None:
        own = ("sensor", name, "noise")
        noise = sensor.noise if isinstance(sensor.noise, TensorDictModuleBase) else ConstantNoise(sensor.noise)
        names[writes(noise)[0]] = own
        modules[f"{name}_noise"] = Renamed(noise, names)
    features = None if sensor.features_key is None else unravel_key(sensor.features_key)
    return Wired(modules, reading, own, observed, names.get(features, features))
