"""The modules of a filter of one sensor: checked once, and with them what an imperfect sensor adds."""

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
    """Errors of a sensor that last and become part of the state: :class:`~torch_denkf.imperfect.FadingBias`."""

    def augmented(self, transition, observation, process_noise, initial, reading_space=None):
        """Returns transition, observation, process noise and initial belief of the state with the errors behind it."""

    def augmented_matrices(self, f, h, q, mean, cov, control=None):
        """Returns F, H, Q, mean, covariance and B of the state with the errors behind it."""


@runtime_checkable
class Visibility(Protocol):
    """A head next to a sensor that says whether it sees: :class:`~torch_denkf.imperfect.Visibility`."""

    def heeded_by(self, analysis):
        """Returns an update that lets a reading count as far as the head says."""


class ReadingOptions(FilterOptions, total=False):
    """The options of filters of one sensor, besides their modules.

    They also take ``control_keys``, ``init_key``, ``update_at_reset``, ``forecast_keys``, ``variance_ceiling``,
    ``check_finite`` and ``prefix`` of :class:`Filter`.

    Attributes:
        reading_space: in which the reading lives, such as ``Circle()`` for an angle; ``None`` by default, for plain
            numbers. That of the state is the initial belief's.
        observation_key: the reading, ``[*B, O]`` or ``[*B, E, O]``; by default the one that the sensor writes.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``, by default ``"observed"``; a nonlinear observation model
            may write it.
        visibility: a head next to the sensor that says whether it sees, :class:`~torch_denkf.imperfect.Visibility`; the
            update uses it, see :class:`~torch_denkf.imperfect.Visible`. ``None`` by default.
        sensor_error: coloured errors of the sensor, such as a :class:`~torch_denkf.imperfect.FadingBias`: they become
            part of the state, behind its S components, of transition, process noise, observation and initial belief.
            All these are given for the state alone. ``None`` by default.
    """

    reading_space: Space | None
    observation_key: NestedKey | None
    observed_key: NestedKey
    visibility: Visibility | None
    sensor_error: SensorError | None


class FilterParts:
    """The modules of a filter of one sensor, from which its constructor makes the forecast and the update.

    Args:
        transition: moves the state.
        sensor: writes the reading; ``None`` where it is in the tensordict.
        observation: predicts the reading.
        noise: writes R.
        initial: the initial belief.
        process_noise: Q, as :func:`~torch_denkf.modules.process_noise.as_process_noise` takes it; ``None`` for none.
        optional: those of the modules that may be ``None``.
        reading_space: see :class:`ReadingOptions`.
        observation_key: likewise.
        observed_key: likewise.
        visibility: likewise.
        sensor_error: likewise.
        **options: of :class:`Filter`, handed on.

    Raises:
        TypeError: for what is no module, no error of a sensor, no visibility.

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
        """Returns the transition of ensembles, with the process noise where there is one."""
        if self.process_noise is None:
            return self.transition
        return NoisyTransition(self.transition, self.process_noise, space=self.space)

    def reading(self, or_part: str = "") -> dict[str, Any]:
        """Returns the keys and the spaces of the reading, as an update takes them.

        Args:
            or_part: what else would say where the reading is, for the message.

        Raises:
            ValueError: if it is not clear where the reading is.
        """
        key = self.observation_key
        if key is None:
            if self.sensor is None:
                raise ValueError(f"Without a sensor, say where the reading is: observation_key=...{or_part}")
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
    if value is not None and (isinstance(value, type) or not isinstance(value, kind)):  # a class has the methods, too
        got = value.__name__ if isinstance(value, type) else type(value).__name__
        raise TypeError(f"{name} is a {words}, or None; got {'the class ' * isinstance(value, type)}{got}")


def check_moments(owner: str, initial: TensorDictModuleBase) -> None:
    """Raises a ``ValueError`` where an initial belief lacks the mean or the covariance that a filter carries."""
    carry, written = [("belief", "mean"), ("belief", "cov")], [unravel_key(key) for key in initial.out_keys]
    if not set(carry).issubset(written):
        raise ValueError(
            f"{owner} carries {carry}, and its initial belief, {type(initial).__name__}, writes {written}. Use "
            "MomentPrior(mean, cov), or GaussianAround(std) around a known state; GaussianPrior, AroundState and "
            "FromSensor are for ensembles and particles."
        )
