"""Roll, pitch and yaw of quaternions: SciPy's Euler angles, and a Gaussian's draws."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tensordict import TensorDict

from tests.plots.test_bands import band, line
from torch_denkf.functional.manifolds import SE2, SE3, SO3, Circle, Euclidean, Product
from torch_denkf.plots import plot_bands

SPACE = Product(SO3(), Circle(), Euclidean(1))
STEPS, E = 80, 19


@pytest.fixture(autouse=True)
def _double(float64):
    return


def turning_run(spread=0.05):
    """Returns a body that turns about a tilted axis, more than once around; quaternions of either sign."""
    rates = torch.tensor([0.03, -0.02, 0.12, 0.2, 0.1]).expand(STEPS, -1) * torch.arange(STEPS).unsqueeze(-1)
    truth = SPACE.plus(SPACE.exp(torch.tensor([0.3, 0.2, 2.0, 3.0, 1.0])), rates)
    ensemble = SPACE.plus(truth.unsqueeze(1), spread * torch.randn(STEPS, E, 5))
    ensemble[..., :4] *= torch.randn(STEPS, E, 1).sign()
    belief = {"ensemble": ensemble, "mean": SPACE.mean(ensemble)}
    return TensorDict({"belief": belief, "state": truth}, [STEPS])


def euler(point):
    """Roll, pitch, yaw in degrees of quaternions ``[*, 4]``."""
    flat = point.reshape(-1, 4).roll(-1, -1).numpy()
    return Rotation.from_quat(flat).as_euler("xyz", degrees=True).reshape(*point.shape[:-1], 3)


def all_lines(axes, color):
    return [np.asarray(found.get_ydata()) for found in axes.get_lines() if found.get_color() == color]


def test_angles_of_the_mean_and_the_truth_are_those_of_scipy():
    run = turning_run()
    panels = plot_bands(run, space=SPACE)
    assert [axes.get_ylabel() for axes in panels] == ["roll, deg", "pitch, deg", "yaw, deg", "heading, deg", "state 4"]
    for name, key in (("truth", "state"), ("belief", ("belief", "mean"))):
        expected = euler(run[key][:, :4])
        for column in range(3):
            difference = line(panels[column], name)[1] - expected[:, column]
            np.testing.assert_allclose(np.sin(np.deg2rad(difference / 2)), 0, atol=1e-9)
        np.testing.assert_allclose(line(panels[4], name)[1], run[key][:, 5])


def test_a_wrap_is_drawn_as_a_wrap():
    run = turning_run()
    turns = []
    for column, axes in enumerate(plot_bands(run, space=SPACE)):
        drawn = np.stack(all_lines(axes, "black"))
        assert np.abs(np.diff(drawn, axis=-1)).max() < 60, "no line across the picture"
        assert len(drawn) == len(axes.collections)
        turns.append(len(drawn))
        if len(drawn) == 1:
            continue
        assert axes.get_ylim() == pytest.approx((-180, 180))
        inside = np.abs(drawn) <= 180
        np.testing.assert_array_equal(inside.sum(0), 1)  # every step is drawn once
        wanted = euler(run["state"][:, :4])[:, column] if column < 3 else np.rad2deg(run["state"][:, 4])
        np.testing.assert_allclose(drawn.T[inside.T], wanted, atol=1e-9)
        names = axes.get_legend_handles_labels()[1]
        assert sorted(names) == ["90 % of the belief", "belief", "truth"], "each is named once"
    assert turns[1] == turns[4] == 1, "pitch and numbers do not wrap"
    assert min(turns[2:4]) > 1, "yaw and heading do"


def test_band_of_an_ensemble_uses_its_members_angles():
    run = turning_run()
    axes = plot_bands(run, space=SPACE, dims=[2])[0]
    _, low, high = band(axes)
    mean = line(axes, "belief")[1]
    members = euler(run["belief", "ensemble"][..., :4])[..., 2]
    members = mean[:, None] + (members - mean[:, None] + 180) % 360 - 180
    expected = np.quantile(members, [0.05, 0.95], axis=1, method="weibull")
    np.testing.assert_allclose([low, high], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("form", ["cov", "var"])
@pytest.mark.parametrize("space", [SO3(), SE3(), SE2(), Product(Circle(), SO3())], ids=repr)
def test_variances_of_tangents_become_those_of_angles(space, form):
    size = space.tangent_dim
    center = space.exp(0.8 * torch.randn(size))
    factor = 0.01 * torch.randn(size, size)
    cov = factor @ factor.mT if form == "cov" else (factor @ factor.mT).diagonal().diag_embed()
    belief = {
        "mean": center.expand(2, -1),
        form: (cov if form == "cov" else cov.diagonal()).expand(2, *[-1] * (1 + (form == "cov"))),
    }
    panels = plot_bands(TensorDict({"belief": belief}, [2]), space=space)
    draws = space.plus(center, torch.randn(20_000, size) @ torch.linalg.cholesky(cov).mT)
    few = plot_bands(TensorDict({"belief": {"ensemble": draws.expand(2, -1, -1)}}, [2]), space=space)
    for axes, other in zip(panels, few, strict=True):
        (_, low, high), (_, lower, upper) = band(axes), band(other)
        # An end of the interval of 20 000 draws is off by 1.5 % of a standard deviation: 3 sigma of the width.
        np.testing.assert_allclose(high - low, upper - lower, rtol=0.03)
