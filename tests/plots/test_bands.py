"""Oracles: the tensors that were passed, quantiles of NumPy and of the normal distribution."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.plots.runs_for_tests import DT, ensemble_run, kalman_runs
from torch_denkf.functional import wrap_angles
from torch_denkf.functional.manifolds import Circle
from torch_denkf.plots import plot_bands

NORMAL_90 = 1.6448536


def line(axes, label):
    (found,) = [line for line in axes.get_lines() if line.get_label() == label]
    return [np.asarray(part, dtype=float) for part in found.get_data()]


def band(axes):
    """Returns times, lower and upper edge [T] of the polygon: start, lower edge, end, upper edge back."""
    (polygon,) = axes.collections[0].get_paths()
    steps = (len(polygon.vertices) - 3) // 2
    lower = polygon.vertices[1 : 1 + steps]
    upper = polygon.vertices[2 + steps : 2 + 2 * steps][::-1]
    np.testing.assert_array_equal(lower[:, 0], upper[:, 0])
    return lower[:, 0], lower[:, 1], upper[:, 1]


def test_a_kalman_filters_band_is_its_variances():
    run = kalman_runs()[3]
    panels = plot_bands(run, dims=[0, 3], names=["x, m", "vy, cm/s"], factors=[1, 100], time=DT)
    for axes, dim, factor in zip(panels, (0, 3), (1, 100), strict=True):
        seconds, low, high = band(axes)
        mean, std = run["belief", "mean"][:, dim], run["belief", "var"][:, dim].sqrt()
        np.testing.assert_allclose(seconds, DT * np.arange(80))
        np.testing.assert_allclose(low, factor * (mean - NORMAL_90 * std), rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(high, factor * (mean + NORMAL_90 * std), rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(line(axes, "belief")[1], factor * mean, rtol=1e-5)
        np.testing.assert_allclose(line(axes, "truth")[1], factor * run["state"][:, dim], rtol=1e-5)
    assert [axes.get_ylabel() for axes in panels] == ["x, m", "vy, cm/s"]
    assert panels[1].get_xlabel() == "time, s"
    assert panels[0].get_xlim() == pytest.approx((-0.05, 7.95))


@pytest.mark.parametrize("level", [0.9, 0.5])
def test_an_ensembles_band_is_its_quantiles(level):
    run = ensemble_run()
    (axes,) = plot_bands(run, dims=[1], level=level)
    _, low, high = band(axes)
    members = run["belief", "ensemble"][:, :, 1].double().numpy()
    expected = np.quantile(members, [(1 - level) / 2, (1 + level) / 2], axis=1, method="weibull")
    np.testing.assert_allclose([low, high], expected, rtol=1e-6)
    # Members that do not reach the level: the variance's band.
    few = run.clone()
    few["belief", "ensemble"] = run["belief", "ensemble"][:, :5]
    _, low, _ = band(plot_bands(few, dims=[1])[0])
    _, wanted, _ = band(plot_bands(run, dims=[1], band="variance")[0])
    np.testing.assert_allclose(low, wanted)


def test_each_component_is_shaded_by_its_own_sensors_mask():
    run = ensemble_run()
    gps = torch.ones(40, 1, dtype=torch.bool)
    gps[30:32] = False
    run["gps_observed"], encoder = gps, torch.ones(40, dtype=torch.bool)
    encoder[5] = False
    values = torch.arange(40.0)
    values[7] = torch.nan
    readings = {0: torch.arange(40.0), 2: values}
    panels = plot_bands(
        run, dims=[0, 1, 2], factors=[1, 1, 10], time=DT, observed={0: "gps_observed", 2: encoder}, readings=readings
    )
    spans = [[(patch.get_x(), patch.get_x() + patch.get_width()) for patch in axes.patches] for axes in panels]
    np.testing.assert_allclose(spans[0], [(2.95, 3.15)])
    assert spans[1] == []
    np.testing.assert_allclose(spans[2], [(0.45, 0.55)])
    assert line(panels[0], "readings")[1].tolist() == [float(t) for t in range(40) if t not in (30, 31)]
    labels = [text.get_text() for text in panels[0].get_legend().get_texts()]
    assert labels == ["not observed", "90 % of the belief", "readings", "truth", "belief"]
    assert line(panels[2], "readings")[1].tolist() == [10.0 * t for t in range(40) if t not in (5, 7)]
    with pytest.raises(ValueError, match=r"observed of \[1\] belong to no drawn component"):
        plot_bands(run, dims=[0], observed={1: encoder})
    with pytest.raises(KeyError, match="no 'imu'"):
        plot_bands(run, observed={1: "imu"})


def test_angles_are_unwrapped_around_the_mean():
    rng = torch.Generator().manual_seed(0)
    theta = torch.linspace(0, 9, 30)
    wrap = wrap_angles
    ensemble = theta[:, None, None] + 0.1 * torch.randn(30, 19, 1, generator=rng)
    belief = {"mean": wrap(ensemble.mean(1)), "ensemble": wrap(ensemble)}
    run = TensorDict({"belief": belief, "state": wrap(theta).unsqueeze(-1)}, [30])
    (axes,) = plot_bands(run, space=Circle(), factors=[1.0], readings={0: wrap(theta + 0.2)})
    _, low, high = band(axes)
    np.testing.assert_allclose(line(axes, "truth")[1], theta, atol=1e-5)
    np.testing.assert_allclose(line(axes, "belief")[1], ensemble.mean(1)[:, 0], atol=1e-5)
    np.testing.assert_allclose(line(axes, "readings")[1], theta + 0.2, atol=1e-5)
    np.testing.assert_allclose(low, np.quantile(ensemble[..., 0], 0.05, axis=1, method="weibull"), atol=1e-5)
    assert (high - low).max() < 0.8


def spans(axes) -> list[tuple[float, float]]:
    return [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in axes.patches]


def slow_sensor(lost: int) -> TensorDict:
    """Returns five seconds at 100 Hz of a sensor at 1 Hz, of whose readings at 0.5, 1.5, ... s one is lost."""
    sequence = TensorDict({"belief": {"mean": torch.zeros(500, 1)}}, [500])
    sequence["observed"] = (torch.arange(500) % 100 == 50).unsqueeze(-1)
    sequence["observed"][50 + 100 * lost] = False
    return sequence


@pytest.mark.parametrize(("gap", "count"), [(2.0, 0), (1.99, 1), (0.99, 3), (0.0, 5)])
def test_gap_is_the_longest_time_between_two_readings_that_is_no_outage(gap, count):
    (axes,) = plot_bands(slow_sensor(lost=2), time=0.01, gap=gap)
    assert len(spans(axes)) == count  # 2 s once, twice 1 s, and half a second at both ends
