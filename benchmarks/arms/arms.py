"""The arms: their geometry, controller and sensors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Binary, Unbounded
from torchrl.envs import Compose, DoubleToFloat, GrayScale, SerialEnv, ToTensorImage, TransformedEnv
from torchrl.envs.libs.dm_control import DMControlWrapper
from torchrl.envs.transforms import ObservationTransform, Transform

SIDE, FINE = 64, 2  # pixels along an image's side, and rendered pixels along a side of each
NOISE = 0.1  # rad


def wrap(angle: Tensor) -> Tensor:
    """Wraps an angle into [-pi, pi)."""
    return torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi


@dataclass
class Arm:
    """Parameters and geometry of an arm; its state is the joints' cosines, sines and velocities ``[3 J]``."""

    domain: str
    task: str
    links: tuple[float, ...]  # m
    dt: float  # s
    actions: int
    stiffness: float  # of the controller: action per rad
    damping: float  # action per rad/s
    torques: tuple[float, ...]  # of full actions, N m
    view: float  # half the width of an image, whose middle is the root, m
    creep: float  # noise of an angle in a step, for unmodelled contacts: floor, objects in the hand; rad
    ahead: float = 0.0  # direction of the links if all angles are 0, rad
    weights: tuple[float, ...] = (0.0, 0.0)  # gravity torque of each link and its load, when it lies flat, N m

    @property
    def joints(self) -> int:
        return len(self.links)

    def state(self, emitted: TensorDictBase) -> Tensor:
        if self.domain == "reacher":
            return self.join(emitted["position"], emitted["velocity"])
        sin_cos = emitted["arm_pos"][..., : self.joints, :]
        return torch.cat([sin_cos[..., 1], sin_cos[..., 0], emitted["arm_vel"][..., : self.joints]], -1)

    def join(self, angles: Tensor, velocity: Tensor) -> Tensor:
        return torch.cat([angles.cos(), angles.sin(), velocity], -1)

    def split(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Returns angles in (-pi, pi] and velocities; a sensor's errors may follow in the state."""
        cos, sin, velocity = state[..., : 3 * self.joints].split(self.joints, -1)
        return torch.atan2(sin, cos), velocity

    def places(self, angles: Tensor) -> Tensor:
        """Returns the links' ends at angles ``[*, J]``, from the root, in the plane of motion, m ``[*, J, 2]``."""
        turned, links = self.ahead + angles.cumsum(-1), torch.tensor(self.links)
        return torch.stack([links * turned.cos(), links * turned.sin()], -1).cumsum(-2)

    def angles(self, places: Tensor) -> Tensor:
        """Returns the angles, in [-pi, pi), of links of any length that end at ``places``."""
        x, y = torch.cat([places[..., :1, :], places.diff(dim=-2)], -2).unbind(-1)
        turned = torch.atan2(y, x) - self.ahead
        return wrap(torch.cat([turned[..., :1], turned.diff(dim=-1)], -1))

    def tip(self, angles: Tensor) -> Tensor:
        """Returns the end of the last link, m ``[*, 2]``."""
        return self.places(angles)[..., -1, :]

    def goal(self, emitted: TensorDictBase) -> Tensor:
        """Returns the goal of the joint angles at the start of an episode."""
        angles = self.split(self.state(emitted))[0]
        if self.domain != "reacher":  # upright, away from floor and walls
            return 1.6 * torch.rand_like(angles) - 0.8
        a, b = self.links
        target = self.tip(angles) + emitted["to_target"]
        square = target.square().sum(-1)
        wrist = ((square - a * a - b * b) / (2 * a * b)).clamp(-0.93, 1).acos()  # its stop is at 160 degrees
        shoulder = torch.atan2(target[..., 1], target[..., 0]) - torch.atan2(b * wrist.sin(), a + b * wrist.cos())
        return torch.stack([shoulder, wrist], -1)

    def hold(self, angles: Tensor) -> Tensor:
        """Returns the action that holds the arm against gravity at angles ``[*, J]``, zero for upright links."""
        flat = torch.tensor(self.weights) * angles.cumsum(-1).sin()
        return -flat.flip(-1).cumsum(-1).flip(-1) / torch.tensor(self.torques)  # a joint carries all that follows

    def control(self, state: Tensor, goal: Tensor, explore: float = 0.0) -> Tensor:
        """Returns the action for an estimate of the state: PD control with gravity compensation at the goal.

        ``explore`` adds random actions, whose size grows along the batch from zero, so that the motion also learns from
        arms at rest.
        """
        angles, velocity = self.split(state)
        error = torch.cat(
            [wrap(goal - angles)[..., :1], (goal - angles)[..., 1:]], -1
        )  # only the first turns all round
        action = self.hold(goal) + self.stiffness * error - self.damping * velocity
        if explore:
            action = action + explore * torch.linspace(0, 1, len(action)).unsqueeze(-1) * torch.randn_like(action)
        return nn.functional.pad(action, (0, self.actions - self.joints)).clamp(-1, 1)  # the grip stays as it is


ARMS = {
    "reacher": Arm("reacher", "easy", (0.12, 0.12), 0.02, 2, 3.0, 0.3, (0.05, 0.05), 0.3065, 0.0005),
    "manipulator": Arm(
        domain="manipulator",
        task="bring_ball",
        links=(0.18, 0.15, 0.12, 0.09),
        dt=0.01,
        actions=5,
        stiffness=1.5,
        damping=0.15,
        torques=(12.0, 8.0, 4.0, 2.0),
        view=0.5587,
        creep=0.003,
        ahead=torch.pi / 2,
        weights=(0.3833, 0.1662, 0.0617, 0.0145),
    ),
}


class Encoders(Transform):
    """Writes ``"state"``, the episode's ``"goal"``, ``"reading"`` (cosines, sines of noisy angles) and ``"observed"``.

    The reading of a reset is always observed; of the others the share ``missing`` is missing.
    """

    def __init__(self, arm: Arm, missing: float):
        super().__init__(in_keys=[], out_keys=["state", "goal", "reading", "observed"])
        self.arm, self.missing = arm, missing

    def _write(self, tensordict: TensorDictBase, goal: Tensor, missing: float) -> TensorDictBase:
        state = self.arm.state(tensordict)
        angles = self.arm.split(state)[0]
        angles = angles + NOISE * torch.randn_like(angles)
        reading = torch.cat([angles.cos(), angles.sin()], -1)
        observed = torch.rand(*tensordict.batch_size, 1) >= missing
        return tensordict.update({"state": state, "goal": goal, "reading": reading, "observed": observed})

    def _step(self, tensordict, next_tensordict):
        return self._write(next_tensordict, tensordict["goal"], self.missing)

    def _reset(self, tensordict, tensordict_reset):
        return self._write(tensordict_reset, self.arm.goal(tensordict_reset), 0.0)

    def transform_observation_spec(self, observation_spec):
        for key, width in (("state", 3), ("goal", 1), ("reading", 2)):
            observation_spec[key] = Unbounded((*observation_spec.shape, width * self.arm.joints))
        observation_spec["observed"] = Binary(shape=(*observation_spec.shape, 1), dtype=torch.bool)
        return observation_spec


class Average(ObservationTransform):
    """Downsamples images to ``SIDE`` pixels along a side by averaging: arms that are a pixel wide need smooth edges.

    MuJoCo's own antialiasing and shadows cost ten times as much as all the rest.
    """

    def __init__(self):
        super().__init__(in_keys=["pixels"], out_keys=["pixels"])

    def _apply_transform(self, pixels):
        return nn.functional.avg_pool2d(pixels, FINE)

    def _reset(self, tensordict, tensordict_reset):
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec):
        observation_spec["pixels"] = Unbounded((*observation_spec["pixels"].shape[:-2], SIDE, SIDE))
        return observation_spec


