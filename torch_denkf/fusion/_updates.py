"""Builds the modules after the forecast of a filter of several sensors: weights, and sequential or joint updates."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import cast

from tensordict import unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf.functional.manifolds import Euclidean, Product, Space, check_space, is_flat
from torch_denkf.fusion.parts import JoinedObservation, JoinedReading, StateObservation
from torch_denkf.fusion.sensor import FusedSensor, Wired, noise_key_of
from torch_denkf.fusion.sensor_weights import SensorWeights, WeightedNoise
from torch_denkf.smoothers.past import lagged
from torch_denkf.submodel import Update, role

__all__ = ["Updates"]


class Updates:
    """Builds the modules after the forecast.

    Args:
        gaussian: whether the belief is a mean and a covariance.
        lag: L.
        size: S.
        analysis: makes an update.
        space: space of the state; ``None`` for vectors.
    """

    def __init__(
        self,
        gaussian: bool,
        lag: int,
        size: int,
        analysis: Callable[..., TensorDictModuleBase],
        space: Space | None = None,
    ):
        self.gaussian, self.lag, self.size, self.analysis, self.space = gaussian, lag, size, analysis, space

    def in_turn(self, prefix, last, sensors, wired):
        """Returns an update for each sensor."""
        modules, names = {}, list(sensors)
        for name, sensor in sensors.items():
            to = last if name == names[-1] else f"after_{name}"
            model = self._model(prefix, name, sensor, wired[name])
            keys = {"reading": wired[name].reading, "noise": wired[name].noise, "observed": wired[name].observed}
            if model.state_dim is not None:
                keys["observed"] = model.out_keys[1]
            told = self._spaces(sensor.reading_space)
            modules.update(self._update(name, model, prefix, to, told, sensor.analysis, **keys))
            prefix = to
        return modules

    def joint(self, prefix, last, sensors, wired):
        """Returns one update for all sensors."""
        own = [name for name, sensor in sensors.items() if sensor.analysis is not None]
        if own:
            raise ValueError(f"A joint update is one for all sensors, and {own} have an analysis of their own.")
        models = {name: self._model(prefix, name, sensor, wired[name]) for name, sensor in sensors.items()}
        keys = {
            "reading": ("sensor", "joint"),
            "noise": ("sensor", "joint_noise"),
            "observed": ("forecast", "observed"),
        }
        spaces = {name: check_space("reading_space", sensor.reading_space) for name, sensor in sensors.items()}
        sizes = [one.point_dim if one else _observation_dim(sensors[name]) for name, one in spaces.items()]
        join = JoinedReading(
            [wired[name].reading for name in sensors],
            [wired[name].noise for name in sensors],
            list(spaces.values()),
            observation_key=keys["reading"],
            noise_key=keys["noise"],
            observation_dim=None if None in sizes else sum(size for size in sizes if size is not None),
        )
        model = JoinedObservation(
            models, list(spaces.values()), predicted_key=("forecast", "observation"), observed_key=keys["observed"]
        )
        told = self._spaces(_side_by_side(spaces, sizes))
        return {"readings": join, **self._update("analysis", model, prefix, last, told, None, **keys)}

    def weighted(self, prefix, sensors, wired, weights):
        """Returns the modules of the sensors' weights and of their weighted noise."""
        if self.gaussian and self.space is not None:
            raise ValueError(f"weights= takes no mean and covariance of points of {self.space}: leave weights= away.")
        models = {name: self._model(prefix, name, sensor, wired[name]) for name, sensor in sensors.items()}
        modules = {
            "weights": SensorWeights(
                weights,
                models,
                {name: wired[name].reading for name in sensors},
                {name: wired[name].noise for name in sensors},
                {name: wired[name].features for name in sensors if wired[name].features is not None},
                _flat_spaces(sensors),
                state_key=(prefix, "ensemble"),
                moments=prefix if self.gaussian else None,
            )
        }
        for name, sensor in sensors.items():
            key, size = ("sensor", name, "weighted_noise"), _observation_dim(sensor)
            modules[f"{name}_weighted"] = WeightedNoise(wired[name].noise, ("weight", name), key, observation_dim=size)
            wired[name] = replace(wired[name], noise=key)
        return modules

    def _spaces(self, reading_space: Space | None) -> dict[str, Space]:
        """Returns the space arguments of an update, without those of plain vectors."""
        spaces = {"space": self.space, "reading_space": reading_space}
        return {name: space for name, space in spaces.items() if space is not None}

    def _model(self, prefix: str, name: str, sensor: FusedSensor, wired: Wired) -> StateObservation:
        ensemble = (prefix, "ensemble")
        # Without a delay, only a state with a lag window needs another mask.
        late = self.lag > 0 and (sensor.delay > 0 or sensor.late_key is not None or self.gaussian)
        return StateObservation(
            sensor.observation,
            ensemble,
            ("forecast", name, "observation"),
            reading_keys=[wired.reading, wired.noise],
            observed_key=wired.observed,
            delay=sensor.delay,
            late_key=sensor.late_key,
            past_key=None if self.gaussian or not late else ("forecast", "past"),
            state_dim=self.size if late else None,
            # A Gaussian update runs the model inside, and reads the mask afterwards.
            seen_key=wired.observed if self.gaussian else ("forecast", name, "observed"),
        )

    def _update(self, name, model, prefix, to, told, analysis, *, reading, noise, observed):
        make = self.analysis if analysis is None else analysis
        if isinstance(make, nn.Module):
            kind = type(make).__name__
            raise TypeError(f"analysis makes the update {name!r}: pass partial({kind}, ...), not a module.")
        keys = {"noise_variance_key": noise, "observed_key": observed, "belief_prefix": to, **told}
        predicted = unravel_key(model.out_keys[0])
        if self.gaussian:
            keys |= {"observation_key": reading, "forecast_prefix": prefix}
            update = make(model, ensemble_key=(prefix, "ensemble"), predicted_key=predicted, **keys)
            modules = {name: update}
        else:
            update = make(forecast_key=(prefix, "ensemble"), predicted_key=predicted, observation_key=reading, **keys)
            modules = {f"{name}_observation": model, name: lagged(update) if self.lag else update}
        if role(update, Update).reading_space is not None and told.get("reading_space") is None:
            raise ValueError(f"reading_space is for FusedSensor(reading_space=...), not for the analysis of {name!r}.")
        return modules


