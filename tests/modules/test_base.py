"""What holds for every sub-model: missing keys are named, keys may be renamed and nested, copies compute the same."""

import pickle
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf.applications.car import PairObservation, UnicycleMotion, UnicycleTransition
from torch_denkf.filters._steps import _without_reading
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

#: name: (constructor, keyword arguments that rename every key, {the renamed input: its shape})
CASES = {
    "learned transition": (
        lambda **k: LearnedTransition(StochasticMLP(S + 2, S, (8,)), **{"action_key": "action", **k}),
        {"in_key": ("a", "b", "x"), "out_key": ("c", "f"), "action_key": ("a", "u")},
        {("a", "b", "x"): (E, S), ("a", "u"): (2,)},
    ),
    "flipout transition": (
        lambda **k: LearnedTransition(StochasticMLP(S, S, (8,), layer="flipout"), **k),
        {"in_key": ("a", "x"), "out_key": "f"},
        {("a", "x"): (E, S)},
    ),
    "unicycle": (
        lambda **k: UnicycleTransition(StochasticMLP(2, 2, (8,)), 0.1, **k),
        {"in_key": ("a", "x"), "out_key": "f"},
        {("a", "x"): (E, S)},
    ),
    "unicycle motion": (
        lambda **k: UnicycleMotion(0.1, **k),
        {"before_key": ("a", "x"), "analysis_key": "z", "belief_prefix": "b"},
        {("a", "x"): (E, S), "z": (E, S)},
    ),
    "pair observation": (
        lambda **k: PairObservation([50.0, 1.0], **k),
        {
            "in_key": "x",
            "history_key": ("a", "h"),
            "steps_key": "n",
            "observed_key": "ok",
            "out_key": "y",
            "clone_key": "z",
            "out_observed_key": ("p", "ok"),
        },
        {"x": (E, S), ("a", "h"): (E, 2, 2)},
    ),
    "select": (lambda **k: Select([3, 4], **k), {"in_key": "x", "out_key": ("p", "q")}, {"x": (E, S)}),
    "linear observation": (
        lambda **k: LinearObservation(H, **k),
        {"in_key": ("a", "x"), "out_key": "y"},
        {("a", "x"): (E, S)},
    ),
    "learned observation": (
        lambda **k: LearnedObservation(nn.Linear(S, OBS), **k),
        {"in_key": ("a", "x"), "out_key": "y"},
        {("a", "x"): (E, S)},
    ),
    "diagonal noise": (
        lambda **k: DiagonalNoise(OBS, **k),
        {"in_key": ("s", "y"), "out_key": ("s", "r")},
        {("s", "y"): (E, OBS)},
    ),
    "constant noise": (lambda **k: ConstantNoise([0.1, 0.2], **k), {"in_key": "y", "out_key": "r"}, {"y": (OBS,)}),
    "image sensor": (
        lambda **k: ImageSensor(OBS, image_shape=(1, 8, 8), ensemble_size=E, **k),
        {"in_key": ("camera", "rgb"), "out_key": "y", "encoding_key": "code", "observed_key": "ok"},
        {("camera", "rgb"): (1, 8, 8)},
    ),
    "vector sensor": (
        lambda **k: VectorSensor(3, OBS, ensemble_size=E, **k),
        {"in_key": ("arm", "q"), "out_key": "y", "observed_key": "ok"},
        {("arm", "q"): (3,)},
    ),
    "gaussian prior": (
        lambda **k: GaussianPrior(torch.zeros(S), torch.ones(S), ensemble_size=E, **k),
        {"out_keys": [("b", "e"), ("b", "m"), "v"]},
        {},
    ),
    "around state": (
        lambda **k: AroundState(torch.ones(S), ensemble_size=E, **k),
        {"state_key": ("truth", "x"), "out_keys": [("b", "e"), ("b", "m"), "v"]},
        {("truth", "x"): (S,)},
    ),
    "from sensor": (
        lambda **k: FromSensor([3, 4], torch.zeros(S), torch.ones(S), ensemble_size=E, **k),
        {
            "observation_key": ("s", "y"),
            "noise_variance_key": ("s", "r"),
            "observed_key": "ok",
            "out_keys": [("b", "e"), ("b", "m"), "v"],
        },
        {("s", "y"): (E, OBS), ("s", "r"): (OBS,)},
    ),
    "analysis": (
        lambda **k: EnsembleAnalysis("perturbed", **k),
        {
            "forecast_key": "f",
            "predicted_key": ("p", "y"),
            "observation_key": ("s", "y"),
            "noise_variance_key": ("s", "r"),
            "observed_key": "ok",
            "belief_prefix": "b",
            "info_prefix": "i",
        },
        {"f": (E, S), ("p", "y"): (E, OBS), ("s", "y"): (E, OBS), ("s", "r"): (OBS,)},
    ),
    "moment prior": (lambda **k: MomentPrior(torch.zeros(S), EYE, **k), {"belief_prefix": "b"}, {}),
    "linear transition": (
        lambda **k: LinearTransition(2 * EYE, EYE, **k),
        {"belief_prefix": "b", "forecast_prefix": "f"},
        {("b", "mean"): (S,), ("b", "cov"): (S, S)},
    ),
    "kalman analysis": (
        lambda **k: KalmanAnalysis(H, torch.ones(OBS), **k),
        {
            "observation_key": ("r", "y"),
            "observed_key": "ok",
            "forecast_prefix": "f",
            "belief_prefix": "b",
            "info_prefix": "i",
        },
        {("f", "mean"): (S,), ("f", "cov"): (S, S), ("r", "y"): (OBS,)},
    ),
}
every_sub_model = pytest.mark.parametrize("name", CASES)


