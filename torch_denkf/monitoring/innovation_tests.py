"""Tests of one sensor's last innovations: consistency and whiteness."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_denkf.monitoring.chi_square import chi_square_p_value

__all__ = ["InnovationTests", "InnovationWindow", "innovation_tests", "interpolate", "observe"]


class InnovationWindow(NamedTuple):
    """Statistics of one sensor's last innovations.

    Attributes:
        terms: statistics of the last W observed steps, the latest first, ``[*B, W, 4]``: normalised innovation squared,
            its degrees of freedom, inner product with the previous observed innovation, variance of that product.
        last: last normalised innovation ``[*B, O]``; zero if none was observed.
    """

    terms: Tensor
    last: Tensor


class InnovationTests(NamedTuple):
    """Result of :func:`innovation_tests`, ``[*B, 1]`` each.

    Attributes:
        p_value: p-value of the windowed sum of normalised innovations squared, under its chi-square distribution.
        whiteness: two-sided p-value of the correlation of successive innovations in the window.
    """

    p_value: Tensor
    whiteness: Tensor


def interpolate(value: Tensor, knots: Tensor, heights: Tensor) -> Tensor:
    """Interpolates linearly between knots, and extrapolates linearly beyond them.

    Args:
        value: any shape ``[*]``.
        knots: increasing, ``[N]`` with N >= 2; or ``[K, N]`` for each component of ``value`` ``[*, K]``.
        heights: values of the function at the knots, of the same shape.

    Example:
        >>> interpolate(torch.tensor([1.0, 8.0, 16.0]), torch.tensor([0.0, 2.0, 8.0]), torch.tensor([0.0, 1.0, 4.0]))
        tensor([0.5000, 4.0000, 8.0000])
    """
    index = (value.detach().unsqueeze(-1) > knots[..., 1:-1]).sum(-1, keepdim=True)
    ends = [_at(part, at) for part in (knots, heights) for at in (index, index + 1)]
    share = (value - ends[0]) / (ends[1] - ends[0])
    return ends[2] + share * (ends[3] - ends[2])


def _at(table: Tensor, index: Tensor) -> Tensor:
    """Returns entries of ``[N]`` or ``[K, N]`` at ``[*, 1]`` or ``[*, K, 1]``."""
    return table.expand(*index.shape[:-1], table.shape[-1]).gather(-1, index).squeeze(-1)


def observe(
    window: InnovationWindow, nis: Tensor, innovation: Tensor, freedom: Tensor, scale: Tensor | float = 1.0
) -> InnovationWindow:
    """Returns the window after one more step; unchanged if nothing is observed.

    The normalised innovation is approximated: it has the direction of the innovation in units of ``scale``, and the
    square root of ``nis`` as norm. With one component this is exact for any scale.

    Args:
        window: window of the steps before.
        nis: normalised innovation squared ``[*B, 1]``.
        innovation: ``[*B, O]``, 0 if not observed.
        freedom: observed components ``[*B, 1]``.
        scale: typical size of the innovation's components, ``[O]``.
    """
    seen = freedom > 0
    direction = torch.where(seen, innovation / scale, 0)
    square = direction.square().sum(-1, keepdim=True)
    there = seen & (square > 0) & (nis > 0)  # the root has no finite slope at zero
    length = torch.where(there, torch.where(there, nis, 1) / torch.where(there, square, 1), 1).sqrt()
    normalised = torch.where(there, direction * length, 0)
    product = (normalised * window.last).sum(-1, keepdim=True)
    variance = ((normalised != 0) & (window.last != 0)).sum(-1, keepdim=True).to(nis.dtype)
    term = torch.stack([nis, freedom, product, variance], -1)
    terms = torch.where(seen.unsqueeze(-1), torch.cat([term, window.terms[..., :-1, :]], -2), window.terms)
    return InnovationWindow(terms, torch.where(seen, normalised, window.last))


def innovation_tests(window: InnovationWindow) -> InnovationTests:
    """Returns p-values of a window's innovations; 1 before the first observation.

    Example:
        >>> terms = torch.tensor([[3.0, 2.0, 0.0, 0.0], [5.0, 2.0, 2.8, 2.0]])  # 8 with 4 degrees of freedom
        >>> tests = innovation_tests(InnovationWindow(terms, torch.zeros(2)))
        >>> tests.p_value.round(decimals=4), tests.whiteness.round(decimals=4)
        (tensor([0.0916]), tensor([0.0477]))
    """
    nis, freedom, product, variance = window.terms.sum(-2).split(1, -1)
    known = variance > 0
    z = torch.where(known, product / torch.where(known, variance, 1).sqrt(), 0)
    return InnovationTests(chi_square_p_value(nis, freedom), torch.special.erfc(z.abs() / 2**0.5))
