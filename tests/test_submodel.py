"""Tests every sub-model: missing keys are named, keys may be renamed and nested, copies compute the same."""

import inspect
import pickle
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict, unravel_key
from torch import nn

from tests.functional.checks import assert_raises
from torch_denkf.applications.car import UnicycleMotion, UnicycleTransition
from torch_denkf.applications.car.modules.pairs import PairObservation
from torch_denkf.modules import (
    AroundState,
    ConstantNoise,
    DiagonalNoise,
    EnsembleAnalysis,
    FromSensor,
    GaussianPrior,
    ImageSensor,
    KalmanAnalysis,
    LearnedObservation,
    LearnedTransition,
    LinearObservation,
    LinearTransition,
    MomentPrior,
    Select,
    StochasticMLP,
    SubModel,
    VectorSensor,
)

E, S, OBS = 4, 5, 2
EYE, H = torch.eye(S), torch.eye(OBS, S)


def moments():
    return [torch.zeros(S), torch.ones(S)]


ACTION, MEMBERS = {"action_key": "action"}, {"ensemble_size": E}
CLONES = {"clone_key": "clone", "history_key": ("forecast", "history")}
IMAGES = {"image_shape": (1, 8, 8), "ensemble_size": E, "encoding_key": "code"}
#: name: (class, arguments, further options, the shapes of what it reads)
CASES = {
    "learned transition": (LearnedTransition, lambda: [StochasticMLP(S + 2, S, (8,))], ACTION, [(E, S), (2,)]),
    "flipout transition": (LearnedTransition, lambda: [StochasticMLP(S, S, (8,), layer="flipout")], {}, [(E, S)]),
    "unicycle": (UnicycleTransition, lambda: [StochasticMLP(2, 2, (8,)), 0.1], {}, [(E, S)]),
    "unicycle motion": (UnicycleMotion, lambda: [0.1], {}, [(E, S), (E, S)]),
    "pair observation": (PairObservation, lambda: [[50.0, 1.0]], CLONES, [(E, S), (E, 2, 2)]),
    "select": (Select, lambda: [[3, 4]], {}, [(E, S)]),
    "linear observation": (LinearObservation, lambda: [H], {}, [(E, S)]),
    "learned observation": (LearnedObservation, lambda: [nn.Linear(S, OBS)], {}, [(E, S)]),
    "diagonal noise": (DiagonalNoise, lambda: [OBS], {}, [(E, OBS)]),
    "constant noise": (ConstantNoise, lambda: [[0.1, 0.2]], {}, [(OBS,)]),
    "image sensor": (ImageSensor, lambda: [OBS], IMAGES, [(1, 8, 8)]),
    "vector sensor": (VectorSensor, lambda: [3, OBS], MEMBERS, [(3,)]),
    "gaussian prior": (GaussianPrior, moments, MEMBERS, []),
    "around state": (AroundState, lambda: [torch.ones(S)], MEMBERS, [(S,)]),
    "from sensor": (FromSensor, lambda: [[3, 4], *moments()], MEMBERS, [(E, OBS), (OBS,)]),
    "analysis": (EnsembleAnalysis, lambda: ["perturbed"], {}, [(E, S), (E, OBS), (E, OBS), (OBS,)]),
    "moment prior": (MomentPrior, lambda: [torch.zeros(S), EYE], {}, []),
    "linear transition": (LinearTransition, lambda: [2 * EYE, EYE], {}, [(S,), (S, S)]),
    "kalman analysis": (KalmanAnalysis, lambda: [H, torch.ones(OBS)], {}, [(S,), (S, S), (OBS,)]),
}
every_sub_model = pytest.mark.parametrize("name", CASES)


def plain(name):
    """Returns the sub-model with the keys that it has by default."""
    kind, arguments, options, _ = CASES[name]
    return kind(*arguments(), **options)


def names_of_keys(name):
    """Returns every parameter that names an entry, and what it names by default."""
    kind, _, options, _ = CASES[name]
    parameters = dict(inspect.signature(kind).parameters)
    if "options" in parameters:  # **options go to the class that it is made of
        parameters |= inspect.signature(kind.__base__).parameters
    defaults = {key: value.default for key, value in parameters.items() if key != "options"} | options
    keys = {key: value for key, value in defaults.items() if key.endswith(("_key", "_keys", "_prefix"))}
    return {key: value for key, value in keys.items() if value is not None and value is not inspect.Parameter.empty}


def other(parameter, value):
    """Another name, of another depth: nested twice where it is an entry, plain where it is a prefix."""
    if parameter.endswith("_keys"):
        return [("other", parameter, str(i)) for i in range(len(value))]
    return f"other {parameter}" if parameter.endswith("_prefix") else ("other", "one", parameter)


def renamed(name):
    """Returns the sub-model with other names for all that it reads and writes."""
    kind, arguments, options, _ = CASES[name]
    names = {key: other(key, value) for key, value in names_of_keys(name).items()}
    return kind(*arguments(), **{**options, **names})


def make(name, batch=(3,)):
    module = renamed(name)
    td = TensorDict({}, batch)
    for key, shape in zip(module.in_keys, CASES[name][3], strict=True):
        value = torch.rand(*batch, *shape) + 0.1
        td[key] = torch.eye(S).expand(*batch, S, S) if "cov" in key else value
    return module, td


