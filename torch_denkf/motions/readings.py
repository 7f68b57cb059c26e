"""Measurement models of a pose: gravity, the magnetic field, the pose itself, landmarks."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from torch_denkf._checks import check_count, check_number, check_values
from torch_denkf.functional.manifolds import SE2, SE3, SE23, SO3, Circle, Euclidean, Product, Space, rotate, skew
from torch_denkf.modules.tensors import register_constant
from torch_denkf.submodel import SubModel

__all__ = ["Gravity", "Magnetic", "PoseOf", "PositionInBody", "RangeBearing"]


class _Reading(SubModel):
    """Base of measurement models h of one part of the state: maps ``[*B, E, P]`` to predicted readings ``[*B, E, Q]``.

    Attributes:
        reading_space: the space of the predicted readings.
    """

    kinds: tuple[type[Space], ...] = (Space,)
    space: Space

    def __init__(self, space: Space, part: int, reading_space: Space | None, in_key: NestedKey, out_key: NestedKey):
        if not isinstance(space, Space):
            raise TypeError(f"space of {type(self).__name__} is that of the states, a Space; got {space!r}.")
        super().__init__(nn.Identity(), [in_key], [out_key])
        parts = space.parts if isinstance(space, Product) else (space,)
        check_count("part", part, least=0, most=len(parts) - 1, cure=f"It is the place of a part of {space}")
        if not isinstance(parts[part], self.kinds):
            names = " or ".join(f"{kind.__name__}()" for kind in self.kinds)
            raise TypeError(f"{type(self).__name__} reads a part that is {names}; part {part} of {space} is none.")
        self.space, self.read_space = space, parts[part]
        self._of_readings(self.read_space if reading_space is None else reading_space)
        self.begin = sum(each.point_dim for each in parts[:part])
        before = sum(each.tangent_dim for each in parts[:part])
        self._beside = before, space.tangent_dim - before - self.read_space.tangent_dim

    def _of_readings(self, space: Space) -> None:
        self.reading_space, self.tangents_of = space, (self.space, space)

    def observe(self, point: Tensor) -> Tensor:
        """Returns the observation ``[*, Q]`` of the part's points ``[*, P]``."""
        raise NotImplementedError

    def gradient(self, point: Tensor, reading: Tensor) -> Tensor:
        """Returns the Jacobian of :meth:`observe`, from tangents of the part to tangents of the reading; optional."""
        raise NotImplementedError

    def compute(self, ensemble, *given):
        """Returns the predicted readings."""
        self.space.check(point=ensemble)
        return self.observe(ensemble.narrow(-1, self.begin, self.read_space.point_dim))

    def jacobian(self, ensemble, *given):
        """Returns the predicted readings and their Jacobian, which is zero outside of the observed part."""
        reading = self.compute(ensemble, *given)
        matrix = self.gradient(ensemble.narrow(-1, self.begin, self.read_space.point_dim), reading)
        return reading, nn.functional.pad(matrix, self._beside) if any(self._beside) else matrix


class PoseOf(_Reading):
    """Observes one part of the state directly, such as its pose: a motion capture system or a satellite receiver.

    The reading is a point of that part's space, ``reading_space``; its noise has the dimension of the tangent space.

    Args:
        space: of the states.
        part: the place of the part in a ``Product``.
        in_key: states to observe ``[*B, E, P]``.
        out_key: predicted readings ``[*B, E, Q]``.

    Example:
        >>> from tensordict import TensorDict
        >>> state = Product(SE2(), Euclidean(3))
        >>> td = TensorDict({("forecast", "ensemble"): torch.arange(6.0).expand(32, 6)})
        >>> PoseOf(state)(td)["forecast", "observation"][0]
        tensor([0., 1., 2.])
    """

    def __init__(
        self,
        space: Space,
        *,
        part: int = 0,
        in_key: NestedKey = ("forecast", "ensemble"),
        out_key: NestedKey = ("forecast", "observation"),
    ):
        super().__init__(space, part, None, in_key, out_key)

    def observe(self, point):
        """Returns the point itself."""
        return point

    def gradient(self, point, reading):
        """Returns the identity."""
        return torch.eye(self.read_space.tangent_dim, dtype=point.dtype, device=point.device)


