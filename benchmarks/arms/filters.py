"""The filter of an arm's joints: motion, sensor, the sensor's biases, and the training of motion and sensor."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.arms.arms import NOISE, Arm, wrap
from benchmarks.arms.sensor import FromPlaces, JointPlaces, JointSensor
from benchmarks.common.training import random_rows
from torch_denkf import modules as m
from torch_denkf.filters import DEnKF
from torch_denkf.training import Stage
from torch_denkf.training.parts import train_part

# These settings were chosen on other episodes than those of the tests, see README.md.
MEMBERS = 256
DRIFT = 0.005  # noise of an angle after a turn of 1 rad, in addition to acceleration noise and creep, rad
LENGTH = 0.3  # rad: correlation length of the sensor's biases
FASTER = 1.25  # limit of the members' speeds, in units of the fastest recorded speed of each joint


class ArmTransition(m.Transition):
    """Learned accelerations and their noise; old and new velocity turn the angle, whose cosine and sine are the state.

    An arm at rest that is held against gravity stays at rest: the network's mean for that case is subtracted.

    With ``bias``, the state also has the sensor's biases, of these standard deviations. All images of an arm at rest
    have the same error, and images of another pose another one: the biases decay with the angle that the joints have
    turned, not with time. The noise of the angles grows with that angle, too.
    """

    def __init__(
        self, arm: Arm, scale: Tensor, fastest: Tensor, change: Tensor, lead: Tensor, bias: Tensor | None = None
    ):
        network = m.StochasticMLP(
            3 * arm.joints + arm.actions, 2 * arm.joints, (128, 128), layer="none", output_gain=0.1
        )
        super().__init__(network, [("belief", "ensemble"), "action"], [("forecast", "ensemble")])
        self.arm = arm
        self.register_buffer("scale", scale)  # of velocities, rad/s
        self.register_buffer("fastest", fastest)  # of velocities, rad/s
        self.register_buffer("change", change)  # standard deviation of a velocity's change in a step, rad/s
        self.register_buffer("lead", lead)  # share of its change that the mean velocity of a step includes
        self.register_buffer("bias", bias)

    def faster(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mean and standard deviation of the velocity change in a step, rad/s, at states ``[*, 3 J]``.

        Velocities are clamped to ``fastest`` before the network: beyond, its predicted noise grows with them.
        """
        angles, velocity = self.arm.split(state)
        velocity = velocity.clamp(-self.fastest, self.fastest)
        held = nn.functional.pad(self.arm.hold(angles), (0, self.arm.actions - self.arm.joints))
        moving = torch.cat([velocity / self.scale, action - held], -1)
        states = torch.cat([angles.cos(), angles.sin()], -1).expand(2, *angles.shape[:-1], -1)
        mean, noise = self.module(torch.cat([states, torch.stack([moving, torch.zeros_like(moving)])], -1)).chunk(2, -1)
        return self.change * (mean[0] - mean[1]), self.change * (0.002 + nn.functional.softplus(noise[0] - 1.5))

    def compute(self, ensemble: Tensor, action: Tensor) -> Tensor:
        state, bias = ensemble.tensor_split((3 * self.arm.joints,), -1)
        angles, velocity = self.arm.split(state)
        velocity = velocity.clamp(-self.fastest, self.fastest)  # an analysis may have made a member faster
        action = action.to(angles.dtype).unsqueeze(-2).expand(*angles.shape[:-1], -1)
        mean, std = self.faster(state, action)
        after = (velocity + mean + std * torch.randn_like(std)).clamp(-self.fastest, self.fastest)
        ways = self.arm.dt * velocity.abs()
        # Without the creep the variance of an arm at rest would vanish.
        drift = (DRIFT**2 * ways + self.arm.creep**2).sqrt() * torch.randn_like(ways)
        turned = angles + self.arm.dt * torch.lerp(velocity, after, self.lead) + drift
        moved = self.arm.join(turned, after)
        if self.bias is None:
            return moved
        new = -torch.expm1(-2 * ways.norm(dim=-1, keepdim=True) / LENGTH)  # share of a bias's variance
        bias = (1 - new).sqrt() * bias + self.bias * new.sqrt() * torch.randn_like(bias)
        return torch.cat([moved, bias], -1)


