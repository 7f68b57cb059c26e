"""A custom arm, from camera to policy, on one page: MuJoCo, a camera, encoders, and actions with latency.

    python examples/own_arm.py             # plots, filter and policy in runs/own-arm

``Reach`` and ``XML`` stand for your arm: two joints, a camera of 60 x 60 pixels at 20 Hz, encoders at 5 Hz. 30 % of
both are missing, and no sensor reads speeds. A scripted controller gives demonstrations. The filter learns
motion and camera from them, and the camera's errors from held-out demonstrations. Then PPO
learns to reach a goal, from the predicted belief at the time when its action runs, 0.1 s later. It needs OpenGL, but no
screen (``MUJOCO_GL=egl``). docs/how_to/own_arm.md has the numbers.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import OrderedDict, deque
from functools import partial
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")  # before dm_control is imported

import numpy as np
import torch
from dm_control import mujoco
from dm_control.rl import control
from dm_env import specs
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import (
    CatTensors,
    DMControlWrapper,
    DoubleToFloat,
    EnvBase,
    ExplorationType,
    InitTracker,
    RenameTransform,
    SerialEnv,
    TransformedEnv,
    set_exploration_type,
)
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm

from torch_denkf import (
    DEnKFLoss,
    DEnKFTransform,
    FilterTrainer,
    FusedFilter,
    FusedSensor,
    MissingFrames,
    SensorLoss,
    Stage,
    TransitionLoss,
    export_step,
    from_pretrained,
    save_pretrained,
)
from torch_denkf.data import EpisodeReplay
from torch_denkf.envs import LateActions
from torch_denkf.fusion import BeliefAhead
from torch_denkf.imperfect import FadingBias
from torch_denkf.metrics import interval_coverage
from torch_denkf.modules import (
    GaussianPrior,
    ImageSensor,
    KeypointTrunk,
    LearnedTransition,
    Select,
    StochasticMLP,
)
from torch_denkf.plots import plot_bands
from torch_denkf.training import take_weights

DT, STEPS, LATE = 0.05, 60, 2  # s of a step; steps of an episode; latency of sensing, inference and bus, in steps
ENCODER, LOST = 0.05, 0.3  # noise in rad; share of missing readings
XML = """<mujoco>
  <option timestep="0.01"/>
  <visual><quality offsamples="0" shadowsize="0"/><global offwidth="60" offheight="60"/></visual>
  <default>
    <joint axis="0 0 1" damping="0.05" limited="true"/>
    <geom type="capsule" size="0.02" contype="0" conaffinity="0"/>
  </default>
  <worldbody>
    <camera name="top" pos="0 0 0.9" fovy="60"/>
    <geom type="plane" size="1 1 0.1" pos="0 0 -0.05" rgba="0.8 0.8 0.75 1"/>
    <body>
      <joint name="shoulder" range="-140 140"/>
      <geom fromto="0 0 0 0.2 0 0" rgba="0.2 0.3 0.8 1"/>
      <body pos="0.2 0 0">
        <joint name="elbow" range="-120 120"/>
        <geom fromto="0 0 0 0.18 0 0" rgba="0.8 0.3 0.2 1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="shoulder" gear="0.2" ctrllimited="true" ctrlrange="-1 1"/>
    <motor joint="elbow" gear="0.1" ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
