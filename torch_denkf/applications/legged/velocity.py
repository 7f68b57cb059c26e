"""Body velocity of a robot's base, from the belief about its inertial sensor."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_denkf.functional.manifolds import rotate, rotation_matrix, skew
from torch_denkf.functional.moments import ensemble_mean, ensemble_var
from torch_denkf.modules import AroundState, GaussianAround, SubModel
from torch_denkf.submodel import Entries

__all__ = ["BaseVelocity", "StartEnsemble", "StartMoments", "base_velocity", "base_velocity_of_moments"]

_KEYS = [("belief", "velocity"), ("belief", "velocity_var")]


def base_velocity(state: Tensor, gyro: Tensor, sensor: Tensor) -> Tensor:
    r"""Returns the velocity of the base's origin in the base's axes, :math:`S R^\top v - S (\omega - b) \times r`.

    Args:
        state: of the sensor ``[*, 16 + 3 F]``, see :class:`~torch_denkf.applications.legged.motion.LeggedSpace`.
        gyro: reading in rad/s, ``[*, 3]``.
        sensor: the sensor's pose S, r on the base ``[7]``.

    Returns:
        ``[*, 3]`` in m/s.
    """
    seen = rotate(state[..., :4], state[..., 4:7], back=True)
    turn = rotate(sensor[:4], gyro - state[..., 10:13])
    return rotate(sensor[:4], seen) - torch.linalg.cross(turn, sensor[4:].expand_as(turn))


def base_velocity_of_moments(mean: Tensor, cov: Tensor, gyro: Tensor, sensor: Tensor) -> tuple[Tensor, Tensor]:
    """Returns mean ``[*, 3]`` and variances ``[*, 3]`` of :func:`base_velocity`, to first order.

    Args:
        mean: ``[*, 16 + 3 F]``.
        cov: of the tangents there ``[*, 15 + 3 F, 15 + 3 F]``.
        gyro: ``[*, 3]`` in rad/s.
        sensor: ``[7]``.
    """
    axes = rotation_matrix(sensor[:4])
    seen = axes @ rotation_matrix(mean[..., :4]).mT  # rotating the world leaves the body velocity as it is
    part = torch.cat([seen, (-skew(sensor[4:]) @ axes).expand_as(seen)], -1)  # by velocity, gyro's bias
    rows = torch.cat([cov[..., 3:6, :], cov[..., 9:12, :]], -2)
    var = (part @ torch.cat([rows[..., 3:6], rows[..., 9:12]], -1) * part).sum(-1)
    return base_velocity(mean, gyro, sensor), var


class BaseVelocity(SubModel):
    """Writes ``("belief", "velocity")`` and ``("belief", "velocity_var")``, ``[*B, 3]``: the base's, in its own axes.

    The velocity of the base is the sensor's, minus the lever-arm term of the base's rotation, which the gyro reads.

    Args:
        sensor: the sensor's pose on the base, ``[7]``.
        gyro_std: standard deviation of the gyro's white noise in one reading, in rad/s.
        ensemble: whether the belief is an ensemble, or a mean and a covariance.
        imu_key: entry ``[*B, 6]``; its first half is the gyro.
    """

    sensor: Tensor
    jitter: Tensor

    def __init__(self, sensor: Tensor, gyro_std: float, *, ensemble: bool, imu_key="imu"):
        belief = [("belief", "ensemble")] if ensemble else [("belief", "mean"), ("belief", "cov")]
        super().__init__(nn.Identity(), [imu_key, *belief], _KEYS)
        self.register_buffer("sensor", sensor.clone(), persistent=False)
        self.register_buffer("jitter", gyro_std**2 * skew(sensor[4:]).square().sum(-1), persistent=False)

    def compute(self, imu, belief, cov=None):
        """Returns velocity and variances."""
        gyro = imu[..., :3].to(belief.dtype)
        if cov is not None:
            velocity, var = base_velocity_of_moments(belief, cov, gyro, self.sensor)
        else:
            members = base_velocity(belief, gyro.unsqueeze(-2), self.sensor)
            velocity, var = ensemble_mean(members), ensemble_var(members)
        return velocity, var + self.jitter

    def derived(self, carried: Entries) -> Entries:
        """Returns velocity and variances of a given belief, with the gyro's reading if there is one, else at rest."""
        belief = [carried[key] for key in self.in_keys[1:]]
        bias = belief[0][..., 10:13]
        still = bias.mean(-2) if len(belief) == 1 else bias
        return dict(zip(_KEYS, self.compute(carried.get(self.in_keys[0], still), *belief), strict=True))


class StartEnsemble(AroundState):
    """Initial ensemble around the start pose of a robot at rest, and the base's velocity.

    Args:
        std: standard deviations of tangents, as of :class:`AroundState`.
        velocity_std: of the base's velocity, in m/s.
        velocity: writes the base's velocity of other beliefs.
        **options: of :class:`AroundState`.
    """

    def __init__(self, std, velocity_std, velocity, **options):
        keys = [("belief", name) for name in ("ensemble", "mean", "var")]
        super().__init__(std, out_keys=[*keys, *_KEYS], **options)
        self.velocity_std, self._velocity = velocity_std, (velocity,)  # a tuple hides the module

    def compute(self, state, *, noise, batch_size):
        """Returns the belief, and the velocity."""
        ensemble, mean, var = super().compute(state, noise=noise, batch_size=batch_size)
        return ensemble, mean, var, *_still(mean, self.velocity_std)

    def derived(self, carried):
        """Returns the velocity of a given belief."""
        return self._velocity[0].derived(carried)


class StartMoments(GaussianAround):
    """Initial mean and covariance around the start pose of a robot at rest, and the base's velocity.

    Args:
        std: standard deviations of tangents, as of :class:`GaussianAround`.
        velocity_std: of the base's velocity, in m/s.
        velocity: writes the base's velocity of other beliefs.
        **options: of :class:`GaussianAround`.
    """

    def __init__(self, std, velocity_std, velocity, **options):
        super().__init__(std, **options)
        keys = [("belief", name) for name in ("mean", "cov", "var")]
        self.out_keys = [*keys, *_KEYS]
        self.velocity_std, self._velocity = velocity_std, (velocity,)

    def compute(self, state):
        """Returns the belief, and the velocity."""
        mean, cov, var = super().compute(state)
        return mean, cov, var, *_still(mean, self.velocity_std)

    def derived(self, carried):
        """Returns the velocity of a given belief."""
        return self._velocity[0].derived(carried)


def _still(mean: Tensor, std: float) -> tuple[Tensor, Tensor]:
    velocity = torch.zeros_like(mean[..., :3])
    return velocity, torch.full_like(velocity, std**2)
