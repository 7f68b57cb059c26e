"""The filter of an arm's joints: its motion, its sensor, the sensor's errors, and how they are learned."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.arms.arms import NOISE, SIDE, Arm, wrap
from torch_denkf import modules as m
from torch_denkf.filters import DEnKF
from torch_denkf.functional import ensemble_mean, ensemble_var
from torch_denkf.objectives import DEnKFLoss
from torch_denkf.training import Stage, train_part

DRIFT = 0.004  # rad a step: noise of the angles, which the learned accelerations do not have
LENGTH = 0.3  # rad: a motion after which a picture is read with other errors, before training


class ArmTransition(m.SubModel):
    """Learned accelerations and their noise; old and new velocity turn the angle, whose cosine and sine are the state.

    With ``bias`` the errors of a sensor follow in the state, of standard deviations ``bias`` before training. A picture
    of an arm at rest is read with the same error again and again, and with another one when the arm has moved: the
    errors fade with the way that the joints went, not with time.
    """

    def __init__(self, arm: Arm, scale: Tensor, change: Tensor, lead: Tensor, bias: Tensor | None = None):
        network = m.StochasticMLP(3 * arm.joints + arm.actions, 2 * arm.joints, (64, 64), layer="none", output_gain=0.1)
        super().__init__(network, [("belief", "ensemble"), "action"], [("forecast", "ensemble")])
        self.arm = arm
        self.register_buffer("scale", scale)  # of velocities, rad/s
        self.register_buffer("change", change)  # of their steps, rad/s
        self.register_buffer("lead", lead)  # share of its change that a velocity has on average in a step
        self.log_drift = nn.Parameter(torch.full((arm.joints,), DRIFT).log())
        self.log_bias = None if bias is None else nn.Parameter(bias.log())
        self.log_length = None if bias is None else nn.Parameter(torch.full_like(bias, LENGTH).log())

    def faster(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the change of the velocities in a step, rad/s, of states ``[*, 3 J]``."""
        angles, velocity = self.arm.split(state)
        mean, noise = self.module(torch.cat([self.arm.join(angles, velocity / self.scale), action], -1)).chunk(2, -1)
        return self.change * mean, self.change * (0.02 + nn.functional.softplus(noise - 1.5))

    def compute(self, ensemble: Tensor, action: Tensor) -> Tensor:
        state, bias = ensemble.tensor_split((3 * self.arm.joints,), -1)
        angles, velocity = self.arm.split(state)
        action = action.to(angles.dtype).unsqueeze(-2).expand(*angles.shape[:-1], -1)
        mean, std = self.faster(state, action)
        faster = mean + std * torch.randn_like(std)
        # Without the drift an arm at rest would be believed for ever.
        drift = self.log_drift.exp() * torch.randn_like(faster)
        turned = angles + self.arm.dt * (velocity + self.lead * faster) + drift
        moved = self.arm.join(turned, velocity + faster)
        if self.log_bias is None:
            return moved
        way = self.arm.dt * velocity.square().sum(-1, keepdim=True).add(1e-8).sqrt()
        new = -torch.expm1(-2 * way / self.log_length.exp())  # share of a bias's variance
        bias = (1 - new).sqrt() * bias + self.log_bias.exp() * new.sqrt() * torch.randn_like(bias)
        return torch.cat([moved, bias], -1)


class FromBiasedSensor(m.FromSensor):
    """A belief from a first reading that is the sum of what it reads and of the last components of the state."""

    def _members(self, center, std, noise, batch_size):
        ensemble = super()._members(center, std, noise, batch_size)[0]
        size = self.observation_dim
        ensemble = torch.cat([ensemble[..., :size] - ensemble[..., -size:], ensemble[..., size:]], -1)
        return ensemble, ensemble_mean(ensemble), ensemble_var(ensemble)


def make_sensor(arm: Arm, frames: TensorDict) -> m.ImageSensor:
    """Reads the cosines and sines of the joints from a picture."""
    size = 2 * arm.joints
    loc, scale = frames["state"][:, :size].mean(0), frames["state"][:, :size].std(0)
    trunk = m.KeypointTrunk(1, channels=(16, 24, 32, 48, 64))
    shape = {"image_shape": (1, SIDE, SIDE), "pixel_loc": 0.25, "pixel_scale": 0.1}
    return m.ImageSensor(size, trunk=trunk, num_cells=(64,), loc=loc, scale=scale, **shape)


