"""Tests what stands around filters on ``device="meta"``, a stand-in for a GPU: losses, smoothers, spaces."""

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv

from tests.applications.legged.test_environment import trotting
from tests.filters.factories import OBS, S, linear_denkf, linear_kalman, toy_denkf, toy_frames
from tests.filters.gaussian_for_tests import learned_filter, linear_frames
from tests.filters.particle_for_tests import toy_filter
from tests.filters.test_meta_device import assert_there, make_tables, on_meta
from tests.filters.test_spaces import KINDS, log
from tests.filters.test_spaces import make as make_on_a_space
from tests.waits import NothingWaits
from torch_denkf import KalmanFilter, LinearGaussianEnv
from torch_denkf.applications.legged import QUADRUPED, legged_filter, quadruped_env
from torch_denkf.functional.kernels import small_system
from torch_denkf.imperfect import RejectReadings
from torch_denkf.objectives import DEnKFLoss, GaussianLoss, MixtureLoss, ObservationLoss, SensorLoss, TransitionLoss
from torch_denkf.smoothers import EnKS, EnRTS, FixedLag, RTSSmoother
from torch_denkf.transforms import DEnKFTransform

deviced = pytest.mark.parametrize("device", ["meta", None], ids=["device", "no device"])


@pytest.fixture(autouse=True)
def as_on_a_gpu(monkeypatch):
    monkeypatch.setattr(small_system, "GPUS", ("cuda", "meta"))
    make_tables()


LOSSES = {
    "ensemble": (toy_denkf, DEnKFLoss),
    "ensemble, scaled": (toy_denkf, lambda filter: DEnKFLoss(filter, state_scale=[1.0] * S, score="energy")),
    "Gaussian": (lambda: learned_filter("EKF"), lambda filter: GaussianLoss(filter, score="nll")),
    "mixture": (toy_filter, lambda filter: MixtureLoss(filter, component_std=[0.5] * S)),
    "transition": (toy_denkf, lambda filter: TransitionLoss(filter, spread=0.1)),
    "sensor": (toy_denkf, SensorLoss),
    "observation": (toy_denkf, ObservationLoss),
}


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("moved", ["filter", "loss"])
@deviced
def test_losses_and_their_gradients(name, moved, device):
    make, make_loss = LOSSES[name]
    filter = make()
    frames = toy_frames((2, 4)).set("state", torch.randn(2, 4, S)).set("target_observation", torch.randn(2, 4, OBS))
    frames["observation"] = torch.randn(2, 4, OBS)
    loss = make_loss(filter.to("meta")) if moved == "filter" else make_loss(filter).to("meta")
    assert {value.device.type for value in (*loss.parameters(), *loss.buffers())} == {"meta"}
    frames = on_meta(frames, device)
    losses = loss(frames)
    assert_there(losses)
    sum(losses.values()).backward()


SMOOTHERS = {
    "RTS": lambda: RTSSmoother(linear_kalman()),
    "EnKS": lambda: EnKS(linear_denkf("etkf")),
    "EnRTS": lambda: EnRTS(linear_denkf("perturbed", noisy=True)),
}


@pytest.mark.parametrize("name", SMOOTHERS)
@deviced
def test_smoothers(name, device):
    frames = on_meta(linear_frames(2, 5).exclude("action"), device)
    smoother = SMOOTHERS[name]().to("meta")
    with NothingWaits():
        assert_there(smoother(frames.copy()))


@pytest.mark.parametrize("kind", KINDS)
def test_filters_and_smoothers_on_spaces(float64, kind):
    data = on_meta(log(2), None)
    filters = [make_on_a_space(kind)] + [FixedLag(make_on_a_space(kind), 2)] * (kind in ("UKF", "perturbed"))
    for filter in filters:
        filter.to("meta")
        with NothingWaits(), torch.no_grad():
            assert_there(filter.sequence(data.copy()))
    if kind in ("EKF", "UKF"):
        smoother = RTSSmoother(make_on_a_space(kind)).to("meta")
        with NothingWaits():
            assert_there(smoother(data.copy()))


@pytest.mark.parametrize("way", ["device", "to"])
def test_an_environment_and_a_filter_in_it(way, monkeypatch):
    monkeypatch.setattr("torchrl.envs.EnvBase._reset_check_done", lambda *_: None)  # torchrl's own look at a reset
    one, options = torch.eye(2), {"batch_size": [4], "missing": 0.3} | ({"device": "meta"} if way == "device" else {})
    base = LinearGaussianEnv(one, one[:1], [0.1, 0.1], [0.2], **options)
    base = base if way == "device" else base.to("meta")
    filter = KalmanFilter(one, one[:1], process_noise=[0.1, 0.1], noise=[0.2], mean=torch.zeros(2), cov=one).to("meta")
    filtered = TransformedEnv(base, Compose(RejectReadings({"observation": "observed"}), DEnKFTransform(filter)))
    for env in (base, filtered):
        row = env.reset()
        with NothingWaits():
            assert_there(env.reset())
            out = env.step(env.rand_action(row))
        assert_there(out)
    assert out["next", "belief", "mean"].shape == (4, 2)


@pytest.mark.parametrize("kind", ["EKF", "DEnKF"])
def test_legged_filters(kind):
    env = quadruped_env(seed=1)
    rows = trotting(env, 2).exclude("done", "terminated", "truncated", "reward").unsqueeze(0)
    filter = legged_filter(env.model, **QUADRUPED, dt=env.dt, kind=kind, ensemble_size=8).to("meta")
    rows = on_meta(rows, None)
    with NothingWaits(), torch.no_grad():
        assert_there(filter.sequence(rows.copy()))
