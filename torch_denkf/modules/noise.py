r"""Observation noise: the diagonal of :math:`r_\zeta(\tilde y_t)` in eq. 9."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf._checks import check_count, check_number, check_values
from torch_denkf.modules.around import Wrapper
from torch_denkf.modules.stochastic import StochasticMLP
from torch_denkf.modules.tensors import (
    as_standard_deviations,
    mean_of_members,
    register_location_and_scale,
    variance_and_floor,
)
from torch_denkf.submodel import Sensor

__all__ = ["ConstantNoise", "DiagonalNoise", "ScaledNoise"]


class DiagonalNoise(Sensor):
    r"""A learned diagonal of R as a function of the observation, with :math:`R = r^2` before training and a floor.

    .. math:: R = (r^2 - c)\,(1 + g_\zeta((\tilde y - m) / s))^2 + c

    This is the form of Kloss et al. (2021), written so that the network's output is relative to ``r`` and the
    floor ``c`` is never larger than :math:`r^2`: no value of ``r`` gives NaN. The last layer starts at zero.

    Args:
        observation_dim: O.
        r: standard deviation before training, one number or one for each dimension, in the observation's units.
        floor: smallest variance ``c``; 1 % of :math:`r^2` by default.
        num_cells: hidden layers; Table I has (16, 16).
        in_features: size of the input, O by default; for a sensor's encoding its size.
        loc: mean :math:`m` of the input ``[in_features]``; zero by default.
        scale: standard deviation :math:`s` of the input ``[in_features]``; one by default.
        in_key: learned observations ``[*B, E, O]`` (their mean is used) or any entry ``[*B, in_features]``.
        out_key: variances ``[*B, O]``.

    Raises:
        ValueError: if ``r`` is not positive or the floor reaches :math:`r^2`.

    Reference:
        Kloss, Martius, Bohg, "How to train your differentiable filter", 2021, arXiv:2012.14313, section 4.

    Example:
        >>> from tensordict import TensorDict
        >>> noise = DiagonalNoise(2, r=0.1)
        >>> noise(TensorDict({("sensor", "ensemble"): torch.randn(32, 2)}))["sensor", "noise"]
        tensor([0.0100, 0.0100], grad_fn=...)
    """

    def __init__(
        self,
        observation_dim: int,
        *,
        r: float | Sequence[float] | torch.Tensor = 0.1,
        floor: float | Sequence[float] | torch.Tensor | None = None,
        num_cells: Sequence[int] = (16, 16),
        in_features: int | None = None,
        loc: Sequence[float] | torch.Tensor | None = None,
        scale: Sequence[float] | torch.Tensor | None = None,
        in_key: NestedKey = ("sensor", "ensemble"),
        out_key: NestedKey = ("sensor", "noise"),
    ):
        check_count("observation_dim", observation_dim)
        in_features = observation_dim if in_features is None else in_features
        network = StochasticMLP(in_features, observation_dim, num_cells, layer="none", output_gain=0.0)
        super().__init__(network, [in_key], [out_key])
        self.observation_dim = observation_dim
        variance, floor = variance_and_floor("DiagonalNoise", observation_dim, r, floor)
        self.register_buffer("variance", variance)
        self.register_buffer("floor", floor)
        register_location_and_scale(
            self, torch.zeros(in_features) if loc is None else loc, torch.ones(in_features) if scale is None else scale
        )

    def compute(self, features, *, batch_size):
        """Returns the variances."""
        relative = 1 + self.module((mean_of_members(features, batch_size) - self.loc) / self.scale)
        return self.variance * relative**2 + self.floor


class ConstantNoise(Sensor):
    """A constant diagonal of R, learned or known.

    Args:
        r: standard deviation of each dimension ``[O]``, in the observation's units; 0 for none, only for Q or in a
            :class:`~torch_denkf.filters.KalmanFilter`: ensembles need R > 0.
        trainable: whether log R is a parameter.
        in_key: any entry of batch shape ``[*B, ...]``, of which only the dtype is used.
        out_key: variances ``[*B, O]``.

    Raises:
        ValueError: if ``r`` is negative, or zero and trainable.

    Example:
        >>> from tensordict import TensorDict
        >>> noise = ConstantNoise([0.1, 2.0], in_key="position")
        >>> noise(TensorDict({"position": torch.zeros(2)}))["sensor", "noise"]
        tensor([0.0100, 4.0000])
    """

    def __init__(
        self,
        r: Sequence[float] | torch.Tensor,
        *,
        trainable: bool = False,
        in_key: NestedKey = ("sensor", "ensemble"),
        out_key: NestedKey = ("sensor", "noise"),
    ):
        super().__init__(nn.Identity(), [in_key], [out_key])
        r = as_standard_deviations("r", r)
        if trainable:
            check_values("r, a trainable standard deviation,", r, above=0)
        self.observation_dim = r.numel()
        log_variance = 2 * r.log()
        if trainable:
            self.log_variance = nn.Parameter(log_variance)
        else:
            self.register_buffer("log_variance", log_variance)

    def compute(self, like, *, batch_size):
        """Returns the variances."""
        variance = self.log_variance.exp().to(torch.promote_types(like.dtype, self.log_variance.dtype))
        return variance.expand(*batch_size, -1)


class ScaledNoise(Wrapper, Sensor):
    r"""Multiplies the variances of another noise module by the square of a factor that is set by hand after training.

    An overconfident filter needs more spread. Scaling Q and R by one factor widens its intervals and keeps its trained
    gain. Inflating the belief in every step would also multiply components that no reading observes, such as the pose
    of a vehicle whose velocities are measured, which would grow without bound.

    ``factor`` is neither a parameter nor in the state dict: it is chosen after training, on validation data.

    Args:
        noise: writes variances ``[*B, N]`` or a covariance ``[*B, N, N]``; its keys are kept.
        factor: factor of the standard deviations; not negative.

    Raises:
        ValueError: if the factor is negative.

    Example:
        >>> from tensordict import TensorDict
        >>> noise = ScaledNoise(ConstantNoise([0.1, 2.0]))
        >>> noise.factor = 3.0
        >>> noise(TensorDict({("sensor", "ensemble"): torch.zeros(32, 2)}))["sensor", "noise"]
        tensor([ 0.0900, 36.0000])
    """

    place = "noise"

    def __init__(self, noise: TensorDictModuleBase, factor: float = 1.0):
        check_number("factor", factor, least=0)
        super().__init__(noise)
        self.factor = factor

    def on_entries(self, entries, call):
        """Returns the scaled variances or covariance."""
        out, key = self.run_inside(entries, call), self.out_keys[0]
        return {**out, key: self.factor**2 * out[key]}
