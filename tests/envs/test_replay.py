"""Any data set as an environment: it shows the data set's rows, and a policy can repeat what was commanded."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv, SerialEnv
from torchrl.envs.utils import check_env_specs

from tests.applications.ur5.data.ur5_demos import ten_demos
from torch_denkf.applications.car import KITTIOdometryExperienceReplay, write_drives
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.data import Episode, EpisodeReplay, LeRobotReplay
from torch_denkf.data.lerobot.rows import recording_from_rows
from torch_denkf.envs import ReplayEnv
from torch_denkf.envs.replay import RecordedPolicy

LENGTHS = [6, 9, 4, 7]


def make(actions=True, transform=None):
    """Returns the state (episode, step), a reading of its own, and an action that tells both."""
    step = torch.cat([torch.arange(length) for length in LENGTHS]).unsqueeze(-1)
    number = torch.arange(4).repeat_interleave(torch.tensor(LENGTHS)).unsqueeze(-1)
    rows = {"step": step, "time": 0.1 * step.double(), "state": torch.cat([number, step], -1).float()}
    rows["wheel"] = torch.randn(len(step), 2)
    if actions:
        rows["action"] = (10.0 * number + step).float()
    starts = [sum(LENGTHS[:k]) for k in range(4)]
    episodes = [Episode(f"run{k}", *at) for k, at in enumerate(zip(starts, LENGTHS, strict=True))]
    return EpisodeReplay(TensorDict(rows, [26]), episodes, for_tests=lambda episode: False, transform=transform)


SETS = ("own", "without actions", "kitti", "ur5", "lerobot")


@pytest.fixture(params=SETS)
def data(request, tmp_path, tmp_path_factory):
    if request.param == "kitti":
        write_drives(tmp_path, ["hill", "town"], frames=8, size=(12, 36))
        return KITTIOdometryExperienceReplay(tmp_path, size=(12, 36), mirrored=True, cache=tmp_path / "cache")
    if request.param == "ur5":
        return UR5ExperienceReplay(ten_demos(tmp_path_factory), split="all", cache=tmp_path)
    if request.param == "lerobot":
        images, state = torch.randint(256, (24, 3, 8, 8), dtype=torch.uint8), torch.rand(24, 3)
        rows = {"observation": {"image": images, "state": state}, "action": torch.rand(24, 2)}
        rows["episode"] = torch.arange(4).repeat_interleave(6)
        return LeRobotReplay(recording_from_rows(TensorDict(rows, [24]), fps=5), split="all")
    return make(request.param == "own")


def same(shown, data, row):
    expected = data[row]
    for key in set(expected.keys()) - {"next", "action", "is_init", "done", "terminated", "truncated", "index"}:
        torch.testing.assert_close(shown[key], expected[key], rtol=0, atol=0, msg=key)
    if "action" in expected:
        torch.testing.assert_close(shown["recorded", "action"], expected["action"], rtol=0, atol=0)


@pytest.mark.parametrize("batch_size", [[], [3], [2, 2]])
def test_every_data_set_replays_its_rows(data, batch_size):
    env = ReplayEnv(data, batch_size=batch_size, length=4)
    check_env_specs(env)
    env.set_seed(0)  # the turn is reset
    rollout = env.rollout(100)
    assert rollout.batch_size == (*batch_size, 3)
    count = max(1, torch.Size(batch_size).numel())
    starts = torch.tensor([data.episodes[k % len(data.episodes)].start for k in range(count)]).reshape(batch_size)
    rows = starts.unsqueeze(-1) + torch.arange(3)
    same(rollout, data, rows)
    same(rollout["next"], data, rows + 1)
    first = torch.tensor([True, False, False]).expand(rows.shape)
    assert rollout["is_init"].squeeze(-1).equal(first)
    assert rollout["next", "truncated"].squeeze(-1).equal(first.flip(-1))
    assert rollout["next", "done"].equal(rollout["next", "truncated"])
    assert not rollout["next", "terminated"].any()
    assert not rollout["next", "reward"].any()
    if "action" in data[:]:
        assert rollout["action"].equal(data[rows]["action"])
    else:
        assert rollout["action"].shape == (*rows.shape, 0)
        assert env.policy is None


def test_elements_take_the_episodes_in_turn():
    """Episodes of 6, 9, 4 and 7 rows, two at a time; an element that ends takes the next."""
    data = make()
    rollout = ReplayEnv(data, batch_size=[2]).rollout(16, break_when_any_done=False)
    assert rollout["episode"].tolist() == [[0] * 5 + [2] * 3 + [3] * 6 + [2] * 2, [1] * 8 + [0] * 5 + [1] * 3]
    assert rollout["step"].squeeze(-1)[0].tolist() == [*range(5), *range(3), *range(6), 0, 1]
    same(rollout[0, :14], data, torch.tensor([*range(5), *range(15, 18), *range(19, 25)]))


def test_a_partial_reset_leaves_the_other_elements():
    data = make()
    env = ReplayEnv(data, batch_size=[2], start=1)
    now = env.reset()
    same(now, data, torch.tensor([1, 7]))
    for _ in range(2):
        now = env.step(env.rand_action(now))["next"]
    now = env.reset(now.exclude("reward").set("_reset", torch.tensor([[False], [True]])))
    same(now, data, torch.tensor([3, 16]))
    assert now["is_init"].flatten().tolist() == [False, True]
    now = env.step(env.rand_action(now))["next"]
    same(now, data, torch.tensor([4, 17]))


def test_random_stretches_are_uniform_and_follow_the_seed():
    data = make()

    def begins(seed):
        env = ReplayEnv(data, batch_size=[64], start="random", length=4, seed=seed)
        return torch.cat([env.reset()["state"] for _ in range(40)])

    first = begins(3)
    assert begins(3).equal(first)
    assert not begins(4).equal(first)
    # 3 + 6 + 1 + 4 stretches of four rows, 2560 draws: 183 each, standard deviation 13.
    stretches, counts = first.unique(dim=0, return_counts=True)
    assert stretches.tolist() == [[k, s] for k, length in enumerate(LENGTHS) for s in range(length - 3)]
    assert (counts - 2560 / 14).abs().max() < 5 * 13
    rollout = ReplayEnv(data, batch_size=[5], start="random", length=4).rollout(30, break_when_any_done=False)
    assert (rollout["next", "state"][..., 0] == rollout["state"][..., 0]).all()
    assert (rollout["next", "state"][..., 1] == rollout["state"][..., 1] + 1).all()


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        *((name, SerialEnv) for name in SETS),
        pytest.param("own", ParallelEnv, marks=pytest.mark.slow),
        pytest.param("kitti", ParallelEnv, marks=pytest.mark.slow),
    ],  # processes take 10 s to start
    indirect=["data"],
)
def test_batched_environments(data, kind):
    last = len(data.episodes) - 1
    env = kind(2, partial(ReplayEnv, data, length=4), create_env_kwargs=[{"episodes": 0}, {"episodes": last}])
    rows = torch.tensor([[0], [data.episodes[last].start]]) + torch.tensor([0, 1, 2, 0, 1])
    commanded = "action" in data[:]
    policy = RecordedPolicy() if commanded else None
    try:
        check_env_specs(env)
        rollout = env.rollout(5, policy, break_when_any_done=False)
        same(rollout, data, rows)
        if commanded:
            assert rollout["action"].equal(data[rows]["action"])
            collector = Collector(env, policy, frames_per_batch=10)
            batch = next(iter(collector))
            assert batch["action"].equal(data[rows]["action"])
            collector.shutdown()
    finally:
        if not env.is_closed:
            env.close()
