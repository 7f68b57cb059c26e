"""Learned motion model of all filters: damped rates, and a pull to the commands if those are read."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from benchmarks.common.arm import JOINTS
from benchmarks.common.arm.motion import ArmMotion
from benchmarks.common.arm.sensors import Statistics

DELAYS = (0, 2)  # rows: latency of the commands
AHEAD = 8  # rows of open-loop prediction in training


def delayed(actions: Tensor) -> Tensor:
    """Returns commands ``[*, T, 2D]`` from sequences ``[*, T, D]``: those of the row, and those of 2 rows before."""
    rows = torch.arange(actions.shape[-2])
    return torch.cat([actions[..., (rows - delay).clamp_min(0), :] for delay in DELAYS], -1)


class Motion(ArmMotion):
    r"""Predicts the next joints, from the joints and their change in the last row.

    .. math:: c_t = d \circ c_{t-1} + \sum_k p_k \circ (u_{t-1-k} - q_{t-1}) + a(q, c, u), \quad q_t = q_{t-1} + c_t

    with the damping d, the pulls p and the acceleration a learned.

    Args:
        facts: statistics of the training episodes.
        actions: whether the commands are read: the last features of the input.
    """

    size, read, fading, scored = 2 * JOINTS, JOINTS, 0.98, slice(JOINTS)

    def __init__(self, facts: Statistics, actions: bool = False):
        units = {name: getattr(facts, name)[:JOINTS] for name in ("loc", "scale", "rate", "acceleration")}
        super().__init__((2 + len(DELAYS) * actions) * JOINTS, **units)
        self.actions = actions
        self.damping = nn.Parameter(torch.full((JOINTS,), 3.0))  # logit
        self.pull = nn.Parameter(torch.zeros(len(DELAYS), JOINTS)) if actions else None

    def forward(self, features: Tensor) -> Tensor:
        """Returns the next states ``[*, 2D]`` from states ``[*, 2D]``, or from states and commands ``[*, 4D]``."""
        place, rates = features[..., :JOINTS], features[..., JOINTS : self.size]
        parts = [(place - self.loc) / self.scale, (rates / (3 * self.rate)).tanh()]
        wanted = self.damping.sigmoid() * rates
        if self.actions:
            way = features[..., self.size :].unflatten(-1, (len(DELAYS), JOINTS)) - place.unsqueeze(-2)
            parts.append((way / (5 * self.rate)).tanh().flatten(-2))
            wanted = wanted + (self.pull * way).sum(-2)
        rates = wanted + self.acceleration * self.accelerate(torch.cat(parts, -1))
        return torch.cat([place + rates, rates], -1)
