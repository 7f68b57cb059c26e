"""Oracles: the tensors that were passed, eigenvectors of known ellipses, the share of a Gaussian that one holds."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.plots.runs_for_tests import ensemble_run, kalman_runs
from torch_denkf.plots import plot_path


def lines(axes):
    """Coordinates [T, 2] by label; the first of those without one."""
    return {line.get_label(): np.stack(line.get_data(), -1) for line in reversed(axes.get_lines())}


def test_lines_are_the_paths():
    run = ensemble_run()
    other = run["state"][:7] + 1
    axes = plot_path(run, others={"dead reckoning": other})
    drawn = lines(axes)
    np.testing.assert_allclose(drawn["truth"], run["state"][:, :2], rtol=1e-6)
    np.testing.assert_allclose(drawn["belief"], run["belief", "mean"][:, :2], rtol=1e-6)
    np.testing.assert_allclose(drawn["dead reckoning"], other[:, :2], rtol=1e-6)
    np.testing.assert_allclose(drawn["members"], run["belief", "ensemble"][:, 0, :2], rtol=1e-6)
    assert len(axes.get_lines()) == 19 + 3
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x, m", "y, m")
    assert axes.get_aspect() == 1
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["members", "truth", "dead reckoning", "belief"]


@pytest.mark.parametrize("forward_up", [False, True])
def test_ellipses_hold_their_share_of_the_belief(forward_up):
    cov = torch.tensor([[4.0, 1.5], [1.5, 1.0]], dtype=torch.float64).expand(3, 2, 2)
    mean = torch.tensor([[5.0, -2.0]], dtype=torch.float64).expand(3, 2)
    belief = TensorDict({"mean": mean, "cov": cov}, [3])
    axes = plot_path(belief, forward_up=forward_up, level=0.8)
    assert [patch.get_gid() for patch in axes.patches] == ["step 0", "step 1", "step 2"]
    steps = [0, 7, 14, 22, 29, 36, 43, 50, 57, 65, 72, 79]
    assert [patch.get_gid() for patch in plot_path(kalman_runs()[0]).patches] == [f"step {step}" for step in steps]
    rng = torch.Generator().manual_seed(0)
    draws = mean[0] + torch.randn(50_000, 2, generator=rng, dtype=torch.float64) @ torch.linalg.cholesky(cov[0]).T
    if forward_up:
        draws = torch.stack([-draws[:, 1], draws[:, 0]], -1)
    patch = axes.patches[0]
    inside = np.linalg.norm(patch.get_patch_transform().inverted().transform(draws.numpy()), axis=-1) <= 1
    assert inside.mean() == pytest.approx(0.8, abs=0.01)
    # An ellipse of another direction with the same share would not have the least area.
    area = math.pi / 4 * patch.width * patch.height
    assert area == pytest.approx(-2 * math.log(0.2) * math.pi * math.sqrt(float(cov[0].det())))


def test_an_ellipse_of_a_variance():
    reach = math.sqrt(-2 * math.log(0.1))
    var = TensorDict({"mean": torch.zeros(1, 2), "var": torch.tensor([[1.0, 9.0]])}, [1])
    (patch,) = plot_path(var).patches
    np.testing.assert_allclose([patch.height, patch.width], [2 * reach, 6 * reach])
    assert patch.angle % 180 == pytest.approx(90)


def test_particles_are_summed_up_with_their_weights():
    particles = torch.tensor([[[0.0, 0.0], [2.0, 0.0], [9.0, 9.0]]])
    log_weight = torch.tensor([[0.5, 0.5, 0.0]]).log()
    axes = plot_path(TensorDict({"ensemble": particles, "log_weight": log_weight}, [1]))
    np.testing.assert_allclose(lines(axes)["belief"], [[1.0, 0.0]])
    np.testing.assert_allclose([axes.patches[0].width, axes.patches[0].height], [2 * 2.1460, 0], atol=1e-3)
