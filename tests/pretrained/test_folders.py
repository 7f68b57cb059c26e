"""Filters by name and from folders: what is saved comes back; what is damaged, changed or unknown is named."""

import hashlib
import inspect
import json
import shutil
from dataclasses import asdict, is_dataclass

import pytest
import torch
from tensordict import TensorDict

from torch_denkf import available, from_pretrained, save_pretrained
from torch_denkf._registered import weights
from torch_denkf.applications.car.odometry.checkpoint import load_car_filter
from torch_denkf.applications.reacher import reacher
from torch_denkf.applications.ur5.filter import ur5_table
from torch_denkf.filters import DEnKF, KalmanFilter
from torch_denkf.modules import (
    ConstantNoise,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedObservation,
    LearnedTransition,
    StochasticMLP,
)


def readings(seed=0):
    generator = torch.Generator().manual_seed(seed)
    shapes = {"encoder": (2,), "action": (2,)}
    return TensorDict({key: torch.rand(3, 6, *shape, generator=generator) for key, shape in shapes.items()}, [3, 6])


def believe(model):
    torch.manual_seed(1)
    return model.sequence(readings())["belief", "ensemble"]


def copy_of(name, folder):
    shutil.copytree(weights()[name], folder / name)
    return folder / name


@pytest.mark.parametrize("name", available())
def test_each_comes_with_its_checksum_and_a_card(name):
    config = json.loads((weights()[name] / "config.json").read_text())
    assert config["sha256"] == hashlib.sha256((weights()[name] / "weights.safetensors").read_bytes()).hexdigest()
    assert config["training"]["command"].split()[0] in ("denkf", "python")
    card = (weights()[name] / "card.md").read_text()
    assert config["training"]["command"] in card
    for heading in ("## Data", "## Training", "## Scores", "## Limits", "## Licence"):
        assert heading in card
    model = from_pretrained(name)
    assert not model.training
    assert {type(value) for value in config["settings"].values()} <= {bool, int, float, list, str, type(None)}


@pytest.mark.parametrize("name", available())
def test_settings_are_those_of_the_description(name, tmp_path):
    """Loads all pretrained filters, and one whose builder is the user's."""
    described = json.loads((weights()[name] / "config.json").read_text())["settings"]
    settings = from_pretrained(name).settings
    found = asdict(settings) if is_dataclass(settings) else dict(settings)
    assert json.loads(json.dumps(found)) | described == json.loads(json.dumps(found))
    again = from_pretrained(save_pretrained(from_pretrained(name), tmp_path))
    assert again.settings == settings


def test_saved_filter_round_trip(tmp_path):
    torch.manual_seed(0)
    model = reacher(ensemble_size=8, num_cells=(8,))
    save_pretrained(model, tmp_path, training={"seed": 0}, card="a card")
    again = from_pretrained(tmp_path)
    assert again.settings == model.settings
    assert torch.equal(believe(model), believe(again))
    assert (tmp_path / "card.md").read_text() == "a card"
    arm = ur5_table(ensemble_size=8)
    arm.inflation = 1.25  # chosen after the training
    assert from_pretrained(save_pretrained(arm, tmp_path)).inflation == 1.25


def test_the_same_folder_serves_both_loaders(tmp_path):
    folder = copy_of("car-odometry", tmp_path)
    by_name, by_folder, car = from_pretrained("car-odometry"), from_pretrained(folder), load_car_filter(folder)
    assert by_name.settings == by_folder.settings == car.settings
    for name, value in car.state_dict().items():
        assert torch.equal(value, by_name.state_dict()[name])
    with pytest.raises(ValueError, match="is of a filter that 'reacher' builds; expected 'car'"):
        load_car_filter(copy_of("reacher", tmp_path))


def test_own_builders(tmp_path):
    def still(size):
        eye = torch.eye(size)
        return KalmanFilter(eye, eye, process_noise_cov=eye, noise_cov=eye, mean=torch.zeros(size), cov=eye)

    with pytest.raises(ValueError, match=r"not known what builds this KalmanFilter; pass builder=FUNCTION"):
        save_pretrained(still(2), tmp_path)
    save_pretrained(still(2), tmp_path, builder=still, settings={"size": 2})
    with pytest.raises(ValueError, match="is of a filter that 'still' builds"):
        from_pretrained(tmp_path)
    again = from_pretrained(tmp_path, builders={"still": still})
    assert isinstance(again, KalmanFilter)
    assert again.settings == {"size": 2}
    with pytest.raises(TypeError, match="JSON"):
        save_pretrained(still(2), tmp_path / "none", builder=still, settings={"size": torch.ones(1)})
    assert not (tmp_path / "none").exists()


def ball(members=8, scheme="perturbed", std=0.5, gain=1.0, key="camera"):
    """Returns a filter each of whose settings changes its belief or its inputs."""
    return DEnKF(
        LearnedTransition(StochasticMLP(2, 2, (8,))),
        None,
        LearnedObservation(lambda state: gain * state[..., [0]]),
        ConstantNoise([std], in_key=key),
        EnsembleAnalysis(scheme, observation_key=key),
        initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=members),
        process_noise=0.1,
    )


CHANGED = {"members": 32, "scheme": "etkf", "std": 0.25, "gain": 2.0, "key": "lidar"}


@pytest.mark.parametrize("name", CHANGED)
def test_settings_that_build_another_filter_raise(tmp_path, name):
    torch.manual_seed(0)
    model, settings = ball(), {name: CHANGED[name]}
    stored = name == "std"  # a number in a buffer comes back with the weights
    if not stored:
        with pytest.raises(ValueError, match=rf"ball\({name}=.*\) builds another model than the one to be stored"):
            save_pretrained(model, tmp_path, builder=ball, settings=settings)
        assert list(tmp_path.iterdir()) == []
        settings = {name: inspect.signature(ball).parameters[name].default}
    save_pretrained(model, tmp_path, builder=ball, settings=settings)
    again = from_pretrained(tmp_path, builders={"ball": ball})
    frames = TensorDict({"camera": torch.randn(3, 6, 1)}, [3, 6])
    frames = model.draw_noise(frames)  # one noise for both
    believed, expected = (filter.sequence(frames.copy())["belief", "ensemble"] for filter in (again, model))
    assert torch.equal(believed, expected)


def test_differences_are_named_and_saving_keeps_the_random_state(tmp_path):
    model = ball()
    with pytest.raises(ValueError, match=r"initial.ensemble_size is 8, built: 32"):
        save_pretrained(model, tmp_path, builder=ball, settings={"members": 32})
    with pytest.raises(ValueError, match=r"transition.* is torch.float64 .*, built: torch.float32"):
        save_pretrained(ball().double(), tmp_path, builder=ball, settings={})
    changed = ball()
    changed["analysis"].inflation = 1.1
    with pytest.raises(ValueError, match=r"\.inflation is 1.1, built: 1.0"):
        save_pretrained(changed, tmp_path, builder=ball, settings={})
    with pytest.raises(TypeError, match="a function with a name"):
        save_pretrained(model, tmp_path, builder=lambda: ball(), settings={})
    torch.manual_seed(3)
    save_pretrained(model.compile(), tmp_path, builder=ball, settings={})
    after = torch.rand(3)
    torch.manual_seed(3)
    assert torch.equal(torch.rand(3), after)
