"""The Differentiable Ensemble Kalman Filter (Liu et al. 2023) as a composition of four sub-models and an analysis."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Unpack

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf._checks import check_count, check_number
from torch_denkf.filters.base import Filter
from torch_denkf.filters.options import FilterOptions
from torch_denkf.functional.manifolds import Space
from torch_denkf.imperfect import FadingBias, Visibility
from torch_denkf.imperfect.bias import biased_parts
from torch_denkf.imperfect.visible import heeding
from torch_denkf.modules import (
    DiagonalNoise,
    EnsembleAnalysis,
    GaussianPrior,
    ImageSensor,
    LearnedObservation,
    LearnedTransition,
    NoisyTransition,
    StochasticMLP,
    as_process_noise,
)
from torch_denkf.running import check_module, reading_of
from torch_denkf.submodel import Initial, Update, role

__all__ = ["DEnKF"]


def _check_image_shape(shape: Sequence[int]) -> None:
    if len(shape) != 3 or not all(isinstance(side, int) and side > 0 for side in shape):
        raise ValueError(f"image_shape is (channels, height, width), positive; got {shape!r}")


class DEnKF(Filter):
    r"""Differentiable ensemble Kalman filter: an ensemble through a stochastic network, updated by a learned sensor.

    Not to be confused with the *deterministic* EnKF of Sakov & Oke (2008), also called DEnKF; its update is the
    analysis scheme ``"sakov"``.

    Args:
        transition: :math:`f_\theta`, forecasts ``("forecast", "ensemble")``.
        sensor: :math:`s_\xi`, writes ``("sensor", "ensemble")``; ``None`` where the reading is in the tensordict, under
            ``observation_key``.
        observation: :math:`h_\psi`, writes ``("forecast", "observation")``.
        noise: :math:`r_\zeta`, writes ``("sensor", "noise")``.
        analysis: the update; ``EnsembleAnalysis("sensor")`` by default, and ``EnsembleAnalysis("perturbed")`` without a
            sensor.
        initial: the initial belief, which also fixes the number of members.
        process_noise: Q of the motion, beside the noise of the transition's network: standard deviations ``[S]`` (a
            number for all, 0 for none), or a module that writes Q, see :mod:`torch_denkf.modules.process_noise`. An
            ensemble without any process noise collapses. ``None``: the transition's own noise alone.
        reading_space: in which the reading lives, such as ``Circle()`` for an angle, for the default ``analysis``;
            ``None`` for plain numbers. The initial belief has that of the state.
        observation_key: the reading ``[*B, O]``, for the default ``analysis`` without a sensor.
        observed_key: its mask ``[*B, 1]`` or ``[*B, O]``, for the default ``analysis``; ``"observed"`` by default.
        sensor_error: coloured errors of the sensor, such as a ``FadingBias``: they become part of the state, behind its
            S components, of transition, process noise, observation and initial belief. All these are given for the
            state alone.
        visibility: a head beside the sensor that says whether it sees, :class:`~torch_denkf.imperfect.Visibility`; the
            update heeds it, see :class:`~torch_denkf.imperfect.Visible`.
        **kwargs: ``control_keys``, ``init_key``, ``update_at_reset``, ``forecast_keys``, ``variance_ceiling``,
            ``check_finite`` and ``prefix`` of :class:`Filter`.

    Raises:
        ValueError: if it is not clear where the reading is.

    Reference:
        Liu, Clark, Campbell, Zhou, Ben Amor, "Enhancing state estimation in robots: a data-driven approach with
        differentiable ensemble Kalman filters", IROS 2023, arXiv:2308.09870, section III.

    Example:
        >>> from tensordict import TensorDict
        >>> denkf = DEnKF.paper(state_dim=5, observation_dim=2, ensemble_size=8)
        >>> td = denkf.initialise(TensorDict({"pixels": torch.zeros(6, 50, 150)}))
        >>> denkf.step(td)["belief", "mean"].shape
        torch.Size([5])
    """

    def __init__(
        self,
        transition: TensorDictModuleBase,
        sensor: TensorDictModuleBase | None,
        observation: TensorDictModuleBase,
        noise: TensorDictModuleBase,
        analysis: TensorDictModuleBase | None = None,
        *,
        initial: TensorDictModuleBase,
        process_noise: TensorDictModuleBase | Sequence[float] | float | None = None,
        reading_space: Space | None = None,
        observation_key: NestedKey | None = None,
        observed_key: NestedKey | None = None,
        sensor_error: FadingBias | None = None,
        visibility: Visibility | None = None,
        **kwargs: Unpack[FilterOptions],
    ):
        check_module("transition", transition)
        check_module("observation", observation)
        check_module("noise", noise)
        check_module("initial", initial)
        if sensor_error is not None:
            of_reading = reading_space if analysis is None else role(analysis, Update).reading_space
            biased = biased_parts(sensor_error, transition, observation, process_noise, initial, of_reading)
            transition, observation, process_noise, initial = biased
        if process_noise is not None:
            q = as_process_noise(process_noise, initial)
            transition = NoisyTransition(transition, q, space=role(initial, Initial).space)
        told = reading_space is not None or observation_key is not None or observed_key is not None
        if analysis is not None and told:
            raise ValueError(
                "reading_space, observation_key and observed_key are for the default analysis; give them to yours "
                "instead."
            )
        if analysis is None:
            if observation_key is None and sensor is None:
                raise ValueError("Without a sensor, say where the reading is: observation_key=..., or an analysis.")
            reading = reading_of(sensor) if sensor is not None and observation_key is None else observation_key
            mask = "observed" if observed_key is None else observed_key
            keys = {"observation_key": reading, "noise_variance_key": noise.out_keys[0], "observed_key": mask}
            analysis = EnsembleAnalysis(
                "perturbed" if sensor is None else "sensor",
                space=role(initial, Initial).space,
                reading_space=reading_space,
                **keys,
            )
        modules = OrderedDict(sensor=sensor) if sensor is not None else OrderedDict()
        if visibility is not None:
            modules["visibility"] = visibility
        modules.update(noise=noise, transition=transition, observation=observation)
        super().__init__(modules | {"analysis": heeding(visibility, analysis)}, initial=initial, **kwargs)

    @classmethod
    def paper(
        cls,
        state_dim: int,
        observation_dim: int,
        *,
        image_shape: tuple[int, int, int] = (6, 50, 150),
        ensemble_size: int = 32,
        rate: float = 0.1,
        r: float = 0.1,
        initial: TensorDictModuleBase | None = None,
        **kwargs,
    ) -> DEnKF:
        """The networks of the paper's Table I, on a standardised state and observation.

        Args:
            state_dim: S.
            observation_dim: O.
            image_shape: of ``"pixels"``, (channels, height, width).
            ensemble_size: E; the paper has 32.
            rate: drop probability of the stochastic layers; the paper does not say. Earlier code of its authors
                has 0.1.
            r: observation noise before training, a standard deviation.
            initial: the initial belief; N(0, I) of the standardised state by default.
            **kwargs: passed on to the constructor.
        """
        check_count("state_dim", state_dim)
        check_count("observation_dim", observation_dim)
        _check_image_shape(image_shape)
        check_number("r", r, above=0)
        return cls(
            transition=LearnedTransition(StochasticMLP(state_dim, state_dim, (32, 32, 64, 64), rate=rate)),
            sensor=ImageSensor(
                observation_dim,
                image_shape=image_shape,
                ensemble_size=ensemble_size,
                num_cells=(64, 64, 32, 32),
                rate=rate,
            ),
            observation=LearnedObservation(StochasticMLP(state_dim, observation_dim, (32, 32, 64, 64), layer="none")),
            noise=DiagonalNoise(observation_dim, r=r, num_cells=(16, 16)),
            initial=_standard_prior(state_dim, ensemble_size) if initial is None else initial,
            **kwargs,
        )

    @classmethod
    def reference(
        cls,
        state_dim: int,
        observation_dim: int,
        *,
        image_shape: tuple[int, int, int] = (6, 50, 150),
        ensemble_size: int = 32,
        r: float = 0.1,
        initial: TensorDictModuleBase | None = None,
        **kwargs,
    ) -> DEnKF:
        """The layer kinds and widths of the authors' PyTorch code, which differ from Table I.

        Flipout layers of widths 64, 512, 256 in a residual transition; an observation model of widths 64, 128, 128,
        64; a sensor of three pooled convolutions, a 512-wide and a 64-wide flipout layer; a noise model of width 32
        on the sensor's 64-wide encoding. The code's dropout between convolutions is left out: it would tie the
        trunk's randomness to ``.training``.

        Args:
            state_dim: S.
            observation_dim: O.
            image_shape: of ``"pixels"``, (channels, height, width).
            ensemble_size: E; the code has 32.
            r: observation noise before training, a standard deviation.
            initial: the initial belief; N(0, I) of the standardised state by default.
            **kwargs: passed on to the constructor.
        """
        encoding_key = ("sensor", "encoding")
        sensor = ImageSensor(
            observation_dim,
            image_shape=image_shape,
            ensemble_size=ensemble_size,
            trunk=_reference_trunk(image_shape),
            num_cells=(64,),
            layer="flipout",
            encoding_key=encoding_key,
        )
        return cls(
            transition=LearnedTransition(StochasticMLP(state_dim, state_dim, (64, 512, 256), layer="flipout")),
            sensor=sensor,
            observation=LearnedObservation(StochasticMLP(state_dim, observation_dim, (64, 128, 128, 64), layer="none")),
            noise=DiagonalNoise(observation_dim, r=r, num_cells=(32,), in_features=64, in_key=encoding_key),
            initial=_standard_prior(state_dim, ensemble_size) if initial is None else initial,
            **kwargs,
        )


def _standard_prior(state_dim: int, ensemble_size: int) -> GaussianPrior:
    return GaussianPrior(torch.zeros(state_dim), torch.ones(state_dim), ensemble_size=ensemble_size)


def _reference_trunk(image_shape: tuple[int, int, int]) -> nn.Sequential:
    """Convolutions 5/16 s2, 5/32 s2, 3/64 s1 with pooling, then a 512-wide layer."""
    layers, channels = [], image_shape[0]
    for width, kernel, stride in ((16, 5, 2), (32, 5, 2), (64, 3, 1)):
        layers += [
            nn.Conv2d(channels, width, kernel, stride, kernel // 2),
            nn.ReLU(),
            nn.MaxPool2d(2, ceil_mode=True),
        ]
        channels = width
    layers.append(nn.Flatten())
    with torch.no_grad():
        features = nn.Sequential(*layers)(torch.zeros(1, *image_shape)).shape[-1]
    return nn.Sequential(*layers, nn.Linear(features, 512), nn.ReLU())
