"""Losses of states that are points of a space: the same as with angles, as in numbers near a point, and by hand.

Beliefs are given, so that a loss is a function of the points alone.
"""

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.distributions import MultivariateNormal

from tests.filters.factories import FixedEnsemble, toy_denkf
from torch_denkf.filters import DEnKF
from torch_denkf.functional.manifolds import SE2, SE3, SE23, SO3, Circle, Euclidean, Opposite, Product, Repeated
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, Select, SubModel
from torch_denkf.objectives import DEnKFLoss, GaussianLoss, MixtureLoss, TransitionLoss
from torch_denkf.objectives._labels import Labels

B, T, E = 3, 5, 8
ROTATIONS = [SO3(), SE3(), SE23(), Product(SO3(), Euclidean(2))]


@pytest.fixture(autouse=True)
def _double(float64):
    return


class Given:
    """A loss of the beliefs that are in the batch."""

    def _run(self, tensordict):
        return tensordict

    def _counts(self, tensordict):
        return torch.ones(tensordict.batch_size, dtype=torch.bool)


class Members(Given, DEnKFLoss):
    pass


class Moments(Given, GaussianLoss):
    pass


class Particles(Given, MixtureLoss):
    pass


LOSSES = {
    **{f"members, {score}": (Members, {"score": score}) for score in ("crps", "energy", "mse")},
    **{f"moments, {score}": (Moments, {"score": score}) for score in ("crps", "nll", "mse")},
    **{f"particles, {score}": (Particles, {"score": score, "mean": 1.0}) for score in ("mixture", "crps")},
}


def value(name, data, **options):
    kind, settings = LOSSES[name]
    off = {"transition": 0.0, "sensor": 0.0, "reduction": "none"}
    losses = kind(toy_denkf(), **off, **settings, **options)(data)
    return torch.stack([losses[key] for key in sorted(losses.keys())])


def beliefs(space, center, spread=0.3):
    """Returns the truth, members with weights, mean and covariance around a point, or around points ``[B, T, P]``."""

    def around(*extra):
        return space.plus(center.expand(*extra, space.point_dim), spread * torch.randn(*extra, space.tangent_dim))

    factor = spread * torch.randn(B, T, space.tangent_dim, space.tangent_dim)
    belief = {
        "ensemble": around(E, B, T).permute(1, 2, 0, 3),
        "log_weight": torch.randn(B, T, E).log_softmax(-1),
        "mean": around(B, T),
        "cov": factor @ factor.mT + 0.01 * torch.eye(space.tangent_dim),
    }
    return TensorDict({"state": around(B, T), "belief": belief}, [B, T])


def points_of(data, change):
    """Returns the batch with all its points changed."""
    out = data.clone()
    for key in ("state", ("belief", "mean"), ("belief", "ensemble")):
        out[key] = change(data[key])
    return out


def for_kind(name, data):
    """Returns the belief that a loss reads: of members without weights, its key is the ensemble's."""
    return data.exclude(("belief", "log_weight")) if name.startswith("members") else data


OPTIONS = {
    "all": {},
    "scaled": {"state_scale": [0.5, 2.0, 4.0]},
    "infinite": {"state_scale": [0.5, math.inf, 4.0]},
    "dims": {"dims": [2, 0], "state_scale": [3.0, 0.5]},
}


