"""Innovations and anomalies for the gain of the ensemble update, in units of the reading's noise."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor


class Whitened(NamedTuple):
    """A whitened reading and the members' predictions; missing components have innovation 0 and variance 1.

    Attributes:
        predicted: HX, ``[*B, E, O]``.
        samples: ỹ, ``[*B, E, O]``, or one for all members, ``[*B, 1, O]``.
        noise: the variances R, ``[*B, O]``.
        innovation: innovation of the means, ``[*B, 1, O]``.
        scale: R^-1/2 / √(E − 1), ``[*B, 1, O]``, the factor of the two below.
        normalised: Y, the anomalies of the predictions, ``[*B, E, O]``.
        mean_shift: the innovation, ``[*B, 1, O]``.
    """

    predicted: Tensor
    samples: Tensor
    noise: Tensor
    innovation: Tensor
    scale: Tensor
    normalised: Tensor
    mean_shift: Tensor


def whiten(predicted: Tensor, samples: Tensor, noise: Tensor, observed: Tensor | None) -> Whitened:
    """Divides all or some of the reading's components by their noise.

    Args:
        predicted: HX, ``[*B, E, O]``.
        samples: ``[*B, E, O]`` or ``[*B, 1, O]``.
        noise: R, ``[*B, O]``.
        observed: boolean, ``[*B, 1]`` or ``[*B, O]``.
    """
    if observed is not None:
        members = observed.unsqueeze(-2)
        predicted, samples = torch.where(members, predicted, 0), torch.where(members, samples, 0)
        noise = torch.where(observed, noise, 1)
    mean = predicted.mean(-2, keepdim=True)
    innovation = samples.mean(-2, keepdim=True) - mean
    scale = (noise * (predicted.shape[-2] - 1)).rsqrt().unsqueeze(-2)
    normalised = (predicted - mean) * scale  # HA, eq. 7
    return Whitened(predicted, samples, noise, innovation, scale, normalised, innovation * scale)


def shift(scheme: str, reading: Whitened, observed: Tensor | None, perturbation: Tensor | None) -> Tensor:
    """Returns the innovations that the gain acts on, one row per member, or one row for all (``"etkf"``)."""
    if scheme == "sensor":
        return (reading.samples - reading.predicted) * reading.scale  # Ỹ − HX, eq. 12
    if scheme == "sakov":
        return reading.mean_shift - reading.normalised / 2
    if scheme == "etkf":
        return reading.mean_shift
    size = reading.predicted.shape[-2]
    draws = torch.randn_like(reading.predicted) if perturbation is None else perturbation
    draws = (draws - draws.mean(-2, keepdim=True)) * (math.sqrt(size) / (size - 1))
    if observed is not None:
        draws = torch.where(observed.unsqueeze(-2), draws, 0)
    return reading.mean_shift - reading.normalised + draws


def scores(square: Tensor, log_det: Tensor, log_noise: Tensor, count: int | Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Returns the normalised innovation squared and the log-likelihood of the innovation, ``[*B, 1]``.

    Args:
        square: mean_shift (I + YᵀY)⁻¹ mean_shiftᵀ.
        log_det: log-determinant of I + YᵀY.
        log_noise: log-determinant of R.
        count: number of observed components.
        size: E.
    """
    nis = square * (size - 1)
    return nis, -0.5 * (nis + log_det + log_noise + count * math.log(2 * math.pi))
