"""Oracles: the rows that a smoother wrote, moved by hand to the steps of the states that they speak of."""

import numpy as np
import torch
from tensordict import TensorDict

from tests.plots.runs_for_tests import kalman_runs
from torch_denkf.functional.manifolds import Circle
from torch_denkf.plots import plot_bands, plot_calibration, plot_path

LAG = 6


def drawn(axes, label):
    (line,) = [line for line in axes.get_lines() if line.get_label() == label]
    return np.stack(line.get_data(), -1)


def heights(axes):
    return [bar.get_height() for bar in axes.containers[0]]


def test_a_belief_of_long_ago_is_drawn_where_the_robot_was_then():
    runs = kalman_runs(lag=LAG)
    run = runs[3]
    known = run["smoothed", "mean"][LAG:]
    (axes,) = plot_bands(run, belief="smoothed", dims=[2])
    np.testing.assert_allclose(drawn(axes, "smoothed belief")[:-LAG, 1], known[:, 2], rtol=1e-6)
    assert np.isnan(drawn(axes, "smoothed belief")[-LAG:, 1]).all()
    assert np.isfinite(drawn(axes, "truth")).all()
    assert axes.collections[0].get_datalim(axes.transData).intervalx.tolist() == [0, 80 - LAG - 1]
    axes = plot_path(run, belief="smoothed")
    np.testing.assert_allclose(drawn(axes, "smoothed belief")[:-LAG], known[:, :2], rtol=1e-6)
    steps = [int(patch.get_gid().removeprefix("step ")) for patch in axes.patches]
    assert (len(steps), steps[0], steps[-1]) == (12, 0, 80 - LAG - 1)
    np.testing.assert_allclose([patch.center for patch in axes.patches], known[steps, :2], rtol=1e-6)


def test_each_state_is_taken_from_the_latest_row_of_its_episode():
    age = torch.tensor([3, 3, 0, 1, 2, 3, 3, 0, 1])  # cut out of an episode; a new one at 2, and one at 7
    mean = torch.arange(9.0).unsqueeze(-1)
    run = TensorDict({"smoothed": {"mean": mean, "var": mean + 1, "age": age.unsqueeze(-1)}}, [9])
    (axes,) = plot_bands(run, belief="smoothed", space=Circle(), factors=[1.0])
    turns = np.unwrap([5.0, 6.0, 8.0])
    wanted = np.full(9, np.nan)
    wanted[[2, 3, 7]] = turns
    np.testing.assert_allclose(drawn(axes, "smoothed belief")[:, 1], wanted, rtol=1e-6)
    (axes,) = plot_calibration(run, torch.zeros(9, 1), belief="smoothed", bins=2)
    assert heights(axes) == [100, 0]  # of three states, each below its mean
