"""The data set's rows are the drives' frames, in whatever order torchrl asks for them."""

import shutil
import warnings
from functools import partial

import cv2
import numpy as np
import pytest
import torch
from tensordict import MemoryMappedTensor
from torchrl.data import SamplerWithoutReplacement, SliceSampler, SliceSamplerWithoutReplacement
from torchrl.data.datasets import BaseDatasetExperienceReplay
from torchrl.envs.transforms import ObservationNorm

import torch_denkf.data._kitti_episodes as episodes_module
import torch_denkf.data.kitti as kitti_module
from tests.data.test_kitti import KITTI, make
from torch_denkf.data import (
    KITTIOdometryExperienceReplay,
    drive_frames,
    mirror_drive,
    read_kitti_drive,
    with_motion,
    write_drives,
)

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
    assert rows["episode"].shape == (len(data),)
    for number, episode in enumerate(data.episodes):
        mine = rows[episode.start : episode.start + episode.length]
        frames, drive = expected_rows(root, episode)
        assert (mine["episode"] == number).all()
        for key in (*KEYS, "is_init"):
            torch.testing.assert_close(mine[key], frames[key], rtol=0, atol=0)
        for key in ("frame", "dt"):
            assert (mine[key] == drive[key]).all()
        calibration = drive["calibration"].clone()
        if episode.mirrored:
            calibration[:, 2] = 35 - calibration[:, 2]
        assert (mine["calibration"] == calibration).all()
        end = [False] * (episode.length - 1) + [True]
        assert mine["next", "done"].flatten().tolist() == mine["next", "truncated"].flatten().tolist() == end
        assert not mine["next", "terminated"].any()
        assert not (mine["done"] | mine["truncated"] | mine["terminated"]).any()
    assert data.episodes[-1].start + data.episodes[-1].length == len(data)
    assert data[5].batch_size == ()
    assert (data[5]["pixels"] == rows["pixels"][5]).all()
    assert data[torch.tensor([70, 3, 3])]["state"].equal(rows["state"][[70, 3, 3]])


@pytest.mark.parametrize(
    "options",
    [
        {"num_slices": 4},
        {"slice_len": 6},
        {"sampler": SliceSampler(num_slices=4)},
        {"sampler": SliceSampler(num_slices=4, end_key=("next", "done"))},
        {"sampler": SliceSamplerWithoutReplacement(num_slices=2), "batch_size": 12},
        {"num_slices": 4, "prefetch": 2},
    ],
)
def test_slices_are_contiguous_and_in_one_episode(root, options):
    data = open_dataset(root, mirrored=True, **{"batch_size": 24, **options})
    rows = data[:]
    starts = set()
    for _ in range(40):
        flat = data.sample()
        batch = flat.reshape(-1, 6)
        slices = len(batch)
        assert (batch["episode"] == batch["episode"][:, :1]).all()
        assert (batch["frame"].diff(dim=1) == 1).all()
        index = flat["index"].reshape(-1, 6)
        assert (index.diff(dim=1) == 1).all()
        for key in KEYS:
            assert (batch[key] == rows[key][index]).all(), key
        assert batch["is_init"].squeeze(-1).tolist() == [[True] + [False] * 5] * slices
        assert batch["next", "truncated"].squeeze(-1).tolist() == [[False] * 5 + [True]] * slices
        assert slices == data._batch_size // 6
        starts |= set(index[:, 0].tolist())
    # 18 + 8 + 36 windows fit in the drives and as many in their mirror images; most have turned up in 160 draws.
    if not isinstance(options.get("sampler"), SliceSamplerWithoutReplacement):
        possible = {e.start + k for e in data.episodes for k in range(e.length - 5)}
        assert starts <= possible
        assert len(starts) > 0.75 * len(possible)


def test_single_rows(root):
    data = open_dataset(root, ["town", "lane"], batch_size=8, sampler=SamplerWithoutReplacement())
    seen = torch.cat([batch["index"] for batch in data])
    assert sorted(seen.flatten().tolist()) == list(range(23 + 9))
    rows = data[:]
    batch = data.sample()
    assert (batch["pixels"] == rows["pixels"][batch["index"].flatten()]).all()
    # The gap blinds two rows; row 8 has a frame, but no difference.
    assert (~rows["observed"][:23]).flatten().nonzero().flatten().tolist() == [0, 7, 8]
    assert not rows["pixels"][7].any()
    assert rows["pixels"][8, :3].any()
    assert not rows["pixels"][8, 3:].any()


