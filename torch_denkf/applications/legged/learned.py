"""How much each standing foot moves, as a network tells it by the last rows of what a legged robot reads."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.transforms import CatFrames

from torch_denkf._checks import check_count, check_number
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.modules import CholeskyNoise, StochasticMLP, SubModel

__all__ = ["LearnedContacts", "last_rows", "with_last_rows"]

SLIP, MOVES = ("legs", "slip"), ("legs", "moves")
_KEYS = ("imu", "joints", "joint_rates", "contact")


class LearnedContacts(SubModel):
    r"""Says of each standing foot how it moves: the covariance of its velocity, which should be zero.

    A foot that has just touched the floor slides or bounces for some rows, and on ice it slides longer. Its rate then
    says little about the base. One small network reads each foot: whether it stood in the last rows, where it was, how
    fast the base is by this foot and by the mean of all that stand, and what the inertial sensor reads. It gives a
    Cholesky factor :math:`L`. The rate of the foot counts with the noise :math:`L L^\top`, and the foot walks at
    random with the mean of that matrix' diagonal times a learned time.

    It is trained through the filter, by how likely the base's true velocity is. Give it to
    :func:`~torch_denkf.applications.legged.legged_filter` as ``contacts``. An environment gets the last rows from
    :func:`last_rows`, a log from :func:`with_last_rows`.

    Args:
        model: of the robot, from MJCF or URDF.
        feet: names of sites or bodies, F.
        imu: name of the site or body at which the sensor sits.
        joints: names of the joints in the order of the readings, as for the filter.
        rows: K, that it reads: this one and those before it.
        rate: standard deviation of a foot's velocity before training, in m/s.
        slip: how a standing foot walks at random before training, in m/sqrt(s).
        num_cells: hidden layers.

    Reads ``("last", "imu")`` ``[*B, 6 K]``, ``("last", "joints")`` and ``("last", "joint_rates")`` ``[*B, J K]`` and
    ``("last", "contact")`` ``[*B, F K]``, the oldest row first. Writes ``("sensor", "noise")`` ``[*B, 3 F, 3 F]`` in
    m^2/s^2, in the sensor's axes, and ``("legs", "slip")`` ``[*B, F]`` in m^2/s.

    Source:
        CoCo-InEKF, RSS 2026, has a network give the covariance of each foot's velocity, trained by squared error.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        feet: Sequence[str],
        imu: str,
        joints: Sequence[str] | None = None,
        rows: int = 5,
        rate: float = 0.3,
        slip: float = 1e-2,
        num_cells: Sequence[int] = (32, 32),
    ):
        check_count("rows", rows)
        check_number("slip", slip, above=0)
        self.rows, size = rows, 16 * rows
        network = CholeskyNoise(3, r=rate, constant=False, num_cells=num_cells, in_features=size)
        super().__init__(network, [("last", key) for key in _KEYS], [("sensor", "noise"), SLIP, MOVES])
        self.mean = StochasticMLP(size, 3, num_cells, layer="none", output_gain=0.0)
        self.kinematics = LegKinematics(model, feet, imu, joints=joints)
        self.observation_dim = 3 * len(self.kinematics.feet)
        self.log_time = nn.Parameter(torch.tensor(2 * math.log(slip / rate)))

    def compute(self, imu, joints, rates, contact):
        """The covariance, how feet walk, and how they move."""
        mean, cov = self.moments(self.features(imu, joints, rates, contact))
        slip = self.log_time.exp() * cov.diagonal(dim1=-2, dim2=-1).mean(-1)
        feet = torch.eye(cov.shape[-3], dtype=cov.dtype, device=cov.device)
        blocks = torch.einsum("fg,...fij->...figj", feet, cov)
        return blocks.flatten(-4, -3).flatten(-2), slip, mean.flatten(-2)

    def moments(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Of each foot's velocity the mean ``[*B, F, 3]`` and the covariance ``[*B, F, 3, 3]``, by its features."""
        noise = self.module
        mean = self.mean((features - noise.loc) / noise.scale)
        return mean, noise.compute(features, batch_size=features.shape[:-1])

    def features(
        self, imu: Tensor, joints: Tensor, rates: Tensor, contact: Tensor, *, rows: int | None = None
    ) -> Tensor:
        """What the network reads of each foot, ``[*B, F, 16 K]``; ``rows`` in the place of K."""
        rows, kinematics = self.rows if rows is None else rows, self.kinematics
        like = kinematics.base
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
        """Sets mean and scale of what the network reads, by a log with the last rows."""
        features = self.features(*(log["last", key] for key in _KEYS)).flatten(0, -2)
        self.module.loc.copy_(features.mean(0))
        self.module.scale.copy_(features.std(0).clamp(min=1e-3))


class Variances(SubModel):
    """The variances alone that learned contacts say, as analyses of ensembles read them."""

    def __init__(self, contacts: LearnedContacts):
        super().__init__(contacts, contacts.in_keys, contacts.out_keys)
        self.observation_dim = contacts.observation_dim

    def compute(self, *last):
        """The variances ``[*B, 3 F]``, and how feet walk."""
        cov, *others = self.module.compute(*last)
        return cov.diagonal(dim1=-2, dim2=-1), *others


def last_rows(rows: int) -> CatFrames:
    """A transform of an environment that keeps the last rows of what :class:`LearnedContacts` reads."""
    options = {"dim": -1, "padding": "same"}
    return CatFrames(rows, in_keys=list(_KEYS), out_keys=[("last", key) for key in _KEYS], **options)


def with_last_rows(log: TensorDictBase, rows: int, every: int = 1) -> TensorDictBase:
    """A log ``[*B, T]`` with the last rows of what :class:`LearnedContacts` reads.

    The first row stands for those before it.

    Args:
        log: with ``"imu"``, ``"joints"``, ``"joint_rates"`` and ``"contact"``.
        rows: K.
    """
    time = log.shape[-1]
    at = (torch.arange(time).unsqueeze(-1) + every * torch.arange(1 - rows, 1)).clamp(min=0)
    return log.copy().update({("last", key): log[key][..., at, :].flatten(-2) for key in _KEYS})
