r"""Motion of a body by its gyro and its accelerometer.

Source: Forster, Carlone, Dellaert & Scaramuzza 2017, IEEE T-RO 33 (the model); Fourmy, Flayols, Léziart, Mansard & Solà
2021, ICRA, and Brossard, Barrau, Chauchat & Bonnabel 2022, IEEE T-RO 38 (the exact integrals).
"""

from __future__ import annotations

from torch import Tensor, cat

from torch_denkf._checks import check_shape
from torch_denkf.functional.manifolds import SE23, SO3, rotate
from torch_denkf.functional.manifolds.rotations import bend, fourth, half_versine, one_minus_sinc, series

__all__ = ["move_inertially"]


def move_inertially(pose: Tensor, rate: Tensor, force: Tensor, dt: float | Tensor, gravity: float = 9.81) -> Tensor:
    r"""The pose of a body after a step in which its rate of turn and its specific force are constant in its own axes.

    With rate :math:`\omega`, specific force :math:`f` and gravity :math:`g`, both axes and world as in
    :mod:`torch_denkf.functional.manifolds`:

    .. math::
        R' &= R \exp(\omega \Delta t) \\
        v' &= v + g \Delta t + R \, \Gamma_1(\omega \Delta t) \, f \Delta t \\
        p' &= p + v \Delta t + g \Delta t^2 / 2 + R \, \Gamma_2(\omega \Delta t) \, f \Delta t^2

    :math:`\Gamma_k` is the integral of the turn, taken k times. No step is too long: nothing is cut off. The earth does
    not turn.

    Args:
        pose: orientation, velocity in m/s and position in m, points ``[*, 10]`` of ``SE23``.
        rate: in rad/s, the body's axes, ``[*, 3]``.
        force: specific force in m/s^2, the body's axes, ``[*, 3]``: at rest it is ``gravity`` upwards.
        dt: seconds, a number or ``[*, 1]``.
        gravity: in m/s^2, along the world's -z.

    Returns:
        The pose ``[*, 10]`` at the step's end.

    Raises:
        ValueError: if a shape is wrong.

    Example:
        >>> import torch
        >>> still, up = torch.zeros(3), torch.tensor([0.0, 0.0, 9.81])
        >>> move_inertially(SE23().neutral(), still, up, 1.0)[4:]
        tensor([0., 0., 0., 0., 0., 0.])
        >>> move_inertially(SE23().neutral(), still, still, 1.0)[4:]  # it falls
        tensor([ 0.0000,  0.0000, -9.8100,  0.0000,  0.0000, -4.9050])
    """
    SE23().check(point=pose)
    for name, value in (("rate", rate), ("force", force)):
        check_shape(name, value, [*value.shape[:-1], 3], "[*, 3]")
    orientation, velocity, position = pose[..., :4], pose[..., 4:7], pose[..., 7:]
    angles = rate * dt
    square = angles.square().sum(-1, keepdim=True)
    third = series(square, one_minus_sinc)
    once = bend(angles, force * dt, series(square, half_versine), third)
    twice = bend(angles, 0.5 * force * dt, 2 * third, 2 * series(square, fourth))
    fall = pose.new_tensor([0.0, 0.0, -gravity]) * dt
    turned = SO3().compose(orientation, SO3().exp(angles))
    moved = position + (velocity + 0.5 * fall + rotate(orientation, twice)) * dt
    return cat([turned, velocity + fall + rotate(orientation, once), moved], -1)
