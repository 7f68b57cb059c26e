"""Oracles: Bayes' rule by hand, the functional resampling schemes, statistics of large samples."""

import math

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.functional import soft_resample, systematic_resample, transport_resample
from torch_denkf.functional.manifolds import Circle, Euclidean
from torch_denkf.functional.weighted import weighted_mean, weighted_var
from torch_denkf.modules import (
    ConstantNoise,
    DiagonalNoise,
    GaussianLikelihood,
    GaussianPrior,
    LearnedTransition,
    MappedNoise,
    NoisyTransition,
)
from torch_denkf.modules.particles import ParticleAnalysis, ResampledTransition, with_weights
from torch_denkf.submodel import SubModel

pytestmark = pytest.mark.usefixtures("float64")

E, S, OBS = 7, 3, 2
BATCHES = [(), (4,), (2, 3)]


def shift():
    """Returns a transition that adds one, deterministically."""
    return LearnedTransition(torch.ones_like)


def belief(batch=(), size=E):
    entries = {"ensemble": torch.randn(*batch, size, S), "log_weight": torch.randn(*batch, size).log_softmax(-1)}
    return TensorDict({"belief": TensorDict(entries, batch)}, batch)


# ------------------------------------------------------------------------------------------- initial weights


@pytest.mark.parametrize("batch", BATCHES)
def test_initial_weights_are_equal(batch):
    start = with_weights(GaussianPrior(torch.zeros(S), torch.ones(S), ensemble_size=E))
    out = start(TensorDict({}, batch))
    assert (out["belief", "log_weight"] == torch.full((*batch, E), -math.log(E))).all()
    particles, weights = out["belief", "ensemble"], out["belief", "log_weight"]
    torch.testing.assert_close(out["belief", "mean"], weighted_mean(particles, weights))
    torch.testing.assert_close(out["belief", "var"], weighted_var(particles, weights))
    assert (start.ensemble_size, start.state_dim) == (E, S)


# ------------------------------------------------------------------------------------------------ motion noise


def statistics(transition, rows=4000):
    """Returns the mean and covariance over the members of what one state becomes, and that state."""
    state = torch.randn(S)
    td = TensorDict({("belief", "ensemble"): state.expand(rows, S)})
    out = transition(td)["forecast", "ensemble"]
    return state, out.mean(0), out.T.cov()


@pytest.mark.parametrize("before", [False, True])
@pytest.mark.parametrize("kind", ["variances", "covariance", "singular"])
@pytest.mark.parametrize("dims", [None, [2, 0]])
def test_motion_noise_in_all_or_some_dimensions_has_its_covariance(before, kind, dims):
    rows, size = 4000, S if dims is None else len(dims)
    root = torch.randn(size, size)
    keys = {"in_key": ("belief", "mean"), "out_key": ("forecast", "q")}
    if kind == "variances":
        root = root.diagonal().abs().diag()
        model = ConstantNoise(root.diagonal(), **keys)
    else:
        root = root[:, : size - (kind == "singular")]
        model = MappedNoise(ConstantNoise(torch.ones(root.shape[1]), **keys), root)
    matrix = torch.nn.Linear(S, S)
    noisy = NoisyTransition(LearnedTransition(matrix, residual=False), model, dims, before=before)
    state, mean, cov = statistics(noisy, rows)
    # As a linear map of independent standard-normal numbers.
    enters = torch.eye(S) if dims is None else torch.eye(S)[:, dims]
    root = matrix.weight @ enters @ root if before else enters @ root
    expected = root @ root.mT
    sd = expected.diagonal().sqrt()
    assert ((mean - matrix(state)).abs() <= 4 * sd / rows**0.5 + 1e-12).all()
    error = ((sd.outer(sd).square() + expected.square()) / rows).sqrt()
    assert ((cov - expected).abs() <= 4 * error + 1e-12).all()
    # Where Q is singular nothing moves, up to the root of the ridge of 1e-14.
    values, vectors = torch.linalg.eigh(expected)
    still = vectors[:, values < 1e-12 * values[-1]]
    assert still.shape[1] == S - root.shape[1]
    assert ((still.mT @ cov @ still).diagonal() <= 1e-12 * values[-1]).all()


def test_motion_noise_is_drawn_in_bulk_where_its_size_is_known():
    q = ConstantNoise([1.0] * S, in_key=("belief", "mean"), out_key=("forecast", "q"))
    every, some = NoisyTransition(shift(), q), NoisyTransition(shift(), q, [1])
    assert every.draw_noise([4, 2], members=E, state_dim=S).shape == (4, 2, E, S)
    assert some.draw_noise([4, 2], members=E).shape == (4, 2, E, 1)
    assert every.draw_noise([4, 2], members=E) is None
    assert some.draw_noise([4, 2], state_dim=S) is None
    td = belief((4,)).set(("noise", "self"), torch.randn(4, E, S))
    torch.testing.assert_close(every(td)["forecast", "ensemble"], td["belief", "ensemble"] + 1 + td["noise", "self"])


