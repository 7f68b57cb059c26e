"""A number that a mask hides has no part in a belief, nor in a gradient: every filter, every space of readings."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf.baselines import IEnKS
from torch_denkf.filters import EKF, UKF, DEnKF, ParticleFilter
from torch_denkf.functional.manifolds import (
    SE2,
    SE3,
    SE23,
    SO3,
    Circle,
    Euclidean,
    Flat,
    Opposite,
    Product,
    Repeated,
    Turned,
    places_of,
)
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.imperfect import RejectReadings
from torch_denkf.modules import AroundState, ConstantNoise, EnsembleAnalysis, GaussianAround, Select, SubModel
from torch_denkf.monitoring import Gated
from torch_denkf.smoothers import FixedLag

T, E, NAN = 3, 12, math.nan
SPACES = {
    "numbers": Flat(3, circular=[2]),
    "SE2": SE2(),
    "SO3": SO3(),
    "SE3": SE3(),
    "SE23": SE23(),
    "Turned": Turned(3),
    "Repeated": Repeated(SO3(), 2),
    "Opposite": Opposite(SE3()),
    "Product": Product(Euclidean(2), SE2(), Circle(), SO3()),
    "Opposite of a product": Opposite(Product(SE2(), Euclidean(2))),
}
KINDS = ("EKF", "UKF", "etkf", "perturbed", "particles", "fused", "gated", "lagged", "IEnKS")
MEAN, VAR = ("belief", "mean"), ("belief", "var")


pytestmark = pytest.mark.usefixtures("float64")


class Stays(SubModel):
    """States that stay where they are, except for noise."""

    def __init__(self):
        super().__init__(nn.Identity(), [("belief", "ensemble")], [("forecast", "ensemble")])

    def compute(self, ensemble):
        return ensemble


class Whole(SubModel):
    """Reads the state as it is."""

    def __init__(self):
        super().__init__(nn.Identity(), [("forecast", "ensemble")], [("forecast", "observation")])

    def compute(self, ensemble):
        return ensemble


def make(kind, space, model=None, reading_space=None, dim=None, key="pose"):
    """Returns a filter whose state is read as it is, or by a model of ``dim`` numbers, with an R that is trained."""
    model, reading_space = (Whole(), space) if model is None else (model, reading_space)
    std, q = ([value] * space.tangent_dim for value in (0.2, 0.05))
    noise = ConstantNoise([0.1] * (dim or space.tangent_dim), in_key=key, trainable=True)
    around = AroundState(std, ensemble_size=E, state_key="start", space=space)
    read = {"reading_space": reading_space, "observation_key": key}
    if kind in ("EKF", "UKF"):
        of, start = {"EKF": EKF, "UKF": UKF}[kind], GaussianAround(std, state_key="start", space=space)
        return of(Stays(), None, model, noise, initial=start, process_noise=q, **read)
    if kind == "particles":
        return ParticleFilter(Stays(), None, model, noise=noise, initial=around, process_noise=q, **read)
    if kind == "IEnKS":
        return IEnKS(Stays(), None, model, noise, initial=around, process_noise=q, **read)
    if kind == "fused":
        sensor = FusedSensor(model, noise, reading_space=reading_space, observed_key="observed")
        return FusedFilter(Stays(), {"pose": sensor}, initial=around, process_noise=q)
    if kind == "gated":
        return Gated(make("etkf", space), window=1, rate=0.5)
    if kind == "lagged":
        return FixedLag(make("etkf", space), 2)
    analysis = EnsembleAnalysis(kind, space=space, **read)
    return DEnKF(Stays(), None, model, noise, analysis, initial=around, process_noise=q)


MASKS = {
    "all": lambda number, size: number < 0,
    "the first": lambda number, size: number != 0,
    "one in the middle": lambda number, size: number != size // 2,
    "all but the last": lambda number, size: number == size - 1,
}
FILLS = (0.0, NAN, 1e6, math.inf)  # behind the first row, whose numbers stay


def frames(space):
    """Runs of one start and one noise: of each mask one as it is, and one for each filling of what is hidden."""
    random, size = torch.Generator().manual_seed(1), space.tangent_dim
    start = space.exp(0.3 * torch.randn(size, generator=random))
    readings = space.plus(start, 0.2 * torch.randn(T, size, generator=random))
    batch = [len(MASKS), 1 + len(FILLS), T]
    data = TensorDict({"start": start.expand(*batch, -1), "pose": readings.expand(*batch, -1)}, batch).clone()
    data["observed"] = torch.ones(*batch, size, dtype=torch.bool)
    for row, mask in enumerate(MASKS.values()):
        data["observed"][row, :, :2] = mask(torch.arange(size), size)  # gradients go back from a reading behind
    hidden = ~space.told(data["observed"])[0]
    for column, number in enumerate(FILLS):
        data["pose"][:, 1 + column] = torch.where(hidden[:, 1 + column], number, data["pose"][:, 1 + column])
    return data, hidden


def filtered(filter, data, key="pose"):
    """Runs a filter, with one noise for all runs; returns what it wrote, and the readings, which require gradients."""
    torch.manual_seed(2)
    noise = filter.draw_noise(data[:1, :1].clone()).get("noise", None)
    pose = data[key].clone().requires_grad_()
    data = data.clone().set(key, pose + 0)
    if noise is not None:
        data["noise"] = noise.expand(data.shape)
    return filter.sequence(data), pose


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SPACES)
def test_masked_value_has_no_effect(kind, name):
    space, filter = SPACES[name], make(kind, SPACES[name])
    data, hidden = frames(space)
    out, pose = filtered(filter, data)
    mean, var = out[MEAN], out[VAR]
    value = (mean * torch.linspace(1, 2, mean.shape[-1])).sum() + var.sum()
    gradient, *others = torch.autograd.grad(value, [pose, *filter.parameters()], allow_unused=True)
    assert all(one is None or one.isfinite().all() for one in others)
    assert not gradient[hidden].any()
    for found in (mean, var, gradient, out["info", "log_likelihood"]):
        assert found.isfinite().all()
        torch.testing.assert_close(found, found[:, :1].expand_as(found), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", ["EKF", "etkf", "particles"])
def test_position_without_heading_is_a_partial_observation(kind):
    """Is what a model of the position alone says, whose noise is the same in all directions."""
    data, _ = frames(SE2())
    data = data[:1, 0]
    data["observed"] = torch.tensor([False, True, True]).expand(1, T, 3)
    out = filtered(make(kind, SE2()), data)[0]
    filter = make(kind, SE2(), Select([1, 2]), dim=2)
    data["pose"], data["observed"] = data["pose"][..., 1:], data["observed"][..., 1:]
    expected = filtered(filter, data)[0]
    # Members are compared in the axes of a point near their mean: what they say of the heading is curved.
    near = 1e-2 if kind == "etkf" else 1e-9
    torch.testing.assert_close(out[MEAN], expected[MEAN], rtol=near, atol=near)
    torch.testing.assert_close(out[VAR], expected[VAR], rtol=5 * near, atol=near)


def test_masked_heading_does_not_rotate_the_position():
    start, angles = torch.tensor([0.3, 0.0, 0.0]), (0.3, NAN, 0.0, 2.5)
    data = TensorDict({"start": start.expand(1, 4, 2, 3)}, [1, 4, 2])
    data["observed"] = torch.tensor([False, True, True]).expand(1, 4, 2, 3)
    data["pose"] = torch.tensor([[angle, 1.0, 2.0] for angle in angles]).unsqueeze(1).expand(1, 4, 2, 3)
    gain = (0.2**2 + 0.05**2) / (0.2**2 + 0.05**2 + 0.1**2)  # the same in all directions
    expected = torch.tensor([0.3, gain, 2 * gain]).expand(4, 3)
    torch.testing.assert_close(filtered(make("EKF", SE2()), data)[0][MEAN][0, :, 1], expected)


@pytest.mark.parametrize("kind", ["EKF", "etkf"])
@pytest.mark.parametrize("name", [name for name in SPACES if name != "numbers"])
def test_nan_rotation_is_a_missing_observation(kind, name):
    """Its whole part is not known: the belief stands where it was, and its gradients are finite."""
    space = SPACES[name]
    data = frames(space)[0][:1, :1, :2].exclude("observed").expand(1, 2, 2).clone()
    data["pose"][:, 0, 1, -1] = NAN
    data["is_init"] = torch.zeros(*data.shape, 1, dtype=torch.bool)
    data["is_init"][..., 0, :] = True
    data = torch.cat([data, data], -1)  # a second episode begins behind the bad reading
    front, filter = RejectReadings({"pose": "observed"}, spaces={"pose": space}), make(kind, space)
    out = filtered(filter.with_options(check_finite=False), front(data))[0]
    part, size = places_of(space)[-1], space.tangent_dim
    begin = part.tangent.start if part.space.flat is None else size - 1  # plain numbers are missing one by one
    assert out["observed"][0, 0, 1].tolist() == [True] * begin + [False] * (size - begin)
    hidden = data.clone()
    hidden["observed"] = out["observed"]
    hidden["pose"] = data["pose"][:, 1:].expand_as(data["pose"])
    torch.testing.assert_close(out[MEAN][:, 0], filtered(filter, hidden)[0][MEAN][:, 0])
    gradients = torch.autograd.grad(out[MEAN].sum() + out[VAR].sum(), list(filter.parameters()))
    assert all(one.isfinite().all() and one.any() for one in gradients)


@pytest.mark.parametrize("name", SPACES)
def test_ensemble_covariance_is_in_the_tangent_space(name):
    """Also at a start, where they follow from the members."""
    space, data = SPACES[name], frames(SPACES[name])[0][0, :1].exclude("observed")
    filter = make("etkf", space)
    analysis = EnsembleAnalysis("etkf", space=space, reading_space=space, observation_key="pose", covariance=True)
    filter = filter.with_modules(analysis=analysis)
    assert ("belief", "cov") in filter.belief_keys
    out = filtered(filter, data.unsqueeze(0))[0]
    away = space.minus(out["belief", "ensemble"], space.mean(out["belief", "ensemble"]).unsqueeze(-2))
    expected = away.mT @ away / (E - 1)
    torch.testing.assert_close(out["belief", "cov"], expected, rtol=0, atol=1e-3)  # an update's mean is rounded
    torch.testing.assert_close(out["belief", "cov"][..., 0, :, :], expected[..., 0, :, :])
    torch.testing.assert_close(out[VAR][..., 0, :], expected[..., 0, :, :].diagonal(dim1=-2, dim2=-1))
