"""The modules of a filter with one sensor: checks them, and adds models of sensor errors and visibility."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Sequence
from typing import Any, Protocol, Unpack, runtime_checkable

from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase

from torch_denkf.filters.options import FilterOptions
from torch_denkf.functional.manifolds import Space
from torch_denkf.modules.motion_noise import NoisyTransition
from torch_denkf.modules.process_noise import as_process_noise
from torch_denkf.running import check_module, reading_of
from torch_denkf.submodel import Initial, role

__all__ = ["FilterParts", "ReadingOptions", "SensorError", "Visibility", "check_kind", "check_moments"]


@runtime_checkable
class SensorError(Protocol):
    """Coloured errors of a sensor, which become part of the state: :class:`~torch_denkf.imperfect.FadingBias`."""

    def augmented(self, transition, observation, process_noise, initial, reading_space=None):
        """Returns transition, observation, process noise and initial belief of the state extended by the errors."""

    def augmented_matrices(self, f, h, q, mean, cov, control=None):
        """Returns F, H, Q, mean, covariance and B of the state extended by the errors."""


@runtime_checkable
class Visibility(Protocol):
    """A head of a sensor that estimates whether a reading is visible: :class:`~torch_denkf.imperfect.Visibility`."""

    def heeded_by(self, analysis):
        """Returns an update that weighs a reading by the head's estimate."""


class ReadingOptions(FilterOptions, total=False):
    """Options of filters with one sensor, in addition to their modules.

    They also take ``control_keys``, ``init_key``, ``update_at_reset``, ``forecast_keys``, ``variance_ceiling``,
    ``check_finite`` and ``prefix`` of :class:`Filter`.

    Attributes:
        reading_space: space of the reading, such as ``Circle()`` for an angle; ``None`` by default, for plain
            numbers. The state has the space of the initial belief.
        observation_key: the reading, ``[*B, O]`` or ``[*B, E, O]``; by default the output of the sensor.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``, by default ``"observed"``; a nonlinear observation model
            may write it.
        visibility: a head of the sensor that estimates whether a reading is visible,
            :class:`~torch_denkf.imperfect.Visibility`; the update uses it, see
            :class:`~torch_denkf.imperfect.Visible`. ``None`` by default.
        sensor_error: coloured errors of the sensor, such as a :class:`~torch_denkf.imperfect.FadingBias`: they become
            part of the state, after its S components. Transition, process noise, observation and initial belief
            are given for the state without them. ``None`` by default.
    """

    reading_space: Space | None
    observation_key: NestedKey | None
    observed_key: NestedKey
    visibility: Visibility | None
    sensor_error: SensorError | None


