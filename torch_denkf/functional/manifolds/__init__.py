r"""Spaces that states and readings live in: numbers, angles, rotations, motions, and products of them.

A *point* is how a state is stored. A *tangent* is a small step from a point, in as many numbers as the space has
directions; errors and covariances are in them. One convention holds everywhere but in :class:`Opposite`:

.. math:: x \oplus d = x \, \exp(d), \qquad x \ominus y = \log(y^{-1} x),

a step is applied on the right, in the axes of the point it starts from. So :math:`y \oplus (x \ominus y) = x`.

A rotation is a unit quaternion with w first, as MuJoCo stores it; it takes the body's axes to the world's. A quaternion
and its negative are the same rotation. Orientation stands first in points and in tangents.

Source: Solà, Deray & Atchuthan 2018, arXiv:1812.01537 (all but SE23); Barrau & Bonnabel 2017, IEEE T-AC 62 (SE23);
Barfoot 2017, State Estimation for Robotics, eq. 7.86 (the Jacobian's lower block).
"""

from torch_denkf.functional.manifolds.flat import Circle, Euclidean, Flat
from torch_denkf.functional.manifolds.products import Opposite, Product, Repeated
from torch_denkf.functional.manifolds.products import Place as Place
from torch_denkf.functional.manifolds.products import places_of as places_of
from torch_denkf.functional.manifolds.products import whole_parts as whole_parts
from torch_denkf.functional.manifolds.quaternions import (
    quaternion_of,
    quaternion_product,
    rotate,
    rotation_matrix,
    skew,
)
from torch_denkf.functional.manifolds.rotations import SE2, SE3, SE23, SO3, Turned
from torch_denkf.functional.manifolds.space import Space
from torch_denkf.functional.manifolds.space import check_space as check_space
from torch_denkf.functional.manifolds.space import is_flat as is_flat

__all__ = [
    "SE2",
    "SE3",
    "SE23",
    "SO3",
    "Circle",
    "Euclidean",
    "Flat",
    "Opposite",
    "Product",
    "Repeated",
    "Space",
    "Turned",
    "quaternion_of",
    "quaternion_product",
    "rotate",
    "rotation_matrix",
    "skew",
]
