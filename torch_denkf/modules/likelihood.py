r"""Likelihoods of particles: compare each particle's predicted observation :math:`h(x^i)` with the reading."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey, unravel_key
from torch import nn

from torch_denkf._checks import check_choice, check_count
from torch_denkf.functional.manifolds import Space, check_space
from torch_denkf.modules.spaces import mean_reading, narrowed_mask
from torch_denkf.modules.stochastic import StochasticMLP
from torch_denkf.modules.tensors import as_vector, mean_of_members
from torch_denkf.submodel import Update

__all__ = ["GaussianLikelihood", "LearnedLikelihood"]

#: Jonschkowski et al.: the smallest likelihood, so that a single reading removes no particle.
_SMALLEST_LIKELIHOOD = 0.004
#: Kloss et al.: the smallest log-likelihood.
_SMALLEST_LOG_LIKELIHOOD = -20.0


class GaussianLikelihood(Update):
    r"""Computes the log-density of the reading around each particle's prediction, :math:`\log N(\tilde y; h(x^i), R)`.

    Unobserved dimensions, and those of infinite variance, are left out; if nothing is observed it is zero for all
    particles.

    Args:
        reading_space: space of the reading, such as ``Circle()`` for an angle; ``None`` for plain numbers.
            Variances are of tangents.
        predicted_key: predicted observations ``[*B, E, O]``, in the observation's units.
        observation_key: one reading ``[*B, O]``, or learned observations ``[*B, E, O]``, whose mean is used.
        noise_variance_key: variances ``[*B, O]``, the diagonal of R.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``, ``True`` where observed; missing readings may be NaN.
        out_key: log-likelihoods ``[*B, E]``, in nats.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if the noise is a covariance.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({
        ...     "forecast": {"observation": torch.tensor([[0.0], [1.0]])},
        ...     "sensor": {"ensemble": torch.tensor([1.0]), "noise": torch.tensor([1.0])},
        ... })
        >>> GaussianLikelihood()(td)["forecast", "log_likelihood"]
        tensor([-1.4189, -0.9189])
    """

    def __init__(
        self,
        *,
        reading_space: Space | None = None,
        predicted_key: NestedKey = ("forecast", "observation"),
        observation_key: NestedKey = ("sensor", "ensemble"),
        noise_variance_key: NestedKey = ("sensor", "noise"),
        observed_key: NestedKey = "observed",
        out_key: NestedKey = ("forecast", "log_likelihood"),
    ):
        super().__init__(
            nn.Identity(), [predicted_key, observation_key, noise_variance_key], [out_key], optional_keys=[observed_key]
        )
        self.reading_space = check_space("reading_space", reading_space)
        self.reading_keys, self.observed_key = self.in_keys[1:], unravel_key(observed_key)
        self.predicted_key = self.in_keys[0]

    def compute(self, predicted, reading, variance, observed=None, *, batch_size):
        """Returns the log-likelihoods."""
        if variance.ndim > len(batch_size) + 1:
            raise ValueError(
                f"GaussianLikelihood takes variances [*B, O]; {self.in_keys[2]!r} has shape {list(variance.shape)}. "
                "Use DiagonalNoise or ConstantNoise."
            )
        observed = narrowed_mask(self.reading_space, observed)
        if reading.ndim > len(batch_size) + 1:
            reading = mean_reading(self.reading_space, reading, observed)
        reading = reading.unsqueeze(-2)
        if self.reading_space is not None:  # for each particle separately: they may be spread over a full turn
            mask = None if observed is None else observed.unsqueeze(-2)
            reading = self.reading_space.innovation(reading, predicted, mask)
            predicted = torch.zeros_like(reading)
        if not reading.shape[-1] == predicted.shape[-1] == variance.shape[-1]:
            widths = {
                key: value.shape[-1] for key, value in zip(self.in_keys, (predicted, reading, variance), strict=True)
            }
            raise ValueError(f"GaussianLikelihood compares vectors of one width; their widths are {widths}.")
        variance = variance.unsqueeze(-2)
        if observed is not None:
            # The reading is replaced, not only the residual, so that NaN reaches neither values nor gradients.
            observed = observed.unsqueeze(-2)
            reading, variance = torch.where(observed, reading, 0.0), torch.where(observed, variance, 1.0)
        residual = reading - predicted
        terms = -0.5 * (residual.square() / variance + variance.log() + math.log(2 * math.pi))
        shown = variance != torch.inf if observed is None else observed & (variance != torch.inf)
        return torch.where(shown, terms, 0.0).sum(-1)


class LearnedLikelihood(Update):
    r"""Computes a learned likelihood from the sensor's encoding and a particle's predicted observation.

    .. math:: \log l^i = b(g(e \oplus (h(x^i) - m) / s))

    It needs no noise model and is not normalised over readings. The bound b prevents a single reading from removing
    all particles. If nothing is observed it is zero for all particles; if only some dimensions are, the network
    reads the mean of the others instead of the particle's values.

    This is the form of the papers, in which the encoding has the information about the reading. A network trained on
    few recordings does not generalise to the encodings of new ones. With a trained sensor, ``observation_key`` gives
    the network the innovation instead:

    .. math:: \log l^i = b(g(e \oplus \mathrm{sign}(d^i) \log(1 + |d^i|))), \quad d^i = (y - h(x^i)) / s

    The logarithm resolves near particles and limits the range of distant ones.

    Args:
        encoding_dim: F, size of the encoding.
        observation_dim: O.
        num_cells: hidden layers; both papers have (128, 128).
        bound: ``"scaled"``, :math:`\log(0.004 + 0.996\, \mathrm{sigmoid}(g))` (Jonschkowski et al. 2018), or
            ``"clipped"``, :math:`\max(\log \mathrm{sigmoid}(g), -20)` (the limit of Kloss et al. 2021).
        loc: mean m of each observation dimension ``[O]``; zero by default. Not with an ``observation_key``.
        scale: s of each observation dimension ``[O]``: its standard deviation, or with an ``observation_key`` the
            usual error of a reading; one by default.
        reading_space: space of the reading, made of numbers and angles; only with an ``observation_key``.
        network: maps ``[*, F + O]`` to ``[*, 1]``; a multi-layer perceptron with ``num_cells`` by default.
        encoding_key: the encoding ``[*B, F]``, such as a sensor's ``encoding_key``; for an entry ``[*B, E, F]`` the
            mean is used.
        observation_key: output of a trained sensor, ``[*B, O]`` or ``[*B, E, O]``, whose mean is used. ``None`` by
            default, as in the papers.
        predicted_key: predicted observations ``[*B, E, O]``, in the observation's units.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``; encodings of frames without any observation may
            be NaN.
        out_key: log-likelihoods ``[*B, E]``, in nats, up to a constant.

    Raises:
        ValueError: on an unknown ``bound``, with both ``loc`` and ``observation_key``, or a ``reading_space`` without
            ``observation_key``, of another kind, or of another size than O.
        KeyError: if an entry is missing.

    Reference:
        Jonschkowski, Rastogi & Brock, "Differentiable particle filters", 2018, arXiv:1805.11122;
        Kloss, Martius & Bohg, "How to train your differentiable filter", 2021, arXiv:2012.14313. Their network reads
        the particle's state; its predicted observation has all information that a reading can confirm.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"forecast": {"observation": torch.randn(32, 2)}, "sensor": {"encoding": torch.randn(16)}})
        >>> LearnedLikelihood(16, 2)(td)["forecast", "log_likelihood"].shape
        torch.Size([32])
    """

    def __init__(
        self,
        encoding_dim: int,
        observation_dim: int,
        *,
        num_cells: Sequence[int] = (128, 128),
        bound: Literal["scaled", "clipped"] = "scaled",
        loc: Sequence[float] | torch.Tensor | None = None,
        scale: Sequence[float] | torch.Tensor | None = None,
        reading_space: Space | None = None,
        network: nn.Module | None = None,
        encoding_key: NestedKey = ("sensor", "encoding"),
        observation_key: NestedKey | None = None,
        predicted_key: NestedKey = ("forecast", "observation"),
        observed_key: NestedKey = "observed",
        out_key: NestedKey = ("forecast", "log_likelihood"),
    ):
        check_choice("bound", bound, ("scaled", "clipped"))
        if loc is not None and observation_key is not None:
            raise ValueError(
                "with an observation_key the network reads the innovation, which has no loc; pass only scale."
            )
        space = check_space("reading_space", reading_space, flat=True)
        if space is not None and (observation_key is None or space.point_dim != observation_dim):
            raise ValueError(
                f"reading_space={reading_space} must fit a reading of {observation_dim}, with an observation_key."
            )
        check_count("encoding_dim", encoding_dim)
        check_count("observation_dim", observation_dim)
        if network is None:
            network = StochasticMLP(encoding_dim + observation_dim, 1, num_cells, layer="none")
        in_keys = [key for key in (encoding_key, predicted_key, observation_key) if key is not None]
        super().__init__(network, in_keys, [out_key], optional_keys=[observed_key])
        self.bound, self.observation_dim, self.encoding_dim = bound, observation_dim, encoding_dim
        self.reading_space = space
        self.reading_keys = [key for key in self.in_keys if key != self.in_keys[1]]
        self.observed_key = unravel_key(observed_key)
        for name, value, default in (("loc", loc, 0.0), ("scale", scale, 1.0)):
            limit = 0 if name == "scale" else None
            vector = as_vector(name, default if value is None else value, observation_dim, above=limit)
            self.register_buffer(name, vector)

    def reading_dims(self, entries, call):
        """Returns the sizes of the encoding and of the reading."""
        return [self.encoding_dim, self.observation_dim][: len(self.reading_keys)]

    def compute(self, encoding, predicted, *rest, batch_size):
        """Returns the log-likelihoods."""
        *readings, observed = rest
        encoding = mean_of_members(encoding, batch_size)
        if readings:
            (reading,) = readings
            if reading.ndim > len(batch_size) + 1:
                reading = mean_reading(self.reading_space, reading, observed)
            reading, space = reading.unsqueeze(-2), self.reading_space
            seen = (reading - predicted if space is None else space.minus(reading, predicted)) / self.scale
        else:
            seen = (predicted - self.loc) / self.scale
        if observed is not None:
            any_observed = observed.any(-1, keepdim=True)
            encoding = torch.where(any_observed, encoding, 0.0)
            seen = torch.where(observed.unsqueeze(-2), seen, 0.0)
        if readings:
            seen = seen.sign() * seen.abs().log1p()
        encoding = encoding.unsqueeze(-2).expand(*seen.shape[:-1], encoding.shape[-1])
        value = self.module(torch.cat([encoding, seen], -1)).squeeze(-1)
        if self.bound == "scaled":
            value = (_SMALLEST_LIKELIHOOD + (1 - _SMALLEST_LIKELIHOOD) * value.sigmoid()).log()
        else:
            value = nn.functional.logsigmoid(value).clamp(min=_SMALLEST_LOG_LIKELIHOOD)
        return value if observed is None else torch.where(any_observed, value, 0.0)
