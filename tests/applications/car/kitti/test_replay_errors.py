"""A data set of folders and files that lack something, are damaged, or contradict each other: errors name them."""

from functools import partial

import pytest

from tests.applications.car.kitti.test_drive import make
from torch_denkf.applications.car import KITTIOdometryExperienceReplay

open_dataset = partial(KITTIOdometryExperienceReplay, size=(12, 36), cache=None)


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
