"""Rotating all angles by pi rotates the belief by pi and changes nothing else, for every module with angles.

Headings near zero never wrap. Rotated by pi, readings and predictions lie on both sides of the cut at +-pi.
"""

import ast
import importlib
import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import nn

import torch_denkf
from tests.filters.factories import FixedEnsemble, NoisyLinear
from torch_denkf.baselines import BackpropKF, IEnKS
from torch_denkf.filters import EKF, UKF, DEnKF, KalmanFilter, ParticleFilter
from torch_denkf.functional.localisation import Neighbours
from torch_denkf.functional.manifolds import Circle, Euclidean, Flat, Opposite
from torch_denkf.fusion import FusedFilter, FusedSensor, SensorAttention
from torch_denkf.imperfect import Contaminated, FadingBias, Visible
from torch_denkf.modules import (
    ConstantNoise,
    EKFTransition,
    EnsembleAnalysis,
    LearnedLikelihood,
    LinearTransition,
    LocalEnsembleAnalysis,
    MomentPrior,
    Select,
    SubModel,
    UKFTransition,
)
from torch_denkf.monitoring import Gated, GatedAnalysis
from torch_denkf.objectives import DEnKFLoss, GaussianLoss, MixtureLoss, ObservationLoss, SensorLoss, TransitionLoss
from torch_denkf.smoothers import FixedLag

B, T, E = 3, 14, 12
PLANE = Flat(2, circular=[0])
MOVE = torch.tensor([[1.0, 0.1], [0.0, 0.9]], dtype=torch.float64)
Q, R = torch.tensor([0.05, 0.1], dtype=torch.float64), torch.tensor([0.3, 0.4], dtype=torch.float64)  # standard dev.
NEAR = Neighbours(torch.arange(2).expand(2, 2), torch.tensor([[1.0, 0.5], [0.5, 1.0]], dtype=torch.float64))


pytestmark = pytest.mark.usefixtures("float64")


def folded(value):
    """Wraps the first component to [-pi, pi]."""
    return torch.cat([torch.atan2(value[..., :1].sin(), value[..., :1].cos()), value[..., 1:]], -1)


class Heading(SubModel):
    """Measurement model h of a compass: both components of the state, or the heading alone."""

    def __init__(self, count=2):
        super().__init__(nn.Identity(), [("forecast", "ensemble")], [("forecast", "observation")])
        self.count = count

    def observe(self, state):
        return folded(state)[..., : self.count]

    def compute(self, ensemble):
        return self.observe(ensemble)


class Sensor(SubModel):
    """Passes an entry on as the sensor's ensemble."""

    def __init__(self, key):
        super().__init__(nn.Identity(), [key], [("sensor", "ensemble")])

    def compute(self, reading):
        return reading


def ahead(turn):
    return torch.tensor([turn, 0.0])


def members(turn):
    generator = torch.Generator().manual_seed(1)
    return FixedEnsemble(torch.tensor([0.4, 0.5]) * torch.randn(E, 2, generator=generator) + ahead(turn))


def moments(turn):
    return MomentPrior(ahead(turn), torch.diag(torch.tensor([0.16, 0.25])))


def frames(turn):
    """Returns readings, samples of a sensor, and labels; the true state jumps, so that gates act."""
    generator = torch.Generator().manual_seed(2)
    state = ahead(turn) + 0.1 * torch.randn(B, T, 2, generator=generator).cumsum(1)
    state[:, 7:] += torch.tensor([1.2, 3.0])
    reading = state + R * torch.randn(B, T, 2, generator=generator)
    samples = reading.unsqueeze(-2) + R * torch.randn(B, T, E, 2, generator=generator)
    data = TensorDict({"observation": folded(reading), "samples": folded(samples), "state": folded(state)}, [B, T])
    data["target_observation"] = folded(state + 0.1)
    data["compass"], data["other"] = data["samples"][..., :1], reading[..., 1:]
    data["encoding"] = torch.randn(B, T, 3, generator=generator)
    data["observed"] = torch.rand(B, T, 2, generator=generator) < 0.8
    data["visible"] = torch.linspace(0, 1, B * T).reshape(B, T, 1)
    for name, component in (("compass", slice(0, 1)), ("other", slice(1, 2))):
        data[f"{name}_observed"] = data["observed"][..., component]
    return data


def noise():
    return ConstantNoise(R, in_key=("sensor", "ensemble"))