def make_filter(arm: Arm, motion: TensorDict, sensor: m.ImageSensor | None, error: Tensor | None) -> DEnKF:
    """State [cos, sin, velocity] of each joint; cosines and sines are read, by encoders or from a picture.

    Args:
        arm: the arm.
        motion: episodes ``[N, T]`` of states and actions.
        sensor: of pictures, or ``None`` for encoders.
        error: standard deviations of what the sensor reads ``[2 J]``.
    """
    size, key = 2 * arm.joints, ("sensor", "ensemble") if sensor else "reading"
    angles, velocity = arm.split(motion["state"])
    steps = velocity.diff(dim=1).flatten(0, 1)
    change = steps.std(0)
    beyond = wrap(angles.diff(dim=1)).flatten(0, 1) / arm.dt - velocity[:, :-1].flatten(0, 1)
    lead = (beyond * steps).sum(0) / steps.square().sum(0)  # 1 in MuJoCo's Euler step; of several it is less
    mean, std = motion["state"][:, 0].mean(0), motion["state"][:, 0].std(0).clamp_min(1e-3)  # both arms begin at rest
    transition = ArmTransition(arm, velocity.flatten(0, 1).std(0), change, lead, error)
    if sensor is None:
        observation: m.SubModel = m.Select(range(size))
        noise: m.SubModel = m.ConstantNoise([NOISE] * size, in_key=key)
        initial = m.FromSensor(range(size), mean=mean, std=std, sensor_key=key)
    else:
        one, none = torch.eye(size), torch.zeros(size, arm.joints)
        observation = m.LinearObservation(torch.cat([one, none, one], -1))
        noise = m.DiagonalNoise(size, r=0.5 * error, loc=mean[:size], scale=std[:size])
        mean, std = torch.cat([mean, torch.zeros(size)]), torch.cat([std, error])
        initial = FromBiasedSensor(range(size), mean=mean, std=std, sensor_key=key)
    analysis = m.EnsembleAnalysis("etkf", sensor_key=key)
    return DEnKF(
        transition=transition, sensor=sensor, observation=observation, noise=noise, analysis=analysis, initial=initial
    )


def train_sensor(sensor: m.ImageSensor, frames: TensorDict, updates: int, out: Path, seed: int) -> None:
    """On single pictures ``[N]``, each of another pose."""

    def loss(batch: TensorDict) -> dict[str, Tensor]:
        error = sensor(batch)["sensor", "ensemble"].mean(-2) - batch["state"][..., : sensor.observation_dim]
        return {"loss_sensor": error.square().mean()}

    def sample(generator: torch.Generator, _: int | None) -> TensorDict:
        return frames[torch.randint(len(frames), (48,), generator=generator)]

    stage = Stage("sensor", loss, sample, updates)
    train_part(sensor, stage, out=out / stage.name, loggers=(), device="cpu", seed=seed)


def train_motion(denkf: DEnKF, motion: TensorDict, updates: int, out: Path, seed: int) -> None:
    """The accelerations, on single steps of true states: likelihood of the next velocities."""
    transition: ArmTransition = denkf["transition"]
    state, action = (motion[key][:, :-1].flatten(0, 1) for key in ("state", "action"))
    faster = motion["state"].diff(dim=1)[..., 2 * transition.arm.joints :].flatten(0, 1) / transition.change
    steps = TensorDict({"state": state, "action": action, "faster": faster}, [len(state)])

    def loss(batch: TensorDict) -> dict[str, Tensor]:
        mean, std = (part / transition.change for part in transition.faster(batch["state"], batch["action"]))
        return {"loss_motion": nn.functional.gaussian_nll_loss(mean, batch["faster"], std.square())}

    def sample(generator: torch.Generator, _: int | None) -> TensorDict:
        return steps[torch.randint(len(steps), (512,), generator=generator)]

    stage = Stage("motion", loss, sample, updates, parameters=transition.module.parameters(), lr=3e-3)
    train_part(transition, stage, out=out / stage.name, loggers=(), device="cpu", seed=seed)


def train_noise(denkf: DEnKF, episodes: TensorDict, updates: int, out: Path, seed: int) -> None:
    """The noises and the sensor's slow errors, on windows of episodes ``[N, T]`` that the sensor has not seen."""
    transition = denkf["transition"]
    with torch.no_grad():  # once, instead of in every window
        read = torch.stack([denkf["sensor"](episode) for episode in episodes]).exclude("pixels")
    parts = {name: denkf[name] for name in ("transition", "observation", "noise", "analysis")}
    size = 3 * transition.arm.joints
    scale = torch.cat([denkf.initial.std[: 2 * size // 3], transition.scale, torch.full((2 * size // 3,), torch.inf)])
    loss = DEnKFLoss(DEnKF(sensor=None, **parts, initial=denkf.initial), sensor=0.0, state_scale=scale)

    def sample(generator: torch.Generator, length: int) -> TensorDict:
        steps = torch.arange(min(length, read.shape[1]))
        first = torch.randint(read.shape[1] - len(steps) + 1, (32, 1), generator=generator)
        batch = read[torch.randint(len(read), (32, 1), generator=generator), first + steps]
        batch["state"] = nn.functional.pad(batch["state"], (0, 2 * size // 3))
        observed = torch.rand(*batch.shape, 1, generator=generator) > 0.3  # some readings are missing
        return batch.set("observed", observed)

    slow = [transition.log_drift, transition.log_bias, transition.log_length]
    parameters = [*denkf["noise"].parameters(), *slow]
    lengths = {0: 15, updates // 2: 60}
    stage = Stage("noise", loss, sample, updates, parameters=parameters, lr=1e-2, lengths=lengths)
    train_part(denkf, stage, out=out / stage.name, loggers=(), device="cpu", seed=seed)
