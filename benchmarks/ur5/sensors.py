"""Sensors by name, and their training on single frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor, nn

from benchmarks.common.arm.close_look import CloseLook, GlimpseTrunk
from benchmarks.common.arm.sensors import Statistics, camera_sensor, train_sensor
from benchmarks.common.scores import SensorLoss
from benchmarks.ur5.demos import STATE, FramePool
from torch_denkf.applications.ur5.simulation.domains import SIM, Domain
from torch_denkf.envs import Brightness, SaltAndPepper
from torch_denkf.modules import ImageSensor, KeypointTrunk, SubModel, convolutional_trunk

SAMPLES = 32  # of a sensor while it is trained
MEMBERS = 128  # of the ensemble filters, whose states are 34 numbers; they read as many samples
WRIST = 5  # J6, which turns the gripper
UNDECIDED = 0.3  # length of (cos, sin) of J6 below which a reading leaves to the forecast which half turn it is
SALT = 0.02  # share of white pixels of a frame with salt and pepper, and of black ones
NEAR = ("sensor", "near")  # readings as states, see NearForecast
# What a good sensor leaves: units of all losses. 1.15 degrees; 1.15 degrees of each component; 0.25 cm.
JOINT_UNIT, PLACE_UNIT = 0.02, 0.0025
REACH, RAISE = 0.36, 0.15  # half a patch's side and its shift upwards, in half pictures: hand and wrist
COARSE = 112  # pixels: the side of the picture that the first look gets


def project(places: Tensor, look: Domain = SIM) -> Tensor:
    """Projects places ``[*, 3]`` into a camera's picture: columns and rows ``[*, 2]`` from -1 (left, top) to 1.

    Only where the first looks go follows from it, so that roll and lens are left out.
    """
    camera, target = torch.tensor(look.camera), torch.tensor(look.target)
    ahead = nn.functional.normalize(target - camera, dim=0)
    right = nn.functional.normalize(torch.linalg.cross(ahead, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    up = torch.linalg.cross(right, ahead)
    way = places - camera
    depth = (way @ ahead) * torch.tan(torch.tensor(look.field / 2).deg2rad())
    return torch.stack([way @ right / depth, -(way @ up) / depth], -1)


class Shrink(nn.Module):
    """Averages pixels until a picture is at most :data:`COARSE` wide."""

    def forward(self, images: Tensor) -> Tensor:
        """Returns pictures ``[N, 3, H / n, W / n]``."""
        times = images.shape[-1] // COARSE
        return nn.functional.avg_pool2d(images, times) if times > 1 else images


def keypoint_trunk() -> nn.Module:
    """Returns the coarse trunk of both presets."""
    return nn.Sequential(Shrink(), KeypointTrunk(3, channels=(32, 48, 96, 128), keypoints=64, features=256))


def glimpse_trunk(side: int) -> GlimpseTrunk:
    """Returns the trunk that looks at the gripper in pictures of a side of so many pixels."""
    return GlimpseTrunk(keypoint_trunk(), CloseLook(side, REACH), 256, raised=RAISE)


@torch.no_grad()
def aim(trunk: GlimpseTrunk, images: Tensor, goal: Tensor) -> None:
    """Sets the patch's centre by least squares to what :func:`project` says, ``[N, 2]``."""
    code = torch.cat([trunk.coarse(part) for part in images.split(128)])
    mean = code.mean(0)
    design = torch.cat([code - mean, torch.ones(len(code), 1)], -1).double()
    ridge = 1e-3 * len(code) * torch.eye(design.shape[-1], dtype=torch.double)
    solution = torch.linalg.solve(design.mT @ design + ridge, design.mT @ goal.double()).float()
    trunk.centre.weight.copy_(solution[:-1].mT)
    trunk.centre.bias.copy_(solution[-1] - trunk.centre.weight @ mean)


