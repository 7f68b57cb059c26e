"""Updates under a contaminated Gaussian likelihood: against fine grids, finite differences, and the plain update."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch.testing import assert_close

from tests.filters.gaussian_for_tests import directional_check
from tests.imperfect.test_visible import (
    BELIEF,
    KEY,
    MEAN,
    SEVERAL,
    STD,
    VISIBLE,
    R,
    around,
    forecast,
    hidden_in_part,
    several,
)
from torch_denkf.functional.manifolds import SO3, Circle, Euclidean, Product
from torch_denkf.imperfect import Contaminated, Visible
from torch_denkf.imperfect.mixture import mix_moments
from torch_denkf.modules import (
    EKFAnalysis,
    EnsembleAnalysis,
    GaussianLikelihood,
    KalmanAnalysis,
    LinearObservation,
    Select,
    UKFAnalysis,
)
from torch_denkf.modules.particles import ParticleAnalysis
from torch_denkf.smoothers.past import LaggedAnalysis

EYE = torch.eye(1, dtype=torch.float64)
SCORES = ("innovation", "nis", "log_likelihood")


def update_of(inner, *args, **options):
    """Returns the update, for particles with the likelihood in front, in double precision."""
    likelihood = GaussianLikelihood(observation_key=KEY)
    if inner == "particles":
        return TensorDictSequential(likelihood, Contaminated(ParticleAnalysis(likelihood), *args, **options)).double()
    return Contaminated(inner, *args, **options).double()


ONE = {
    "etkf": lambda: EnsembleAnalysis("etkf", observation_key=KEY),
    "perturbed": lambda: EnsembleAnalysis("perturbed", observation_key=KEY),
    "Kalman": lambda: KalmanAnalysis(EYE, None, observation_key=KEY),
    "Kalman with its noise": lambda: KalmanAnalysis(EYE, R**2 * EYE[0], observation_key=KEY),
    "EKF": lambda: EKFAnalysis(Select([0]), observation_key=KEY),
    "UKF": lambda: UKFAnalysis(Select([0]), observation_key=KEY),
    "particles": lambda: "particles",
}


def normal(value, std):
    return torch.exp(-0.5 * (value / std) ** 2) / (std * math.sqrt(2 * math.pi))


def on_line(reading, share, outlier_std, divergence=0.0):
    """Returns mean, variance, log-likelihood and outlier probability of the exact posterior, on a fine grid."""
    x = torch.linspace(MEAN - 30 * STD, MEAN + 30 * STD, 400_001, dtype=torch.float64)
    step = float(x[1] - x[0])
    prior, outlier = normal(x - MEAN, STD), share * normal(reading - x, outlier_std)
    lost = (1 - divergence) * prior + divergence * normal(x - MEAN, 3 * STD)
    joint = lost * (1 - share) * normal(reading - x, R) + prior * outlier
    total = float(joint.sum()) * step
    mean = float((joint * x).sum()) * step / total
    variance = float((joint * (x - mean) ** 2).sum()) * step / total
    return mean, variance, math.log(total), float((prior * outlier).sum()) * step / total


@pytest.mark.parametrize("name", ONE)
@pytest.mark.parametrize(
    ("reading", "share", "wide"),
    [
        (1.0, 0.2, {"width": 8.0}),
        (4.5, 0.2, {"width": 8.0}),
        (3.0, 0.7, {"noise": [2.0]}),
        (-4.0, 0.01, {"width": 3.0}),
    ],
)
def test_one_step_is_that_of_a_fine_grid(name, reading, share, wide):
    """Mean, variance and likelihood are the exact posterior's; particles come close to them."""
    torch.manual_seed(0)
    td = update_of(ONE[name](), share, **wide)(forecast(reading, 1.0, 20_000 if name == "particles" else 40))
    expected = on_line(reading, share, wide["noise"][0] if "noise" in wide else wide["width"] * R)
    # Particles stand at 20,000 quantiles, of which the last lacks its tail; shares are kept as float32 numbers.
    atol = 2e-2 if name == "particles" and reading == -4 else 2e-3 if name == "particles" else 1e-6
    found = [td["belief", "mean"], td["belief", "var"], td["info", "log_likelihood"], td["info", "outlier"]]
    assert [value.item() for value in found] == pytest.approx(expected, abs=atol)


