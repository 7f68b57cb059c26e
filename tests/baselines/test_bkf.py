"""Tests what only the Backprop KF has: a learned sensor with a learned R in front of a learned linear system."""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from tests.filters.factories import linear_system
from tests.filters.gaussian_for_tests import prior
from torch_denkf.baselines import BackpropKF
from torch_denkf.functional import kalman_predict, kalman_update
from torch_denkf.modules import CholeskyNoise


def test_step_equals_the_kalman_filter_with_the_networks_outputs(float64):
    F, Q, H, _ = linear_system()
    r = CholeskyNoise(2, constant=False, in_features=3, in_key="features", out_key=("sensor", "noise"))
    q = CholeskyNoise(2, r=0.3)
    with torch.no_grad():
        for parameter in (*r.parameters(), *q.parameters()):
            parameter.add_(torch.randn_like(parameter))
    sensor = TensorDictModule(nn.Linear(3, 2), ["features"], [("sensor", "ensemble")])
    B = torch.randn(2, 1)
    filter = BackpropKF(F, sensor, H, r, process_noise_cov=q, initial=prior(), control=B, trainable=True)
    td = TensorDict({"features": torch.randn(4, 3), "action": torch.randn(4, 1)}, [4])
    td = filter.initialise(td)
    out = filter.step(td.copy())
    frame = r(sensor(td.copy()))
    Q = q(TensorDict({("belief", "mean"): torch.zeros(2)}))["forecast", "noise"]
    mean, cov = kalman_predict(td["belief", "mean"], td["belief", "cov"], F, Q)
    mean = mean + td["action"] @ B.mT
    update = kalman_update(mean, cov, frame["sensor", "ensemble"], H, frame["sensor", "noise"])
    torch.testing.assert_close(out["belief", "mean"], update.mean, rtol=0, atol=1e-13)
    torch.testing.assert_close(out["belief", "cov"], update.cov, rtol=0, atol=1e-13)
    names = {name for name, _ in filter.named_parameters()}
    assert {"module.transition.matrix", "module.transition.control"} <= names
    assert not any("analysis" in name for name in names), "C gives the observation its meaning, and is given"
