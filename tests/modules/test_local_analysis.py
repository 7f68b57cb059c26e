"""Oracles: the global transform, the scalar Kalman update, torch's Normal, finite differences."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.gaussian_for_tests import directional_check
from tests.functional.checks import assert_raises
from torch_denkf.functional import neighbours
from torch_denkf.functional.inflation import relax_to_prior_spread
from torch_denkf.functional.localisation import Neighbours, gaspari_cohn, neighbours_of_taper
from torch_denkf.modules import EnsembleAnalysis, LocalEnsembleAnalysis

E, S = 6, 12
PLACES = torch.arange(S, dtype=torch.float64).unsqueeze(-1)
NAMES = ("ensemble", "mean", "var")


def inputs(batch=(3,), observations=S):
    forecast = torch.randn(*batch, E, S)
    return TensorDict(
        {
            "forecast": {"ensemble": forecast, "observation": forecast[..., :observations].clone()},
            "sensor": {"ensemble": torch.randn(*batch, observations), "noise": 0.3 + torch.rand(*batch, observations)},
        },
        batch,
    )


def everywhere(observations=S):
    return Neighbours(torch.arange(observations).expand(S, observations), torch.ones(S, observations))


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("samples", [False, True])
def test_full_neighbourhoods_equal_the_global_transform(float64, batch, samples):
    td = inputs(batch)
    if samples:
        td["sensor", "ensemble"] = td["sensor", "ensemble"].unsqueeze(-2) + torch.randn(*batch, E, S)
    expected = EnsembleAnalysis("etkf", inflation=1.1, relaxation=0.2)(td.clone())
    found = LocalEnsembleAnalysis(everywhere(), inflation=1.1, relaxation=0.2, tile=5)(td.clone())
    for name in NAMES:
        torch.testing.assert_close(found["belief", name], expected["belief", name], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found["info", "innovation"], expected["info", "innovation"])


def test_a_rotation_is_the_same_for_all_components(float64):
    module, td = LocalEnsembleAnalysis(everywhere(), rotate=True), inputs()
    td["noise", "self"] = module.draw_noise([3], members=E, dtype=torch.float64)
    expected = EnsembleAnalysis("etkf", rotate=True)(td.clone())["belief", "ensemble"]
    torch.testing.assert_close(module(td.clone())["belief", "ensemble"], expected, rtol=1e-9, atol=1e-9)
    drawn = [module(td.exclude("noise"))["belief", "ensemble"] for _ in range(2)]
    assert not drawn[0].allclose(drawn[1])
    torch.testing.assert_close(drawn[0].mean(-2), drawn[1].mean(-2))
    assert LocalEnsembleAnalysis(everywhere()).draw_noise([3], members=E) is None
    assert module.draw_noise([3]) is None, "without a number of members"


def test_a_taper_is_as_good_as_places(float64):
    taper = gaspari_cohn((PLACES - PLACES[::2].T).abs(), 1.0)
    td = inputs(observations=S // 2)
    first = LocalEnsembleAnalysis.around(PLACES, PLACES[::2], 1.0, tile=5)(td.clone())
    second = LocalEnsembleAnalysis(taper, tile=7)(td.clone())
    torch.testing.assert_close(first["belief", "ensemble"], second["belief", "ensemble"], rtol=1e-12, atol=1e-12)


def test_an_observation_far_away_changes_nothing(float64):
    """The reach is 3.65: components 0 to 7 do not see the last observation, 8 to 11 do."""
    module, td = LocalEnsembleAnalysis.around(PLACES, PLACES, 1.0), inputs()
    other = td.clone()
    other["sensor", "ensemble"][..., -1] += 5
    first, second = (module(part)["belief", "ensemble"] for part in (td, other))
    assert first[..., :8].equal(second[..., :8])
    assert ((first - second)[..., 8:].abs().amax((0, 1)) > 1e-6).all()


def test_diagnostics_take_each_observation_by_itself(float64):
    module, td = LocalEnsembleAnalysis.around(PLACES, PLACES, 1.0), inputs()
    td["observed"] = torch.rand(3, S) < 0.6
    hidden = ~td["observed"]
    td["sensor", "ensemble"][hidden] = torch.nan
    out = module(td.clone())
    predicted = td["forecast", "observation"]
    normal = torch.distributions.Normal(predicted.mean(-2), (predicted.var(-2) + td["sensor", "noise"]).sqrt())
    reading = torch.where(hidden, 0.0, td["sensor", "ensemble"])
    log_likelihood = normal.log_prob(reading).masked_fill(hidden, 0).sum(-1, keepdim=True)
    nis = ((reading - normal.mean) / normal.stddev).square().masked_fill(hidden, 0).sum(-1, keepdim=True)
    torch.testing.assert_close(out["info", "log_likelihood"], log_likelihood)
    torch.testing.assert_close(out["info", "nis"], nis)
    torch.testing.assert_close(out["info", "innovation"], (reading - normal.mean).masked_fill(hidden, 0))


def test_only_components_near_an_observation_are_inflated_and_rotated(float64):
    """Radius 1: of observations 0 and 1 alone, components from 5 on see nothing; the last row sees nothing at all."""
    td = inputs()
    td["observed"] = torch.zeros(3, S, dtype=torch.bool)
    td["observed"][:2, :2] = True
    td["sensor", "noise"] = td["sensor", "noise"].masked_fill(~td["observed"], torch.nan)
    forecast = td["forecast", "ensemble"]
    plain = LocalEnsembleAnalysis.around(PLACES, PLACES, 1.0, tile=5)(td.clone())["belief", "ensemble"]
    inflated = LocalEnsembleAnalysis.around(PLACES, PLACES, 1.0, tile=5, inflation=1.5)(td.clone())[
        "belief", "ensemble"
    ]
    spread, more = plain.std(-2), inflated.std(-2)
    torch.testing.assert_close(more[:2, :5], 1.5 * spread[:2, :5])
    torch.testing.assert_close(inflated[:2, :, 5:], forecast[:2, :, 5:])
    rotated = LocalEnsembleAnalysis.around(PLACES, PLACES, 1.0, inflation=1.5, rotate=True)(td.clone())
    assert rotated["belief", "ensemble"][2].equal(forecast[2])
    assert not rotated["belief", "ensemble"][0].allclose(forecast[0])
    relaxed = LocalEnsembleAnalysis.around(PLACES, PLACES, 1.0, relaxation=0.7)(td.clone())["belief", "ensemble"]
    torch.testing.assert_close(relaxed[:2], relax_to_prior_spread(plain, forecast, 0.7)[:2])


def test_gradients_equal_finite_differences(float64):
    """By all that is read."""
    module, td = LocalEnsembleAnalysis.around(PLACES, PLACES, 1.0, inflation=1.1), inputs((2,))
    keys = [(prefix, name) for prefix in ("forecast", "sensor") for name in td[prefix].keys()]  # noqa: SIM118
    leaves = [td[key].requires_grad_() for key in keys]
    directional_check(lambda: module(td.copy())["belief", "ensemble"].square().sum(), leaves)


def test_untrained_parameters_raise_by_name(float64):
    """A radius, a taper and the places that it follows from are constants: no gradient step would move them."""
    radius, taper = nn.Parameter(torch.tensor(2.0)), torch.rand(S, S, requires_grad=True)
    with pytest.raises(ValueError, match=r"radius requires a gradient .* Detach it"):
        LocalEnsembleAnalysis.around(PLACES, PLACES, radius)
    with torch.no_grad(), pytest.raises(ValueError, match="radius requires"):
        LocalEnsembleAnalysis.around(PLACES, PLACES, radius)
    for near in (taper, neighbours_of_taper(taper), neighbours(PLACES.clone().requires_grad_(), PLACES, 2.0)):
        assert_raises(ValueError, "near requires a gradient", LocalEnsembleAnalysis, near)
    assert_raises(ValueError, "taper requires a gradient", EnsembleAnalysis, "sakov", taper=(torch.ones(S, S), taper))
    td = inputs()
    found = LocalEnsembleAnalysis.around(PLACES, PLACES, radius.detach())(td.clone())["belief", "ensemble"]
    assert found.equal(LocalEnsembleAnalysis.around(PLACES, PLACES, 2.0)(td.clone())["belief", "ensemble"])
