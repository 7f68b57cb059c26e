"""Readings of a robot that stands still: an attitude to start from, and where its speed is known to be zero."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf.functional.manifolds import SO3

__all__ = ["attitude_of", "stands_still"]


def attitude_of(acceleration: Tensor, magnetic: Tensor | None = None, *, declination: float = 0.0) -> Tensor:
    """Returns the attitude of a body at rest from its accelerometer, and its magnetometer.

    Args:
        acceleration: specific force in the body's axes ``[*B, 3]``, upwards where it stands still; in any unit.
        magnetic: magnetic field in the body's axes ``[*B, 3]``; without it the body's x axis is taken to point along
            the world's, up to its slope.
        declination: of magnetic north east of the true one, rad.

    Returns:
        Unit quaternions ``[*B, 4]`` from body to world, w first; x points east and z up, and with ``magnetic`` the
        horizontal field points north.

    Example:
        >>> attitude_of(torch.tensor([0.0, 0.0, 9.81]), torch.tensor([0.0, 20.0, -40.0])) + 0.0
        tensor([1., 0., 0., 0.])
    """
    up = acceleration / torch.linalg.vector_norm(acceleration, dim=-1, keepdim=True)
    if magnetic is None:
        ahead = torch.zeros_like(up)
        steep = up[..., 0].abs() > 0.99  # then its y axis tells the direction
        ahead[..., 0], ahead[..., 1] = (~steep).to(up.dtype), steep.to(up.dtype)
        north = torch.linalg.cross(up, ahead)
    else:
        north = magnetic - (magnetic * up).sum(-1, keepdim=True) * up
    north = north - (north * up).sum(-1, keepdim=True) * up
    north = north / torch.linalg.vector_norm(north, dim=-1, keepdim=True)
    rows = torch.stack([torch.linalg.cross(north, up), north, up], -2)  # the world's axes, seen from the body
    turn = SO3().exp(torch.tensor([0.0, 0.0, -declination], dtype=rows.dtype, device=rows.device))
    return SO3().compose(turn, _quaternion(rows)) if declination else _quaternion(rows)


def _quaternion(matrix: Tensor) -> Tensor:
    """Returns the unit quaternion of a rotation matrix ``[*B, 3, 3]``, by its largest component for precision."""
    a, b, c = matrix.diagonal(dim1=-2, dim2=-1).unbind(-1)
    squares = torch.stack([1 + a + b + c, 1 + a - b - c, 1 - a + b - c, 1 - a - b + c], -1)  # four times
    x, y, z = (matrix[..., j, i] - matrix[..., i, j] for i, j in ((1, 2), (2, 0), (0, 1)))
    xy, xz, yz = (matrix[..., i, j] + matrix[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    w, p, q, r = squares.unbind(-1)
    columns = torch.stack([w, x, y, z, x, p, xy, xz, y, xy, q, yz, z, xz, yz, r], -1).unflatten(-1, (4, 4))
    largest = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    found = columns.gather(-2, largest).squeeze(-2)
    found = found / torch.linalg.vector_norm(found, dim=-1, keepdim=True)
    return torch.where(found[..., :1] < 0, -found, found)


def stands_still(
    turn_rate: Tensor, acceleration: Tensor, *, window: int, rate_noise: float, acceleration_noise: float
) -> Tensor:
    """Tells where a robot stands still, so that a reading of zero velocity may be given to the filter.

    The mask is that of a sensor of zeros, such as ``FusedSensor(Select([3]), [0.01], observed_key="still")``. A row
    is still where all readings of the window around it stay within five standard deviations of their mean, and turn
    rates of zero.

    Args:
        turn_rate: rad/s, ``[*B, T, N]``, with little bias.
        acceleration: m/s^2, ``[*B, T, M]``.
        window: rows on either side.
        rate_noise: standard deviation of a turn rate.
        acceleration_noise: likewise, of an acceleration.

    Returns:
        Mask ``[*B, T, 1]``.

    Example:
        >>> wheels = torch.tensor([0.0, 0.0, 0.0, 0.0, 2.0, 2.0]).unsqueeze(-1)
        >>> stands_still(wheels, 0 * wheels, window=1, rate_noise=0.1, acceleration_noise=0.1).squeeze(-1)
        tensor([ True,  True,  True, False, False, False])
    """

    def around(values: Tensor) -> Tensor:
        padded = torch.cat([values[..., :1, :].expand(*values.shape[:-2], window, -1), values], -2)
        padded = torch.cat([padded, values[..., -1:, :].expand(*values.shape[:-2], window, -1)], -2)
        return padded.unfold(-2, 2 * window + 1, 1)

    rates, forces = around(turn_rate), around(acceleration)
    quiet = (rates.abs() < 5 * rate_noise).flatten(-2).all(-1)
    steady = ((forces - forces.mean(-1, keepdim=True)).abs() < 5 * acceleration_noise).flatten(-2).all(-1)
    return (quiet & steady).unsqueeze(-1)
