"""Gating of a reading by its own and the previous innovations."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

__all__ = ["Response", "adapt", "disbelief"]

Response = Literal["reject", "student", "huber"]


def disbelief(evidence: Tensor, limit: Tensor, response: Response, *, freedom: float = 4.0) -> Tensor:
    r"""Returns the factor on a reading's variances: 1 up to the limit, and growing with the evidence beyond it.

    ============== ===================================== =============================================================
    response       beyond the limit l                    influence of an outlier
    ============== ===================================== =============================================================
    ``"reject"``   infinity                              none
    ``"student"``  :math:`(\nu + q) / (\nu + l)`         falls with its distance, as for Student's t
    ``"huber"``    :math:`\sqrt{q / l}`                  constant beyond the limit, as for Huber's loss
    ============== ===================================== =============================================================

    Args:
        evidence: q, sum of normalised innovations squared over some steps ``[*]``.
        limit: l, threshold of the sum, broadcasts with it; infinite for a gate that never acts.
        response: one of the three.
        freedom: :math:`\nu` of Student's t; positive.

    Raises:
        ValueError: for an unknown response.

    Example:
        >>> q = torch.tensor([1.0, 16.0])
        >>> [disbelief(q, torch.tensor(4.0), response).tolist() for response in ("reject", "student", "huber")]
        [[1.0, inf], [1.0, 2.5], [1.0, 2.0]]
    """
    if response not in get_args(Response):
        raise ValueError(f"response is one of {', '.join(get_args(Response))}; got {response!r}")
    if response == "reject":
        return torch.where(evidence > limit, torch.inf, 1.0).to(evidence.dtype)
    ratio = (evidence - limit).clamp_min(0) / (limit + (freedom if response == "student" else 0.0))
    return 1 + ratio if response == "student" else (1 + ratio).sqrt()


def adapt(log_factor: Tensor, nis: Tensor, freedom: Tensor, rate: float, *, largest: float = 9.0) -> Tensor:
    r"""Adapts a factor on a variance by one step of stochastic approximation; it grows while innovations are too large.

    :math:`\log \alpha \leftarrow \log \alpha + \eta (\mathrm{nis} / O - 1)` is stationary if the normalised innovation
    squared has the mean O (Robbins & Monro 1951), as with the true variance.

    Args:
        log_factor: any shape.
        nis: normalised innovation squared, under the factor.
        freedom: O; with 0 the factor does not change.
        rate: :math:`\eta`, about the inverse of the memory in steps.
        largest: upper bound of nis / O, which limits the influence of an outlier.

    Example:
        >>> adapt(torch.zeros(2), torch.tensor([3.0, 1.0]), torch.ones(2), 0.1)
        tensor([0.2000, 0.0000])
    """
    ratio = (nis / freedom.clamp_min(1)).clamp_max(largest)
    return torch.where(freedom > 0, log_factor + rate * (ratio - 1), log_factor)
