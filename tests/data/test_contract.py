"""Tests what all data sets share: shapes of samples, splits, options; and what filters make of their samples."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors.utils import split_trajectories
from torchrl.data import SliceSampler

import torch_denkf
import torch_denkf.data
from tests.data.replay_for_tests import check_contract, check_slices, check_statistics, ways_to_slice
from torch_denkf.applications.car import write_drives
from torch_denkf.data import Episode, EpisodeReplay, LeRobotReplay
from torch_denkf.data.episodes import hashed_share
from torch_denkf.data.lerobot.rows import recording_from_rows
from torch_denkf.filters import DEnKF
from torch_denkf.objectives import DEnKFLoss

ROWS = 12


def make(count=10, *, for_tests=lambda episode: False, lengths=None, **options):
    """Returns episodes whose numbers tell where they are: state (episode, step), action (100 episode + step)."""
    lengths = lengths or [ROWS] * count
    step = torch.cat([torch.arange(length) for length in lengths]).unsqueeze(-1)
    number = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths)).unsqueeze(-1)
    rows = {"step": step, "time": 0.1 * step.double(), "state": torch.cat([number, step], -1).float()}
    rows["action"] = (100 * number + step).float()
    starts = [sum(lengths[:k]) for k in range(len(lengths))]
    episodes = [Episode(f"run{k}", *at) for k, at in enumerate(zip(starts, lengths, strict=True))]
    return EpisodeReplay(TensorDict(rows, [len(step)]), episodes, for_tests=for_tests, **options)


def test_a_split_keeps_the_contract():
    data = make(for_tests=lambda episode: episode.name in ("run0", "run4"))
    check_contract(data)
    assert [e.name for e in data.episodes] == ["run1", "run2", "run3", "run5", "run6", "run7", "run8", "run9"]
    assert data[:]["state"][:, 0].unique_consecutive().tolist() == [1, 2, 3, 5, 6, 7, 8, 9]
    assert data.root is None


def test_rollouts_are_episodes_with_statistics_of_all_that_was_seen():
    """Leaves masked pictures and readings out of the statistics; the rows are the root's."""
    shape = [4, ROWS]
    seen, read = torch.rand(*shape, 1) < 0.5, torch.rand(*shape, 1) < 0.5
    root = TensorDict({"state": torch.randn(*shape, 2), "action": torch.randn(*shape, 1).double()}, shape)
    root["pixels"] = torch.randint(256, (*shape, 3, 4, 4), dtype=torch.uint8) * seen[..., None, None]
    root["encoder"], root["observed"], root["encoder_observed"] = torch.randn(*shape, 2) * read, seen, read
    done = (torch.arange(ROWS) == ROWS - 1).reshape(1, ROWS, 1).expand(*shape, 1)
    rollouts = root.copy().set("next", root.roll(-1, 1)).set(("next", "done"), done).set("done", torch.zeros_like(done))
    data = EpisodeReplay.from_rollouts(rollouts, 0.1, split="all", num_slices=2, slice_len=5)
    check_contract(data)
    assert data[:]["state"].equal(root["state"].flatten(0, 1))
    assert data[:]["pixels"].equal(root["pixels"].flatten(0, 1) / 255)
    numbers = {key: root[key].float().flatten(0, 1).numpy() for key in ("state", "action")}
    numbers["encoder"] = root["encoder"][read.squeeze(-1)].numpy()
    check_statistics(data.statistics, **numbers)
    pixels = root["pixels"][seen.squeeze(-1)].double() / 255
    torch.testing.assert_close(data.statistics["pixels", "mean"].flatten().double(), pixels.mean((0, 2, 3)))
    assert sorted(data.statistics.keys()) == ["action", "encoder", "pixels", "state"]
    held = EpisodeReplay.from_rollouts(rollouts, 0.1, split="validation", validation_share=0.5)
    assert {episode.name for episode in held.episodes} == {
        str(k) for k in range(4) if hashed_share(str(k), "validation") < 0.5
    }
    with pytest.raises(ValueError, match="ends before its last row"):
        EpisodeReplay.from_rollouts(rollouts.roll(1, 1), 0.1)
    for strange in (root["pixels"] / 255, root["pixels"].movedim(2, -1)):
        with pytest.raises(ValueError, match=r"uint8 \[T, C, H, W\]"):
            EpisodeReplay.from_rollouts(rollouts.set("pixels", strange), 0.1)


