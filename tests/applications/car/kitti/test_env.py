"""The replay shows exactly the drive's rows, whatever TorchRL wraps around it."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, InitTracker, ParallelEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torch_denkf.applications.car import KITTIReplayEnv, dead_reckoning, read_kitti_drive, write_drives
from torch_denkf.applications.car.kitti.frames import drive_frames
from torch_denkf.applications.car.vision.poses import poses_to_state, state_to_poses

ROWS = 24
KEYS = ("pixels", "state", "observed", "time")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kitti")
    write_drives(folder, ["town"], frames=ROWS, size=(12, 36))
    (folder / "sequences/town/image_2/000009.png").unlink()  # a gap
    return folder


@pytest.fixture(scope="module")
def drive(root):
    return read_kitti_drive(root, "town", size=(12, 36), cache=None)


def same(rollout, frames, rows, keys=KEYS):
    for key in keys:
        torch.testing.assert_close(rollout[key], frames[key][rows], rtol=0, atol=0)


@pytest.mark.parametrize("batch_size", [[], [3], [2, 2]])
def test_specs(drive, batch_size):
    check_env_specs(KITTIReplayEnv(drive, batch_size=batch_size, length=5))
    env = KITTIReplayEnv(drive, batch_size=batch_size, start="random", length=5, device="cpu")
    check_env_specs(env)
    assert env.device == env.reset().device == torch.device("cpu")


@pytest.mark.parametrize("colour", [True, False, None])
def test_a_rollout_is_the_drives_frames(root, tmp_path, colour):
    env = KITTIReplayEnv(root, "town", size=(10, 30), colour=colour, cache=tmp_path)
    frames = drive_frames(read_kitti_drive(root, "town", size=(10, 30), colour=colour, cache=tmp_path))
    rollout = env.rollout(1000)
    assert rollout.batch_size == (ROWS - 1,)
    assert rollout["pixels"].shape[1:] == (6 if colour is not False else 2, 10, 30)
    same(rollout, frames, slice(0, ROWS - 1))
    same(rollout["next"], frames, slice(1, ROWS))
    assert (rollout["is_init"] == frames["is_init"][:-1]).all()
    assert not rollout["next", "is_init"].any()
    flags = rollout["next"].select("done", "truncated", "terminated")
    assert flags["truncated"].flatten().tolist() == [False] * (ROWS - 2) + [True]
    assert (flags["truncated"] == flags["done"]).all()
    assert not flags["terminated"].any()
    assert not rollout["next", "reward"].any()
    # The gap blinds two frames.
    assert (~rollout["observed"]).flatten().nonzero().flatten().tolist() == [0, 9, 10]
    assert env.dt == pytest.approx(0.103)


@pytest.mark.parametrize("images", [True, False])
def test_flow_and_road_are_emitted_where_the_drive_has_them(drive, images):
    drive = drive.copy() if images else drive.exclude("image")
    drive["flow"], drive["road"] = torch.randn(ROWS, 3, 2, 5).half(), torch.randn(ROWS, 4, 6).half()
    env = KITTIReplayEnv(drive, batch_size=[2], start=[0, 6], length=5)
    check_env_specs(env)
    keys = {"pixels", "flow", "road", "state"} if images else {"flow", "road", "state"}
    assert keys - set(env.observation_spec.keys()) == set()
    assert ("pixels" in env.observation_spec.keys()) == images  # noqa: SIM118
    rollout, frames = env.rollout(10), drive_frames(drive)
    same(rollout, frames, torch.tensor([[0, 1, 2, 3], [6, 7, 8, 9]]), keys)
    assert (rollout["flow"][0, 2] == drive["flow"][2].float()).all()


def test_rows_replay_their_own_stretch(drive):
    env = KITTIReplayEnv(drive, batch_size=[3], start=[0, 4, 12], length=8)
    rollout, frames = env.rollout(1000), drive_frames(drive)
    assert rollout.batch_size == (3, 7)
    for row, start in enumerate((0, 4, 12)):
        same(rollout[row], frames, slice(start, start + 7))
        same(rollout[row]["next"], frames, slice(start + 1, start + 8))
    # A start within the drive has a frame before it: the difference is the true one.
    assert rollout["observed"][:, 0].flatten().tolist() == [False, True, True]
    assert rollout["pixels"][1, 0, 3:].abs().max() > 0


def test_only_rows_that_end_start_anew(drive):
    env = KITTIReplayEnv(drive, batch_size=[3], start=[0, 4, 12], length=[3, 5, 12])
    rollout = env.rollout(11, break_when_any_done=False)
    expected = torch.tensor(
        [
            [0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0],
            [4, 5, 6, 7, 4, 5, 6, 7, 4, 5, 6],
            [12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22],
        ]
    )
    frames = drive_frames(drive)
    same(rollout, frames, expected)
    starts = torch.tensor([[0], [4], [12]])
    assert (rollout["is_init"].squeeze(-1) == (expected == starts)).all()
    ends = torch.tensor([[2], [8], [23]])
    same(rollout["next"], frames, expected + 1)
    assert (rollout["next", "truncated"].squeeze(-1) == (expected + 1 == ends)).all()


def test_a_partial_reset_leaves_the_other_rows(drive):
    env = KITTIReplayEnv(drive, batch_size=[2], start=[2, 3], length=10)
    now = env.reset()
    for _ in range(4):
        now = env.step(now)["next"]
    mask = torch.tensor([[False], [True]])
    now = env.reset(now.exclude("reward").set("_reset", mask))
    frames = drive_frames(drive)
    same(now, frames, torch.tensor([6, 3]))
    assert now["is_init"].flatten().tolist() == [False, True]
    now = env.step(now)["next"]
    same(now, frames, torch.tensor([7, 4]))
    assert not now["is_init"].any()


def test_a_row_that_is_stepped_after_its_end_stays_there(drive):
    env = KITTIReplayEnv(drive, start=0, length=2)
    now = env.step(env.reset())["next"]
    again = env.step(now.clone().set("done", torch.zeros(1, dtype=torch.bool)))["next"]
    same(again, now.unsqueeze(0), 0)
    assert again["truncated"]


def test_random_starts_follow_the_seed(drive):
    def starts(set_seed=None, **options):
        env = KITTIReplayEnv(drive, batch_size=[64], start="random", length=4, **options)
        if set_seed is not None:
            env.set_seed(set_seed)
        return torch.stack([env.reset()["time"].div(0.103).round().long().squeeze(-1) for _ in range(20)])

    first = starts(5)
    assert (starts(5) == first).all()
    assert (starts(6) != first).any()
    assert (starts(seed=5) == starts(seed=5)).all()
    assert (starts() != starts()).any()  # torch's generator moves on
    torch.manual_seed(1)
    one = starts()
    torch.manual_seed(1)
    assert (starts() == one).all()
    # All 21 rows from which four frames fit, evenly: 1280 draws, 61 each, standard deviation 7.6.
    counts = first.flatten().bincount(minlength=ROWS)
    assert (counts[21:] == 0).all()
    assert counts[:21].min() > 61 - 5 * 7.6
    assert counts[:21].max() < 61 + 5 * 7.6
    rollout = KITTIReplayEnv(drive, batch_size=[5], start="random", length=4).rollout(20, break_when_any_done=False)
    moved = (rollout["next", "time"] - rollout["time"]).squeeze(-1)
    torch.testing.assert_close(moved, torch.full_like(moved, 0.103))


@pytest.mark.slow
def test_batched_environments(root, drive, tmp_path):
    make = partial(KITTIReplayEnv, root, "town", size=(12, 36), cache=tmp_path)
    frames = drive_frames(drive)
    rows = torch.tensor([[0, 1, 2, 3, 4, 0, 1], [7, 8, 9, 10, 11, 7, 8]])
    options = [{"start": 0, "length": 6}, {"start": 7, "length": 6}]
    for kind in (SerialEnv, ParallelEnv):
        env = kind(2, [make, make], create_env_kwargs=options)
        try:
            check_env_specs(env)
            same(env.rollout(7, break_when_any_done=False), frames, rows)
            collector = Collector(env, frames_per_batch=14)
            same(next(iter(collector)), frames, rows)
            collector.shutdown()
        finally:
            if not env.is_closed:
                env.close()
    env = SerialEnv(2, partial(make, batch_size=[3], length=6))
    check_env_specs(env)
    env = SerialEnv(2, partial(make, start="random", length=6))
    env.set_seed(0)
    draws = torch.stack([env.reset()["time"] for _ in range(10)])
    assert (draws[:, 0] != draws[:, 1]).any()  # each worker has its own seed


@pytest.mark.parametrize("batch_size", [[], [2]])
def test_collectors_and_replay_buffers(drive, tmp_path, batch_size):
    make = partial(KITTIReplayEnv, drive, batch_size=batch_size, start=2, length=6)
    collector = Collector(make, None, frames_per_batch=14, total_frames=28)
    batches = list(collector)
    collector.shutdown()
    stretch = 14 // max(1, sum(batch_size))
    rows = 2 + torch.arange(2 * stretch) % 5
    for batch, expected in zip(batches, rows.split(stretch), strict=True):
        same(batch, drive_frames(drive), expected.expand(*batch_size, -1))
    for storage in (LazyTensorStorage(14), LazyMemmapStorage(14, scratch_dir=tmp_path / "memmap")):
        buffer = TensorDictReplayBuffer(storage=storage, batch_size=5)
        buffer.extend(batches[0].reshape(-1))
        assert buffer.sample()["pixels"].shape == (5, 6, 12, 36)


def test_a_policy_that_writes_no_action(drive):
    def policy(tensordict: TensorDict) -> TensorDict:
        return tensordict.set("seen", tensordict["pixels"].mean((-3, -2, -1)).unsqueeze(-1))

    rollout = SerialEnv(2, partial(KITTIReplayEnv, drive)).rollout(5, policy)
    assert rollout["seen"].shape == (2, 5, 1)
    collector = Collector(partial(KITTIReplayEnv, drive), policy, frames_per_batch=10, total_frames=10)
    assert next(iter(collector))["seen"].shape == (10, 1)
    collector.shutdown()


def test_transforms(drive):
    env = TransformedEnv(KITTIReplayEnv(drive, length=5), Compose(InitTracker("starts"), StepCounter()))
    check_env_specs(env)
    rollout = env.rollout(9, break_when_any_done=False)
    assert (rollout["starts"] == rollout["is_init"]).all()
    assert rollout["step_count"].flatten().tolist() == [0, 1, 2, 3, 0, 1, 2, 3, 0]


def test_the_pair_that_shows_a_speed_is_labelled_with_it():
    """5 m/s, then 12 m/s from the step into frame 7 on; a mark's column shows where the car is."""
    rows, dt = 12, 0.1
    speed = torch.tensor([5.0] * 7 + [12.0] * 5, dtype=torch.float64)
    velocities = torch.stack([speed, torch.zeros(rows)], -1)
    path = dead_reckoning(velocities, torch.zeros(3, dtype=torch.float64), dt).numpy()
    state = torch.from_numpy(poses_to_state(state_to_poses(path), dt)).float()
    place = (state[:, 0] * 10).round().long()  # a tenth of a metre for each pixel
    image = torch.zeros(rows, 1, 1, 100, dtype=torch.uint8)
    image[torch.arange(rows), 0, 0, place] = 255
    drive = TensorDict(
        {
            "image": image,
            "frame_valid": torch.ones(rows, 1, dtype=torch.bool),
            "state": state,
            "time": dt * torch.arange(rows, dtype=torch.float64).unsqueeze(-1),
            "dt": torch.full((rows, 1), dt),
        },
        [rows],
    )
    rollout = KITTIReplayEnv(drive).rollout(100)["next"]
    difference = rollout["pixels"][:, 1, 0]
    moved = (difference.argmax(-1) - difference.argmin(-1)) / 10  # in the images, in m
    assert rollout["observed"].all()
    torch.testing.assert_close(moved / dt, rollout["state"][:, 3])
    assert rollout["state"][:, 3].tolist() == pytest.approx([5.0] * 6 + [12.0] * 5)


def test_errors_say_what_to_do(root, drive):
    with pytest.raises(TypeError, match=r"name the sequence to replay.*list_kitti_drives"):
        KITTIReplayEnv(root)
    with pytest.raises(TypeError, match="not both"):
        KITTIReplayEnv(drive, "town")
    with pytest.raises(FileNotFoundError, match=r"no folder .*sequences/09"):
        KITTIReplayEnv(root, "09")
    with pytest.raises(ValueError, match="random starts need the number of frames"):
        KITTIReplayEnv(drive, start="random")
    with pytest.raises(ValueError, match="or 'random', got 'first'"):
        KITTIReplayEnv(drive, start="first", length=3)
    for options in ({"start": 20, "length": 5}, {"start": -1}, {"length": 1}, {"start": ROWS - 1}):
        with pytest.raises(ValueError, match=r"do not fit in a drive of 24 rows.*at least 2 frames"):
            KITTIReplayEnv(drive, **options)
