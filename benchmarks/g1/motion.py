"""The motion that all filters learn: rates that last, and a pull to the commands where those are read.

The filters' state is D numbers, and the change of each in the last row. It is trained on states of the training
episodes before any filter is, and further with each filter.
"""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.g1.recordings import JOINTS
from benchmarks.g1.sensors import Statistics
from torch_denkf.training import Stage
from torch_denkf.training.parts import train_part

FADING = 0.98  # of a bias in a row, before training
DELAYS = (0, 2)  # rows: the robot follows a command after some
AHEAD = 8  # rows that the motion runs by itself in training


def with_rates(states: Tensor) -> Tensor:
    """States ``[T, 2D]`` of sequences ``[T, D]``; an episode begins at rest."""
    return torch.cat([states, torch.cat([torch.zeros_like(states[:1]), states.diff(dim=0)])], -1)


def delayed(actions: Tensor) -> Tensor:
    """Commands ``[T, 2D]`` of sequences ``[T, D]``: those of the row, and those of some rows before."""
    rows = torch.arange(len(actions))
    return torch.cat([actions[(rows - delay).clamp_min(0)] for delay in DELAYS], -1)


class Motion(nn.Module):
    r"""One row on.

    .. math:: c_t = d \circ c_{t-1} + \sum_k p_k \circ (u_{t-1-k} - q_{t-1}) + a(q, c, u), \quad q_t = q_{t-1} + c_t

    with the damping d, the pulls p and the acceleration a learned.

    Args:
        facts: statistics of the training episodes.
        actions: whether the commands are read: the last features of the input.
    """

    fading = FADING

    def __init__(self, facts: Statistics, actions: bool = False):
        super().__init__()
        self.actions, size = actions, JOINTS
        self.size, self.read = 2 * size, size
        for name in ("loc", "scale", "rate", "acceleration"):
            self.register_buffer(name, getattr(facts, name)[:size].clone())
        self.damping = nn.Parameter(torch.full((size,), 3.0))  # of it the sigmoid
        self.pull = nn.Parameter(torch.zeros(len(DELAYS), size)) if actions else None
        inputs = 2 * size + len(DELAYS) * size * actions
        self.accelerate = nn.Sequential(
            nn.Linear(inputs, 48), nn.Tanh(), nn.Linear(48, 48), nn.Tanh(), nn.Linear(48, size)
        )
        nn.init.zeros_(self.accelerate[-1].weight)
        nn.init.zeros_(self.accelerate[-1].bias)

    def forward(self, features: Tensor) -> Tensor:
        """States ``[*, 2D]`` of states ``[*, 2D]``, or of states and commands ``[*, 4D]``."""
        size = self.read
        place, rates = features[..., :size], features[..., size : 2 * size]
        parts = [(place - self.loc) / self.scale, (rates / (3 * self.rate)).tanh()]
        wanted = self.damping.sigmoid() * rates
        if self.actions:
            way = features[..., 2 * size :].unflatten(-1, (len(DELAYS), size)) - place.unsqueeze(-2)
            parts.append((way / (5 * self.rate)).tanh().flatten(-2))
            wanted = wanted + (self.pull * way).sum(-2)
        rates = wanted + self.acceleration * self.accelerate(torch.cat(parts, -1))
        return torch.cat([place + rates, rates], -1)


class BiasedReading(nn.Module):
    """h: the joints, with the sensor's errors of them where the state holds those."""

    def forward(self, state: Tensor) -> Tensor:
        """Readings ``[*, D]`` of states ``[*, 2D or 3D]``."""
        place, bias = state[..., :JOINTS], state[..., 2 * JOINTS :]
        return place + bias if bias.shape[-1] else place


class MotionLoss(nn.Module):
    """Absolute errors of some rows from true states, in the numbers' accelerations."""

    def __init__(self, motion: Motion):
        super().__init__()
        self.motion = motion

    def forward(self, rows: TensorDict) -> dict[str, Tensor]:
        """Scores stretches ``[N, AHEAD + 1]``."""
        size = self.motion.read
        state, terms = rows["motion"][:, 0], []
        for step in range(AHEAD):
            inputs = torch.cat([state, rows["action"][:, step]], -1) if self.motion.actions else state
            state = self.motion(inputs)
            error = (state - rows["motion"][:, step + 1])[:, :size].abs() / self.motion.acceleration
            terms.append(error.mean() / (step + 1))
        return {"loss_motion": torch.stack(terms).mean()}


def train_motion(
    motion: Motion, sequences: list[tuple[Tensor, Tensor]], *, out: Path, seed: int, updates: int
) -> Motion:
    """Trains the motion on true states ``[T, D]`` and commands ``[T, D]``, or reads it where that was done."""
    full = torch.cat([torch.cat([with_rates(state), delayed(action)], -1) for state, action in sequences])
    lengths = torch.tensor([len(state) for state, _ in sequences])
    starts = lengths.cumsum(0) - lengths
    begins = torch.cat([start + torch.arange(n - AHEAD) for start, n in zip(starts, lengths, strict=True)])
    held = len(begins) - max(int(0.1 * len(begins)), 1)  # the last episodes

    def stretches(index: Tensor) -> TensorDict:
        rows = full[begins[index].unsqueeze(-1) + torch.arange(AHEAD + 1)]
        width = motion.size
        return TensorDict({"motion": rows[..., :width], "action": rows[..., width:]}, batch_size=rows.shape[:2])

    def sample(generator: torch.Generator, length: int | None) -> TensorDict:
        return stretches(torch.randint(held, (256,), generator=generator))

    loss, checked = MotionLoss(motion), stretches(torch.arange(held, len(begins))[::7])
    return train_part(
        motion,
        Stage("motion", loss, sample, updates, lr=5e-3),
        out=out,
        validate=lambda: {"error": float(loss(checked)["loss_motion"])},
        validate_every=max(updates // 4, 1),
        save_every=max(updates // 2, 1),
        seed=seed,
        device="cpu",
    )
