"""Smoothers of particle filters, which reweight particles by the motion's density."""

from __future__ import annotations

import math

import torch
from tensordict import unravel_key
from torch import Tensor

from torch_denkf.beliefs import moments_of
from torch_denkf.filters import Filter
from torch_denkf.filters.gather import controls_of
from torch_denkf.functional.linalg import as_covariance, cholesky
from torch_denkf.functional.manifolds import Space
from torch_denkf.functional.smoothing.particles import backward_smooth
from torch_denkf.functional.weighted import weighted_mean
from torch_denkf.modules import NoisyTransition
from torch_denkf.running import run_module
from torch_denkf.smoothers.base import Smoother
from torch_denkf.smoothers.fixed_lag import prefix_of
from torch_denkf.submodel import Call, Entries

__all__ = ["ParticleSmoother"]

_STILL = 1e-12  # replaces a variance of zero


class ParticleSmoother(Smoother):
    r"""Backward smoothing of particles: ancestors of likely later particles gain weight; no particle moves.

    It needs the density of the motion, :math:`p(x_{t+1} | x_t)`, and so a
    :class:`~torch_denkf.modules.NoisyTransition` with noise in every dimension, added after a deterministic motion.
    Each step computes E² densities. For other motions :class:`FixedLag` follows the ancestors of the
    particles, of which few remain after a long lag. It writes ``("smoothed", "ensemble")`` ``[*B, T, E, S]``, the
    filter's particles, their ``log_weight`` ``[*B, T, E]``, ``mean`` and ``var``, see :class:`Smoother`.

    On a space the density is Gaussian in the tangent from the forecast particle to the later one. That is
    accurate if the noise of a step is small compared with a full turn.

    Args:
        filter: a particle filter.
        lag: number of later readings; ``None`` for all.

    Raises:
        TypeError: for another filter, or a motion without a density.

    Reference:
        Doucet, Godsill & Andrieu, "On sequential Monte Carlo sampling methods for Bayesian filtering", Statistics and
        Computing 10, 2000, section V.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import ParticleFilter
        >>> from torch_denkf.modules import ConstantNoise, GaussianLikelihood, GaussianPrior, LearnedTransition, Select
        >>> filter = ParticleFilter(
        ...     LearnedTransition(torch.nn.Linear(2, 2)),
        ...     None,
        ...     Select([0]),
        ...     GaussianLikelihood(observation_key="position"),
        ...     noise=ConstantNoise([0.1], in_key="position"),
        ...     initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=50),
        ...     process_noise=0.1,
        ... )
        >>> ParticleSmoother(filter)(TensorDict({"position": torch.randn(3, 5, 1)}, [3, 5]))["smoothed", "mean"].shape
        torch.Size([3, 5, 2])
    """

    def __init__(self, filter: Filter, lag: int | None = None):
        prefix = prefix_of(filter, "particles", self)
        motion = filter.transition_module.module
        if not isinstance(motion, NoisyTransition) or motion.before or motion.dims is not None:
            raise TypeError(
                "ParticleSmoother needs the density of the motion: a NoisyTransition with noise in all dimensions, "
                "after the motion (process_noise= of ParticleFilter). FixedLag smooths particles of any motion."
            )
        keys = [(prefix, "ensemble"), (prefix, "log_weight")]
        super().__init__(filter, lag, keys, ("ensemble", "log_weight", "mean", "var"))

    def _smooth(self, entries, follows, out):
        particles, log_weights = (entries[key] for key in self._needed)
        densities = self._densities(entries, particles, log_weights)
        smoothed = backward_smooth(log_weights, densities, follows=follows, lag=self.lag)
        return particles, smoothed, *moments_of(particles, smoothed, self.filter.structure.space)

    def _densities(self, entries: Entries, particles: Tensor, log_weights: Tensor) -> Tensor:
        """Returns log-densities of particles at t (columns) given particles at t − 1 (rows), ``[*B, T, E, E]``."""
        motion, structure = self.filter.transition_module.module, self.filter.structure
        space = structure.space
        key, out_key = unravel_key(motion.in_keys[0]), unravel_key(motion.out_keys[0])
        time, count = particles.ndim - 3, particles.shape[-3]

        def before(value: Tensor) -> Tensor:
            return value.narrow(time, 0, count - 1)

        def after(value: Tensor) -> Tensor:
            return value.narrow(time, 1, count - 1)

        def mean(members: Tensor) -> Tensor:
            return weighted_mean(members, weights) if space is None else space.mean(members, weights.exp())

        # A step reads the belief before it, the action at the time of that belief, and other entries of its own time.
        work = {name: after(value) for name, value in entries.items() if value.ndim > time}
        work.update({name: before(entries[name]) for name in structure.belief if name in entries})
        work.update({name: after(value) for name, value in controls_of(structure, entries, time).items()})
        old, weights = before(particles), before(log_weights)
        work.update({key: old, motion.mean_key: mean(old)})
        call = Call(old.shape[:-2], sample=False)
        moved = run_module(motion.module["transition"], work, call)[out_key]
        work[motion.forecast_mean_key] = mean(moved)
        noise = run_module(motion.module["noise"], work, call)[unravel_key(motion.module["noise"].out_keys[0])]
        cov = as_covariance(noise, work[motion.mean_key])
        log_density = log_density_of_pairs(after(particles), moved, cov, space)
        return torch.cat([torch.zeros_like(log_density.narrow(time, 0, 1)), log_density], time)


def log_density_of_pairs(values: Tensor, means: Tensor, cov: Tensor, space: Space | None = None) -> Tensor:
    """Returns the log-density N(value; mean, cov) of each value (columns) around each mean (rows).

    Args:
        values: ``[*B, E, S]``.
        means: ``[*B, E, S]``.
        cov: the covariance for all pairs, ``[*B, S, S]``.
        space: space of values and means; the density is of the tangents between them.

    Returns:
        The log-densities, ``[*B, E, E]``; NaN if ``cov`` is not positive definite.

    Example:
        >>> log_density_of_pairs(torch.zeros(1, 2), torch.zeros(1, 2), torch.eye(2))
        tensor([[-1.8379]])
    """
    moved = cov.diagonal(dim1=-2, dim2=-1)  # without noise, as in a step of zero duration, a value equals its mean
    factor = cholesky(cov + torch.where(moved == 0, _STILL, 0.0).to(cov.dtype).diag_embed())
    if space is None:
        white = [torch.linalg.solve_triangular(factor, value.mT, upper=False).mT for value in (values, means)]
        away = white[0].unsqueeze(-3) - white[1].unsqueeze(-2)
    else:
        away = space.minus(values.unsqueeze(-3), means.unsqueeze(-2))
        away = torch.linalg.solve_triangular(factor.unsqueeze(-3), away.mT, upper=False).mT
    square = away.square().sum(-1)
    log_det = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)[..., None, None]
    return -0.5 * (square + log_det + cov.shape[-1] * math.log(2 * math.pi))
