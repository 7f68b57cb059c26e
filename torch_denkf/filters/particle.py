"""Differentiable particle filters: the sub-models of an ensemble filter, with weights instead of an ensemble update."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, Unpack

from tensordict import unravel_key
from tensordict.nn import TensorDictModuleBase

from torch_denkf._checks import check_choice
from torch_denkf.filters.base import Filter
from torch_denkf.filters.parts import FilterParts, ReadingOptions
from torch_denkf.modules import GaussianLikelihood, NoisyTransition, SubModel
from torch_denkf.modules.particles import ParticleAnalysis, ResampledTransition, with_weights

__all__ = ["DPF", "MixtureParticleFilter", "ParticleFilter"]


class ParticleFilter(Filter):
    r"""Particle filter: each step resamples, moves the particles, and weights them with the reading's likelihood.

    Its belief is the particles ``("belief", "ensemble")`` ``[*B, E, S]`` and their normalised log-weights
    ``("belief", "log_weight")`` ``[*B, E]``, both carried, with weighted ``("belief", "mean")`` and
    ``("belief", "var")``. With the true models, Gaussian likelihood and systematic resampling it is the bootstrap
    filter (Gordon, Salmond & Smith 1993), whose error falls like :math:`1/\sqrt{E}`.

    Args:
        transition: forecasts ``("forecast", "ensemble")``; its randomness is the motion noise, see
            :class:`~torch_denkf.modules.NoisyTransition`. Without any noise, particles become copies of one.
        sensor: writes ``("sensor", "ensemble")`` or an encoding; ``None`` if the reading is in the tensordict, under
            ``observation_key``, or if ``likelihood`` has the key.
        observation: writes the predicted observations ``("forecast", "observation")``.
        likelihood: writes ``("forecast", "log_likelihood")``; a Gaussian one by default.
        analysis: the update, :class:`~torch_denkf.modules.particles.ParticleAnalysis` by default. With a Gaussian
            likelihood it also writes ``("info", "innovation")`` and ``("info", "nis")``.
        noise: writes ``("sensor", "noise")``, for a Gaussian likelihood; ``None`` if none is needed.
        resampling: ``"systematic"``, ``"soft"``, ``"transport"`` or ``None``, see
            :class:`~torch_denkf.modules.particles.ResampledTransition`; a ``transition`` of this class is used
            unchanged.
        alpha: share of the uniform distribution in soft resampling.
        epsilon: regularisation of transport.
        ess_threshold: resamples only if the effective number of particles is below this share of E. ``None``: always.
        jitter: regularised particle filter: separates the copies of resampling by a Gaussian kernel of
            this many times the usual width. For motions with little or no noise.
        initial: the initial belief, which also fixes the number of particles; weights are added if it has none.
        process_noise: Q of the motion, in addition to the transition's own noise: standard deviations ``[S]`` (one
            number for all), or a module that writes Q, see :class:`~torch_denkf.modules.NoisyTransition`.
        **options: ``reading_space`` and ``observation_key``, for the default likelihood; ``observed_key``, also used by
            resampling; ``visibility``, for a Gaussian likelihood; ``sensor_error`` and the common options of
            filters, see :class:`~torch_denkf.filters.parts.ReadingOptions`.

    Raises:
        ValueError: on an unknown ``resampling``, or if the source of the reading is ambiguous.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import ConstantNoise, GaussianPrior, LearnedTransition, LinearObservation
        >>> from torch_denkf.modules import StochasticMLP
        >>> pf = ParticleFilter(
        ...     LearnedTransition(StochasticMLP(2, 2)),
        ...     None,
        ...     LinearObservation(torch.eye(2)),
        ...     observation_key="position",
        ...     noise=ConstantNoise([0.1, 0.1], in_key="position"),
        ...     initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=100),
        ... )
        >>> pf.carry_keys
        [('belief', 'ensemble'), ('belief', 'log_weight')]
        >>> pf.sequence(TensorDict({"position": torch.randn(3, 5, 2)}, [3, 5]))["info", "ess"].shape
        torch.Size([3, 5, 1])
    """

    def __init__(
        self,
        transition: SubModel,
        sensor: TensorDictModuleBase | None,
        observation: TensorDictModuleBase,
        likelihood: TensorDictModuleBase | None = None,
        analysis: TensorDictModuleBase | None = None,
        *,
        initial: TensorDictModuleBase,
        noise: TensorDictModuleBase | None = None,
        resampling: Literal["systematic", "soft", "transport"] | None = "systematic",
        alpha: float = 0.05,
        epsilon: float = 0.05,
        ess_threshold: float | None = None,
        jitter: float = 0.0,
        process_noise: TensorDictModuleBase | Sequence[float] | float | None = None,
        **options: Unpack[ReadingOptions],
    ):
        check_choice("resampling", resampling, ("systematic", "soft", "transport", None))
        more = process_noise is not None or options.get("sensor_error") is not None
        if more and isinstance(transition, ResampledTransition):
            raise ValueError("Add process noise and sensor_error to the motion inside the ResampledTransition.")
        parts = FilterParts(
            transition, sensor, observation, noise, initial, process_noise, optional=["noise"], **options
        )
        if likelihood is None:
            likelihood = GaussianLikelihood(**parts.reading(", or a likelihood"))
        elif parts.reading_space is not None or parts.observation_key is not None:
            raise ValueError(
                "reading_space and observation_key are for the default likelihood; pass them to your own, "
                "the key as observation_key= of a GaussianLikelihood, or as encoding_key= or observation_key= of a "
                "LearnedLikelihood."
            )
        if analysis is None:
            of_reading = likelihood if isinstance(likelihood, GaussianLikelihood) else None
            analysis = ParticleAnalysis(of_reading, space=parts.space)
        moving = parts.moving()
        if not isinstance(moving, ResampledTransition):
            moving = ResampledTransition(
                moving,
                resampling,
                alpha=alpha,
                epsilon=epsilon,
                ess_threshold=ess_threshold,
                jitter=jitter,
                observed_key=parts.observed_key,
            )
        (ensemble, log_weight), initial = map(unravel_key, moving.in_keys[:2]), parts.initial
        if log_weight not in map(unravel_key, initial.out_keys):
            initial = with_weights(initial, ensemble_key=ensemble, log_weight_key=log_weight)
        modules = parts.in_order(
            transition=moving, observation=parts.observation, likelihood=likelihood, analysis=analysis
        )
        super().__init__(modules, initial=initial, **parts.options)


class DPF(ParticleFilter):
    """Differentiable particle filter of Jonschkowski et al.: learned models, and hard resampling that stops gradients.

    Train it with :class:`torch_denkf.objectives.MixtureLoss`: the likelihood of each step is then trained by that
    step's belief only.

    Args:
        transition: forecasts ``("forecast", "ensemble")``.
        sensor: writes the encoding, the input of ``likelihood``.
        observation: writes ``("forecast", "observation")``.
        likelihood: learned, bounded from below, see :class:`~torch_denkf.modules.LearnedLikelihood`.
        motion_noise: learned variances of some dimensions of the state, see
            :class:`~torch_denkf.modules.NoisyTransition`; ``None`` if ``transition`` is random already.
        noisy_dims: those dimensions. The noise is added before the motion; for noise after it, use a ``transition``
            with noise instead.
        initial: the initial belief.
        **kwargs: arguments of :class:`ParticleFilter`.

    Reference:
        Jonschkowski, Rastogi & Brock, "Differentiable particle filters: end-to-end learning with algorithmic priors",
        2018, arXiv:1805.11122. There the motion noise is a sampler and on KITTI 100 particles start at the truth.

    Example:
        >>> import torch
        >>> from torch_denkf.modules import AroundState, DiagonalNoise, LearnedLikelihood, LearnedTransition
        >>> from torch_denkf.modules import Select, VectorSensor
        >>> dpf = DPF(
        ...     LearnedTransition(torch.nn.Linear(2, 2)),
        ...     VectorSensor(6, 1, ensemble_size=1, layer="none"),
        ...     Select([1]),
        ...     LearnedLikelihood(1, 1, encoding_key=("sensor", "ensemble")),
        ...     DiagonalNoise(1, in_features=2, in_key=("belief", "mean"), out_key=("forecast", "noise")),
        ...     noisy_dims=[1],
        ...     initial=AroundState([0.0, 0.0], ensemble_size=100),
        ... )
        >>> dpf["transition"].scheme
        'systematic'
    """

    def __init__(
        self,
        transition: SubModel,
        sensor: TensorDictModuleBase | None,
        observation: TensorDictModuleBase,
        likelihood: TensorDictModuleBase,
        motion_noise: TensorDictModuleBase | None = None,
        *,
        noisy_dims: Sequence[int] = (),
        initial: TensorDictModuleBase,
        **kwargs,
    ):
        if motion_noise is not None:
            transition = NoisyTransition(transition, motion_noise, noisy_dims, before=True)
        super().__init__(transition, sensor, observation, likelihood, initial=initial, **kwargs)


class MixtureParticleFilter(ParticleFilter):
    """Differentiable particle filters of Kloss et al. for the mixture loss: dPF-M and dPF-M-lrn.

    They use soft resampling in every step, so that gradients continue from step to step; "M" is the loss,
    :class:`torch_denkf.objectives.MixtureLoss`, and "lrn" the likelihood.

    Args:
        transition: forecasts ``("forecast", "ensemble")``.
        sensor: writes ``("sensor", "ensemble")``, or the encoding, the input of ``learned_likelihood``; ``None`` if
            the reading is in the tensordict, under ``observation_key``.
        observation: writes ``("forecast", "observation")``.
        noise: writes ``("sensor", "noise")``, for the Gaussian likelihood; not needed with a learned one.
        learned_likelihood: a :class:`~torch_denkf.modules.LearnedLikelihood`, theirs is ``bound="clipped"``;
            ``None`` for the Gaussian one.
        initial: the initial belief.
        alpha: share of the uniform distribution in soft resampling.
        **kwargs: arguments of :class:`ParticleFilter`, such as ``observation_key``.

    Raises:
        ValueError: if neither ``noise`` nor ``learned_likelihood`` is given.

    Reference:
        Kloss, Martius & Bohg, "How to train your differentiable filter", 2021, arXiv:2012.14313.

    Example:
        >>> import torch
        >>> from torch_denkf.modules import AroundState, DiagonalNoise, LearnedTransition, Select, StochasticMLP
        >>> from torch_denkf.modules import VectorSensor
        >>> pf = MixtureParticleFilter(
        ...     LearnedTransition(StochasticMLP(2, 2)),
        ...     VectorSensor(6, 1, ensemble_size=1, layer="none"),
        ...     Select([1]),
        ...     DiagonalNoise(1),
        ...     initial=AroundState([0.0, 0.0], ensemble_size=100),
        ... )
        >>> pf["transition"].scheme, type(pf["likelihood"]).__name__
        ('soft', 'GaussianLikelihood')
    """

    def __init__(
        self,
        transition: SubModel,
        sensor: TensorDictModuleBase | None,
        observation: TensorDictModuleBase,
        noise: TensorDictModuleBase | None = None,
        *,
        learned_likelihood: TensorDictModuleBase | None = None,
        initial: TensorDictModuleBase,
        alpha: float = 0.05,
        **kwargs,
    ):
        if noise is None and learned_likelihood is None:
            raise ValueError("MixtureParticleFilter needs noise, for its Gaussian likelihood, or a learned_likelihood.")
        super().__init__(
            transition,
            sensor,
            observation,
            learned_likelihood,
            noise=noise,
            resampling="soft",
            alpha=alpha,
            initial=initial,
            **kwargs,
        )
