"""A sensor that learned few rows by heart, beside one that is known. Oracle: least squares, and the Kalman filter."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torch_denkf import FilterTrainer, FusedFilter, FusedSensor, GaussianLoss, SensorLoss, Stage
from torch_denkf.modules import ConstantNoise, LinearTransition, MomentPrior, Select

pytestmark = pytest.mark.usefixtures("float64")

FEATURES, ENCODER, Q = 30, 0.5, 0.1  # of a picture; standard deviations of the encoder and of a step


def record(runs, steps, seed):
    """A place that walks; a picture of noisy features, of which each says a little; an encoder."""
    g = torch.Generator().manual_seed(seed)
    state = (Q * torch.randn(runs, steps, 1, generator=g)).cumsum(1) + torch.randn(runs, 1, 1, generator=g)
    picture = state / FEATURES**0.5 + torch.randn(runs, steps, FEATURES, generator=g)
    encoder = state + ENCODER * torch.randn(runs, steps, 1, generator=g)
    return TensorDict({"state": state, "picture": picture, "encoder": encoder}, [runs, steps])


def make_filter(seen):
    """The camera's head is the least squares solution on some rows: it has hardly fewer weights than there are rows."""
    head = nn.Linear(FEATURES, 1, bias=False)
    head.weight.data = torch.linalg.lstsq(seen["picture"].flatten(0, 1), seen["state"].flatten(0, 1)).solution.mT
    camera = TensorDictModule(head, ["picture"], [("sensor", "ensemble")])
    noise = ConstantNoise([1.0], trainable=True, in_key="encoder")
    place = Select([0])
    return FusedFilter(
        LinearTransition(torch.eye(1), Q**2 * torch.eye(1)),
        {"camera": FusedSensor(place, noise, camera), "encoder": FusedSensor(place, [ENCODER])},
        initial=MomentPrior(torch.zeros(1), torch.eye(1)),
    )


def learned(filter, loss, data, out, **options):
    stage = Stage("noise", loss, lambda *_: data, 80, lr=0.1, schedule="constant", clip=None, **options)
    FilterTrainer(filter, [stage], out=out, device="cpu", progress=False).fit()
    return filter


def error(filter, data, *without):
    data = data.copy()
    for name in without:
        data[f"{name}_observed"] = torch.zeros(*data.shape, 1, dtype=torch.bool)
    with torch.no_grad():
        return (filter.sequence(data)["belief", "mean"] - data["state"])[:, 10:].square().mean().sqrt().item()


def residual(filter, data):
    return (filter["camera_sensor"](data.copy())["sensor", "camera", "ensemble"] - data["state"]).square().mean()


@pytest.mark.parametrize("whole", [False, True], ids=["sensor alone", "through the filter"])
def test_both_sensors_are_no_worse_than_one_where_noise_is_learned_on_unseen_rows(tmp_path, whole):
    seen, held, unseen = record(4, 10, 0), record(8, 40, 1), record(64, 60, 2)
    found = {}
    for name, data in (("seen", seen), ("held", held)):
        filter = make_filter(seen)
        loss = GaussianLoss(filter, score="nll") if whole else SensorLoss(filter, sensor=0.0, noise=1.0)
        if not whole:
            loss.set_keys(sensor="camera")
        weight = filter["camera_sensor"].module.module.weight if False else next(filter["camera_sensor"].parameters())
        before = weight.detach().clone()
        learned(filter, loss, data, tmp_path / name, frozen=["camera_sensor"])
        assert weight.equal(before)
        found[name] = error(filter, unseen)
        if not whole:
            variance = filter(unseen[:, 0].copy())["sensor", "camera", "noise"] if False else None
    alone = error(filter, unseen, "camera")
    assert found["held"] < alone < found["seen"]
