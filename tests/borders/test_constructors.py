"""Arguments of constructors that depend on others, and arguments, weights and covariances that are right."""

import copy
import pickle
from functools import partial

import pytest
import torch
from tensordict import TensorDict

from benchmarks.common.lorenz96 import lorenz96_step
from benchmarks.reliability.damage import INF, NAN, put
from benchmarks.reliability.documents import edited
from tests.borders.models import signed
from tests.filters.factories import linear_denkf, linear_kalman
from tests.filters.gaussian_for_tests import linear_filter
from torch_denkf.applications.car import UnicycleMotion, track
from torch_denkf.applications.car.odometry.evaluation import evaluate_car_filter
from torch_denkf.applications.car.odometry.training import train_car_filter
from torch_denkf.baselines.lstm_cell import LSTMUpdate
from torch_denkf.deployment.folder import WEIGHTS, load_folder, save_folder
from torch_denkf.filters import DEnKF, KalmanFilter
from torch_denkf.functional.manifolds import Circle, Flat
from torch_denkf.imperfect import FadingBias
from torch_denkf.modules import DiagonalNoise, GaussianPrior, MomentPrior, Select
from torch_denkf.objectives import GaussianLoss, TransitionLoss

EYE, ZERO, ONE = torch.eye(2), torch.zeros(2), torch.ones(2)
PARTS = {"transition": EYE, "process_noise_cov": EYE, "observation": EYE, "noise_cov": EYE, "mean": ZERO, "cov": EYE}


def message_of(make, *words, error=ValueError):
    """Returns the message of what is raised; it holds these words."""
    with pytest.raises(error) as caught:
        make()
    message = str(caught.value)
    missing = [word for word in words if word not in message]
    assert not missing, message
    return message


@pytest.mark.parametrize(
    ("noises", "words"),
    [({"process_noise": [1.0], "noise": [1.0, 1.0]}, "not both"), ({}, "Give noise, standard deviations")],
)
def test_noises_of_a_kalman_filter(noises, words):
    parts = {name: value for name, value in PARTS.items() if name != "noise_cov"}
    with pytest.raises(ValueError, match=words):
        KalmanFilter(**parts, **noises)


KALMAN = partial(KalmanFilter, **PARTS)
WRONG = {
    "circular": (lambda: Flat(2, circular=[-1]), "circular", "got -1"),
    "a space of fewer": (lambda: KALMAN(reading_space=Circle()), "reading_space", "2 rows of matrix"),
    "no double": (lambda: DiagonalNoise(2, r=0.1, floor=0.02), "r^2 - floor of DiagonalNoise", "-0.0"),
    "endless layers": (lambda: LSTMUpdate(2, features=2, num_layers=2**63), "num_layers", "at most 1000", f"{2**63}"),
    "dt": (lambda: UnicycleMotion(torch.tensor(0.1)), "dt", "Tensor"),
    "error of a sensor": (lambda: KALMAN(sensor_error=1.0), "sensor_error is a FadingBias", "float"),
    "a class": (lambda: KALMAN(sensor_error=FadingBias), "sensor_error is a FadingBias", "FadingBias"),
    "visibility": (lambda: linear_filter("UKF", visibility=Select([0])), "visibility is a Visibility", "Select"),
    "step": (lambda: lorenz96_step(torch.zeros(4), dt=-0.05), "dt", "got -0.05"),
    "two clocks": (lambda: list(track(None, [], (1, 1, 1, 1), times=[0.0], fps=10)), "pass times or fps, not both"),
    "pitch": (lambda: evaluate_car_filter(None, "nowhere", ["00"], pitch=NAN), "pitch", "got nan"),
    "no root": (lambda: train_car_filter("out", rendered=3, leave_out=["09"]), "{'leave_out': ['09']}", "--root"),
}
WRONG_TYPES = ("dt", "error of a sensor", "a class", "visibility")


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_argument_is_named(name):
    """The message begins with the argument's name, and has its value."""
    make, *words = WRONG[name]
    assert message_of(make, *words, error=TypeError if name in WRONG_TYPES else ValueError).startswith(words[0])


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_covariances_that_are_right_pass(scale, dtype):
    """Accepts covariances of any unit, singular, and with the rounding of a product in their own precision."""
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(6, 3, generator=generator, dtype=dtype) * torch.logspace(-3, 3, 6, dtype=dtype).unsqueeze(-1)
    cov = scale * (root @ root.mT)
    assert MomentPrior(cov[0], cov).cov.equal(cov)
    one = torch.eye(6, dtype=dtype)
    KalmanFilter(one, one, process_noise_cov=0 * one, noise_cov=0 * cov, mean=cov[0], cov=cov)


def test_constants_without_values_pass():
    """On "meta" there is nothing to look at; a copy, a pickle and a state dict are not checked again."""
    with torch.device("meta"):
        prior = GaussianPrior([0.0], [1.0], ensemble_size=4)
        DEnKF.paper(state_dim=3, observation_dim=2)
        KalmanFilter(**{name: value.to("meta") for name, value in PARTS.items()})
    assert prior.std.is_meta
    kf = KalmanFilter(**PARTS)
    for other in (copy.deepcopy(kf), pickle.loads(pickle.dumps(kf))):
        assert other.state_dict().keys() == kf.state_dict().keys()
        td = other.initialise(TensorDict({"observation": ONE}))
        assert other.step(td.clone())["belief", "mean"].equal(kf.step(td.clone())["belief", "mean"])


def test_a_scale_of_one_number_and_one_member_for_the_mean_pass():
    batch = TensorDict({"observation": torch.zeros(2, 3, 2), "state": torch.zeros(2, 3, 2)}, [2, 3])
    losses = [GaussianLoss(linear_kalman(), sensor=0.0, state_scale=scale)(batch) for scale in ([2.0], [2.0, 2.0])]
    assert torch.equal(*(loss["loss_state"] for loss in losses))
    one_step = TransitionLoss(linear_denkf("etkf"), members=1, score="mse")
    assert one_step(batch)["loss_transition"].isfinite()


@pytest.mark.parametrize("change", [lambda value: value + INF, lambda value: value.long(), lambda value: value * NAN])
@pytest.mark.parametrize("name", ["weight", "constant"])
def test_weights_of_another_kind(tmp_path, name, change):
    def build():
        model = torch.nn.Linear(2, 2)
        model.register_buffer("constant", torch.ones(2))
        model.register_buffer("hidden", torch.tensor([1.0, INF]))
        return model

    save_folder(build(), tmp_path, builder="line", settings={})
    load_folder(tmp_path, {"line": build})  # where what is built is infinite, what is stored may be
    signed(edited(put(name, change)))(tmp_path / WEIGHTS)
    with pytest.raises(ValueError, match=rf"{WEIGHTS} holds NaN, infinity or whole numbers in \['{name}'\]"):
        load_folder(tmp_path, {"line": build})
