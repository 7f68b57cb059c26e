"""Oracles: torch's own LSTM cell on inputs put together by hand, Jacobians by automatic differentiation."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.nn import functional as F

from torch_denkf.applications.car import UnicycleTransition
from torch_denkf.applications.car.modules.unicycle_pose import UnicyclePose
from torch_denkf.baselines.lstm_cell import LSTMUpdate

BATCHES = [(), (3,), (2, 3)]
KEYS = {"encoding_key": "code", "observation_key": "reading", "extra_keys": ["steps"]}
SIZES = {"features": 4, "observation_dim": 2, "extra_features": 1}


def memory(batch, layers=1, hidden=5):
    return {"hidden": torch.randn(*batch, layers, hidden), "cell": torch.randn(*batch, layers, hidden)}


def frames(batch, layers=1, width=2):
    entries = {"code": torch.randn(*batch, 4), "reading": torch.randn(*batch, 2)}
    entries["observed"] = torch.rand(*batch, width) < 0.5
    return TensorDict({**entries, "steps": torch.ones(*batch, 1, dtype=torch.int64), "forecast": memory(batch)}, batch)


def reference(update, inputs, hidden, cell):
    """Returns one layer, by torch's cell."""
    cell_module = nn.LSTMCell(inputs.shape[-1], update.hidden_size)
    cell_module.load_state_dict(update.module["cells"][0].state_dict())
    flat = [part.reshape(-1, part.shape[-1]) for part in (inputs, hidden, cell)]
    return [part.reshape(hidden.shape) for part in cell_module(flat[0], tuple(flat[1:]))]


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("width", [1, 2])
def test_update_is_an_lstm_cell_with_two_heads(float64, batch, width):
    loc, scale, y_loc, y_scale = torch.randn(3), torch.rand(3) + 0.5, torch.randn(2), torch.rand(2) + 0.5
    units = {"loc": loc, "scale": scale, "observation_loc": y_loc, "observation_scale": y_scale, "floor": 0.01}
    update = LSTMUpdate(3, hidden_size=5, **SIZES, **KEYS, **units)
    nn.init.normal_(update.module["var"].weight)
    td = frames(batch, width=width)
    seen = td["observed"].expand(*batch, 2).double()
    any_seen = seen.amax(-1, keepdim=True)
    inputs = torch.cat([any_seen * td["code"], seen * (td["reading"] - y_loc) / y_scale, seen, td["steps"]], -1)
    hidden, cell = reference(update, inputs, td["forecast", "hidden"].squeeze(-2), td["forecast", "cell"].squeeze(-2))
    mean = loc + scale * update.module["mean"](hidden)
    var = scale**2 * (F.softplus(update.module["var"](hidden)) + 0.01)
    td["code"] = torch.where(td["observed"].any(-1, keepdim=True), td["code"], torch.nan)
    td["reading"] = torch.where(td["observed"], td["reading"], torch.nan)
    out = update(td)["belief"]
    expected = {"hidden": hidden.unsqueeze(-2), "cell": cell.unsqueeze(-2), "mean": mean, "var": var}
    for name, value in expected.items():
        torch.testing.assert_close(out[name], value, rtol=0, atol=1e-13)
    assert out["cov"].equal(torch.diag_embed(out["var"]))


def test_the_mask_of_an_encoding_is_one_flag_and_samples_are_averaged(float64):
    code, samples = torch.randn(3, 4), torch.randn(3, 6, 2)
    seen = torch.tensor([[True], [False], [True]])
    state = memory((3,))
    alone = LSTMUpdate(1, features=4, hidden_size=5, encoding_key="code")
    out = alone(TensorDict({"code": code, "observed": seen, "forecast": state}, [3]))
    inputs = torch.cat([seen * code, seen], -1)
    expected = reference(alone, inputs, state["hidden"].squeeze(-2), state["cell"].squeeze(-2))
    torch.testing.assert_close(out["belief", "hidden"].squeeze(-2), expected[0], rtol=0, atol=1e-13)
    reading = LSTMUpdate(1, observation_dim=2, hidden_size=5, encoding_key=None, observation_key="y")
    of_samples = reading(TensorDict({"y": samples, "forecast": state}, [3]))
    of_mean = reading(TensorDict({"y": samples.mean(1), "forecast": state}, [3]))
    assert of_samples["belief", "mean"].equal(of_mean["belief", "mean"])