def denkf(analysis, turn, reads="observation"):
    parts = {"transition": NoisyLinear(MOVE, Q.diag()), "sensor": Sensor(reads), "observation": Heading()}
    return DEnKF(**parts, noise=noise(), analysis=analysis, initial=members(turn))


def ensemble(scheme="etkf", reads="observation", **options):
    return lambda turn: denkf(EnsembleAnalysis(scheme, reading_space=PLANE, **options), turn, reads)


def local(**options):
    return lambda turn: denkf(LocalEnsembleAnalysis(NEAR, reading_space=PLANE, **options), turn, "samples")


def kalman(turn):
    both = torch.eye(2)
    prior = {"mean": ahead(turn), "cov": 0.2 * both}
    return KalmanFilter(MOVE, both, process_noise=Q, noise=R, **prior, reading_space=PLANE)


def gaussian(kind, **more):
    def make(turn):
        options = {"initial": moments(turn), "reading_space": PLANE, **more}
        if kind is BackpropKF:
            return BackpropKF(
                MOVE, Sensor("samples"), torch.eye(2), noise(), process_noise_cov=Q.square().diag(), **options
            )
        walk = ConstantNoise(Q, in_key=("belief", "mean"), out_key=("forecast", "noise"))
        return kind(NoisyLinear(MOVE), Sensor("samples"), Heading(), noise(), process_noise=walk, **options)

    return make


def particles(likelihood=None):
    def make(turn):
        options = {"reading_space": PLANE} if likelihood is None else {"likelihood": likelihood()}
        parts = NoisyLinear(MOVE, Q.diag()), Sensor("observation"), Heading()
        return ParticleFilter(*parts, noise=noise(), initial=members(turn), **options)

    return make


def iterated(turn):
    parts = NoisyLinear(MOVE), Sensor("observation"), Heading(), noise()
    return IEnKS(*parts, initial=members(turn), process_noise=Q, reading_space=PLANE)


def learned_likelihood():
    torch.manual_seed(3)
    keys = {"encoding_key": "encoding", "observation_key": ("sensor", "ensemble")}
    return LearnedLikelihood(3, 2, num_cells=(8,), reading_space=PLANE, scale=[0.3, 0.4], **keys)


def fused(motion, *, delay=0, weights=False, joint=False, analysis=None):
    """Returns a maker of filters with a compass that draws samples, and another sensor."""

    def make(turn):
        sensors = {
            "compass": FusedSensor(Heading(1), R[:1], sensor=Sensor("compass"), reading_space=Circle(), delay=delay),
            "other": FusedSensor(Select([1]), R[1:]),
        }
        torch.manual_seed(4)
        attention = SensorAttention({"compass": 1, "other": 1}, size=4, slope=2.0) if weights else None
        for parameter in () if attention is None else attention.parameters():
            parameter.data.add_(0.3 * torch.randn_like(parameter))
        walk = ConstantNoise(Q, in_key=("belief", "mean"), out_key=("forecast", "noise"))
        transition = {
            "ensemble": lambda: NoisyLinear(MOVE, Q.diag()),
            "Kalman": lambda: LinearTransition(MOVE, Q.square().diag()),
            "EKF": lambda: EKFTransition(NoisyLinear(MOVE), walk),
            "UKF": lambda: UKFTransition(NoisyLinear(MOVE), walk),
        }[motion]()
        initial = members(turn) if motion == "ensemble" else moments(turn)
        options = {"weights": attention, "joint": joint, "analysis": analysis}
        return FusedFilter(transition, sensors, initial=initial, **options)

    return make


def with_visibility(make):
    """Adds the probability of occlusion to a filter's update."""

    def made(turn):
        filter = make(turn)
        return filter.with_modules(analysis=Visible(filter["analysis"], visible_key="visible"))

    return made


def contaminated(make):
    """Adds a share of outliers to a filter's noise model."""

    def made(turn):
        filter = make(turn)
        divergence = 0.0 if isinstance(filter, ParticleFilter) else 0.1
        return filter.with_modules(analysis=Contaminated(filter["analysis"], 0.3, width=3.0, divergence=divergence))

    return made


def gated(make, **options):
    return lambda turn: Gated(make(turn), **options)


GATES = {
    "student": {"response": "student", "window": 2, "rate": 0.2},
    "reject, opens": {"response": "reject", "window": 1, "rate": 0.1, "patience": 2},
    "adapted spread": {"rate": 0.0, "adapt_inflation": 0.1},
    "adapted noise": {"rate": 0.2, "adapt_noise": 0.1},
}
OF_ENSEMBLES = {"one": {}, "by component": {"by_component": True}}

