"""Likelihoods of particles. Oracles: torch.distributions, networks by hand."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Normal

from torch_denkf.modules import GaussianLikelihood, LearnedLikelihood

pytestmark = pytest.mark.usefixtures("float64")

E, OBS, F = 7, 2, 5
BATCHES = [(), (4,), (2, 3)]


def reading(batch=(), members=None):
    shape = (*batch, OBS) if members is None else (*batch, members, OBS)
    return TensorDict(
        {
            "forecast": {"observation": torch.randn(*batch, E, OBS)},
            "sensor": {
                "ensemble": torch.randn(shape),
                "noise": 0.1 + torch.rand(*batch, OBS),
                "encoding": torch.randn(*batch, F),
            },
        },
        batch,
    )


@pytest.mark.parametrize("members", [None, 3])
@pytest.mark.parametrize("batch", BATCHES)
def test_gaussian_likelihood_is_the_normal_density(batch, members):
    td = reading(batch, members)
    y = td["sensor", "ensemble"] if members is None else td["sensor", "ensemble"].mean(-2)
    normal = Normal(td["forecast", "observation"], td["sensor", "noise"].sqrt().unsqueeze(-2))
    expected = normal.log_prob(y.unsqueeze(-2)).sum(-1)
    torch.testing.assert_close(GaussianLikelihood()(td)["forecast", "log_likelihood"], expected)


def test_gaussian_likelihood_of_observed_components():
    td = reading((4,))
    observed = torch.tensor([[True, True], [True, False], [False, True], [False, False]])
    normal = Normal(td["forecast", "observation"], td["sensor", "noise"].sqrt().unsqueeze(-2))
    each = normal.log_prob(td["sensor", "ensemble"].unsqueeze(-2))
    for key in (("sensor", "ensemble"), ("sensor", "noise")):
        td[key] = torch.where(observed, td[key], torch.nan)
    out = GaussianLikelihood()(td.set("observed", observed))["forecast", "log_likelihood"]
    expected = torch.stack([each[0].sum(-1), each[1, :, 0], each[2, :, 1], torch.zeros(E)])
    torch.testing.assert_close(out, expected)
    assert (out[3] == 0).all()
    one = GaussianLikelihood()(td.set("observed", torch.tensor([[True], [False], [False], [False]])))
    torch.testing.assert_close(one["forecast", "log_likelihood"][0], each[0].sum(-1))
    assert (one["forecast", "log_likelihood"][1:] == 0).all()


@pytest.mark.parametrize("bound", ["scaled", "clipped"])
@pytest.mark.parametrize("batch", BATCHES)
def test_learned_likelihood_by_hand(batch, bound):
    loc, scale = torch.tensor([1.0, -2.0]), torch.tensor([0.5, 3.0])
    model = LearnedLikelihood(F, OBS, num_cells=(8,), bound=bound, loc=loc, scale=scale)
    td = reading(batch)
    out = model(td)["forecast", "log_likelihood"]
    assert out.shape == (*batch, E)
    assert out.std() > 1e-3, "the particles differ"
    predicted = (td["forecast", "observation"] - loc) / scale
    for i in range(E):
        value = model.module(torch.cat([td["sensor", "encoding"], predicted[..., i, :]], -1))[..., 0]
        likelihood = 1 / (1 + (-value).exp())
        expected = (0.004 + 0.996 * likelihood).log() if bound == "scaled" else likelihood.log()
        torch.testing.assert_close(out[..., i], expected)


@pytest.mark.parametrize(("bound", "lowest"), [("scaled", math.log(0.004)), ("clipped", -20.0)])
def test_learned_likelihood_is_bounded(bound, lowest):
    model = LearnedLikelihood(F, OBS, bound=bound, network=torch.nn.Linear(F + OBS, 1))
    td = reading((500,)).set(("sensor", "encoding"), 1e3 * torch.randn(500, F))
    out = model(td)["forecast", "log_likelihood"]
    torch.testing.assert_close(out.min(), torch.tensor(lowest))
    assert out.max() <= 0
    out.sum().backward()
    assert model.module.weight.grad.isfinite().all()


def test_learned_likelihood_of_observed_components():
    model = LearnedLikelihood(F, OBS, num_cells=(8,), loc=[1.0, -2.0])
    observed = torch.tensor([[True, True], [True, False], [False, False]])
    td = reading((3,)).set("observed", observed)
    plain = model(td.copy())["forecast", "log_likelihood"]
    td["sensor", "encoding"][2] = torch.nan
    other = td.clone()
    other["forecast", "observation"][1, :, 1] += 5.0
    out, out_of_other = (model(part)["forecast", "log_likelihood"] for part in (td, other))
    assert out[0].equal(plain[0])
    assert out[1].equal(out_of_other[1]), "what is not observed does not count"
    assert (out[2] == 0).all()
    at_mean = td[1].exclude("observed")
    at_mean["forecast", "observation"][:, 1] = -2.0
    torch.testing.assert_close(out[1], model(at_mean)["forecast", "log_likelihood"])


def test_learned_likelihood_sees_the_innovation():
    """By hand: the encoding, and the compressed innovation of the mean reading; nothing where not observed."""
    scale = torch.tensor([0.5, 3.0])
    model = LearnedLikelihood(F, OBS, num_cells=(8,), scale=scale, observation_key=("sensor", "ensemble"))
    td = reading((4,), members=3)
    innovation = (td["sensor", "ensemble"].mean(-2, keepdim=True) - td["forecast", "observation"]) / scale
    features = td["sensor", "encoding"].unsqueeze(-2).expand(-1, E, -1)
    value = model.module(torch.cat([features, innovation.sign() * (1 + innovation.abs()).log()], -1))[..., 0]
    expected = (0.004 + 0.996 * value.sigmoid()).log()
    torch.testing.assert_close(model(td.copy())["forecast", "log_likelihood"], expected)
    td["observed"] = torch.tensor([[True], [False], [True], [True]])
    td["sensor", "ensemble"][1] = torch.nan
    out = model(td)["forecast", "log_likelihood"]
    torch.testing.assert_close(out[[0, 2, 3]], expected[[0, 2, 3]])
    assert (out[1] == 0).all()


SEES_READING = LearnedLikelihood(F, OBS, num_cells=(4,), observation_key=("sensor", "ensemble"))


@pytest.mark.parametrize(
    "model", [GaussianLikelihood(), LearnedLikelihood(F, OBS, num_cells=(4,)).double(), SEES_READING.double()]
)
def test_masked_nan_has_finite_gradients(model):
    td = reading((4,)).set("observed", torch.tensor([[True], [False], [True], [False]]))
    hidden = ~td["observed"]
    leaves = []
    for key in (("sensor", "ensemble"), ("sensor", "noise"), ("sensor", "encoding")):
        leaves.append(torch.where(hidden, torch.nan, td[key]).requires_grad_())
        td[key] = leaves[-1]
    leaves.append(td["forecast", "observation"].requires_grad_())
    model(td)["forecast", "log_likelihood"].sum().backward()
    grads = [leaf.grad for leaf in (*leaves, *model.parameters()) if leaf.grad is not None]
    assert len(grads) >= 2
    assert all(grad.isfinite().all() for grad in grads)
    assert (leaves[-1].grad[[0, 2]] != 0).any()
    assert (leaves[-1].grad[[1, 3]] == 0).all()
