"""Numbers of which some are angles: the same spaces part by part, and results of formulas that wrap differences."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.filters import EKF, DEnKF
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
PARTS = Product(Circle(), Euclidean(2), Circle(), Circle())
#: Means, variances and log-likelihoods of the update below, of formulas that wrap the difference of one component.
STORED = {
    "EKF": [
        1.1581641296933172,
        3.21072336177983,
        -1.7127538054600242,
        0.07058823529411765,
        0.08235294117647057,
        0.1588235294117647,
        -1.7238989480464433,
    ],
    "UKF": [
        1.158164129693317,
        3.21072336177983,
        -1.7127538054600244,
        0.07058823529411765,
        0.08235294117647068,
        0.1588235294117647,
        -1.7238989480464437,
    ],
    "Kalman": [
        1.1581641296933172,
        3.21072336177983,
        -1.7127538054600242,
        0.07058823529411765,
        0.08235294117647057,
        0.1588235294117647,
        -1.7238989480464433,
    ],
    "etkf": [
        1.0631954731757989,
        3.1579835706936517,
        -1.92375134861917,
        0.05350923823239225,
        0.06330311043878718,
        0.0590726154145921,
        -1.4583697345847595,
    ],
    "sakov": [
        1.0631954731757989,
        3.157983570693652,
        -1.92375134861917,
        0.0647161179031762,
        0.06683092098329461,
        0.06395979336032588,
        -1.4583697345847595,
    ],
}
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
    spread = torch.tensor([[0.3, -0.2, 0.1], [-0.1, 0.4, 0.2], [0.2, 0.1, -0.4], [-0.5, -0.3, 0.3]])
    mean = torch.tensor([1.0, 3.1, -2.0])
    predicted = mean + spread
    predicted[1, 1] -= 6.25  # of all but one member on this side of pi
    cov = torch.diag(torch.tensor([0.2, 0.1, 0.3])) + 0.05
    forecast = {"ensemble": mean + spread, "observation": predicted, "mean": mean, "cov": cov}
    sensor = {"ensemble": torch.tensor([1.2, -3.0, -1.5]), "noise": torch.tensor([0.1, 0.2, 0.3])}
    for space in (Flat(3, circular=[1]), Euclidean(1) * Circle() * Euclidean(1)):
        out = UPDATES[name](space)(TensorDict({"forecast": forecast, "sensor": sensor}))
        found = torch.cat([out["belief", "mean"], out["belief", "var"], out["info", "log_likelihood"]])
        torch.testing.assert_close(found, torch.tensor(STORED[name]), rtol=0, atol=4e-15)


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
