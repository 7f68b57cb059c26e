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

SAMPLES = 32  # of a sensor in training
MEMBERS = 128  # of the ensemble filters, whose states have dimension 34; they read as many samples
WRIST = 5  # J6, which turns the gripper
UNDECIDED = 0.3  # length of (cos, sin) of J6 in a reading below which the forecast decides the half turn
SALT = 0.02  # share of white pixels of a frame with salt and pepper, and of black ones
NEAR = ("sensor", "near")  # readings as states, see NearForecast
# Units of all losses, the errors of a good sensor: 1.15 degrees for each angle; 0.25 cm.
JOINT_UNIT, PLACE_UNIT = 0.02, 0.0025
REACH, RAISE = 0.36, 0.15  # half a patch's side and its shift upwards, in half images: hand and wrist
COARSE = 112  # pixels: the side of the coarse part's input


def project(places: Tensor, look: Domain = SIM) -> Tensor:
    """Projects places ``[*, 3]`` into a camera's image: columns and rows ``[*, 2]`` from -1 (left, top) to 1.

    Roll and lens are neglected, because only the initial place of the patch depends on it.
    """
    camera, target = torch.tensor(look.camera), torch.tensor(look.target)
    ahead = nn.functional.normalize(target - camera, dim=0)
    right = nn.functional.normalize(torch.linalg.cross(ahead, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    up = torch.linalg.cross(right, ahead)
    way = places - camera
    depth = (way @ ahead) * torch.tan(torch.tensor(look.field / 2).deg2rad())
    return torch.stack([way @ right / depth, -(way @ up) / depth], -1)


class Shrink(nn.Module):
    """Downsamples images to a width of about :data:`COARSE` by averaging."""

    def forward(self, images: Tensor) -> Tensor:
        """Returns images ``[N, 3, H / n, W / n]``."""
        times = images.shape[-1] // COARSE
        return nn.functional.avg_pool2d(images, times) if times > 1 else images


def keypoint_trunk() -> nn.Module:
    """Returns the coarse trunk of both presets."""
    return nn.Sequential(Shrink(), KeypointTrunk(3, channels=(32, 48, 96, 128), keypoints=64, features=256))


def glimpse_trunk(side: int) -> GlimpseTrunk:
    """Returns the trunk with a patch around the gripper, for images with ``side`` pixels along a side."""
    return GlimpseTrunk(keypoint_trunk(), CloseLook(side, REACH), 256, raised=RAISE)


@torch.no_grad()
def aim(trunk: GlimpseTrunk, images: Tensor, goal: Tensor) -> None:
    """Fits the patch's centre by least squares to goals ``[N, 2]``, such as those of :func:`project`."""
    code = torch.cat([trunk.coarse(part) for part in images.split(128)])
    mean = code.mean(0)
    design = torch.cat([code - mean, torch.ones(len(code), 1)], -1).double()
    ridge = 1e-3 * len(code) * torch.eye(design.shape[-1], dtype=torch.double)
    solution = torch.linalg.solve(design.mT @ design + ridge, design.mT @ goal.double()).float()
    trunk.centre.weight.copy_(solution[:-1].mT)
    trunk.centre.bias.copy_(solution[-1] - trunk.centre.weight @ mean)


class TurnedWrist(nn.Module):
    """Encodes a state as a reading: J6 by twice its angle, and by the angle itself.

    The fingers look the same after half a turn: a network that predicts J6 itself averages between two solutions unless
    it sees the label on one side of the hand. Half of (cos, sin) of 2 J6 is unique. (cos, sin) of J6 resolves the half
    turn; predictions of it are short if the image is ambiguous.
    """

    def forward(self, state: Tensor) -> Tensor:
        """Returns readings ``[*, 13]`` of states ``[*, >= 10]``: J1..J5, cos and sin of 2 J6, the opening, x, y, z."""
        once = state[..., WRIST : WRIST + 1]
        wrist = [0.5 * (2 * once).cos(), 0.5 * (2 * once).sin(), once.cos(), once.sin()]
        return torch.cat([state[..., :WRIST], *wrist, state[..., WRIST + 1 : STATE]], -1)


def side_of(reading: Tensor, near: Tensor | None = None) -> Tensor:
    """Returns J6, ``[*]`` rad, to within a quarter turn, from readings ``[*, 13]``.

    Args:
        reading: the mean of a sensor's samples.
        near: a prior estimate of J6 ``[*]``, which decides ambiguous readings; ``None`` for the reading alone.
    """
    cos, sin = reading[..., WRIST + 2], reading[..., WRIST + 3]
    if near is None:
        return torch.atan2(sin, cos)
    cos, sin = cos + UNDECIDED * near.cos(), sin + UNDECIDED * near.sin()
    return near + torch.atan2(sin * near.cos() - cos * near.sin(), cos * near.cos() + sin * near.sin())


def wrist_of(reading: Tensor, near: Tensor) -> Tensor:
    """Returns states ``[*, 10]`` from readings ``[*, 13]``, with the solution of J6 that is closest to ``near``."""
    angle = torch.atan2(reading[..., WRIST + 1], reading[..., WRIST]) / 2
    angle = angle + torch.pi * ((near - angle) / torch.pi).round()
    return torch.cat([reading[..., :WRIST], angle.unsqueeze(-1), reading[..., WRIST + 4 :]], -1)


def _near(reading: Tensor, near: Tensor | None = None) -> Tensor:
    """Returns ``near``, or J6 of readings that include J6 itself."""
    return reading[..., WRIST] if near is None else near


@dataclass(frozen=True)
class Preset:
    """A sensor, with the maps from a true state to its reading and back."""

    name: str
    build: Callable[[Statistics, int], ImageSensor]
    observe: Callable[[Tensor], Tensor]
    dim: int
    state_of: Callable[[Tensor, Tensor], Tensor]  # from a reading, and an estimate of J6
    side_of: Callable[..., Tensor] = _near  # estimate of J6 from a reading and a prior estimate
    coarse: str | None = None  # a preset that is trained first, and whose trunk becomes this one's coarse part


def unit_of(dim: int) -> Tensor:
    """Returns the units of a reading's components, of which the last three are a place."""
    return torch.cat([torch.full((dim - 3,), JOINT_UNIT), torch.full((3,), PLACE_UNIT)])


def _moments(facts: Statistics) -> tuple[Tensor, Tensor]:
    """Returns mean and standard deviation of the readings of :class:`TurnedWrist`."""
    loc, scale = facts.loc, facts.scale
    middle = torch.zeros(4), torch.tensor([0.35, 0.35, 0.7, 0.7])
    return tuple(
        torch.cat([part[:WRIST], four, part[WRIST + 1 :]]) for part, four in zip((loc, scale), middle, strict=True)
    )


CELLS = (128, 64)


def keypoint_sensor(facts: Statistics, samples: int = SAMPLES) -> ImageSensor:
    """Returns a sensor with keypoints, a coarse view and coordinate channels, which reads J6 by twice its angle."""
    head = {"num_cells": CELLS, "layer": "dropout", "rate": 0.05}
    return camera_sensor(facts, keypoint_trunk(), samples, *_moments(facts), **head)


def glimpse_sensor(facts: Statistics, samples: int = SAMPLES) -> ImageSensor:
    """Returns a sensor with a patch around the gripper, and a flipout head, whose noise is learned."""
    head = {"num_cells": CELLS, "layer": "flipout"}
    return camera_sensor(facts, glimpse_trunk(facts.size[1]), samples, *_moments(facts), **head)


def paper_sensor(facts: Statistics, samples: int = SAMPLES) -> ImageSensor:
    """Returns the paper's sensor: Table I on the frame, which reads all ten components of the state."""
    return camera_sensor(facts, convolutional_trunk(3), samples, facts.loc, facts.scale)


_PRESETS = (
    Preset("keypoints", keypoint_sensor, TurnedWrist(), 13, wrist_of, side_of),
    Preset("glimpse", glimpse_sensor, TurnedWrist(), 13, wrist_of, side_of, coarse="keypoints"),
    Preset("paper", paper_sensor, lambda state: state[..., :STATE], STATE, lambda reading, near: reading),
)
SENSORS = {preset.name: preset for preset in _PRESETS}


def adopt(sensor: ImageSensor, coarse: ImageSensor, pool: FramePool, look: Domain = SIM, count: int = 1500) -> None:
    """Copies a trained trunk into a sensor with a patch, freezes it, and aims the patch at the gripper.

    Args:
        sensor: with a patch.
        coarse: the trained sensor.
        pool: frames, some of which are used to aim.
        look: the camera of these frames.
        count: number of frames.
    """
    trunk = sensor.module["trunk"]
    trunk.coarse.load_state_dict(coarse.module["trunk"].state_dict())
    trunk.coarse.requires_grad_(False)
    rows = pool.rows(torch.arange(0, len(pool), max(len(pool) // count, 1)))
    aim(trunk, sensor._prepare(rows["pixels"]), project(rows["state"][:, 7:], look))


class NearForecast(SubModel):
    """Maps the sensor's samples to states, and resolves the half turn of J6.

    The image of a turned gripper has two solutions. The mean of the samples selects one, see :func:`side_of`, or the
    forecast's mean if the samples are ambiguous. All members use the same solution, so that an ensemble does not split.
    (If each member chose by itself, those with errors above a quarter turn would choose the other solution, and the
    mean would lie between.)

    Args:
        preset: with ``state_of``, which maps readings to states.
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
    """Augments training frames: a third get salt and pepper, a third another exposure.

    Args:
        frames: with pixels.
        generator: of all draws.
        times: downsampling factor of rows and columns: salt has ``times**2`` as many grains, each weaker by the same.
    """
    seed, area = int(torch.randint(2**31, (), generator=generator)), times**2
    own = torch.Generator().manual_seed(seed)
    frames = Brightness((0.85, 1.15), (-0.03, 0.03), p=0.33, generator=own)(frames)
    salted = SaltAndPepper(area * SALT, p=0.33, generator=own)(frames.copy())["pixels"]
    return frames.set("pixels", torch.lerp(frames["pixels"], salted, 1 / area))


def train_preset(
    sensor: ImageSensor, preset: Preset, train: FramePool, held_out: FramePool, times: int = 1, **settings
) -> ImageSensor:
    """Trains a sensor on frames that were downsampled by ``times``, see :func:`disturb`, and
    :func:`~benchmarks.common.arm.sensors.train_sensor`.
    """
    terms = {"loss_joints": slice(-3), "loss_place": slice(-3, None)}
    loss = SensorLoss(sensor, lambda frames: preset.observe(frames["state"]), unit_of(preset.dim), terms)
    sample = lambda generator: disturb(train.sample(generator, 64), generator, times)  # noqa: E731
    return train_sensor(sensor, loss, sample, held_out, weight_decay=0.02, **settings)
