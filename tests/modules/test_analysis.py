"""Oracle: the functions of torch_denkf.functional, which have their own tests."""

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.functional import analyse
from torch_denkf.functional.inflation import inflate, random_rotation, relax_to_prior_spread
from torch_denkf.modules import EnsembleAnalysis

SCHEMES = ["sensor", "perturbed", "etkf", "sakov"]
E, S, OBS = 6, 4, 2


def inputs(batch=(3,)):
    return TensorDict(
        {
            "forecast": {"ensemble": torch.randn(*batch, E, S), "observation": torch.randn(*batch, E, OBS)},
            "sensor": {"ensemble": torch.randn(*batch, E, OBS), "noise": torch.rand(*batch, OBS) + 0.1},
        },
        batch,
    )


def expected(td, scheme, **kwargs):
    return analyse(
        td["forecast", "ensemble"],
        td["forecast", "observation"],
        td["sensor", "ensemble"],
        td["sensor", "noise"],
        scheme=scheme,
        observed=td.get("observed", None),
        **kwargs,
    )


def assert_belief(td, ensemble):
    assert td["belief", "ensemble"].equal(ensemble)
    torch.testing.assert_close(td["belief", "mean"], ensemble.mean(-2), rtol=0, atol=1e-13)
    torch.testing.assert_close(td["belief", "var"], ensemble.var(-2), rtol=0, atol=1e-13)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("masked", [False, True])
def test_equals_the_function(float64, scheme, batch, masked):
    td = inputs(batch)
    if masked:
        td["observed"] = torch.rand(*batch, OBS) < 0.6
    noise = torch.randn(*batch, E, OBS) if scheme == "perturbed" else None
    if noise is not None:
        td["noise", "self"] = noise
    result = expected(td, scheme, perturbation=noise)
    out = EnsembleAnalysis(scheme, draws="random")(td)
    assert_belief(out, result.ensemble)
    for name in ("innovation", "nis", "log_likelihood"):
        assert out["info", name].equal(getattr(result, name))


def test_relaxation_then_inflation(float64):
    td = inputs()
    out = EnsembleAnalysis("etkf", inflation=1.2, relaxation=0.3)(td)
    relaxed = relax_to_prior_spread(expected(td, "etkf").ensemble, td["forecast", "ensemble"], 0.3)
    assert_belief(out, inflate(relaxed, 1.2))


def test_rotation_given_and_drawn(float64):
    module, td = EnsembleAnalysis("etkf", rotate=True), inputs()
    rotation = random_rotation(E, (3,))
    given = module(td.copy().set(("noise", "self"), rotation))
    assert_belief(given, expected(td, "etkf", rotation=rotation).ensemble)
    drawn, again = (module(td.copy())["belief", "ensemble"] for _ in range(2))
    plain = expected(td, "etkf").ensemble
    assert not drawn.equal(again)
    # A rotation moves members, but neither mean nor covariance.
    torch.testing.assert_close(drawn.mean(-2), plain.mean(-2))
    covs = [torch.einsum("bes,bet->bst", a, a) for a in (x - x.mean(-2, keepdim=True) for x in (drawn, plain))]
    torch.testing.assert_close(*covs)
    assert not drawn.allclose(plain)


def test_inflation_multiplies_the_given_components(float64):
    td = inputs()
    plain = EnsembleAnalysis("sensor")(td.clone())["belief"]
    some = EnsembleAnalysis("sensor", inflation=1.5, inflated=[1, 2])(td.clone())["belief"]
    torch.testing.assert_close(some["mean"], plain["mean"])
    factors = torch.tensor([1.0, 1.5, 1.5, 1.0])
    torch.testing.assert_close(some["var"], plain["var"] * factors**2)
    anomalies = [belief["ensemble"] - belief["mean"].unsqueeze(-2) for belief in (some, plain)]
    torch.testing.assert_close(anomalies[0], anomalies[1] * factors)


def test_inflation_leaves_an_ensemble_without_observation_as_it_is(float64):
    td = inputs((2,)).set("observed", torch.tensor([[True], [False]]))
    plain = EnsembleAnalysis("sensor")(td.clone())["belief", "ensemble"]
    inflated = EnsembleAnalysis("sensor", inflation=1.5)(td.clone())["belief", "ensemble"]
    torch.testing.assert_close(inflated[0], inflate(plain[0], 1.5))
    assert inflated[1].equal(td["forecast", "ensemble"][1])
