r"""Spaces of states and readings: numbers, angles, rotations, motions, and products of them.

A *point* is the stored form of a state. A *tangent* is a small step from a point, with one component per degree of
freedom; errors and covariances are tangents. One convention holds everywhere but in :class:`Opposite`:

.. math:: x \oplus d = x \, \exp(d), \qquad x \ominus y = \log(y^{-1} x),

a step is applied on the right, in the axes of its start. So :math:`y \oplus (x \ominus y) = x`.

A rotation is a unit quaternion with w first, as MuJoCo stores it; it takes the body's axes to the world's. A quaternion
and its negative are the same rotation. Orientation comes first in points and in tangents.

Source: Solà, Deray & Atchuthan 2018, arXiv:1812.01537 (all but SE23); Barrau & Bonnabel 2017, IEEE T-AC 62 (SE23);
Barfoot 2017, State Estimation for Robotics, eq. 7.86 (the Jacobian's lower block).
"""

from torch_denkf.functional.manifolds.flat import Circle as Circle
from torch_denkf.functional.manifolds.flat import Euclidean as Euclidean
from torch_denkf.functional.manifolds.flat import Flat as Flat
from torch_denkf.functional.manifolds.products import Opposite as Opposite
from torch_denkf.functional.manifolds.products import Place as Place
from torch_denkf.functional.manifolds.products import Product as Product
from torch_denkf.functional.manifolds.products import Repeated as Repeated
from torch_denkf.functional.manifolds.products import places_of as places_of
from torch_denkf.functional.manifolds.products import whole_parts as whole_parts
from torch_denkf.functional.manifolds.quaternions import quaternion_of as quaternion_of
from torch_denkf.functional.manifolds.quaternions import quaternion_product as quaternion_product
from torch_denkf.functional.manifolds.quaternions import rotate as rotate
from torch_denkf.functional.manifolds.quaternions import rotation_matrix as rotation_matrix
from torch_denkf.functional.manifolds.quaternions import skew as skew
from torch_denkf.functional.manifolds.rotations import SE2 as SE2
from torch_denkf.functional.manifolds.rotations import SE3 as SE3
from torch_denkf.functional.manifolds.rotations import SE23 as SE23
from torch_denkf.functional.manifolds.rotations import SO3 as SO3
from torch_denkf.functional.manifolds.rotations import Turned as Turned
from torch_denkf.functional.manifolds.space import Space as Space
from torch_denkf.functional.manifolds.space import check_space as check_space
from torch_denkf.functional.manifolds.space import is_flat as is_flat
