"""Oracles: the development kit's loops written out over evo's relative poses, evo's own pairs, numbers by hand."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from evo.core.metrics import RPE

from tests.applications.car.metrics.paths_for_tests import matrices, straight, winding
from torch_denkf.applications.car.metrics.devkit import kitti_devkit_error

LENGTHS = (100, 200, 300, 400, 500, 600, 700, 800)


def written_out(estimated, truth, lengths=LENGTHS, step=10):
    """Segments by search, errors by evo's matrices: (length, %, deg/m) for each."""
    poses, poses_true = matrices(estimated), matrices(truth)
    travelled = [0.0]
    for before, after in pairwise(poses_true):
        travelled.append(travelled[-1] + np.linalg.norm(after[:3, 3] - before[:3, 3]))
    out = []
    for first in range(0, len(travelled), step):
        for length in lengths:
            last = next((k for k in range(first, len(travelled)) if travelled[k] > travelled[first] + length), None)
            if last is not None:
                error = RPE.rpe_base(poses_true[first], poses_true[last], poses[first], poses[last])
                angle = math.acos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))
                out.append((length, 100 * np.linalg.norm(error[:3, 3]) / length, math.degrees(angle) / length))
    return torch.tensor(out, dtype=torch.float64)


def test_the_definition_written_out():
    truth, estimated = winding(0, rows=460), winding(1, rows=460)
    error = kitti_devkit_error(estimated, truth)
    expected = written_out(estimated, truth)
    assert len(set(expected[:, 0].tolist())) == 4  # of 459 m or so
    torch.testing.assert_close(error.translation, expected[:, 1].mean())
    torch.testing.assert_close(error.rotation, expected[:, 2].mean(), atol=1e-7, rtol=1e-7)
    for k, length in enumerate(LENGTHS):
        rows = expected[expected[:, 0] == length]
        assert error.segments[k] == len(rows)
        torch.testing.assert_close(error.length_translation[k], rows[:, 1].mean(), equal_nan=True)
        torch.testing.assert_close(error.length_rotation[k], rows[:, 2].mean(), equal_nan=True, atol=1e-7, rtol=1e-7)


def test_by_hand():
    truth = straight(251)
    fast = truth * torch.tensor([1.1, 1.0, 1.0], dtype=torch.float64)
    estimated = fast.clone()
    estimated[:, 2] = 0.001 * torch.arange(
        251, dtype=torch.float64
    )  # the heading turns, the positions do not: each segment is laid on
    error = kitti_devkit_error(fast, truth, lengths=(100, 200))
    # 101 steps for 100 m: 10.1 m of 100 m; 201 for 200 m. Starts at 0 to 140 (of 149), and at 0 to 40 (of 49).
    assert error.segments.tolist() == [15, 5]
    torch.testing.assert_close(error.length_translation, torch.tensor([10.1, 10.05], dtype=torch.float64))
    torch.testing.assert_close(error.translation.item(), (15 * 10.1 + 5 * 10.05) / 20)  # by segments, not by lengths
    assert error.rotation == 0
    turned = kitti_devkit_error(estimated, truth, lengths=(100, 200))
    expected = torch.tensor([math.degrees(0.101) / 100, math.degrees(0.201) / 200], dtype=torch.float64)
    torch.testing.assert_close(turned.length_rotation, expected)
    # The start at k is off by 0.001 k: the estimate of length 1.1 x 101 leaves at that angle.
    law_of_cosines = [math.sqrt(111.1**2 + 101**2 - 2 * 111.1 * 101 * math.cos(0.001 * k)) for k in range(0, 150, 10)]
    torch.testing.assert_close(turned.length_translation[0].item(), sum(law_of_cosines) / 15)


def test_errors_say_what_to_do():
    path = straight(90)
    with pytest.raises(ValueError, match=r"the shortest path is 89\.0 m long; leave such paths out"):
        kitti_devkit_error(path, path)
    assert kitti_devkit_error(path, path, lengths=(88.5,)).segments.tolist() == [1]
    for options in ({"step": 0}, {"lengths": ()}, {"lengths": (0, 100)}):
        with pytest.raises(ValueError, match="must be positive"):
            kitti_devkit_error(path, path, **options)
    with pytest.raises(ValueError, match=r"pass state\[..., :3\]"):
        kitti_devkit_error(path[:, :2], path[:, :2])
