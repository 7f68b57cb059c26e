"""Oracles: episodes that must be alike, actions and scores worked out by hand, and a sensor of known errors."""

import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("dm_control", reason="dm_control is not installed: pip install dm-control 'mujoco<4'")

from benchmarks.arms import study
from benchmarks.arms.arms import ARMS, make_env, wrap
from benchmarks.arms.filters import make_filter
from benchmarks.arms.page import difference
from benchmarks.arms.sensor import JointSensor
from benchmarks.arms.study import Study, collect, compare, scores, trained

KEYS = {"reading": "held", "belief": ("belief", "mean"), "truth": "state"}  # of what the policy reads


@pytest.mark.parametrize(("name", "missing"), [("manipulator", 0.0), ("reacher", 0.3)])
def test_one_controller_in_the_same_episodes_on_each_estimate(name, missing, monkeypatch):
    arm, made, run = ARMS[name], [], study.run

    def noted(*args):
        made.append(run(*args))
        return made[-1]

    denkf = make_filter(arm, collect(arm, False, 2, 30, 0), None, None)
    monkeypatch.setattr(study, "run", noted)
    rows = compare(arm, denkf, missing, False, Study(episodes=2, steps=24))
    episodes = dict(zip(list(KEYS)[: 2 if missing else 3], made, strict=True))
    for estimate, data in episodes.items():
        action = arm.control(data[KEYS[estimate]], data["goal"])
        torch.testing.assert_close(data["action"], action, atol=1e-6, rtol=0)
        for key in ("state", "goal"):
            assert data[key][:, 0].equal(made[0][key][:, 0])  # all begin alike
    assert rows == [
        {"missing": missing, "estimate": estimate, **row}
        for estimate, data in episodes.items()
        for row in scores(arm, data, KEYS[estimate])
    ]
    errors = []
    for data in made[:2]:
        reading = torch.nn.functional.pad(data["next", "reading"], (0, arm.joints))
        errors.append(wrap(arm.split(reading)[0] - arm.split(data["next", "state"])[0]))
    torch.testing.assert_close(errors[0], errors[1], atol=1e-4, rtol=0)  # the same in each step
    assert made[0]["next", "observed"].equal(made[1]["next", "observed"])
    assert bool(missing) != made[0]["next", "observed"].all()


def test_the_filter_learns_how_much_the_sensor_errs(monkeypatch, tmp_path):
    """Biases have the standard deviation of the sensor's error, which a constant is no part of."""
    arm, deviation = ARMS["reacher"], torch.tensor([0.01, 0.02, 0.03, 0.04])

    class Reads(JointSensor):
        """Pictures are rows of what is read from them."""

        def compute(self, pixels):
            return pixels[..., 0, 0, :]

    def collected(arm, pixels, episodes, steps, seed):
        angles, velocity = torch.rand(episodes, steps, 2), torch.randn(episodes, steps, 2)
        sign = 1 - 2 * (torch.arange(steps) % 2)
        error = 0.05 + deviation * sign.unsqueeze(-1)
        read = arm.places(angles).flatten(-2) + error
        motion = {"state": arm.join(angles, velocity), "action": torch.zeros(episodes, steps, 2)}
        films = {"pixels": read.unflatten(-1, (1, 1, -1))} if pixels else {}
        return TensorDict({**motion, **films}, [episodes, steps])

    monkeypatch.setattr(study, "JointSensor", Reads)
    monkeypatch.setattr(study, "collect", collected)
    for name in ("poses", "train_sensor", "train_motion"):
        monkeypatch.setattr(study, name, lambda *_: None)
    denkf = trained(arm, True, Study(), tmp_path)
    assert denkf["transition"].bias.tolist() == pytest.approx(deviation.tolist(), rel=1e-3)
    assert denkf.initial.std[-4:].tolist() == pytest.approx(deviation.tolist(), rel=1e-3)
    noise = denkf["noise"](TensorDict({("sensor", "reading"): torch.zeros(4)}))["sensor", "noise"]
    assert noise.sqrt().tolist() == pytest.approx(deviation.tolist(), rel=1e-3)


def test_the_reading_of_a_reset_is_always_there():
    env = make_env(ARMS["reacher"], False, 4, missing=1.0)
    data = env.rollout(3)
    env.close()
    assert data["observed"][:, 0].all()
    assert not data["next", "observed"].any()


def test_the_controller_by_hand():
    """Only the first angle goes the short way round, and the arm is held as its goal needs it."""
    arm = ARMS["manipulator"]
    goal, angles = torch.tensor([3.0, 0.4, 2.5, 0.1]), torch.tensor([-3.0, 0.3, -1.0, 0.2])
    action = arm.control(arm.join(angles, torch.full((4,), 0.1)), goal)
    expected = arm.hold(goal) + 1.5 * torch.tensor([6.0 - 2 * torch.pi, 0.1, 3.5, -0.1]) - 0.15 * 0.1
    expected[2] = 1.0  # no action is more than full
    torch.testing.assert_close(action, torch.nn.functional.pad(expected, (0, 1)), atol=1e-5, rtol=0)


def test_scores_of_the_end_are_of_the_last_quarter():
    """The arm is at its goal there, and the belief in its tip errs to one side, then as far to the other."""
    arm, zero = ARMS["reacher"], torch.zeros(2, 8, 2)
    before = torch.arange(8) < 6
    state = arm.join(zero + 0.5 * before.unsqueeze(-1), zero)
    off = torch.tensor([0.9, 0.9, 0.9, 0.9, 0.9, 0.9, 0.1, -0.1])
    held = arm.join(zero + torch.stack([off, 0 * off], -1), zero)
    data = TensorDict({"state": state, "held": held, "reward": torch.ones(2, 8, 1)}, [2, 8])
    episodes = TensorDict({"next": data, "goal": zero, "action": zero}, [2, 8])
    row, angle = scores(arm, episodes, "held")[0], torch.tensor(0.1)
    assert row["tip"] == pytest.approx(0.0, abs=1e-5)
    assert row["error"] == pytest.approx(2 * 24 * (angle / 2).sin().item(), rel=1e-4)  # of a link of 24 cm
    assert row["offset"] == pytest.approx(24 * (1 - angle.cos().item()), rel=1e-3)  # along it; across it is 0


def test_differences_are_of_the_same_episodes_in_any_order():
    case = {"task": "reacher", "source": "encoders", "missing": 0.0}
    angles = {"reading": {0: 1.0, 1: 5.0, 2: 3.0}, "belief": {2: 5.0, 1: 7.0, 0: 9.0}}
    rows = [
        {**case, "seed": 0, "estimate": estimate, "episode": episode, "angle": angle}
        for estimate, each in angles.items()
        for episode, angle in each.items()
    ]
    # They are 8, 2 and 2, and of three draws 4 % are all 8 and 30 % all 2.
    assert difference(rows, "angle", **case) == "+4.00 [+2.00, +8.00], +133%"