@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.parametrize("name", LOSSES)
def test_angles_and_numbers_equal_the_plain_scores(name, options):
    # Headings on both sides of the cut, and members within half a turn of the truth.
    space = Product(Circle(), Euclidean(2))
    data = for_kind(name, beliefs(space, torch.tensor([math.pi - 0.05, 1.0, -2.0])))
    assert data["state"][..., 0].min() < -3 < 3 < data["state"][..., 0].max()
    data["state_observed"] = torch.rand(B, T, 3) < 0.7
    data["state"][0, 0] = torch.nan
    expected = value(name, data, space=space, **OPTIONS[options])
    plain = value(name, data, **OPTIONS[options])
    assert (plain - expected).abs().max() > 0.1, "without a space it is another loss"
    for key in ("state", ("belief", "ensemble"), ("belief", "mean")):  # turned by half a circle nothing wraps
        if key in data.keys(True):
            data[key] = space.flat.normalise(data[key] - torch.tensor([math.pi, 0.0, 0.0]))
    torch.testing.assert_close(value(name, data, **OPTIONS[options]), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("space", [SO3(), SE2(), SE3(), SE23()], ids=repr)
@pytest.mark.parametrize("name", LOSSES)
def test_losses_near_a_point_equal_euclidean_losses(name, space):
    small, size = 1e-4, space.tangent_dim
    numbers = for_kind(name, beliefs(Euclidean(size), torch.zeros(size), spread=1.0))
    center = space.exp(torch.randn(size))
    points = points_of(numbers, lambda tangent: space.plus(center, small * tangent))
    points["belief", "cov"] *= small**2
    scale = torch.rand(size) + 0.5
    expected = value(name, numbers, state_scale=scale)
    found = value(name, points, space=space, state_scale=small * scale)
    if name in ("moments, nll", "particles, mixture"):  # densities in their own units; rows are mean and state
        found[-1] -= size * math.log(small)
    # Curvature changes tangents by about their product: one part in 1e4, times a few.
    torch.testing.assert_close(found, expected, rtol=5e-3, atol=5e-3)


MOVES = {
    "any": [0.3, -2.0, 1.1],
    "half a turn": [0.0, 0.0, math.pi],
    "half a turn askew": [0.0, 0.6 * math.pi, 0.8 * math.pi],
}


@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize("space", ROTATIONS, ids=repr)
@pytest.mark.parametrize("name", LOSSES)
def test_a_turn_of_the_world_changes_no_score(name, space, move):
    data = for_kind(name, beliefs(space, space.neutral()))
    turn = space.exp(torch.cat([torch.tensor(MOVES[move]), torch.randn(space.tangent_dim - 3)]))

    def turned(point):
        out = space.compose(turn.expand_as(point), point)
        # A quaternion and its negative are the same rotation.
        return torch.cat([out[..., :4] * torch.randn_like(out[..., :1]).sign(), out[..., 4:]], -1)

    expected = value(name, data, space=space)
    torch.testing.assert_close(value(name, points_of(data, turned), space=space), expected, rtol=1e-9, atol=1e-9)
    assert expected.abs().min() > 1e-4


def test_a_gaussian_is_one_of_tangents_at_its_mean():
    space = SE3()
    data = beliefs(space, space.exp(torch.randn(6)))
    away = space.minus(data["state"], data["belief", "mean"])
    expected = -MultivariateNormal(torch.zeros(6), data["belief", "cov"]).log_prob(away)
    torch.testing.assert_close(value("moments, nll", data, space=space)[0], expected)
    torch.testing.assert_close(value("moments, mse", data, space=space)[0], away.square().mean(-1))


def test_one_member_is_scored_by_its_distance():
    for space in (SO3(), Euclidean(2)):
        data = for_kind("members", beliefs(space, space.exp(torch.randn(space.tangent_dim))))
        data["belief", "ensemble"] = data["belief", "ensemble"][..., :1, :]
        away = space.minus(data["state"], data["belief", "ensemble"].squeeze(-2))
        expected = {"energy": away.norm(dim=-1), "crps": away.abs().mean(-1), "mse": away.square().mean(-1)}
        for score, by_hand in expected.items():
            torch.testing.assert_close(value(f"members, {score}", data, space=space)[0], by_hand)


@pytest.mark.parametrize("space", [SO3(), pytest.param(SE3(), marks=pytest.mark.slow)], ids=repr)
def test_members_that_are_drawn_like_the_truth_score_best(space):
    """The score's gradient is zero there: by the members' mean, and by the spread along each axis."""
    count, size = 20_000, space.tangent_dim
    factor = 0.3 * torch.eye(size) + torch.tril(0.15 * torch.ones(size, size), -1)
    truth = space.exp(torch.randn(count, size) @ factor.mT)
    labels = Labels(truth, torch.ones(count, size, dtype=torch.bool), range(size), space=space)
    moved = torch.zeros(2 * size, requires_grad=True)
    center = space.exp(moved[:size])
    members = space.plus(center, (torch.randn(count, 8, size) @ factor.mT) * (1 + moved[size:]))
    off = {}
    for each in (False, True):
        errors = labels.errors(members, each=each)
        pairs = (errors.unsqueeze(-2) - errors.unsqueeze(-3)).abs().sum((-3, -2)) / (8 * 7)
        score = (errors.abs().mean(-2) - pairs / 2).sum(-1)
        (gradient,) = torch.autograd.grad(score.mean(), moved, retain_graph=True)
        off[each] = gradient.abs().max()
    # By chance a derivative of size one is off by about 1 / sqrt(20 000) = 0.007 times the spread.
    assert off[False] < 0.008
    assert off[True] > 2 * off[False], "tangents at the truth"


def test_labels_are_of_whole_parts():
    space = Product(SO3(), Euclidean(2), SE2())  # points of 9, tangents of 8
    data = for_kind("members", beliefs(space, space.exp(torch.randn(8))))
    full = value("members, mse", data, space=space, dims=[3, 4])[0]
    data["state"][0, 0, 1] = torch.nan  # of the quaternion
    data["state"][0, 1, 4] = torch.nan  # one number
    data["state"][0, 2, 8] = torch.nan  # of the pose
    data["state"][0, 3] = torch.nan
    members = data["belief", "ensemble"].requires_grad_()
    found = value("members, mse", data, space=space)[0]
    away = space.minus(data["state"], space.mean(members)).square()
    left = {0: [3, 4, 5, 6, 7], 1: [0, 1, 2, 4, 5, 6, 7], 2: [0, 1, 2, 3, 4]}
    for step, dims in left.items():
        # The mean of tangents at the mean is zero to 1e-6.
        torch.testing.assert_close(found[0, step], away[0, step, dims].mean(), rtol=1e-4, atol=1e-6)
    assert found[0, 3] == 0
    (gradient,) = torch.autograd.grad(found.sum(), members)
    assert gradient.isfinite().all()
    assert (gradient[0, 3] == 0).all()
    assert (gradient[0, 0, :, :4] == 0).all()
    data = data.detach()
    assert (value("members, mse", data, space=space, dims=[3, 4])[0, 1:] == full[1:]).all()
    # Labels of the leading parts, and of a part of one.
    for given, scored in ((4, [0, 1, 2]), (5, [0, 1, 2, 3]), (8, [0, 1, 2, 3, 4])):
        less = data.clone()
        less["state"] = data["state"][..., :given]
        scale = torch.rand(len(scored)) + 0.5
        torch.testing.assert_close(
            value("members, mse", less, space=space, state_scale=scale)[:, 1:],
            value("members, mse", data, space=space, dims=scored, state_scale=scale)[:, 1:],
        )


@pytest.mark.parametrize(
    ("space", "parts"),
    [
        (Opposite(Product(SE2(), Euclidean(2))), Product(Opposite(SE2()), Euclidean(2))),
        (Repeated(SE2(), 2), Product(SE2(), SE2())),
        (Opposite(Repeated(SO3(), 2)), Product(Opposite(SO3()), Opposite(SO3()))),
    ],
)
def test_labels_of_a_part_count_in_every_way_to_write_a_product(space, parts):
    data = for_kind("members", beliefs(parts, parts.exp(torch.randn(parts.tangent_dim))))
    data["state"] = data["state"][..., : parts.parts[0].point_dim]
    data["state"][0, 0, 0] = torch.nan
    expected = value("members, mse", data, space=parts)[0]
    assert expected[0, 0] == 0 < expected[0, 1:].min()
    torch.testing.assert_close(value("members, mse", data, space=space)[0], expected)


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("where", ["at the truth", "half a turn off"])
def test_gradients_are_finite(name, where):
    space = SE3()
    data = for_kind(name, beliefs(space, space.neutral(), spread=0.0))
    if where == "half a turn off":
        data["state"] = torch.tensor([0.0, 0.0, 1.0, 0.0, 1.0, 2.0, 3.0]).expand(B, T, 7)
    leaves = [data["belief", key].requires_grad_() for key in ("mean", "ensemble")]
    result = value(name, data, space=space)
    gradients = torch.autograd.grad(result.sum(), leaves, allow_unused=True)
    assert result.isfinite().all()
    assert all(gradient.isfinite().all() for gradient in gradients if gradient is not None)


class Wander(SubModel):
    """Moves points by a step of their space."""

    def __init__(self, space, step):
        super().__init__(nn.Identity(), [("belief", "ensemble")], [("forecast", "ensemble")])
        self.space, self.step = space, nn.Parameter(step)

    def compute(self, ensemble):
        return self.space.plus(ensemble, self.step)


def test_a_step_from_the_truth():
    space, size = SE3(), 6
    start = space.exp(torch.randn(size))
    step, learned = 0.4 * torch.randn(size), 0.4 * torch.randn(size)
    path = [start]
    for _ in range(T - 1):
        path.append(space.plus(path[-1], step))
    data = TensorDict({"state": torch.stack(path).expand(B, T, 7), "observation": torch.zeros(B, T, 1)}, [B, T])
    filter = DEnKF(
        transition=Wander(space, learned),
        sensor=None,
        observation=Select([4]),
        noise=ConstantNoise([1.0], in_key="observation"),
        analysis=EnsembleAnalysis("etkf"),
        initial=FixedEnsemble(start.expand(4, 7)),
    )
    loss = TransitionLoss(filter, score="mse", space=space)
    expected = space.minus(space.exp(learned), space.exp(step)).square().mean()
    torch.testing.assert_close(loss(data)["loss_transition"], expected)
    around = TransitionLoss(filter, score="crps", space=space, spread=[0.1] * 6)
    result = around(data)["loss_transition"]
    result.backward()
    assert result > 0
    assert filter.transition_module.step.grad.isfinite().all()
