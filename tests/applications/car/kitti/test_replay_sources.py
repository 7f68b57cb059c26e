"""A data set of folders: which drives and cameras it consists of; what lacks something is named."""

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


def fails(error, match, root, **options):
    with pytest.raises(error, match=match):
        open_dataset(root, **options)


def test_folders_that_lack_something(tmp_path):
    fails(FileNotFoundError, r"no folder .*sequences; pass the folder that holds 'sequences' and 'poses'", tmp_path)
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
    fails(FileNotFoundError, r"no folder .*sequences/03; .* has \['02', '05', '07'\]", tmp_path, drives=[3])
    for wrong in ([], ["02", 2]):
        fails(ValueError, r"drives are names, each once, or None for all", tmp_path, drives=wrong)
