"""What follows from a belief that is carried on; oracle: by hand."""

import pytest
import torch

from torch_denkf.modules import _summaries

PREFIX = ("belief",)


def summaries(given, wanted):
    """Of a filter whose belief these are."""
    return _summaries.summaries(wanted, None, given)


def entries(**values):
    return {(*PREFIX, name): value for name, value in values.items()}


def names(*last):
    return [(*PREFIX, name) for name in last]


def test_of_an_ensemble(float64):
    ensemble = torch.randn(3, 8, 2)
    out = summaries(entries(ensemble=ensemble), names("mean", "var", "cov"))
    deviations = ensemble - ensemble.mean(-2, keepdim=True)
    torch.testing.assert_close(out["belief", "mean"], ensemble.mean(-2))
    torch.testing.assert_close(out["belief", "cov"], deviations.mT @ deviations / 7)
    torch.testing.assert_close(out["belief", "var"], out["belief", "cov"].diagonal(dim1=-2, dim2=-1))


def test_of_weighted_particles(float64):
    ensemble, log_weight = torch.randn(3, 8, 2), torch.randn(3, 8).log_softmax(-1)
    given = entries(ensemble=ensemble, log_weight=log_weight)
    out = summaries(given, names("mean", "var"))
    weight = log_weight.exp().unsqueeze(-1)
    mean = (weight * ensemble).sum(-2)
    torch.testing.assert_close(out["belief", "mean"], mean)
    assert not out["belief", "mean"].allclose(ensemble.mean(-2), atol=1e-3)
    with pytest.raises(KeyError, match=r"'cov'.* does not follow"):  # not that of equal weights
        summaries(given, names("cov"))


def test_of_a_covariance(float64):
    cov = torch.tensor([[2.0, 0.5], [0.5, 1.0]])
    out = summaries(entries(mean=torch.zeros(2), cov=cov), names("var"))
    assert out["belief", "var"].equal(torch.tensor([2.0, 1.0]))
    with pytest.raises(KeyError, match=r"'ensemble'.* does not follow"):
        summaries(entries(mean=torch.zeros(2), cov=cov), names("ensemble"))