@pytest.mark.parametrize("name", [name for name in ONE if name != "particles"])
@pytest.mark.parametrize(("reading", "divergence"), [(1.0, 0.3), (6.0, 0.05)])
def test_a_forecast_that_has_diverged_is_a_third_part_of_the_mixture(name, reading, divergence):
    torch.manual_seed(0)
    td = update_of(ONE[name](), 0.2, width=8.0, divergence=divergence)(forecast(reading, 1.0, 40))
    found = [td["belief", "mean"], td["belief", "var"], td["info", "log_likelihood"], td["info", "outlier"]]
    expected = on_line(reading, 0.2, 8 * R, divergence)
    assert [value.item() for value in found] == pytest.approx(expected, abs=1e-6)


def test_clones_diverge_with_the_present(float64):
    """The smoother's past and the present, as one state of both."""
    torch.manual_seed(0)
    members, past = torch.randn(12, 2), torch.randn(12, 3, 2)
    analysis = EnsembleAnalysis("etkf", observation_key=KEY)
    td = TensorDict({"forecast": {"ensemble": members, "observation": members[:, :1], "past": past}})
    td[KEY], td["sensor", "noise"] = torch.tensor([4.0]), torch.tensor([0.2])
    whole = td.clone().set(("forecast", "ensemble"), torch.cat([members, past.flatten(1)], -1))
    options = {"share": 0.3, "width": 5.0, "divergence": 0.2}
    apart = Contaminated(analysis, **options).around(LaggedAnalysis(analysis))(td)
    whole = Contaminated(analysis, **options)(whole)
    both = torch.cat([apart["belief", "ensemble"], apart["forecast", "past"].flatten(1)], -1)
    assert_close(both, whole["belief", "ensemble"], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["etkf", "EKF", "UKF", "EKF, correlated"])
def test_two_components_are_those_of_a_fine_grid(name):
    """Two states, of which a reading has the sum and the first: the posterior of a grid, covariances included."""
    torch.manual_seed(3)
    H, y = torch.tensor([[1.0, 1.0], [1.0, 0.0]]).double(), torch.tensor([2.5, -0.7]).double()
    noise = torch.tensor([0.3, 0.2]).double()
    full = torch.tensor([[0.3, 0.15], [0.15, 0.2]]).double() if "correlated" in name else noise.diag()
    members = torch.randn(9, 2).double()
    mean, cov = members.mean(0), members.T.cov()
    keys = {"observation_key": KEY}
    inner = {"e": lambda: EnsembleAnalysis("etkf", **keys), "U": lambda: UKFAnalysis(LinearObservation(H), **keys)}
    inner = inner.get(name[0], lambda: EKFAnalysis(LinearObservation(H), **keys))()
    td = TensorDict({"forecast": {"ensemble": members, "observation": members @ H.T, "mean": mean, "cov": cov}})
    td[KEY], td["sensor", "noise"] = y, full if "correlated" in name else noise
    out = update_of(inner, 0.3, width=6.0)(td.expand(3).clone())[1]

    axes = [torch.linspace(-9, 9, 1201, dtype=torch.float64) * cov[i, i].sqrt() + mean[i] for i in range(2)]
    x = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    cell = float((axes[0][1] - axes[0][0]) * (axes[1][1] - axes[1][0]))

    def density(value, at, cov):
        return torch.distributions.MultivariateNormal(at, cov).log_prob(value).exp()

    prior, outlier = density(x, mean, cov), 0.3 * density(y, x @ H.T, 36 * full)
    joint = prior * (0.7 * density(y, x @ H.T, full) + outlier)
    total = joint.sum() * cell
    weight = (joint * cell / total).unsqueeze(-1)
    center = (weight * x).sum((0, 1))
    spread = torch.einsum("ij,ija,ijb->ab", weight[..., 0], x - center, x - center)
    belief = out["belief"]
    assert_close(belief["mean"], center, rtol=0, atol=1e-6)
    assert_close(belief["ensemble"].T.cov() if name == "etkf" else belief["cov"], spread, rtol=0, atol=1e-6)
    assert out["info", "log_likelihood"].item() == pytest.approx(total.log().item(), abs=1e-6)
    assert out["info", "outlier"].item() == pytest.approx(((prior * outlier).sum() * cell / total).item(), abs=1e-6)


