"""Every writer on a disk that is full: an OSError that names the file and the free space, and nothing is lost."""

import os

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.applications.ur5.data.ur5_demos import make_demo, write_folder
from tests.data.lerobot.lerobot_folder import write_version_2
from torch_denkf.applications.car import read_kitti_drive, with_motion, write_drives
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.data import LeRobotReplay
from torch_denkf.data.lerobot.rows import recording_from_rows
from torch_denkf.deployment import export_step
from torch_denkf.deployment.folder import load_folder, save_folder
from torch_denkf.filters import KalmanFilter
from torch_denkf.plots import write_video
from torch_denkf.training import FilterTrainer, Stage
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

FULL = r"cannot write .*{}.*: No space left on device, \d+(\.\d)? [kM]B free in .*disk0"


def left(disk):
    return [path for path in disk.rglob("*") if path.name.startswith(".") or path.suffix == ".part"]


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    root = tmp_path_factory.mktemp("kitti")
    write_drives(root, ["town"], frames=30)
    return root


def test_drives_and_their_motion(drives, small_disk):
    disk = small_disk("600k")
    with pytest.raises(OSError, match=FULL.format("the cache at .*town")):
        read_kitti_drive(drives, "town", cache=disk)
    drive = read_kitti_drive(drives, "town", size=(10, 30), cache=disk)
    assert len(list(disk.iterdir())) == 1
    filled = disk / "filled"
    filled.write_bytes(bytes(400_000))
    with pytest.raises(OSError, match=FULL.format("the cache at .*motion")):
        with_motion(drive, cache=disk)
    assert not left(disk)
    filled.unlink()
    again = read_kitti_drive(drives, "town", size=(10, 30), cache=disk)
    assert (again == read_kitti_drive(drives, "town", size=(10, 30), cache=None)).all()


def test_demos(tmp_path, small_disk):
    write_folder(tmp_path / "demos", [make_demo(number, 8) for number in range(4)])
    disk = small_disk("16k")
    with pytest.raises(OSError, match=FULL.format("the cache at .*ur5")):
        UR5ExperienceReplay(tmp_path / "demos", split="all", cache=disk, progress=False)
    assert not left(disk)


def test_robots_recordings(tmp_path, small_disk):
    write_version_2(tmp_path / "robot", [6, 6], images="bytes")
    disk = small_disk("300k")
    with pytest.raises(OSError, match=FULL.format("pictures to .*disk0")):
        LeRobotReplay(tmp_path / "robot", split="all", cache=disk, progress=False)
    rows = TensorDict(
        {"observation": {"image": torch.rand(12, 3, 96, 128), "state": torch.rand(12, 2)}, "episode": torch.ones(12)},
        [12],
    )
    with pytest.raises(OSError, match=FULL.format("0.4 MB of pictures to .*disk0")):
        recording_from_rows(rows, fps=10.0, folder=disk)
    assert list(disk.iterdir()) == []


def small_model(size):
    return nn.Linear(size, 1)


def test_checkpoints_and_models(small_disk):
    disk = small_disk("100k")
    write_checkpoint(disk / "last.pt", {"x": torch.ones(3)})
    save_folder(small_model(2), disk / "model", builder="line", settings={"size": 2})
    with pytest.raises(OSError, match=FULL.format("last.pt")):
        write_checkpoint(disk / "last.pt", {"x": torch.ones(100_000)})
    with pytest.raises(OSError, match=FULL.format(r"weights-\w+.safetensors")):
        save_folder(small_model(100_000), disk / "model", builder="line", settings={"size": 100_000})
    assert read_checkpoint(disk / "last.pt")["x"].tolist() == [1.0, 1.0, 1.0]
    assert load_folder(disk / "model", {"line": small_model}).in_features == 2
    assert not left(disk)


def test_logs_of_a_training(small_disk):
    disk, net = small_disk("60k"), nn.Linear(1, 1)
    fit = Stage(
        "fit",
        loss=lambda batch: {"loss_fit": net(batch["x"]).square().mean()},
        sample=lambda generator, length: TensorDict({"x": torch.rand(4, 1, generator=generator)}, [4]),
        updates=3000,
        lr=0.1,
    )
    with pytest.raises(OSError, match=r"cannot write .*(logs|pt).*No space left on device, .* free"):
        FilterTrainer(net, [fit], out=disk / "run", device="cpu", log_every=1, save_every=20, progress=False).fit()
    assert read_checkpoint(disk / "run" / "last.pt")["update"] >= 20
    assert not left(disk)


def test_an_exported_step(small_disk):
    """torch itself ends the process here (SIGABRT)."""
    disk, one = small_disk("16k"), torch.eye(1)
    kf = KalmanFilter(one, one, process_noise_cov=one, noise_cov=one, mean=torch.zeros(1), cov=one)
    with pytest.raises(OSError, match=FULL.format("kf.pt2")):
        export_step(kf, TensorDict({"observation": torch.ones(1)}), disk / "kf.pt2", compiled=False)
    assert list(disk.iterdir()) == []


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_videos(small_disk, suffix):
    if suffix == ".gif":
        pytest.importorskip("PIL")
    disk, noise = small_disk("100k"), np.random.default_rng(0).integers(0, 255, (40, 256, 256, 3), np.uint8)
    file = write_video(disk / f"a{suffix}", noise[:2, :16, :16], 10)
    before = file.read_bytes()
    with pytest.raises(OSError, match=rf"cannot write .*a{suffix}.* free in .*disk0"):
        write_video(file, noise, 10)
    assert file.read_bytes() == before
    assert os.listdir(disk) == [file.name]
