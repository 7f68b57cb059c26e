"""The data set's rows are the drives' frames, in whatever order torchrl asks for them."""

from functools import partial

import cv2
import numpy as np
import pytest
import torch
from torchrl.data.datasets import BaseDatasetExperienceReplay

from tests.data import replay_for_tests as shared
from torch_denkf.applications.car import KITTIOdometryExperienceReplay, read_kitti_drive, write_drives
from torch_denkf.applications.car.kitti.frames import drive_frames
from torch_denkf.applications.car.kitti.mirror import mirror_drive

SIZE = (12, 36)
LENGTHS = {"hill": 14, "lane": 9, "town": 23}
KEYS = ("pixels", "state", "observed", "time")
open_dataset = partial(KITTIOdometryExperienceReplay, size=SIZE, cache=None)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Three drives; a gap in the town, and a second camera in the town and the lane."""
    folder = tmp_path_factory.mktemp("kitti")
    for name, frames in LENGTHS.items():
        write_drives(folder, name, frames=frames, size=SIZE)
    for name in ("town", "lane"):
        second = folder / "sequences" / name / "image_3"
        second.mkdir()
        for file in (folder / "sequences" / name / "image_2").iterdir():
            cv2.imwrite(str(second / file.name), 255 - cv2.imread(str(file)))
    (folder / "sequences/town/image_2/000007.png").unlink()
    return folder


def expected_rows(root, episode, **options):
    drive = read_kitti_drive(root, episode.drive, camera=episode.camera, size=SIZE, cache=None, **options)
    return drive_frames(mirror_drive(drive) if episode.mirrored else drive), drive


def test_all_rows(root):
    data = open_dataset(root, cameras="both", mirrored=True)
    assert isinstance(data, BaseDatasetExperienceReplay)
    assert [(e.drive, e.camera, e.mirrored, e.length) for e in data.episodes] == [
        (drive, camera, mirrored, LENGTHS[drive])
        for drive, camera in [
            ("hill", "image_2"),
            ("lane", "image_2"),
            ("lane", "image_3"),
            ("town", "image_2"),
            ("town", "image_3"),
        ]
        for mirrored in (False, True)
    ]
    assert len(data) == 2 * (14 + 2 * 9 + 2 * 23)
    rows = data[:]
    for episode in data.episodes:
        mine = rows[episode.start : episode.start + episode.length]
        frames, drive = expected_rows(root, episode)
        for key in KEYS:
            torch.testing.assert_close(mine[key], frames[key], rtol=0, atol=0)
        for key in ("frame", "dt"):
            assert (mine[key] == drive[key]).all()
        calibration = drive["calibration"].clone()
        if episode.mirrored:
            calibration[:, 2] = 35 - calibration[:, 2]
        assert (mine["calibration"] == calibration).all()
    shared.check_contract(data)
    shared.check_indices(data)


def test_statistics_by_hand(root):
    """Takes the training drives alone: numpy, from the PNGs of those two drives."""
    data = open_dataset(root, ["hill", "town"])
    frames, differences, states = [], [], []
    for name in ("hill", "town"):
        before = None
        for k in range(LENGTHS[name]):
            image = cv2.imread(str(root / f"sequences/{name}/image_2/{k:06d}.png"))
            image = None if image is None else image[..., ::-1].astype(np.float64) / 255
            if image is not None:
                frames.append(image)
                if before is not None:
                    differences.append(image - before)
            before = image
        states.append(read_kitti_drive(root, name, cache=None)["state"].numpy())
    states, both = np.concatenate(states), [np.stack(frames), np.stack(differences)]
    assert [len(part) for part in both] == [14 + 22, 13 + 20]
    statistics = data.statistics
    for name, function in (("mean", np.mean), ("std", np.std)):
        expected = np.concatenate([function(part, axis=(0, 1, 2)) for part in both])
        np.testing.assert_allclose(statistics["pixels", name].flatten(), expected, atol=2e-6)
    shared.check_statistics(statistics, velocity=states[:, 3:], state=states)
    assert statistics["pixels", "mean"].shape == (6, 1, 1)
    others = open_dataset(root).statistics
    assert abs(others["velocity", "mean"][0] - statistics["velocity", "mean"][0]) > 0.01  # the lane would count


# The rest of torchrl's interface -------------------------------------------------------------------------------------
