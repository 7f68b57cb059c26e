"""Kinds of belief: which one names tell, what follows from what is carried, what finite means; oracle: by hand."""

import pytest
import torch

from torch_denkf.beliefs import Belief, Ensemble, Moments, Particles, complete, kinds_of, summary_keys
from torch_denkf.functional.manifolds import Circle

PREFIX = ("belief",)


def entries(**values):
    return {(*PREFIX, name): value for name, value in values.items()}


def names(*last):
    return [(*PREFIX, name) for name in last]


def completed(given, wanted, **options):
    kinds = kinds_of([*given, *wanted], carry=given)
    return complete(given, wanted, kinds, **options)


@pytest.mark.parametrize(
    ("carried", "kind"),
    [
        (("mean", "cov"), Moments),
        (("ensemble",), Ensemble),
        (("ensemble", "log_weight"), Particles),
        (("mean",), Belief),
        (("count",), Belief),
    ],
)
def test_kind_of_belief_from_carried_names(carried, kind):
    keys = names("ensemble", "mean", "cov", "var", "log_weight")
    (found,) = kinds_of([*keys, *names(*carried)], carry=names(*carried))
    assert type(found) is kind
    assert found.prefix == PREFIX


def test_each_prefix_has_a_kind_of_its_own():
    keys = [("robot", "ensemble"), ("robot", "mean"), ("gps", "mean"), ("gps", "cov"), "age"]
    found = kinds_of(keys, carry=keys)
    assert [(kind.prefix, type(kind)) for kind in found] == [(("robot",), Ensemble), (("gps",), Moments)]
    assert found[1].carry == [("gps", "mean"), ("gps", "cov")]


def test_a_new_kind_is_one_class(monkeypatch, float64):
    monkeypatch.setattr(Belief, "_kinds", list(Belief._kinds))

    class Mixture(Belief):
        """Gaussians [*B, K, S], with variances and log-weights."""

        carried = ("means", "vars", "log_weights")

        def derived(self, name, *carried):
            means, _, log_weights = carried
            return (log_weights.exp().unsqueeze(-1) * means).sum(-2) if name == "mean" else None

    given = entries(
        means=torch.tensor([[1.0], [5.0]]), vars=torch.ones(2, 1), log_weights=torch.tensor([0.25, 0.75]).log()
    )
    (kind,) = kinds_of(given, carry=given)
    assert type(kind) is Mixture
    assert complete(given, names("mean"), [kind])["belief", "mean"].tolist() == pytest.approx([4.0])


# ------------------------------------------------------------------------------------------------------ what follows


def test_an_ensembles_moments(float64):
    ensemble = torch.randn(3, 8, 2)
    out = completed(entries(ensemble=ensemble), names("mean", "var", "cov"))
    deviations = ensemble - ensemble.mean(-2, keepdim=True)
    torch.testing.assert_close(out["belief", "mean"], ensemble.mean(-2))
    torch.testing.assert_close(out["belief", "cov"], deviations.mT @ deviations / 7)
    torch.testing.assert_close(out["belief", "var"], out["belief", "cov"].diagonal(dim1=-2, dim2=-1))


def test_weighted_particles_moments(float64):
    ensemble, log_weight = torch.randn(3, 8, 2), torch.randn(3, 8).log_softmax(-1)
    given = entries(ensemble=ensemble, log_weight=log_weight)
    out = completed(given, names("mean", "var"))
    weight = log_weight.exp().unsqueeze(-1)
    mean = (weight * ensemble).sum(-2)
    torch.testing.assert_close(out["belief", "mean"], mean)
    assert not out["belief", "mean"].allclose(ensemble.mean(-2), atol=1e-3)
    with pytest.raises(KeyError, match=r"'cov'.* cannot be computed"):  # not that of equal weights
        completed(given, names("cov"))


def test_a_covariances_variances(float64):
    cov = torch.tensor([[2.0, 0.5], [0.5, 1.0]])
    out = completed(entries(mean=torch.zeros(2), cov=cov), names("var"))
    assert out["belief", "var"].equal(torch.tensor([2.0, 1.0]))
    with pytest.raises(KeyError, match=r"'ensemble'.* cannot be computed"):
        completed(entries(mean=torch.zeros(2), cov=cov), names("ensemble"))


def test_on_a_circle_the_mean_of_members_is_that_of_directions(float64):
    ensemble = torch.tensor([[3.1], [-3.1]])
    kind = Ensemble(PREFIX, Circle())
    mean, var = (kind.derived(name, ensemble) for name in ("mean", "var"))
    assert abs(float(mean)) == pytest.approx(torch.pi)
    assert float(var) == pytest.approx(2 * (torch.pi - 3.1) ** 2)


def test_independent_entries_are_read_from_the_stored_belief(float64):
    given = entries(ensemble=torch.randn(4, 2))
    age = torch.tensor([3.0])
    out = completed(given, names("mean", "age"), stored=entries(age=age, mean=torch.full((2,), torch.nan)))
    assert out["belief", "age"] is age
    assert out["belief", "mean"].isfinite().all()  # it follows
    with pytest.raises(KeyError, match=r"'age'.* cannot be computed .*store it"):
        completed(given, names("age"))


