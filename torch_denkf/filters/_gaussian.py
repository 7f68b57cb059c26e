"""What the filters with a mean, a covariance and a learned sensor share: their modules' order and their options."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Unpack

from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase

from torch_denkf.filters.base import Filter
from torch_denkf.filters.options import FilterOptions
from torch_denkf.functional.manifolds import Space
from torch_denkf.imperfect import Visibility
from torch_denkf.imperfect.visible import heeding
from torch_denkf.running import check_module
from torch_denkf.submodel import Initial, role

__all__ = ["GaussianFilter", "GaussianOptions", "refuse_other_beliefs"]


class GaussianOptions(FilterOptions, total=False):
    """What the filters with a mean, a covariance and a learned sensor take beside their models.

    They also take ``control_keys``, ``init_key``, ``update_at_reset``, ``forecast_keys``, ``variance_ceiling``,
    ``check_finite`` and ``prefix`` of :class:`Filter`.

    Attributes:
        inflation: factor on the belief's standard deviations, where anything is observed; 1 by default. What is never
            observed grows by it without bound.
        reading_space: in which the reading lives, such as ``Circle()`` for an angle; ``None`` by default, for plain
            numbers. That of the state is the initial belief's.
        observation_key: the reading, ``[*B, O]`` or ``[*B, E, O]``; ``("sensor", "ensemble")`` by default.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``, by default ``"observed"``; a nonlinear observation model
            may write it.
        visibility: a head beside the sensor that says whether it sees, :class:`~torch_denkf.imperfect.Visibility`; the
            update heeds it, see :class:`~torch_denkf.imperfect.Visible`. ``None`` by default.
    """

    inflation: float
    reading_space: Space | None
    observation_key: NestedKey
    observed_key: NestedKey
    visibility: Visibility | None


class GaussianFilter(Filter):
    """A sensor and its noise, the two steps of a Kalman filter, and a Gaussian initial belief.

    Args:
        sensor: writes the reading; ``None`` where it is in the tensordict.
        noise: writes R.
        transition: forecasts mean and covariance.
        analysis: makes the module that updates them, from ``inflation``, ``reading_space``, ``observation_key``,
            ``observed_key`` and ``noise_variance_key``.
        initial: the initial belief.
        **options: see :class:`GaussianOptions`.

    Raises:
        ValueError: if ``initial`` writes no mean and covariance.
    """

    def __init__(
        self,
        sensor: TensorDictModuleBase | None,
        noise: TensorDictModuleBase,
        transition: TensorDictModuleBase,
        analysis: Callable[..., TensorDictModuleBase],
        *,
        initial: TensorDictModuleBase,
        inflation: float = 1.0,
        reading_space: Space | None = None,
        observation_key: NestedKey = ("sensor", "ensemble"),
        observed_key: NestedKey = "observed",
        visibility: Visibility | None = None,
        **kwargs: Unpack[FilterOptions],
    ):
        check_module("noise", noise)
        check_module("initial", initial)
        refuse_other_beliefs(type(self).__name__, initial, transition.in_keys[:2])
        space = role(initial, Initial).space
        spaces = {"space": space, "reading_space": reading_space}
        update = analysis(
            **{name: space for name, space in spaces.items() if space is not None},
            inflation=inflation,
            observation_key=observation_key,
            noise_variance_key=noise.out_keys[0],
            observed_key=observed_key,
        )
        modules = OrderedDict(sensor=sensor) if sensor is not None else OrderedDict()
        if visibility is not None:
            modules["visibility"] = visibility
        modules.update(noise=noise, transition=transition, analysis=heeding(visibility, update))
        super().__init__(modules, initial=initial, **kwargs)


def refuse_other_beliefs(owner: str, initial: TensorDictModuleBase, carry: Sequence[NestedKey]) -> None:
    """Raises a ``ValueError`` where an initial belief lacks the mean or the covariance that a filter carries."""
    written = [unravel_key(key) for key in initial.out_keys]
    if not set(map(unravel_key, carry)).issubset(written):
        raise ValueError(
            f"{owner} carries {list(carry)}, and its initial belief, {type(initial).__name__}, writes {written}. Use "
            "MomentPrior(mean, cov), or GaussianAround(std) around a known state; GaussianPrior, AroundState and "
            "FromSensor are for ensembles and particles."
        )
