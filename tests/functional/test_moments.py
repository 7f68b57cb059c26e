"""Oracles: numpy's mean, var and cov."""

import numpy as np
import pytest
import torch

from torch_denkf.functional.moments import ensemble_anomalies, ensemble_cov, ensemble_mean, ensemble_var


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_moments_are_numpys(batch):
    ensemble = torch.randn(*batch, 7, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    array = ensemble.numpy()
    close = {"rtol": 1e-12, "atol": 1e-12}  # sums of seven numbers of size 1
    np.testing.assert_allclose(ensemble_mean(ensemble), array.mean(-2), **close)
    np.testing.assert_allclose(ensemble_anomalies(ensemble), array - array.mean(-2, keepdims=True), **close)
    np.testing.assert_allclose(ensemble_var(ensemble), array.var(-2, ddof=1), **close)
    for index in np.ndindex(*batch):
        np.testing.assert_allclose(ensemble_cov(ensemble)[index], np.cov(array[index].T), **close)
