"""Updates that use whether a sensor sees: against a fine grid, closed forms, and the analysis alone."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch.testing import assert_close

from torch_denkf.functional.localisation import Neighbours
from torch_denkf.imperfect import Visibility, Visible
from torch_denkf.modules import (
    EKFAnalysis,
    EnsembleAnalysis,
    GaussianLikelihood,
    KalmanAnalysis,
    LocalEnsembleAnalysis,
    Select,
    UKFAnalysis,
)
from torch_denkf.modules.particles import ParticleAnalysis

KEY = "reading"
VISIBLE = ("sensor", "visible")


def particles(**options):
    likelihood = GaussianLikelihood(observation_key=KEY)
    return TensorDictSequential(likelihood, Visible(ParticleAnalysis(likelihood), **options))


ANALYSES = {
    "etkf": lambda **options: Visible(EnsembleAnalysis("etkf", observation_key=KEY), **options),
    "perturbed": lambda **options: Visible(EnsembleAnalysis("perturbed", observation_key=KEY), **options),
    "Kalman": lambda **options: Visible(
        KalmanAnalysis(torch.eye(1, dtype=torch.float64), None, observation_key=KEY), **options
    ),
    "EKF": lambda **options: Visible(EKFAnalysis(Select([0]), observation_key=KEY), **options),
    "UKF": lambda **options: Visible(UKFAnalysis(Select([0]), observation_key=KEY), **options),
    "particles": particles,
}
MEAN, STD, R = 0.3, 1.2, 0.5  # of a forecast in one dimension, standard deviations


def forecast(reading, p, members=400, dtype=torch.float64):
    """Returns one dimension: members at the quantiles of the forecast, with exactly its mean and variance."""
    levels = (torch.arange(members, dtype=dtype) + 0.5) / members
    standard = torch.special.ndtri(levels)
    ensemble = (MEAN + STD * standard / standard.std()).unsqueeze(-1)
    entries = {"ensemble": ensemble, "observation": ensemble, "log_weight": torch.full((members,), -math.log(members))}
    entries |= {"mean": ensemble.mean(-2), "cov": torch.tensor([[STD**2]], dtype=dtype)}
    td = TensorDict({"forecast": {key: value.to(dtype) for key, value in entries.items()}})
    td[KEY], td["sensor", "noise"] = torch.tensor([reading], dtype=dtype), torch.tensor([R**2], dtype=dtype)
    return td.set(VISIBLE, torch.as_tensor([p], dtype=dtype))


def grid(reading, p, broad):
    """Returns mean, variance, log-likelihood and visibility of the exact posterior, on a fine grid."""
    x = torch.linspace(MEAN - 12 * STD, MEAN + 12 * STD, 200_001, dtype=torch.float64)
    step = float(x[1] - x[0])

    def normal(value, std):
        return torch.exp(-0.5 * (value / std) ** 2) / (std * math.sqrt(2 * math.pi))

    prior = normal(x - MEAN, STD)
    far = torch.tensor(reading - MEAN, dtype=torch.float64)
    seen, other = p * normal(reading - x, R), (1 - p) * normal(far, broad * math.hypot(STD, R))
    joint = prior * (seen + other)
    total = float(joint.sum()) * step
    mean = float((joint * x).sum()) * step / total
    variance = float((joint * (x - mean) ** 2).sum()) * step / total
    return mean, variance, math.log(total), float((prior * seen).sum()) * step / total


@pytest.mark.parametrize("name", ANALYSES)
@pytest.mark.parametrize(("reading", "p"), [(1.0, 0.8), (4.5, 0.8), (4.0, 0.3), (-9.0, 0.99)])
def test_one_step_is_that_of_a_fine_grid(name, reading, p):
    """The mixture's mean and variance; particles come close to it, and stochastic members to theirs."""
    torch.manual_seed(0)
    members = {"particles": 20_000, "perturbed": 40_000}.get(name, 40)
    td = ANALYSES[name](broad=8.0)(forecast(reading, p, members))
    mean, variance, log_likelihood, share = grid(reading, p, 8.0)
    # Particles stand at 20,000 quantiles, of which the last lacks its tail; perturbed members have errors at random.
    atol = {"particles": 2e-3, "perturbed": 0.03}.get(name, 1e-8)
    assert td["belief", "mean"].item() == pytest.approx(mean, abs=atol)
    assert td["belief", "var"].item() == pytest.approx(variance, abs=3 * atol)
    assert td["info", "log_likelihood"].item() == pytest.approx(log_likelihood, abs=max(atol, 1e-6))
    assert td["info", "visible"].item() == pytest.approx(share, abs=max(atol, 1e-6))