FILTERS = {
    **{f"ensemble, {scheme}": ensemble(scheme, "samples") for scheme in ("sensor", "perturbed", "etkf", "sakov")},
    "ensemble, inflated": ensemble(inflation=1.1, relaxation=0.3),
    "ensemble, rotated": ensemble(rotate=True),
    "ensemble with a lag": lambda turn: FixedLag(ensemble()(turn), 3),
    "local": local(inflation=1.1),
    "local with a lag": lambda turn: FixedLag(local()(turn), 3),
    "Kalman": kalman,
    **{kind.__name__: gaussian(kind) for kind in (EKF, UKF, BackpropKF)},
    "EKF with coloured noise": lambda turn: gaussian(EKF, sensor_error=FadingBias([0.1, 0.1], 5.0))(turn),
    "IEnKS": iterated,
    "particles": particles(),
    "particles, learned": particles(learned_likelihood),
    **{
        f"{name} with {model}": around(make)
        for model, around in {"visibility": with_visibility, "outliers": contaminated}.items()
        for name, make in {
            "ensemble": ensemble(),
            "ensemble of samples": ensemble("sensor", "samples"),
            "Kalman": kalman,
            "UKF": gaussian(UKF),
            "particles": particles(),
        }.items()
    },
    **{
        f"fused {motion}, {name}": fused(motion, **options)
        for motion in ("ensemble", "Kalman", "UKF")
        for name, options in {
            "in turn": {},
            "joint": {"joint": True},
            "late": {"delay": 2},
            "weights": {"weights": True},
            "weights, late": {"weights": True, "delay": 2},
        }.items()
    },
    **{
        f"gated {name}, {gate}, {parts}": gated(make, **options, **by)
        for name, make in {"ensemble": ensemble(), "samples": ensemble(reads="samples"), "local": local()}.items()
        for gate, options in GATES.items()
        for parts, by in OF_ENSEMBLES.items()
    },
    **{
        f"gated {name}, {gate}": gated(make, **options)
        for name, make in {
            "Kalman": kalman,
            "EKF": gaussian(EKF),
            "UKF": gaussian(UKF),
            "with a lag": lambda turn: FixedLag(ensemble()(turn), 3),
            "fused ensemble": fused("ensemble"),
            "fused Kalman": fused("Kalman"),
        }.items()
        for gate, options in GATES.items()
    },
    **{
        f"gated late {motion}, {gate}": gated(fused(motion, delay=2), **GATES[gate])
        for motion in ("ensemble", "Kalman")
        for gate in ("student", "reject, opens", "adapted noise")
    },
}


def turned_back(key, value, turn):
    """Returns an entry of the rotated run, rotated back."""
    angle = {"mean", "ensemble", "past", "joint_mean", "past_mean"}
    if isinstance(key, tuple) and key[0] in ("belief", "smoothed") and key[-1] in angle:
        value = value.clone()
        value[..., 0 :: 2 if key[-1] == "joint_mean" else value.shape[-1]] -= turn
    return value


def written(filter, turn):
    torch.manual_seed(5)
    out = filter.sequence(frames(turn))
    return {
        key: turned_back(key, out[key], turn) for key in filter.out_keys if key[0] in ("belief", "smoothed", "info")
    }


@pytest.mark.parametrize("name", FILTERS)
def test_beliefs_rotate_with_their_angles(name):
    here, there = (written(FILTERS[name](turn), turn) for turn in (0.0, math.pi))
    data = frames(math.pi)["observation"][..., 0]
    assert data.min() < -3
    assert data.max() > 3
    assert here["belief", "mean"].isfinite().all()
    for key, value in here.items():  # gains and variance factors accumulate rounding over the steps
        torch.testing.assert_close(there[key], value, rtol=1e-8, atol=1e-8, msg=lambda m, k=key: f"{k}: {m}")