class Magnetic(_Reading):
    r"""Observes a vector of the world in the body's axes, :math:`R^\top m`: a magnetometer.

    Args:
        space: of the states.
        field: :math:`m` in the world's axes, ``[3]``, in the sensor's unit.
        part: the place of the part with the orientation, ``SO3()``, ``SE3()`` or ``SE23()``, in a ``Product``.
        in_key: states to observe ``[*B, E, P]``.
        out_key: predicted readings ``[*B, E, 3]``.

    Raises:
        TypeError: if the part has no orientation in space.

    Example:
        >>> from tensordict import TensorDict
        >>> north = Magnetic(SO3(), [0.0, 20.0, -40.0])  # microtesla; x points east, z up
        >>> left = SO3().exp(torch.tensor([[0.0, 0.0, torch.pi / 2]]))  # x of the body points north
        >>> north(TensorDict({("forecast", "ensemble"): left}))["forecast", "observation"].round(decimals=3) + 0.0
        tensor([[ 20.,   0., -40.]])
    """

    kinds = (SO3, SE3, SE23)
    field: Tensor

    def __init__(
        self,
        space: Space,
        field: Sequence[float] | Tensor,
        *,
        part: int = 0,
        in_key: NestedKey = ("forecast", "ensemble"),
        out_key: NestedKey = ("forecast", "observation"),
    ):
        super().__init__(space, part, Euclidean(3), in_key, out_key)
        _register_vectors(self, "field", field, [3])

    def observe(self, point):
        """Returns the direction in the body's axes."""
        return rotate(point[..., :4], self.field, back=True)

    def gradient(self, point, reading):
        """Returns the Jacobian: a rotation of the body rotates the vector back."""
        others = self.read_space.tangent_dim - 3
        return nn.functional.pad(skew(reading), (0, others)) if others else skew(reading)


class Gravity(Magnetic):
    """Observes specific force, upwards, in the body's axes: an accelerometer at constant velocity.

    Args:
        space: of the states.
        gravity: in m/s^2; 1 if readings are directions.
        part: the place of the part with the orientation, ``SO3()``, ``SE3()`` or ``SE23()``, in a ``Product``.
        in_key: states to observe ``[*B, E, P]``.
        out_key: predicted readings ``[*B, E, 3]``.

    Raises:
        TypeError: if the part has no orientation in space.

    Example:
        >>> from tensordict import TensorDict
        >>> nose_down = SO3().exp(torch.tensor([[0.0, torch.pi / 2, 0.0]]))  # x points down
        >>> td = TensorDict({("forecast", "ensemble"): nose_down})
        >>> Gravity(SO3(), gravity=1.0)(td)["forecast", "observation"].round(decimals=3) + 0.0
        tensor([[-1.,  0.,  0.]])
    """

    def __init__(
        self,
        space: Space,
        *,
        gravity: float = 9.81,
        part: int = 0,
        in_key: NestedKey = ("forecast", "ensemble"),
        out_key: NestedKey = ("forecast", "observation"),
    ):
        check_number("gravity", gravity, above=0)
        super().__init__(space, [0.0, 0.0, float(gravity)], part=part, in_key=in_key, out_key=out_key)


class PositionInBody(_Reading):
    r"""Observes landmarks in the body's axes, :math:`R^\top (l - p)`: a stereo camera or a lidar.

    Args:
        space: of the states.
        landmark: position in the world, ``[3]``, in the plane ``[2]``; of several landmarks ``[L, 3]`` or ``[L, 2]``.
        landmark_key: instead of ``landmark``, an entry with the positions of each row, ``[*B, 3 L]`` or ``[*B, 2 L]``,
            for landmarks that are recognised; an observed mask ``[*B, O]`` tells which are missing in a row.
        count: L, the number of landmarks in the entry.
        part: the place of the pose, ``SE2()``, ``SE3()`` or ``SE23()``, in a ``Product``.
        in_key: states to observe ``[*B, E, P]``.
        out_key: predicted readings ``[*B, E, 3 L]``, in the plane ``[*B, E, 2 L]``.

    Raises:
        TypeError: if the part is no pose.
        ValueError: if landmarks have another shape, or are given twice or not at all.

    Example:
        >>> from tensordict import TensorDict
        >>> pose = torch.tensor([[torch.pi / 2, 1.0, 0.0]])  # it looks along y
        >>> sees = PositionInBody(SE2(), [1.0, 5.0])
        >>> sees(TensorDict({("forecast", "ensemble"): pose}))["forecast", "observation"].round(decimals=3) + 0.0
        tensor([[5., 0.]])
    """

    kinds: tuple[type[Space], ...] = (SE2, SE3, SE23)
    landmark: Tensor

    def __init__(
        self,
        space: Space,
        landmark: Sequence[float] | Sequence[Sequence[float]] | Tensor | None = None,
        *,
        landmark_key: NestedKey | None = None,
        count: int = 1,
        part: int = 0,
        in_key: NestedKey = ("forecast", "ensemble"),
        out_key: NestedKey = ("forecast", "observation"),
    ):
        super().__init__(space, part, None, in_key, out_key)
        if (landmark is None) == (landmark_key is None):
            raise ValueError(f"{type(self).__name__} takes landmark=, or landmark_key= of an entry that says it.")
        size = 2 if isinstance(self.read_space, SE2) else 3
        if landmark is None:
            check_count("count", count)
            self.in_keys = [in_key, landmark_key]
        else:
            _register_vectors(self, "landmark", landmark, [size], [len(landmark), size])
            count = self.landmark.numel() // size
        self.size, self.count = size, count
        self._of_readings(self.space_of_reading(count))

    def space_of_reading(self, count: int) -> Space:
        """Returns the space of the readings of ``count`` landmarks."""
        return Euclidean(self.size * count)

    def compute(self, ensemble, *given):
        """Returns the predicted readings."""
        self.space.check(point=ensemble)
        point, size = ensemble.narrow(-1, self.begin, self.read_space.point_dim), self.size * self.count
        if not given:
            return self.observe(point)
        if given[0].shape[-1] != size:
            what = f"{self.count} landmarks of {self.size} numbers"
            raise ValueError(f"{self.in_keys[1]!r} is [*B, {size}], {what}; got {list(given[0].shape)}.")
        return self.seen(point, given[0].to(ensemble.dtype).unsqueeze(-2).unflatten(-1, (-1, self.size))).flatten(-2)

    def observe(self, point):
        """Returns the given landmarks in the body's axes, concatenated."""
        return self.seen(point, self.landmark.reshape(-1, self.size)).flatten(-2)

    def gradient(self, point, reading):
        """Returns the Jacobian: landmarks rotate and move opposite to the body."""
        return self._by_pose(reading)

    def _by_pose(self, seen: Tensor) -> Tensor:
        """Returns the Jacobian ``[*, N L, D]`` of landmarks at ``seen`` ``[*, N L]`` in the body's axes."""
        seen = seen.unflatten(-1, (-1, self.size))
        turn = skew(seen) if self.size == 3 else torch.stack([seen[..., 1], -seen[..., 0]], -1).unsqueeze(-1)
        nearer = -torch.eye(self.size, dtype=seen.dtype, device=seen.device).expand(*seen.shape, self.size)
        between = seen.new_zeros(*seen.shape, self.read_space.tangent_dim - turn.shape[-1] - self.size)
        return torch.cat([turn, between, nearer], -1).flatten(-3, -2)

    def seen(self, point: Tensor, landmark: Tensor) -> Tensor:
        """Returns the landmarks ``[*, L, N]`` in the body's axes."""
        away = landmark - point[..., -self.size :].unsqueeze(-2)
        if self.size == 3:
            return rotate(point[..., None, :4], away, back=True)
        cos, sin = point[..., :1].cos(), point[..., :1].sin()
        x, y = away.unbind(-1)
        return torch.stack([cos * x + sin * y, cos * y - sin * x], -1)


