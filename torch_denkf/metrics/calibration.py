"""Does the spread of an ensemble say how wrong its mean is?"""

from __future__ import annotations

import torch

__all__ = ["spread_skill_ratio"]


def spread_skill_ratio(
    mean: torch.Tensor, variance: torch.Tensor, truth: torch.Tensor, ensemble_size: int | None = None
):
    r"""Spread over skill, :math:`\sqrt{\frac{E+1}{E}\,\overline{s^2}} / \mathrm{RMSE}`: one for a calibrated ensemble.

    The truth of a calibrated ensemble is one more draw from its distribution; its squared distance from the mean of E
    members is then (E+1)/E times their variance, on average.

    Args:
        mean: of the ensemble, ``[*B, S]``.
        variance: of the ensemble with divisor E-1, ``[*B, S]``.
        truth: ``[*B, S]``, in the same units.
        ensemble_size: E; ``None`` for a distribution whose moments are exact.

    Returns:
        One ratio a state dimension, ``[S]``.

    Raises:
        ValueError: if the shapes differ.

    Reference:
        Fortin et al., "Why should ensemble spread match the RMSE of the ensemble mean?", J. Hydrometeorol. 15, 2014.

    Example:
        >>> rng = torch.Generator().manual_seed(0)
        >>> draws = torch.randn(10000, 9, 1, generator=rng)  # eight members and the truth
        >>> members, truth = draws[:, :8], draws[:, 8]
        >>> spread_skill_ratio(members.mean(1), members.var(1), truth, 8).round(decimals=1)
        tensor([1.])
    """
    if not mean.shape == variance.shape == truth.shape:
        shapes = [list(part.shape) for part in (mean, variance, truth)]
        raise ValueError(f"mean, variance and truth need one shape; got {shapes}.")
    factor = 1.0 if ensemble_size is None else (ensemble_size + 1) / ensemble_size
    batch = tuple(range(mean.ndim - 1))
    return (factor * variance.mean(batch)).sqrt() / (mean - truth).square().mean(batch).sqrt()
