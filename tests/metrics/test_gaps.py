"""Rows without a label, NaN in the truth, count nowhere. Oracle: the same metric of the other rows alone."""

import pytest
import torch

from tests.functional.checks import assert_raises
from torch_denkf.functional.manifolds import Flat
from torch_denkf.metrics import (
    ensemble_interval_coverage,
    interval_coverage,
    nees,
    pit,
    spread_skill_ratio,
    state_errors,
)
from torch_denkf.plots.histograms import rank_histogram, spread_error


def problem():
    rng = torch.Generator().manual_seed(0)
    ensemble = torch.randn(3, 40, 19, 2, generator=rng, dtype=torch.float64)
    truth = torch.randn(3, 40, 2, generator=rng, dtype=torch.float64)
    known = torch.rand(3, 40, 2, generator=rng) < torch.tensor([0.4, 0.7])
    return ensemble, truth, truth.where(known, torch.nan), known


METRICS = {
    "coverage": lambda e, x: interval_coverage(e.mean(-2), e.var(-2), x, level=0.8),
    "coverage of angles": lambda e, x: interval_coverage(
        e.mean(-2), e.var(-2), x, level=0.8, space=Flat(x.shape[-1], circular=[0])
    ),
    "coverage of members": lambda e, x: ensemble_interval_coverage(e, x, level=0.8),
    "rmse": lambda e, x: state_errors(e.mean(-2), x).rmse,
    "mae": lambda e, x: state_errors(e.mean(-2), x).mae,
    "spread over skill": lambda e, x: spread_skill_ratio(e.mean(-2), e.var(-2), x, 19),
    "spread": lambda e, x: spread_error(e.mean(-2), e.var(-2), x, bins=5).spread,
    "error": lambda e, x: spread_error(e.mean(-2), e.var(-2), x, bins=5).error,
}


@pytest.mark.parametrize("metric", METRICS.values(), ids=METRICS)
def test_each_dimension_is_that_of_its_known_rows(metric):
    ensemble, truth, gaps, known = problem()
    value = metric(ensemble, gaps)
    for dim in range(2):
        rows = known[..., dim]
        alone = metric(ensemble[rows][..., [dim]], truth[rows][:, [dim]])
        torch.testing.assert_close(value[dim], alone[0], rtol=1e-12, atol=0)
    assert metric(ensemble, truth).isfinite().all()


def test_a_dimension_without_any_label_has_no_number():
    ensemble, truth, _, _ = problem()
    truth[..., 1] = torch.nan
    for name in ("coverage", "coverage of members", "rmse", "spread over skill"):
        value = METRICS[name](ensemble, truth)
        assert value[0].isfinite()
        assert value[1].isnan()


@pytest.mark.parametrize("metric", [name for name in METRICS if name not in ("spread", "error")])  # these are of bins
def test_a_belief_that_is_nan_is_not_left_out(metric):
    ensemble, _, gaps, known = problem()
    where = tuple((known[..., 0] & ~known[..., 1]).nonzero()[0].tolist())
    ensemble[where] = torch.nan
    assert METRICS[metric](ensemble, gaps).isnan().tolist() == [True, False]


def test_metrics_of_complete_rows_raise_on_gaps():
    ensemble, truth, gaps, _ = problem()
    assert_raises(ValueError, r"truth is NaN, unknown.*leave out", nees, ensemble.mean(-2), ensemble.var(-2), gaps)
    assert_raises(ValueError, "leave out the rows", rank_histogram, ensemble, gaps)
    with pytest.raises(ValueError, match="bins need at least one state each; got 0 states"):
        spread_error(ensemble.mean(-2), ensemble.var(-2), truth * torch.nan, bins=2)
    assert pit(ensemble.mean(-2), ensemble.var(-2), gaps).isnan().equal(gaps.isnan())
