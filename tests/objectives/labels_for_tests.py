"""Losses of every belief on frames with gaps in their labels, and their scores by hand, an element's labels alone."""

import math

import torch
from torch.distributions import MultivariateNormal

from tests.filters.factories import S, toy_denkf
from tests.filters.gaussian_for_tests import learned_filter
from tests.filters.particle_for_tests import toy_filter
from tests.objectives.denkf_for_tests import score_by_hand
from tests.objectives.problem_for_tests import problem
from torch_denkf.objectives import DEnKFLoss, GaussianLoss, MixtureLoss

SCALE = [0.5, 3.0, 4.0]
STD = [0.3, 0.7, 2.0]
OFF = {"state": 0.0, "transition": 0.0, "sensor": 0.0}
CASES = {
    **{f"members-{score}": (toy_denkf, DEnKFLoss, {"score": score}) for score in ("crps", "energy", "mse")},
    **{
        f"moments-{score}": (lambda: learned_filter("EKF"), GaussianLoss, {"score": score})
        for score in ("crps", "nll", "mse")
    },
    "particles-mixture": (toy_filter, MixtureLoss, {"component_std": STD}),
    "particles-crps": (toy_filter, MixtureLoss, {"score": "crps"}),
}
TERMS = {"state": "belief", "transition": "forecast"}


def case(name, *, terms=("state", "transition"), **options):
    """Returns a filter, frames with noise and labels, what the filter makes of them, and a loss."""
    make, loss, settings = CASES[name]
    filter = make()
    frames, out = problem(filter)
    return filter, frames, out, loss(filter, **{**OFF, **dict.fromkeys(terms, 1.0)}, **settings, **options)


def element(name, out, prefix, index, truth, dims, scale):
    """Returns the score of one element ``index`` in some dimensions, with nothing masked."""
    kind, score = name.split("-")
    dims, unit = list(dims), torch.tensor(scale)[list(dims)]
    y = truth[index][dims]
    if kind == "moments":
        mean, cov = out[prefix, "mean"][index][dims], out[prefix, "cov"][index][dims][:, dims]
        if score == "nll":
            return -MultivariateNormal(mean, cov).log_prob(y)
        if score == "mse":
            return ((mean - y) / unit).square().mean()
        std, z = cov.diagonal().sqrt() / unit, (y - mean) / cov.diagonal().sqrt()
        normal = torch.distributions.Normal(torch.zeros(()), torch.ones(()))
        return (std * (z * (2 * normal.cdf(z) - 1) + 2 * normal.log_prob(z).exp() - math.pi**-0.5)).mean()
    ensemble = out[prefix, "ensemble"][index][:, dims]
    if kind == "members":
        return score_by_hand(score, ensemble / unit, y / unit)
    weights = out[prefix, "log_weight"][index].exp()
    if score == "crps":
        errors = (ensemble - y) / unit
        pairs = (errors.unsqueeze(0) - errors.unsqueeze(1)).abs()
        both = weights[:, None, None] * weights[None, :, None]
        return ((weights[:, None] * errors.abs()).sum(0) - (both * pairs).sum((0, 1)) / 2).mean()
    width = torch.tensor(STD)[dims] * unit
    log_density = torch.distributions.Normal(ensemble, width).log_prob(y).sum(-1)
    return -torch.logsumexp(log_density + weights.log(), 0)


def by_hand(name, out, prefix, truth, labelled, counts, scale=(1.0,) * S):
    """Returns the mean over the elements that count and have labels, each scored in its labelled dimensions alone."""
    found = []
    for index in (counts & labelled.any(-1)).nonzero().tolist():
        dims = labelled[tuple(index)].nonzero().flatten().tolist()
        found.append(element(name, out, prefix, tuple(index), truth, dims, scale))
    assert 0 < len(found) < counts.sum()
    return torch.stack(found).mean()


def gaps():
    """Returns labels of some elements, or of some dimensions, for ``[2, 7]`` elements."""
    whole = torch.rand(2, 7, 1) < 0.6
    some = torch.rand(2, 7, S) < 0.5
    some[:, ::2] = False  # elements without any
    some[:, 1] = torch.tensor([True, False, True])  # there is a part
    return whole, some
