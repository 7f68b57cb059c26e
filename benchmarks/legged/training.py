"""Learned contacts, trained through a filter, and a recurrent network in the filter's place."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from benchmarks.legged.task import ROWS, Robot, scores
from torch_denkf import Filter
from torch_denkf.applications.legged import LearnedContacts, LeggedNoises, legged_filter

__all__ = ["LSTM", "VELOCITY", "learned_contacts", "trained_lstm"]

VELOCITY, VAR = ("belief", "velocity"), ("belief", "velocity_var")
_MOMENTS = [("belief", "mean"), ("belief", "cov")]
_SETTLING = 10  # rows of a window that are not scored: its belief comes from another filter
_AGAIN = 35  # updates after which windows get new beliefs to start from


def learned_contacts(
    robot: Robot, validation: Robot, noises: LeggedNoises, updates: int, window: int
) -> LearnedContacts:
    """Trains contacts through the extended filter, by the likelihood of the base's true velocity.

    An update takes a window of each run. It begins with the belief that the filter had there when it last filtered all
    runs. Those of validation are filtered with them, and what the network was when it did best there is kept.

    Args:
        robot: with the logs of the training.
        validation: with other logs of the same length.
        noises: of the filter; the network begins with what they say of feet.
        updates: of the network.
        window: rows.
    """
    contacts = LearnedContacts(robot.model, **robot.names, rows=ROWS, rate=noises.rate, slip=noises.slip)
    contacts.standardise(robot.log)
    filter = legged_filter(robot.model, **robot.names, dt=robot.dt, kind="EKF", noises=noises, contacts=contacts)
    optimiser = torch.optim.Adam(contacts.parameters(), 3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
    best, kept, count = float("inf"), contacts.state_dict(), len(robot.log)
    both = torch.cat([robot.log, validation.log])
    for update in range(updates + 1):
        if update % _AGAIN == 0 or update == updates:
            belief = _beliefs(filter, both)
            found = scores(validation, *(belief[key[1]][count:] for key in (VELOCITY, VAR)))
            print(f"learned contacts, update {update}: validation {found}", flush=True)
            if found["nll"] < best:
                best, kept = found["nll"], {key: value.clone() for key, value in contacts.state_dict().items()}
        if update == updates:
            break
        firsts = torch.randint(1, robot.log.shape[1] - window + 1, (count,)).tolist()
        part = torch.stack([robot.log[run, first : first + window] for run, first in enumerate(firsts)])
        part["previous", "belief"] = torch.stack(
            [belief[run, first - 1 : first - 1 + window] for run, first in enumerate(firsts)]
        ).select(*(key[1] for key in _MOMENTS))
        out = filter.sequence(part, keep=[VELOCITY, VAR])
        loss = _nll(out[VELOCITY], out[VAR], part["true", "velocity"])[:, min(_SETTLING, window // 2) :].mean()
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(contacts.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        if update % 10 == 0:
            print(f"learned contacts, update {update}: {loss.item():.3f}", flush=True)
    contacts.load_state_dict(kept)
    return contacts.requires_grad_(False)


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


def trained_lstm(robot: Robot, validation: Robot, contacts: LearnedContacts, updates: int, window: int = 200) -> LSTM:
    """Trains it on the same logs, by the same likelihood; what it was when it did best in validation is kept.

    Args:
        robot: with the logs of the training.
        validation: with other logs.
        contacts: whose features it reads.
        updates: each by one window of all runs, in which the memory begins empty.
        window: rows.
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
        part = slice(first, first + window)
        loss = _nll(*network(features[:, part]), true[:, part])[:, min(_SETTLING, window // 2) :].mean()
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


@torch.no_grad()
def _beliefs(filter: Filter, log: TensorDict) -> TensorDict:
    return filter.sequence(log.clone(), keep=[*_MOMENTS, VELOCITY, VAR])["belief"]