class TurnedWrist(nn.Module):
    """Encodes what the better sensor reads: J6 by twice its angle, and by the angle itself.

    The fingers look the same after half a turn: a network that must name J6 itself hedges between two answers until it
    sees the label on one side of the hand. Half of (cos, sin) of 2 J6 has one answer, and turns by one radian a radian.
    Which of the two J6 it is say (cos, sin) of J6: short where the picture leaves that open.
    """

    def forward(self, state: Tensor) -> Tensor:
        """Returns readings ``[*, 13]`` of states ``[*, >= 10]``: J1..J5, cos and sin of 2 J6, the opening, x, y, z."""
        once = state[..., WRIST : WRIST + 1]
        wrist = [0.5 * (2 * once).cos(), 0.5 * (2 * once).sin(), once.cos(), once.sin()]
        return torch.cat([state[..., :WRIST], *wrist, state[..., WRIST + 1 : STATE]], -1)


def side_of(reading: Tensor, near: Tensor | None = None) -> Tensor:
    """About where J6 is, ``[*]`` rad, to a quarter turn: what readings ``[*, 13]`` say.

    Args:
        reading: the mean of a sensor's samples.
        near: where J6 is thought to be ``[*]``: decides where the picture does not; ``None`` for the picture alone.
    """
    cos, sin = reading[..., WRIST + 2], reading[..., WRIST + 3]
    if near is None:
        return torch.atan2(sin, cos)
    cos, sin = cos + UNDECIDED * near.cos(), sin + UNDECIDED * near.sin()
    return near + torch.atan2(sin * near.cos() - cos * near.sin(), cos * near.cos() + sin * near.sin())


def wrist_of(reading: Tensor, near: Tensor) -> Tensor:
    """Returns states ``[*, 10]`` from readings ``[*, 13]``; of two J6 half a turn apart the one next to ``near``."""
    angle = torch.atan2(reading[..., WRIST + 1], reading[..., WRIST]) / 2
    angle = angle + torch.pi * ((near - angle) / torch.pi).round()
    return torch.cat([reading[..., :WRIST], angle.unsqueeze(-1), reading[..., WRIST + 4 :]], -1)


def _near(reading: Tensor, near: Tensor | None = None) -> Tensor:
    """Encodes what a sensor reads that reads J6 itself."""
    return reading[..., WRIST] if near is None else near


@dataclass(frozen=True)
class Preset:
    """A sensor, what it should read of a true state, and what state a reading says."""

    name: str
    build: Callable[[Statistics, int], ImageSensor]
    observe: Callable[[Tensor], Tensor]
    dim: int
    state_of: Callable[[Tensor, Tensor], Tensor]  # of a reading, and of a J6 that is near
    side_of: Callable[..., Tensor] = _near  # which J6 is near, of a reading and of a J6 that is thought to be
    coarse: str | None = None  # a preset that is trained first, and whose trunk becomes this one's coarse part


def unit_of(dim: int) -> Tensor:
    """Units of a reading's components: the last three are a place."""
    return torch.cat([torch.full((dim - 3,), JOINT_UNIT), torch.full((3,), PLACE_UNIT)])


def _moments(facts: Statistics) -> tuple[Tensor, Tensor]:
    """Returns the mean and standard deviation of what :class:`TurnedWrist` reads."""
    loc, scale = facts.loc, facts.scale
    middle = torch.zeros(4), torch.tensor([0.35, 0.35, 0.7, 0.7])
    return tuple(
        torch.cat([part[:WRIST], four, part[WRIST + 1 :]]) for part, four in zip((loc, scale), middle, strict=True)
    )


CELLS = (128, 64)


def keypoint_sensor(facts: Statistics, samples: int = SAMPLES) -> ImageSensor:
    """Returns a better network: keypoints and a coarse view, coordinate channels, J6 by twice its angle."""
    head = {"num_cells": CELLS, "layer": "dropout", "rate": 0.05}
    return camera_sensor(facts, keypoint_trunk(), samples, *_moments(facts), **head)


def glimpse_sensor(facts: Statistics, samples: int = SAMPLES) -> ImageSensor:
    """Builds one with a second look at the gripper. Flipout learns how large its noise is; dropout's is what it is."""
    head = {"num_cells": CELLS, "layer": "flipout"}
    return camera_sensor(facts, glimpse_trunk(facts.size[1]), samples, *_moments(facts), **head)


def paper_sensor(facts: Statistics, samples: int = SAMPLES) -> ImageSensor:
    """Returns the paper's: Table I on the frame, which reads all ten numbers of the state."""
    return camera_sensor(facts, convolutional_trunk(3), samples, facts.loc, facts.scale)


