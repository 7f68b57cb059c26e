"""Quaternions, w first, and rotation matrices."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf.functional.kernels.small_system import made_once

__all__ = ["quaternion_of", "quaternion_product", "rotate", "rotation_matrix", "skew"]


class Table:
    """Selects components ``[*, M]`` from ``[*, N]`` and multiplies by signs: builds a small matrix in two calls.

    Args:
        places: indices of the components among the N, M digits.
        signs: M of ``+``, ``-`` and ``0``.
    """

    def __init__(self, places: str, signs: str):
        self.places, self.signs = list(map(int, places)), [{"+": 1.0, "-": -1.0, "0": 0.0}[sign] for sign in signs]

    def __call__(self, numbers: Tensor) -> Tensor:
        """Returns the selected components times their signs."""
        if torch.compiler.is_compiling():  # inductor (torch 2.13) changes the indices
            return torch.stack([sign * numbers[..., at] for at, sign in zip(self.places, self.signs, strict=True)], -1)
        dtype, device = numbers.dtype, numbers.device
        places = made_once((self, device), lambda: torch.as_tensor(self.places, device=device))
        signs = made_once((self, dtype, device), lambda: torch.as_tensor(self.signs, dtype=dtype, device=device))
        return numbers.index_select(-1, places) * signs


#: Tables for the matrix of quaternion products, the conjugate, products with i, j and k, and cross products.
_TIMES = Table("0123103223013210", "+---++-++++-+-++")
_BACK = Table("0123", "+---")
_TURNS = Table("123032301210", "---+-+++--++")
_CROSS = Table("021200100", "0-++0--+0")
#: Tables of two factors: a rotation matrix is the identity plus twice the sum of two products each.
_FIRST, _SECOND = Table("231010101320102012", "--+-++++--+-+-++--"), Table("232332231331323112", "+" * 18)
#: Table of a rotation's right Jacobian without its third term, to apply to a quaternion times 2 sin(a/2) / a.
BENT = Table("032301210", "++--+++-+")


def quaternion_product(first: Tensor, second: Tensor) -> Tensor:
    """Multiplies quaternions ``[*, 4]``, w first: the rotation ``second``, then ``first``."""
    return (torch.unflatten(_TIMES(first), -1, (4, 4)) * second.unsqueeze(-2)).sum(-1)


def rotate(quaternion: Tensor, vector: Tensor, *, back: bool = False) -> Tensor:
    """Rotates a vector ``[*, 3]`` from the body's axes to the world's by a quaternion ``[*, 4]``, or ``back``."""
    w, axis = quaternion[..., :1], quaternion[..., 1:]
    twice = 2 * _cross(axis, vector)
    return torch.addcmul(vector, w, twice, value=-1 if back else 1) + _cross(axis, twice)


def _cross(first: Tensor, second: Tensor) -> Tensor:
    if second.ndim == 1:  # torch.linalg.cross adds no dimensions
        second = second.expand_as(first)
    elif first.ndim != second.ndim:
        first, second = torch.broadcast_tensors(first, second)
    return torch.linalg.cross(first, second)


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """Returns the matrix ``[*, 3, 3]`` of a quaternion ``[*, 4]``: its columns are the body's axes in the world's."""
    terms = torch.unflatten(_FIRST(quaternion) * _SECOND(quaternion), -1, (3, 3, 2))
    return torch.add(torch.eye(3, dtype=quaternion.dtype, device=quaternion.device), terms.sum(-1), alpha=2)


def quaternion_of(matrix: Tensor) -> Tensor:
    """Returns a quaternion ``[*, 4]`` of a rotation matrix ``[*, 3, 3]``, by the largest of its four components."""
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
