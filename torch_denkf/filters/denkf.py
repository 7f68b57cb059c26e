"""The Differentiable Ensemble Kalman Filter (Liu et al. 2023) as a composition of four sub-models and an analysis."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Unpack

import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf._checks import check_count, check_number
from torch_denkf.filters.base import Filter
from torch_denkf.filters.parts import FilterParts, ReadingOptions
from torch_denkf.modules import (
    DiagonalNoise,
    EnsembleAnalysis,
    GaussianPrior,
    ImageSensor,
    LearnedObservation,
    LearnedTransition,
    StochasticMLP,
)
from torch_denkf.submodel import Update, role

__all__ = ["DEnKF"]


class DEnKF(Filter):
    r"""Differentiable ensemble Kalman filter: an ensemble through a stochastic network, updated by a learned sensor.

    Not to be confused with the *deterministic* EnKF of Sakov & Oke (2008), also called DEnKF; its update is the
    analysis scheme ``"sakov"``.

    Args:
        transition: :math:`f_\theta`, forecasts ``("forecast", "ensemble")``.
        sensor: :math:`s_\xi`, writes ``("sensor", "ensemble")``; ``None`` if the reading is in the tensordict, under
            ``observation_key``.
        observation: :math:`h_\psi`, writes ``("forecast", "observation")``.
        noise: :math:`r_\zeta`, writes ``("sensor", "noise")``.
        analysis: the update; ``EnsembleAnalysis("sensor")`` by default, and ``EnsembleAnalysis("perturbed")`` without a
            sensor.
        initial: the initial belief, which also fixes the number of members.
        process_noise: Q of the motion, in addition to the noise of the transition's network: standard deviations
            ``[S]`` (one number for all, 0 for none), or a module that writes Q, see
            :mod:`torch_denkf.modules.process_noise`. An ensemble without any process noise collapses. ``None``: only
            the transition's own noise.
        **options: ``reading_space``, ``observation_key``, ``observed_key``, for the default ``analysis``,
            ``visibility``, ``sensor_error`` and the common options of filters, see
            :class:`~torch_denkf.filters.parts.ReadingOptions`.

    Raises:
        ValueError: if the source of the reading is ambiguous.

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
        **options: Unpack[ReadingOptions],
    ):
        if analysis is not None:
            if any(options.get(name) is not None for name in ("reading_space", "observation_key", "observed_key")):
                raise ValueError(
                    "reading_space, observation_key and observed_key are for the default analysis; pass them to your "
                    "own analysis instead."
                )
            options["reading_space"] = role(analysis, Update).reading_space
        parts = FilterParts(transition, sensor, observation, noise, initial, process_noise, **options)
        if analysis is None:
            scheme = partial(EnsembleAnalysis, "perturbed" if sensor is None else "sensor")
            analysis = scheme(space=parts.space, **parts.reading(", or an analysis"))
        modules = parts.in_order(transition=parts.moving(), observation=parts.observation, analysis=analysis)
        super().__init__(modules, initial=parts.initial, **parts.options)

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
        """Returns the networks of the paper's Table I, on a standardised state and observation.

        Args:
            state_dim: S.
            observation_dim: O.
            image_shape: shape of ``"pixels"``, (channels, height, width).
            ensemble_size: E; the paper has 32.
            rate: drop probability of the stochastic layers; the paper does not give it. Earlier code of its authors
                has 0.1.
            r: observation noise before training, a standard deviation.
            initial: the initial belief; N(0, I) of the standardised state by default.
            **kwargs: passed on to the constructor.
        """
        check_count("state_dim", state_dim)
        check_count("observation_dim", observation_dim)
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
        """Returns a filter with the layers and widths of the authors' PyTorch code, which differ from Table I.

        It has flipout layers of widths 64, 512, 256 in a residual transition; an observation model of widths 64, 128,
        128, 64; a sensor of three pooled convolutions, a 512-wide and a 64-wide flipout layer; a noise model of width
        32 on the sensor's 64-wide encoding. The code's dropout between convolutions is left out, because the
        trunk's randomness would then depend on ``.training``.

        Args:
            state_dim: S.
            observation_dim: O.
            image_shape: shape of ``"pixels"``, (channels, height, width).
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
    """Returns convolutions 5/16 s2, 5/32 s2, 3/64 s1 with pooling, then a 512-wide layer."""
    layers, channels = [], image_shape[0]
    for width, kernel, stride in ((16, 5, 2), (32, 5, 2), (64, 3, 1)):
        layers += [nn.Conv2d(channels, width, kernel, stride, kernel // 2), nn.ReLU(), nn.MaxPool2d(2, ceil_mode=True)]
        channels = width
    layers.append(nn.Flatten())
    with torch.no_grad():
        features = nn.Sequential(*layers)(torch.zeros(1, *image_shape)).shape[-1]
    return nn.Sequential(*layers, nn.Linear(features, 512), nn.ReLU())