@pytest.mark.parametrize("name", ["etkf", "Kalman", "particles"])
def test_the_expected_nis_is_the_number_of_components(name):
    """Readings at all places, weighted by their density under the model."""
    readings = torch.linspace(-60, 60, 1201, dtype=torch.float64).unsqueeze(-1)
    td = forecast(0.0, 1.0, 2000 if name == "particles" else 10).expand(1201).clone()
    out = update_of(ONE[name](), 0.3, width=6.0)(td.set(KEY, readings))
    density = out["info", "log_likelihood"].exp()
    assert (density * out["info", "nis"]).sum().item() * 0.1 == pytest.approx(
        1, abs=2e-3 if name == "particles" else 1e-6
    )


SPACE = Product(SO3(), Euclidean(2))


def on_space(members=9, batch=(3,), seed=1):
    """Returns an attitude and two numbers; the reading is another attitude and one of the numbers."""
    torch.manual_seed(seed)
    center = SPACE.plus(SPACE.neutral(torch.zeros(1).double()).expand(*batch, 6), torch.randn(*batch, 5).double())
    ensemble = SPACE.plus(center.unsqueeze(-2), 0.3 * torch.randn(*batch, members, 5).double())
    away = SPACE.minus(ensemble, SPACE.mean(ensemble).unsqueeze(-2))
    td = TensorDict({("forecast", "ensemble"): ensemble, ("forecast", "observation"): ensemble[..., :5]}, batch)
    td["forecast", "mean"], td["forecast", "cov"] = SPACE.mean(ensemble), away.mT @ away / (members - 1)
    space = Product(SO3(), Euclidean(1))
    td[KEY] = space.plus(center[..., :5], 0.8 * torch.randn(*batch, 4).double())
    td["sensor", "noise"] = torch.full((*batch, 4), 0.09).double()
    return td, {"space": SPACE, "reading_space": space, "observation_key": KEY}


KINDS_ON_SPACE = {
    "etkf": lambda keys: EnsembleAnalysis("etkf", **keys),
    "EKF": lambda keys: EKFAnalysis(Select(range(5)), **keys),
    "UKF": lambda keys: UKFAnalysis(Select(range(5)), **keys),
}


def tangents(name, td, start, prefix="belief"):
    """Returns the mean and covariance of a belief as tangents at a point."""
    if name == "etkf":
        away = SPACE.minus(td[prefix, "ensemble"], start.unsqueeze(-2))
        return away.mean(-2), (away - away.mean(-2, keepdim=True)).mT @ (away - away.mean(-2, keepdim=True)) / 8
    step = SPACE.minus(td[prefix, "mean"], start)
    back = SPACE.right_jacobian(step).inverse()
    return step, back @ td[prefix, "cov"] @ back.mT


@pytest.mark.parametrize("name", KINDS_ON_SPACE)
def test_on_a_space_the_tangents_at_the_forecast_are_mixed(name, float64):
    td, keys = on_space()
    inner = KINDS_ON_SPACE[name](keys)
    start = SPACE.near(td["forecast", "ensemble"]) if name == "etkf" else td["forecast", "mean"]
    sound, wide = inner(td.clone()), inner(td.clone().set(("sensor", "noise"), 25 * td["sensor", "noise"]))
    out = Contaminated(inner, 0.4, width=5.0)(td.clone())
    q = out["info", "outlier"]
    assert ((q > 1e-3) & (q < 1 - 1e-3)).any()
    odds = 0.4 / 0.6 * (wide["info", "log_likelihood"] - sound["info", "log_likelihood"]).exp()
    assert_close(q, odds / (1 + odds))
    mean, cov = mix_moments(1 - q, *tangents(name, sound, start), *tangents(name, wide, start))
    found = tangents(name, out, start)
    assert_close(found[0], mean, rtol=0, atol=1e-9)
    assert_close(found[1], cov, rtol=0, atol=1e-8)
    if name == "etkf":
        away = SPACE.minus(out["belief", "ensemble"], out["belief", "mean"].unsqueeze(-2))
        assert_close(away.mean(-2), torch.zeros(3, 5), rtol=0, atol=1e-7)
        assert_close(away.var(-2), out["belief", "var"])


