"""Base of all known motions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from torch_denkf._checks import check_values
from torch_denkf.functional.manifolds import Product, Space
from torch_denkf.modules.tensors import as_vector
from torch_denkf.motions.time_step import check_dt, for_members, keys_of_dt
from torch_denkf.submodel import SubModel, Transition

__all__ = ["Motion", "carried", "corner", "densities", "integrated", "walked"]


class Motion(Transition):
    """A known motion of states that are points of a space.

    A subclass writes :meth:`move` and :meth:`noise_of_step`.

    Args:
        space: of the states, P numbers a point and D a tangent.
        dt: time step in seconds, or the key of an entry ``[*B, 1]`` with the seconds since the last step.
        actions: the keys of what drives the motion, and how many numbers each has.
        in_key: the belief's ensemble ``[*B, E, P]``.
        out_key: the forecast ensemble ``[*B, E, P]``.
    """

    space: Product

    def __init__(
        self,
        space: Product,
        dt: float | NestedKey,
        actions: dict[NestedKey, int],
        in_key: NestedKey,
        out_key: NestedKey,
    ):
        check_dt(dt)
        super().__init__(nn.Identity(), [in_key, *actions, *keys_of_dt(dt)], [out_key])
        self.space, self.dt, self.actions = space, dt, actions
        self.tangents_of, self._timed = (space, space), bool(keys_of_dt(dt))

    def move(self, *values: Any, **_: Any) -> Tensor:
        """Returns the states ``[*, P]`` one step later.

        Args:
            *values: the states ``[*, P]``, then the actions ``[*, A]``.
            **_: ``dt``, seconds, a number or ``[*, 1]``.
        """
        raise NotImplementedError

    def gradient(self, *values: Any, **_: Any) -> Tensor:
        """Returns the Jacobian ``[*, D, D]`` of :meth:`move`, between tangents, from the same values; optional."""
        raise NotImplementedError

    def move_and_gradient(self, *values: Any, **dt: Any) -> tuple[Tensor, Tensor]:
        """Returns both, which may share computations."""
        return self.move(*values, **dt), self.gradient(*values, **dt)

    def noise_of_step(self, dt: Any) -> list:
        """Returns the standard deviations ``[D]`` that a step of ``dt`` seconds adds, in the space's tangents.

        They are numbers, or tensors of the shape of ``dt``, if that is a tensor.
        """
        raise NotImplementedError

    @property
    def process_noise(self) -> list[float] | SubModel:
        """Returns the process noise of a step, in the space's tangents: the noise to give to a filter.

        Standard deviations ``[D]``; where the motion reads the length of each step, a module that writes the variances
        of that step.

        Raises:
            ValueError: if no noise was given.
        """
        if not any(self.noise_of_step(1.0)):
            raise ValueError(
                f"{type(self).__name__} was given no noise, so that a filter would trust it blindly: pass its "
                "arguments ..._noise."
            )
        return self.noise_of_step(self.dt) if isinstance(self.dt, (int, float)) else NoiseOfStep(self)

    def compute(self, ensemble, *others):
        """Returns the forecast ensemble."""
        actions, dt = self._drivers(ensemble, *others)
        return self.move(ensemble, *actions, dt=dt)

    def jacobian(self, ensemble, *others):
        """Returns the forecast ensemble, and the Jacobian between tangents."""
        actions, dt = self._drivers(ensemble, *others)
        return self.move_and_gradient(ensemble, *actions, dt=dt)

    def _drivers(self, ensemble: Tensor, *others: Tensor) -> tuple[list[Tensor], Any]:
        """Returns the actions and the length of the step, next to an ensemble."""
        actions: list[Any]
        dt: Any
        *actions, dt = others if self._timed else (*others, self.dt)
        self.space.check(point=ensemble)
        for (key, size), action in zip(self.actions.items(), actions, strict=True):
            if action.shape[-1:] != (size,):
                raise ValueError(f"{key!r} of {type(self).__name__} is [*B, {size}]; got {list(action.shape)}.")
        if isinstance(dt, Tensor):
            if dt.shape[-1:] != (1,):
                raise ValueError(f"{self.dt!r} of {type(self).__name__} is [*B, 1]; got {list(dt.shape)}.")
            dt = dt.to(ensemble.dtype)
        return [action.to(ensemble.dtype).unsqueeze(-2) for action in actions], for_members(dt)


class NoiseOfStep(SubModel):
    """Process noise of a motion whose steps differ in length: the variances of each step, ``[*B, D]``.

    Args:
        motion: reads its time step from an entry.
        out_key: the variances.
    """

    def __init__(self, motion: Motion, out_key: NestedKey = ("forecast", "noise")):
        super().__init__(motion, [("belief", "mean"), *keys_of_dt(motion.dt)], [out_key])

    def compute(self, mean, dt):
        """Returns the variances of the step."""
        dt = dt.to(mean.dtype).squeeze(-1)
        return torch.stack([torch.zeros_like(dt) + each for each in self.module.noise_of_step(dt)], -1).square()


def carried(space: Space, twist: Tensor, dt: Any) -> tuple[Tensor, Tensor]:
    r"""Returns the Jacobians of :math:`x \exp(d)` by x, and by the rate r with :math:`d = r \Delta t`: ``[*, D, D]``.

    Args:
        space: of x.
        twist: :math:`d`, ``[*, D]``.
        dt: seconds, a number or ``[*, 1]``.
    """
    rate = space.right_jacobian(twist)
    rate = rate * (dt.unsqueeze(-1) if isinstance(dt, Tensor) else dt)
    return space.adjoint(space.exp(-twist)), rate


def corner(above: Tensor, below: Tensor | None = None) -> Tensor:
    """Returns rows ``[*, N, D]``, and below them those of numbers that a motion does not mix, ``[*, D - N, D - N]``.

    By default these stay as they are.
    """
    if below is None:
        below = torch.eye(above.shape[-1] - above.shape[-2], dtype=above.dtype, device=above.device)
    padded = nn.functional.pad(below, (above.shape[-2], 0))
    return torch.cat([above, padded.expand(*above.shape[:-2], *padded.shape[-2:])], -2)


def densities(name: str, value: float | Sequence[float] | Tensor, size: int) -> list[float]:
    """Returns noise densities, one for each of ``size`` numbers, of one for all or of one for each.

    Raises:
        TypeError: if they are no numbers.
        ValueError: if one is negative or not finite, or they are neither one nor ``size``.
    """
    vector = as_vector(name, torch.as_tensor(value, dtype=torch.float64), size)
    check_values(name, vector, least=0)
    return vector.tolist()


def walked(density: Sequence[float], dt: Any) -> list:
    """Returns the standard deviations of a random walk after ``dt`` seconds."""
    return [each * dt**0.5 for each in density]


def integrated(density: Sequence[float], dt: Any) -> list:
    """Returns the standard deviations of a random walk's integral after ``dt`` seconds.

    They are correlated with those of the walk by .87. In a filter, where the next step moves by what this one has
    drawn, all but the last step's correlation is there.
    """
    return [each * (dt**3 / 3) ** 0.5 for each in density]
