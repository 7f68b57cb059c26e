"""The LSTM as a filter: torch's own LSTM on whole sequences is the oracle; and what it is for, a memory."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf.applications.car import dead_reckoning
from torch_denkf.applications.car.modules.unicycle_pose import UnicyclePose
from torch_denkf.baselines import LSTMFilter
from torch_denkf.modules import GaussianAround, ImageSensor
from torch_denkf.objectives import GaussianLoss


def reader(layers=1, **kwargs):
    """Estimates two numbers from readings of two, and their flags."""
    sizes = {"observation_dim": 2, "hidden_size": 6, "num_layers": layers, "loc": [1.0, -1.0], "scale": [2.0, 3.0]}
    return LSTMFilter(None, state_dim=2, observation_key="observation", **{**sizes, **kwargs})


def readings(batch, width=1, resets=True):
    frames = TensorDict({"observation": torch.randn(*batch, 2), "observed": torch.rand(*batch, width) < 0.7}, batch)
    if resets:
        frames["is_init"] = torch.rand(*batch, 1) < 0.2
        frames["is_init"][..., 0, :] = True
    return frames


def torch_lstm(filter, frames):
    """Returns means, hidden and cell states of the last layer by ``torch.nn.LSTM`` with the same weights."""
    update = filter["lstm"]
    lstm = nn.LSTM(update.in_size, update.hidden_size, update.num_layers, batch_first=True)
    weights = update.module["cells"].state_dict()
    lstm.load_state_dict({f"{name.split('.')[1]}_l{name.split('.')[0]}": value for name, value in weights.items()})
    seen = frames["observed"].expand(*frames.shape, 2).double()
    inputs = torch.cat([seen * frames["observation"], seen], -1)
    output, (hidden, cell) = lstm(inputs.flatten(0, -3))
    mean = update.loc + update.scale * update.module["mean"](output)
    return mean.unflatten(0, frames.shape[:-1]), hidden.transpose(0, 1), cell.transpose(0, 1)


@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("batch", [(3, 9), (2, 2, 6)])
@pytest.mark.parametrize("update_at_reset", [True, False])
def test_a_sequence_is_torchs_lstm(float64, layers, batch, update_at_reset):
    filter, frames = reader(layers, update_at_reset=update_at_reset), readings(batch, width=2, resets=False)
    out = filter.sequence(frames.copy())
    first = 0 if update_at_reset else 1  # the first frame is not read where the first belief is the initial one
    mean, hidden, cell = torch_lstm(filter, frames[..., first:])
    torch.testing.assert_close(out["belief", "mean"][..., first:, :], mean, rtol=0, atol=1e-12)
    torch.testing.assert_close(out["belief", "hidden"][..., -1, :, :].flatten(0, -3), hidden, rtol=0, atol=1e-12)
    torch.testing.assert_close(out["belief", "cell"][..., -1, :, :].flatten(0, -3), cell, rtol=0, atol=1e-12)
    if first:
        assert out["belief", "mean"][..., 0, :].equal(torch.tensor([1.0, -1.0]).expand(*batch[:-1], 2))
        assert out["belief", "var"][..., 0, :].equal(torch.tensor([4.0, 9.0]).expand(*batch[:-1], 2))


def test_flag_distinguishes_missing_from_zero(float64):
    filter, frames = reader(), readings((3, 9))
    zeros = frames.copy().set("observation", torch.zeros(3, 9, 2)).set("observed", torch.ones(3, 9, 1).bool())
    missing = zeros.copy().set("observed", torch.zeros(3, 9, 1).bool())
    assert not filter.sequence(zeros)["belief", "mean"].equal(filter.sequence(missing)["belief", "mean"])


def test_actions_are_read_one_step_late(float64):
    # As in every filter: the action that is stored at t leads to t + 1.
    filter = reader(extra_keys=["action"], extra_features=1)
    frames = readings((2, 6), resets=False).set("action", torch.randn(2, 6, 1))
    expected = filter.sequence(frames.copy())["belief", "mean"]
    frames["action"][:, 3] += 1
    changed = (filter.sequence(frames.copy())["belief", "mean"] != expected).any(-1).any(0)
    assert changed.tolist() == [False] * 4 + [True] * 2


# ----------------------------------------------------------------------------------------------------- a vehicle


def vehicle(sensor=None, **kwargs):
    initial = GaussianAround([0.0, 0.0, 0.0, 1.0, 0.1])
    units = {"loc": [10.0, 0.1], "scale": [3.0, 0.1], "hidden_size": 8, "floor": 1e-4}
    return LSTMFilter(sensor, state_dim=5, motion=UnicyclePose(0.1), initial=initial, **{**units, **kwargs})


def test_pose_is_the_dead_reckoning_of_the_velocities(float64):
    filter, start = vehicle(features=4, encoding_key="code"), torch.randn(3, 5)
    frames = TensorDict({"code": torch.randn(3, 12, 4), "state": start.unsqueeze(1).expand(3, 12, 5)}, [3, 12])
    belief = filter.sequence(frames)["belief"]
    mean = belief["mean"]
    assert (mean[:, 1:, 3:].flatten(0, 1).std(0) > torch.tensor([0.1, 0.003])).all(), "the network says something"
    expected = dead_reckoning(mean[..., 3:], start[:, :3], 0.1)
    torch.testing.assert_close(mean[..., :3], expected, rtol=0, atol=1e-12)
    # Headings alone are linear: their variance is the sum of those of the steps.
    added = 0.1**2 * belief["var"][:, 1:, 4].cumsum(1)
    torch.testing.assert_close(belief["var"][:, 1:, 2], added, rtol=1e-12, atol=0)
    assert torch.linalg.eigvalsh(belief["cov"][:, 1:]).amin() > -1e-12


def test_the_sensor_of_other_filters_is_trained_through_the_memory():
    sensor = ImageSensor(
        2, image_shape=(2, 9, 12), ensemble_size=1, num_cells=(8,), layer="none", encoding_key=("sensor", "encoding")
    )
    filter = vehicle(sensor, features=8, extra_keys=["steps"], extra_features=1)
    frames = TensorDict({"pixels": torch.rand(2, 5, 2, 9, 12), "steps": torch.ones(2, 5, 1)}, [2, 5])
    frames["state"], frames["observed"] = torch.randn(2, 5, 5), torch.rand(2, 5, 1) < 0.7
    loss = GaussianLoss(filter, score="nll", transition=0.0, sensor=0.0, dims=[3, 4], state_scale=[3.0, 0.1])
    sum(loss(frames).values()).backward()
    # All but the sensor's own reading, which this filter leaves unread.
    unread = [name for name, parameter in filter.named_parameters() if parameter.grad is None]
    assert len(unread) == 2
    assert all(filter.get_parameter(name).shape[0] == 2 and ".head." in name for name in unread)
    assert sensor.module["trunk"][0].weight.grad.abs().sum() > 0


# ------------------------------------------------------------------------------------------------------- a memory