@pytest.mark.parametrize("name", KINDS_ON_SPACE)
def test_visible_mixes_tangents_with_the_forecast(name, float64):
    """The sibling: an occluded reading on a space; certain ones are the update, and the forecast."""
    td, keys = on_space()
    inner = KINDS_ON_SPACE[name](keys)
    start = SPACE.near(td["forecast", "ensemble"]) if name == "etkf" else td["forecast", "mean"]
    alone = inner(td.clone())
    td["sensor", "visible"] = torch.tensor([[1.0], [0.0], [0.6]])
    out = Visible(inner)(td.clone())
    q = out["info", "visible"]
    key = "ensemble" if name == "etkf" else "cov"
    assert torch.equal(out["belief", key][0], alone["belief", key][0])
    assert torch.equal(out["belief", key][1], td["forecast", key][1])
    mean, cov = mix_moments(q, *tangents(name, alone, start), *tangents(name, td, start, "forecast"))
    found = tangents(name, out, start)
    assert_close(found[0], mean, rtol=0, atol=1e-9)
    assert_close(found[1], cov, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", [*SEVERAL, "particles"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_shares_of_zero_and_of_one(name, dtype):
    """No outliers are the plain update bit for bit; nothing but wide outliers is the forecast."""
    inner = "particles" if name == "particles" else SEVERAL[name]().to(dtype)
    td = several(samples=name == "sensor", dtype=dtype)
    plain = around(name).to(dtype)
    alone = plain(td.clone())
    none = update_of(inner, 0.0).to(dtype)(td.clone())
    for key in [("belief", name) for name in BELIEF] + [("info", name) for name in SCORES]:
        if alone.get(key, None) is not None:
            assert torch.equal(none[key], alone[key]), key
    assert (none["info", "outlier"] == 0).all()
    if name == "sensor" or "inflated" in name:  # samples spread, and inflation acts, whatever the noise is
        return
    hidden = plain(td.clone().set("observed", torch.zeros(3, 1, dtype=torch.bool)))
    all_of_them = update_of(inner, 1.0, width=1e4).to(dtype)(td.clone())
    tolerance = 1e-5 if dtype == torch.float32 else 1e-6
    for key in [("belief", name) for name in BELIEF]:
        if hidden.get(key, None) is not None:
            assert_close(all_of_them[key], hidden[key], rtol=0, atol=tolerance)
    assert (all_of_them["info", "outlier"] == 1).all()


@pytest.mark.parametrize("noise", [torch.tensor([0.5]), None])
def test_a_kalman_analysis_keeps_its_inflation(noise):
    """Oracle: the analysis alone, of which a share of 0 is nothing else."""
    plain = KalmanAnalysis(torch.eye(1), noise, inflation=1.5)
    values = {"forecast": {"mean": torch.zeros(1), "cov": torch.eye(1)}, "observation": torch.ones(1)}
    td = TensorDict({**values, "sensor": {"noise": torch.tensor([0.5])}})
    assert_close(Contaminated(plain, 0.0)(td.copy())["belief", "cov"], plain(td.copy())["belief", "cov"])


@pytest.mark.parametrize("name", [*SEVERAL, "particles"])
def test_masks_are_heeded(name):
    """Nothing observed is the forecast bit for bit; one component is a reading of one; NaN spoils no gradient."""
    inner = "particles" if name == "particles" else SEVERAL[name]()
    update = update_of(inner, "share", noise=[2.0, 1.5])
    td = hidden_in_part(name)
    td["sensor", "noise"] = torch.where(td["observed"], td["sensor", "noise"], torch.nan)
    share = torch.tensor([[0.4], [torch.nan], [0.3]], dtype=torch.float64, requires_grad=True)
    out = update(td.clone().set("share", share))
    key = "mean" if name in ("Kalman", "UKF") else "log_weight" if name == "particles" else "ensemble"
    assert_close(out["belief", key][1], td["forecast", key][1], rtol=0, atol=1e-14)
    for score in ("nis", "log_likelihood", "outlier"):
        assert out["info", score][1].item() == 0
    assert update_of(inner, 0.3)(td.clone())["info", "outlier"][1].item() == 0
    loss = out["belief", "mean"].sum() + out["info", "log_likelihood"].sum() + out["info", "nis"].sum()
    (gradient,) = torch.autograd.grad(loss, share)
    assert gradient.isfinite().all()
    assert gradient[1].item() == 0
    assert (gradient[[0, 2]] != 0).all()
    number = update_of(inner, 0.4, noise=[2.0, 1.5])(td.clone())["info"]
    assert [number[score][1].item() for score in ("nis", "log_likelihood", "outlier")] == [0, 0, 0]
    # The second component may be anything where it is hidden.
    again = td[2].clone().set("share", share[2].detach())
    again[KEY][..., 1], again["sensor", "noise"][1] = 3.0, 1.0
    other = update(again)
    for key in (("belief", "mean"), ("info", "log_likelihood"), ("info", "outlier")):
        assert_close(other[key], out[key][2])


@pytest.mark.parametrize("name", ONE)
@pytest.mark.parametrize("reading", [1.0, 2.5])
def test_gradients_are_those_of_finite_differences(name, reading):
    """Checks the gradients of belief and scores by logit of the share and logarithm of width or noise."""
    torch.manual_seed(0)
    perturbation = torch.randn(40, 1, dtype=torch.float64)
    for wide in ({"width": 4.0}, {"noise": [1.7]}):
        update = update_of(ONE[name](), 0.3, trainable=True, **wide)
        parameters = list(update.parameters())
        assert len(parameters) == 2

        def value(update=update):
            td = forecast(reading, 1.0, 40)
            td = update(td.set(("noise", "self"), perturbation) if name == "perturbed" else td)
            scores = td["info", "nis"].sum() + td["info", "log_likelihood"].sum() + td["info", "outlier"].sum()
            return td["belief", "mean"].sum() + 2 * td["belief", "var"].sum() + scores

        directional_check(value, parameters, rtol=1e-5)


def sum_of(keys, out_key):
    """Returns a module that writes a share from entries: the sigmoid of their sum."""
    return TensorDictModule(lambda *values: torch.cat(values, -1).sum(-1, keepdim=True).sigmoid(), keys, [out_key])


@pytest.mark.parametrize("name", [*SEVERAL, "particles"])
def test_share_and_width_come_from_entries_and_from_heads(name):
    """A head reads the plain update's innovation and an entry of the frame: the same as what it writes, as entries."""
    inner = "particles" if name == "particles" else SEVERAL[name]()
    td = several(samples=name == "sensor").set("light", torch.tensor([[0.1], [-1.0], [0.5]]).double())
    innovation = around(name)(td.clone())["info", "innovation"]
    share = (innovation.sum(-1, keepdim=True) + td["light"]).sigmoid()
    width = TensorDictModule(lambda light: 3 + light.exp(), ["light"], ["width"])
    heads = update_of(inner, sum_of([("info", "innovation"), "light"], "share"), width=width)
    update = heads[-1] if name == "particles" else heads
    assert "light" in update.in_keys
    assert ("info", "innovation") not in update.in_keys
    by_head = heads(td.clone())
    by_entry = update_of(inner, "share", width=("a", "width"))(
        td.clone().set("share", share).set(("a", "width"), 3 + td["light"].exp())
    )
    for key in (("belief", "mean"), ("belief", "var"), ("info", "log_likelihood"), ("info", "outlier")):
        assert_close(by_head[key], by_entry[key])
    for row in range(3):
        number = update_of(inner, share[row].item(), width=(3 + td["light"].exp())[row].item())
        assert_close(number(td[row].clone())["belief", "mean"], by_entry["belief", "mean"][row], rtol=0, atol=1e-6)


def test_invalid_arguments_raise():
    inner = EnsembleAnalysis("etkf")
    with pytest.raises(ValueError, match="share"):
        Contaminated(inner, share=0.0, trainable=True)
    with pytest.raises(ValueError, match="divergence is for"):
        update_of("particles", divergence=0.1)
    with pytest.raises(TypeError, match="share must be a TensorDict module"):
        Contaminated(inner, nn.Linear(1, 1))
    with pytest.raises(KeyError, match="share"):
        Contaminated(SEVERAL["etkf"](), "share")(several())
    for name, shape in (("share", [3]), ("share", [3, 2]), ("width", [3]), ("noise", [3, 2, 2])):
        with pytest.raises(ValueError, match=rf"{name} '{name}' must be \[\*B, "):
            Contaminated(SEVERAL["etkf"](), **{name: name})(several().set(name, torch.ones(shape)))


@pytest.mark.parametrize("name", ["etkf", "Kalman", "particles"])
def test_head_is_trained_by_observed_readings(name):
    """Its frame may be NaN behind the mask: the gradient is that of the other rows."""
    inner = "particles" if name == "particles" else SEVERAL[name]()
    td = several(samples=False).set("light", torch.tensor([[0.1], [torch.nan], [0.5]]).double())
    td["observed"] = torch.tensor([[True], [False], [True]])
    for keys in (["light"], ["light", ("info", "innovation")]):
        layer = nn.Linear(1 if len(keys) == 1 else 3, 1).double()
        head = TensorDictModule(lambda *read, f=layer: f(torch.cat(read, -1)).sigmoid(), keys, ["share"])
        losses = (update_of(inner, head)(each.clone())["info", "log_likelihood"].sum() for each in (td, td[[0, 2]]))
        found, expected = (torch.autograd.grad(loss, list(layer.parameters())) for loss in losses)
        assert_close(found, expected)


#: An update around another, by the share that it writes.
AROUND = {"visible": Visible, "outlier": lambda inner: Contaminated(inner, 0.4, width=10.0, trainable=True)}
BOTH = pytest.mark.parametrize("share", AROUND)


@BOTH
@pytest.mark.parametrize("name", ["etkf", "Kalman", "UKF", "particles"])
def test_gradients_are_finite_far_out(name, share):
    """Readings of NIS up to 1e6, in single precision, past the forecast and at it."""
    update = around(name, AROUND[share]).float()
    td = several(dtype=torch.float32)
    td[KEY] = td["forecast", "mean"][:, :2] + torch.tensor([[0.0, 0.0], [20.0, 0.0], [1300.0, 0.0]])
    leaves = [td["forecast", "ensemble"].requires_grad_()] if name in ("etkf", "particles") else []
    leaves += [td[VISIBLE].requires_grad_()] if share == "visible" else [*update.parameters()]
    out = update(td)
    assert out["info", "nis"].max() > (5e5 if share == "visible" else 5e4)
    loss = out["belief", "mean"].square().sum() + out["belief", "var"].sum() - out["info", "log_likelihood"].sum()
    for gradient in torch.autograd.grad(loss + out["info", "nis"].sum(), leaves):
        assert gradient.isfinite().all()
        assert (gradient != 0).any()


@BOTH
@pytest.mark.parametrize("name", ["etkf", "UKF", "particles"])
def test_a_turn_more_is_the_same_reading(name, share):
    keys = {"observation_key": KEY, "reading_space": Circle() * Euclidean(1)}
    likelihood = GaussianLikelihood(**keys)
    inner = {
        "etkf": lambda: EnsembleAnalysis("etkf", **keys),
        "UKF": lambda: UKFAnalysis(Select([0, 1]), **keys),
        "particles": lambda: ParticleAnalysis(likelihood),
    }[name]()
    update = TensorDictSequential(*([likelihood] if name == "particles" else []), AROUND[share](inner))
    td = several()
    turned = td.clone()
    turned[KEY][..., 0] += 2 * math.pi
    out, other = update(td), update(turned)
    for key in (("belief", "mean"), ("belief", "var"), ("info", share), ("info", "log_likelihood")):
        assert_close(out[key], other[key])


@pytest.mark.parametrize("share", [0.1, 0.2, 0.3, 0.4])
def test_particles_of_a_missing_observation_keep_their_weights_bit_for_bit(share):
    td = several().float().set("observed", torch.zeros(3, 1, dtype=torch.bool))
    contaminated = around("particles", lambda inner: Contaminated(inner, share)).float()
    expected = around("particles").float()(td.clone())["belief", "log_weight"]
    assert contaminated(td.clone())["belief", "log_weight"].equal(expected)