@pytest.mark.parametrize("before", [False, True])
def test_standard_deviations_are_noise_of_those_under_any_keys(before):
    motion = LearnedTransition(torch.ones_like, in_key=("prior", "x"), out_key=("moved", "x"))
    noisy = NoisyTransition(motion, [0.5, 0.0], [2, 0], before=before, mean_key=("prior", "mean"), draws="random")
    td = TensorDict({("prior", "x"): torch.randn(4, E, S), ("noise", "self"): torch.randn(4, E, 2)}, [4])
    expected = td["prior", "x"] + 1
    expected[..., 2] += 0.5 * td["noise", "self"][..., 0]
    torch.testing.assert_close(noisy(td.copy())["moved", "x"], expected)
    with pytest.raises(ValueError, match="noise is one number, and the number of dimensions is not known"):
        NoisyTransition(motion, 0.5)


@pytest.mark.parametrize("weights", [False, True])
@pytest.mark.parametrize(("name", "space"), [("belief", None), ("forecast", None), ("belief", Euclidean(S))])
def test_noise_model_reads_the_weighted_mean(weights, name, space):
    model = DiagonalNoise(1, in_features=S, num_cells=(4,), in_key=(name, "mean"), out_key=("forecast", "q"))
    torch.nn.init.normal_(model.module.layers[-1].weight)
    noisy = NoisyTransition(shift(), model, [1], draws="random", space=space)
    assert noisy.in_keys == [("belief", "ensemble")]
    td = belief((4,)) if weights else belief((4,)).exclude(("belief", "log_weight"))
    td["belief", "mean"] = torch.full((4, S), torch.nan)  # whatever it was before
    td["noise", "self"] = torch.ones(4, E, 1)
    out = noisy(td.copy())
    x = td["belief", "ensemble"]
    mean = weighted_mean(x, td["belief", "log_weight"]) if weights else x.mean(-2)
    variance = model(TensorDict({(name, "mean"): mean + (name == "forecast")}, [4]))["forecast", "q"]
    expected = x + 1
    expected[..., 1] += variance.sqrt()
    torch.testing.assert_close(out["forecast", "ensemble"], expected)
    assert out["belief", "mean"].isnan().all(), "the tensordict's own mean is left as it is"
    out["forecast", "ensemble"].sum().backward()
    assert model.module.layers[0].weight.grad.abs().sum() > 0


def test_noise_model_inputs():
    class Lit(SubModel):
        def __init__(self):
            super().__init__(torch.nn.Identity(), [("belief", "mean")], [("forecast", "q")], optional_keys=["light"])

        def compute(self, mean, light=None):
            return torch.ones_like(mean) if light is None else light.square()

    td = belief((4,)).exclude(("belief", "log_weight")).set("light", torch.rand(4, S))
    td["noise", "self"] = torch.ones(4, E, S)
    out = NoisyTransition(shift(), Lit(), draws="random")(td.copy())["forecast", "ensemble"]
    torch.testing.assert_close(out, td["belief", "ensemble"] + 1 + td["light"].unsqueeze(-2))


# -------------------------------------------------------------------------------------------------- resampling


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("scheme", ["systematic", "soft", "transport", None])
def test_resampling_before_the_motion(scheme, batch):
    td = belief(batch).set(("noise", "self"), torch.rand(*batch, 1))
    particles, log_weights = td["belief", "ensemble"], td["belief", "log_weight"]
    expected, weights = {
        "systematic": lambda u: systematic_resample(particles, log_weights, u),
        "soft": lambda u: soft_resample(particles, log_weights, u, 0.3),
        "transport": lambda u: transport_resample(particles, log_weights, epsilon=0.2, iterations=7),
        None: lambda u: (particles, log_weights),
    }[scheme](td["noise", "self"])
    module = ResampledTransition(shift(), scheme, alpha=0.3, epsilon=0.2, iterations=7)
    out = module(td.copy())
    assert out["forecast", "ensemble"].equal(expected + 1)
    assert out["forecast", "log_weight"].equal(weights)
    assert out["belief", "ensemble"].equal(particles), "the belief is left as it is"
    assert out["belief", "log_weight"].equal(log_weights)
    assert module.in_keys[:2] == [("belief", "ensemble"), ("belief", "log_weight")]
    assert module.out_keys == [("forecast", "ensemble"), ("forecast", "log_weight")]


@pytest.mark.parametrize("width", [1, OBS])
def test_no_resampling_in_front_of_a_missing_frame(width):
    td = belief((4,)).set("observed", torch.tensor([[True], [False], [True], [False]]).expand(4, width).clone())
    if width > 1:
        td["observed"][0, 0] = False  # something is observed
    out = ResampledTransition(shift())(td.copy())
    for row, seen in enumerate([True, False, True, False]):
        assert (out["forecast", "log_weight"][row].equal(td["belief", "log_weight"][row])) != seen
        assert (out["forecast", "ensemble"][row].equal(td["belief", "ensemble"][row] + 1)) != seen


