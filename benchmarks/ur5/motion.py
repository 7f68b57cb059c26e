"""The motion that all filters learn: rates that last, and a place that follows from the joints. Nothing of it is known.

The filters' state is the table's ten numbers and the change of each joint in the last step, [J1..J7, x, y, z, c1..c7].
Both the joints' accelerations and the arm's kinematics are networks; they are trained on states of the training demos
before any filter is, and further with each filter.
"""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.ur5.demos import JOINTS, STATE
from benchmarks.ur5.sensors import JOINT_UNIT, PLACE_UNIT, Statistics
from torch_denkf.training import Stage, train_part

SIZE = STATE + JOINTS  # of the filters' state
FADING = 0.95  # of a bias in a step, before training
RATES = list(range(STATE, SIZE))
ERRORS = torch.cat([torch.full((JOINTS,), JOINT_UNIT), torch.full((3,), PLACE_UNIT)])  # units of a filter's loss
NOISY = [*range(JOINTS, SIZE)]  # place and rates; the joints follow from their rates


def with_rates(states: Tensor) -> Tensor:
    """The filters' states ``[*B, T, 17]`` of sequences ``[*B, T, 10]``; an episode begins at rest."""
    joints = states[..., :JOINTS]
    rates = torch.cat([torch.zeros_like(joints[..., :1, :]), joints.diff(dim=-2)], -2)
    return torch.cat([states, rates], -1)


class ArmMotion(nn.Module):
    r"""One step of the arm.

    .. math:: c_t = d \circ c_{t-1} + a(q, c, u), \quad q_t = q_{t-1} + c_t, \quad
              p_t = k(q_t) + \lambda \circ (p_{t-1} - k(q_{t-1}))

    with the damping d, the acceleration a and the kinematics k learned. The place p keeps a share of what it differs
    from the kinematics. Members whose place follows from their joints carry the correlation of both: what the sensor
    says of the place corrects the joints, and the other way round.

    Args:
        facts: statistics of the training demos.
        actions: whether the joints' targets of the last step are read: features 17 to 23 of the input.
    """

    size, read, fading = SIZE, STATE, FADING

    def __init__(self, facts: Statistics, actions: bool = False):
        super().__init__()
        self.actions = actions
        for name, value in {
            "loc": facts.loc[:JOINTS],
            "scale": facts.scale[:JOINTS],
            "rate": facts.rate,
            "acceleration": facts.acceleration,
            "place_loc": facts.loc[JOINTS:],
            "place_scale": facts.scale[JOINTS:],
        }.items():
            self.register_buffer(name, value.clone())
        self.damping = nn.Parameter(torch.full((JOINTS,), 4.0))  # of it the sigmoid
        self.keep = nn.Parameter(torch.zeros(3))  # likewise
        self.accelerate = nn.Sequential(
            nn.Linear(2 * JOINTS + JOINTS * actions, 32), nn.Tanh(), nn.Linear(32, 32), nn.Tanh(), nn.Linear(32, JOINTS)
        )
        self.pull = nn.Parameter(torch.full((JOINTS,), 0.5)) if actions else None  # share of the way to the target
        nn.init.zeros_(self.accelerate[-1].weight)
        nn.init.zeros_(self.accelerate[-1].bias)
        self.kinematics = nn.Sequential(nn.Linear(12, 96), nn.SiLU(), nn.Linear(96, 96), nn.SiLU(), nn.Linear(96, 3))

    def place(self, joints: Tensor) -> Tensor:
        """k: where the gripper is, m ``[*, 3]``, at joints ``[*, 7]``."""
        angles = joints[..., :6]
        features = torch.cat([angles.cos(), angles.sin()], -1)
        return self.place_loc + self.place_scale * self.kinematics(features)

    def forward(self, features: Tensor) -> Tensor:
        """States ``[*, 17]`` of states ``[*, 17]``, or of states and actions ``[*, 24]``."""
        joints, place, rates = features[..., :SIZE].split((JOINTS, 3, JOINTS), -1)
        parts = [(joints - self.loc) / self.scale, rates / self.rate]
        wanted = self.damping.sigmoid() * rates
        if self.actions:
            way = features[..., SIZE:] - joints
            # The fingers are often told to shut on an object: a way that they do not go.
            parts.append((way / (3 * self.rate)).tanh())
            wanted = wanted + self.pull * (way.clamp(-1, 1) - wanted) * (way.abs() < 5 * self.rate)
        rates = wanted + self.acceleration * self.accelerate(torch.cat(parts, -1))
        moved = joints + rates
        place = self.place(moved) + self.keep.sigmoid() * (place - self.place(joints))
        return torch.cat([moved, place, rates], -1)


class BiasedReading(nn.Module):
    """h: the table's ten numbers, and the sensor's errors of them where the state holds those."""

    def forward(self, state: Tensor) -> Tensor:
        """Readings ``[*, 10]`` of states ``[*, 17]`` or ``[*, 27]``."""
        read = state[..., :STATE]
        return read if state.shape[-1] == SIZE else read + state[..., SIZE:]


class MotionLoss(nn.Module):
    """Absolute errors of one step from true states, and of the kinematics."""

    def __init__(self, motion: ArmMotion):
        super().__init__()
        self.motion = motion

    def forward(self, rows: TensorDict) -> dict[str, Tensor]:
        """Scores pairs of rows ``[N]``."""
        before, after = rows["before"], rows["after"]
        moved = self.motion(torch.cat([before, rows["action"]], -1) if self.motion.actions else before)
        rates = (moved - after)[..., STATE:] / self.motion.acceleration
        # From random places around the demos', too: members are wrong.
        place = self.motion.place(after[..., :JOINTS]) - after[..., JOINTS:STATE]
        return {"loss_rates": rates.abs().mean(), "loss_place": place.abs().mean() / PLACE_UNIT}


def train_motion(
    motion: ArmMotion, states: Tensor, actions: Tensor, *, out: Path, seed: int, updates: int
) -> ArmMotion:
    """Trains the motion on true sequences ``[N, T, 10]`` and actions ``[N, T, 7]``, or reads it where that was done."""
    full = with_rates(states)

    def pairs(index: Tensor) -> TensorDict:
        demo, step = index // (full.shape[1] - 1), index % (full.shape[1] - 1)
        rows = {"before": full[demo, step], "after": full[demo, step + 1], "action": actions[demo, step]}
        return TensorDict(rows, batch_size=index.shape)

    count = full.shape[0] * (full.shape[1] - 1)
    held = int(0.95 * full.shape[0]) * (full.shape[1] - 1)  # whole demos

    def sample(generator: torch.Generator, length: int | None) -> TensorDict:
        return pairs(torch.randint(max(held, 1), (512,), generator=generator))

    loss = MotionLoss(motion)
    checked = (
        pairs(torch.arange(held, count)[:: max((count - held) // 4000, 1)]) if held < count else pairs(torch.arange(1))
    )
    return train_part(
        motion,
        Stage("motion", loss, sample, updates, lr=5e-3),
        out=out,
        validate=lambda: {"error": float(sum(loss(checked).values()))},
        validate_every=max(updates // 4, 1),
        save_every=max(updates // 2, 1),
        seed=seed,
        device="cpu",
    )
