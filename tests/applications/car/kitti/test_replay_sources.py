"""Checks which drives and cameras a data set consists of: made by hand, and real frames where they are."""

from functools import partial

import pytest

from tests.applications.car.kitti.test_drive import make
from torch_denkf.applications.car import KITTIOdometryExperienceReplay

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
