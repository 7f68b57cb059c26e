"""The data set's rows are the drives' frames, in whatever order torchrl asks for them."""

from functools import partial

import cv2
import numpy as np
import pytest
import torch
from torchrl.data.datasets import BaseDatasetExperienceReplay

from tests.applications.car.kitti.test_drive import make
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
    """Writes three drives with a gap in the town, and a second camera in the town and the lane."""
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


def test_cameras(tmp_path):
    make(tmp_path, camera="image_0", grey=True, sequence="00")
    make(tmp_path, camera="image_3", sequence="00")
    make(tmp_path, camera="image_0", grey=True, sequence="01")
    make(tmp_path, camera="image_1", grey=True, sequence="01")

    def chosen(**options):
        return [(e.drive, e.camera) for e in open_dataset(tmp_path, **options).episodes]

    assert chosen() == [("00", "image_0"), ("01", "image_0")]
    # Both cameras of one kind, colour before grey.
    assert chosen(cameras="both") == [("00", "image_3"), ("01", "image_0"), ("01", "image_1")]
    assert chosen(cameras=["image_1", "image_0"], drives=1) == [("01", "image_1"), ("01", "image_0")]
    data = open_dataset(tmp_path, cameras="both", colour=False)
    assert data[:]["pixels"].shape == (18, 2, *SIZE)
    assert (data[0]["calibration"] != data[6]["calibration"]).any()  # each camera has its own
    with pytest.raises(ValueError, match=r"01/image_0 has frames of {'image': \(1, .*00/image_3 has .*\(3, .*colour"):
        open_dataset(tmp_path, cameras="both", colour=None)


def fails(error, match, root, **options):
    with pytest.raises(error, match=match):
        open_dataset(root, **options)


def test_folders_that_lack_something(tmp_path):
    (tmp_path / "sequences").mkdir()
    fails(FileNotFoundError, r"no drive below .* has both images and poses: it is empty; download KITTI", tmp_path)
    make(tmp_path, sequence="05", images=[])
    make(tmp_path, sequence="07")
    (tmp_path / "poses/07.txt").unlink()
    message = r"no poses/07.txt; no images sequences/NAME/image_\*/FFFFFF.png for \['05'\]"
    fails(FileNotFoundError, message, tmp_path)
    make(tmp_path, sequence="02")
    assert [e.drive for e in open_dataset(tmp_path).episodes] == ["02"]
    # Asked for by name, they are errors.
    fails(FileNotFoundError, r"no images in .*sequences/05; expected FFFFFF.png", tmp_path, drives=["02", "05"])
    fails(FileNotFoundError, r"no images in .*sequences/05", tmp_path, drives=["05"], cameras="both")
    fails(FileNotFoundError, r"no poses at .*poses/07.txt; download", tmp_path, drives=["07"])
