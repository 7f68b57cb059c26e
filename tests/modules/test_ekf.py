"""Oracles: Jacobians by reverse-mode differentiation and finite differences, the Kalman update, a filter in numpy."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.factories import NoisyLinear
from tests.filters.gaussian_for_tests import directional_check
from torch_denkf.applications.car import UnicycleTransition
from torch_denkf.applications.car.modules.pairs import ClonedTransition, PairObservation
from torch_denkf.functional import kalman_update
from torch_denkf.functional.manifolds import Flat
from torch_denkf.fusion.parts import OfOwnErrors
from torch_denkf.modules import (
    ConstantNoise,
    DiagonalNoise,
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
from torch_denkf.modules.stochastic import FlipoutLinear
from torch_denkf.running import linearise
from torch_denkf.submodel import Call

TRANSITIONS, ANALYSES = [EKFTransition, UKFTransition], [EKFAnalysis, UKFAnalysis]


def constant_noise(size):
    return ConstantNoise([0.3] * size, in_key=("belief", "mean"), out_key=("forecast", "noise"))


def spread(*batch, dim):
    root = torch.randn(*batch, dim, dim)
    return root @ root.mT


def belief(*batch, dim=5, **entries):
    mean = torch.randn(*batch, dim)
    return TensorDict({"belief": {"mean": mean, "cov": spread(*batch, dim=dim)}, **entries}, batch)


def network(n_in, n_out, layer="none"):
    return StochasticMLP(n_in, n_out, (8, 8), layer=layer, activation=nn.Tanh)


def by_rows(function, mean):
    """Jacobian of one row at a time, by torch's reverse mode."""
    return torch.stack([torch.autograd.functional.jacobian(function, row) for row in mean])


@pytest.mark.parametrize("layer", ["none", "dropout", "flipout"])
@pytest.mark.parametrize("clones", [0, 2])
def test_forecast_is_f_p_f_with_the_jacobian_of_any_transition(float64, layer, clones):
    unicycle = UnicycleTransition(network(2, 2, layer), dt=0.2, scale=[3.0, 0.5], loc=[1.0, 0.0])
    transition = ClonedTransition(unicycle) if clones else unicycle
    dim = 5 + 2 * clones
    td = belief(4, dim=dim)
    out = EKFTransition(transition, constant_noise(dim))(td.copy())
    velocity = unicycle.module
    assert velocity.sample, "left as it was"
    velocity.sample = False

    def move(state):
        return transition(TensorDict({("belief", "ensemble"): state.unsqueeze(-2)}, state.shape[:-1]))[
            "forecast", "ensemble"
        ].squeeze(-2)

    mean, cov = td["belief", "mean"], td["belief", "cov"]
    F = by_rows(move, mean)
    basis = torch.eye(dim).unsqueeze(1) * 1e-6
    differences = ((move(mean + basis) - move(mean - basis)) / 2e-6).permute(1, 2, 0)
    torch.testing.assert_close(F, differences, rtol=0, atol=1e-8)  # the step's square, and eps / step
    torch.testing.assert_close(out["forecast", "mean"], move(mean), rtol=0, atol=1e-14)
    expected = F @ cov @ F.mT + 0.09 * torch.eye(dim)
    torch.testing.assert_close(out["forecast", "cov"], expected, rtol=1e-11, atol=1e-11)
    assert "ensemble" not in out["belief"], "the members are in a copy"


