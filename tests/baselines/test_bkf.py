"""Tests what only the Backprop KF has: a learned sensor with a learned R in front of a learned linear system."""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from tests.filters.factories import linear_system
from tests.filters.gaussian_for_tests import minimise, prior
from torch_denkf.baselines import BackpropKF
from torch_denkf.functional import kalman_predict, kalman_update
from torch_denkf.modules import CholeskyNoise, DiagonalNoise
from torch_denkf.objectives import GaussianLoss


def simulate(rows, steps, generator):
    """Readings whose noise is four times as large where a flag is up; Q and the start as in :func:`linear_filter`."""
    F, Q, H, R = linear_system()
    initial = prior()
    state = initial.mean + torch.randn(rows, 2, generator=generator) * initial.cov.diagonal().sqrt()
    frames = []
    for _ in range(steps):
        flag = (torch.rand(rows, 1, generator=generator) < 0.5).to(state.dtype)
        noise = R.sqrt() * torch.randn(rows, 2, generator=generator) * (1 + 3 * flag)
        # What the sensor sees is the reading in other units: it has to learn them.
        features = torch.cat([2 * (state @ H.mT + noise) + 1, flag], -1)
        frames.append(TensorDict({"features": features, "state": state}, [rows]))
        state = state @ F.mT + torch.randn(rows, 2, generator=generator) @ torch.linalg.cholesky(Q).mT
    return torch.stack(frames, 1)


def make_filter(**kwargs):
    F, Q, H, _ = linear_system()
    sensor = TensorDictModule(nn.Linear(3, 2), ["features"], [("sensor", "ensemble")])
    r = DiagonalNoise(2, r=1.0, num_cells=(), in_features=1, in_key="flag", out_key=("sensor", "noise"), floor=1e-4)
    return BackpropKF(F, sensor, H, r, process_noise_cov=Q, initial=prior(), **kwargs)


def test_the_sensor_and_its_noise_are_learned_through_the_filter():
    *_, R = linear_system()
    frames = simulate(2000, 8, torch.Generator().manual_seed(0))
    frames["flag"] = frames["features"][..., 2:]
    filter = make_filter()
    # The likelihood of the innovation says nothing about the units of a sensor: the true state must.
    loss = GaussianLoss(filter, score="nll", transition=0.0, sensor=0.0)
    minimise(loss, frames, filter.parameters(), 40)
    linear = filter["sensor"].module
    torch.testing.assert_close(linear.weight[:, :2].detach(), 0.5 * torch.eye(2), rtol=0, atol=0.02)
    torch.testing.assert_close(linear.bias.detach(), torch.tensor([-0.5, -0.5]), rtol=0, atol=0.05)
    # What the flag adds is known from readings with a noise of 2.8: standard error 2.8 / sqrt(7000) = 0.03 and more.
    assert (linear.weight[:, 2].abs() < 0.12).all()
    flags = TensorDict({"flag": torch.tensor([[0.0], [1.0]])}, [2])
    learned = filter["noise"](flags)["sensor", "noise"].detach()
    torch.testing.assert_close(learned, torch.stack([R, 16 * R]), rtol=0.1, atol=0)


def test_a_step_is_the_kalman_filter_of_what_the_networks_say(float64):
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