@pytest.mark.parametrize("ends", [False, True])
def test_padding_of_a_rollout_is_no_row(ends):
    """torchrl's split_trajectories pads the shorter ones with zeros, and marks that."""
    done = torch.zeros(2, ROWS, 1, dtype=torch.bool)
    done[0, 2] = ends
    rollouts = TensorDict({"state": torch.randn(2, ROWS, 1), "next": {"done": done}, "done": done.clone()}, [2, ROWS])
    number = torch.stack([(torch.arange(ROWS) > 2).long(), torch.full((ROWS,), 2)])
    rollouts["collector", "traj_ids"] = number
    data = EpisodeReplay.from_rollouts(split_trajectories(rollouts), 0.1)
    assert [episode.length for episode in data.episodes] == [3, ROWS - 3, ROWS]
    assert data[:]["state"].equal(rollouts["state"].flatten(0, 1))


def test_rollouts_of_a_policy_hold_no_graph_and_nested_numbers_count():
    td = TensorDict({"next": {"done": torch.zeros(1, ROWS, 1, dtype=torch.bool)}}, [1, ROWS])
    td["action"], td["robot", "speed"] = torch.randn(1, ROWS, 2, requires_grad=True), torch.randn(1, ROWS, 3)
    td["pixels"] = torch.randint(256, (1, ROWS, 3, 4, 4), dtype=torch.uint8)
    td["observed"] = torch.tensor([True, False]).expand(1, ROWS, 2)  # of two readings
    data = EpisodeReplay.from_rollouts(td, 0.1)
    assert not data[:]["action"].requires_grad
    torch.testing.assert_close(data.statistics["robot", "speed", "mean"], td["robot", "speed"].mean((0, 1)))
    pixels = td["pixels"].double().mean((0, 1, 3, 4)) / 255
    torch.testing.assert_close(data.statistics["pixels", "mean"].flatten().double(), pixels)


# Samples --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", ways_to_slice(), ids=lambda options: " ".join(options))
def test_slices_are_in_one_episode(options):
    check_slices(make(5, **{"batch_size": 24, **options}), options, "step", ("state", "action", "time"))


def test_user_transforms_see_slices():
    seen = []
    data = make(num_slices=3, slice_len=4, transform=lambda rows: seen.append(rows.shape) or rows)
    assert data.sample().shape == (3, 4)
    assert seen == [(3, 4)]


def test_slices_that_may_be_shorter_stay_flat():
    data = make(lengths=[3, 12, 12], batch_size=8, slice_len=4, strict_length=False)
    for _ in range(20):
        sample = data.sample()
        assert sample.batch_dims == 1
        # Each begins where it is marked, and continues by one step.
        begins = sample["is_init"].squeeze(-1)
        assert begins[0]
        assert (sample["step"].diff(dim=0).squeeze(-1)[~begins[1:]] == 1).all()
    padded = make(
        lengths=[3, 12, 12], batch_size=8, sampler=SliceSampler(slice_len=4, strict_length=False, pad_output=True)
    )
    masks = torch.cat([padded.sample()["collector", "mask"] for _ in range(20)])
    assert masks.shape == (40, 4)
    assert set(masks.sum(-1).tolist()) <= {3, 4}
    spans = make(batch_size=8, sampler=SliceSampler(slice_len=4, span=True))
    assert spans.sample().batch_dims == 1


# Splits ---------------------------------------------------------------------------------------------------------------


def names(**options):
    return {episode.name for episode in make(**options).episodes}


def test_validation_split_is_optional():
    def for_tests(episode):
        return hashed_share(episode.name, "test") < 0.25

    everything = {f"run{k}" for k in range(200)}
    test = names(count=200, for_tests=for_tests, split="test")
    train = names(count=200, for_tests=for_tests)
    assert train == everything - test == names(count=200, for_tests=for_tests, split="train")
    assert 30 < len(test) < 70  # 50, standard deviation 6.1
    parts = [
        names(count=200, for_tests=for_tests, split=s, validation_share=0.1) for s in ("train", "validation", "test")
    ]
    assert parts[2] == test
    assert parts[0] | parts[1] == train
    assert not parts[0] & parts[1]
    assert 5 <= len(parts[1]) <= 27  # 15 of 150, standard deviation 3.7
    more = names(count=200, for_tests=for_tests, split="validation", validation_share=0.2)
    assert parts[1] < more
    # Episodes that are added move none.
    fewer = names(count=120, for_tests=for_tests, split="validation", validation_share=0.2)
    assert fewer == {name for name in more if int(name[3:]) < 120}
    assert names(count=200, for_tests=for_tests, split="all") == everything