@pytest.mark.parametrize("parts", OF_ENSEMBLES)
def test_gate_does_not_wrap_members_spread_over_more_than_a_turn(parts):
    """The oracle is an analysis without angles, as headings near zero never wrap."""
    forecast = torch.tensor([0.4, 0.5]) * torch.randn(B, E, 2)
    entries = (
        {"ensemble": forecast, "observation": forecast},
        {"ensemble": torch.randn(B, 2), "noise": torch.ones(B, 2)},
    )
    entries[1]["ensemble"][:, 1] += 20.0  # a large innovation, at which the gate opens after `patience` rejections
    out = []
    for space in (PLANE, None):
        options = {"response": "reject", "window": 1, "adapt_inflation": 0.1, **OF_ENSEMBLES[parts]}
        gate = GatedAnalysis(EnsembleAnalysis("etkf", reading_space=space), 2, **options)
        td = TensorDict(dict(zip(("forecast", "sensor"), entries, strict=True)), [B])
        td.update(dict(zip(gate.state_keys, gate.initial_state([B]), strict=True)))
        td["gate", "shut"] += gate.patience
        td["gate", "log_inflation"] += math.log(9.0)
        out.append(gate(td))
        assert (td["gate", "factor"] == 1).all()
    assert (3 * forecast[..., 0]).abs().max() > math.pi, "the adapted spread alone"
    for key in gate.out_keys:
        torch.testing.assert_close(out[0][key], out[1][key], rtol=1e-11, atol=1e-11, msg=lambda m, k=key: f"{k}: {m}")


STATE = {"space": PLANE}
BOTH = {**STATE, "reading_space": PLANE}

SAMPLED = ensemble("sensor", "samples")  # a filter whose sensor draws samples

LOSSES = {
    **{f"DEnKFLoss, {score}": (DEnKFLoss, SAMPLED, {**BOTH, "score": score}) for score in ("crps", "energy", "mse")},
    "DEnKFLoss, nll": (DEnKFLoss, SAMPLED, {**BOTH, "nll": 1.0, "observation": 1.0}),
    **{f"GaussianLoss, {score}": (GaussianLoss, gaussian(EKF), {**BOTH, "score": score}) for score in ("crps", "nll")},
    "GaussianLoss, dims": (GaussianLoss, gaussian(UKF), {**BOTH, "dims": [1, 0]}),
    **{f"MixtureLoss, {score}": (MixtureLoss, particles(), {**STATE, "score": score}) for score in ("mixture", "crps")},
    "DEnKFLoss, product": (DEnKFLoss, SAMPLED, {"space": Circle() * Euclidean(1), "reading_space": PLANE}),
    "MixtureLoss, Opposite": (MixtureLoss, particles(), {"space": Opposite(PLANE)}),
    "TransitionLoss, spread": (TransitionLoss, SAMPLED, {"space": PLANE, "spread": [0.1, 0.1]}),
    "TransitionLoss": (TransitionLoss, SAMPLED, STATE),
    "TransitionLoss of moments": (TransitionLoss, gaussian(EKF), STATE),
    "SensorLoss": (SensorLoss, SAMPLED, {"reading_space": PLANE}),
    "ObservationLoss": (ObservationLoss, SAMPLED, {"reading_space": PLANE}),
}


@pytest.mark.parametrize("name", LOSSES)
def test_losses_are_invariant_to_rotation(name):
    kind, make, options = LOSSES[name]
    values = []
    for turn in (0.0, math.pi):
        torch.manual_seed(6)
        values.append(kind(make(turn), **options)(frames(turn)))
    assert values[0].keys()
    for key, value in values[0].items():
        torch.testing.assert_close(values[1][key], value, rtol=1e-9, atol=1e-9, msg=lambda m, k=key: f"{k}: {m}")


def modules_with_spaces():
    """Returns the classes of modules that take the space of a reading, or change entries that an analysis aligned."""
    found, root = set(), Path(torch_denkf.__file__).parent
    for file in sorted(root.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ClassDef) and any(map(_names_a_space, ast.walk(node))):
                place = ".".join(["torch_denkf", *file.relative_to(root).with_suffix("").parts])
                found.add(getattr(importlib.import_module(place), node.name))
    # Measurement models of motions declare their space, and rejection handles each reading separately.
    others = ("torch_denkf.motions.", "torch_denkf.imperfect.rejection")
    return {kind for kind in found if issubclass(kind, nn.Module) and not kind.__module__.startswith(others)}


def _names_a_space(node):
    words = {getattr(node, name, None) for name in ("arg", "attr", "id")}
    return bool(words & {"reading_space", "spaces", "aligned"})


def test_every_module_with_angles_is_tested():
    made = [make(0.0) for make in FILTERS.values()] + [
        kind(make(0.0), **options) for kind, make, options in LOSSES.values()
    ]
    turned = {kind for each in made for part in each.modules() for kind in type(part).__mro__}
    found = modules_with_spaces()
    assert {EnsembleAnalysis, LearnedLikelihood} < found
    assert not found - turned, "add them to FILTERS or LOSSES"
