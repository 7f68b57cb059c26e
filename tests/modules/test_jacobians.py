"""Oracle: automatic differentiation, by which the same filter steps when no sub-model knows its Jacobian."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.testing import assert_close

from tests.filters.factories import has_compiler
from tests.motions.steps_for_tests import MOTIONS, frame, random_points
from tests.motions.test_readings import DEEP, READINGS
from torch_denkf.applications.legged.motion import LeggedMotion, LeggedSpace
from torch_denkf.applications.legged.readings import FeetInBody, FeetRates
from torch_denkf.compilation import options_for_processors
from torch_denkf.functional.jacobians import jacobian_of_network
from torch_denkf.functional.manifolds import SO3, Euclidean, Opposite
from torch_denkf.fusion.parts import JoinedObservation, LinearMembers, OfOwnErrors, StateObservation
from torch_denkf.imperfect import FadingBias
from torch_denkf.imperfect.bias import BiasedObservation, BiasedTransition
from torch_denkf.modules import (
    ConstantNoise,
    EKFAnalysis,
    EKFTransition,
    LearnedObservation,
    LearnedTransition,
    LinearObservation,
    LinearTransition,
    Select,
    StochasticMLP,
    UKFAnalysis,
    UKFTransition,
)
from torch_denkf.motions import AttitudeMotion, Gravity
from torch_denkf.running import run_module
from torch_denkf.submodel import Call, SubModel

ACTIVATIONS = {
    "relu": nn.ReLU,
    "leaky": lambda: nn.LeakyReLU(0.2),
    "elu": lambda: nn.ELU(0.7),
    "tanh": nn.Tanh,
    "sigmoid": nn.Sigmoid,
    "silu": nn.SiLU,
    "silu in place": lambda: nn.SiLU(inplace=True),
    "softplus": lambda: nn.Softplus(2.0, threshold=1.0),
}


def mlp(n_in, n_out, activation=nn.Tanh, layer="none"):
    return StochasticMLP(n_in, n_out, (7, 6), layer=layer, activation=activation)


def chain(n_in, n_out):
    return nn.Sequential(nn.Sequential(nn.Linear(n_in, 5), nn.ELU()), nn.Identity(), nn.Linear(5, n_out, bias=False))


def scaled(network, **options):
    where = {"loc": [1.0, 2.0, -1.0], "scale": [2.0, 0.5, 3.0]}
    return lambda: LearnedTransition(network(), **where, **options)


def linear(**options):
    return LinearTransition(torch.randn(3, 3), torch.eye(3), trainable=True, **options)


def of_own_errors():
    bias = FadingBias([1.0, 1.0], time=3.0)
    return OfOwnErrors(BiasedObservation(LearnedObservation(mlp(3, 2)), bias), [2, 0], 3)


def of_a_sensor(observation, name):
    keys = {"reading_keys": ["reading", "noise"], "observed_key": "observed"}
    return StateObservation(observation, ("forecast", "ensemble"), name, **keys)


def side_by_side():
    models = {"a": of_a_sensor(Select([1]), "a"), "b": of_a_sensor(LearnedObservation(mlp(3, 1)), "b")}
    keys = {"predicted_key": ("forecast", "observation"), "observed_key": ("forecast", "observed")}
    return JoinedObservation(models, [None, None], **keys)


TRANSITIONS = {
    **{kind: lambda layer=kind: LearnedTransition(mlp(3, 3, layer=layer)) for kind in ("none", "dropout", "flipout")},
    "linear": lambda: LearnedTransition(nn.Linear(3, 3), residual=False),
    "chain": lambda: LearnedTransition(chain(3, 3)),
    "identity": lambda: LearnedTransition(nn.Identity()),
    "activation alone": lambda: LearnedTransition(nn.Tanh()),
    "action and dt": scaled(lambda: mlp(5, 3), action_key="action", action_loc=[1.0, 0.0], dt_key="dt"),
    "dt": scaled(lambda: chain(3, 3), dt_key="dt"),
    "not residual": scaled(lambda: chain(3, 3), residual=False),
    "matrices": lambda: LinearMembers(linear(control=torch.randn(3, 2))),
    "biased": lambda: BiasedTransition(LearnedTransition(mlp(2, 2)), FadingBias([1.0], time=3.0)),
}
OBSERVATIONS = {
    "mlp": lambda: LearnedObservation(mlp(3, 2, nn.ReLU), loc=[1.0, 0.0, 2.0], scale=[2.0, 1.0, 0.5]),
    "select": lambda: Select([2, 0, 2]),
    "linear": lambda: LinearObservation(torch.randn(2, 3)),
    "of a fused sensor": lambda: of_a_sensor(LearnedObservation(mlp(3, 2)), ("forecast", "observation")),
    "biased": lambda: BiasedObservation(LearnedObservation(mlp(2, 1)), FadingBias([1.0], time=3.0)),
    "biased factor": lambda: BiasedObservation(Select([0, 1]), FadingBias([1.0], time=3.0, factor=True), dims=[1]),
    "errors of others": of_own_errors,
    "side by side": side_by_side,
}


def entries(size, *batch, space=None, **others):
    tangents = size if space is None else space.tangent_dim
    root = torch.randn(*batch, tangents, tangents)
    mean = torch.randn(*batch, size) if space is None else random_points(space, *batch)
    moments = {"mean": mean, "cov": root @ root.mT + torch.eye(tangents)}
    return TensorDict({"belief": dict(moments), "forecast": dict(moments), **others}, batch)


def known_and_differentiated(monkeypatch, module, td, *, parameters=()):
    """Returns what a step writes and its gradients, by the sub-model's Jacobian and by autodiff."""
    results = []
    for forget in (False, True):
        if forget:
            monkeypatch.setattr("torch_denkf.modules.ekf.linearise", lambda *_: None)
        else:
            monkeypatch.setattr("torch_denkf.modules.ekf._differentiated", None)  # it is not called
        out = module(td.copy())
        monkeypatch.undo()
        values = [out.get(key) for key in module.out_keys]
        total = sum((value * torch.arange(1.0, value.numel() + 1).reshape(value.shape).sin()).sum() for value in values)
        grads = torch.autograd.grad(total, parameters, materialize_grads=True) if total.requires_grad else ()
        results.append([*values, *grads])
    return results


