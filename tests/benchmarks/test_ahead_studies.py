"""The studies of late actions and of joints ahead: what they simulate, fit and score."""

import torch
from tensordict import TensorDict

from benchmarks.common.arm import JOINTS
from benchmarks.control import latency
from benchmarks.control.latency import TwoLinks, best_policy, moved, read_grid
from benchmarks.g1.later import Motion, looked, scores
from torch_denkf import NoisyPendulumEnv


def test_the_studys_motion_is_the_environments():
    data = NoisyPendulumEnv(batch_size=[20]).rollout(10)
    angle, speed = moved(
        torch.atan2(data["state"][..., 1:2], data["state"][..., :1]), data["state"][..., 2:], data["action"]
    )
    torch.testing.assert_close(
        torch.cat([angle.cos(), angle.sin(), speed], -1), data["next", "state"], atol=1e-5, rtol=0
    )


def test_a_grid_is_read_between_its_points_and_all_around():
    count = 8
    table = torch.arange(count, dtype=torch.float32).view(-1, 1) + 10 * torch.arange(count, dtype=torch.float32)
    step = 2 * torch.pi / count
    read = lambda angle, speed: read_grid(table, torch.tensor(angle), torch.tensor(speed)).item()  # noqa: E731
    assert abs(read(2.5 * step, -8.0) - 2.5) < 1e-4
    assert abs(read(-0.5 * step, -8.0) - 3.5) < 1e-4  # between the last and the first
    assert abs(read(0.0, 8.0) - 70.0) < 1e-4


def test_the_policy_holds_a_pendulum_upright():
    """A small angle, within what the motor can lift."""
    policy = best_policy(31, sweeps=100)
    angle, speed = torch.tensor([[0.1], [-0.1]]), torch.zeros(2, 1)
    for _ in range(60):
        angle, speed = moved(angle, speed, policy(torch.cat([angle.cos(), angle.sin(), speed], -1)))
    assert angle.abs().max() < 0.3


def test_two_links_lose_no_energy_but_to_friction(float64, monkeypatch):
    """Kinetic energy, from the velocities of the links' middles, in a step that is short."""
    dt = 1e-4
    monkeypatch.setattr(latency, "DT", dt)
    state = torch.tensor([[0.3, 0.8, 1.0, -0.7], [-1.0, -1.5, 0.5, 2.0]])

    def energy(state):
        one, two, first, second = state.unbind(-1)
        L, M, C = TwoLinks.L, TwoLinks.M, TwoLinks.C
        middle = torch.stack([-L * one.sin() * first, L * one.cos() * first], -1)
        both = C * (first + second).unsqueeze(-1) * torch.stack([-(one + two).sin(), (one + two).cos()], -1)
        turning = M * L**2 / 24 * (first**2 + (first + second) ** 2)
        return 0.5 * M * ((C * first) ** 2 + (middle + both).square().sum(-1)) + turning

    after = TwoLinks.moved(state, torch.zeros(2, 2))
    lost = TwoLinks.DAMPING * dt * (state[:, 2:] ** 2 + after[:, 2:] ** 2).sum(-1) / 2
    torch.testing.assert_close(energy(state) - energy(after), lost, rtol=5e-3, atol=0)


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
