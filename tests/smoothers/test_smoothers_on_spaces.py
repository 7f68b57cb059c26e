"""Smoothers of orientations: against plain numbers, a Kalman filter of small angles, and each other."""

from functools import partial

import pytest
import torch

from tests.filters.beliefs_for_tests import close
from tests.filters.test_spaces import (
    SPACE,
    STD,
    B,
    Orientation,
    Q,
    R,
    T,
    Turning,
    assert_turned,
    log,
    make,
    turned_beliefs,
)
from tests.smoothers.small_angles import PROCESS, STARTS, assert_small_differences, linear, noise, readings, rotating
from torch_denkf.baselines import IEnKS
from torch_denkf.filters import EKF, UKF, DEnKF, ParticleFilter
from torch_denkf.functional.gaussian import gaussian_log_prob
from torch_denkf.functional.manifolds import SO3, Euclidean
from torch_denkf.modules import AroundState, ConstantNoise, EnsembleAnalysis, GaussianAround
from torch_denkf.smoothers import FixedLag, ParticleSmoother, RTSSmoother
from torch_denkf.smoothers.particles import log_density_of_pairs

GAUSSIAN = {"EKF": EKF, "UKF": UKF}
SMOOTHED = [("smoothed", "mean"), ("smoothed", "var")]


pytestmark = pytest.mark.usefixtures("float64")


def filter_of(kind, parts, own, std, q, space=None, reading_space=None, *, size=24, key="pose", **options):
    """Returns a filter of rotations, or of plain numbers."""
    around = AroundState(std, ensemble_size=size, state_key="start", space=space)
    known = {"process_noise": q, "observation_key": key, "reading_space": reading_space, **options}
    if kind in GAUSSIAN:
        return GAUSSIAN[kind](*parts, own, initial=GaussianAround(std, state_key="start", space=space), **known)
    if kind == "particles":
        return ParticleFilter(*parts, noise=own, initial=around, **known)
    if kind == "IEnKS":
        return IEnKS(*parts, own, initial=around, **known)
    more = {"localisation": "significance", "threshold": 1.0} if kind == "significance" else {}
    scheme, spaces = "etkf" if kind == "significance" else kind, {"space": space, "reading_space": reading_space}
    analysis = EnsembleAnalysis(scheme, observation_key=key, **spaces, **more)
    return DEnKF(*parts, own, analysis, initial=around, process_noise=q)


KINDS = {kind: partial(filter_of, kind) for kind in ("perturbed", "etkf", "significance")}
KINDS |= {kind: lambda *parts, kind=kind: FixedLag(filter_of(kind, *parts), 4) for kind in GAUSSIAN}
KINDS |= {f"IEnKS {count}": partial(filter_of, "IEnKS", iterations=count) for count in (1, 5)}
#: None are drawn again: weights multiply small differences up over all readings.
KINDS["particles"] = lambda *parts: ParticleSmoother(filter_of("particles", *parts, resampling=None))


@pytest.mark.parametrize("kind", KINDS)
def test_small_angles_are_plain_numbers(kind):
    """With all angles a thousandth, products of two are a millionth: what plain filters of numbers leave out."""
    data, flat = readings(0.1 if kind == "particles" else 1.0)
    plain = KINDS[kind](linear(), noise(), STARTS, PROCESS)
    on_space = KINDS[kind](rotating(), noise(), STARTS, PROCESS, SPACE, SO3())
    flat = getattr(plain, "filter", plain).draw_noise(flat)
    if flat.get("noise", None) is not None:
        data["noise"] = flat["noise"]
    out, expected = on_space.sequence(data.clone()), plain.sequence(flat)
    for key in [key for key in ("belief", "smoothed") if out.get(key, None) is not None]:
        assert_small_differences(out, expected, key, data["start"], var=0.05 if kind == "particles" else 0.01)


@pytest.mark.parametrize("kind", ["EKF", "UKF"])
def test_online_lag_is_the_smoother(kind):
    """With one step it is the same formula; with more, means move in several steps, which products of angles tell."""
    filter, data = make(kind), log()
    for lag, away, var in ((1, 1e-12, 1e-12), (5, 1e-3, 5e-3)):
        whole, online = RTSSmoother(filter, lag)(data.clone()), FixedLag(filter, lag).sequence(data.clone())
        later, own = online["smoothed"][:, lag:], whole["smoothed"][:, :-lag]
        std = own["var"].sqrt()
        assert (SPACE.minus(later["mean"], own["mean"]).abs() / std).max() < away
        assert (later["var"] / own["var"] - 1).abs().max() < var
        assert (online["smoothed", "age"][:, lag:] == lag).all()


@pytest.mark.parametrize("space", [None, SPACE])
def test_densities_of_pairs_are_those_of_their_tangents(space):
    on, root = Euclidean(6) if space is None else space, torch.randn(B, 6, 6)
    values, means = (on.exp(torch.randn(B, 4, 6)) for _ in range(2))
    cov = root @ root.mT + torch.eye(6)
    found = log_density_of_pairs(values, means, cov, *([] if space is None else [space]))
    for i in range(4):
        for j in range(4):
            away = on.minus(values[:, j], means[:, i])
            due = gaussian_log_prob(away, torch.zeros_like(away), cov)
            torch.testing.assert_close(found[:, i, j], due.reshape(found[:, i, j].shape))


def iterated(size=8, key="pose", **options):
    parts, own = (Turning(), None, Orientation()), ConstantNoise(R, in_key=key)
    return filter_of("IEnKS", parts, own, STD, Q, SPACE, SO3(), size=size, key=key, **options)


def test_the_iterated_smoother_of_many_members_is_that_of_moments():
    """An extended Kalman filter is as good as exact here. The bound is ten standard errors of so many members."""
    data, size = log(steps=8), 400
    expected = FixedLag(make("EKF"), 1).sequence(data.clone())
    torch.manual_seed(0)
    with torch.no_grad():
        out = iterated(size, iterations=3).sequence(data.clone())
    for key in ("belief", "smoothed"):
        std = expected[key, "var"].sqrt()
        assert (SPACE.minus(out[key, "mean"], expected[key, "mean"]).abs() < 10 * std / size**0.5).all()
        assert ((out[key, "var"] / std.square() - 1).abs() < 5 * (2 / size) ** 0.5).all()


@pytest.mark.parametrize("turn", [[2.0, -1.0, 0.5], [torch.pi, 0.0, 0.0]])
def test_a_turned_world_turns_the_iterated_smoother_and_nothing_else(turn):
    filter, turn = iterated(inflation=1.1, rotate=True), SO3().exp(torch.tensor(turn))
    data = filter.draw_noise(log(steps=6))
    here, there = turned_beliefs(filter, turn, data)
    assert_turned(here, there, turn, 1e-8)
    close(there["info"], here["info"], ["nis", "log_likelihood"], atol=1e-7)


def test_the_iterated_smoother_takes_the_mean_of_samples_that_are_points():
    filter = iterated()
    data = filter.draw_noise(log(hidden=False))
    expected = filter.sequence(data.clone())
    away, sampled = 0.1 * torch.randn(B, T, 1, 3), ("poses", "ensemble")
    data[sampled] = SO3().plus(data["pose"].unsqueeze(-2), torch.cat([away, -away] * 4, -2))
    out = iterated(key=sampled).sequence(data)
    close(out, expected, [("belief", "ensemble"), *SMOOTHED], atol=1e-9)
