"""A camera that learned few rows by heart, or errs for long, beside a known encoder. Oracle: least squares, Riccati."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torch_denkf import FilterTrainer, FusedFilter, FusedSensor, SensorLoss, Stage
from torch_denkf.modules import ConstantNoise, LinearTransition, MomentPrior, Select

pytestmark = pytest.mark.usefixtures("float64")

FEATURES, ENCODER, Q = 30, 0.5, 0.1  # of a picture; standard deviations of the encoder and of a step


def riccati(*variances):
    """Standard deviation of the best estimate of a place that walks, of readings with these variances."""
    P = 1.0
    for _ in range(500):
        P = 1 / (1 / (P + Q**2) + sum(1 / variance for variance in variances))
    return P**0.5


def record(runs, steps, seed):
    """A place that walks; a picture of noisy features, of which each says a little; an encoder."""
    g = torch.Generator().manual_seed(seed)
    state = (Q * torch.randn(runs, steps, 1, generator=g)).cumsum(1) + torch.randn(runs, 1, 1, generator=g)
    picture = state / FEATURES**0.5 + torch.randn(runs, steps, FEATURES, generator=g)
    encoder = state + ENCODER * torch.randn(runs, steps, 1, generator=g)
    return TensorDict({"state": state, "picture": picture, "encoder": encoder}, [runs, steps])


def make_filter(head, noise, **options):
    place, camera = Select([0]), TensorDictModule(head, ["picture"], [("sensor", "ensemble")])
    return FusedFilter(
        LinearTransition(torch.eye(1), Q**2 * torch.eye(1)),
        {"camera": FusedSensor(place, noise, camera, **options), "encoder": FusedSensor(place, [ENCODER])},
        initial=MomentPrior(torch.zeros(1), torch.eye(1)),
    )


@torch.no_grad()
def error(filter, data, camera=True):
    mask = torch.full((*data.shape, 1), camera)
    mean = filter.sequence(data.copy().set("camera_observed", mask))["belief", "mean"][..., :1]
    return (mean - data["state"])[:, 10:].square().mean().sqrt().item()


def test_both_are_no_worse_than_one_where_noise_is_learned_on_rows_that_the_head_has_not_seen(tmp_path):
    """The head is the least squares solution on 40 rows: on these its errors are a seventh of what they are on others."""
    seen, held, unseen = record(4, 10, 0), record(8, 40, 1), record(64, 60, 2)
    found = {}
    for name, data in (("seen", seen), ("held", held)):
        head = nn.Linear(FEATURES, 1, bias=False)
        head.weight.data = torch.linalg.lstsq(seen["picture"].flatten(0, 1), seen["state"].flatten(0, 1)).solution.mT
        before, noise = head.weight.clone(), ConstantNoise([1.0], trainable=True, in_key="encoder")
        filter = make_filter(head, noise)
        loss = SensorLoss(filter, sensor=0.0, noise=1.0)
        loss.set_keys(sensor="camera")
        settings = {"schedule": "constant", "clip": None, "frozen": ["camera_sensor"]}
        stage = Stage("noise", loss, lambda *_, data=data: data, 80, lr=0.1, **settings)
        FilterTrainer(filter, [stage], out=tmp_path / name, device="cpu", progress=False).fit()
        assert head.weight.equal(before)
        variance = (head(data["picture"]) - data["state"]).square().mean().item()
        assert noise.log_variance.exp().item() == pytest.approx(variance, rel=0.02)
        found[name] = error(filter, unseen)
    alone = error(filter, unseen, camera=False)
    assert alone == pytest.approx(riccati(ENCODER**2), rel=0.03)
    assert found["held"] < alone < 0.4 * found["seen"]
