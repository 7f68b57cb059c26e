"""Motions driven by a gyro and an accelerometer.

Source: Forster, Carlone, Dellaert & Scaramuzza 2017, IEEE T-RO 33 (the model); Fourmy, Flayols, Léziart, Mansard & Solà
2021, ICRA, and Brossard, Barrau, Chauchat & Bonnabel 2022, IEEE T-RO 38 (the exact integrals).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torch import Tensor

from torch_denkf._checks import check_number, check_shape
from torch_denkf.functional.manifolds import SE23, SO3, Euclidean, Product, rotate, rotation_matrix, skew
from torch_denkf.functional.manifolds.rotations import (
    Function,
    bend,
    fifth,
    fourth,
    half_versine,
    one_minus_sinc,
    several,
)
from torch_denkf.motions.motion import Motion, corner, densities, integrated, walked

__all__ = ["AttitudeMotion", "InertialMotion", "move_inertially"]


class InertialMotion(Motion):
    r"""Inertial navigation: orientation, velocity and position, driven by gyro and accelerometer.

    The state is a point of ``Product(SE23(), Euclidean(3), Euclidean(3))``, 16 numbers: orientation, velocity in m/s
    and position in m, both in the world's axes; then the biases of the gyro, in rad/s, and of the accelerometer, in
    m/s^2, both in the body's axes. The tangent has 15 components, three for each of these.

    The readings are inputs of the motion, not of an analysis: the mean over the step. For sensors that are sampled at
    the beginning and the end of a step, use the mean of both: the error of a step is then of third order in its length.
    An accelerometer reads specific force: at rest it reads ``gravity`` upwards.

    The integration is exact where rate and specific force are constant in the body's axes, see
    :func:`move_inertially`. The body is where the accelerometer sits.

    Noises are the densities in data sheets. Conversions from degrees and micro-g: 0.005 deg/s/sqrt(Hz) is 8.7e-5
    rad/s/sqrt(Hz), and 400 ug/sqrt(Hz) is 3.9e-3 m/s^2/sqrt(Hz).

    Args:
        dt: time step in seconds, or the key of an entry ``[*B, 1]`` with the seconds since the last step.
        gyro_noise: density of the gyro's white noise in rad/s/sqrt(Hz); a number, or one for each axis.
        accelerometer_noise: in m/s^2/sqrt(Hz).
        gyro_walk: of the random walk of its bias, in rad/s^2/sqrt(Hz): standard deviation after a second, in rad/s.
        accelerometer_walk: in m/s^3/sqrt(Hz).
        gravity: in m/s^2; the world's z points up.
        imu_key: entry ``[*B, 6]``: the gyro in rad/s, then the accelerometer in m/s^2, in the body's axes.
        gyro_key: entry ``[*B, 3]``, where both have entries of their own.
        accelerometer_key: entry ``[*B, 3]``, likewise.
        in_key: the belief's ensemble ``[*B, E, 16]``.
        out_key: forecast ensemble ``[*B, E, 16]``.

    Raises:
        ValueError: if ``dt`` or a noise is negative, or only one sensor has a key of its own.

    Source:
        Forster et al. 2017, IEEE T-RO 33 (model and noises); Brossard et al. 2022, IEEE T-RO 38 (integration).

    Example:
        >>> from tensordict import TensorDict
        >>> motion = InertialMotion(0.01, gyro_noise=8.7e-5, accelerometer_noise=3.9e-3)
        >>> state = motion.space.neutral().expand(32, 16)
        >>> imu = torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 9.81])  # ahead with 1 m/s^2
        >>> moved = motion(TensorDict({("belief", "ensemble"): state, "imu": imu}))["forecast", "ensemble"]
        >>> moved[0, 4:7]
        tensor([0.0100, 0.0000, 0.0000])
        >>> len(motion.process_noise)
        15
    """

    def __init__(
        self,
        dt: float | NestedKey,
        *,
        gyro_noise: float | Sequence[float] | Tensor = 0.0,
        accelerometer_noise: float | Sequence[float] | Tensor = 0.0,
        gyro_walk: float | Sequence[float] | Tensor = 0.0,
        accelerometer_walk: float | Sequence[float] | Tensor = 0.0,
        gravity: float = 9.81,
        imu_key: NestedKey = "imu",
        gyro_key: NestedKey | None = None,
        accelerometer_key: NestedKey | None = None,
        in_key: NestedKey = ("belief", "ensemble"),
        out_key: NestedKey = ("forecast", "ensemble"),
    ):
        check_number("gravity", gravity)
        actions = {imu_key: 6}
        if gyro_key is not None and accelerometer_key is not None:
            actions = {gyro_key: 3, accelerometer_key: 3}
        elif gyro_key is not None or accelerometer_key is not None:
            raise ValueError("InertialMotion needs gyro_key and accelerometer_key, or imu_key alone, which holds both.")
        super().__init__(Product(SE23(), Euclidean(3), Euclidean(3)), dt, actions, in_key, out_key)
        self.gravity = float(gravity)
        self.gyro_noise = densities("gyro_noise", gyro_noise, 3)
        self.accelerometer_noise = densities("accelerometer_noise", accelerometer_noise, 3)
        self.gyro_walk = densities("gyro_walk", gyro_walk, 3)
        self.accelerometer_walk = densities("accelerometer_walk", accelerometer_walk, 3)

    def move(self, state, *readings, dt):
        """Returns the state moved by the readings without their biases."""
        gyro, accelerometer = readings if len(readings) == 2 else readings[0].split(3, -1)
        pose, gyro_bias, accelerometer_bias = self.space.points(state)
        moved = move_inertially(pose, gyro - gyro_bias, accelerometer - accelerometer_bias, dt, self.gravity)
        return torch.cat([moved, gyro_bias, accelerometer_bias], -1)

    def gradient(self, state, *readings, dt):
        """Returns the Jacobian of the pose by itself and by the biases, which stay."""
        gyro, accelerometer = readings if len(readings) == 2 else readings[0].split(3, -1)
        _, gyro_bias, accelerometer_bias = self.space.points(state)
        rate, force = torch.broadcast_tensors(gyro - gyro_bias, accelerometer - accelerometer_bias)
        return corner(_inertial_jacobian(rate, force, dt))

    def noise_of_step(self, dt):
        """Returns the noise of orientation, velocity, position, the gyro's bias and the accelerometer's."""
        force = self.accelerometer_noise
        moved = walked(self.gyro_noise, dt) + walked(force, dt) + integrated(force, dt)
        return moved + walked(self.gyro_walk, dt) + walked(self.accelerometer_walk, dt)


class AttitudeMotion(Motion):
    r"""Motion of an orientation driven by a gyro: :math:`R' = R \exp((\omega - b) \Delta t)`.

    The state is a point of ``Product(SO3(), Euclidean(3))``, 7 numbers: the orientation, and the gyro's bias, in rad/s.
    The tangent has 6 components. See :class:`InertialMotion` for velocity and position, and for the time of a reading.

    Args:
        dt: time step in seconds, or the key of an entry ``[*B, 1]`` with the seconds since the last step.
        gyro_noise: density of the gyro's white noise in rad/s/sqrt(Hz); a number, or one for each axis.
        gyro_walk: of the random walk of its bias, in rad/s^2/sqrt(Hz): standard deviation after a second, in rad/s.
        gyro_key: entry ``[*B, 3]`` in rad/s, the body's axes.
        in_key: the belief's ensemble ``[*B, E, 7]``.
        out_key: forecast ensemble ``[*B, E, 7]``.

    Raises:
        ValueError: if ``dt`` or a noise is negative.

    Example:
        >>> from tensordict import TensorDict
        >>> motion = AttitudeMotion(0.5, gyro_noise=8.7e-5)
        >>> gyro = torch.tensor([0.0, 0.0, torch.pi])  # half a turn a second, to the left
        >>> state = motion.space.neutral().expand(32, 7)
        >>> moved = motion(TensorDict({("belief", "ensemble"): state, "gyro": gyro}))["forecast", "ensemble"]
        >>> moved[0, :4]  # a quarter turn
        tensor([0.7071, 0.0000, 0.0000, 0.7071])
    """

    def __init__(
        self,
        dt: float | NestedKey,
        *,
        gyro_noise: float | Sequence[float] | Tensor = 0.0,
        gyro_walk: float | Sequence[float] | Tensor = 0.0,
        gyro_key: NestedKey = "gyro",
        in_key: NestedKey = ("belief", "ensemble"),
        out_key: NestedKey = ("forecast", "ensemble"),
    ):
        super().__init__(Product(SO3(), Euclidean(3)), dt, {gyro_key: 3}, in_key, out_key)
        self.gyro_noise = densities("gyro_noise", gyro_noise, 3)
        self.gyro_walk = densities("gyro_walk", gyro_walk, 3)

    def move(self, state, gyro, *, dt):
        """Returns the orientation turned by the reading without its bias."""
        orientation, bias = self.space.points(state)
        return torch.cat([SO3().plus(orientation, (gyro - bias) * dt), bias], -1)

    def move_and_gradient(self, state, gyro, *, dt):
        """Returns the Jacobian by the orientation itself, and by the bias, which stays."""
        orientation, bias = self.space.points(state)
        turn, by_rate = SO3().exp_and_jacobian((gyro - bias) * dt)
        moved = torch.cat([SO3().compose(orientation, turn), bias], -1)
        by_rate = -by_rate * (dt.unsqueeze(-1) if isinstance(dt, Tensor) else dt)
        return moved, corner(torch.cat([rotation_matrix(turn).mT, by_rate], -1))

    def noise_of_step(self, dt):
        """Returns the noise of orientation and bias."""
        return walked(self.gyro_noise, dt) + walked(self.gyro_walk, dt)


def move_inertially(pose: Tensor, rate: Tensor, force: Tensor, dt: float | Tensor, gravity: float = 9.81) -> Tensor:
    r"""Returns the pose after a step of constant angular velocity and specific force in the body's axes.

    With rate :math:`\omega`, specific force :math:`f` and gravity :math:`g`, both axes and world as in
    :mod:`torch_denkf.functional.manifolds`:

    .. math::
        R' &= R \exp(\omega \Delta t) \\
        v' &= v + g \Delta t + R \, \Gamma_1(\omega \Delta t) \, f \Delta t \\
        p' &= p + v \Delta t + g \Delta t^2 / 2 + R \, \Gamma_2(\omega \Delta t) \, f \Delta t^2

    :math:`\Gamma_k` is the k-fold integral of the rotation. The result is exact for steps of any length. The earth's
    rotation is neglected.

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
    half, third, falling = several(angles.square().sum(-1, keepdim=True), half_versine, one_minus_sinc, fourth)
    once = bend(angles, force * dt, half, third)
    twice = bend(angles, 0.5 * force * dt, 2 * third, 2 * falling)
    fall = -gravity * torch.eye(3, dtype=pose.dtype, device=pose.device)[2] * dt
    turned = SO3().compose(orientation, SO3().exp(angles))
    moved = position + (velocity + 0.5 * fall + rotate(orientation, twice)) * dt
    return torch.cat([turned, velocity + fall + rotate(orientation, once), moved], -1)