def test_existing_entries_are_kept():
    given = entries(mean=torch.zeros(2), cov=torch.eye(2), var=torch.full((2,), 7.0))
    out = completed(given, names("mean", "cov", "var"))
    assert all(out[key] is value for key, value in given.items())


def test_uncarried_moments_belong_to_the_belief():
    written = [*names("ensemble", "mean", "var", "cov", "gain"), ("info", "mean"), "mean"]
    assert summary_keys(names("ensemble"), written) == names("mean", "var", "cov")


# -------------------------------------------------------------------------------------------------- finite, and limits


def test_a_particle_may_have_no_weight_and_no_other_number_may_be_infinite():
    particles, plain = Particles(), Ensemble()
    assert particles.finite("log_weight", torch.tensor([0.0, -torch.inf]))
    for bad in (torch.inf, torch.nan):
        assert not particles.finite("log_weight", torch.tensor([0.0, bad]))
    for bad in (torch.inf, -torch.inf, torch.nan):
        assert not particles.finite("ensemble", torch.tensor([0.0, bad]))
        assert not plain.finite("ensemble", torch.tensor([0.0, bad]))


def test_negative_variances_are_a_flaw():
    assert Moments().flaws(entries(cov=torch.diag(torch.tensor([1.0, -1e-3])))) == [
        "negative variances in [('belief', 'cov')]"
    ]
    assert Moments().flaws(entries(cov=torch.eye(2))) == []
    assert Moments().flaws({}) == []


def test_limited_moments_keep_their_correlations(float64):
    cov = torch.tensor([[400.0, 60.0], [60.0, 25.0]])
    held = {"mean": torch.tensor([1e9, 2.0]), "cov": cov, "var": cov.diagonal()}
    out = Moments().limited(held, 100.0)
    torch.testing.assert_close(out["cov"], torch.tensor([[100.0, 30.0], [30.0, 25.0]]))
    torch.testing.assert_close(out["var"], torch.tensor([100.0, 25.0]))
    assert out["mean"].tolist() == [10_000.0, 2.0]  # a thousand standard deviations of the ceiling


def test_limited_members_have_the_limited_moments(float64):
    ensemble = torch.randn(50, 2) * torch.tensor([30.0, 1.0]) + torch.tensor([5.0, -1.0])
    held = {"ensemble": ensemble, "mean": ensemble.mean(-2), "var": ensemble.var(-2)}
    out = Ensemble().limited(held, 100.0)
    torch.testing.assert_close(out["ensemble"].var(-2), out["var"])
    torch.testing.assert_close(out["var"], torch.stack([torch.tensor(100.0), ensemble[:, 1].var()]))
    torch.testing.assert_close(out["ensemble"].mean(-2), ensemble.mean(-2))
    assert out["ensemble"][:, 1].equal(ensemble[:, 1])


def test_limited_particles_come_near_the_median_and_the_others_stay(float64):
    ensemble = torch.tensor([[0.0], [1.0], [2.0], [1e6]])
    log_weight = torch.full((4,), 0.25).log()
    held = {"ensemble": ensemble, "log_weight": log_weight, "mean": ensemble.mean(-2), "var": ensemble.var(-2)}
    out = Particles().limited(held, 100.0)
    assert out["ensemble"][:3].equal(ensemble[:3])
    assert 10.0 <= float(out["ensemble"][3]) <= 12.0  # ten from a median between one and two
    assert float(out["mean"]) == pytest.approx(float(out["ensemble"].mean()))
    assert float(out["var"]) == pytest.approx(100.0)


def test_limited_members_follow_a_mean_out_of_reach(float64):
    """The ceiling is a hundred: the mean stays within a thousand times ten, and the members around it."""
    ensemble = torch.randn(50, 1) + 1e9
    held = {"ensemble": ensemble, "mean": ensemble.mean(-2), "var": ensemble.var(-2)}
    out = Ensemble().limited(held, 100.0)
    assert out["mean"].tolist() == [10_000.0]
    torch.testing.assert_close(out["ensemble"].mean(-2), out["mean"])
    torch.testing.assert_close(out["ensemble"].var(-2), held["var"])


def test_where_nothing_is_limited_members_on_a_space_stay_to_the_bit():
    """Also where another row is limited; taken off the mean and put back they would be rounded."""
    space = Circle()
    ensemble = torch.randn(2, 50, 1) * torch.tensor([0.3, 1e-3]).reshape(2, 1, 1) + 1.0
    held = {"ensemble": ensemble, "mean": space.mean(ensemble), "var": ensemble.var(-2)}
    out = Ensemble(space=space).limited(held, 1e-4)["ensemble"]
    assert out[1].equal(ensemble[1])
    assert float(out[0].var()) == pytest.approx(1e-4, rel=0.01)


def test_the_mean_of_particles_that_are_not_limited_stays_to_the_bit():
    ensemble = torch.cat([torch.tensor([0.0, 1.0, 2.0, 1e6]).unsqueeze(-1), torch.randn(4, 1)], -1)
    mean = ensemble.mean(-2) + torch.tensor([0.0, 1e-3])  # what an update wrote
    held = {"ensemble": ensemble, "log_weight": torch.full((4,), 0.25).log(), "mean": mean, "var": ensemble.var(-2)}
    out = Particles().limited(held, 100.0)
    assert out["mean"][1] == mean[1]
    assert out["mean"][0] < 10.0
