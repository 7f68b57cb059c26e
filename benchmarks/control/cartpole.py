"""Swing-up of dm_control's cartpole from noisy readings, and filters with learned or with known dynamics."""

from __future__ import annotations

import numpy as np
import torch
from dm_control.suite import cartpole
from dm_control.utils.rewards import tolerance
from mujoco import MjData, MjModel
from mujoco.rollout import Rollout
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Bounded

from torch_denkf import modules as m
from torch_denkf.envs import LinearGaussianEnv
from torch_denkf.filters import DEnKF
from torch_denkf.functional.draws import exact_draws

REPEAT, STEPS = 4, 250  # physics steps of 0.01 s per action; actions in an episode
DT = 0.01 * REPEAT  # s
ACTION_NOISE, START_STD = 0.3, 0.01
START = (0.0, -1.0, 0.0, 0.0, 0.0)  # the cart in the middle, the pole hanging
SCALE = (1.0, 1.0, 1.0, 2.0, 5.0)  # of a state
TRACK = 1.8  # m from the middle


class NoisyCartpole(LinearGaussianEnv):
    """A batch of cartpoles. The state is the cart's position, cosine and sine of the pole's angle, and two velocities.

    Physics, reward and start are those of ``dm_control.suite.cartpole.swingup``. Entries of the state (m, 1, 1, m/s,
    rad/s) are read with noise: the first three, or with the velocities all five, which dm_control's own observation
    has. In each physics step the motor gets the action ``[*B, 1]`` and N(0, 0.3^2), within [-1, 1]. The reward is the
    sum over an action's physics steps.

    Args:
        count: carts.
        noise: standard deviation of a reading.
        missing: share of missing readings.
        seed: of the environment's own generator.
        action_noise: standard deviation of the noise of an action in each physics step.
        read: number of first entries of the state that are read: 3 or 5.
    """

    def __init__(
        self,
        count: int,
        noise: float,
        missing: float = 0.0,
        seed: int = 0,
        action_noise: float = ACTION_NOISE,
        read: int = 3,
    ):
        # Readings, masks and the time limit are those of a linear system; motion and reward are defined here.
        one = torch.eye(5)
        super().__init__(
            one,
            one[:read],
            [0.0] * 5,
            [noise] * read,
            control=one[:, 3:4],
            missing=missing,
            max_steps=STEPS,
            batch_size=[count],
            seed=seed,
        )
        self.action_spec = Bounded(-1.0, 1.0, (count, 1))
        self.action_noise = action_noise
        text, assets = cartpole.get_model_and_assets()
        self.model = MjModel.from_xml_string(text.decode(), assets)
        self.data, self.simulator = MjData(self.model), Rollout(nthread=0)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        position, angle, velocity, turn = (START_STD * self._randn(self.F, 4)).split(1, -1)
        angle = torch.pi + angle
        state = torch.cat([position, angle.cos(), angle.sin(), velocity, turn], -1)
        return self._emit(state, torch.zeros(*self.batch_size, 1, dtype=torch.int64))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        before = tensordict["state"]
        motor = tensordict["action"] + self.action_noise * self._randn(before[..., :1], REPEAT)
        motor = motor.clamp(-1, 1)
        state, after = self.moved(before, motor)
        reward = swing_up(after[..., 1], np.cos(after[..., 2]), after[..., 4], motor.double().numpy())
        reward = torch.from_numpy(reward.sum(-1, keepdims=True)).to(state.dtype)
        return self._emit(state, tensordict["step"] + 1).set("reward", reward)

    def moved(self, state: Tensor, motor: Tensor) -> tuple[Tensor, np.ndarray]:
        """Returns states ``[N, 5]`` after an action, and MuJoCo's states ``[N, physics steps, 5]`` in between.

        Args:
            state: ``[N, 5]``.
            motor: inputs of the motor in each physics step, ``[N, physics steps]``, within [-1, 1].
        """
        position, cos, sin, velocity, turn = state.split(1, -1)
        angle = torch.atan2(sin, cos)
        before = torch.cat([torch.zeros_like(angle), position, angle, velocity, turn], -1).double().numpy()
        after, _ = self.simulator.rollout(self.model, self.data, before, motor.double().numpy()[..., None])
        _, position, angle, velocity, turn = torch.from_numpy(after[:, -1]).to(cos.dtype).split(1, -1)
        return torch.cat([position, angle.cos(), angle.sin(), velocity, turn], -1), after


