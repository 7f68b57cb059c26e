"""Motions of arms: networks that are first trained on true states, and then further with each filter."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.common.arm import JOINTS
from torch_denkf.training import Stage
from torch_denkf.training.parts import train_part


def with_rates(states: Tensor, order: int) -> Tensor:
    """Returns states ``[*, T, D]`` with their first and second differences in time; an episode begins at rest."""
    parts, values = [states], states[..., :JOINTS]
    for _ in range(order):
        values = torch.cat([torch.zeros_like(values[..., :1, :]), values.diff(dim=-2)], -2)
        parts.append(values)
    return torch.cat(parts, -1)


class ArmMotion(nn.Module):
    """Motion over one row, with a network that predicts the change of the rates.

    Args:
        inputs: dimension of the network's input.
        **units: buffers; ``acceleration`` is the unit of the loss.

    Attributes:
        size: dimension of the state.
        read: number of its first components that the sensor reads.
        fading: decay factor of the sensor's bias per row, before training.
        actions: whether commands follow the state in the input.
        scored: components of the state in the loss.
    """

    size: int
    read: int
    fading: float
    actions = False
    scored: slice

    def __init__(self, inputs: int, **units: Tensor):
        super().__init__()
        for name, value in units.items():
            self.register_buffer(name, value.clone())
        self.accelerate = nn.Sequential(
            nn.Linear(inputs, 48), nn.Tanh(), nn.Linear(48, 48), nn.Tanh(), nn.Linear(48, JOINTS)
        )
        nn.init.zeros_(self.accelerate[-1].weight)
        nn.init.zeros_(self.accelerate[-1].bias)

    def losses(self, rows: TensorDict) -> dict[str, Tensor]:
        """Returns absolute errors of A steps, the k-th weighted by 1 / k, on true states, ``"path"`` ``[N, A + 1, S]``.

        Commands, if any, follow the states.
        """
        path, terms = rows["path"], []
        state = path[:, 0, : self.size]
        for step in range(1, path.shape[1]):
            state = self(torch.cat([state, path[:, step - 1, self.size :]], -1) if self.actions else state)
            error = (state - path[:, step, : self.size])[:, self.scored].abs() / self.acceleration
            terms.append(error.mean() / step)
        return {"loss_motion": torch.stack(terms).mean()}


class BiasedReading(nn.Module):
    """Measurement model h: the first components of a state, plus the sensor's biases if the state has them."""

    def __init__(self, motion: ArmMotion):
        super().__init__()
        self.read, self.size = motion.read, motion.size

    def forward(self, state: Tensor) -> Tensor:
        """Returns readings ``[*, read]`` of states ``[*, size]`` or ``[*, size + read]``."""
        place, bias = state[..., : self.read], state[..., self.size :]
        return place + bias if bias.shape[-1] else place


class WithBias(nn.Module):
    r"""Motion of a state that includes the sensor's biases, which decay: :math:`b_t = \rho \circ b_{t-1}`.

    The errors of a sensor on consecutive frames are similar. A filter that takes them for white noise becomes ever more
    certain of them; here they are part of the state, and the reading is state plus bias ("coloured measurement noise":
    Bryson & Henrikson 1968).

    Args:
        motion: of the state without biases.
    """

    def __init__(self, motion: ArmMotion):
        super().__init__()
        self.motion = motion
        self.fading = nn.Parameter(torch.full((motion.read,), motion.fading).logit())

    def forward(self, features: Tensor) -> Tensor:
        """Returns the next states ``[*, size + read]`` from such states, or from states and commands."""
        size, whole = self.motion.size, self.motion.size + self.motion.read
        moved = self.motion(torch.cat([features[..., :size], features[..., whole:]], -1))
        return torch.cat([moved, self.fading.sigmoid() * features[..., size:whole]], -1)


def train_motion(
    motion: ArmMotion, sequences: Sequence[Tensor], ahead: int, *, out: Path, seed: int, updates: int
) -> ArmMotion:
    """Trains a motion on sequences ``[T, S]`` of true states, or loads it if it was trained before.

    Args:
        motion: trained in place.
        sequences: states, followed by commands if there are any; the last tenth validates.
        ahead: rows that the motion predicts recursively, because a small error in one row may grow in ten.
        out: folder for checkpoints and logs.
        seed: of all random numbers.
        updates: of 256 stretches each.
    """
    full, lengths = torch.cat(list(sequences)), torch.tensor([len(one) for one in sequences])
    starts = lengths.cumsum(0) - lengths
    begins = torch.cat([start + torch.arange(n - ahead) for start, n in zip(starts, lengths, strict=True)])
    held = len(begins) - max(int(0.1 * len(begins)), 1)

    def stretches(index: Tensor) -> TensorDict:
        return TensorDict({"path": full[begins[index].unsqueeze(-1) + torch.arange(ahead + 1)]}, index.shape)

    def sample(generator: torch.Generator, length: int | None) -> TensorDict:
        return stretches(torch.randint(held, (256,), generator=generator))

    checked = stretches(torch.arange(held, len(begins))[:: max((len(begins) - held) // 4000, 1)])
    return train_part(
        motion,
        Stage("motion", motion.losses, sample, updates, lr=5e-3),
        out=out,
        validate=lambda: {"error": float(sum(motion.losses(checked).values()))},
        monitor="error",
        validate_every=max(updates // 4, 1),
        save_every=max(updates // 2, 1),
        seed=seed,
        device="cpu",
    )
