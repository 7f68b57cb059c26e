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


def test_a_filter_that_trusts_itself_is_high_at_both_ends():
    runs = kalman_runs().clone()
    runs["belief", "var"] /= 16
    (axes,) = plot_calibration(runs, dims=[1], every=20)
    assert bars(axes)[[0, -1]].min() > band(axes)[1]
    assert bars(axes)[3:7].max() < 10


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


def test_ranks_of_a_skewed_ensemble_are_flat_where_its_gaussian_is_not():
    rng = torch.Generator().manual_seed(0)
    draws = torch.empty(4000, 33, 1).exponential_(generator=rng)
    belief = TensorDict({"ensemble": draws[:, 1:]}, [4000])
    (axes,) = plot_calibration(belief, draws[:, 0])
    assert ((bars(axes) >= band(axes)[0]) & (bars(axes) <= band(axes)[1])).all()
    (axes,) = plot_calibration(belief, draws[:, 0], kind="pit")
    assert bars(axes)[0] < band(axes)[0]


def test_particles_count_with_their_weights():
    rng = torch.Generator().manual_seed(0)
    run = ensemble_run(members=6)
    counts = torch.multinomial(torch.ones(40, 6), 6, replacement=True, generator=rng)
    weight = torch.nn.functional.one_hot(counts, 6).sum(1) / 6
    run["belief", "log_weight"] = weight.log()
    repeated = run["belief", "ensemble"].gather(1, counts.unsqueeze(-1).expand(-1, -1, 3))
    for bins in (7, 4):
        panels = plot_calibration(run.exclude(("belief", "mean"), ("belief", "var")), bins=bins)
        wanted = plot_calibration(TensorDict({"ensemble": repeated}, [40]), run["state"], bins=bins)
        for axes, other in zip(panels, wanted, strict=True):
            np.testing.assert_allclose(bars(axes), bars(other), atol=1e-9)
            assert axes.get_legend_handles_labels()[1] == other.get_legend_handles_labels()[1]