_PRESETS = (
    Preset("keypoints", keypoint_sensor, TurnedWrist(), 13, wrist_of, side_of),
    Preset("glimpse", glimpse_sensor, TurnedWrist(), 13, wrist_of, side_of, coarse="keypoints"),
    Preset("paper", paper_sensor, lambda state: state[..., :STATE], STATE, lambda reading, near: reading),
)
SENSORS = {preset.name: preset for preset in _PRESETS}


def adopt(sensor: ImageSensor, coarse: ImageSensor, pool: FramePool, look: Domain = SIM, count: int = 1500) -> None:
    """Gives a sensor with a second look a trained one's trunk, which stays as it is, and aims it at the gripper.

    Args:
        sensor: with a second look.
        coarse: trained.
        pool: frames to aim by, some of them.
        look: the camera that took these.
        count: how many.
    """
    trunk = sensor.module["trunk"]
    trunk.coarse.load_state_dict(coarse.module["trunk"].state_dict())
    trunk.coarse.requires_grad_(False)
    rows = pool.rows(torch.arange(0, len(pool), max(len(pool) // count, 1)))
    aim(trunk, sensor._prepare(rows["pixels"]), project(rows["state"][:, 7:], look))


class NearForecast(SubModel):
    """The sensor's samples as states; of the J6 half a turn apart those on the side that the picture shows.

    What a turned gripper looks like says which two angles are possible. Which of them it is says the mean of the
    samples, see :func:`side_of`, and where that is undecided the forecast's mean. All members take the same, so
    that an ensemble does not split. (Members that compare cosines each for itself do split: those a little more
    than a quarter of a turn off are drawn to the other side, and the mean lies between.)

    Args:
        preset: whose ``state_of`` turns readings into states.
        forecast_key: the forecast's ensemble ``[*B, E, S]``, or mean ``[*B, S]``.
    """

    def __init__(self, preset: Preset, forecast_key: NestedKey = ("forecast", "ensemble")):
        super().__init__(nn.Identity(), [("sensor", "ensemble"), forecast_key], [NEAR])
        self.preset, self.factor = preset, 1.0  # on the samples' distances from their mean

    def compute(self, samples, forecast, *, batch_size):
        """Returns the states ``[*B, E, 10]``."""
        angle = forecast[..., WRIST]
        if angle.ndim > len(batch_size):
            angle = angle.mean(-1)
        near = self.preset.side_of(samples.mean(-2), angle).detach().unsqueeze(-1).expand(samples.shape[:-1])
        states = self.preset.state_of(samples, near)
        if self.factor != 1.0:
            states = torch.lerp(states.mean(-2, keepdim=True), states, self.factor)
        return states


def disturb(frames: TensorDict, generator: torch.Generator, times: int = 1) -> TensorDict:
    """Disturbs training frames as a camera does: a third get salt and pepper, a third another exposure.

    Args:
        frames: with pixels.
        generator: of all draws.
        times: so many rows, and columns, of the camera's were averaged into one: of salt there are as many grains more,
            each as much weaker.
    """
    seed, area = int(torch.randint(2**31, (), generator=generator)), times**2
    own = torch.Generator().manual_seed(seed)
    frames = Brightness((0.85, 1.15), (-0.03, 0.03), p=0.33, generator=own)(frames)
    salted = SaltAndPepper(area * SALT, p=0.33, generator=own)(frames.copy())["pixels"]
    return frames.set("pixels", torch.lerp(frames["pixels"], salted, 1 / area))


def train_preset(
    sensor: ImageSensor, preset: Preset, train: FramePool, held_out: FramePool, times: int = 1, **settings
) -> ImageSensor:
    """Trains a sensor on frames that were shrunk so many times, see :func:`disturb`, and
    :func:`~benchmarks.common.arm.sensors.train_sensor`.
    """
    terms = {"loss_joints": slice(-3), "loss_place": slice(-3, None)}
    loss = SensorLoss(sensor, lambda frames: preset.observe(frames["state"]), unit_of(preset.dim), terms)
    sample = lambda generator: disturb(train.sample(generator, 64), generator, times)  # noqa: E731
    return train_sensor(sensor, loss, sample, held_out, weight_decay=0.02, **settings)
