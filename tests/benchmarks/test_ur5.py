"""The parts of the UR5 study that a wrong table could come from: roles, cameras, scores, tables."""

import math

import pytest
from benchmarks.ur5.evaluation import errors

from benchmarks.ur5.demos import Roles
from tests.benchmarks.ur5_for_tests import states


def test_who_is_tested_is_not_trained_on():
    with pytest.raises(ValueError, match=r"\[3\] would be tested on and used as tune"):
        Roles({1}, [2, 3], [4], [3, 5])
    with pytest.raises(ValueError, match="its sensor has not seen"):
        Roles({1, 2}, [2], [4], [5])


# ------------------------------------------------------------------------------------------------ failing cameras


# --------------------------------------------------------------------------------------------------------- scores


def test_errors_are_means_of_absolute_ones_with_wrapped_angles_and_without_the_first_row():
    truth = states(2, 5)
    mean = truth.clone()
    mean[:, 1:, 5] += 2 * math.pi - math.radians(7.0)
    mean[:, 1:, 6] += math.radians(14.0)
    mean[:, 1:, 8] += 0.03
    mean[:, 0] += 100.0
    scores = errors(mean, truth)
    assert scores["joint_mae_deg"] == pytest.approx(3.0, abs=1e-3)
    assert scores["J6_deg"] == pytest.approx(7.0, abs=1e-3)
    assert scores["ee_mae_cm"] == pytest.approx(1.0, abs=1e-4)


# ---------------------------------------------------------------------------------------------------------- tables
