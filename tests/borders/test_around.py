"""Arguments of cars, replays and saved folders: the message names the argument and has its value."""

import hashlib
import json
import math

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from benchmarks.common.lorenz96 import lorenz96_step
from tests.borders.test_constructors import NAN, refuses
from tests.filters.factories import linear_denkf, linear_kalman
from torch_denkf.applications.car.odometry.evaluation import evaluate_car_filter
from torch_denkf.applications.car.odometry.training import train_car_filter
from torch_denkf.deployment.folder import WEIGHTS, described, load_folder, save_folder
from torch_denkf.objectives import GaussianLoss, TransitionLoss

INF = math.inf


def scored(make, **options):
    """A loss of a batch of two dimensions."""
    loss = make(**options)
    return loss(TensorDict({"observation": torch.zeros(2, 3, 2), "state": torch.zeros(2, 3, 2)}, [2, 3]))


def gaussian_loss(**options):
    return GaussianLoss(linear_kalman(), sensor=0.0, **options)


def one_step(**options):
    return TransitionLoss(linear_denkf("etkf"), **options)


def test_a_scale_of_one_number_and_one_member_for_the_mean_pass():
    one, two = (scored(gaussian_loss, state_scale=scale)["loss_state"] for scale in ([2.0], [2.0, 2.0]))
    assert torch.equal(one, two)
    assert scored(one_step, members=1, score="mse")["loss_transition"].isfinite()


REFUSED = {
    "step": (lambda: lorenz96_step(torch.zeros(4), dt=-0.05), "dt", "got -0.05"),
    "pitch": (lambda: evaluate_car_filter(None, "nowhere", ["00"], pitch=NAN), "pitch", "got nan"),
    "no root": (lambda: train_car_filter("out", rendered=3, leave_out=["09"]), "{'leave_out': ['09']}", "--root"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED)
def test_refused(case):
    refuses(*case)


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
    weights = load_file(tmp_path / WEIGHTS)
    broken = build()
    weights[name] = change(weights[name])
    save_folder(broken, tmp_path, builder="line", settings={})
    save_file(weights, tmp_path / WEIGHTS)
    config = (tmp_path / "config.json").read_text()
    again = {**json.loads(config), "sha256": hashlib.sha256((tmp_path / WEIGHTS).read_bytes()).hexdigest()}
    (tmp_path / "config.json").write_text(described(again))
    with pytest.raises(ValueError, match=rf"{WEIGHTS} holds NaN, infinity or whole numbers in \['{name}'\]"):
        load_folder(tmp_path, {"line": build})