def run(module, td, noise=None):
    td = td.copy()
    if noise is not None:
        td["noise", "self"] = noise
    torch.manual_seed(1)
    return module(td).select(*module.out_keys)


@every_sub_model
def test_every_name_is_that_of_its_parameter(name):
    before, after = plain(name), renamed(name)
    expected = {}
    for parameter, value in names_of_keys(name).items():
        new = other(parameter, value)
        pairs = zip(value, new, strict=True) if parameter.endswith("_keys") else [(value, new)]
        expected |= {unravel_key(one): another for one, another in pairs}
    for keys, found in ((before.in_keys, after.in_keys), (before.out_keys, after.out_keys)):
        for key, key_found in zip(keys, found, strict=True):
            by_prefix = (expected.get(key[0]), *key[1:]) if isinstance(key, tuple) else None
            assert unravel_key(key_found) in {expected.get(unravel_key(key)), by_prefix} - {None}


@every_sub_model
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_writes_its_out_keys_only(name, batch):
    module, td = make(name, batch)
    before = td.copy()
    out = module(td)
    assert set(out.keys(True, True)) == {*before.keys(True, True), *module.out_keys}
    assert all(td[key] is before[key] for key in module.in_keys)
    assert all(out[key].shape[: len(batch)] == batch and out[key].isfinite().all() for key in module.out_keys)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case[3]])
def test_default_and_renamed_keys_compute_the_same(name):
    module, td = make(name)
    default = plain(name)
    default.load_state_dict(module.state_dict())
    entries = {p: td[m] for p, m in zip(default.in_keys, module.in_keys, strict=True)}
    outputs, expected = run(default, TensorDict(entries, td.batch_size)), run(module, td)
    for ours, theirs in zip(default.out_keys, module.out_keys, strict=True):
        assert outputs[ours].equal(expected[theirs])


@every_sub_model
def test_missing_key_is_named(name):
    module, td = make(name)
    for key in module.in_keys:
        with pytest.raises(KeyError) as error:
            module(td.exclude(key))
        assert repr(key) in str(error.value)
        assert type(module).__name__ in str(error.value)
        for entry in module.in_keys:
            assert entry == key or str(entry) in str(error.value), "the message lists what is there"


NO_NOISE = {
    "unicycle motion",
    "pair observation",
    "select",
    "linear observation",
    "learned observation",
    "diagonal noise",
    "constant noise",
    "moment prior",
    "linear transition",
    "kalman analysis",
}


@every_sub_model
def test_copies_compute_the_same(name):
    module, td = make(name)
    noise = module.draw_noise(td.batch_size, members=E, state_dim=S, observation_dim=OBS)
    assert (noise is None) == (name in NO_NOISE)
    expected = run(module, td, noise)
    loaded = renamed(name)
    loaded.load_state_dict(module.state_dict())
    for copy in (loaded, pickle.loads(pickle.dumps(module)), deepcopy(module)):
        out = run(copy, td, noise)
        assert all(out[key].equal(expected[key]) for key in module.out_keys)


class TwoNoises(SubModel):
    """Adds two noises by name to a value, behind an entry of whole numbers."""

    noise_names = ("push", "pull")

    def __init__(self):
        super().__init__(nn.Identity(), ["count", "x"], ["y"])

    def draw_noise(self, batch_size, *, device=None, dtype=None, generator=None, **_):
        draw = lambda: torch.randn(*batch_size, 2, device=device, dtype=dtype, generator=generator)  # noqa: E731
        return {"push": draw(), "pull": draw()}

    def compute(self, count, x, *, noise):
        return count.unsqueeze(-1) * x + noise["push"] - noise["pull"]


def test_noise_is_drawn_in_the_precision_of_what_is_read_and_all_or_none_is_given():
    module, zero = TwoNoises(), torch.zeros(3, 2, dtype=torch.float64)
    td = TensorDict({"count": torch.tensor([1, 2, 3]), "x": zero}, [3])
    torch.manual_seed(0)
    drawn = torch.randn(2, 3, 2, dtype=torch.float64)
    torch.manual_seed(0)
    assert module(td.copy())["y"].equal(drawn[0] - drawn[1])
    given = {"push": zero + 1.0, "pull": zero + 3.0}
    td["noise", "self"] = given
    assert (module(td.copy())["y"] == -2.0).all()
    del td["noise", "self", "pull"]  # half of it is as good as none
    torch.manual_seed(0)
    assert module(td)["y"].equal(drawn[0] - drawn[1])


class Returns(SubModel):
    """A sub-model of two out_keys, and whatever its compute returns."""

    def __init__(self, out):
        super().__init__(nn.Identity(), ["x"], [("belief", "mean"), ("belief", "var")])
        self.out, self.reading_keys = out, self.in_keys

    def compute(self, x):
        return self.out


@pytest.mark.parametrize(
    ("out", "got"),
    [
        (torch.zeros(2), "1 values"),
        ((torch.zeros(2),) * 3, "3 values"),
        (None, "NoneType"),
        ({"a": torch.zeros(2)}, "dict"),
    ],
)
def test_too_few_or_too_many_values_name_the_module_and_its_keys(out, got):
    keys = r"\[\('belief', 'mean'\), \('belief', 'var'\)\], 2 values; it returned "
    assert_raises(ValueError, r"Returns.compute\(\) .*" + keys + got, Returns(out), TensorDict({"x": torch.zeros(2)}))
