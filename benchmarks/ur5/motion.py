"""The learned motion of all filters: decaying accelerations, and a place that follows from the joints."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.common.arm import JOINTS
from benchmarks.common.arm.motion import ArmMotion
from benchmarks.common.arm.sensors import Statistics
from benchmarks.ur5.demos import STATE
from benchmarks.ur5.sensors import PLACE_UNIT

SIZE = STATE + 2 * JOINTS  # of the filters' state
AHEAD = 4  # steps that the motion is trained on
RATES = list(range(STATE, STATE + JOINTS))
ACCELERATIONS = list(range(STATE + JOINTS, SIZE))


class Motion(ArmMotion):
    r"""One step of the arm: [J1..J7, x, y, z], each joint's change in the last step, and the change of that.

    .. math:: a_t = e \circ a_{t-1} + j(q, c, a), \quad c_t = d \circ c_{t-1} + a_t, \quad q_t = q_{t-1} + c_t, \quad
              p_t = k(q_t) + \lambda \circ (p_{t-1} - k(q_{t-1}))

    with the dampings d and e, the jerk j and the kinematics k learned. The difference between the place p and the
    kinematics decays. As the members' places follow from their joints, both are correlated: readings of the place
    correct the joints, and vice versa.

    Args:
        facts: statistics of the training demos.
    """

    size, read, fading, scored = SIZE, STATE, 0.95, slice(STATE, STATE + JOINTS)

    def __init__(self, facts: Statistics):
        rates = {name: getattr(facts, name) for name in ("rate", "acceleration", "jerk")}
        super().__init__(3 * JOINTS, loc=facts.loc, scale=facts.scale, **rates)
        self.damping = nn.Parameter(torch.full((JOINTS,), 6.0))  # d, as a logit
        self.lasting = nn.Parameter(torch.full((JOINTS,), 2.0))  # e, as a logit
        self.keep = nn.Parameter(torch.zeros(3))  # lambda, as a logit
        self.kinematics = nn.Sequential(nn.Linear(12, 96), nn.SiLU(), nn.Linear(96, 96), nn.SiLU(), nn.Linear(96, 3))

    def place(self, joints: Tensor) -> Tensor:
        """Returns the kinematics k: the gripper's place, m ``[*, 3]``, at joints ``[*, 7]``."""
        angles = joints[..., :6]
        features = torch.cat([angles.cos(), angles.sin()], -1)
        return self.loc[JOINTS:] + self.scale[JOINTS:] * self.kinematics(features)

    def forward(self, states: Tensor) -> Tensor:
        """Returns the next states ``[*, 24]`` from states ``[*, 24]``."""
        joints, place, rates, accelerations = states.split((JOINTS, 3, JOINTS, JOINTS), -1)
        angles = (joints - self.loc[:JOINTS]) / self.scale[:JOINTS]
        parts = [angles, rates / self.rate, accelerations / self.acceleration]
        wanted = self.damping.sigmoid() * rates + self.lasting.sigmoid() * accelerations
        faster = wanted + self.jerk * self.accelerate(torch.cat(parts, -1))
        moved = joints + faster
        place = self.place(moved) + self.keep.sigmoid() * (place - self.place(joints))
        return torch.cat([moved, place, faster, faster - rates], -1)

    def losses(self, rows: TensorDict) -> dict[str, Tensor]:
        """Returns errors of the rates, and of the kinematics."""
        true = rows["path"][:, 1]
        place = self.place(true[:, :JOINTS]) - true[:, JOINTS:STATE]
        return {**super().losses(rows), "loss_place": place.abs().mean() / PLACE_UNIT}