class FilterParts:
    """The modules of a filter with one sensor, from which its constructor makes the forecast and the update.

    Args:
        transition: forecasts the state.
        sensor: writes the reading; ``None`` if it is in the tensordict.
        observation: predicts the reading.
        noise: writes R.
        initial: the initial belief.
        process_noise: Q, see :func:`~torch_denkf.modules.process_noise.as_process_noise`; ``None`` for none.
        optional: names of the modules that may be ``None``.
        reading_space: see :class:`ReadingOptions`.
        observation_key: see :class:`ReadingOptions`.
        observed_key: see :class:`ReadingOptions`.
        visibility: see :class:`ReadingOptions`.
        sensor_error: see :class:`ReadingOptions`.
        **options: options of :class:`Filter`, passed on.

    Raises:
        TypeError: if an argument is no module, no ``sensor_error`` or no ``visibility``.

    Example:
        >>> import torch
        >>> from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, GaussianPrior, LearnedTransition, Select
        >>> prior, r = GaussianPrior([0.0], [1.0], ensemble_size=8), ConstantNoise([0.1], in_key="reading")
        >>> motion, keys = LearnedTransition(torch.sin), {"observation_key": "reading"}
        >>> parts = FilterParts(motion, None, Select([0]), r, prior, process_noise=0.1, **keys)
        >>> update = EnsembleAnalysis("etkf", space=parts.space, **parts.reading())
        >>> list(parts.in_order(transition=parts.moving(), observation=parts.observation, analysis=update))
        ['noise', 'transition', 'observation', 'analysis']
    """

    def __init__(
        self,
        transition: TensorDictModuleBase,
        sensor: TensorDictModuleBase | None,
        observation: Any,
        noise: Any,
        initial: TensorDictModuleBase,
        process_noise: TensorDictModuleBase | Sequence[float] | float | None = None,
        *,
        optional: Collection[str] = (),
        reading_space: Space | None = None,
        observation_key: NestedKey | None = None,
        observed_key: NestedKey = "observed",
        visibility: Visibility | None = None,
        sensor_error: SensorError | None = None,
        **options: Unpack[FilterOptions],
    ):
        modules = {"transition": transition, "sensor": sensor, "observation": observation, "noise": noise}
        for name, module in {**modules, "initial": initial}.items():
            if module is not None or name not in ("sensor", *optional):
                check_module(name, module)
        check_kind("visibility", visibility)
        check_kind("sensor_error", sensor_error)
        start = role(initial, Initial)
        q = None if process_noise is None else as_process_noise(process_noise, start.state_dim)
        if sensor_error is not None:
            transition, observation, q, initial = sensor_error.augmented(
                transition, observation, q, initial, reading_space
            )
        self.transition, self.sensor, self.observation, self.noise = transition, sensor, observation, noise
        self.process_noise, self.initial, self.visibility, self.options = q, initial, visibility, options
        self.reading_space, self.observation_key, self.observed_key = reading_space, observation_key, observed_key
        self.space = role(initial, Initial).space

    def moving(self) -> TensorDictModuleBase:
        """Returns the transition of ensembles, with the process noise if there is one."""
        if self.process_noise is None:
            return self.transition
        return NoisyTransition(self.transition, self.process_noise, space=self.space)

    def reading(self, or_part: str = "") -> dict[str, Any]:
        """Returns the keys and the space of the reading, as options of an update.

        Args:
            or_part: other arguments that would define the source of the reading, for the message.

        Raises:
            ValueError: if the source of the reading is ambiguous.
        """
        key = self.observation_key
        if key is None:
            if self.sensor is None:
                raise ValueError(f"Without a sensor, pass the key of the reading: observation_key=...{or_part}")
            key = reading_of(self.sensor)
        found = {"observation_key": key, "observed_key": self.observed_key, "reading_space": self.reading_space}
        if self.noise is not None:
            found["noise_variance_key"] = self.noise.out_keys[0]
        return {name: value for name, value in found.items() if value is not None}

    def in_order(self, **others: TensorDictModuleBase | None) -> OrderedDict[str, TensorDictModuleBase]:
        """Returns the modules by name, without ``None``, the ``others`` last; ``analysis`` gets the visibility."""
        if self.visibility is not None:
            others["analysis"] = self.visibility.heeded_by(others["analysis"])
        named = {"sensor": self.sensor, "visibility": self.visibility, "noise": self.noise, **others}
        return OrderedDict((name, module) for name, module in named.items() if module is not None)


def check_kind(name: str, value: object) -> None:
    """Raises a ``TypeError`` unless a ``sensor_error`` or a ``visibility`` is one, or ``None``."""
    kind, words = {"sensor_error": (SensorError, "FadingBias"), "visibility": (Visibility, "Visibility")}[name]
    if value is not None and (isinstance(value, type) or not isinstance(value, kind)):  # a class has them, too
        got = value.__name__ if isinstance(value, type) else type(value).__name__
        raise TypeError(f"{name} is a {words}, or None; got {'the class ' * isinstance(value, type)}{got}")


def check_moments(owner: str, initial: TensorDictModuleBase) -> None:
    """Raises a ``ValueError`` if an initial belief lacks the mean or the covariance that a filter carries."""
    carry, written = [("belief", "mean"), ("belief", "cov")], [unravel_key(key) for key in initial.out_keys]
    if not set(carry).issubset(written):
        raise ValueError(
            f"{owner} carries {carry}, and its initial belief, {type(initial).__name__}, writes {written}. Use "
            "MomentPrior(mean, cov), or GaussianAround(std) around a known state; GaussianPrior, AroundState and "
            "FromSensor are for ensembles and particles."
        )