</mujoco>"""


class Reach(control.Task):
    """Task of reaching the joint angles of a goal, with observations of camera and encoders."""

    def __init__(self):
        self._random, self.goal, self.ticks = np.random.RandomState(0), np.zeros(2), 0  # torchrl seeds ``_random``

    def initialize_episode(self, physics):
        self.ticks = 0
        physics.data.qpos[:], self.goal = self._random.uniform(-1.5, 1.5, (2, 2))

    def before_step(self, action, physics):
        physics.set_control(action)
        self.ticks += 1

    def get_observation(self, physics):
        joints = physics.data.qpos.copy()
        return OrderedDict(
            pixels=physics.render(60, 60, camera_id="top").transpose(2, 0, 1).copy(),
            encoder=joints + ENCODER * self._random.normal(size=2),
            encoder_observed=np.array([self.ticks % 4 == 0]),
            goal=self.goal.copy(),
            truth=np.concatenate([joints, physics.data.qvel]),  # rad, rad/s; not "state", which torchrl renames
        )

    def get_reward(self, physics):
        return -float(np.abs(physics.data.qpos - self.goal).mean())

    def action_spec(self, physics):
        return specs.BoundedArray((2,), np.float64, -1.0, 1.0)


def make_env(count: int, seed: int, *transforms) -> TransformedEnv:
    """Returns a batch of arms with 30 % of the readings missing."""

    def one() -> EnvBase:
        arm = control.Environment(mujoco.Physics.from_xml_string(XML), Reach(), STEPS * DT, control_timestep=DT)
        return DMControlWrapper(arm)

    env = TransformedEnv(SerialEnv(count, one), DoubleToFloat())
    lost = [MissingFrames(LOST), MissingFrames(LOST, in_keys=["encoder"], observed_key="encoder_observed")]
    for transform in (InitTracker(), RenameTransform(["truth"], ["state"]), *lost, *transforms):
        env.append_transform(transform)
    env.set_seed(seed)
    return env


def demonstrate(episodes: int, seed: int) -> TensorDict:
    """Returns rollouts of a controller on the truth with random actions added: ``[episodes, STEPS]``."""

    def controller(state, goal):
        shake = torch.randn(len(goal), 1) * torch.randn_like(goal)  # more in some episodes
        return (3.0 * (goal - state[:, :2]) - 0.5 * state[:, 2:] + shake).clamp(-1, 1)

    with torch.no_grad():
        return make_env(episodes, seed).rollout(STEPS, TensorDictModule(controller, ["state", "goal"], ["action"]))


def make_filter(facts: dict[str, list[float]], error: dict[str, list[float]], members: int = 32) -> FusedFilter:
    """Returns a filter of [angles rad, speeds rad/s] with a learned motion, the camera, and the encoders.

    Args:
        facts: means and standard deviations of the demonstrations; plain numbers, for the filter's ``config.json``.
        error: of the camera, in rad: ``white``, and, if known, ``std`` and ``time`` (steps) of the coloured part.
        members: of the ensemble.
    """
    loc, scale = torch.tensor(facts["mean"]), torch.tensor(facts["std"])
    camera = ImageSensor(
        2,
        image_shape=(3, 60, 60),
        ensemble_size=members,
        trunk=KeypointTrunk(3, channels=(16, 24, 32), features=64),
        num_cells=(64,),
        loc=loc[:2],
        scale=scale[:2],
        pixel_loc=facts["pixel_mean"],
        pixel_scale=facts["pixel_std"],
    )
    joints, lasting = Select([0, 1]), None
    if "std" in error:
        lasting = FadingBias(error["std"], error["time"], trainable=False)
    return FusedFilter(
        LearnedTransition(
            StochasticMLP(4 + 2, 4, (64, 64), output_gain=0.1), loc=loc, scale=scale, action_key="action"
        ),
        {
            "camera": FusedSensor(joints, error["white"], camera, observed_key="observed", sensor_error=lasting),
            "encoder": FusedSensor(joints, [ENCODER] * 2),
        },
        initial=GaussianPrior(loc, scale, ensemble_size=members),
        process_noise=[0.002, 0.002, 0.02, 0.02],
        update_at_reset=True,
    )


@torch.no_grad()
def camera_errors(model: FusedFilter, rows: TensorDict, lasting: bool) -> dict[str, list[float]]:
    """Estimates the camera's errors on rows ``[B, T]``: as white noise, or as white and coloured noise."""
    off = model["camera_sensor"](rows.copy())["sensor", "camera", "ensemble"].mean(-2) - rows["state"][..., :2]
    off = torch.where(rows["observed"], off, torch.nan)
    if not lasting:
        return {"white": off.square().nanmean((0, 1)).sqrt().tolist()}
    bias, white = FadingBias.from_residuals(off)
    return {"white": white.clamp_min(0.01).tolist(), "std": bias.std.tolist(), "time": bias.log_time.exp().tolist()}


