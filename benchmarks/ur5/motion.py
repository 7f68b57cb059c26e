"""The motion that all filters learn: accelerations that last, and a place that follows from the joints.

Nothing of it is known. The filters' state is the table's ten numbers, each joint's change in the last step, and the
change of that: [J1..J7, x, y, z, c1..c7, a1..a7]. What changes the accelerations and the arm's kinematics are networks;
they are trained on states of the training demos before any filter is, and further with each filter.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.ur5.demos import JOINTS, STATE
from benchmarks.ur5.sensors import JOINT_UNIT, PLACE_UNIT, Statistics
from torch_denkf.training import Stage
from torch_denkf.training.parts import train_part

SIZE = STATE + 2 * JOINTS  # of the filters' state
AHEAD = 4  # steps that the motion is trained on: what errs little in one step may err much in ten
FADING = 0.95  # of a bias in a step, before training
RATES = list(range(STATE, STATE + JOINTS))
ACCELERATIONS = list(range(STATE + JOINTS, SIZE))
ERRORS = torch.cat([torch.full((JOINTS,), JOINT_UNIT), torch.full((3,), PLACE_UNIT)])  # units of a filter's loss
NOISY = [*range(JOINTS, STATE), *ACCELERATIONS]  # and the place; joints and rates follow from the accelerations


def with_rates(states: Tensor) -> Tensor:
    """The filters' states ``[*B, T, 24]`` of sequences ``[*B, T, 10]``; an episode begins at rest."""
    rates = _changes(states[..., :JOINTS])
    return torch.cat([states, rates, _changes(rates)], -1)


def _changes(values: Tensor) -> Tensor:
    """Differences along time, of the same shape; the first is zero."""
    return torch.cat([torch.zeros_like(values[..., :1, :]), values.diff(dim=-2)], -2)


class ArmMotion(nn.Module):
    r"""One step of the arm.

    .. math:: a_t = e \circ a_{t-1} + j(q, c, a), \quad c_t = d \circ c_{t-1} + a_t, \quad q_t = q_{t-1} + c_t, \quad
              p_t = k(q_t) + \lambda \circ (p_{t-1} - k(q_{t-1}))

    with the dampings d and e, the jerk j and the kinematics k learned. The place p keeps a share of what it differs
    from the kinematics. Members whose place follows from their joints carry the correlation of both: what the
    sensor says of the place corrects the joints, and the other way round.

    Args:
        facts: statistics of the training demos.
    """

    size, read, fading, actions = SIZE, STATE, FADING, False

    def __init__(self, facts: Statistics):
        super().__init__()
        for name, value in {
            "loc": facts.loc[:JOINTS],
            "scale": facts.scale[:JOINTS],
            "rate": facts.rate,
            "acceleration": facts.acceleration,
            "jerk": facts.jerk,
            "place_loc": facts.loc[JOINTS:],
            "place_scale": facts.scale[JOINTS:],
        }.items():
            self.register_buffer(name, value.clone())
        self.damping = nn.Parameter(torch.full((JOINTS,), 6.0))  # d, of it the sigmoid
        self.lasting = nn.Parameter(torch.full((JOINTS,), 2.0))  # e, likewise
        self.keep = nn.Parameter(torch.zeros(3))  # likewise
        self.accelerate = nn.Sequential(
            nn.Linear(3 * JOINTS, 48), nn.Tanh(), nn.Linear(48, 48), nn.Tanh(), nn.Linear(48, JOINTS)
        )
        nn.init.zeros_(self.accelerate[-1].weight)
        nn.init.zeros_(self.accelerate[-1].bias)
        self.kinematics = nn.Sequential(nn.Linear(12, 96), nn.SiLU(), nn.Linear(96, 96), nn.SiLU(), nn.Linear(96, 3))

    def place(self, joints: Tensor) -> Tensor:
        """k: where the gripper is, m ``[*, 3]``, at joints ``[*, 7]``."""
        angles = joints[..., :6]
        features = torch.cat([angles.cos(), angles.sin()], -1)
        return self.place_loc + self.place_scale * self.kinematics(features)

    def forward(self, states: Tensor) -> Tensor:
        """States ``[*, 24]`` of states ``[*, 24]``."""
        joints, place, rates, accelerations = states.split((JOINTS, 3, JOINTS, JOINTS), -1)
        parts = [(joints - self.loc) / self.scale, rates / self.rate, accelerations / self.acceleration]
        wanted = self.damping.sigmoid() * rates + self.lasting.sigmoid() * accelerations
        faster = wanted + self.jerk * self.accelerate(torch.cat(parts, -1))
        moved = joints + faster
        place = self.place(moved) + self.keep.sigmoid() * (place - self.place(joints))
        return torch.cat([moved, place, faster, faster - rates], -1)


