"""One sensor of a filter of several: its model, noise, mask and delay, and its modules under keys of their own."""

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

    The keys of its modules need not be chosen: what they write is put under ``("sensor", NAME, ...)``.

    Attributes:
        observation: h, what the sensor would read in a state: :class:`~torch_denkf.modules.Select`,
            :class:`~torch_denkf.modules.LinearObservation`, :class:`~torch_denkf.modules.LearnedObservation`.
        noise: R: standard deviations ``[O]``; a module that writes variances ``[*B, O]``; or the key of an entry of the
            data with the variances of each reading, or, for a mean and a covariance, its covariance ``[*B, O, O]``.
        sensor: a module that reads frames and writes the reading, such as an image sensor; ``None`` where the reading
            is in the data.
        observation_key: its key in the data, ``[*B, O]``; by default the sensor's name.
        observed_key: its mask, ``[*B, 1]`` or ``[*B, O]``, True where there is a reading; by default NAME_observed. A
            sensor with a lower rate than the filter's has it True in every n-th step. It is the mask of the *data*:
            where ``sensor`` makes a further one of it, as :class:`~torch_denkf.monitoring.BlackIsMissing` does, the
            update reads that one by itself.
        delay: by how many steps its readings come late. Each then corrects the state that it belongs to, and through
            the covariances all since.
        late_key: an entry ``[*B, 1]``, int64, that says it for each reading, 0 to ``delay``, where delays vary.
        reading_space: in which the reading lives, such as ``Circle()`` for an angle; ``None`` for plain numbers. R is
            of tangents.
        features_key: an entry ``[*B, F]`` that tells how good a reading is, for the filter's ``weights``: one of the
            data, or one that ``sensor`` writes, such as its encoding, under the sensor's own key.
        analysis: makes the sensor's own update, see :class:`FusedFilter`; ``None`` for the filter's.
        sensor_error: coloured errors of the sensor, :class:`~torch_denkf.imperfect.FadingBias`: they become part of the
            state, behind its S components and the errors of the sensors before this one. All else is given for the S
            components alone. A constant offset is one with a ``time`` far beyond that of the recordings.
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
    """A sensor's modules under keys of their own, and those keys."""

    modules: dict[str, TensorDictModuleBase]
    reading: NestedKey
    noise: NestedKey
    observed: NestedKey
    features: NestedKey | None


def noise_key_of(sensor: FusedSensor) -> NestedKey | None:
    """Returns the key under which the data have the noise of each reading; ``None`` where they do not."""
    noise = sensor.noise
    named = isinstance(noise, str) or (isinstance(noise, tuple) and all(isinstance(part, str) for part in noise))
    return unravel_key(noise) if named else None


def wire(name: str, sensor: FusedSensor) -> Wired:
    """Puts the outputs of a sensor's modules under ``("sensor", name, ...)``."""
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
