"""Drives along given poses are read back as given; runs are repeatable, can be resumed, and explain their errors."""

import cv2
import numpy as np
import pytest

from torch_denkf.applications.car import read_kitti_drive
from torch_denkf.applications.car.kitti import writer
from torch_denkf.applications.car.kitti.drive import list_kitti_drives
from torch_denkf.applications.car.kitti.files import write_poses
from torch_denkf.applications.car.kitti.render import random_drive, render_drives
from torch_denkf.applications.car.street.random_drive import hilly_poses
from torch_denkf.applications.car.vision.poses import KITTI_DT, poses_to_state

cv2.setNumThreads(1)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Writes a folder with pose files of two drives."""
    folder = tmp_path_factory.mktemp("recorded")
    for seed, name in enumerate(("00", "01")):
        rng = np.random.default_rng(seed)
        write_poses(folder / f"{name}.txt", hilly_poses(random_drive(30, rng), rng))
    return folder


def content(root):
    return {str(file.relative_to(root)): file.read_bytes() for file in sorted(root.rglob("*")) if file.is_file()}


def test_the_reader_gives_back_the_given_poses(recorded, tmp_path):
    assert render_drives(tmp_path, poses=recorded, frames=12, size=(25, 75), focal=0.8) == ["00", "01"]
    assert list_kitti_drives(tmp_path) == ["00", "01"]
    for name in ("00", "01"):
        drive = read_kitti_drive(tmp_path, name, size=(25, 75), cache=None)
        given = np.loadtxt(recorded / f"{name}.txt").reshape(-1, 3, 4)[:12]
        np.testing.assert_allclose(drive["state"], poses_to_state(given, KITTI_DT), atol=1e-5)
        assert drive["frame_valid"].all()
        # 0.8 of the width; rows are scaled as KITTI's 376 x 1241 to 25 x 75.
        focal = [0.8 * 75, 0.8 * 1241 * 25 / 376, 607.1928 * 75 / 1241 - 0.5, 185.2157 * 25 / 376 - 0.5]
        np.testing.assert_allclose(drive["calibration"][3], focal, rtol=1e-6)
        assert drive["image"].float().std(dim=(1, 2, 3)).min() > 15
    grey = tmp_path / "grey"
    render_drives(grey, poses=recorded, names="01", frames=12, size=(25, 75), focal=0.8, camera="image_0")
    one = cv2.imread(str(grey / "sequences/01/image_0/000005.png"), cv2.IMREAD_UNCHANGED)
    three = cv2.imread(str(tmp_path / "sequences/01/image_2/000005.png"))
    assert one.shape == (25, 75)
    assert np.abs(one.astype(float) - cv2.cvtColor(three, cv2.COLOR_BGR2GRAY)).mean() < 4  # two kinds of grain


@pytest.mark.slow
def test_bytes_depend_neither_on_processes_nor_on_interruptions(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(writer, "STRETCH", 5)
    options = {"poses": recorded, "frames": 12, "size": (12, 36)}
    render_drives(tmp_path / "one", **options)
    expected = content(tmp_path / "one")
    assert len(expected) == 2 * (12 + 4)

    render_drives(tmp_path / "two", **options, processes=2)
    assert content(tmp_path / "two") == expected

    written = []

    def stop(images):
        written.append(images)
        if sum(written) >= 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_drives(tmp_path / "three", **options, progress=stop)
    assert list_kitti_drives(tmp_path / "three") == ["00"]
    assert [entry.name for entry in (tmp_path / "three/sequences").iterdir()] == ["00"]
    first = tmp_path / "three/sequences/00/image_2/000001.png"
    before = first.stat().st_mtime_ns
    written.clear()
    render_drives(tmp_path / "three", **options, progress=written.append)
    assert written == [12, 5, 5, 2]
    assert first.stat().st_mtime_ns == before
    assert content(tmp_path / "three") == expected


def test_a_drive_that_is_there_stays(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"cannot write to .*file.*; choose another folder"):
        render_drives(tmp_path / "file", names="a", frames=2)
    render_drives(tmp_path / "out", names="a", frames=2, size=(12, 36))
    with pytest.raises(FileExistsError, match=r"sequences/a is there .*overwrite=True"):
        render_drives(tmp_path / "out", names="a", frames=3, size=(12, 36))
