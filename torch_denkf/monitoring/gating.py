"""How far a reading is believed, from its own and the last innovations."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

__all__ = ["Response", "adapt", "disbelief"]

Response = Literal["reject", "student", "huber"]


def disbelief(evidence: Tensor, limit: Tensor, response: Response, *, freedom: float = 4.0) -> Tensor:
    r"""Factor on a reading's variances: 1 up to the limit, and from there on the larger, the less it is believed.

    ============== ===================================== =============================================================
    response       beyond the limit l                    so that an outlier's pull
    ============== ===================================== =============================================================
    ``"reject"``   infinity                              is none
    ``"student"``  :math:`(\nu + q) / (\nu + l)`         falls with its distance, as under Student's t
    ``"huber"``    :math:`\sqrt{q / l}`                  stays as at the limit, as under Huber's loss
    ============== ===================================== =============================================================

    Args:
        evidence: q, normalised innovations squared, summed over some steps ``[*]``.
        limit: l, what the sum seldom exceeds, broadcasts with it; infinite for a gate that never acts.
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
    r"""One step of stochastic approximation: a factor on a variance grows while innovations are too large.

    :math:`\log \alpha \leftarrow \log \alpha + \eta (\mathrm{nis} / O - 1)` rests where the normalised innovation
    squared has its expected mean O (Robbins & Monro 1951), which it has with the true variance.

    Args:
        log_factor: any shape.
        nis: normalised innovation squared, under the factor.
        freedom: O; where it is 0 nothing changes.
        rate: :math:`\eta`, about the inverse of the steps that are remembered.
        largest: nis / O is held below it, so that one outlier counts little.

    Example:
        >>> adapt(torch.zeros(2), torch.tensor([3.0, 1.0]), torch.ones(2), 0.1)
        tensor([0.2000, 0.0000])
    """
    ratio = (nis / freedom.clamp_min(1)).clamp_max(largest)
    return torch.where(freedom > 0, log_factor + rate * (ratio - 1), log_factor)