@pytest.mark.parametrize("Transition", TRANSITIONS)
def test_actions_and_state_dependent_process_noise(float64, Transition):
    noise = DiagonalNoise(3, r=0.5, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    nn.init.normal_(noise.module.layers[-1].weight)
    matrix = nn.Linear(5, 3)
    module = Transition(LearnedTransition(matrix, action_key="action", residual=False), noise)
    assert module.in_keys == [("belief", "mean"), ("belief", "cov"), "action"]
    assert module.out_keys == [("forecast", "mean"), ("forecast", "cov")]
    td = belief(2, 3, dim=3, action=torch.randn(2, 3, 2))
    out = module(td.copy())
    F = matrix.weight[:, :3]
    mean = matrix(torch.cat([td["belief", "mean"], td["action"]], -1))
    Q = noise(td.copy())["forecast", "noise"].diag_embed()
    torch.testing.assert_close(out["forecast", "mean"], mean, rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(out["forecast", "cov"], F @ td["belief", "cov"] @ F.mT + Q, rtol=1e-10, atol=1e-10)


def test_the_jacobian_has_a_gradient_unless_it_is_stopped(float64):
    net, td = network(2, 2), belief(3)
    stopped, module = (
        EKFTransition(UnicycleTransition(net, 0.2), constant_noise(5), stop_jacobian_gradient=stop)
        for stop in (True, False)
    )
    # The covariance depends on the network through F alone, and Q is fixed.
    out = stopped(td.copy())
    assert not out["forecast", "cov"].requires_grad
    assert (torch.autograd.grad(out["forecast", "mean"].sum(), net.layers[0].weight)[0] != 0).any()
    directional_check(lambda: module(td.copy())["forecast", "cov"].sum(), [net.layers[0].weight], step=1e-6, rtol=1e-6)


@pytest.mark.parametrize("Transition", TRANSITIONS)
@pytest.mark.parametrize("layer", [nn.Dropout(), FlipoutLinear(3, 3)])
def test_random_layers_raise(Transition, layer):
    random = LearnedTransition(nn.Sequential(nn.Linear(3, 3), layer))
    with pytest.raises(ValueError, match=r"deterministic model; LearnedTransition has random parts \(\['module.1'\]"):
        Transition(random, constant_noise(3))


@pytest.mark.parametrize("Analysis", ANALYSES)
def test_random_observation_models_raise_or_made_deterministic(Analysis):
    with pytest.raises(ValueError, match="needs a deterministic model; LearnedObservation"):
        Analysis(LearnedObservation(nn.Sequential(nn.Linear(3, 3), nn.Dropout())))
    module = Analysis(LearnedObservation(StochasticMLP(3, 2, (64,), rate=0.5)))
    td = forecast(4)
    assert module(td.copy())["belief", "mean"].equal(module(td.copy())["belief", "mean"])


@pytest.mark.parametrize("Transition", TRANSITIONS)
def test_sub_models_that_draw_their_own_noise_raise(Transition):
    matrix, state = torch.eye(3), torch.get_rng_state()
    noisy = NoisyLinear(matrix, matrix)
    with pytest.raises(ValueError, match=r"NoisyLinear has random parts \(\['NoisyLinear'\]"):
        Transition(noisy, constant_noise(3))
    assert torch.get_rng_state().equal(state)
    Transition(NoisyLinear(matrix), constant_noise(3))


# ------------------------------------------------------------------------------------------------------ analysis


def forecast(*batch, dim=3, observations=2):
    return TensorDict(
        {
            "forecast": {"mean": torch.randn(*batch, dim), "cov": spread(*batch, dim=dim)},
            "sensor": {
                "ensemble": torch.randn(*batch, 7, observations),
                "noise": torch.rand(*batch, observations) + 0.5,
            },
        },
        batch,
    )


def assert_is_update(out, update, *, atol=1e-10):
    names = {"belief": ("mean", "cov"), "info": ("innovation", "nis", "log_likelihood")}
    for prefix, keys in names.items():
        for name in keys:
            torch.testing.assert_close(out[prefix, name], getattr(update, name), rtol=1e-9, atol=atol)
    assert out["belief", "var"].equal(out["belief", "cov"].diagonal(dim1=-2, dim2=-1))


@pytest.mark.parametrize("layer", ["none", "dropout"])
def test_update_is_linear_in_the_jacobian(float64, layer):
    model = LearnedObservation(network(3, 2, layer), scale=[1.0, 2.0, 3.0])
    td = forecast(4)
    out = EKFAnalysis(model)(td.copy())
    model.module.sample = False
    mean, cov = td["forecast", "mean"], td["forecast", "cov"]
    H = by_rows(model.observe, mean)
    reading = td["sensor", "ensemble"].mean(-2)
    shifted = reading - model.observe(mean) + (H @ mean.unsqueeze(-1)).squeeze(-1)
    assert_is_update(out, kalman_update(mean, cov, shifted, H, td["sensor", "noise"]))


@pytest.mark.parametrize("Analysis", ANALYSES)
@pytest.mark.parametrize("width", [1, 2])
def test_masks_full_noise_and_plain_readings(float64, Analysis, width):
    td = forecast(2, 3)
    H = torch.randn(2, 3)
    td["observed"] = torch.rand(2, 3, width) < 0.5
    td["reading"] = torch.where(td["observed"], torch.randn(2, 3, 2), torch.nan).requires_grad_()
    td["R"] = spread(2, 3, dim=2) + torch.eye(2)
    td["R"] = torch.where(td["observed"].unsqueeze(-1), td["R"], torch.nan)
    td["R"] = torch.where(td["observed"].unsqueeze(-2), td["R"], torch.nan).requires_grad_()
    out = Analysis(LinearObservation(H), observation_key="reading", noise_variance_key="R")(td.copy())
    moments = td["forecast", "mean"], td["forecast", "cov"]
    assert_is_update(out, kalman_update(*moments, td["reading"], H, td["R"], observed=td["observed"]))
    total = sum(value.square().sum() for value in out["belief"].values()) + out["info", "log_likelihood"].sum()
    for gradient in torch.autograd.grad(total, (td["reading"], td["R"])):
        assert gradient.isfinite().all()
    nothing = ~td["observed"].any(-1)
    torch.testing.assert_close(out["belief", "mean"][nothing], moments[0][nothing], rtol=0, atol=0)
    torch.testing.assert_close(out["belief", "cov"][nothing], moments[1][nothing], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("Analysis", ANALYSES)
def test_the_observation_model_may_read_steps_and_write_the_mask(float64, Analysis):
    # Pairs over 1, 2 and 3 steps, one that does not exist, and one over a gap beyond the sensor's reach.
    td = forecast(5, dim=9)
    td["forecast", "mean"][4, 3] = 100.0
    td["steps"] = torch.tensor([[1], [2], [3], [0], [2]])
    module = Analysis(PairObservation([50.0, torch.inf], history_key=None), observed_key=("forecast", "observed"))
    assert ("forecast", "ensemble") not in module.in_keys
    out = module(td.copy())
    velocities = torch.eye(9)[3:].unflatten(0, (3, 2))
    for row, pairs in enumerate((1, 2, 3)):
        one = td[row]
        H = velocities[:pairs].sum(0)
        reading = one["sensor", "ensemble"].mean(-2)
        update = kalman_update(one["forecast", "mean"], one["forecast", "cov"], reading, H, one["sensor", "noise"])
        assert_is_update(out[row], update)
    assert (out["info", "log_likelihood"][3:] == 0).all()
    torch.testing.assert_close(out["belief", "mean"][3:], td["forecast", "mean"][3:], rtol=0, atol=0)


@pytest.mark.parametrize("Analysis", ANALYSES)
def test_inflation_acts_where_something_is_observed(float64, Analysis):
    td = forecast(4)
    td["observed"] = torch.tensor([[True, True], [True, False], [False, True], [False, False]])
    plain, inflated = (Analysis(Select([0, 2]), inflation=factor)(td.copy()) for factor in (1.0, 1.5))
    factor = torch.tensor([2.25, 2.25, 2.25, 1.0])
    for name, shape in (("cov", (4, 1, 1)), ("var", (4, 1))):
        torch.testing.assert_close(inflated["belief", name], factor.reshape(shape) * plain["belief", name])
    assert inflated["belief", "mean"].equal(plain["belief", "mean"])


@pytest.mark.parametrize("Analysis", ANALYSES)
def test_angles_are_compared_across_pi(float64, Analysis):
    td = forecast(1)
    td["forecast", "mean"][0, 0], td["sensor", "ensemble"][..., 0] = 3.1, -3.1
    innovation = Analysis(Select([0, 1]), reading_space=Flat(2, circular=[0]))(td.copy())["info", "innovation"]
    torch.testing.assert_close(innovation[0, 0], torch.tensor(2 * torch.pi - 6.2), rtol=0, atol=1e-12)


def test_an_observation_that_ignores_the_state_corrects_nothing(float64):
    td = forecast(2)
    out = EKFAnalysis(LearnedObservation(lambda x: torch.ones_like(x[..., :2])))(td.copy())
    torch.testing.assert_close(out["belief", "mean"], td["forecast", "mean"], rtol=0, atol=0)
    torch.testing.assert_close(out["info", "innovation"], td["sensor", "ensemble"].mean(-2) - 1, rtol=0, atol=1e-14)


@pytest.mark.parametrize("error", [ValueError, KeyError, IndexError, TypeError])
@pytest.mark.parametrize("wrapped", [False, True])
def test_an_error_in_a_jacobian_is_raised(error, wrapped):
    """It is no sign that the Jacobian is not known, also of a model inside another."""

    class Own(Select):
        def jacobian(self, *values):
            raise error("division by my own wheelbase")

    model = OfOwnErrors(Own([1]), [0], 1) if wrapped else Own([1])
    td = TensorDict({"forecast": {"mean": torch.zeros(3), "cov": torch.eye(3)}}, [])
    td["sensor"] = {"ensemble": torch.ones(1), "noise": torch.ones(1)}
    with pytest.raises(error, match="my own wheelbase"):
        EKFAnalysis(model)(td)


def test_jacobian_of_an_unbiased_sensor_next_to_a_biased_one():
    model = OfOwnErrors(Select([1]), [], 1)
    states = torch.randn(4, 1, 3)
    _, jacobian, _ = linearise(model, {("forecast", "ensemble"): states}, Call(torch.Size([4])))
    assert jacobian.expand(4, 1, 1, 3).equal(torch.tensor([0.0, 1.0, 0.0]).expand(4, 1, 1, 3))
