"""Numbers of which some are angles. Oracles: unit vectors, the same numbers on another turn, spaces part by part."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.filters import EKF, DEnKF
from torch_denkf.functional import wrap_angles
from torch_denkf.functional.manifolds import (
    SE2,
    SO3,
    Circle,
    Euclidean,
    Flat,
    Opposite,
    Product,
    Repeated,
    check_space,
    places_of,
    whole_parts,
)
from torch_denkf.modules import (
    AroundState,
    ConstantNoise,
    EKFAnalysis,
    EnsembleAnalysis,
    GaussianAround,
    KalmanAnalysis,
    LearnedTransition,
    Select,
    UKFAnalysis,
)

pytestmark = pytest.mark.usefixtures("float64")

MIXED = Flat(5, circular=[3, 0, 4])
FIRST = Flat(2, circular=[0])
PARTS = Product(Circle(), Euclidean(2), Circle(), Circle())
UPDATES = {
    "EKF": lambda space: EKFAnalysis(Select([0, 1, 2]), reading_space=space),
    "UKF": lambda space: UKFAnalysis(Select([0, 1, 2]), reading_space=space),
    "Kalman": lambda space: KalmanAnalysis(
        torch.eye(3), None, reading_space=space, observation_key=("sensor", "ensemble")
    ),
    "etkf": lambda space: EnsembleAnalysis("etkf", reading_space=space),
    "sakov": lambda space: EnsembleAnalysis("sakov", reading_space=space),
}


def test_a_product_of_lines_and_circles_is_flat():
    assert PARTS.flat == MIXED
    assert hash(PARTS.flat) == hash(MIXED)
    assert (Euclidean(2) * Circle()).flat == Flat(3, circular=[2])
    assert Circle() * Euclidean(2) * Circle() * Circle() == PARTS
    assert SO3() * Euclidean(3) == Product(SO3(), Euclidean(3))
    assert Repeated(Circle() * Euclidean(1), 2).flat == Flat(4, circular=[0, 2])
    assert Product(*MIXED.parts) == PARTS
    assert (Euclidean(2), Circle()) == (Flat(2), Flat(1, circular=[0]))
    assert [space.flat for space in (SO3(), SE2(), SE2() * Circle(), Opposite(Circle()))] == [None] * 4
    assert copy.deepcopy(MIXED) == MIXED
    assert check_space("space", PARTS) == MIXED
    with pytest.raises(TypeError):
        SO3() * 3


def test_the_closed_form_is_that_of_the_parts():
    point, origin = 3 * torch.randn(2, 6, 5)
    for method in ("compose", "plus", "minus"):
        torch.testing.assert_close(getattr(MIXED, method)(point, origin), getattr(PARTS, method)(point, origin))
    for method in ("inverse", "exp", "log", "normalise", "basis", "dual_basis", "right_jacobian", "adjoint"):
        assert getattr(MIXED, method)(point).equal(getattr(PARTS, method)(point))
    points = MIXED.plus(point.unsqueeze(-2), 0.4 * torch.randn(6, 9, 5))
    weights = torch.rand(6, 9).softmax(-1)
    for given in (None, weights):
        mean = MIXED.mean(points, given)
        torch.testing.assert_close(mean, PARTS.mean(points, given))
        # Members within half a turn: the point around which the tangents add up to zero.
        away = MIXED.minus(points, mean.unsqueeze(-2)) * (1 if given is None else 9 * given.unsqueeze(-1))
        torch.testing.assert_close(away.mean(-2), torch.zeros(6, 5), rtol=0, atol=1e-14)
    known = torch.rand(6, 5) < 0.5
    assert all(part.equal(known) for part in whole_parts(MIXED, known))
    assert [place[1:] for place in places_of(MIXED)] == [place[1:] for place in places_of(PARTS)]


@pytest.mark.parametrize("name", UPDATES)
def test_the_reading_of_an_angle_is_the_shorter_way_round(name):
    """The oracle is the update of plain numbers whose angles were brought to one turn before."""
    spread = torch.tensor([[0.3, -0.2, 0.1], [-0.1, 0.4, 0.2], [0.2, 0.1, -0.4], [-0.5, -0.3, 0.3]])
    mean, reading = torch.tensor([1.0, 3.1, -2.0]), torch.tensor([1.2, -3.0, -1.5])
    cov, turn = torch.diag(torch.tensor([0.2, 0.1, 0.3])) + 0.05, torch.tensor([0.0, 2 * math.pi, 0.0])

    def update(space, predicted, reading):
        forecast = {"ensemble": mean + spread, "observation": predicted, "mean": mean, "cov": cov}
        sensor = {"ensemble": reading, "noise": torch.tensor([0.1, 0.2, 0.3])}
        out = UPDATES[name](space)(TensorDict({"forecast": forecast, "sensor": sensor}))
        return torch.cat([out["belief", "mean"], out["belief", "var"], out["info", "log_likelihood"]])

    expected = update(None, mean + spread, reading + turn)
    across = mean + spread - turn * torch.tensor([[0.0], [1.0], [0.0], [0.0]])  # one member's on the other side of pi
    for space in (Flat(3, circular=[1]), Euclidean(1) * Circle() * Euclidean(1)):
        torch.testing.assert_close(update(space, across, reading), expected, rtol=0, atol=4e-15)


@pytest.mark.parametrize("kind", ["EKF", "DEnKF"])
def test_a_state_on_lines_and_circles_is_that_of_plain_numbers(kind):
    """Its angle is wrapped, and the filter that lets it grow beyond pi is the oracle."""
    space, turn = Flat(3, circular=[1]), torch.tensor([0.3, 0.4, 0.0])
    data = TensorDict({"start": torch.zeros(2, 12, 3), "pose": 0.1 * torch.randn(2, 12, 3)}, [2, 12])
    data["pose"] += turn * torch.arange(12.0).unsqueeze(-1)
    beliefs = []
    for on in (None, space):
        around = {"state_key": "start", "space": on}
        std = [0.2, 0.3, 0.1]
        initial = GaussianAround(std, **around) if kind == "EKF" else AroundState(std, ensemble_size=9, **around)
        motion = LearnedTransition(lambda state: state + turn, residual=False)
        parts = (motion, None, Select([0, 1, 2]), ConstantNoise([0.3, 0.2, 0.4], in_key="pose"))
        options = {"initial": initial, "process_noise": [0.1, 0.1, 0.1], "reading_space": space}
        filter = (EKF if kind == "EKF" else DEnKF)(*parts, observation_key="pose", **options)
        torch.manual_seed(0)
        beliefs.append(filter.sequence(data.clone())["belief"])
    plain, wrapped = beliefs
    assert plain["mean"][..., 1].max() > 4 > math.pi > wrapped["mean"].narrow(-1, 1, 1).max()
    torch.testing.assert_close(space.minus(plain["mean"], wrapped["mean"]), torch.zeros(2, 12, 3), rtol=0, atol=1e-12)
    torch.testing.assert_close(wrapped["var"], plain["var"], rtol=0, atol=1e-12)


def test_wrapped_differences_point_the_same_way_and_lie_within_half_a_turn():
    difference = 20 * torch.randn(50, 3)
    out = Flat(3, circular=[2, 0]).normalise(difference)
    assert out[:, 1].equal(difference[:, 1])
    for function in (torch.sin, torch.cos):
        torch.testing.assert_close(function(out), function(difference), rtol=0, atol=1e-12)
    assert (out[:, [0, 2]] >= -math.pi).all()
    assert (out[:, [0, 2]] < math.pi).all()
    edges = torch.tensor([-math.pi, 0.0, 3.0, -3.0, 2 * math.pi, 7.0]).unsqueeze(-1)
    expected = torch.tensor([-math.pi, 0.0, 3.0, -3.0, 0.0, 7.0 - 2 * math.pi]).unsqueeze(-1)
    torch.testing.assert_close(wrap_angles(edges), expected, rtol=0, atol=1e-14)
    assert Euclidean(3).normalise(difference) is difference


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("samples", [True, False])
def test_aligned_angles_do_not_depend_on_full_turns(batch, samples):
    predicted = torch.tensor([3.0, 5.0]) + 0.4 * torch.randn(*batch, 9, 2)
    reading = torch.tensor([-3.0, 5.0]) + 0.4 * torch.randn(*batch, *[7] * samples, 2)
    if samples:  # as many as members
        reading = reading[..., :1, :] + 0.1 * torch.randn(*batch, 9, 2)
    first = FIRST.align(predicted, reading)
    turns = [2 * math.pi * torch.randint(-3, 4, value.shape) for value in (predicted, reading)]
    moved = [value + turn * torch.tensor([1.0, 0.0]) for value, turn in zip((predicted, reading), turns, strict=True)]
    torch.testing.assert_close(FIRST.align(*moved), first, rtol=0, atol=1e-12)
    for value, aligned in zip((predicted, reading), first, strict=True):
        assert (aligned - value)[..., 1].abs().max() < 1e-14
        for function in (torch.sin, torch.cos):
            torch.testing.assert_close(function(aligned[..., 0]), function(value[..., 0]), rtol=0, atol=1e-12)
    # On one turn: like a line, with the reading on the shorter way round.
    spread = first[0][..., 0].amax(-1) - first[0][..., 0].amin(-1)
    assert (spread < math.pi).all()
    center = first[0][..., 0].mean(-1)
    own = first[1][..., 0].mean(-1) if samples else first[1][..., 0]
    assert ((own - center).abs() < math.pi).all()


def test_masked_values_may_be_nan():
    predicted, reading = torch.randn(3, 5, 2), torch.full((3, 5, 2), torch.nan)
    reading[0] = 1.0
    observed = torch.tensor([[True], [False], [False]])
    for samples in (reading, reading[:, 0]):
        aligned = FIRST.align(predicted, samples, observed)
        assert all(value.isfinite().all() for value in aligned)
        torch.testing.assert_close(aligned[1][0], samples[0])
    assert Euclidean(2).align(predicted, reading)[0] is predicted


def test_gradients_are_those_of_numbers_on_a_line():
    # The turn is a constant: the mean of a reading moves with each sample by 1/n.
    samples = (math.pi + 0.3 * torch.randn(6, 1)).requires_grad_()
    torch.testing.assert_close(
        torch.autograd.grad(Circle().mean(wrap_angles(samples)).sum(), samples)[0],
        torch.full((6, 1), 1 / 6),
        rtol=0,
        atol=1e-14,
    )