class HoldAngles(Transform):
    """Writes ``"held"``: the last observed angles, and velocities smoothed over about five steps."""

    def __init__(self, arm: Arm, in_key):
        super().__init__(in_keys=[in_key], out_keys=["held"])
        self.arm = arm

    def _angles(self, tensordict: TensorDictBase) -> Tensor:
        reading = tensordict[self.in_keys[0]]
        if self.in_keys[0] == "reading":
            return self.arm.split(nn.functional.pad(reading, (0, self.arm.joints)))[0]
        return self.arm.angles(reading.unflatten(-1, (-1, 2)))  # of places

    def _step(self, tensordict, next_tensordict):
        before, velocity = self.arm.split(tensordict["held"])
        angles = torch.where(next_tensordict["observed"], self._angles(next_tensordict), before)
        velocity = velocity + 0.2 * (wrap(angles - before) / self.arm.dt - velocity)
        return next_tensordict.set("held", self.arm.join(angles, velocity))

    def _reset(self, tensordict, tensordict_reset):
        angles = self._angles(tensordict_reset)
        return tensordict_reset.set("held", self.arm.join(angles, torch.zeros_like(angles)))  # at rest

    def transform_observation_spec(self, observation_spec):
        observation_spec["held"] = observation_spec["state"].clone()
        return observation_spec


def make_one(arm: Arm, pixels: bool) -> DMControlWrapper:
    from dm_control import suite

    env = suite.load(arm.domain, arm.task)
    if not pixels:
        return DMControlWrapper(env)
    env.physics.model.vis.quality.offsamples = 0
    quick = {"shadow": False, "reflection": False}
    shape = {"height": FINE * SIDE, "width": FINE * SIDE, "camera_id": 0, "render_flag_overrides": quick}
    return DMControlWrapper(env, from_pixels=True, pixels_only=False, render_kwargs=shape)


def make_env(arm: Arm, pixels: bool, episodes: int, missing: float = 0.0) -> TransformedEnv:
    """Returns an environment of ``episodes`` arms in one batch."""
    images = [ToTensorImage(), GrayScale(), Average()] if pixels else []
    arms = SerialEnv(episodes, partial(make_one, arm, pixels))
    return TransformedEnv(arms, Compose(DoubleToFloat(), *images, Encoders(arm, missing)))
