"""Which drives and cameras a data set consists of: made by hand, and real frames where they are."""

import shutil
import warnings
from functools import partial

import pytest
import torch

from tests.applications.car.kitti.test_drive import make
from tests.real_data import KITTI
from torch_denkf.applications.car import KITTIOdometryExperienceReplay, read_kitti_drive
from torch_denkf.applications.car.kitti.frames import drive_frames
from torch_denkf.applications.car.kitti.mirror import mirror_drive

SIZE = (12, 36)
open_dataset = partial(KITTIOdometryExperienceReplay, size=SIZE, cache=None)


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
    for wrong in ("all", "image_2", [], ["image_0", "image_0"]):
        with pytest.raises(ValueError, match="cameras is 'first', 'both' or a sequence of folder names"):
            open_dataset(tmp_path, cameras=wrong)
    with pytest.raises(FileNotFoundError, match=r"no folder .*sequences/01/image_2"):
        open_dataset(tmp_path, cameras=["image_2"], drives="01")


def test_drives_of_other_sizes_are_scaled_with_their_calibration(tmp_path):
    make(tmp_path, sequence="00", size=(12, 36))
    make(tmp_path, sequence="01", size=(24, 72))
    rows = open_dataset(tmp_path)[:]
    torch.testing.assert_close(rows["calibration"][0], torch.tensor([30.0, 18.0, 14.5, 4.5]))
    torch.testing.assert_close(rows["calibration"][6], torch.tensor([15.0, 9.0, 7.0, 2.0]))


def test_a_drive_that_starts_later(tmp_path):
    """Row 0 is frame 2: frame k is (R, G, B) = (100 + k, 50 + k, k), and one brighter than the frame before."""
    make(tmp_path, images=[2, 3, 4, 5])
    data = open_dataset(tmp_path, mirrored=True)
    assert [episode.length for episode in data.episodes] == [4, 4]
    rows = data[:]
    assert rows["frame"].flatten().tolist() == [2, 3, 4, 5] * 2
    assert rows["step"].flatten().tolist() == [0, 1, 2, 3] * 2
    assert rows["time"][[0, 4]].flatten().tolist() == [0, 0]
    values = (255 * rows["pixels"][:, :, 5, 7]).round().int().tolist()
    assert values == [[100 + k, 50 + k, k, *[int(k > 2)] * 3] for k in (2, 3, 4, 5)] * 2


def test_real_frames(tmp_path):
    drive = "2011_09_26_drive_0039"
    if not (KITTI / "sequences" / drive / "image_1").is_dir():
        pytest.skip(f"no KITTI frames at {KITTI}")
    for camera in ("image_0", "image_1"):
        folder = tmp_path / "sequences" / drive / camera
        folder.mkdir(parents=True)
        for k in range(40):
            file = KITTI / "sequences" / drive / camera / f"{k:06d}.png"
            if file.is_file():
                (folder / file.name).symlink_to(file)
    (tmp_path / "poses").mkdir()
    shutil.copy(KITTI / "poses" / f"{drive}.txt", tmp_path / "poses")
    for name in ("calib.txt", "times.txt"):
        shutil.copy(KITTI / "sequences" / drive / name, tmp_path / "sequences" / drive)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = KITTIOdometryExperienceReplay(
            tmp_path, cameras="both", mirrored=True, colour=False, batch_size=40, num_slices=4, cache=tmp_path / "cache"
        )
    assert [(e.camera, e.mirrored, e.length) for e in data.episodes] == [
        (camera, mirrored, 40) for camera in ("image_0", "image_1") for mirrored in (False, True)
    ]
    batch = data.sample()
    assert batch.shape == (4, 10)
    for row in batch:
        episode = data.episodes[row["episode"][0]]
        drive_rows = read_kitti_drive(tmp_path, drive, camera=episode.camera, colour=False, cache=None)
        frames = drive_frames(mirror_drive(drive_rows) if episode.mirrored else drive_rows)
        for key in ("pixels", "state", "observed", "time"):
            assert row[key].equal(frames[key][row["frame"].flatten()]), key
    # Side by side, the cameras see the same turns; the pictures differ by their parallax.
    pixels = data[:]["pixels"].reshape(4, 40, 2, 50, 150)
    assert 0.005 < (pixels[0, :, 0] - pixels[2, :, 0]).abs().mean() < 0.2
    assert (data[:]["state"][:40] == data[:]["state"][80:120]).all()