def test_statistics_by_hand(root):
    """Of the training drives alone: numpy, from the PNGs of those two drives."""
    data = open_dataset(root, ["hill", "town"])
    frames, differences, velocities = [], [], []
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
        velocities.append(read_kitti_drive(root, name, cache=None)["state"][:, 3:].double().numpy())
    velocities, both = np.concatenate(velocities), [np.stack(frames), np.stack(differences)]
    assert [len(part) for part in both] == [14 + 22, 13 + 20]
    statistics = data.statistics
    for name, function in (("mean", np.mean), ("std", np.std)):
        expected = np.concatenate([function(part, axis=(0, 1, 2)) for part in both])
        np.testing.assert_allclose(statistics["pixels", name].flatten(), expected, atol=2e-6)
        np.testing.assert_allclose(statistics["velocity", name], function(velocities, axis=0), rtol=1e-5)
    assert statistics["pixels", "mean"].shape == (6, 1, 1)
    others = open_dataset(root).statistics
    assert abs(others["velocity", "mean"][0] - statistics["velocity", "mean"][0]) > 0.01  # the lane would count


def test_statistics_of_mirrored_drives(root):
    plain, mirrored = open_dataset(root).statistics, open_dataset(root, mirrored=True).statistics
    assert abs(plain["velocity", "mean"][1]) > 1e-3
    assert abs(mirrored["velocity", "mean"][1]) < 1e-9
    expected = (plain["velocity", "std"][1] ** 2 + plain["velocity", "mean"][1] ** 2).sqrt()
    torch.testing.assert_close(mirrored["velocity", "std"][1], expected)
    torch.testing.assert_close(mirrored["velocity", "mean"][0], plain["velocity", "mean"][0])
    torch.testing.assert_close(mirrored["pixels"], plain["pixels"])


def test_transforms_see_the_pixels(root):
    training = open_dataset(root, ["hill", "lane"]).statistics["pixels"]
    norm = ObservationNorm(training["mean"], training["std"], in_keys=["pixels"], standard_normal=True)
    data = open_dataset(root, ["hill", "lane"], transform=norm)
    frames = data[:]["pixels"][:, :3]
    torch.testing.assert_close(frames.mean((0, 2, 3)), torch.zeros(3), atol=1e-4, rtol=0)
    torch.testing.assert_close(frames.std((0, 2, 3), correction=0), torch.ones(3), atol=1e-4, rtol=0)
    doubled = open_dataset(root, "lane", transform=lambda rows: rows.set("double", 2 * rows["pixels"]), batch_size=4)
    doubled.append_transform(lambda rows: rows.set("more", 2 * rows["double"]))
    sample = doubled.sample()
    assert (sample["more"] == 4 * sample["pixels"]).all()


def test_flow(root, tmp_path):
    """Added once for each drive and camera, mirrored with its episode, with or without pixels."""
    calls = []

    def flow(drive, **options):
        calls.append(len(drive))
        return with_motion(drive, cache=tmp_path, **options)

    data = open_dataset(root, ["lane", "town"], mirrored=True, flow=flow)
    assert calls == [9, 23]
    rows = data[:]
    for episode in data.episodes:
        _, drive = expected_rows(root, episode)
        drive = with_motion(drive, cache=tmp_path)
        frames = drive_frames(mirror_drive(drive) if episode.mirrored else drive)
        for key in ("flow", "road", "pixels"):
            assert rows[key][episode.start : episode.start + episode.length].equal(frames[key]), key
    assert rows["flow"][1, 0].any()
    assert not (rows["flow"][1] == rows["flow"][1 + 9]).all()  # the lane's mirror image
    light = open_dataset(root, ["lane", "town"], mirrored=True, flow=partial(flow, keep_images=False))
    assert "pixels" not in light[:]
    assert light[:]["flow"].equal(rows["flow"])
    assert light[:]["calibration"].equal(rows["calibration"])
    assert set(light.statistics.keys()) == {"velocity"}
    for bad in (lambda drive: drive, lambda drive: flow(drive)[1:]):
        with pytest.raises(ValueError, match=r"flow must return the drive with 'flow', 9 rows of it; for lane/image_2"):
            open_dataset(root, "lane", flow=bad)


def test_the_cache_is_mapped_and_opens_without_decoding(root, tmp_path, monkeypatch):
    options = {"cameras": "both", "mirrored": True, "cache": tmp_path}
    first = open_dataset(root, **options)
    entries = sorted(path.name for path in tmp_path.iterdir())
    assert len(entries) == 5  # mirror images take no space
    with monkeypatch.context() as patch:
        patch.setattr(kitti_module, "_decode", None)
        again = open_dataset(root, **options)
    assert all(isinstance(drive["image"], MemoryMappedTensor) for drive in again._drives)
    assert (again[:] == first[:]).all()
    assert "pixels" not in again._storage[:]
    assert sum(value.nbytes for value in again._storage[:].values(True, True)) < 120 * len(again)
    assert sorted(path.name for path in tmp_path.iterdir()) == entries