class BiasedReading(nn.Module):
    """h: the table's ten numbers, and the sensor's errors of them."""

    def forward(self, state: Tensor) -> Tensor:
        """Readings ``[*, 10]`` of states ``[*, 34]``."""
        return state[..., :STATE] + state[..., SIZE:]


class MotionLoss(nn.Module):
    """Absolute errors of some steps from true states, the k-th counting 1 / k; and of the kinematics."""

    def __init__(self, motion: ArmMotion):
        super().__init__()
        self.motion = motion

    def forward(self, rows: TensorDict) -> dict[str, Tensor]:
        """Scores paths ``[N]`` of some rows each."""
        path, errors = rows["path"], []
        moved = path[:, 0]
        for step, truth in enumerate(path.unbind(1)[1:], start=1):
            moved = self.motion(moved)
            rates = (moved - truth)[..., RATES] / self.motion.acceleration
            errors.append(rates.abs().mean() / step)
        place = self.motion.place(path[:, 1, :JOINTS]) - path[:, 1, JOINTS:STATE]
        return {"loss_rates": torch.stack(errors).sum(), "loss_place": place.abs().mean() / PLACE_UNIT}


@torch.no_grad()
def open_loop(motion: ArmMotion, states: Tensor, ahead: Sequence[int] = (1, 5, 10)) -> dict[str, float]:
    """Mean absolute errors of the joints, degrees, so many steps after true states, without any reading.

    Args:
        motion: to be tested.
        states: sequences ``[N, T, 10]``.
        ahead: numbers of steps, rising.
    """
    full, last = with_rates(states), states.shape[-2] - max(ahead)
    moved, errors = full[:, :last], {}
    for step in range(max(ahead)):
        moved = motion(moved)
        if step + 1 in ahead:
            error = (moved - full[:, step + 1 : step + 1 + last])[..., :JOINTS].abs().mean()
            errors[f"after_{step + 1}_deg"] = float(error.rad2deg())
    return errors


def train_motion(motion: ArmMotion, states: Tensor, *, out: Path, seed: int, updates: int) -> ArmMotion:
    """Trains the motion on true sequences ``[N, T, 10]``, or reads it where that was done."""
    full, ahead = with_rates(states), min(AHEAD, states.shape[1] - 1)
    starts = full.shape[1] - ahead  # of a demo
    steps = torch.arange(ahead + 1)

    def paths(index: Tensor) -> TensorDict:
        demo, step = (index // starts).unsqueeze(-1), (index % starts).unsqueeze(-1) + steps
        return TensorDict({"path": full[demo, step]}, batch_size=index.shape)

    count = full.shape[0] * starts
    held = int(0.95 * full.shape[0]) * starts  # whole demos

    def sample(generator: torch.Generator, length: int | None) -> TensorDict:
        return paths(torch.randint(max(held, 1), (512,), generator=generator))

    unseen = slice(held // starts, held // starts + 60)

    def far() -> dict[str, float]:
        return open_loop(motion, states[unseen]) if states.shape[1] > 20 and held < count else {}

    loss = MotionLoss(motion)
    checked = (
        paths(torch.arange(held, count)[:: max((count - held) // 4000, 1)]) if held < count else paths(torch.arange(1))
    )
    return train_part(
        motion,
        Stage("motion", loss, sample, updates, lr=5e-3),
        out=out,
        validate=lambda: {"error": float(sum(loss(checked).values())), **far()},
        monitor="error",
        validate_every=max(updates // 4, 1),
        save_every=max(updates // 2, 1),
        seed=seed,
        device="cpu",
    )
