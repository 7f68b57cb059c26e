"""A data set of folders and files that lack something, are damaged, or contradict each other: errors name them."""

from functools import partial

import cv2
import numpy as np
import pytest
import torch
from torchrl.data import SliceSampler

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


def test_damaged_files(tmp_path):
    make(tmp_path, sequence="00")
    make(tmp_path, sequence="01", size=(40, 60))
    folder = tmp_path / "sequences/01/image_2"
    noisy = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
    cv2.imwrite(str(folder / "000004.png"), noisy)
    data = (folder / "000004.png").read_bytes()
    (folder / "000004.png").write_bytes(data[: len(data) // 2])  # truncated
    (folder / "000002.png").write_bytes(data[:30] + b"?" * 200 + data[230:])  # corrupt, though its end is there
    with pytest.warns(UserWarning, match="is not a complete PNG image") as caught:
        rows = open_dataset(tmp_path, ["00", "01"])[:]
    named = {str(folder / name) for name in ("000002.png", "000004.png")}
    assert {str(warning.message).split(" is ")[0] for warning in caught} == named
    assert rows["observed"][6:].flatten().tolist() == [False, True, False, False, False, False]
    assert not rows["pixels"][[8, 10]].any()
    for name in folder.iterdir():
        name.write_bytes(b"nothing")
    with pytest.warns(UserWarning, match="PNG"):
        fails(ValueError, r"none of the 6 images in .*sequences/01/image_2 can be read", tmp_path)


def test_files_that_contradict_each_other(tmp_path):
    make(tmp_path)
    make(tmp_path, images=[3], size=(37, 122))
    fails(ValueError, r"000003.png is 122 pixels wide and 37 high, but .*000000.png is 30 pixels wide", tmp_path)
    make(tmp_path)
    lines = (tmp_path / "poses/00.txt").read_text().splitlines()
    (tmp_path / "poses/00.txt").write_text("\n".join([*lines[:2], lines[2] + " 7", *lines[3:]]))
    fails(ValueError, r"poses/00.txt:3: expected 12 finite numbers", tmp_path)
    fails(ValueError, r"size is \(height, width\)", tmp_path, size=(0, 5))


def test_drives_shorter_than_a_slice(tmp_path):
    root = tmp_path
    for name, frames in (("hill", 14), ("lane", 9), ("town", 23)):
        make(root, sequence=name, images=range(frames), poses=range(frames))
    message = r"slices have 15 rows, but 2 episodes are shorter: {'hill/image_2': 14, 'lane/image_2': 9}; pass"
    fails(ValueError, message, root, batch_size=30, num_slices=2)
    fails(ValueError, message, root, batch_size=30, slice_len=15)
    fails(ValueError, message, root, batch_size=30, sampler=SliceSampler(num_slices=2))
    data = open_dataset(root, batch_size=30, num_slices=2, strict_length=False)
    for _ in range(20):  # the short ones come whole
        sample = data.sample()
        ends = sample["next", "truncated"].flatten().nonzero().flatten() + 1
        lengths = ends.diff(prepend=torch.zeros(1, dtype=torch.int64))
        assert lengths.tolist() == [min(15, data.episodes[k].length) for k in sample["episode"][ends - 1]]
    assert open_dataset(root, "town", batch_size=30, num_slices=2).sample().shape == (2, 15)
    fails(ValueError, "either a sampler", root, num_slices=2, sampler=SliceSampler(num_slices=2))
    fails(ValueError, "num_slices=2 times slice_len=3 is 6 rows", root, num_slices=2, slice_len=3, batch_size=7)
