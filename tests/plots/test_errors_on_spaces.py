"""Pictures of errors on a space: the numbers of the metrics, which have oracles of their own."""

import numpy as np
import torch
from tensordict import TensorDict

from tests.plots.test_bands_of_spaces import SPACE
from tests.plots.test_calibration import bars
from tests.plots.test_spread import data
from torch_denkf.metrics import pit
from torch_denkf.plots import plot_calibration, plot_spread_error
from torch_denkf.plots.histograms import rank_histogram, spread_error

RUNS, E = 400, 9


def test_errors_on_a_space_are_those_of_the_metrics_and_rotations_in_degrees(float64):
    mean, std = SPACE.exp(2 * torch.randn(RUNS, 5)), torch.rand(RUNS, 1) * 0.2 + 0.05
    members, truth = (SPACE.plus(mean.unsqueeze(1), std.unsqueeze(1) * torch.randn(RUNS, count, 5)) for count in (E, 1))
    center, truth = SPACE.mean(members), truth.squeeze(1)
    belief = {"ensemble": members, "mean": center, "var": SPACE.minus(members, center.unsqueeze(1)).var(1)}
    run = TensorDict({"belief": belief, "state": truth}, [RUNS])
    labels = ["about x, deg", "about y, deg", "about z, deg", "heading, deg", "state 4"]
    factors = np.array([180 / np.pi] * 4 + [1.0])
    known = truth.clone()
    known[::2, 1] = torch.nan  # one number of a quaternion
    for reached in (truth, known):
        drawn = data(plot_spread_error(run, reached, space=SPACE))
        points = spread_error(center, belief["var"], reached, ensemble_size=E, space=SPACE)
        for column, label in enumerate(labels):
            expected = [factors[column] * each[column].numpy() for each in (points.spread, points.error)]
            np.testing.assert_allclose(drawn[label], expected, rtol=1e-12)
    ranks = rank_histogram(members, truth, space=SPACE)
    panels = plot_calibration(run, space=SPACE, bins=E + 1)
    np.testing.assert_allclose([bars(axes) for axes in panels], 100 * ranks.numpy() / RUNS, rtol=1e-12)
    assert panels[0].get_ylabel().startswith("about x\n")
    values = pit(center, belief["var"], truth, space=SPACE)
    counts = torch.stack([torch.histc(column, 10, 0, 1) for column in values.unbind(-1)])
    drawn = [bars(axes) for axes in plot_calibration(run, space=SPACE, kind="pit")]
    np.testing.assert_allclose(drawn, 100 * counts.numpy() / RUNS, rtol=1e-12)
