"""Oracle: one step back after the other."""

import pytest
import torch
from torch.testing import assert_close

from torch_denkf.compilation.in_time import prefixes, rts_in_time
from torch_denkf.functional.smoothing.rts import rts_smooth


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 8, 33])
def test_prefixes_of_a_product_that_does_not_commute(float64, count):
    matrices = torch.randn(count, 2, 2) / 2
    expected = [matrices[0]]
    for matrix in matrices[1:]:
        expected.append(expected[-1] @ matrix)
    (found,) = prefixes(lambda one, other: (one[0] @ other[0],), (matrices,))
    assert_close(found, torch.stack(expected))


def values(*batch, count, size=3):
    """What a linear filter hands to the smoother."""

    def spread():
        root = torch.randn(*batch, count, size, size)
        return root @ root.mT + torch.eye(size)

    cov, move = spread(), torch.randn(*batch, count, size, size)
    before = torch.cat([cov[..., :1, :, :], cov[..., :-1, :, :]], -3)
    forecast = move @ before @ move.mT + spread()
    mean, forecast_mean = torch.randn(2, *batch, count, size)
    return mean, cov, forecast_mean, forecast, before @ move.mT


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
@pytest.mark.parametrize("count", [1, 2, 9])
def test_all_times_at_once_are_one_after_the_other(float64, batch, count):
    entries = [value.requires_grad_() for value in values(*batch, count=count)]
    follows = torch.rand(*batch, count) > 0.2
    for keep in ({}, {"follows": follows}):
        ours, theirs = rts_in_time(*entries, **keep), rts_smooth(*entries, **keep)
        assert_close(ours, theirs, rtol=1e-9, atol=1e-10)
        gradients = (
            torch.autograd.grad(mean.sin().sum() + cov.sin().sum(), entries, materialize_grads=True)
            for mean, cov in (ours, theirs)
        )
        assert_close(*gradients, rtol=1e-7, atol=1e-8)


def test_an_episode_that_diverges_does_not_reach_the_one_before(float64):
    mean, *others = values(count=6)
    follows = torch.ones(6, dtype=torch.bool)
    follows[3] = False
    expected = rts_smooth(mean, *others, follows=follows)
    mean[4:] = torch.nan
    found = rts_in_time(mean, *others, follows=follows)
    for ours, theirs in zip(found, expected, strict=True):
        assert_close(ours[:3], theirs[:3])
    assert found[0][3:5].isnan().any()
