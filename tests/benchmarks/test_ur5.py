"""The parts of the UR5 study that a wrong table could come from: scores."""

import math

import pytest
import torch
from tensordict import TensorDict

from benchmarks.common.arm.scores import estimated
from benchmarks.ur5.study import score_row
from tests.benchmarks.ur5_for_tests import states


def test_errors_are_means_of_absolute_ones_with_wrapped_angles_and_without_the_first_row():
    truth = states(2, 5)
    mean = truth.clone()
    mean[:, 1:, 5] += 2 * math.pi - math.radians(7.0)
    mean[:, 1:, 6] += math.radians(14.0)
    mean[:, 1:, 8] += 0.03
    mean[:, 0] += 100.0
    readings = TensorDict({"state": truth, "valid": torch.ones(2, 5, 1, dtype=torch.bool)}, [2, 5])
    scores = score_row(estimated(readings, mean, torch.full_like(mean, 0.01)), "clean")
    assert scores["joint_mae_deg"] == pytest.approx(3.0, abs=1e-3)
    assert scores["J6_deg"] == pytest.approx(7.0, abs=1e-3)
    assert scores["ee_mae_cm"] == pytest.approx(1.0, abs=1e-4)
