"""Learned velocity of each stance foot, by a network that reads the last rows of a legged robot's sensors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import mujoco
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.distributions import MultivariateNormal
from torchrl.envs.transforms import CatFrames, Compose, UnaryTransform

from torch_denkf._checks import check_count, check_number
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.diagnosis import entry_of
from torch_denkf.functional.manifolds import SO3, rotate
from torch_denkf.modules import CholeskyNoise, StochasticMLP
from torch_denkf.submodel import Sensor

__all__ = ["LearnedContacts", "last_rows", "with_last_rows"]

SLIP, MOVES = ("legs", "slip"), ("legs", "moves")
_KEYS = ("imu", "joints", "joint_rates", "contact")


class LearnedContacts(Sensor):
    r"""Predicts mean and covariance of the velocity of each stance foot, which is zero without slip.

    A foot slides or bounces for some rows after touch-down, and longer on ice; then it has little information on the
    base. A small network, shared by the feet, reads the last rows: contact and position of the foot, the velocity of
    the base by this foot and by the mean of all stance feet, and the inertial sensor. Its outputs are the mean and a
    Cholesky factor of the covariance. The filter moves the foot with the mean, also in the observation of its rate.

    It is trained by :meth:`loss`, with the true velocity of the base and without a filter. Its errors are correlated in
    time, so the filter multiplies the covariance by ``lasts``.

    Give it to :func:`~torch_denkf.applications.legged.legged_filter` as ``contacts``. An environment gets the last rows
    from :func:`last_rows`, a log from :func:`with_last_rows`.

    Args:
        model: of the robot, from MJCF or URDF.
        feet: names of sites or bodies, F.
        imu: name of the site or body at which the sensor sits.
        joints: names of the joints in the order of the readings, as for the filter.
        rows: K, number of input rows: the current one and those before it.
        rate: standard deviation of a foot's velocity before training, in m/s.
        lasts: correlation time of the errors in rows; choose it by validation.
        num_cells: hidden layers.

    Reads ``("last", "imu")`` ``[*B, 6 K]``, ``("last", "joints")`` and ``("last", "joint_rates")`` ``[*B, J K]`` and
    ``("last", "contact")`` ``[*B, F K]``, the oldest row first. Writes ``("sensor", "noise")`` ``[*B, 3 F, 3 F]`` in
    m^2/s^2, ``("legs", "slip")`` ``[*B, F]``, the mean of its diagonal for each foot, and ``("legs", "moves")``
    ``[*B, 3 F]`` in m/s. All are in the sensor's axes.

    Source:
        CoCo-InEKF, RSS 2026, has a network give the covariance of each foot's velocity, trained through the filter.
    """

    lasts: Tensor

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        feet: Sequence[str],
        imu: str,
        joints: Sequence[str] | None = None,
        rows: int = 10,
        rate: float = 0.3,
        lasts: float = 20.0,
        num_cells: Sequence[int] = (64, 64),
    ):
        check_count("rows", rows)
        check_number("rate", rate, above=0)
        check_number("lasts", lasts, least=1)
        self.rows, size = rows, 16 * rows
        network = CholeskyNoise(3, r=rate, constant=False, num_cells=num_cells, in_features=size)
        super().__init__(network, [("last", key) for key in _KEYS], [("sensor", "noise"), SLIP, MOVES])
        self.mean = StochasticMLP(size, 3, num_cells, layer="none", output_gain=0.0)
        self.kinematics = LegKinematics(model, feet, imu, joints=joints)
        self.observation_dim = 3 * len(self.kinematics.feet)
        self.register_buffer("lasts", torch.tensor(float(lasts)))

    def compute(self, imu, joints, rates, contact):
        """Returns the covariance, the variance of the feet's random walk, and their mean velocities."""
        mean, cov = self._moments(self.features(imu, joints, rates, contact))
        cov = self.lasts * cov
        feet = torch.eye(cov.shape[-3], dtype=cov.dtype, device=cov.device)
        blocks = torch.einsum("fg,...fij->...figj", feet, cov)
        slip = cov.diagonal(dim1=-2, dim2=-1).mean(-1)
        return blocks.flatten(-4, -3).flatten(-2), slip, mean.flatten(-2)

    def _moments(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mean ``[*B, F, 3]`` and covariance ``[*B, F, 3, 3]`` of each foot's velocity."""
        noise = self.module
        mean = self.mean((features - noise.loc) / noise.scale)
        return mean, noise.compute(features, batch_size=features.shape[:-1])

    def loss(self, log: TensorDictBase) -> Tensor:
        """Returns the mean negative log-likelihood of the true velocities of the standing feet, a scalar.

        Args:
            log: ``[*B]``, rows in any order, with the last rows and ``("true", "velocity")`` of the base ``[*B, 3]`` in
                its own axes, in m/s.

        Raises:
            ValueError: if there is no contact in any row, or an entry is of another size or not finite.
            KeyError: if one is missing.
        """
        cure = "last_rows and with_last_rows make the last rows; the truth is that of a simulator or motion capture."
        keys: list[NestedKey] = [("true", "velocity"), *(("last", key) for key in _KEYS)]
        true, *last = (entry_of(log, key, type(self).__name__, cure) for key in keys)
        for key, value in zip(keys, (true, *last), strict=True):
            check_number(repr(key), value.to(self.lasts.dtype))
        if list(true.shape) != [*log.shape, 3]:
            raise ValueError(f"{keys[0]!r} is [*B, 3] = {[*log.shape, 3]}; got {list(true.shape)}.")
        features, sensor = self.features(*last), self.kinematics.base
        own = features[..., -16:]  # of the newest row
        to_sensor = SO3().inverse(sensor[:4])
        velocity = rotate(to_sensor, true.to(own.dtype)).unsqueeze(-2)
        lever = rotate(to_sensor, sensor[4:]).expand_as(own[..., 10:13])
        moves = velocity + torch.linalg.cross(own[..., 10:13], lever) - own[..., 4:7]
        stands = own[..., 0] > 0
        if not stands.any():
            raise ValueError('No foot stands in these rows, by ("last", "contact"): nothing is to be learned of them.')
        mean, cov = self._moments(features[stands])
        return -MultivariateNormal(mean, cov, validate_args=False).log_prob(moves[stands]).mean()

    def features(
        self, imu: Tensor, joints: Tensor, rates: Tensor, contact: Tensor, *, rows: int | None = None
    ) -> Tensor:
        """Returns the network's inputs for each foot, ``[*B, F, 16 K]``; ``rows`` instead of K."""
        rows, kinematics = self.rows if rows is None else rows, self.kinematics
        like = kinematics.base
        sizes = 6, len(kinematics.joints), len(kinematics.joints), len(kinematics.feet)
        for key, size, value in zip(_KEYS, sizes, (imu, joints, rates, contact), strict=True):
            if value.shape[-1:] != (size * rows,):
                raise ValueError(
                    f"{rows} rows of {key!r} of this robot are [*B, {size * rows}]; got {list(value.shape)}. "
                    "last_rows and with_last_rows make them, with as many rows as LearnedContacts reads."
                )
        imu, joints, rates = (part.to(like.dtype).unflatten(-1, (rows, -1)) for part in (imu, joints, rates))
        stands = contact.to(like.dtype).unflatten(-1, (rows, -1)).unsqueeze(-1)  # [*B, K, F, 1]
        feet = kinematics(joints)
        gyro, force = (part.unsqueeze(-2).expand_as(feet) for part in imu.split(3, -1))
        base = -kinematics.velocities(joints, rates) - torch.linalg.cross(gyro, feet)
        mean = (stands * base).sum(-2, keepdim=True) / stands.sum(-2, keepdim=True).clamp(min=1)
        parts = [stands, feet, base, mean.expand_as(base), gyro, force]
        return torch.cat(parts, -1).transpose(-3, -2).flatten(-2)

    @torch.no_grad()
    def standardise(self, log: TensorDictBase) -> None:
        """Sets mean and scale of the network's inputs, from a log with the last rows."""
        features = self.features(*(log["last", key] for key in _KEYS)).flatten(0, -2)
        self.module.loc.copy_(features.mean(0))
        self.module.scale.copy_(features.std(0).clamp(min=1e-3))


class Variances(Sensor):
    """Variances of learned contacts without correlations, for analyses of ensembles."""

    def __init__(self, contacts: LearnedContacts):
        super().__init__(contacts, contacts.in_keys, contacts.out_keys)
        self.observation_dim = contacts.observation_dim

    def compute(self, *last):
        """Returns the variances ``[*B, 3 F]``, and that of the feet's random walk."""
        cov, *others = self.module.compute(*last)
        return cov.diagonal(dim1=-2, dim2=-1), *others


def check_rows(rows: int, every: int) -> None:
    """Raises unless both are numbers of rows."""
    check_count("rows", rows)
    check_count("every", every)


def last_rows(rows: int, every: int = 1) -> Compose:
    """Returns a transform of an environment that keeps the last rows of the inputs of :class:`LearnedContacts`.

    Args:
        rows: K.
        every: how many rows lie between two of them, and one more.
    """
    check_rows(rows, every)
    keys, picked = [("last", key) for key in _KEYS], partial(_picked, rows=rows, every=every)
    kept = CatFrames((rows - 1) * every + 1, in_keys=list(_KEYS), out_keys=keys, dim=-1, padding="same")
    return Compose(kept, UnaryTransform(keys, keys, fn=picked)) if every > 1 else Compose(kept)


def _picked(frames: Tensor, rows: int, every: int) -> Tensor:
    return frames.unflatten(-1, ((rows - 1) * every + 1, -1))[..., ::every, :].flatten(-2)


def with_last_rows(log: TensorDictBase, rows: int, every: int = 1) -> TensorDictBase:
    """Returns a log ``[*B, T]`` with the last rows of the inputs of :class:`LearnedContacts`.

    The first row is repeated for those before it.

    Args:
        log: with ``"imu"``, ``"joints"``, ``"joint_rates"`` and ``"contact"``.
        rows: K.
        every: how many rows lie between two of them, and one more.
    """
    check_rows(rows, every)
    time = log.shape[-1]
    at = (torch.arange(time).unsqueeze(-1) + every * torch.arange(1 - rows, 1)).clamp(min=0)
    return log.copy().update({("last", key): log[key][..., at, :].flatten(-2) for key in _KEYS})
