r"""Localisation: tapers covariances of distant components, which in small ensembles are sampling noise, to zero.

There are two ways. If O x O matrices fit in memory, factors of the covariances are passed to
:func:`~torch_denkf.functional.analyse` as its ``taper``. If they do not, or for an ensemble transform,
each component of the state gets its own analysis, from the observations near it (:func:`letkf`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torch_denkf._checks import check_ensemble, check_mask, check_one_dtype, check_shape
from torch_denkf.functional._whitened import whiten
from torch_denkf.functional.analysis import check_significance, significant
from torch_denkf.functional.linalg import inverse_square_root, solve


def gaspari_cohn(distance: Tensor, radius: float) -> Tensor:
    r"""Returns the taper of Gaspari & Cohn: like a Gaussian near zero, and exactly zero from :math:`2 c` on.

    It is a correlation function (positive definite in up to three dimensions), so that the element-wise product of a
    covariance matrix with it is a covariance matrix.

    Args:
        distance: non-negative, any shape, in any unit.
        radius: standard deviation of the Gaussian with the same curvature at zero, in the same unit;
            :math:`c = \sqrt{10/3}` radius, so that the taper ends at 3.65 radii.

    Returns:
        Factors in [0, 1], of the same shape.

    Raises:
        ValueError: if the radius is not positive.

    Source:
        Gaspari & Cohn 1999, Q. J. R. Meteorol. Soc. 125, eq. 4.10.

    Examples:
        >>> gaspari_cohn(torch.tensor([0.0, 1.0, 2.0, 4.0]), radius=1.0)
        tensor([1.0000, 0.6354, 0.1472, 0.0000])
    """
    if not radius > 0:
        raise ValueError(f"radius must be positive, got {radius}")
    z = distance / (math.sqrt(10 / 3) * radius)
    near = 1 + z.square() * (-5 / 3 + z * (5 / 8 + z * (1 / 2 - z / 4)))
    # z (4 - ...) + 4 - 2/(3 z), as a polynomial over z; clamped away from 0, for finite gradients of both branches.
    far_z = z.clamp(1, 2)
    far = 4 - 2 / (3 * far_z) + far_z * (-5 + far_z * (5 / 3 + far_z * (5 / 8 + far_z * (-1 / 2 + far_z / 12))))
    return torch.where(z < 1, near, torch.where(z < 2, far, 0.0)).clamp(0, 1)


_PAIRS = 2**24  # largest number of distances at a time, in neighbours()


class Neighbours(NamedTuple):
    """The observations near each component of a state.

    Attributes:
        index: indices of the observations, ``[S, L]``, int64; rows with fewer than L are padded.
        taper: their weights in [0, 1], ``[S, L]``; 0 for padding.
    """

    index: Tensor  # type: ignore[assignment]  # replaces tuple.index
    taper: Tensor


def neighbours(
    states: Tensor, observations: Tensor, radius: float, *, period: Tensor | None = None, tile: int = 4096
) -> Neighbours:
    """Finds the observations within the taper's reach of each component of a state.

    Args:
        states: positions of the components, ``[S, D]``, in any unit.
        observations: positions of the observations, ``[O, D]``.
        radius: see :func:`gaspari_cohn`, in the same unit.
        period: ``[D]``, the circumference of each circular coordinate (``inf`` for the others).
        tile: components to process at a time. They are sorted by their first coordinate, and compared with the
            observations within reach of the tile in this coordinate, at most 2²⁴ pairs at a time.

    Returns:
        :class:`Neighbours`, with L the largest count of any component, at least 1.

    Raises:
        ValueError: if the radius is not positive.

    Examples:
        Each of five positions on a circle has its neighbours:

        >>> places = torch.arange(5.0).unsqueeze(-1)
        >>> neighbours(places, places, 0.5, period=torch.tensor([5.0])).index.sort().values.tolist()
        [[0, 1, 4], [0, 1, 2], [1, 2, 3], [2, 3, 4], [0, 3, 4]]
    """
    reach = 2 * math.sqrt(10 / 3) * radius

    def around(offset: Tensor, circle: Tensor | None) -> Tensor:
        offset = offset.abs()
        return offset if circle is None else torch.minimum(offset, circle - offset)

    def tapers(order: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        first, circle = observations[:, 0], None if period is None else period[0]
        for rows in order.split(tile):
            low, high = states[rows[0], 0], states[rows[-1], 0]
            close = around(first - (low + high) / 2, circle) <= (high - low) / 2 * (1 + 1e-5) + reach
            near = close.nonzero().squeeze(-1) if bool(close.any()) else close.new_zeros(1, dtype=torch.int64)
            for part in rows.split(max(_PAIRS // len(near), 1)):
                offset = around(states[part].unsqueeze(1) - observations[near], period)
                yield gaspari_cohn(offset.square().sum(-1).sqrt(), radius), near

    order = states[:, 0].argsort()
    found = _largest(tapers(order))
    back = torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device=order.device))
    return Neighbours(found.index[back], found.taper[back])


def neighbours_of_taper(taper: Tensor, *, tile: int = 4096) -> Neighbours:
    """Returns the observations with a positive taper, for each component of a state.

    Args:
        taper: factors in [0, 1], ``[S, O]``; 0 to ignore an observation. They need not be functions of a
            distance.
        tile: components to process at a time.

    Returns:
        :class:`Neighbours`, with L the largest count of any component, at least 1.

    Raises:
        ValueError: if the taper is not a matrix.

    Examples:
        >>> neighbours_of_taper(torch.tensor([[0.0, 1.0, 0.0], [0.5, 0.0, 0.2]])).index.tolist()
        [[1, 0], [0, 2]]
    """
    if taper.ndim != 2:
        raise ValueError(f"taper must be [S, O], one row per component of the state, got {list(taper.shape)}")
    columns = torch.arange(taper.shape[1], device=taper.device)
    return _largest((part, columns) for part in taper.split(tile))


def _largest(tapers: Iterable[tuple[Tensor, Tensor]]) -> Neighbours:
    """Returns the positive entries of each row, for matrices stacked along rows, and the indices of their columns."""
    rows = []
    for taper, columns in tapers:
        values, places = taper.topk(max(int((taper > 0).sum(-1).max()), 1), dim=-1)
        rows.append((columns[places], values))
    length = max(values.shape[-1] for _, values in rows)
    pad = [(torch.nn.functional.pad(value, (0, length - value.shape[-1])) for value in row) for row in rows]
    return Neighbours(*(torch.cat(column) for column in zip(*pad, strict=True)))


def letkf(
    forecast: Tensor,
    predicted: Tensor,
    observation: Tensor,
    noise: Tensor,
    near: Neighbours,
    *,
    observed: Tensor | None = None,
    significance: float | Tensor | None = None,
    tile: int = 4096,
) -> Tensor:
    r"""Runs the local ensemble transform: a separate analysis of each state component, from the observations near it.

    With :math:`Y_s = \rho_s^{1/2} R^{-1/2} HA / \sqrt{E - 1}` of the observations near component s, its members are
    :math:`\bar x_s + A_s (w + (I + Y_s Y_s^T)^{-1/2})`, where :math:`w = (I + Y_s Y_s^T)^{-1} Y_s d` moves the mean.
    Neighbouring components see nearly the same observations, so that the transform changes slowly in space.

    Args:
        forecast: ``[*B, E, S]`` with E >= 2, in the state's units.
        predicted: the predicted observations, ``[*B, E, O]``, in the sensor's units.
        observation: one value each, ``[*B, O]``.
        noise: variances R, ``[*B, O]``, positive.
        near: the observations of each component, see :func:`neighbours`.
        observed: boolean, ``[*B, 1]`` or ``[*B, O]``; components with False are ignored, and may be NaN.
        significance: weighs each observation also by the significance of its correlation with the component, see
            :func:`~torch_denkf.functional.analysis.significant`: one number, such as 1.5. ``None`` for no such weights.
        tile: components to analyse at a time; memory is ``E * L * tile`` for each element of the batch.

    Returns:
        The analysis ensemble, ``[*B, E, S]``. A component without observations is unchanged, up to rounding.

    Raises:
        ValueError: for shapes that do not fit.

    Source:
        Hunt, Kostelich & Szunyogh 2007, Physica D 230, sections 2.3 and 3 ("R-localisation").

    Examples:
        Two members at -1 and 1, the second component out of reach of the only observation:

        >>> ensemble = torch.tensor([[-1.0, -1.0], [1.0, 1.0]])
        >>> near = neighbours(torch.tensor([[0.0], [9.0]]), torch.tensor([[0.0]]), radius=1.0)
        >>> letkf(ensemble, ensemble[:, :1], torch.tensor([4.0]), torch.tensor([2.0]), near).mean(0).round(decimals=4)
        tensor([2., 0.])
    """
    check_ensemble("forecast", forecast, min_size=2)
    check_one_dtype(forecast=forecast, predicted=predicted, observation=observation, noise=noise)
    check_mask("observed", observed)
    check_significance(significance, forecast.shape[-2])
    batch, (size, dim), count = forecast.shape[:-2], forecast.shape[-2:], predicted.shape[-1]
    check_shape("predicted", predicted, (*batch, size, count), "[*B, E, O]")
    check_shape("observation", observation, (*batch, count), "[*B, O]")
    check_shape("noise", noise, (*batch, count), "[*B, O]")
    check_shape("near.index", near.index, (dim, near.taper.shape[-1]), "[S, L]")
    reading = whiten(predicted, observation.unsqueeze(-2), noise, observed)
    normalised, shift = reading.normalised, reading.mean_shift
    mean = forecast.mean(-2, keepdim=True)
    anomalies = forecast - mean
    eye = torch.eye(size, dtype=forecast.dtype, device=forecast.device)
    moved = []
    for index, taper, part in zip(
        near.index.split(tile), near.taper.split(tile), anomalies.split(tile, dim=-1), strict=True
    ):
        root = taper.to(forecast.dtype).sqrt().unsqueeze(-2)
        local = normalised[..., index].movedim(-3, -2)  # [*B, tile, E, L]
        if significance is not None:
            own = part.mT.unsqueeze(-1)  # [*B, tile, E, 1]
            weight = significant(local.mT @ own, local, own, significance).mT  # [*B, tile, 1, L]
            # The slope of the root at 0 is infinite, and times 0 it would make the gradient NaN.
            root = root * torch.where(weight > 0, torch.where(weight > 0, weight, 1).sqrt(), 0)
        local = local * root
        gram = local @ local.mT
        local_shift = shift[..., index].movedim(-3, -2) * root  # [*B, tile, 1, L]
        weights = solve(gram + eye, local @ local_shift.mT)
        transform = inverse_square_root(gram) + weights  # column i makes member i; w is the same in all
        moved.append((part.movedim(-2, -1).unsqueeze(-2) @ transform).squeeze(-2).movedim(-1, -2))
    return mean + torch.cat(moved, -1)
