"""The study of BROAD: errors, kinds, the equations in C, the evolution strategy."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.broad.learning import Equations, beliefs, factor, minimised
from benchmarks.broad.study import OWN, SIX, Runner, settings_for
from benchmarks.broad.task import kind_of, read_trials, scores, simulated_trial
from torch_denkf.applications.imu.filter import ImuSettings
from torch_denkf.applications.imu.log import imu_rows
from torch_denkf.functional.manifolds import SO3

SENSORS = ("gyro", "acceleration", "magnetometer", "orientation", "scored")


def test_errors_are_those_of_the_benchmark():
    trial = simulated_trial(seconds=5.0)
    tilt, turn = torch.tensor([[0.03, 0.0, 0.0], [0.0, 0.0, 0.1]], dtype=torch.float64)
    off = SO3().compose(SO3().exp(turn), SO3().exp(tilt))  # tilted, then turned about the world's z
    std = torch.tensor([0.02, 0.02, 0.05], dtype=torch.float64).expand(len(trial.gyro), 3)
    found = scores(trial, -SO3().compose(off, trial.orientation), std)
    assert found["heading"] == pytest.approx(np.degrees(0.1), rel=1e-9)
    assert found["inclination"] == pytest.approx(np.degrees(0.03), rel=1e-9)
    assert found["total"] == pytest.approx(np.degrees(2 * np.arccos(np.cos(0.05) * np.cos(0.015))), rel=1e-6)
    assert found["heading_held"] == 0  # 0.1 > 1.645 * 0.05
    assert found["inclination_held"] == 1  # 0.03 < 2.146 * 0.02


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("14_undisturbed_slow_translation_with_breaks_B", "slow translation"),
        ("21_undisturbed_fast_combined", "fast combined"),
        ("27_disturbed_phone_vibration_B", "phone vibration"),
        ("35_disturbed_attached_magnet_4cm", "attached magnet"),
    ],
)
def test_kinds(name, kind):
    assert kind_of(name) == kind


def test_numbers_are_those_that_never_saw_the_kind():
    numbers = {"all": {"gyro": 1.0}, "tapping": {"gyro": 2.0}}
    assert settings_for("tapping", numbers)[1].gyro == 2.0
    assert settings_for("office", numbers)[0] == "all"


def test_no_trials(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no \.npz"):
        read_trials(tmp_path)


@torch.no_grad()
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_the_equations_in_c_are_the_filter():
    trial, settings = simulated_trial(seconds=8.0), replace(ImuSettings(), lag=0.01, lag_std=0.01, magnetometer=0.5)
    assert imu_rows(settings, trial.gyro, trial.acceleration, rate=trial.rate)["rest_observed"].sum() > 3
    shorter = replace(trial, **{name: getattr(trial, name)[:500] for name in SENSORS})
    found = Runner(smoother=False)(settings, [shorter, trial])  # in one batch
    for each, own in zip([shorter, trial], found, strict=True):
        for method, six in ((OWN, False), (SIX, True)):
            mean, cov = beliefs(Equations(), each, settings, six=six)
            away = (own[method].mean[:, :4] * mean[:, :4]).sum(-1).abs() - 1
            assert away.abs().max() < 1e-12
            torch.testing.assert_close(own[method].mean[:, 4:], mean[:, 4:], atol=1e-6, rtol=0)  # m, uT
            torch.testing.assert_close(own[method].cov[:, :3, :3], cov, atol=1e-6 * cov.max().item(), rtol=0)


def test_the_factor_suffices_for_nine_rows_of_ten_of_trials_that_count_the_same():
    short, long = np.arange(1000.0), np.full(9, 3.5)
    found = factor([short, long])
    assert ((short <= found).mean() + (long <= found).mean()) / 2 == pytest.approx(0.9, abs=2e-3)


def test_the_strategy_finds_a_minimum():
    wanted, scale = np.array([1.0, -2.0, 0.5]), np.array([1.0, 10.0, 0.1])
    found = minimised(lambda x: float((scale * (x - wanted) ** 2).sum()), np.zeros(3), 0.5, 60, seed=0)
    assert np.abs(found - wanted).max() < 0.05