def test_statistics_are_of_the_training_episodes_whatever_the_split():
    for split in ("train", "validation", "test", "all"):
        data = make(5, for_tests=lambda episode: episode.name == "run1", split=split, validation_share=0.5)
        held = [k for k in range(5) if hashed_share(f"run{k}", "validation") < 0.5 and k != 1]
        train = [k for k in range(5) if k != 1 and k not in held]
        assert held
        assert data.statistics["state", "mean"].tolist() == pytest.approx([sum(train) / len(train), (ROWS - 1) / 2])
        assert data.statistics["action", "mean"].item() == pytest.approx(100 * sum(train) / len(train) + 5.5)
    with pytest.raises(ValueError, match="none of the episodes in memory is in the training split"):
        _ = make(2, for_tests=lambda episode: True, split="test").statistics


def test_cameras_and_mirror_images_of_a_drive_stay_together(tmp_path):
    write_drives(tmp_path, ["hill", "lane", "town"], frames=6, size=(12, 36))
    kitti = torch_denkf.applications.car.KITTIOdometryExperienceReplay
    options = {"size": (12, 36), "cache": None, "mirrored": True}
    sides = {k: hashed_share(k, "test") for k in ("hill", "lane", "town")}
    share = sorted(sides.values())[0] + 1e-6  # one drive
    test = kitti(tmp_path, test_share=share, split="test", **options)
    assert {e.drive for e in test.episodes} == {min(sides, key=sides.get)}
    assert len(test.episodes) == 2
    train = kitti(tmp_path, test_share=share, **options)
    assert len(train.episodes) == 4
    assert (train.statistics == test.statistics).all()
    everything = kitti(tmp_path, **options)
    assert len(everything.episodes) == 6
    assert (everything.statistics["velocity"] != test.statistics["velocity"]).any()
    named = kitti(tmp_path, sorted({e.drive for e in train.episodes}), **options)
    torch.testing.assert_close(named.statistics, test.statistics)
    assert (everything.statistics["pixels"] != test.statistics["pixels"]).any()


# Options --------------------------------------------------------------------------------------------------------------


def test_options_that_are_wrong():
    def fails(error, match, **options):
        with pytest.raises(error, match=match):
            make(**options)

    fails(TypeError, "no option slice_length; there are .*'slice_len'", slice_length=3)
    fails(ValueError, r"in \[0, 1\), got 1.5", validation_share=1.5)
    fails(ValueError, "pass validation_share=0.1", split="validation")
    with pytest.raises(ValueError, match="test_share is a share of all episodes"):
        torch_denkf.applications.car.KITTIOdometryExperienceReplay("nowhere", test_share=1.5)
    fails(
        ValueError,
        "num_slices=2 times slice_len=3 is 6 rows, but batch_size=7",
        num_slices=2,
        slice_len=3,
        batch_size=7,
    )
    fails(ValueError, "either a sampler", sampler=SliceSampler(num_slices=2), slice_len=3)
    fails(ValueError, "10 episodes are shorter: {'run0': 12", num_slices=2, slice_len=13)
    fails(ValueError, "none of the 10 episodes in memory is in the split 'test'", split="test")
    with pytest.raises(TypeError, match="no option shuffle"):
        LeRobotReplay("nowhere", shuffle=True)


def test_episodes_that_do_not_fit_their_rows():
    step = torch.arange(6).unsqueeze(-1)
    rows = TensorDict({"step": step, "time": step.double()}, [6])

    def fails(error, match, rows, *episodes):
        with pytest.raises(error, match=match):
            EpisodeReplay(rows, episodes, for_tests=lambda episode: False)

    fails(KeyError, r"these lack \['time'\]", rows.exclude("time"), Episode("a", 0, 6))
    fails(ValueError, "the episodes have 5 rows, but there are 6", rows, Episode("a", 0, 5))
    fails(
        ValueError,
        r"Episode\(name='b', start=4, length=2\) comes at row 3",
        rows,
        Episode("a", 0, 3),
        Episode("b", 4, 2),
    )
    fails(ValueError, "each of at least one row", rows, Episode("a", 0, 0), Episode("b", 0, 6))


def test_losses_accept_samples():
    pictures = torch.randint(256, (60, 3, 24, 24), dtype=torch.uint8)
    rows = TensorDict({"observation": {"image": pictures, "state": torch.rand(60, 2)}}, [60])
    rows["episode"] = torch.arange(5).repeat_interleave(12)
    data = LeRobotReplay(recording_from_rows(rows, fps=10.0), num_slices=3, slice_len=4)
    denkf = DEnKF.paper(state_dim=2, observation_dim=2, image_shape=(3, 24, 24), ensemble_size=4)
    losses = DEnKFLoss(denkf, transition=0.0, sensor=0.0)(data.sample())
    sum(value for key, value in losses.items() if key.startswith("loss")).backward()
    gradients = [p.grad for p in denkf.parameters() if p.grad is not None]
    assert gradients
    assert all(g.isfinite().all() for g in gradients)
