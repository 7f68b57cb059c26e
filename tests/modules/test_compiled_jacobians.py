"""Every motion and observation model under a Jacobian, compiled by inductor: the oracle is the eager one.

Eager, copies of the batch go through the model and one backward pass goes back; compiled, backward passes are mapped
over, and inductor has errors of its own there. test_ekf.py compares the eager Jacobian with finite differences.
"""

import pytest
import torch
from torch import nn

from tests.filters.factories import has_compiler
from torch_denkf.applications.car import UnicycleTransition
from torch_denkf.applications.car.modules.pairs import ClonedTransition, PairObservation
from torch_denkf.compilation import options_for_processors
from torch_denkf.fusion.parts import JoinedObservation, StateObservation
from torch_denkf.imperfect import FadingBias
from torch_denkf.imperfect.bias import BiasedObservation, BiasedTransition
from torch_denkf.modules import (
    ConstantNoise,
    EKFAnalysis,
    EKFTransition,
    LearnedObservation,
    LearnedTransition,
    LinearObservation,
    Select,
    StochasticMLP,
    UKFAnalysis,
    UKFTransition,
)
from torch_denkf.motions import ContinuousMotion
from torch_denkf.running import run_module
from torch_denkf.submodel import Call

B, S = 3, 9  # the unicycle's five and two steps of its past; or three times three numbers
SEEN = ("forecast", "observed")
KINDS = {"EKF": (EKFTransition, EKFAnalysis), "UKF": (UKFTransition, UKFAnalysis)}


def network(inputs, outputs):
    return StochasticMLP(inputs, outputs, (6,), layer="none", activation=nn.Tanh)


def bent(state):
    """Parts in another order, as a user writes them."""
    first, second, third = state[..., 2:5].sin(), state[..., [7, 0]], state[..., 1].unsqueeze(-1)
    return torch.cat([third * first, second, state.flip(-1)[..., :3].cumsum(-1), third.clamp(-0.5, 0.5)], -1)


def of_state(model, predicted, **kwargs):
    keys = {"reading_keys": ["reading"], "observed_key": "observed", **kwargs}
    return StateObservation(model, ("forecast", "ensemble"), predicted, **keys)


def motions():
    straight = {"loc": [1.0, 0.1], "scale": [2.0, 0.5]}
    return {
        "learned": LearnedTransition(network(S + 2, S), action_key="action"),
        "unicycle": ClonedTransition(UnicycleTransition(network(2, 2), "dt", **straight)),
        "unicycle with a trend": ClonedTransition(
            UnicycleTransition(network(2, 2), 0.1, history_key="past"), history_key="past"
        ),
        "biased": BiasedTransition(LearnedTransition(network(S - 2, S - 2)), FadingBias([1.0, 2.0], time=5.0)),
        "continuous": ContinuousMotion(0.1 * torch.randn(S, S), trainable=True),
        "of a user": LearnedTransition(bent, residual=False),
    }


def observations():
    """Models, the size of what they predict, and the mask that an analysis reads after them."""
    predicted, late = ("forecast", "observation"), {"state_dim": 3}
    two = {"a": of_state(Select([1, 4]), "a"), "b": of_state(LearnedObservation(network(S, 1)), "b")}
    return {
        "select": (Select([4, 0, 7]), 3, "observed"),
        "select one": (Select([3]), 1, "observed"),
        "linear": (LinearObservation(torch.randn(2, S)), 2, "observed"),
        "learned": (LearnedObservation(network(S, 2), loc=torch.ones(S), scale=2 * torch.ones(S)), 2, "observed"),
        "biased": (BiasedObservation(Select([2, 5, 0]), FadingBias([1.0, 2.0], time=5.0), dims=[2, 0]), 3, "observed"),
        "pair": (PairObservation(history_key=None, curve=nn.Sequential(nn.Linear(2, 2), nn.Tanh())), 2, SEEN),
        "late by two": (of_state(Select([2, 0]), predicted, delay=2, **late), 2, SEEN),
        "late by what it says": (
            of_state(LearnedObservation(network(3, 2)), predicted, late_key="late", **late),
            2,
            SEEN,
        ),
        "joined": (JoinedObservation(two, [None] * 2, predicted_key=predicted, observed_key=SEEN), 3, SEEN),
        "of a user": (LearnedObservation(bent), S, "observed"),
    }


def everything(kind, dtype):
    """Modules by name, and what each reads: all of them in filters of one kind."""
    transition, analysis = KINDS[kind]
    torch.manual_seed(0)
    noise = ConstantNoise([0.3] * S, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    modules = {f"motion, {name}": transition(model, noise).to(dtype) for name, model in motions().items()}
    moments = {"mean": torch.randn(B, S, dtype=dtype), "cov": torch.eye(S, dtype=dtype).expand(B, S, S) + 0.1}
    entries = {(prefix, name): value for prefix in ("belief", "forecast") for name, value in moments.items()}
    entries |= {"action": torch.randn(B, 2, dtype=dtype), "dt": 0.1 + torch.rand(B, 1, dtype=dtype)}
    entries |= {"steps": torch.tensor([[1], [3], [2]]), "late": torch.tensor([[0], [2], [1]])}
    entries |= {("smoothed", "age"): torch.tensor([[2], [2], [0]]), "observed": torch.tensor([[True], [True], [False]])}
    reads = dict.fromkeys(modules, entries)
    for name, (model, size, mask) in observations().items():
        modules[f"observation, {name}"] = analysis(model, observed_key=mask).to(dtype)
        reading = {
            ("sensor", "ensemble"): torch.randn(B, size, dtype=dtype),
            ("sensor", "noise"): torch.ones(B, size, dtype=dtype),
        }
        reads[f"observation, {name}"] = {**entries, **reading}
    return modules, reads


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="inductor needs a C++ compiler, g++")
@pytest.mark.parametrize(
    ("kind", "gradients", "passes"),
    [("EKF", False, True), ("EKF", True, True), ("UKF", False, True), ("UKF", True, True), ("EKF", False, False)],
)
def test_inductor_gives_the_eager_numbers(kind, gradients, passes):
    """With this package's passes, and without."""
    modules, reads = everything(kind, torch.float64)
    trained = [parameter for module in modules.values() for parameter in module.parameters()]

    def run():
        return {name: run_module(module, reads[name], Call(torch.Size([B]))) for name, module in modules.items()}

    def found(run):
        with torch.set_grad_enabled(gradients):
            written = run()
        out = {f"{name}, {key}": value for name, values in written.items() for key, value in values.items()}
        if gradients:
            loss = sum(value.sin().sum() for value in out.values() if value.is_floating_point())
            out |= {
                f"gradient {i}": value
                for i, value in enumerate(torch.autograd.grad(loss, trained, materialize_grads=True))
            }
        return out

    expected = found(run)
    torch._dynamo.reset()
    options = {"options": options_for_processors()} if passes else {}
    compiled = found(torch.compile(run, fullgraph=True, dynamic=False, **options))
    for key, value in expected.items():
        # float64: a few roundings; those of a system of nine by nine among them
        torch.testing.assert_close(compiled[key], value, rtol=1e-10, atol=1e-10, msg=lambda m, k=key: f"{k}: {m}")