def moving(transition, size, **options):
    noise = ConstantNoise([0.3] * size, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    return EKFTransition(transition, noise, **options)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("name", TRANSITIONS)
def test_jacobian_of_a_transition_and_its_gradient(float64, monkeypatch, name, batch):
    transition = TRANSITIONS[name]()
    td = entries(3, *batch, action=torch.randn(*batch, 2), dt=torch.rand(*batch, 1))
    both = known_and_differentiated(monkeypatch, moving(transition, 3), td, parameters=list(transition.parameters()))
    assert_close(*both, rtol=1e-10, atol=1e-10)


def reading(name, *batch, kind=EKFAnalysis):
    """Returns an update of an observation, and what it reads."""
    observation = OBSERVATIONS[name]()
    size = {"errors of others": 6}.get(name, 3)
    outputs = {"select": 3, "biased": 1, "biased factor": 2}.get(name, 2)
    mask = torch.rand(*batch, 1 if name == "side by side" else outputs) > 0.3
    td = entries(size, *batch, reading=torch.randn(*batch, outputs), noise=torch.rand(*batch, outputs), observed=mask)
    masks = {"observed_key": ("forecast", "observed")} if name == "side by side" else {}
    return kind(observation, observation_key="reading", noise_variance_key="noise", **masks), td


@pytest.mark.parametrize("batch", [(), (4,)])
@pytest.mark.parametrize("name", OBSERVATIONS)
def test_jacobian_of_an_observation_and_its_gradient(float64, monkeypatch, name, batch):
    update, td = reading(name, *batch)
    both = known_and_differentiated(monkeypatch, update, td, parameters=list(update.parameters()))
    assert_close(*both, rtol=1e-10, atol=1e-10)


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="inductor needs a C++ compiler, g++")
@pytest.mark.parametrize("kinds", [(EKFTransition, EKFAnalysis), (UKFTransition, UKFAnalysis)], ids=["EKF", "UKF"])
@pytest.mark.parametrize("known", [True, False])
def test_inductor_gives_the_eager_numbers_and_gradients(float64, monkeypatch, kinds, known):
    """All in one graph, with their Jacobians and without: mapped backward passes meet errors of inductor's own."""
    if not known:
        monkeypatch.setattr("torch_denkf.modules.ekf.linearise", lambda *_: None)
    noise = ConstantNoise([0.3] * 3, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    td = entries(3, 4, action=torch.randn(4, 2), dt=torch.rand(4, 1))
    parts = [(kinds[0](make(), noise), td) for make in TRANSITIONS.values()]
    parts += [reading(name, 4, kind=kinds[1]) for name in OBSERVATIONS]
    rows = [dict(row.items(True, True)) for _, row in parts]
    parameters = [parameter for module, _ in parts for parameter in module.parameters()]

    def run():
        pairs = zip(parts, rows, strict=True)
        return [[*run_module(module, row, Call(torch.Size([4]))).values()] for (module, _), row in pairs]

    found = []
    for function in (run, torch.compile(run, fullgraph=True, dynamic=False, options=options_for_processors())):
        values = [value for written in function() for value in written if value.is_floating_point()]
        loss = sum(value.sin().sum() for value in values)
        found.append([*values, *torch.autograd.grad(loss, parameters, materialize_grads=True)])
    assert_close(*found, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_chains_of_layers(float64, name):
    network = nn.Sequential(nn.Linear(4, 5), ACTIVATIONS[name](), nn.Linear(5, 5), ACTIVATIONS[name](), nn.Linear(5, 3))
    x = 2 * torch.randn(6, 4)
    x[0], x[1] = 0.0, 30.0
    parameters = list(network.parameters())
    value, jacobian = jacobian_of_network(network, x, 2)
    expected = torch.func.vmap(torch.func.jacrev(network))(x)[..., :2]
    assert_close(value, network(x), rtol=1e-12, atol=1e-12)
    assert_close(jacobian, expected, rtol=1e-10, atol=1e-10)
    ours, theirs = (
        torch.autograd.grad(each.sin().sum(), parameters[:-1], materialize_grads=True) for each in (jacobian, expected)
    )
    assert_close(ours, theirs, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
@pytest.mark.parametrize("name", ACTIVATIONS)
def test_chains_keep_their_precision(name, dtype):
    network = nn.Sequential(nn.Linear(2, 3), ACTIVATIONS[name](), nn.Linear(3, 2)).to(dtype)
    x = torch.tensor([[-1.0, 0.5], [2.0, -0.3]], dtype=dtype)
    jacobian = jacobian_of_network(network, x, 2)[1]
    tolerance = 4 * torch.finfo(dtype).eps
    assert_close(jacobian, torch.func.vmap(torch.func.jacrev(network))(x), rtol=tolerance, atol=tolerance)


def test_unknown_jacobians_in_a_chain_are_differentiated():
    x = torch.zeros(1, 3)
    others = [nn.LayerNorm(3), nn.Sequential(nn.Linear(3, 3), nn.GELU("tanh")), lambda x: x, nn.ReLU6()]
    weighted = nn.utils.parametrizations.weight_norm(nn.Linear(3, 3))
    hooked, outer = nn.Linear(3, 3), nn.Sequential(nn.Linear(3, 3))
    for layer in (hooked, outer):
        layer.register_forward_hook(lambda module, read, out: 2 * out)
    still, watched, before, own = nn.Identity(), nn.Linear(3, 3), nn.Linear(3, 3), nn.Linear(3, 3)
    still.register_forward_hook(lambda module, read, out: 2 * out)
    watched.register_full_backward_hook(lambda module, read, out: None)
    before.register_full_backward_pre_hook(lambda module, out: None)
    own.forward = lambda x: 2 * x

    class Twice(StochasticMLP):
        def forward(self, x, *args, **options):
            return 2 * super().forward(x, *args, **options)

    twice = Twice(3, 3, (4,), layer="none")
    for network in (*others, weighted, hooked, outer, nn.Sequential(hooked), still, watched, before, own, twice):
        assert jacobian_of_network(network, x, 3) is None


@pytest.mark.parametrize("kind", ["compute", "hook", "wrapper", "mixin"])
def test_overriding_a_computation_replaces_its_jacobian(float64, kind):
    """Oracle: the factor."""

    class Doubled(Select):
        def observe(self, state):
            return 2 * super().observe(state)

    class Twofold:
        def compute(self, ensemble):
            return 2 * super().compute(ensemble)

    class Mixed(Twofold, Select):
        pass

    observation = {"compute": Doubled, "mixin": Mixed}.get(kind, Select)([0])
    if kind == "hook":
        observation.register_forward_hook(
            lambda module, read, out: out.set(("forecast", "observation"), 2 * out["forecast", "observation"])
        )
    if kind == "wrapper":

        class Twice(StateObservation):
            def on_entries(self, entries, call):
                return {key: 2 * value for key, value in super().on_entries(entries, call).items()}

        keys = {"reading_keys": ["reading", "noise"], "observed_key": "observed"}
        observation = Twice(observation, ("forecast", "ensemble"), ("forecast", "observation"), **keys)
    td = entries(2, reading=torch.zeros(1), noise=torch.zeros(1))
    out = EKFAnalysis(observation, observation_key="reading", noise_variance_key="noise")(td)
    assert_close(out["belief", "mean"][0], torch.tensor(0.0), atol=1e-12, rtol=0)
    assert_close(out["info", "innovation"], -2 * td["forecast", "mean"][:1])


@pytest.mark.parametrize("still", [False, True])
@pytest.mark.parametrize("dt", [0.3, "dt"])
@pytest.mark.parametrize("name", MOTIONS)
def test_known_motions(float64, monkeypatch, name, dt, still):
    motion = MOTIONS[name](dt)
    space, batch = motion.space, (2, 3)
    td = entries(space.point_dim, *batch, space=space, dt=torch.rand(*batch, 1), **frame(motion, *batch, still=still))
    if still:
        td["belief", "mean"] = space.neutral().expand(*batch, -1)
    both = known_and_differentiated(monkeypatch, moving(motion, space.tangent_dim, space=space), td)
    assert_close(*both, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", READINGS)
def test_known_readings(float64, monkeypatch, name):
    reading = READINGS[name]()
    space, own, batch = reading.space, reading.reading_space, (2, 3)
    noise = torch.rand(*batch, own.tangent_dim)
    td = entries(space.point_dim, *batch, space=space, reading=random_points(own, *batch), noise=noise)
    keys = {"observation_key": "reading", "noise_variance_key": "noise"}
    update = EKFAnalysis(reading, space=space, reading_space=own, **keys)
    assert_close(*known_and_differentiated(monkeypatch, update, td), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("moves_key", [None, "moves"])
@pytest.mark.parametrize("name", ["motion", "motion of other steps", "feet", "rates"])
def test_a_legged_robots(float64, monkeypatch, name, moves_key):
    """Two feet, which stand or not; the biases turn what they move."""
    space, batch = LeggedSpace(2), (3,)
    given = {"imu": torch.randn(3, 6), "legs": {"feet": torch.randn(3, 6)}, "contact": torch.rand(3, 2) > 0.4}
    given |= {
        "moves": torch.randn(3, 6),
        "dt": torch.rand(3, 1),
        "reading": torch.randn(3, 6),
        "noise": torch.ones(3, 6),
    }
    td = entries(22, *batch, space=space, **given)
    if name.startswith("motion"):
        motion = LeggedMotion(2, 0.1 if name == "motion" else "dt", moves_key=moves_key).double()
        module = moving(motion, 21, space=space)
    else:
        observation = FeetInBody(space) if name == "feet" else FeetRates(space, moves_key=moves_key)
        keys = {"observation_key": "reading", "noise_variance_key": "noise"}
        module = EKFAnalysis(observation, space=space, **keys)
    assert_close(*known_and_differentiated(monkeypatch, module, td), rtol=1e-9, atol=1e-9)


def test_at_a_landmark_range_and_bearing_have_no_gradient():
    reading = READINGS["range and bearing"]()
    state = torch.zeros(1, 6)
    state[0, 3:5] = torch.tensor([3.0, 4.0])
    value, jacobian = reading.jacobian(state)
    assert value.tolist() == [[0.0, 0.0]]
    assert jacobian.tolist() == torch.zeros(1, 2, 6).tolist()


def test_tangents_of_another_space_are_differentiated(float64):
    """Oracle: the same filter without the motion's own Jacobian; a right-invariant filter has other tangents."""
    motion = AttitudeMotion(0.1)
    space = Opposite(SO3()) * Euclidean(3)
    td = entries(7, 2, space=space, gyro=torch.randn(2, 3))
    ours = moving(motion, 6, space=space)(td.copy())["forecast", "cov"]
    motion.jacobian = lambda *_: None
    assert_close(ours, moving(motion, 6, space=space)(td.copy())["forecast", "cov"], rtol=1e-12, atol=1e-12)
    gravity = Gravity(DEEP, part=1)
    assert gravity.tangents_of == (DEEP, Euclidean(3))
    assert SubModel.tangents_of is None