def test_variance_begins_at_the_scale_and_has_a_floor(float64):
    update = LSTMUpdate(2, hidden_size=5, **SIZES, **KEYS, scale=[1.0, 10.0], floor=0.01)
    var = update(frames((7,)))["belief", "var"]
    torch.testing.assert_close(var, torch.tensor([1.01, 101.0]).expand(7, 2))
    nn.init.constant_(update.module["var"].bias, -1e4)
    assert update(frames((7,)))["belief", "var"].equal(torch.tensor([0.01, 1.0]).expand(7, 2))


def test_gradients(float64):
    update = LSTMUpdate(2, hidden_size=3, num_layers=2, **SIZES, **KEYS)
    nn.init.normal_(update.module["var"].weight)
    observed, steps = torch.tensor([[True, False], [False, False]]), torch.ones(2, 1)

    def outputs(code, reading, hidden, cell, *parameters):
        state = {"forecast": {"hidden": hidden, "cell": cell}, "observed": observed, "steps": steps}
        td = TensorDict({"code": code, "reading": reading, **state}, [2])
        named = dict(zip(dict(update.named_parameters()), parameters, strict=True))
        out = torch.func.functional_call(update, named, (td,))["belief"]
        return tuple(out[name] for name in ("mean", "var", "hidden", "cell"))

    inputs = [torch.randn(2, 4), torch.randn(2, 2), torch.randn(2, 2, 3), torch.randn(2, 2, 3)]
    inputs = [*inputs, *(parameter.detach() for parameter in update.parameters())]
    assert torch.autograd.gradcheck(outputs, [part.requires_grad_() for part in inputs])


@pytest.mark.parametrize("batch", BATCHES)
def test_pose_moves_as_the_unicycle_and_its_covariance_by_jacobians(float64, batch):
    dt = 0.3
    motion = UnicycleTransition(torch.zeros_like, dt)

    def move(state):  # the transition moves with the velocities that it is given
        td = TensorDict({("belief", "ensemble"): state.unsqueeze(-2)}, state.shape[:-1])
        return motion(td)["forecast", "ensemble"].squeeze(-2)

    def random_cov(size):
        root = torch.randn(*batch, size, size)
        return root @ root.mT

    mean, velocity = 3 * torch.randn(*batch, 5), 3 * torch.randn(*batch, 2)
    cov, velocity_cov = random_cov(5), random_cov(2)
    forecast, estimate = {"mean": mean, "cov": cov}, {"mean": velocity, "cov": velocity_cov}
    out = UnicyclePose(dt)(TensorDict({"forecast": forecast, "velocity": estimate}, batch))["belief"]
    state = torch.cat([mean[..., :3], velocity], -1)
    jacobian = torch.func.jacrev(move)
    for _ in batch:
        jacobian = torch.func.vmap(jacobian)
    J, joint = jacobian(state), torch.zeros(*batch, 5, 5)
    joint[..., :3, :3], joint[..., 3:, 3:] = cov[..., :3, :3], velocity_cov
    torch.testing.assert_close(out["mean"], move(state), rtol=0, atol=1e-13)
    torch.testing.assert_close(out["cov"], J @ joint @ J.mT, rtol=1e-12, atol=1e-12)
    assert out["var"].equal(out["cov"].diagonal(dim1=-2, dim2=-1))


def test_inflation_widens_the_belief_and_leaves_its_mean():
    update = LSTMUpdate(2, features=3, hidden_size=4, encoding_key="x", scale=[2.0, 0.5])
    td = TensorDict({"x": torch.randn(5, 3), "forecast": {k: torch.randn(5, 1, 4) for k in ("hidden", "cell")}}, [5])
    plain = update(td.copy())["belief"]
    update.inflation = 1.5
    wide = update(td.copy())["belief"]
    torch.testing.assert_close(wide["var"], 2.25 * plain["var"])
    assert wide["mean"].equal(plain["mean"])