def make(name, batch=(3,)):
    constructor, keys, shapes = CASES[name]
    module = constructor(**keys)
    td = TensorDict({}, batch)
    for key, shape in shapes.items():
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
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_renamed_and_nested_keys(name, batch):
    module, td = make(name, batch)
    before = td.copy()
    out = module(td)
    assert list(module.in_keys) == list(CASES[name][2])
    assert set(out.keys(True, True)) == {*before.keys(True, True), *module.out_keys}
    assert all(td[key] is before[key] for key in CASES[name][2])
    assert all(out[key].shape[: len(batch)] == batch and out[key].isfinite().all() for key in module.out_keys)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case[2]])
def test_default_and_renamed_keys_compute_the_same(name):
    module, td = make(name)
    kwargs = {"encoding_key": "code"} if "image" in name else {}
    plain = CASES[name][0](**kwargs)
    plain.load_state_dict(module.state_dict())
    renamed = TensorDict({p: td[m] for p, m in zip(plain.in_keys, module.in_keys, strict=True)}, td.batch_size)
    outputs, expected = run(plain, renamed), run(module, td)
    for ours, theirs in zip(plain.out_keys, module.out_keys, strict=True):
        assert outputs[ours].equal(expected[theirs])


@every_sub_model
def test_missing_key_is_named(name):
    module, td = make(name)
    for key in CASES[name][2]:
        with pytest.raises(KeyError) as error:
            module(td.exclude(key))
        assert repr(key) in str(error.value)
        assert type(module).__name__ in str(error.value)
        for other in CASES[name][2]:
            assert other == key or str(other) in str(error.value), "the message lists what is there"


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
    other = CASES[name][0](**CASES[name][1])
    other.load_state_dict(module.state_dict())
    for copy in (other, pickle.loads(pickle.dumps(module)), deepcopy(module)):
        out = run(copy, td, noise)
        assert all(out[key].equal(expected[key]) for key in module.out_keys)


@every_sub_model
def test_train_and_eval_are_the_same(name):
    module, td = make(name)
    outputs = [run(module.train(mode), td) for mode in (True, False)]
    assert all(outputs[0][key].equal(outputs[1][key]) for key in module.out_keys)


@every_sub_model
def test_float64(name):
    module, td = make(name)
    out = run(module.double(), td.to(torch.float64))
    assert all(out[key].dtype != torch.float32 for key in module.out_keys)


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

    def without_reading(self, x):
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
    with pytest.raises(ValueError, match=r"Returns.compute\(\) .*" + keys + got):
        Returns(out)(TensorDict({"x": torch.zeros(2)}))
    with pytest.raises(ValueError, match=r"Returns.without_reading\(\) .*" + keys + got):
        _without_reading(Returns(out), {})