def test_a_mask_does_not_overrule_the_threshold():
    few, many = torch.full((E,), 1e-3), torch.full((E,), 1e-3)
    few[:2], many[:5] = 1.0, 1.0  # of 7 particles 2 and 5 are effective
    td = belief((4,))
    td["belief", "log_weight"] = torch.stack([few, many, few, many]).log().log_softmax(-1)
    td["observed"] = torch.tensor([[True], [True], [False], [False]])
    out = ResampledTransition(shift(), ess_threshold=0.5)(td.copy())
    assert (out["forecast", "log_weight"][0] == -math.log(E)).all(), "observed, and few are effective"
    assert out["forecast", "log_weight"][1:].equal(td["belief", "log_weight"][1:])
    assert out["forecast", "ensemble"][1:].equal(td["belief", "ensemble"][1:] + 1)


# ----------------------------------------------------------------------------------------------------- update


@pytest.mark.parametrize("batch", BATCHES)
def test_analysis_is_bayes_rule(batch):
    td = TensorDict({"forecast": belief(batch)["belief"]}, batch)
    td["forecast", "log_likelihood"] = torch.randn(*batch, E)
    out = ParticleAnalysis()(td)
    joint = td["forecast", "log_weight"].exp() * td["forecast", "log_likelihood"].exp()
    weights = joint / joint.sum(-1, keepdim=True)
    particles = td["forecast", "ensemble"]
    mean = (weights.unsqueeze(-1) * particles).sum(-2)
    var = (weights.unsqueeze(-1) * (particles - mean.unsqueeze(-2)).square()).sum(-2) * E / (E - 1)
    assert out["belief", "ensemble"].equal(particles)
    torch.testing.assert_close(out["belief", "log_weight"], weights.log())
    torch.testing.assert_close(out["belief", "mean"], mean)
    torch.testing.assert_close(out["belief", "var"], var)
    torch.testing.assert_close(out["info", "ess"], 1 / weights.square().sum(-1, keepdim=True))
    torch.testing.assert_close(out["info", "log_likelihood"], joint.sum(-1, keepdim=True).log())


def test_analysis_of_unlikely_readings_does_not_underflow():
    td = TensorDict({"forecast": belief((2,))["belief"]}, [2])
    td["forecast", "log_likelihood"] = torch.randn(2, E) - 1e5
    out = ParticleAnalysis()(td)
    expected = (td["forecast", "log_weight"] + td["forecast", "log_likelihood"] + 1e5).log_softmax(-1)
    torch.testing.assert_close(out["belief", "log_weight"], expected, rtol=0, atol=1e-9)  # 1e5 costs five digits


def test_analysis_without_an_observation_keeps_the_weights():
    td = TensorDict({"forecast": belief((200,))["belief"]}, [200])
    td["forecast", "log_likelihood"] = torch.zeros(200, E)
    td["forecast", "log_likelihood"][0] = 1.0
    out = ParticleAnalysis()(td)
    assert out["belief", "log_weight"][1:].equal(td["forecast", "log_weight"][1:])
    assert (out["info", "log_likelihood"][1:] == 0).all()
    torch.testing.assert_close(out["info", "log_likelihood"][0], torch.ones(1))


def test_a_tempered_likelihood_is_that_of_more_noise(float64):
    # N(y; h, R)^(1/4) is proportional to N(y; h, 4R).
    particles, predicted = torch.randn(3, 50, 2), torch.randn(3, 50, 2)
    td = TensorDict({"forecast": {"ensemble": particles, "observation": predicted}, "y": torch.randn(3, 2)}, [3])
    td["forecast", "log_weight"] = torch.randn(3, 50).log_softmax(-1)
    weights = []
    for variance, tempering in ((0.5, 0.25), (2.0, 1.0)):
        td["sensor", "noise"] = torch.full((3, 2), variance)
        out = ParticleAnalysis(tempering=tempering)(GaussianLikelihood(observation_key="y")(td.copy()))
        weights.append(out["belief", "log_weight"])
    torch.testing.assert_close(*weights, rtol=0, atol=1e-12)


def test_the_innovation_of_angles_is_the_shorter_way_round():
    likelihood = GaussianLikelihood(reading_space=Circle(), observation_key="y")
    predicted, weights = torch.tensor([[3.0], [-3.0]]), torch.tensor([0.25, 0.75]).log()
    forecast = {"ensemble": predicted, "observation": predicted, "log_weight": weights}
    td = TensorDict({"forecast": forecast, "y": torch.tensor([-2.5]), "sensor": {"noise": torch.tensor([0.01])}})
    out = ParticleAnalysis(likelihood)(likelihood(td))
    gap = 2 * math.pi - 6  # between the two predictions
    innovation = 0.5 + 0.25 * gap
    variance = 2 * 0.25 * 0.75 * gap**2 + 0.01
    torch.testing.assert_close(out["info", "innovation"], torch.tensor([innovation]))
    torch.testing.assert_close(out["info", "nis"], torch.tensor([innovation**2 / variance]))
