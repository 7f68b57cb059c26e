"""An environment of quadrupeds that walk at a commanded velocity under random forces."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from benchmarks.legged.task import Ground
from torch_denkf.applications.legged import quadruped_env
from torch_denkf.functional.manifolds import SO3, rotate

__all__ = ["EVERY", "Walk", "acted", "gait", "play", "up_of"]

EVERY = 5  # rows of 0.01 s per action
PACE, LIFT = 1.5, 0.4  # strides per second; control that lifts a swinging leg
NOMINAL = 0.4  # m of stride for each m/s of the command, right for a friction of 0.5
LIMIT = (0.15, 0.15, 0.15)  # largest change of the stride by an action: forwards and to the left in m, turn in rad
MOTOR, STRENGTH, LOAD = 1000.0, (0.8, 2.5), (0.0, 40.0)  # stiffness in Nm; factors on it; kg on the robot's back
FASTEST = (0.35, 0.2)  # of commands, m/s
WIDTH = 0.15  # m/s, error at which the reward falls to 1 / e
_ANGLES = math.pi / 4 * torch.tensor([1.0, -1.0, -3.0, 3.0])  # of the legs: front left, front right, back right, left
_OUT = torch.stack([_ANGLES.cos(), _ANGLES.sin()], -1)
_ALONG = torch.stack([-_ANGLES.sin(), _ANGLES.cos()], -1)


def gait(phase: Tensor, stride: Tensor) -> Tensor:
    """Returns controls ``[*B, 12]`` of a trot whose feet move straight in any direction.

    Args:
        phase: in rad, ``[*B, 1]``.
        stride: amplitude of the feet: forwards and to the left in m, turn in rad, ``[*B, 3]``.
    """
    phase = phase + math.pi * torch.tensor([0.0, 1.0, 0.0, 1.0])  # [*B, 4]
    foot = stride[..., None, :2] + 0.83 * stride[..., None, 2:] * _ALONG  # legs end 0.83 m from the middle
    # A control of 1 moves a foot 0.54 m around its hip, or 0.27 m outwards.
    around, out = ((foot * axis).sum(-1) * phase.cos() / each for axis, each in ((_ALONG, 0.54), (_OUT, 0.27)))
    return torch.stack([around, -LIFT * (-phase.sin()).clamp(min=0), out], -1).flatten(-2).clamp(-0.8, 0.8)


class Walk(EnvBase):
    """A batch of robots, 100 rows per second. An ``"action"`` ``[3]`` in [-1, 1] adds to the strides of their gait.

    Emits each robot's readings, the truth, and ``"command"`` ``[2]``, the target velocity in the base's axes,
    in m/s, which changes every 2 to 4 s; and ``"phase"`` ``[2]``, cosine and sine, of the gait. The reward of a row is
    1 if the base moves as commanded and does not turn. Friction, floor, motors and load are drawn at the reset.

    Args:
        count: robots, B.
        ground: of the walk; ``pushes`` are the standard deviations of a horizontal force in N, which changes every 1
            to 3 s.
        seed: of all random numbers.
    """

    def __init__(self, count: int, ground: Ground, seed: int):
        super().__init__(batch_size=[count])
        self.ground, self.robots = ground, [quadruped_env(seed=1000 * seed + number) for number in range(count)]
        self.dt, self.mass = self.robots[0].dt, float(self.robots[0].model.body_mass[1])
        spec = self.robots[0].observation_spec.expand(count)
        more = {"command": Unbounded((count, 2)), "phase": Unbounded((count, 2))}
        self.observation_spec = Composite({**dict(spec.items()), **more}, shape=[count])
        self.action_spec = Bounded(-1.0, 1.0, (count, 3))
        self.reward_spec = Unbounded((count, 1))
        self.set_seed(seed)

    def _set_seed(self, seed: int | None) -> None:
        self.random = np.random.default_rng(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        count = len(self.robots)
        for robot in self.robots:
            model, draw = robot.model, self.random.uniform
            model.geom_friction[:, 0] = math.exp(draw(*map(math.log, self.ground.friction)))
            model.geom_solref[:, 0] = draw(*self.ground.softness)
            model.actuator_gainprm[:, 0] = MOTOR * math.exp(draw(*map(math.log, STRENGTH)))
            model.actuator_biasprm[:, 1] = -model.actuator_gainprm[:, 0]
            model.body_mass[1] = self.mass + draw(*LOAD)
        self.row, self.until = 0, np.zeros((count, 2), dtype=int)  # when command and force change
        self.command, self.pull = torch.zeros(count, 2), self.random.uniform(*self.ground.pushes, count)
        return self._with_command(torch.stack([robot._reset() for robot in self.robots]))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action, time = tensordict["action"], self.row * self.dt
        base = torch.cat([NOMINAL * self.command, torch.zeros(len(action), 1)], -1)
        stride = min(1.0, time) * (base + torch.tensor(LIMIT) * action.clamp(-1, 1))
        controls = gait(torch.full((len(action), 1), 2 * math.pi * PACE * time), stride)
        rows = []
        for robot, control in zip(self.robots, controls.double().numpy(), strict=True):
            robot.data.ctrl[:] = control
            rows.append(robot._move())
        out, self.row = torch.stack(rows), self.row + 1
        wrong = (out["true", "velocity"][:, :2] - self.command).square().sum(-1, keepdim=True) / WIDTH**2
        turn = torch.tensor([[robot.data.qvel[5]] for robot in self.robots], dtype=torch.float32)
        upright = up_of(out["true", "orientation"])[:, 2:] > 0.5
        out["reward"] = torch.where(upright, (-wrong - (turn / 0.5).square()).exp(), 0.0)
        out["done"] = out["terminated"] = torch.zeros_like(upright)
        return self._with_command(out)

    def _with_command(self, out: TensorDict) -> TensorDict:
        """Draws new commands and forces when due."""
        for number, robot in enumerate(self.robots):
            if self.row >= self.until[number, 0]:
                self.command[number] = torch.tensor(self.random.uniform(-1, 1, 2) * FASTEST)
                self.until[number, 0] += round(self.random.uniform(2, 4) / self.dt)
            if self.row >= self.until[number, 1]:
                robot.data.xfrc_applied[1, :2] = self.pull[number] * self.random.standard_normal(2)
                self.until[number, 1] += round(self.random.uniform(1, 3) / self.dt)
        phase = torch.tensor(2 * math.pi * PACE * self.row * self.dt)
        phase = torch.stack([phase.cos(), phase.sin()]).expand(len(self.robots), 2)
        return out.update({"command": self.command.clone(), "phase": phase.clone()})


def up_of(turn: Tensor) -> Tensor:
    """Returns the vertical in the axes of an orientation ``[*, 4]``."""
    return rotate(SO3().inverse(turn), turn.new_tensor([0.0, 0.0, 1.0]).expand(*turn.shape[:-1], 3))


@torch.no_grad()
def play(
    env: EnvBase,
    policy: TensorDictModuleBase,
    rows: int,
    keep: list,
    watch: Callable[[TensorDict], None] = lambda row: None,
) -> TensorDict:
    """Returns some entries of an episode ``[B, T]``, in which a policy acts every fifth row.

    Args:
        env: a :class:`Walk`, maybe with transforms.
        policy: writes ``"action"``.
        rows: T.
        keep: keys before and after a step.
        watch: called with each row.
    """
    row, found = env.reset(), []
    for number in range(rows):
        if number % EVERY == 0:
            acted = policy(row.clone(False)).select(*policy.out_keys)
        row = env.step(row.update(acted))
        found.append(row.select(*keep, *policy.out_keys, ("next", "reward"), *(("next", key) for key in keep)))
        row = row["next"].exclude("reward")
        watch(row)
    return torch.stack(found, 1)


def acted(data: TensorDict) -> TensorDict:
    """Returns the rows of ``[B, T]`` with an action, and the mean reward until the next action."""
    out = data[:, ::EVERY].clone(False).set("next", data["next"][:, EVERY - 1 :: EVERY])
    out["next", "reward"] = data["next", "reward"].unflatten(1, (-1, EVERY)).mean(2)
    for key in ("done", "terminated"):
        out["next", key] = torch.zeros(*out.shape, 1, dtype=torch.bool)
    return out