@pytest.mark.parametrize("name", ANALYSES)
def test_the_gradient_by_p_is_that_of_finite_differences(name):
    analysis = ANALYSES[name]()
    perturbation = torch.randn(40, 1, dtype=torch.float64)

    def value(p):
        td = forecast(3.5, 0.5, 40).set(VISIBLE, p)
        td = analysis(td.set(("noise", "self"), perturbation) if name == "perturbed" else td)
        return td["belief", "mean"].sum() + 2 * td["belief", "var"].sum() + td["info", "log_likelihood"].sum()

    assert torch.autograd.gradcheck(value, torch.tensor([0.6], dtype=torch.float64, requires_grad=True))


NEAR = Neighbours(torch.arange(2).expand(3, 2), torch.tensor([[1.0, 0.5], [0.5, 1.0], [0.2, 0.2]]).double())


def several(members=12, batch=(3,), dtype=torch.float64, seed=1, samples=False):
    """Returns a forecast of three components, two of which are read."""
    torch.manual_seed(seed)
    ensemble = torch.randn(*batch, members, 3, dtype=dtype)
    td = TensorDict({("forecast", "ensemble"): ensemble}, batch)
    td["forecast", "observation"] = ensemble[..., :2]
    anomalies = ensemble - ensemble.mean(-2, keepdim=True)
    td["forecast", "mean"], td["forecast", "cov"] = ensemble.mean(-2), anomalies.mT @ anomalies / (members - 1)
    td["forecast", "log_weight"] = torch.randn(*batch, members, dtype=dtype).log_softmax(-1)
    td[KEY] = torch.randn(*batch, *([members] if samples else []), 2, dtype=dtype) + 1
    td["sensor", "noise"] = torch.full((*batch, 2), 0.3, dtype=dtype)
    td[VISIBLE] = torch.linspace(0.1, 0.9, td.numel(), dtype=dtype).reshape(*batch, 1)
    return td


BELIEF = ("ensemble", "mean", "cov", "var", "log_weight")
SCORES = ("innovation", "nis", "log_likelihood")
SEVERAL = {
    "etkf": lambda: EnsembleAnalysis("etkf", observation_key=KEY, covariance=True),
    "sakov, inflated": lambda: EnsembleAnalysis("sakov", observation_key=KEY, inflation=1.1, relaxation=0.2),
    "sensor": lambda: EnsembleAnalysis("sensor", observation_key=KEY),
    "significance": lambda: EnsembleAnalysis("etkf", observation_key=KEY, localisation="significance", threshold=1.0),
    "local": lambda: LocalEnsembleAnalysis(NEAR, observation_key=KEY),
    "Kalman": lambda: KalmanAnalysis(torch.eye(2, 3, dtype=torch.float64), None, observation_key=KEY),
    "UKF": lambda: UKFAnalysis(Select([0, 1]), observation_key=KEY),
}


def around(name, wrap=lambda inner: inner):
    """Returns the update of that name in a wrapper; that of particles behind its likelihood."""
    if name != "particles":
        return TensorDictSequential(wrap(SEVERAL[name]()))
    likelihood = GaussianLikelihood(observation_key=KEY)
    return TensorDictSequential(likelihood, wrap(ParticleAnalysis(likelihood)))


def hidden_in_part(name):
    """Returns a row that is observed, one that is not, and one of which the first component alone is."""
    td = several(samples=name == "sensor")
    td["observed"] = torch.tensor([[True, True], [False, False], [True, False]])
    shown = td["observed"].unsqueeze(-2) if name == "sensor" else td["observed"]
    return td.set(KEY, torch.where(shown, td[KEY], torch.nan))


def moments(td, prefix):
    if td.get((prefix, "cov"), None) is not None and td.get((prefix, "ensemble"), None) is None:
        return td[prefix, "mean"], td[prefix, "cov"]
    ensemble = td[prefix, "ensemble"]
    anomalies = ensemble - ensemble.mean(-2, keepdim=True)
    return ensemble.mean(-2), anomalies.mT @ anomalies / (ensemble.shape[-2] - 1)


@pytest.mark.parametrize("name", [name for name in SEVERAL if name != "local"])
def test_moments_of_the_belief_are_those_of_the_mixture(name):
    analysis = SEVERAL[name]()
    td = several(samples=name == "sensor")
    before = {"forecast": moments(td.exclude(("forecast", "cov"), ("forecast", "mean")), "forecast")}["forecast"]
    alone, mixed = analysis(td.clone()), Visible(analysis)(td.clone())
    q = mixed["info", "visible"]
    assert (q > 0).all()
    assert (q < 1).all()
    (mean, cov), (other_mean, other_cov) = moments(alone, "belief"), before
    apart, share = (mean - other_mean).unsqueeze(-1), q.unsqueeze(-1)
    ours = moments(mixed, "belief")
    assert_close(ours[0], q * mean + (1 - q) * other_mean, rtol=0, atol=1e-10)
    expected = share * cov + (1 - share) * other_cov + share * (1 - share) * apart @ apart.mT
    assert_close(ours[1], expected, rtol=0, atol=1e-9)
    assert_close(mixed["belief", "mean"], ours[0])
    assert_close(mixed["belief", "var"], ours[1].diagonal(dim1=-2, dim2=-1))
    if ("belief", "cov") in mixed.keys(True, True):
        assert_close(mixed["belief", "cov"], ours[1])
    for score in ("innovation", "nis"):
        assert torch.equal(mixed["info", score], alone["info", score])