def learn(
    rollouts: TensorDict, unseen: TensorDict, out: Path, updates: tuple[int, int, int]
) -> tuple[FusedFilter, dict]:
    """Trains motion and camera on three quarters of the demonstrations, error model and filter on the others.

    The camera's errors on its training images would be too small.
    """
    split = partial(EpisodeReplay.from_rollouts, rollouts, DT, validation_share=0.25, num_slices=16, slice_len=20)
    data, held = split(), split(split="validation")
    seen, new = (part[:].reshape(-1, STEPS) for part in (data, held))
    facts = {name: data.statistics["state", name].tolist() for name in ("mean", "std")}
    facts |= {f"pixel_{name}": data.statistics["pixels", name].flatten().tolist() for name in ("mean", "std")}
    first, scale = make_filter(facts, {"white": [0.1, 0.1]}), data.statistics["state", "std"]
    motion, camera = TransitionLoss(first, state_scale=scale), SensorLoss(first, observation_scale=scale[:2])
    camera.set_keys(sensor="camera")
    stages = [
        Stage("motion", motion, data.draw, updates[0], lengths={0: 10}, validate=lambda: dict(motion(new))),
        Stage("camera", camera, data.draw, updates[1], lengths={0: 4}, validate=lambda: dict(camera(new))),
    ]
    options = {"device": "cpu", "validate_every": 50}
    FilterTrainer(first, stages, out=out / "parts", **options).fit(resume=False)
    for rows, name in ((seen, "pictures that it learned from"), (new, "other pictures")):
        print(f"  the camera is off by {camera_errors(first, rows, False)['white']} rad on {name}")
        for lasting, kind in ((False, "white"), (True, "lasting")):
            model = make_filter(facts, camera_errors(first, rows, lasting))
            take_weights(model, first)
            print(f"  both, {kind} errors on {name}: {errors(model, unseen)[1]}")
    whole = DEnKFLoss(model, sensor=0.0, state_scale=scale)
    frozen = ["camera_sensor", "camera_noise"]
    stage = Stage("whole", whole, held.draw, updates[2], lr=5e-4, lengths={0: 10, updates[2] // 2: 20}, frozen=frozen)
    FilterTrainer(model, [stage], out=out / "whole", **options).fit(resume=False)
    return model, {"facts": facts, "error": camera_errors(first, new, True)}


def errors(model: FusedFilter, rollouts: TensorDict, *without: str) -> tuple[TensorDict, str]:
    """Returns beliefs on rollouts, maybe without a sensor, and their root mean squared errors as text."""
    data = rollouts.exclude("next").clone()
    for key in without:
        data[key] = torch.zeros_like(data[key])
    with torch.no_grad():
        out = model.sequence(data)[:, 10:]
    mean, var = out["belief", "mean"][..., :4], out["belief", "var"][..., :4]  # the camera's bias follows
    error = (mean - out["state"]).square().mean((0, 1)).sqrt()
    holds = interval_coverage(mean, var, out["state"], level=0.9).mean()
    return out, f"{error[:2].mean():.3f} rad, {error[2:].mean():.2f} rad/s, 90 % coverage {100 * holds:.0f} %"


def make_actor() -> ProbabilisticActor:
    head = MLP(8, 2, num_cells=[64, 64], activation_class=nn.Tanh)
    nn.init.normal_(head[-1].weight, std=0.01)
    head = nn.Sequential(head, AddStateIndependentNormalScale(2, init_value=0.5))
    keys = {"in_keys": ["loc", "scale"], "distribution_class": IndependentNormal, "return_log_prob": True}
    return ProbabilisticActor(TensorDictModule(head, ["seen"], ["loc", "scale"]), **keys)


def late_env(model: FusedFilter, count: int, seed: int, key=("ahead", "belief", "mean")) -> TransformedEnv:
    """Returns arms with latency and the filter, and the policy's input: a belief and the goal."""
    keep = [("belief", "mean"), ("belief", "var")]
    belief = DEnKFTransform(model, ahead=BeliefAhead(model, LATE, keep=keep))
    return make_env(
        count, seed, LateActions(LATE), belief, CatTensors([key, "goal"], "seen", del_keys=False, sort=False)
    )


def ppo(model: FusedFilter, actor: ProbabilisticActor, batches: int, arms: int = 16) -> list[float]:
    """Trains the policy; returns the return of each batch."""
    critic = ValueOperator(MLP(8, 1, num_cells=[64, 64], activation_class=nn.Tanh), in_keys=["seen"])
    gae = GAE(gamma=0.95, lmbda=0.9, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, entropy_bonus=False, critic_coeff=0.5, loss_critic_type="l2")
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.05, batches)
    rows, curve = arms * STEPS, []
    for data in tqdm(Collector(late_env(model, arms, 1), actor, frames_per_batch=rows, total_frames=batches * rows)):
        curve.append(data["next", "reward"].sum((1, 2)).mean().item())
        with torch.no_grad():
            gae(data)
        steps = data.select(*loss.in_keys, "advantage", "value_target", strict=False).reshape(-1)
        for _ in range(10):
            for part in torch.randperm(rows).split(240):
                terms = loss(steps[part])
                optimiser.zero_grad()
                (terms["loss_objective"] + terms["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()
        schedule.step()
    return curve


@torch.no_grad()
def test(model: FusedFilter, actor: ProbabilisticActor, key, arms: int) -> float:
    """Returns the mean return of the policy with the belief under ``key`` as its input."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return late_env(model, arms, 1000, key).rollout(STEPS, actor)["next", "reward"].sum((1, 2)).mean().item()


@torch.no_grad()
def run(model: FusedFilter, actor: ProbabilisticActor) -> tuple[float, float]:
    """Runs a loop as on the robot, and returns the return of an episode and the milliseconds of a cycle."""
    arm, ahead = make_env(1, 2000), BeliefAhead(model, LATE)
    under_way, total, seconds = deque([torch.zeros(2)] * LATE), 0.0, []
    row = arm.reset()
    belief = model.initialise(row[0].select("pixels", "observed", "encoder", "encoder_observed"))
    while not row["done"].any():
        begun = time.perf_counter()
        actions = TensorDict({("under_way", "action"): torch.stack(list(under_way))})
        later = ahead(belief.copy().update(actions))["ahead", "belief", "mean"]
        under_way.append(actor(TensorDict({"seen": torch.cat([later, row["goal"][0]])}))["loc"])
        seconds.append(time.perf_counter() - begun)
        action = under_way.popleft()
        step = arm.step(row.set("action", action.expand(1, 2).double().clamp(-1, 1)))["next"]
        total, row = total + step["reward"].item(), step.exclude("reward")
        begun = time.perf_counter()
        reading = row[0].select("pixels", "observed", "encoder", "encoder_observed")
        belief = model.step(belief.update(reading).set("action", action))
        seconds[-1] += time.perf_counter() - begun
    return total, 1e3 * sorted(seconds)[len(seconds) // 2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=60, help="demonstrations")
    parser.add_argument("--updates", nargs=3, type=int, default=(400, 600, 200), help="of motion, camera and whole")
    parser.add_argument("--batches", type=int, default=60, help="of PPO, 960 steps each; 0: no policy")
    parser.add_argument("--out", type=Path, default=Path("runs/own-arm"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smoke", action="store_true", help="a tiny run of everything")
    args = parser.parse_args()
    arms = 16
    if args.smoke:
        arms, args.out = 1, args.out.with_name("own-arm-smoke")
        args.episodes, args.updates, args.batches = 10, [2] * 3, 1
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)

    # Demonstrations, as a data set; the filter, in three stages.
    rollouts, unseen = demonstrate(args.episodes, 1), demonstrate(arms, 100_000)
    print(f"{arms} unseen episodes")
    model, settings = learn(rollouts, unseen, args.out / "training", tuple(args.updates))
    out, both = errors(model, unseen)
    print(f"  both, after the training of the whole: {both}")
    print(f"  encoders alone: {errors(model, unseen, 'observed')[1]}")
    print(f"  camera alone: {errors(model, unseen, 'encoder_observed')[1]}")
    names = ["shoulder, rad", "elbow, rad", "shoulder, rad/s", "elbow, rad/s"]
    dots = {k: out["encoder"][0, :, k].where(out["encoder_observed"][0, :, 0], torch.nan) for k in (0, 1)}
    axes = plot_bands(out[0], dims=range(4), names=names, readings=dots, time=DT)
    axes[0].figure.savefig(args.out / "arm.png", dpi=80)
    if not args.batches:
        return
    # The policy on the predicted belief at the time when its action runs.
    actor = make_actor()
    curve = ppo(model, actor, args.batches, arms)
    print(f"return of an episode: {curve[0]:.1f} in the first batch")
    for name, key in (("of that moment", ("ahead", "belief", "mean")), ("of now", ("belief", "mean"))):
        print(f"  after it, on the belief {name}: {test(model, actor, key, 2 * arms):.1f}")

    # On the robot: the filter from its folder, its step as a file, and a loop.
    save_pretrained(model, args.out / "filter", builder=make_filter, settings=settings, card="# An arm\n")
    torch.save(actor.state_dict(), args.out / "policy.pt")
    again = from_pretrained(args.out / "filter", builders={"make_filter": make_filter})
    example = again.initialise(rollouts[0, 0].exclude("next"))
    export_step(again, example, args.out / "step.pt2", compiled=not args.smoke)
    total, cycle = run(again, actor)
    print(f"in a loop: return {total:.1f} of one episode, {cycle:.1f} ms a cycle")


if __name__ == "__main__":
    main()
