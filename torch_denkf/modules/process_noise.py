r"""Noise with a full covariance, as a learned Cholesky factor: Q of a transition, or R of a sensor.

A filter with a covariance adds to its forecast the output ``("forecast", "noise")`` of a *process noise* module:
variances ``[*B, S]`` (:class:`~torch_denkf.modules.ConstantNoise` or :class:`~torch_denkf.modules.DiagonalNoise` with
``in_key=("belief", "mean"), out_key=("forecast", "noise")``) or a covariance ``[*B, S, S]`` (the modules of this file).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torch.nn import functional as F

from torch_denkf._checks import check_count, check_values
from torch_denkf.modules.around import Wrapper
from torch_denkf.modules.noise import ConstantNoise
from torch_denkf.modules.stochastic import StochasticMLP
from torch_denkf.modules.tensors import (
    as_floating,
    mean_of_members,
    register_location_and_scale,
    register_matrix,
    variance_and_floor,
)
from torch_denkf.submodel import Call, Entries, SubModel

__all__ = ["CholeskyNoise", "MappedNoise", "NoiseThrough", "as_process_noise"]

_BELIEF_MEAN, _FORECAST_NOISE = ("belief", "mean"), ("forecast", "noise")


def as_process_noise(
    noise: TensorDictModuleBase | Sequence[float] | torch.Tensor | float,
    size: int | None,
    name: str = "process_noise",
    in_key: NestedKey = _BELIEF_MEAN,
) -> TensorDictModuleBase:
    """Returns a module that writes Q: the given one, or a constant one for standard deviations ``[S]`` or one number.

    Args:
        noise: the module, or standard deviations in the state's units; 0 for a dimension without noise.
        size: S, if it is known; needed if ``noise`` is one number.
        name: name of the argument, for messages.
        in_key: entry whose dtype a constant Q takes.

    Raises:
        ValueError: if S is not known, or a standard deviation is negative.

    Example:
        >>> q = as_process_noise(0.5, 2)
        >>> from tensordict import TensorDict
        >>> q(TensorDict({("belief", "mean"): torch.zeros(2)}))["forecast", "noise"]
        tensor([0.2500, 0.2500])
    """
    if isinstance(noise, nn.Module):
        return noise
    std = as_floating(noise, name)
    check_values(f"{name}, a standard deviation,", std, least=0)
    if std.ndim > 1 or (std.ndim == 1 and size is not None and len(std) != size):
        known = f"[S] = [{size}]" if size is not None else "[S]"
        raise ValueError(f"{name} must be {known}, a standard deviation for each; got {list(std.shape)}")
    if std.ndim == 0:
        if size is None:
            raise ValueError(
                f"{name} is one number, and the number of dimensions is not known: give one for each, [S]."
            )
        std = std.expand(size)
    return ConstantNoise(std, in_key=in_key, out_key=_FORECAST_NOISE)


class CholeskyNoise(SubModel):
    r"""A learned covariance, constant or a function of an entry: :math:`D L L^T D + C`, ``diag(r^2)`` before training.

    :math:`D^2 = r^2 - c` and :math:`C` are diagonal, with the floor c; :math:`L` is lower triangular with a positive
    diagonal, the identity before training.

    Args:
        dim: N, the size of the covariance.
        r: standard deviation before training, a number or one for each dimension, in the units of the state (or of
            the observation).
        constant: whether the covariance is constant, and only the dtype of ``in_key`` is used.
        floor: smallest variance c; 1 % of :math:`r^2` by default.
        num_cells: hidden layers of the network, if not ``constant``.
        in_features: size of the input; N by default.
        loc: mean of the input ``[in_features]``; zero by default.
        scale: standard deviation of the input ``[in_features]``; one by default. An infinite one removes that feature
            from the network's input, such as the position of a vehicle.
        in_key: ``[*B, in_features]``, or learned observations ``[*B, E, in_features]``, whose mean is used.
        out_key: covariance ``[*B, N, N]``; ``("sensor", "noise")`` for R.

    Raises:
        ValueError: if ``r`` is not positive or the floor reaches :math:`r^2`.

    Reference:
        Haarnoja, Ajay, Levine, Abbeel, "Backprop KF: learning discriminative deterministic state estimators", 2016,
        arXiv:1605.07148, section 4, for R.

    Example:
        >>> from tensordict import TensorDict
        >>> noise = CholeskyNoise(2, r=[0.1, 1.0])
        >>> noise(TensorDict({("belief", "mean"): torch.zeros(2)}))["forecast", "noise"]
        tensor([[0.0100, 0.0000],
                [0.0000, 1.0000]], grad_fn=...)
    """

    def __init__(
        self,
        dim: int,
        *,
        r: float | Sequence[float] | torch.Tensor = 0.1,
        constant: bool = True,
        floor: float | Sequence[float] | torch.Tensor | None = None,
        num_cells: Sequence[int] = (16, 16),
        in_features: int | None = None,
        loc: Sequence[float] | torch.Tensor | None = None,
        scale: Sequence[float] | torch.Tensor | None = None,
        in_key: NestedKey = _BELIEF_MEAN,
        out_key: NestedKey = _FORECAST_NOISE,
    ):
        check_count("dim", dim)
        in_features, size = dim if in_features is None else in_features, dim * (dim + 1) // 2
        network = (
            nn.Identity() if constant else StochasticMLP(in_features, size, num_cells, layer="none", output_gain=0.0)
        )
        super().__init__(network, [in_key], [out_key])
        variance, floor = variance_and_floor("CholeskyNoise", dim, r, floor)
        self.dim, self.constant = dim, constant
        if constant:
            self.raw = nn.Parameter(torch.zeros(size, dtype=variance.dtype))
        self.register_buffer("std", variance.sqrt())
        self.register_buffer("floor", floor)
        register_location_and_scale(
            self, torch.zeros(in_features) if loc is None else loc, torch.ones(in_features) if scale is None else scale
        )
        self.register_buffer("rows", torch.tril_indices(dim, dim), persistent=False)

    def compute(self, features, *, batch_size):
        """Returns the covariance."""
        if self.constant:
            raw = self.raw.to(torch.promote_types(features.dtype, self.raw.dtype)).expand(*batch_size, -1)
        else:
            raw = self.module((mean_of_members(features, batch_size) - self.loc) / self.scale)
        row, column = self.rows
        # softplus is linear for large inputs, so that a large output of a network does not blow up the covariance.
        positive = F.softplus(raw + 0.5413248546129181)  # log(e - 1): softplus of it is 1
        entries = torch.where(row == column, positive, raw) * self.std.to(raw.dtype)[row]
        factor = raw.new_zeros(*raw.shape[:-1], self.dim**2).index_copy(-1, row * self.dim + column, entries)
        factor = factor.unflatten(-1, (self.dim, self.dim))
        return factor @ factor.mT + self.floor.to(raw.dtype).diag_embed()


class NoiseThrough(Wrapper):
    """Runs another noise module and replaces its output Q by G Q G^T; a sub-class implements G.

    Attributes:
        noise_dim: N of the noise inside, if it is known; an ensemble then draws only N numbers.
    """

    place = "noise"
    noise_dim: int | None = None

    def on_entries(self, entries, call):
        """Returns the covariance."""
        written, matrix = self.unmapped(entries, call)
        noise = written[self.out_keys[0]]
        scaled = matrix * noise.unsqueeze(-2) if noise.ndim == len(call.batch_size) + 1 else matrix @ noise
        return {**written, self.out_keys[0]: scaled @ matrix.mT}

    def unmapped(self, entries: Entries, call: Call) -> tuple[Entries, torch.Tensor]:
        """Returns the outputs of the noise module inside, and G."""
        written = self.run_inside(entries, call)
        noise = written[self.out_keys[0]]
        matrix = self._matrix(entries).to(noise.dtype)
        if noise.shape[-1] != matrix.shape[-1]:
            raise ValueError(
                f"{type(self).__name__} maps noise of {matrix.shape[-1]} dimensions to {matrix.shape[-2]}; "
                f"{type(self.module).__name__} writes {list(noise.shape)}."
            )
        return written, matrix

    def _matrix(self, entries) -> torch.Tensor:
        """Returns G, ``[S, N]`` or ``[*B, S, N]``."""
        raise NotImplementedError


class MappedNoise(NoiseThrough):
    r"""Noise that enters through a known matrix: :math:`G Q G^T`, e.g. in some dimensions of the state only.

    Args:
        noise: writes variances ``[*B, N]`` or a covariance ``[*B, N, N]``; its keys are kept.
        matrix: G, ``[S, N]``; columns of the identity select the noisy dimensions.

    Raises:
        ValueError: if the noise does not have N dimensions.

    Example:
        >>> from tensordict import TensorDict
        >>> second = MappedNoise(CholeskyNoise(1, r=2.0, in_features=2), torch.eye(2)[:, 1:])
        >>> second(TensorDict({("belief", "mean"): torch.zeros(2)}))["forecast", "noise"]
        tensor([[0., 0.],
                [0., 4.]], grad_fn=...)
    """

    def __init__(self, noise: TensorDictModuleBase, matrix: torch.Tensor):
        super().__init__(noise)
        register_matrix(self, "matrix", matrix, "[S, N]")
        self.noise_dim = self.matrix.shape[-1]

    def _matrix(self, entries):
        return self.matrix
