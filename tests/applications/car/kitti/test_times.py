"""Times of a drive in KITTI's layout: gaps and jitter. Wrong ones are cases of tests/borders/kitti.py."""

import math
import warnings

import numpy as np
import pytest
import torch

from tests.applications.car.kitti.test_drive import make
from torch_denkf.applications.car import KITTIReplayEnv, read_kitti_drive, with_motion
from torch_denkf.applications.car.kitti.frames import frames_at
from torch_denkf.applications.car.kitti.gaps import bridge_gaps
from torch_denkf.data.times import increasing

ROWS = 20
POSES, TIMES = "poses/00.txt", "sequences/00/times.txt"


@pytest.fixture
def root(tmp_path):
    """Returns a drive of 20 frames at 1 m and 0.1 s."""
    return make(tmp_path, images=range(ROWS), poses=range(ROWS))


def read(root, **options):
    return read_kitti_drive(root, "00", size=(10, 30), cache=None, **options)


def set_times(root, times):
    (root / TIMES).write_text("".join(f"{float(value)!r}\n" for value in times))


def test_a_gap_of_a_hundred_seconds(root):
    """Speed is the mean over the gap; nothing pairs frames over it, and all else is as without it."""
    regular = read(root)
    times = [0.1 * k + (100.0 if k >= 12 else 0.0) for k in range(ROWS)]
    set_times(root, times)
    with pytest.warns(UserWarning, match=r"times.txt: 1 gaps, the longest of 100.1 s before line 13"):
        drive = read(root)
    others = torch.arange(ROWS) != 12
    for key in ("state", "dt"):
        torch.testing.assert_close(drive[key][others], regular[key][others], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(drive["dt"][12], torch.tensor([100.1]))
    torch.testing.assert_close(drive["state"][12], torch.tensor([12.0, 0.0, 0.0, 1 / 100.1, 0.0]))
    torch.testing.assert_close(drive["time"][:, 0], torch.tensor(times, dtype=torch.float64))
    assert drive["frame_valid"].all()
    observed = frames_at(drive, torch.arange(ROWS))["observed"][:, 0]
    assert observed.equal((torch.arange(ROWS) > 0) & others)
    assert KITTIReplayEnv(drive).dt == pytest.approx(0.1)


def test_no_pair_is_bridged_over_a_gap(root):
    (root / "sequences/00/image_2/000011.png").unlink()
    (root / "sequences/00/image_2/000005.png").unlink()
    set_times(root, [0.1 * k + (100.0 if k >= 12 else 0.0) for k in range(ROWS)])
    with pytest.warns(UserWarning, match="1 gaps"):
        drive = read(root)
    steps = bridge_gaps(drive, 3)["steps"][:, 0].tolist()
    assert steps == [0, 1, 1, 1, 1, 0, 2, 1, 1, 1, 1, 0, 0, 1, 1, 1, 1, 1, 1, 1]
    # The flow that is kept is of these pairs, and not that of a drive without the gap.
    flow = with_motion(drive, cache=root / "cache")
    set_times(root, [0.1 * k for k in range(ROWS)])
    with_motion(read(root), cache=root / "cache")
    assert len(list((root / "cache").glob("motion-*"))) == 2
    assert not flow["flow"][12].any()


def test_jitter_counts_as_a_steady_rate(root):
    """Cameras are triggered, and their stamps are written a little later."""
    regular, rng = read(root), np.random.default_rng(0)
    set_times(root, 0.1 * np.arange(ROWS) + rng.uniform(-0.01, 0.01, ROWS))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        drive = read(root)
    assert (drive["dt"] == drive["dt"][0]).all()
    torch.testing.assert_close(drive["state"][:, 3], regular["state"][:, 3], rtol=0.1, atol=0)
    assert (drive["state"][:, 3] == drive["state"][0, 3]).all()


@pytest.mark.parametrize("seed", range(5))
def test_increasing_is_the_longest(seed):
    """Against the quadratic rule: the longest that ends at k is one longer than that of a smaller value before."""
    times = np.random.default_rng(seed).integers(0, 12, 30).astype(float)
    longest: list[int] = []
    for k, value in enumerate(times):
        longest.append(1 + max((longest[j] for j in range(k) if times[j] < value), default=0))
    kept = times[increasing(times)]
    assert len(kept) == max(longest)
    assert (np.diff(kept) > 0).all()


def test_rotations_of_few_digits_pass(tmp_path):
    make(tmp_path)
    angles = np.linspace(0, 1, 6)
    rows = [f"{math.cos(a):.3f} 0 {math.sin(a):.3f} 0 0 1 0 0 {-math.sin(a):.3f} 0 {math.cos(a):.3f} {k}" for k, a in
            enumerate(angles)]  # fmt: skip
    (tmp_path / POSES).write_text("\n".join(rows))
    torch.testing.assert_close(read(tmp_path)["state"][:, 2], -torch.tensor(angles).float(), atol=1e-3, rtol=0)
