"""The study of joints ahead: fit and scores."""

import torch
from tensordict import TensorDict

from benchmarks.common.arm import JOINTS
from benchmarks.g1.later import Motion, looked, scores


def test_the_fit_finds_a_linear_motion_and_the_belief_ahead_follows_it(float64):
    """Joints that go half of the way to their command in each row: all is known but the encoders' noise."""
    commands = torch.randn(3, 40, JOINTS).cumsum(1) * 0.1
    joints = [torch.zeros(3, JOINTS)]
    for t in range(39):
        joints.append(0.5 * joints[-1] + 0.5 * commands[:, t] + 1e-4 * torch.randn(3, JOINTS))
    joints = torch.stack(joints, 1)
    data = TensorDict(
        {"joints": joints, "action": commands, "encoders": joints + 1e-3 * torch.randn_like(joints)}, [3, 40]
    )
    data["valid"] = torch.ones(3, 40, dtype=torch.bool)
    motion = Motion.fitted(data)
    half = 0.5 * torch.eye(JOINTS)
    torch.testing.assert_close(motion.weight[:, 2 * JOINTS :], half, atol=5e-3, rtol=0)
    out = looked(motion, data, "EKF", 1.0, 4)
    now, later, inside = scores(motion, data, out, 4)
    assert later < 0.05 * now
    assert 0.8 < inside <= 1.0
