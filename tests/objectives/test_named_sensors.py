"""Losses of a filter of several sensors: each by its name, with its own mask, noise and observation model."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn

from tests.filters.factories import NoisyLinear
from torch_denkf.filters import EKF, DEnKF
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.modules import ConstantNoise, GaussianPrior, LearnedTransition, MomentPrior, Select
from torch_denkf.monitoring import BlackIsMissing
from torch_denkf.objectives import DEnKFLoss, GaussianLoss, ObservationLoss, SensorLoss
from torch_denkf.submodel import Sensor

B, T, MEMBERS = 2, 5, 4
NOISE = 0.5


@pytest.fixture(autouse=True)
def _double(float64):
    return


class Camera(Sensor):
    """Reads the mean of a picture times two, plus a tenth: wrong where it shows nothing."""

    def __init__(self, out_key=("sensor", "ensemble"), image_key="pixels"):
        super().__init__(nn.Linear(1, 1), [image_key], [out_key])
        nn.init.constant_(self.module.weight, 2.0)
        nn.init.constant_(self.module.bias, 0.1)

    def compute(self, pixels):
        reading = self.module(pixels.flatten(-3).mean(-1, keepdim=True)).unsqueeze(-2)
        return reading.expand(*reading.shape[:-2], MEMBERS, 1)


def camera(**keys):
    return TensorDictSequential(BlackIsMissing(**({"image_key": keys["image_key"]} if keys else {})), Camera(**keys))


def start(gaussian):
    return MomentPrior([0.0, 0.0], torch.eye(2)) if gaussian else GaussianPrior([0, 0], [1, 1], ensemble_size=MEMBERS)


def fused(kind, *, lidar=False, **options):
    """Returns a state of two components: a wheel, whose model comes first, reads the second, and a camera the first."""
    sensors = {"wheel": FusedSensor(Select([1]), [0.3]), "camera": FusedSensor(Select([0]), [NOISE], sensor=camera())}
    if lidar:
        sensors["lidar"] = FusedSensor(Select([1]), [0.2], sensor=camera(image_key="scan"))
    motion = LearnedTransition(nn.Linear(2, 2), residual=True)
    return FusedFilter(motion, sensors, initial=start(kind == "gaussian"), process_noise=[0.1, 0.1], **options)


def data():
    torch.manual_seed(3)
    drive = TensorDict({"pixels": torch.rand(B, T, 1, 2, 2), "state": torch.randn(B, T, 2)}, [B, T])
    drive["pixels"][:, ::2] = 0
    drive["scan"], drive["wheel"] = torch.rand(B, T, 1, 2, 2), torch.randn(B, T, 1)
    return drive


def off(drive, component=0, key="pixels"):
    """Returns errors of a camera's readings, in the pictures that show anything."""
    error = 2 * drive[key].flatten(-3).mean(-1) + 0.1 - drive["state"][..., component]
    return error[drive[key].flatten(-3).amax(-1) > 0.02]


NAMES = ["camera", ("sensor", "camera", "ensemble"), None]


@pytest.mark.parametrize("name", NAMES, ids=str)
@pytest.mark.parametrize("options", [{}, {"joint": True}, {"prefix": "car"}, {"lag": 1}], ids=str)
@pytest.mark.parametrize("kind", ["gaussian", "ensemble"])
def test_pictures_that_show_nothing_do_not_train_the_camera(kind, options, name):
    filter, drive = fused(kind, **options), data()
    whole = (GaussianLoss if kind == "gaussian" else DEnKFLoss)(filter)
    alone = SensorLoss(filter, noise=1.0)
    for loss in (whole, alone):
        loss.set_keys(sensor=name)
        value = loss(drive)
        torch.testing.assert_close(value["loss_sensor"], off(drive).abs().mean())
        value["loss_sensor"].backward()
        gradient = filter["camera_sensor"].get_submodule("module.module.1.module").bias.grad
        torch.testing.assert_close(gradient, off(drive).sign().mean().unsqueeze(0))
        filter.zero_grad()
    nll = -torch.distributions.Normal(0.0, NOISE).log_prob(off(drive)).mean()
    torch.testing.assert_close(alone(drive)["loss_noise"], nll)
    assert alone.in_keys == ["pixels", "state"]


@pytest.mark.parametrize("kind", ["gaussian", "ensemble"])
def test_each_of_several_learned_sensors_is_named(kind):
    filter, drive = fused(kind, lidar=True), data()
    loss = (GaussianLoss if kind == "gaussian" else DEnKFLoss)(filter)
    for name, component, key in (("lidar", 1, "scan"), ("camera", 0, "pixels")):
        loss.set_keys(sensor=name)
        torch.testing.assert_close(loss(drive)["loss_sensor"], off(drive, component, key).abs().mean())
    loss.set_keys(sensor=None)
    for several in (loss, SensorLoss(filter)):
        none = r"several sensors, of which none is selected \(there are \['camera', 'lidar'\]\).*set_keys\(sensor="
        with pytest.raises(KeyError, match=none):
            several(drive)
        with pytest.raises(KeyError, match=r"writes the samples .*'lidar'.*: select one of several sensors"):
            several(drive.copy().set("target_observation", drive["wheel"]))


def test_the_observation_model_is_that_of_the_sensor():
    drive = data()
    loss = ObservationLoss(fused("ensemble"))
    loss.set_keys(sensor="wheel")
    drive["target_observation"] = drive["state"][..., 1:] + 2
    with pytest.raises(KeyError, match=r"several sensors: select one, set_keys\(sensor="):
        ObservationLoss(fused("ensemble", lidar=True))(drive)
    torch.testing.assert_close(loss(drive)["loss_observation"], torch.tensor(4.0))


@pytest.mark.parametrize("score", ["SensorLoss", "whole"])
@pytest.mark.parametrize("kind", [EKF, DEnKF])
def test_a_filter_of_one_sensor_with_keys_of_its_own(kind, score):
    """The mask is the one that its update reads, the samples are those that its sensor writes."""
    drive, gaussian = data(), kind is EKF
    sensor = TensorDictSequential(BlackIsMissing(), Camera(("eye", "ensemble")))
    parts = {"transition": NoisyLinear(torch.eye(2)), "sensor": sensor, "observation": Select([0])}
    noise = ConstantNoise([NOISE], in_key=("eye", "ensemble"))
    filter = kind(**parts, noise=noise, initial=start(gaussian), observed_key="seen", process_noise=[0.1, 0.1])
    loss = SensorLoss(filter) if score == "SensorLoss" else (GaussianLoss if gaussian else DEnKFLoss)(filter)
    torch.testing.assert_close(loss(drive)["loss_sensor"], off(drive).abs().mean())


def test_missing_entry_is_named_with_the_available_ones():
    loss = SensorLoss(fused("ensemble", lidar=True))
    loss.set_keys(sensor="lidar")
    with pytest.raises(KeyError, match=r"SensorLoss reads 'scan', which is missing. There is .*scans"):
        loss(data().rename_key_("scan", "scans"))
