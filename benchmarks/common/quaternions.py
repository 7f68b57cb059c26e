"""Quaternions in plain numpy, w first, for attitude filters that share no code with the library.

Source: Solà 2017, arXiv:1711.02508.
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray


def product(a: ndarray, b: ndarray) -> ndarray:
    """Multiplies quaternions, ``[*, 4]``, and normalises the product."""
    w = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdims=True)
    xyz = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    found = np.concatenate([w, xyz], -1)
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def exp(angles: ndarray) -> ndarray:
    """Maps rotation vectors in rad, ``[*, 3]``, to quaternions."""
    half = np.linalg.norm(angles, axis=-1, keepdims=True) / 2
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * angles], -1)


def matrix(q: ndarray) -> ndarray:
    """Maps quaternions to rotation matrices, ``[*, 3, 3]``."""
    cross = skew(q[..., 1:])
    return np.eye(3) + 2 * q[..., :1, None] * cross + 2 * cross @ cross


def right_jacobian(angles: ndarray) -> ndarray:
    """Returns the right Jacobian of small rotations, up to the fourth power."""
    cross, square = skew(angles), (angles**2).sum(-1)[..., None, None]
    return np.eye(3) - (1 / 2 - square / 24) * cross + (1 / 6 - square / 120) * cross @ cross


def skew(v: ndarray) -> ndarray:
    """Returns the matrix whose product with a vector is the cross product."""
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape[:-1], 3, 3)
