"""The parts of the UR5 study that a wrong table could come from: roles, cameras, scores, tables."""

import math

import pytest
import torch
from tensordict import TensorDict

from benchmarks.ur5.demos import Roles
from benchmarks.ur5.evaluation import errors, sensor_rows
from benchmarks.ur5.motion import SIZE, with_rates
from benchmarks.ur5.readings import Windows
from benchmarks.ur5.sensors import SENSORS, TurnedWrist
from tests.benchmarks.ur5_for_tests import states


def test_who_is_tested_is_not_trained_on():
    with pytest.raises(ValueError, match=r"\[3\] would be tested on and used as tune"):
        Roles({1}, [2, 3], [4], [3, 5])
    with pytest.raises(ValueError, match="its sensor has not seen"):
        Roles({1, 2}, [2], [4], [5])


# ------------------------------------------------------------------------------------------------ failing cameras


def test_windows_begin_wrong_as_they_are_told_and_are_true_otherwise():
    full = with_rates(states(3, 50))
    entries = {"state": full[..., :10], "motion": full, "observed": torch.ones(3, 50, 1, dtype=torch.bool)}
    std = torch.linspace(0.1, 1.0, SIZE)
    windows = Windows([TensorDict(entries, [3, 50])], 8, std).sample(torch.Generator().manual_seed(0), 400)
    wrong = (windows["start"] - windows["motion"]) / std
    torch.testing.assert_close(wrong[:, 0], wrong[:, -1], atol=1e-4, rtol=0)
    # 400 draws: the standard error of a standard deviation is 0.035.
    torch.testing.assert_close(wrong[:, 0].std(0), torch.ones(SIZE), atol=0.15, rtol=0)
    rates = windows["state"][:, 1:, :7] - windows["state"][:, :-1, :7]
    torch.testing.assert_close(windows["motion"][:, 1:, 10:17], rates)
    assert 0.6 < float(windows["observed"].float().mean()) < 0.95


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


def test_a_perfect_sensor_has_no_error_where_it_sees():
    truth = states(2, 6)
    truth[..., 5] = 3.0
    samples = TurnedWrist()(truth).unsqueeze(-2) + 0.001 * torch.tensor([-1.0, 1.0])[:, None]
    reading = TensorDict({"state": truth, "sensor": {"ensemble": samples}}, [2, 6])
    reading["observed"] = torch.ones(2, 6, 1, dtype=torch.bool)
    (row,) = sensor_rows(SENSORS["keypoints"], {"clean": reading}, {})
    assert row["joint_mae_deg"] < 1e-3
    assert row["ee_mae_cm"] < 1e-3
    assert row["coverage90"] == 1.0


# ---------------------------------------------------------------------------------------------------------- tables