def test_a_bar_counts_what_is_decoded(root, tmp_path, monkeypatch):
    bars = []

    class Bar:
        def __init__(self, total, initial, disable, **_):
            self.total, self.n, self.closed = total, initial, False
            assert disable is None  # silent without a terminal
            bars.append(self)

        def update(self, count):
            self.n += count

        def close(self):
            self.closed = True

    monkeypatch.setattr(episodes_module, "tqdm", Bar)
    open_dataset(root, "hill", cache=tmp_path)
    assert [(bar.n, bar.total, bar.closed) for bar in bars] == [(14, 14, True)]
    open_dataset(root, "hill", cache=tmp_path)  # from the cache: no bar
    open_dataset(root, progress=False)
    assert len(bars) == 1
    open_dataset(root, ["hill", "lane", "town"], cache=tmp_path)  # what is there counts as done
    assert [(bar.n, bar.total, bar.closed) for bar in bars[1:]] == [(14 + 9 + 22,) * 2 + (True,)]
    open_dataset(root, "lane", cache=tmp_path, flow=partial(with_motion, cache=None))
    assert [(bar.n, bar.total) for bar in bars[2:]] == [(18, 18)]
    monkeypatch.setattr(episodes_module, "tqdm", None)  # not installed
    open_dataset(root, "lane")


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


# Bad input -----------------------------------------------------------------------------------------------------------


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
    message = r"no poses/NAME.txt for \['07'\]; no images sequences/NAME/image_\*/FFFFFF.png for \['05'\]"
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


def test_drives_shorter_than_a_slice(root):
    message = r"slices have 15 rows, but these drives are shorter: {'hill/image_2': 14, 'lane/image_2': 9}; leave them"
    fails(ValueError, message, root, batch_size=30, num_slices=2)
    fails(ValueError, message, root, batch_size=30, slice_len=15)
    fails(ValueError, message, root, batch_size=30, sampler=SliceSampler(num_slices=2))
    data = open_dataset(root, batch_size=30, num_slices=2, strict_length=False)
    for _ in range(20):  # the short ones come whole
        sample = data.sample()
        ends = sample["next", "truncated"].flatten().nonzero().flatten() + 1
        lengths = ends.diff(prepend=torch.zeros(1, dtype=torch.int64))
        assert lengths.tolist() == [min(15, data.episodes[k].length) for k in sample["episode"][ends - 1]]
    assert len(open_dataset(root, "town", batch_size=30, num_slices=2).sample()) == 30
    for wrong in ({"num_slices": 2, "slice_len": 3}, {"num_slices": 2, "sampler": SliceSampler(num_slices=2)}):
        fails(ValueError, "pass one of num_slices, slice_len and sampler", root, **wrong)


# The rest of torchrl's interface -------------------------------------------------------------------------------------


def test_it_deletes_nothing_of_the_users(root):
    data = open_dataset(root, "lane")
    with pytest.raises(RuntimeError, match="delete them by hand"):
        data.delete()
    assert data.data_path == data.data_path_root == data.root == root
    assert (root / "sequences/lane/image_2/000000.png").is_file()
    with pytest.raises(RuntimeError):
        data.extend(data[:2])


def darkness(rows):
    return rows.select("episode", "state").set("dark", 1 - rows["pixels"][..., :3, :, :].mean((-3, -2, -1)))


def test_preprocess_sees_pixels(root, tmp_path):
    data = open_dataset(root, "lane", mirrored=True)
    storage = data.preprocess(darkness, num_workers=1, mp_start_method="fork", dest=tmp_path)
    rows = data[:]
    torch.testing.assert_close(storage[:]["dark"], 1 - rows["pixels"][:, :3].mean((1, 2, 3)))
    assert storage[:]["state"].equal(rows["state"])


# Real frames ---------------------------------------------------------------------------------------------------------


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
    batch = data.sample().reshape(4, 10)
    for row in batch:
        episode = data.episodes[row["episode"][0]]
        drive_rows = read_kitti_drive(tmp_path, drive, camera=episode.camera, colour=False, cache=None)
        frames = drive_frames(mirror_drive(drive_rows) if episode.mirrored else drive_rows)
        for key in KEYS:
            assert row[key].equal(frames[key][row["frame"].flatten()]), key
    # Side by side, the cameras see the same turns; the pictures differ by their parallax.
    pixels = data[:]["pixels"].reshape(4, 40, 2, 50, 150)
    assert 0.005 < (pixels[0, :, 0] - pixels[2, :, 0]).abs().mean() < 0.2
    assert (data[:]["state"][:40] == data[:]["state"][80:120]).all()