class RangeBearing(PositionInBody):
    """Observes range and bearing of landmarks in the plane; the bearing is positive to the left.

    The reading is a point of ``Product(Euclidean(1), Circle(), ...)``, ``reading_space``: a length and an angle for
    each landmark.

    Args:
        space: of the states.
        landmark: position in the world, ``[2]``; of several landmarks ``[L, 2]``.
        landmark_key: instead of ``landmark``, an entry with the positions of each row, ``[*B, 2 L]``, for landmarks
            that are recognised, by a barcode for example.
        count: L, the number of landmarks in the entry.
        part: the place of the pose, ``SE2()``, in a ``Product``.
        in_key: states to observe ``[*B, E, P]``.
        out_key: predicted readings ``[*B, E, 2 L]``: range in the unit of length, and bearing in rad.

    Raises:
        TypeError: if the part is no pose in the plane.
        ValueError: if landmarks have another shape, or are given twice or not at all.

    Example:
        >>> from tensordict import TensorDict
        >>> pose = torch.tensor([[0.0, 1.0, 0.0]])
        >>> td = TensorDict({("forecast", "ensemble"): pose, "post": torch.tensor([1.0, 5.0])})
        >>> RangeBearing(SE2(), landmark_key="post")(td)["forecast", "observation"]
        tensor([[5.0000, 1.5708]])
    """

    kinds = (SE2,)

    def space_of_reading(self, count):
        """Returns the product of a length and an angle for each landmark."""
        return Product(*[Euclidean(1), Circle()] * count)

    def seen(self, point, landmark):
        """Returns ranges and bearings; they and their gradients are zero at the landmark itself."""
        away = super().seen(point, landmark)
        there = (away == 0).all(-1, keepdim=True)
        away = torch.where(there, torch.ones_like(away), away)
        polar = torch.stack([torch.linalg.vector_norm(away, dim=-1), torch.atan2(away[..., 1], away[..., 0])], -1)
        return torch.where(there, torch.zeros_like(polar), polar)

    def gradient(self, point, reading):
        """Returns the Jacobian by the chain rule: range and bearing by position in the body, times the base class's."""
        distance, angle = reading.unflatten(-1, (-1, 2)).unbind(-1)
        ahead = torch.stack([angle.cos(), angle.sin()], -1)
        across = torch.stack([-ahead[..., 1], ahead[..., 0]], -1) / torch.where(distance == 0, 1, distance)[..., None]
        rows = torch.stack([ahead, across], -2) * (distance != 0)[..., None, None]
        turned = self._by_pose((distance[..., None] * ahead).flatten(-2)).unflatten(-2, (-1, 2))
        return (rows @ turned).flatten(-3, -2)


def _register_vectors(module: nn.Module, name: str, value: Sequence | Tensor, *shapes: list[int]) -> None:
    """Registers a constant, and checks that it is finite and has one of the shapes.

    Raises:
        ValueError: if it has another shape.
    """
    register_constant(module, name, value)
    found = getattr(module, name)
    if list(found.shape) not in shapes:
        raise ValueError(f"{name} is {' or '.join(map(str, shapes))}; got {list(found.shape)}.")
    check_values(name, found)