def test_particles_are_the_exact_mixture_of_weights():
    td = several()
    alone, mixed = around("particles")(td.clone()), around("particles", Visible)(td.clone())
    q = mixed["info", "visible"]
    weight = q * alone["belief", "log_weight"].exp() + (1 - q) * td["forecast", "log_weight"].exp()
    assert_close(mixed["belief", "log_weight"].exp(), weight)
    assert torch.equal(mixed["belief", "ensemble"], td["forecast", "ensemble"])
    assert_close(mixed["info", "nis"], alone["info", "nis"])


@pytest.mark.parametrize("name", [*SEVERAL, "particles"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_p_of_one_and_of_zero(name, dtype):
    td = several(samples=name == "sensor", dtype=dtype)
    alone = around(name).to(dtype)(td.clone())
    tolerance = 2e-5 if dtype == torch.float32 else 1e-11
    for p, prefix, expected in ((1.0, "belief", alone), (0.0, "forecast", td)):
        sees = torch.full((3, 1), p, dtype=dtype)
        out = around(name, Visible).to(dtype)(td.clone().set(VISIBLE, sees))
        for key in BELIEF:
            wanted = expected.get((prefix, key), None)
            unknown = wanted is None or out.get(("belief", key), None) is None
            # The forecast's mean is not the one of these weights.
            if not unknown and (p == 1 or key != "mean" or name != "particles"):
                assert_close(out["belief", key], wanted, rtol=0, atol=tolerance)
        assert (out["info", "visible"] == p).all()
        if p == 1:
            assert_close(out["info", "log_likelihood"], alone["info", "log_likelihood"], rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", [*SEVERAL, "particles"])
def test_masks_are_heeded(name):
    """Keeps the forecast bit for bit where nothing is observed, whatever p; NaN spoils neither value nor gradient."""
    td, plain = hidden_in_part(name), around(name)
    p = torch.tensor([[0.4], [torch.nan], [0.7]], dtype=torch.float64, requires_grad=True)
    out = around(name, Visible)(td.clone().set(VISIBLE, p))
    key = "mean" if name in ("Kalman", "UKF") else "log_weight" if name == "particles" else "ensemble"
    assert torch.equal(out["belief", key][1], plain(td.clone())["belief", key][1])
    assert_close(out["belief", key][1], td["forecast", key][1])
    assert out["info", "log_likelihood"][1].item() == 0
    assert out["info", "visible"][1].item() == 0
    (gradient,) = torch.autograd.grad(out["belief", "mean"].sum() + out["info", "log_likelihood"].sum(), p)
    assert gradient.isfinite().all()
    assert gradient[1].item() == 0
    assert (gradient[[0, 2]] != 0).all()
    # The density of one component alone: as many as are observed count.
    one = several(samples=name == "sensor")[2]
    one["observed"] = torch.tensor([True, False])
    nis, own = out["info", "nis"][2], plain(one)["info", "log_likelihood"]
    if name != "particles":
        other = own + 0.5 * nis * (1 - 0.01) - math.log(10)
        assert_close(out["info", "log_likelihood"][2], torch.logaddexp(own + math.log(0.7), other + math.log(0.3)))


def test_head_outputs_its_initial_value():
    head = Visibility(4, start=0.7, floor=0.01)
    encoding = torch.randn(5, 4)
    assert_close(
        head(TensorDict({("sensor", "encoding"): encoding}, [5]))["sensor", "visible"], torch.full((5, 1), 0.7)
    )
    samples = torch.randn(5, 6, 4)
    head.module.layers[-1].weight.data.normal_(std=100.0)
    p = head(TensorDict({("sensor", "encoding"): samples}, [5]))["sensor", "visible"]
    assert_close(p, head(TensorDict({("sensor", "encoding"): samples.mean(1)}, [5]))["sensor", "visible"])
    assert p.min() >= 0.01 - 1e-6
    assert p.max() <= 0.99 + 1e-6
    for wrong in ({"floor": 0.5}, {"floor": 0.0}, {"start": 1.0}):
        with pytest.raises(ValueError, match=r"floor|start"):
            Visibility(4, **wrong)


def test_missing_visibility_raises():
    with pytest.raises(KeyError, match="visible"):
        Visible(EnsembleAnalysis("etkf"))(
            several(samples=True).exclude(VISIBLE).rename_key_(KEY, ("sensor", "ensemble"))
        )
