"""Trains learned contacts by the velocities of standing feet, and a recurrent network instead of the filter."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from benchmarks.common.training import random_rows
from benchmarks.legged.task import ROWS, Robot, scores
from torch_denkf.applications.legged import LearnedContacts, LeggedNoises, legged_filter
from torch_denkf.training import Stage
from torch_denkf.training.parts import train_part

__all__ = ["CELLS", "LSTM", "VELOCITY", "learned_contacts", "trained_lstm"]

VELOCITY, VAR = ("belief", "velocity"), ("belief", "velocity_var")
CELLS = (48, 48)  # of the learned contacts' networks: their weights take 83 KB
LASTS = (1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 20.0)  # candidate correlation times of the contacts' errors, in rows
SETTINGS = {"loggers": (), "device": "cpu", "seed": 0}
_SETTLING = 10  # first rows of a window, not scored because the memory begins empty


def learned_contacts(robot: Robot, validation: Robot, noises: LeggedNoises, updates: int, out: Path) -> LearnedContacts:
    """Trains contacts by the likelihood of standing feet's velocities, and chooses their errors' correlation time.

    It is the smallest with which an extended Kalman filter's squared error is no more than its covariance.

    Args:
        robot: with the logs of the training.
        validation: with other logs, for that choice.
        noises: of the filter.
        updates: of the network, each by 512 rows.
        out: folder of the training.
    """
    contacts = LearnedContacts(robot.model, **robot.names, rows=ROWS, rate=noises.rate, num_cells=CELLS)
    rows = robot.log.select("last", "true").flatten()
    contacts.standardise(rows[torch.randint(len(rows), (10_000,))])

    loss = lambda some: {"loss_contacts": contacts.loss(some)}  # noqa: E731
    stage = Stage("contacts", loss, random_rows(rows, 512), updates, lr=3e-3, schedule="cosine")
    train_part(contacts, stage, out=out / stage.name, **SETTINGS)
    contacts.requires_grad_(False)
    filter = legged_filter(robot.model, **robot.names, dt=robot.dt, kind="EKF", noises=noises, contacts=contacts)
    for lasts in LASTS:
        contacts.lasts.fill_(lasts)
        found = filter.sequence(validation.log.clone(), keep=[VELOCITY, VAR])
        if scores(validation, found[VELOCITY], found[VAR])["nees"] <= 1:
            break
    return contacts


class LSTM(nn.Module):
    """LSTM that estimates the base's velocity and its variances, from the learned contacts' features of each row.

    Args:
        contacts: with the features.
        hidden_size: of the memory.
    """

    def __init__(self, contacts: LearnedContacts, hidden_size: int = 64):
        super().__init__()
        self.contacts = [contacts]  # not a part of this network
        self.features = contacts.observation_dim // 3 * 16
        self.memory = nn.LSTM(self.features, hidden_size, batch_first=True)
        self.head = nn.Linear(hidden_size, 6)
        self.register_buffer("loc", torch.zeros(self.features))
        self.register_buffer("scale", torch.ones(self.features))

    def read(self, log: TensorDict) -> Tensor:
        """Returns features ``[R, T, N]`` of a log."""
        keys = ("imu", "joints", "joint_rates", "contact")
        return self.contacts[0].features(*(log[key] for key in keys), rows=1).flatten(-2)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Returns velocities and variances ``[R, T, 3]``."""
        mean, spread = self.head(self.memory((features - self.loc) / self.scale)[0]).split(3, -1)
        return mean, F.softplus(spread) + 1e-5


def trained_lstm(
    robot: Robot, validation: Robot, contacts: LearnedContacts, updates: int, out: Path, window: int = 200
) -> LSTM:
    """Trains the LSTM by the likelihood of the true velocity, and returns the best one in validation.

    Args:
        robot: with the logs of the training.
        validation: with other logs.
        contacts: with the features.
        updates: each by one window of 24 runs, in which the memory begins empty.
        out: folder of the training.
        window: rows.
    """
    network, window = LSTM(contacts), min(window, robot.log.shape[1])
    log = TensorDict({"read": network.read(robot.log), "true": robot.log["true", "velocity"]}, robot.log.shape)
    network.loc.copy_(log["read"].mean((0, 1)))
    network.scale.copy_(log["read"].std((0, 1)).clamp(min=1e-3))

    def sample(generator: torch.Generator, length: int | None) -> TensorDict:
        first = int(torch.randint(0, log.shape[1] - window + 1, (), generator=generator))
        return log[torch.randperm(len(log), generator=generator)[:24], first : first + window]

    def loss(part: TensorDict) -> dict[str, Tensor]:
        velocity, var = network(part["read"])
        nll = 0.5 * ((velocity - part["true"]).square() / var + var.log())
        return {"loss_nll": nll[:, min(_SETTLING, window // 2) :].mean()}

    stage = Stage("lstm", loss, sample, updates, lr=3e-3, weight_decay=1e-5, schedule="cosine")
    check = torch.no_grad()(lambda: {"nll": scores(validation, *network(network.read(validation.log)))["nll"]})
    return train_part(
        network, stage, out=out / stage.name, validate=check, monitor="nll", validate_every=50, **SETTINGS
    )
