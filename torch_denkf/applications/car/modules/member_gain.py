"""Constant calibration errors of a sensor as a fixed gain and offset of each member."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torch import nn

from torch_denkf._checks import check_count, check_shape, check_values
from torch_denkf.modules.tensors import as_standard_deviations
from torch_denkf.submodel import SubModel

__all__ = ["MemberGain"]


class MemberGain(SubModel):
    r"""Applies a fixed gain and offset to each member's prediction: :math:`\hat y^i c e^{\sigma z^i} + n b^i`.

    A camera that is mounted too low has a constant scale error of the speed. As white noise, such an error would
    average out over time, and the filter would become overconfident; or the noise model would become too large, and the
    filter too slow. Here the :math:`z^i` are fixed normal quantiles of E members: each member keeps its gain, so that
    the ensemble keeps the calibration uncertainty. Put it after the observation model.

    An analysis moves member i towards the reading y divided by the member's gain.

    For a mean of y, the mean of the inverse gains must be 1, so :math:`c = \frac{1}{E} \sum_i e^{-\sigma z^i}`. Without
    c, the speed would be too high by the factor c, about :math:`e^{\sigma^2 / 2}`, and the path too long. The offsets
    :math:`b^i` are normal quantiles in another order. They represent a constant bias that does not scale with the
    reading, as of a turn rate. A pair of frames n steps apart has the offset n times.

    Args:
        std: standard deviation :math:`\sigma` of the logarithm of the factor, for each observation dimension ``[O]``,
            before training; it is learned.
        ensemble_size: E.
        offset_std: standard deviation of the offset ``[O]``, in the observation's units; by default zero.
        seed: seed of the order of the quantiles, which differs for each dimension.
        in_key: predictions of the members, ``[*B, E, O]``.
        out_key: key of the output; by default ``in_key``.
        steps_key: optional n ``[*B, 1]``; 1 by default.

    Raises:
        ValueError: if a standard deviation is not positive, that of an offset is negative, or the number of members
            differs.

    Source: Consider parameters (Schmidt 1966), whose uncertainty is modelled without estimating them, as an ensemble.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({("forecast", "observation"): torch.full((4, 1), 10.0)})
        >>> predicted = MemberGain([0.1], ensemble_size=4)(td)["forecast", "observation"].flatten()
        >>> predicted.sort().values.round(decimals=1), (1 / predicted).mean()
        (tensor([ 8.8000,  9.7000, 10.4000, 11.5000], grad_fn=...), tensor(0.1000, grad_fn=...))
    """

    def __init__(
        self,
        std: Sequence[float] | torch.Tensor,
        *,
        ensemble_size: int = 32,
        offset_std: Sequence[float] | torch.Tensor | None = None,
        seed: int = 0,
        in_key: NestedKey = ("forecast", "observation"),
        out_key: NestedKey | None = None,
        steps_key: NestedKey = "steps",
    ):
        out_keys = [in_key if out_key is None else out_key]
        super().__init__(nn.Identity(), [in_key], out_keys, optional_keys=[steps_key])
        std = as_standard_deviations("std", std)
        check_values("std, a standard deviation,", std, above=0)
        check_count("ensemble_size", ensemble_size, least=2)
        self.log_std = nn.Parameter(std.log())
        generator = torch.Generator().manual_seed(seed)
        levels = (torch.arange(ensemble_size, dtype=std.dtype) + 0.5) / ensemble_size
        quantiles = torch.special.ndtri(levels)
        quantiles = quantiles / quantiles.square().mean().sqrt()  # to variance one
        orders = [torch.randperm(ensemble_size, generator=generator) for _ in std]
        self.register_buffer("quantiles", torch.stack([quantiles[order] for order in orders], -1))
        offset_std = torch.zeros_like(std) if offset_std is None else as_standard_deviations("offset_std", offset_std)
        check_shape("offset_std", offset_std, tuple(std.shape), "[O]")
        self.register_buffer("offset_std", offset_std)
        orders = [torch.randperm(ensemble_size, generator=generator) for _ in std]
        self.register_buffer("offset_quantiles", torch.stack([quantiles[order] for order in orders], -1))

    def compute(self, predicted, steps=None):
        """Returns the predictions with each member's gain and offset."""
        if predicted.shape[-2:] != self.quantiles.shape:
            raise ValueError(
                f"MemberGain was made for predictions [*B, {self.quantiles.shape[0]}, {self.quantiles.shape[1]}], "
                f"ensemble_size by the entries of std; {self.in_keys[0]!r} has shape {list(predicted.shape)}."
            )
        if steps is not None:
            check_shape(str(self.optional_keys[0]), steps, (*predicted.shape[:-2], 1), "[*B, 1]")
            steps = steps.to(predicted.dtype)
        inverse = (-self.log_std.exp() * self.quantiles).exp()
        offset = self.offset_std * self.offset_quantiles
        return predicted * (inverse.mean(-2) / inverse) + (offset if steps is None else steps.unsqueeze(-1) * offset)
