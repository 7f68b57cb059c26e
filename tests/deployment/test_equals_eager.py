"""A packaged step gives the eager step's numbers where there is more to trace than plain arithmetic.

Jacobians by automatic differentiation, a Gauss-Newton search, an LSTM cell: traced wrongly, each gives a package that
runs silently, and is wrong.
"""

import pytest
import torch
from torch import nn

from tests.deployment.test_export import needs_compiler
from tests.filters.gaussian_for_tests import learned_filter, learned_frames
from torch_denkf.baselines import IEnKS, LSTMFilter
from torch_denkf.deployment import export_step, load_step
from torch_denkf.filters import EKF
from torch_denkf.modules import ConstantNoise, GaussianPrior, LearnedTransition, MomentPrior, Select, StochasticMLP

STATES = 3


def bend(states):
    """Returns a known motion that is not linear."""
    x, y, z = states.unbind(-1)
    return torch.stack([x + 0.3 * y.sin(), 0.9 * y - 0.1 * x**3, z.cos() * x], -1)


def parts(motion):
    """Transition, sensor, observation and noise of a filter that reads "reading" ``[*B, 2]``."""
    noise = ConstantNoise([1.0, 0.8], in_key="reading")
    return {
        "transition": LearnedTransition(motion, residual=False),
        "sensor": None,
        "observation": Select([0, 2]),
        "noise": noise,
    }


def known_ekf():
    start = MomentPrior(torch.zeros(STATES), torch.eye(STATES))
    return EKF(**parts(bend), process_noise=[0.2] * STATES, initial=start, observation_key="reading")


def members():
    return GaussianPrior(torch.zeros(STATES), torch.ones(STATES), ensemble_size=5)


def iterated():
    network = StochasticMLP(STATES + 2, STATES, (8,), layer="none", activation=nn.Tanh)
    moved = {**parts(bend), "transition": LearnedTransition(network, action_key="action")}
    return IEnKS(**moved, initial=members(), iterations=2, observation_key="reading")


def lstm():
    return LSTMFilter(None, observation_dim=2, state_dim=STATES, observation_key="reading", hidden_size=4, num_layers=2)


FILTERS = {
    "dEKF": lambda: learned_filter("EKF"),
    "dEKF whose Jacobian is a constant": lambda: learned_filter("EKF", stop_jacobian_gradient=True),
    "EKF of a known motion": known_ekf,
    "IEnKS": iterated,
    "LSTMFilter": lstm,
}


def frames(steps):
    """Measurements, readings, actions and masks."""
    out = learned_frames(steps).exclude("is_init")
    out["observed"] = torch.tensor([[True, True], [True, False], [False, True], [False, False]]).repeat(steps // 4, 1)
    return out.update({"reading": out["measurement"][..., :2].clone()})


def assert_the_same(filter, tmp_path, batch=(), **options):
    data = frames(4) if not batch else frames(4 * batch[0]).reshape(4, *batch)
    row = filter.initialise(data[0])
    step = load_step(export_step(filter, row, tmp_path / "step.pt2", **options))
    close = 1e-6 if data["reading"].dtype == torch.float32 else 1e-12
    with torch.no_grad():
        for frame in data:
            row = row.select(*filter.carry_keys).update(frame)
            found = step({name: row[tuple(name.split("."))] for name in step.inputs})
            row = filter.step(row)
            for name, value in found.items():
                expected = row[tuple(name.split("."))]
                torch.testing.assert_close(value, expected, rtol=close, atol=close, msg=lambda m, k=name: f"{k}: {m}")


@pytest.mark.parametrize("name", FILTERS)
def test_the_graph(name, tmp_path):
    assert_the_same(FILTERS[name](), tmp_path, compiled=False)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("name", ["EKF of a known motion", "dEKF", "LSTMFilter"])
def test_compiled(name, tmp_path):
    assert_the_same(FILTERS[name](), tmp_path)
