"""Quaternions, w first, and rotation matrices."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_denkf.functional.kernels.small_system import made_once

__all__ = ["quaternion_of", "quaternion_product", "rotate", "rotation_matrix", "skew"]


class Table:
    """Picks numbers ``[*, M]`` of ``[*, N]``, times factors: a matrix of a few numbers in two calls.

    Args:
        places: of the numbers among the N.
        factors: M of them.
    """

    def __init__(self, places: Sequence[int], factors: Sequence[float]):
        self.places, self.factors = list(places), list(factors)

    def __call__(self, numbers: Tensor) -> Tensor:
        """Returns the numbers."""
        dtype, device = numbers.dtype, numbers.device
        places = made_once((self, device), lambda: torch.as_tensor(self.places, device=device))
        factors = made_once((self, dtype, device), lambda: torch.as_tensor(self.factors, dtype=dtype, device=device))
        return numbers.index_select(-1, places) * factors


#: The matrix of products with a quaternion; its conjugate; its products with i, j and k; and that of cross products.
_TIMES = Table([0, 1, 2, 3, 1, 0, 3, 2, 2, 3, 0, 1, 3, 2, 1, 0], [1, -1, -1, -1, 1, 1, -1, 1, 1, 1, 1, -1, 1, -1, 1, 1])
_BACK = Table([0, 1, 2, 3], [1, -1, -1, -1])
_TURNS = Table([1, 2, 3, 0, 3, 2, 3, 0, 1, 2, 1, 0], [-1, -1, -1, 1, -1, 1, 1, 1, -1, -1, 1, 1])
_CROSS = Table([0, 2, 1, 2, 0, 0, 1, 0, 0], [0, -1, 1, 1, 0, -1, -1, 1, 0])
#: The rotation matrix without the identity: twice two products each.
_FIRST = Table(
    [2, 3, 1, 0, 1, 0, 1, 0, 1, 3, 2, 0, 1, 0, 2, 0, 1, 2],
    [-1, -1, 1, -1, 1, 1, 1, 1, -1, -1, 1, -1, 1, -1, 1, 1, -1, -1],
)
_SECOND = Table([2, 3, 2, 3, 3, 2, 2, 3, 1, 3, 3, 1, 3, 2, 3, 1, 1, 2], [2] * 18)


def quaternion_product(first: Tensor, second: Tensor) -> Tensor:
    """Multiplies quaternions ``[*, 4]``, w first: the rotation ``second``, then ``first``."""
    return (torch.unflatten(_TIMES(first), -1, (4, 4)) * second.unsqueeze(-2)).sum(-1)


def rotate(quaternion: Tensor, vector: Tensor, *, back: bool = False) -> Tensor:
    """Rotates a vector ``[*, 3]`` from the body's axes to the world's by a quaternion ``[*, 4]``; or ``back``."""
    w, axis = quaternion[..., :1], quaternion[..., 1:]
    twice = 2 * _cross(axis, vector)
    return torch.addcmul(vector, w, twice, value=-1 if back else 1) + _cross(axis, twice)


def _cross(first: Tensor, second: Tensor) -> Tensor:
    if second.ndim == 1:  # torch pads no dimensions
        second = second.expand_as(first)
    elif first.ndim != second.ndim:
        first, second = torch.broadcast_tensors(first, second)
    return torch.linalg.cross(first, second)


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """Returns the matrix ``[*, 3, 3]`` of a quaternion ``[*, 4]``: its columns are the body's axes in the world's."""
    terms = torch.unflatten(_FIRST(quaternion) * _SECOND(quaternion), -1, (3, 3, 2))
    return terms.sum(-1) + torch.eye(3, dtype=quaternion.dtype, device=quaternion.device)


def quaternion_of(matrix: Tensor) -> Tensor:
    """Returns a quaternion ``[*, 4]`` of a rotation matrix ``[*, 3, 3]``, by the largest of its four numbers."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrix.unbind(-2))
    candidates = [
        torch.stack([1 + a + e + i, h - f, c - g, d - b], -1),
        torch.stack([h - f, 1 + a - e - i, b + d, c + g], -1),
        torch.stack([c - g, b + d, 1 - a + e - i, f + h], -1),
        torch.stack([d - b, c + g, f + h, 1 - a - e + i], -1),
    ]
    table = torch.stack(candidates, -2)  # each row is 4 q_k q
    best = table.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = table.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    return unit(row)


def skew(vector: Tensor) -> Tensor:
    """Returns the matrix ``[*, 3, 3]`` whose product with another vector is the cross product with it."""
    return torch.unflatten(_CROSS(vector), -1, (3, 3))


def products(point: Tensor) -> Tensor:
    """Returns the products of a point's quaternion with i, j and k, ``[*, 4, 3]``."""
    return torch.unflatten(_TURNS(point), -1, (4, 3))


def conjugate(quaternion: Tensor) -> Tensor:
    return _BACK(quaternion)


def unit(quaternion: Tensor) -> Tensor:
    return quaternion / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)