def make_filter(arm: Arm, motion: TensorDict, sensor: JointSensor | None, error: Tensor | None) -> DEnKF:
    """Returns a filter of the state [cos, sin, velocity] per joint; encoders read cos and sin, images link positions.

    Args:
        arm: the arm.
        motion: episodes ``[N, T]`` of states and actions.
        sensor: of images, or ``None`` for encoders.
        error: standard deviations of the sensor's errors ``[2 J]``, or ``None`` for encoders.
    """
    size = 2 * arm.joints
    angles, velocity = arm.split(motion["state"])
    steps = velocity.diff(dim=1).flatten(0, 1)
    change = steps.std(0)
    beyond = wrap(angles.diff(dim=1)).flatten(0, 1) / arm.dt - velocity[:, :-1].flatten(0, 1)
    lead = (beyond * steps).sum(0) / steps.square().sum(0)  # 1 for one of MuJoCo's Euler steps, less for several
    fastest = FASTER * velocity.abs().amax((0, 1))
    transition = ArmTransition(arm, velocity.flatten(0, 1).std(0), fastest, change, lead, error)
    key, first = "reading", motion["state"][:, 0]
    if sensor is not None:
        key, first = sensor.out_keys[0], torch.cat([arm.places(angles[:, 0]).flatten(-2), velocity[:, 0]], -1)
    mean, std = first.mean(0), first.std(0).clamp_min(1e-3)  # arms begin at rest
    start = {"mean": mean, "std": std, "ensemble_size": MEMBERS}
    if sensor is None:
        observation: m.SubModel = m.Select(range(size))
        noise = m.ConstantNoise([NOISE] * size, in_key=key)
        initial = m.FromSensor(range(size), observation_key=key, **start)
    else:
        observation, noise = JointPlaces(arm), m.ConstantNoise(error, in_key=key)
        initial = FromPlaces(arm, bias=error, **start)
    analysis = m.EnsembleAnalysis("etkf", observation_key=key)
    return DEnKF(
        transition=transition, sensor=sensor, observation=observation, noise=noise, analysis=analysis, initial=initial
    )


def train_sensor(sensor: JointSensor, frames: TensorDict, updates: int, out: Path, seed: int) -> None:
    """Trains the sensor on single images ``[N]``, each of another pose."""
    loss = lambda batch: sensor.losses(batch["pixels"], batch["state"])  # noqa: E731
    stage = Stage("sensor", loss, random_rows(frames, 48), updates)
    train_part(sensor, stage, out=out / stage.name, loggers=(), device="cpu", seed=seed)


def train_motion(denkf: DEnKF, motion: TensorDict, updates: int, out: Path, seed: int) -> None:
    """Trains the accelerations on single steps of true states, by the likelihood of the next velocities."""
    transition: ArmTransition = denkf["transition"]
    state, action = (motion[key][:, :-1].flatten(0, 1) for key in ("state", "action"))
    faster = motion["state"].diff(dim=1)[..., 2 * transition.arm.joints :].flatten(0, 1) / transition.change
    steps = TensorDict({"state": state, "action": action, "faster": faster}, [len(state)])

    def loss(batch: TensorDict) -> dict[str, Tensor]:
        mean, std = (part / transition.change for part in transition.faster(batch["state"], batch["action"]))
        return {"loss_motion": nn.functional.gaussian_nll_loss(mean, batch["faster"], std.square())}

    learned = {"parameters": transition.module.parameters(), "lr": 3e-3}
    stage = Stage("motion", loss, random_rows(steps, 512), updates, **learned)
    train_part(transition, stage, out=out / stage.name, loggers=(), device="cpu", seed=seed)
