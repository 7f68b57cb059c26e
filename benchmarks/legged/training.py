"""Learned contacts, trained by how feet move, and a recurrent network in the filter's place."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from benchmarks.legged.task import ROWS, Robot, scores
from torch_denkf.applications.legged import LearnedContacts, LeggedNoises, legged_filter

__all__ = ["CELLS", "LSTM", "VELOCITY", "learned_contacts", "trained_lstm"]

VELOCITY, VAR = ("belief", "velocity"), ("belief", "velocity_var")
CELLS = (48, 48)  # of the learned contacts' networks: their weights take 83 KB
LASTS = (1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 20.0)  # rows for which errors of the learned contacts may last
_SETTLING = 10  # rows of a window that are not scored: the memory begins empty


def learned_contacts(
    robot: Robot, validation: Robot, noises: LeggedNoises, updates: int, batch: int = 512
) -> LearnedContacts:
    """Trains contacts by the likelihood of how standing feet move, and chooses for how long their errors last.

    They last for the fewest rows with which an extended filter's squared error is no more than it expects.

    Args:
        robot: with the logs of the training.
        validation: with other logs, on which that is looked at.
        noises: of the filter.
        updates: of the network.
        batch: rows of an update.
    """
    contacts = LearnedContacts(robot.model, **robot.names, rows=ROWS, rate=noises.rate, num_cells=CELLS)
    rows = robot.log.select("last", "true").flatten()
    contacts.standardise(rows[torch.randint(len(rows), (10_000,))])
    optimiser = torch.optim.Adam(contacts.parameters(), 3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
    for update in range(updates):
        loss = contacts.loss(rows[torch.randint(len(rows), (batch,))])
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(contacts.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        if update % 500 == 0:
            print(f"learned contacts, update {update}: {loss.item():.3f}", flush=True)
    contacts.requires_grad_(False)
    filter = legged_filter(robot.model, **robot.names, dt=robot.dt, kind="EKF", noises=noises, contacts=contacts)
    for lasts in LASTS:
        contacts.lasts.fill_(lasts)
        out = filter.sequence(validation.log.clone(), keep=[VELOCITY, VAR])
        found = scores(validation, out[VELOCITY], out[VAR])
        print(f"errors last {lasts:g} rows: validation {found}", flush=True)
        if found["nees"] <= 1:
            break
    return contacts


class LSTM(nn.Module):
    """Velocity of the base and its variances, by what the learned contacts read of the last row.

    Args:
        contacts: whose features it reads.
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
        """Features ``[R, T, N]`` of a log."""
        keys = ("imu", "joints", "joint_rates", "contact")
        return self.contacts[0].features(*(log[key] for key in keys), rows=1).flatten(-2)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Velocities and variances ``[R, T, 3]``."""
        mean, spread = self.head(self.memory((features - self.loc) / self.scale)[0]).split(3, -1)
        return mean, F.softplus(spread) + 1e-5


def trained_lstm(
    robot: Robot, validation: Robot, contacts: LearnedContacts, updates: int, window: int = 200, batch: int = 24
) -> LSTM:
    """Trains it on the same logs, by the same likelihood; what it was when it did best in validation is kept.

    Args:
        robot: with the logs of the training.
        validation: with other logs.
        contacts: whose features it reads.
        updates: each by one window of some runs, in which the memory begins empty.
        window: rows.
        batch: runs of an update.
    """
    network, window = LSTM(contacts), min(window, robot.log.shape[1])
    features, true = network.read(robot.log), robot.log["true", "velocity"]
    network.loc.copy_(features.mean((0, 1)))
    network.scale.copy_(features.std((0, 1)).clamp(min=1e-3))
    optimiser = torch.optim.Adam(network.parameters(), 3e-3, weight_decay=1e-5)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
    best, kept = float("inf"), network.state_dict()
    for update in range(updates):
        first = int(torch.randint(0, features.shape[1] - window + 1, ()))
        part = torch.randperm(len(features))[:batch], slice(first, first + window)
        loss = _nll(*network(features[part]), true[part])[:, min(_SETTLING, window // 2) :].mean()
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        if update % 50 == 49 or update == updates - 1:
            with torch.no_grad():
                found = scores(validation, *network(network.read(validation.log)))
            if found["nll"] < best:
                best, kept = found["nll"], {key: value.clone() for key, value in network.state_dict().items()}
                print(f"LSTM, update {update}: validation {found['velocity']:.3f} m/s", flush=True)
    network.load_state_dict(kept)
    return network


def _nll(velocity: Tensor, var: Tensor, true: Tensor) -> Tensor:
    return 0.5 * ((velocity - true).square() / var + var.log())