#: Minus the derivative of ``fourth`` by the angle squared.
_sixth = Function(
    lambda a: (a**2 + 2 * a.cos() - 2) / a**6 - (a - a.sin()) / (2 * a**5),
    (1 / 720, -1 / 20160, 1 / 1209600, -1 / 119750400),
)


def _inertial_jacobian(rate: Tensor, force: Tensor, dt: float | Tensor) -> Tensor:
    """Returns the Jacobian of :func:`move_inertially`, ``[*, 9, 15]``: of the pose's tangent by itself, and by biases.

    Velocity and position are seen from the body's axes, before the step and behind it. What the force adds to the
    velocity is what a twist of turn and force moves a body by; to the position it adds the integral of that.
    """
    angles, impulse = rate * dt, force * dt
    dt = dt.unsqueeze(-1) if isinstance(dt, Tensor) else dt
    square = angles.square().sum(-1, keepdim=True)
    half, third, fall, low, lower = (
        value.unsqueeze(-1) for value in several(square, half_versine, one_minus_sinc, fourth, fifth, _sixth)
    )
    eye = torch.eye(3, dtype=rate.dtype, device=rate.device)
    w, f = skew(angles), skew(impulse)
    w2 = w @ w
    back = eye - (1 - square.unsqueeze(-1) * third) * w + half * w2  # the axes behind the step from those before it
    once, twice = eye + half * w + third * w2, 0.5 * eye + third * w + fall * w2  # of the impulse, and its integral
    by_turn = 2 * w @ f - f @ w
    cross = w @ impulse.unsqueeze(-1)
    again, along = w @ cross, 2 * angles.unsqueeze(-2)
    of_once = ((fall - third / 2) * cross - low * again) @ along - half * f - third * by_turn
    of_twice = -(low * cross + lower * again) @ along - third * f - fall * by_turn
    moved = skew((torch.stack([once, twice], -3) @ impulse[..., None, :, None]).squeeze(-1))
    columns = torch.cat([moved[..., 0, :, :], moved[..., 1, :, :] * dt, of_once, once, dt * of_twice, dt * twice], -1)
    columns = back @ columns
    by_once, by_twice, *by_biases = columns.split([3, 3, 6, 6], -1)
    zero = torch.zeros_like(back)
    rows = [
        [back, zero, zero, -dt * (back @ once), zero],
        [-by_once, back, zero, -dt * by_biases[0]],
        [-by_twice, back * dt, back, -dt * by_biases[1]],
    ]
    return torch.cat([torch.cat(row, -1) for row in rows], -2)
