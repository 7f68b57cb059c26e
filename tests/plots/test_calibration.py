"""Oracles: a Kalman filter, which is calibrated; wrong spreads, which are not; counts by hand."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.plots.runs_for_tests import ensemble_run, kalman_runs
from torch_denkf.plots import plot_calibration
from torch_denkf.plots.histograms import histogram_band, rank_histogram


def bars(axes):
    return np.array([bar.get_height() for bar in axes.containers[0]])


def band(axes):
    (span,) = [patch for patch in axes.patches if patch.get_gid() == "band"]
    return span.get_y(), span.get_y() + span.get_height()


def test_a_kalman_filters_bars_end_in_the_band():
    runs = kalman_runs()
    for axes in plot_calibration(runs, every=20):  # 240 steps, far enough from each other
        low, high = band(axes)
        assert (low, high) == pytest.approx([100 * count / 240 for count in histogram_band(240, 10)])
        assert bars(axes).sum() == pytest.approx(100)
        assert ((low <= bars(axes)) & (bars(axes) <= high)).all()


def test_ranks_are_laid_on_bins_in_equal_parts():
    run = ensemble_run()
    panels = plot_calibration(run, bins=5)
    for axes, counts in zip(panels, rank_histogram(run["belief", "ensemble"], run["state"]), strict=True):
        np.testing.assert_allclose(bars(axes), counts.reshape(5, 4).sum(1) / 40 * 100, atol=1e-9)
    # Three ranks on two bins: the middle one goes to both.
    members = torch.tensor([[[0.0], [2.0]]]).expand(4, 2, 1)
    truth = torch.tensor([[-1.0], [1.0], [1.0], [3.0]])
    (axes,) = plot_calibration(TensorDict({"ensemble": members}, [4]), truth, bins=2)
    np.testing.assert_allclose(bars(axes), [50, 50])
    (axes,) = plot_calibration(TensorDict({"ensemble": members}, [4]), truth, bins=3)
    np.testing.assert_allclose(bars(axes), [25, 50, 25])
