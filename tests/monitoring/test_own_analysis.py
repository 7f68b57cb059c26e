"""An analysis of a user's own is lagged, delayed, gated, rejected and left out like ours of the same formula."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.factories import linear_denkf
from torch_denkf.functional import analyse
from torch_denkf.functional.moments import ensemble_mean, ensemble_var
from torch_denkf.imperfect import RejectReadings
from torch_denkf.modules import EnsembleAnalysis, Update
from torch_denkf.monitoring import Gated
from torch_denkf.smoothers import EnRTS, FixedLag


class Own(Update):
    def __init__(self):
        writes = [("belief", name) for name in ("ensemble", "mean", "var")]
        writes += [("info", name) for name in ("innovation", "nis", "log_likelihood")]
        reads = [("forecast", "ensemble"), ("forecast", "observation"), "observation", ("sensor", "noise")]
        super().__init__(nn.Identity(), reads, writes, optional_keys=["observed"])
        self.predicted_key, self.reading_keys = self.in_keys[1], self.in_keys[2:]
        self.observed_key, self.info_prefix = "observed", "info"

    def compute(self, forecast, predicted, reading, variance, observed=None):
        ensemble, *scores = analyse(forecast, predicted, reading, variance, scheme="etkf", observed=observed)
        return ensemble, ensemble_mean(ensemble), ensemble_var(ensemble), *scores


REJECT = RejectReadings({"observation": "observed"})
WAYS = {
    "as it is": lambda filter: filter.sequence,
    "lagged": lambda filter: FixedLag(filter, 3).sequence,
    "gated": lambda filter: Gated(filter, 2, response="reject", window=1, rate=0.3).sequence,
    "gated and lagged": lambda filter: FixedLag(Gated(filter, 2, rate=0.3, adapt_noise=0.1), 2).sequence,
    "rejected": lambda filter: lambda data: filter.sequence(REJECT(data)),
    "smoothed": EnRTS,
    "predicted": lambda filter: lambda data: filter.predict(filter.initialise(data[:, 0])),
}


@pytest.fixture
def data(float64):
    torch.manual_seed(3)
    data = TensorDict({"observation": 3.0 * torch.randn(4, 9, 2)}, [4, 9])
    return data.set("observed", torch.rand(4, 9, 1) < 0.7)


@pytest.mark.parametrize("way", WAYS)
def test_custom_analysis_equals_the_library_one(data, way):
    if way == "rejected":
        data["observation"][1, 4] = torch.nan
    ours, own = (WAYS[way](linear_denkf(ensemble_size=8).with_modules(analysis=part)) for part in both())
    expected, out = ours(data.clone()), own(data.clone())
    keys = [key for key in expected.keys(True, True) if expected[key].is_floating_point()]
    assert ("belief", "mean") in keys
    assert set(keys) <= set(out.keys(True, True))
    for key in keys:
        torch.testing.assert_close(out[key], expected[key], rtol=0, atol=1e-10, equal_nan=True, msg=str(key))


def both():
    return EnsembleAnalysis("etkf", observation_key="observation"), Own()
