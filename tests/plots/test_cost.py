"""Oracle: a frontier and a staircase by hand."""

import numpy as np
import pytest
import torch

from torch_denkf.plots import plot_error_cost

POINTS = {
    "KF": (0.1, 2.0),
    "DEnKF": [(0.2, 1.5), (0.4, 1.0), (0.9, 1.0)],
    "PF": torch.tensor([[0.3, 1.8], [2.0, 0.5]]),
}


def lines(axes):
    return {line.get_gid() or line.get_label(): line for line in axes.get_lines()}


def test_lines_rings_and_staircase():
    axes = plot_error_cost(POINTS, error="RMSE, m", notes={"DEnKF": ["E = 8", "E = 32", "E = 64"]})
    drawn = lines(axes)
    np.testing.assert_allclose(drawn["DEnKF"].get_xydata(), POINTS["DEnKF"])
    np.testing.assert_allclose(drawn["KF"].get_xydata(), [(0.1, 2.0)])
    best = [(0.1, 2.0), (0.2, 1.5), (0.4, 1.0), (2.0, 0.5)]
    np.testing.assert_allclose(drawn["rings"].get_xydata(), best, rtol=1e-6)
    stairs = drawn["frontier"]
    assert stairs.get_drawstyle() == "steps-post"
    np.testing.assert_allclose(stairs.get_xydata()[1:-1], best, rtol=1e-6)
    # From the top down to the first point, and on to the right from the last one.
    assert stairs.get_xydata()[0].tolist() == [0.1, axes.get_ylim()[1]]
    assert stairs.get_xydata()[-1].tolist() == [axes.get_xlim()[1], 0.5]
    assert axes.get_xscale() == "log"
    assert axes.get_yscale() == "linear"
    assert axes.get_ylim()[0] == 0
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time, ms a step", "RMSE, m")
    assert [(text.get_text(), text.xy) for text in axes.texts][1] == ("E = 32", (0.4, 1.0))
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["KF", "DEnKF", "PF", "Pareto frontier"]


def test_both_axes_may_be_logarithmic_with_plain_numbers():
    axes = plot_error_cost({"a": [(0.1, 0.01), (1.0, 0.001)]}, log_error=True)
    assert axes.get_yscale() == "log"
    axes.figure.draw_without_rendering()
    assert {"0.1", "0.2", "0.5", "1"} <= {label.get_text() for label in axes.get_xticklabels()}
    assert {"0.001", "0.01"} <= {label.get_text() for label in axes.get_yticklabels()}


def test_errors_say_what_to_do():
    with pytest.raises(ValueError, match=r"KF: points must be \(ms a step, error\)"):
        plot_error_cost({"KF": (1.0, 2.0, 3.0)})
    with pytest.raises(ValueError, match="KF: times must be positive"):
        plot_error_cost({"KF": (0.0, 2.0)})
    with pytest.raises(ValueError, match="all values finite"):
        plot_error_cost({"KF": (1.0, float("nan"))})
    with pytest.raises(ValueError, match="nothing to draw"):
        plot_error_cost({})
