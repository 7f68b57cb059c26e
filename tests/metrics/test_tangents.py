"""Metrics of points of a space: as with angles, as of numbers, in a turned world, and where a belief fits its truth."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.functional.checks import assert_raises
from torch_denkf.functional.manifolds import SE2, SE3, SE23, SO3, Circle, Euclidean, Flat, Product
from torch_denkf.metrics import (
    ensemble_interval_coverage,
    interval_coverage,
    nees,
    pit,
    rotation_error,
    spread_skill_ratio,
    state_errors,
)
from torch_denkf.plots.histograms import rank_histogram, spread_error

COUNT, E = 600, 9


@pytest.fixture(autouse=True)
def _double(float64):
    return


def belief(space, center, factor):
    """Returns the truth, mean, members, weights, variance and covariance around a point, [COUNT, ...]."""

    def around(*extra):
        point = center.expand(COUNT, *extra, space.point_dim)
        return space.plus(point, torch.randn(COUNT, *extra, space.tangent_dim) @ factor.mT)

    cov = (factor @ factor.mT + 0.01 * torch.eye(space.tangent_dim)).expand(COUNT, -1, -1)
    return {
        "truth": around(),
        "mean": around(),
        "ensemble": around(E),
        "log_weight": torch.randn(COUNT, E).log_softmax(-1),
        "cov": cov,
        "var": cov.diagonal(dim1=-2, dim2=-1) * (1 + torch.rand(COUNT, space.tangent_dim)),
    }


METRICS = {
    "errors": lambda b, **o: torch.stack(state_errors(b["mean"], b["truth"], **o)),
    "coverage": lambda b, **o: interval_coverage(b["mean"], b["var"], b["truth"], **o),
    "members' coverage": lambda b, **o: ensemble_interval_coverage(b["ensemble"], b["truth"], level=0.7, **o),
    "pit": lambda b, **o: pit(b["mean"], b["var"], b["truth"], **o),
    "ranks": lambda b, **o: rank_histogram(b["ensemble"], b["truth"], **o),
    "weighted ranks": lambda b, **o: rank_histogram(b["ensemble"], b["truth"], log_weight=b["log_weight"], **o),
    "spread": lambda b, **o: torch.stack(spread_error(b["mean"], b["var"], b["truth"], **o)),
    "nees": lambda b, **o: nees(b["mean"], b["cov"], b["truth"], **o).values,
    "nees of variances": lambda b, **o: nees(b["mean"], b["var"], b["truth"], **o).values,
}
RATIO = {"ratio": lambda b, **o: spread_skill_ratio(b["mean"], b["var"], b["truth"], E, **o)}


@pytest.mark.parametrize("name", METRICS)
def test_angles_and_numbers_equal_the_plain_metrics(name):
    found = belief(Product(Circle(), Euclidean(2)), torch.tensor([math.pi - 0.05, 1.0, -2.0]), 0.4 * torch.eye(3))
    expected = METRICS[name](found, space=Product(Circle(), Euclidean(2)))
    assert not torch.allclose(METRICS[name](found), expected), "it is no plain number"
    turn = torch.tensor([math.pi, 0.0, 0.0])  # turned by half a circle nothing wraps
    for key in ("truth", "mean", "ensemble"):
        found[key] = Flat(3, circular=[0]).normalise(found[key] - turn)
    torch.testing.assert_close(METRICS[name](found), expected)


@pytest.mark.parametrize("turn", [[0.3, -2.0, 1.1], [0.0, 0.0, math.pi], [0.0, 0.6 * math.pi, 0.8 * math.pi]])
@pytest.mark.parametrize("space", [SO3(), SE3(), SE23(), Product(SO3(), Euclidean(2))], ids=repr)
def test_a_turn_of_the_world_changes_nothing(space, turn):
    here = belief(space, space.neutral(), 0.3 * torch.eye(space.tangent_dim))
    move = space.exp(torch.cat([torch.tensor(turn), torch.randn(space.tangent_dim - 3)]))
    there = dict(here)
    for key in ("truth", "mean", "ensemble"):
        point = space.compose(move.expand_as(here[key]), here[key])
        there[key] = torch.cat([point[..., :4] * torch.randn_like(point[..., :1]).sign(), point[..., 4:]], -1)
    for name, metric in (METRICS | RATIO).items():
        found, expected = metric(there, space=space), metric(here, space=space)
        torch.testing.assert_close(found, expected, msg=lambda m, n=name: f"{n}: {m}")


def test_angles_between_orientations_are_those_of_scipy():
    space = Product(Euclidean(1), SE3(), SO3(), Circle(), SE2())
    one, other = (space.exp(torch.randn(40, space.tangent_dim)) for _ in range(2))
    other[0, 1:5] *= -1.0
    error = rotation_error(one, other, space=space)
    assert error.shape == (40, 4)
    for column, first in ((0, 1), (1, 8)):
        both = (Rotation.from_quat(p[:, first : first + 4].roll(-1, -1).numpy()) for p in (one, other))
        expected = torch.from_numpy((next(both).inv() * next(both)).magnitude()).rad2deg()
        torch.testing.assert_close(error[:, column], expected)
    for column, at in ((2, 12), (3, 13)):
        difference = (one - other)[:, at]
        torch.testing.assert_close(error[:, column], torch.atan2(difference.sin(), difference.cos()).abs().rad2deg())
    other[1, 3] = torch.nan
    assert rotation_error(one, other, space=space)[1].isnan().tolist() == [True, False, False, False]
    assert_raises(ValueError, "has no orientation", rotation_error, one[:, :1], one[:, :1], space=Euclidean(1))


def test_parts_that_are_not_known_do_not_count():
    space = Product(SO3(), Euclidean(2))
    found = belief(space, space.neutral(), 0.3 * torch.eye(5))
    gaps = dict(found, truth=found["truth"].clone())
    gaps["truth"][::2, 2] = torch.nan
    gaps["truth"][1::3, 5] = torch.nan
    rows = [torch.arange(COUNT) % 2 == 1] * 3 + [torch.ones(COUNT, dtype=torch.bool), torch.arange(COUNT) % 3 != 1]
    for name in ("errors", "coverage", "members' coverage", "spread"):
        value = METRICS[name](gaps, space=space)
        for dim, row in enumerate(rows):
            known = {key: part[row] for key, part in found.items()}
            place = (slice(None), dim) if name in ("errors", "spread") else dim
            torch.testing.assert_close(value[place], METRICS[name](known, space=space)[place])
    torch.testing.assert_close(
        RATIO["ratio"](gaps, space=space)[0], RATIO["ratio"]({k: v[rows[0]] for k, v in found.items()}, space=space)[0]
    )
