"""Quaternions, w first, and rotation matrices."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf.functional.kernels.small_system import made_once

__all__ = ["quaternion_of", "quaternion_product", "rotate", "rotation_matrix", "skew"]


def quaternion_product(first: Tensor, second: Tensor) -> Tensor:
    """Multiplies quaternions ``[*, 4]``, w first: the rotation ``second``, then ``first``."""
    a, b = first[..., :1], first[..., 1:]
    c, d = second[..., :1], second[..., 1:]
    w = a * c - (b * d).sum(-1, keepdim=True)
    return torch.cat([w, torch.addcmul(torch.addcmul(_cross(b, d), c, b), a, d)], -1)


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Rotates a vector ``[*, 3]`` from the body's axes to the world's by a quaternion ``[*, 4]``."""
    w, axis = quaternion[..., :1], quaternion[..., 1:]
    twice = 2 * _cross(axis, vector)
    return torch.addcmul(vector, w, twice) + _cross(axis, twice)


def _cross(first: Tensor, second: Tensor) -> Tensor:
    if first.ndim != second.ndim:  # torch pads no dimensions
        first, second = torch.broadcast_tensors(first, second)
    return torch.linalg.cross(first, second)


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """Returns the matrix ``[*, 3, 3]`` of a quaternion ``[*, 4]``: its columns are the body's axes in the world's."""
    axes = torch.eye(3, dtype=quaternion.dtype, device=quaternion.device)
    return rotate(quaternion.unsqueeze(-2), axes).mT


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
    axes = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return _cross(vector.unsqueeze(-2), axes).mT


def products(point: Tensor) -> Tensor:
    """Returns the products of a point's quaternion with i, j and k, ``[*, 4, 3]``."""
    w, x, y, z = point[..., :4].unbind(-1)
    rows = [[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def conjugate(quaternion: Tensor) -> Tensor:
    return quaternion * made_once(("conjugate", quaternion.dtype, quaternion.device), lambda: _signs(quaternion))


def _signs(like: Tensor) -> Tensor:
    return torch.as_tensor([1.0, -1.0, -1.0, -1.0], dtype=like.dtype, device=like.device)


def unit(quaternion: Tensor) -> Tensor:
    return quaternion / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)