def swing_up(position: np.ndarray, cos: np.ndarray, turn: np.ndarray, motor: np.ndarray) -> np.ndarray:
    """Returns the dense reward of ``dm_control.suite.cartpole.Balance`` for a batch."""
    centered = (1 + tolerance(position, margin=2)) / 2
    small_control = (4 + tolerance(motor, margin=1, value_at_margin=0, sigmoid="quadratic")) / 5
    small_velocity = (1 + tolerance(turn, margin=5)) / 2
    return (cos + 1) / 2 * small_control * small_velocity * centered


class Push(m.SubModel):
    """The filter's motion: a network predicts the change of the velocities, which move cart and pole.

    The network outputs the change of both velocities without a motor, the gain from the motor to the cart's velocity,
    and the ratio of the pole's velocity change to the cart's. At the end of the track the cart stops, which changes the
    pole's velocity by that ratio, too.
    """

    MOST = 20.0  # m/s, rad/s: upper bound of the speeds

    def __init__(self):
        network = nn.Sequential(nn.Linear(5, 32), nn.Tanh(), nn.Linear(32, 4))
        super().__init__(network, [("belief", "ensemble"), "action"], [("forecast", "ensemble")])
        self.register_buffer("scale", torch.tensor(SCALE))

    def compute(self, ensemble: Tensor, action: Tensor) -> Tensor:
        """Returns states ``[*B, E, 5]`` one step on, with actions ``[*B, 1]``."""
        position, cos, sin, velocity, turn = ensemble.split(1, -1)
        angle = torch.atan2(sin, cos)
        features = torch.cat([position, angle.cos(), angle.sin(), velocity, turn], -1) / self.scale
        drift, spin, motor, share = self.module(features).split(1, -1)
        push = motor * action.unsqueeze(-2)
        faster = velocity + drift + push
        # Constant acceleration during a step: position and angle move with the mean velocities.
        ahead = position + DT * (velocity + faster) / 2
        stop = torch.where((ahead.abs() > TRACK) & (ahead * faster > 0), -faster, 0.0)
        faster, turning = faster + stop, turn + spin + share * (push + stop)
        angle = angle + DT * (turn + turning) / 2
        velocities = torch.cat([faster, turning], -1).clamp(-self.MOST, self.MOST)
        return torch.cat([ahead, angle.cos(), angle.sin(), velocities], -1)


class Physics(m.Transition):
    """The simulator's motion with the motor's true noise, an upper bound for learned motions."""

    def __init__(self):
        super().__init__(nn.Identity(), [("belief", "ensemble"), "action"], [("forecast", "ensemble")])
        self.world = NoisyCartpole(1, 0.0)

    def compute(self, ensemble: Tensor, action: Tensor) -> Tensor:
        """Returns states ``[*B, E, 5]`` one step on, with actions ``[*B, 1]``."""
        normal = exact_draws(torch.randn(*ensemble.shape[:-1], REPEAT), ensemble)
        motor = action.unsqueeze(-2) + ACTION_NOISE * normal
        state, _ = self.world.moved(ensemble.flatten(0, -2), motor.clamp(-1, 1).flatten(0, -2))
        return state.view_as(ensemble)


def exact_filter(noise: float, members: int = 32, read: int = 3) -> DEnKF:
    """Returns a filter with the simulator's motion and the true noise of the readings."""
    return _filter(Physics(), m.ConstantNoise([noise] * read, in_key="observation"), members)


def unlearned_filter(members: int, read: int = 3) -> DEnKF:
    """Returns a filter with known observation model and reset; learned acceleration and noises."""
    q = m.ConstantNoise([0.2, 0.3], trainable=True, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    r = m.ConstantNoise([0.2] * read, trainable=True, in_key="observation")
    return _filter(m.NoisyTransition(Push(), q, dims=[3, 4], before=True), r, members)


def _filter(transition: m.SubModel, noise: m.ConstantNoise, members: int) -> DEnKF:
    return DEnKF(
        transition=transition,
        sensor=None,
        observation=m.Select(range(noise.log_variance.numel())),
        noise=noise,
        analysis=m.EnsembleAnalysis("etkf", observation_key="observation"),
        initial=m.GaussianPrior(START, [0.02] * 5, ensemble_size=members),
        update_at_reset=True,
    )
