"""Pairs across gaps, by hand and against a search row by row."""

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.applications.car import read_kitti_drive, with_motion, write_drives
from torch_denkf.applications.car.kitti.frames import frames_at
from torch_denkf.applications.car.kitti.gaps import bridge_gaps, steps_between


def searched(valid, longest):
    """Counts steps back to the last existing frame, by a loop."""
    steps = []
    for row, there in enumerate(valid):
        back = next((n for n in range(1, longest + 1) if row >= n and valid[row - n]), 0)
        steps.append(back if there else 0)
    return steps


@pytest.mark.parametrize("longest", [1, 2, 3, 7])
def test_steps_are_those_that_a_search_finds(longest):
    valid = torch.rand(3, 400, generator=torch.Generator().manual_seed(longest)) < 0.5
    expected = [searched(row, longest) for row in valid.tolist()]
    assert steps_between(valid, longest).tolist() == expected
    for row in range(3):
        drive = TensorDict({"frame_valid": valid[row].unsqueeze(-1)}, [400])
        assert bridge_gaps(drive, longest)["steps"].flatten().tolist() == expected[row]
        assert "steps" not in drive


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drives")
    drive = read_kitti_drive(folder, *write_drives(folder, ["town"], frames=14, seed=1), colour=False, cache=None)
    valid = drive["frame_valid"].clone()
    valid[[3, 6, 7, 9, 10, 11]] = False
    return drive.set("frame_valid", valid).set("image", torch.where(valid[..., None, None], drive["image"], 0))


def test_differences_and_flow_are_those_of_the_frames_left_side_by_side(drive):
    whole = bridge_gaps(drive)
    assert whole["steps"].flatten().tolist() == [0, 1, 1, 0, 2, 1, 0, 0, 3, 0, 0, 0, 0, 1]
    assert frames_at(whole, torch.tensor([4, 8, 12]))["observed"].flatten().tolist() == [True, True, False]
    kept = whole["frame_valid"].squeeze(-1)
    pixels, left = frames_at(whole, torch.arange(14))["pixels"], drive[kept].contiguous()
    seen = whole["steps"][kept].squeeze(-1) > 0  # of 8 and 12 the pair is too far apart
    motion, expected = with_motion(whole, cache=None), with_motion(left, cache=None)
    beside = frames_at(left, torch.arange(len(left)))["pixels"]
    assert pixels[kept][seen].equal(beside[seen])
    for key in ("flow", "road"):
        assert motion[key][kept][seen].equal(expected[key][seen])
        assert not motion[key][~kept].any()
        assert not motion[key][12].any()