def _flat_spaces(sensors: Mapping[str, FusedSensor]) -> dict[str, Space | None]:
    """Returns the spaces of the readings; raises unless all consist of vectors and angles."""
    others = [name for name, sensor in sensors.items() if not is_flat(sensor.reading_space)]
    if others:
        raise ValueError(f"weights= takes readings of numbers and angles, and {others} read points: leave it away.")
    return {name: check_space("reading_space", sensor.reading_space) for name, sensor in sensors.items()}


def _side_by_side(spaces: Mapping[str, Space | None], sizes: Sequence[int | None]) -> Space | None:
    """Returns the product of all reading spaces; ``None`` if no reading has one."""
    if not any(spaces.values()):
        return None
    parts: list[Space] = []
    for (name, space), size in zip(spaces.items(), sizes, strict=True):
        if space is None and size is None:
            raise ValueError(f"The size of {name!r}'s readings is not known: give it reading_space=Euclidean(...).")
        parts.append(Euclidean(cast(int, size)) if space is None else space)
    return Product(*parts)


def _observation_dim(sensor: FusedSensor) -> int | None:
    noise = sensor.noise
    if noise_key_of(sensor) is not None:
        return None
    if isinstance(noise, TensorDictModuleBase):
        return getattr(noise, "observation_dim", getattr(noise, "dim", None))
    return len(noise)
