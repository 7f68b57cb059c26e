"""Pictures of errors on a space: the numbers of the metrics, which have oracles of their own."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.plots.test_bands_of_spaces import SPACE
from torch_denkf.metrics import pit
from torch_denkf.plots import plot_calibration, plot_spread_error
from torch_denkf.plots.histograms import rank_histogram, spread_error

RUNS, E = 400, 9


@pytest.fixture(autouse=True)
def _double(float64):
    return


def beliefs(space=SPACE, *, ensemble=True):
    """Points all over the space, with errors as large as is said."""
    std = torch.rand(RUNS, 1) * 0.2 + 0.05
    mean = space.exp(2 * torch.randn(RUNS, space.tangent_dim))

    def around(*extra):
        return space.plus(mean.unsqueeze(1), std.unsqueeze(1) * torch.randn(RUNS, *extra, space.tangent_dim))

    belief = {"mean": mean, "var": std.square().expand(RUNS, space.tangent_dim)}
    if ensemble:
        members = around(E)
        center = space.mean(members)
        spread = space.minus(members, center.unsqueeze(1)).var(1)
        belief = {"ensemble": members, "mean": center, "var": spread}
    return TensorDict({"belief": belief, "state": around(1).squeeze(1)}, [RUNS])


def lines(axes):
    return {line.get_label(): [np.asarray(line.get_xdata()), np.asarray(line.get_ydata())] for line in axes.get_lines()}


def heights(panels):
    return np.stack([[bar.get_height() for bar in axes.containers[0]] for axes in panels])


@pytest.mark.parametrize("ensemble", [True, False])
def test_spread_and_error_are_those_of_the_metric_and_rotations_in_degrees(ensemble):
    run = beliefs(ensemble=ensemble)
    belief, size = run["belief"], E if ensemble else None
    points = spread_error(belief["mean"], belief["var"], run["state"], ensemble_size=size, space=SPACE)
    drawn = lines(plot_spread_error(run, space=SPACE))
    factors = np.array([180 / np.pi] * 4 + [1.0])
    labels = ["about x, deg", "about y, deg", "about z, deg", "heading, deg", "state 4"]
    assert [*drawn][:5] == labels
    for column, label in enumerate(labels):
        for got, expected in zip(drawn[label], (points.spread, points.error), strict=True):
            np.testing.assert_allclose(got, factors[column] * expected[column].numpy(), rtol=1e-12)
    chosen = lines(plot_spread_error(run, space=SPACE, dims=[4, 1], factors=[1.0, 2.0], names=["a", "b"]))
    np.testing.assert_allclose(chosen["b"][1], 2 * points.error[1].numpy(), rtol=1e-12)


def test_ranks_and_probabilities_are_those_of_the_metrics():
    run = beliefs()
    belief = run["belief"]
    ranks = rank_histogram(belief["ensemble"], run["state"], space=SPACE)
    panels = plot_calibration(run, space=SPACE, bins=E + 1)
    np.testing.assert_allclose(heights(panels), 100 * ranks.numpy() / RUNS, rtol=1e-12)
    assert panels[0].get_ylabel().startswith("about x\n")
    values = pit(belief["mean"], belief["var"], run["state"], space=SPACE)
    counts = torch.stack([torch.histc(column, 10, 0, 1) for column in values.unbind(-1)])
    drawn = heights(plot_calibration(run, space=SPACE, kind="pit"))
    np.testing.assert_allclose(drawn, 100 * counts.numpy() / RUNS, rtol=1e-12)
