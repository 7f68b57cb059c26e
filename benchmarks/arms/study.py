"""The study: episodes, the filter of the arm's joints, its training, and one controller on three estimates."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import TransformedEnv
from tyro.conf import arg

from benchmarks.arms.arms import ARMS, NOISE, SIDE, Arm, HoldReading, make_env, make_one, wrap
from benchmarks.common.tables import head, line
from torch_denkf import modules as m
from torch_denkf._files import write_text
from torch_denkf.filters import DEnKF
from torch_denkf.objectives import DEnKFLoss
from torch_denkf.training import FilterTrainer, Stage
from torch_denkf.transforms import DEnKFTransform

DRIFT = 0.004  # rad a step: noise of the angles, which the learned accelerations do not have


@dataclass(frozen=True)
class Study:
    """A filter between an arm and its policy: dm_control's reacher and manipulator, noisy encoders or pixels.

    Collects episodes, trains a DEnKF of the arm's joints, appends it to the environment, and lets one controller move
    the arm to a goal on the readings, on the belief and on the truth. See benchmarks/arms/README.md.
    """

    task: Literal[tuple(sorted(ARMS))] = "reacher"
    source: Annotated[Literal["proprioception", "pixels"], arg(name="from")] = "proprioception"
    demos: int | None = None  # episodes to train on; by default 100, from pixels 240
    episodes: int = 20  # episodes to test on
    steps: int | None = None  # of an episode; by default 200, from pixels 120
    sensor_updates: int = 1500
    updates: int = 500
    seed: int = 0
    out: Path = Path("runs/dm_control_arms")
    smoke: bool = False  # some seconds, to see that it runs, on both tasks

    @property
    def pixels(self) -> bool:
        """Whether pictures are read."""
        return self.source == "pixels"


def run(env: TransformedEnv, policy: TensorDictModule, steps: int, seed: int) -> TensorDict:
    """Episodes ``[N, T]`` that begin alike for all policies."""
    torch.manual_seed(seed)
    env.set_seed(seed)
    with torch.no_grad():
        return env.rollout(steps, policy, break_when_any_done=False)


# ------------------------------------------------------------------------------------------------------ the filter


class ArmTransition(m.SubModel):
    """Learned accelerations and their noise; the new velocity turns the angle, whose cosine and sine are the state."""

    def __init__(self, arm: Arm, scale: Tensor, change: Tensor):
        network = m.StochasticMLP(3 * arm.joints + arm.actions, 2 * arm.joints, (64, 64), layer="none", output_gain=0.1)
        super().__init__(network, [("belief", "ensemble"), "action"], [("forecast", "ensemble")])
        self.arm, self.scale, self.change = arm, scale, change  # of velocities and of their steps, rad/s

    def compute(self, ensemble: Tensor, action: Tensor) -> Tensor:
        angles, velocity = self.arm.split(ensemble)
        action = action.to(angles.dtype).unsqueeze(-2).expand(*angles.shape[:-1], -1)
        features = torch.cat([self.arm.join(angles, velocity / self.scale), action], -1)
        mean, noise = self.module(features).chunk(2, -1)
        noise = (0.02 + nn.functional.softplus(noise - 1.5)) * torch.randn_like(noise)
        velocity = velocity + self.change * (mean + noise)
        # As MuJoCo's semi-implicit Euler has it; without the noise an arm at rest would be believed for ever.
        angles = angles + self.arm.dt * velocity + DRIFT * torch.randn_like(angles)
        return self.arm.join(angles, velocity)


def collect(arm: Arm, study: Study) -> TensorDict:
    """Episodes of the controller on the truth with noise on its actions; many short ones where pictures are learned."""
    at_once, steps = (30, min(60, study.steps)) if study.pixels else (study.demos, study.steps)
    env = make_env(arm, study.pixels, min(at_once, study.demos))
    policy = TensorDictModule(partial(arm.control, explore=0.5), in_keys=["state", "goal"], out_keys=["action"])
    rounds = range(-(-study.demos // at_once))
    data = torch.cat([run(env, policy, steps, study.seed + number).exclude("next") for number in rounds])
    env.close()
    return data


def make_filter(arm: Arm, data: TensorDict, pixels: bool) -> DEnKF:
    """State [cos, sin, velocity] of each joint; cosines and sines are read, by encoders or from a picture."""
    states = data["state"].flatten(0, 1)
    loc, scale = states.mean(0), states.std(0)
    change = data["state"].diff(dim=1)[..., 2 * arm.joints :].flatten(0, 1).std(0)
    size, key = 2 * arm.joints, ("sensor", "ensemble") if pixels else "reading"
    sensor, noise = None, m.ConstantNoise([NOISE] * size, in_key="reading")
    if pixels:
        trunk = m.KeypointTrunk(1, channels=(16, 24, 32, 48, 64))
        frames = {"image_shape": (1, SIDE, SIDE), "pixel_loc": 0.25, "pixel_scale": 0.1}
        sensor = m.ImageSensor(size, trunk=trunk, num_cells=(64,), loc=loc[:size], scale=scale[:size], **frames)
        noise = m.DiagonalNoise(size, r=0.3 * scale[:size], loc=loc[:size], scale=scale[:size])
    return DEnKF(
        transition=ArmTransition(arm, scale[size:], change),
        sensor=sensor,
        observation=m.Select(range(size)),
        noise=noise,
        analysis=m.EnsembleAnalysis("etkf", sensor_key=key),
        initial=m.FromSensor(range(size), mean=loc, std=scale, sensor_key=key),
    )


def train(denkf: DEnKF, data: TensorDict, study: Study) -> None:
    """The sensor, if there is one, on single frames of half of the episodes; the rest on windows of the others."""
    scale, sensor = denkf.initial.std, denkf[0] if "pixels" in denkf.in_keys else None

    def fit(stage: Stage) -> None:
        trainer = FilterTrainer(denkf, [stage], out=study.out / stage.name, loggers=(), device="cpu", seed=study.seed)
        trainer.fit(resume=False)

    def draw(count: int, generator: torch.Generator) -> Tensor:
        return torch.randint(count, (48, 1), generator=generator)

    def sample_windows(generator: torch.Generator, length: int) -> TensorDict:
        steps = torch.arange(min(length, data.shape[1]))
        batch = data[draw(len(data), generator), draw(data.shape[1] - len(steps) + 1, generator) + steps]
        observed = torch.rand(*batch.shape, 1, generator=generator) > 0.3  # some readings are missing
        return batch.set("observed", observed)

    if sensor is not None:
        size, (seen, data) = denkf["observation"].dims.numel(), data.split(len(data) // 2)
        frames = seen.select("pixels", "state").flatten(0, 1)

        def loss_sensor(batch: TensorDict) -> dict[str, Tensor]:
            error = sensor(batch)["sensor", "ensemble"].mean(-2) - batch["state"][..., :size]
            return {"loss_sensor": (error / scale[:size]).square().mean()}

        def sample_frames(generator: torch.Generator, _: int | None) -> TensorDict:
            return frames[draw(len(frames), generator).squeeze(-1)]

        fit(Stage("sensor", loss_sensor, sample_frames, study.sensor_updates, parameters=sensor.parameters()))
        with torch.no_grad():  # once, instead of in every window
            data = torch.stack([sensor(episode) for episode in data])
    data = data.exclude("pixels")
    parts = {name: denkf[name] for name in ("transition", "observation", "noise", "analysis")}
    loss = DEnKFLoss(DEnKF(sensor=None, **parts, initial=denkf.initial), sensor=0.0, state_scale=scale)
    lengths = {0: 10, study.updates // 3: 25, study.updates * 3 // 4: 100}
    fit(Stage("filter", loss, sample_windows, study.updates, lr=3e-3, lengths=lengths))


# ----------------------------------------------------------------------------------------------------------- scores


def scores(arm: Arm, episodes: TensorDict, key) -> list[str]:
    """RMSE of angles (degrees) and velocities (rad/s); distance of the tip from its goal in the last quarter (cm),
    return and mean square of the action, with their standard errors over episodes.
    """
    estimate, truth = (arm.split(episodes["next", name]) for name in (key, "state"))
    errors = wrap(estimate[0] - truth[0]) * 57.2958, estimate[1] - truth[1]
    distance = 100 * (arm.tip(episodes["goal"]) - arm.tip(truth[0])).norm(dim=-1)
    rows = (
        distance[:, -(episodes.shape[1] // 4) :].mean(-1),
        episodes["next", "reward"].sum((1, 2)),
        episodes["action"].square().mean((1, 2)),
    )
    return [f"{error.square().mean().sqrt():.2f}" for error in errors] + [
        f"{row.mean():.2f} ± {row.std() / len(row) ** 0.5:.2f}" for row in rows
    ]


def compare(arm: Arm, denkf: DEnKF, missing: float, study: Study) -> list[str]:
    """One controller on three estimates, in the same episodes."""
    env, reading = make_env(arm, study.pixels, study.episodes, missing), denkf["analysis"].in_keys[2]
    env.append_transform(DEnKFTransform(denkf, diagnostics=[reading] if study.pixels else []))
    env.append_transform(HoldReading(arm, reading))
    lines = []
    for name, key in (("reading", "held"), ("**belief**", ("belief", "mean")), ("truth", "state")):
        policy = TensorDictModule(arm.control, in_keys=[key, "goal"], out_keys=["action"])
        episodes = run(env, policy, study.steps, study.seed + 1000)
        lines.append(line(f"{missing:.0%}", name, *scores(arm, episodes, key)))
    env.close()
    return lines


def run_task(study: Study) -> None:
    """Collects, trains and compares; leaves ``table.md`` in the study's folder.

    Raises:
        SystemExit: if dm_control cannot show the arm.
    """
    arm, start = ARMS[study.task], time.perf_counter()
    torch.manual_seed(study.seed)
    try:
        make_one(arm, study.pixels).reset()
    except Exception as error:  # each OpenGL library has its own
        where = "libegl1 and libgl1-mesa-dri (Debian)" if study.pixels else "dm-control and mujoco<4"
        raise SystemExit(
            f"dm_control cannot show {study.task}: {type(error).__name__}: {error}. Install {where}."
        ) from error
    data = collect(arm, study)
    denkf = make_filter(arm, data, study.pixels)
    train(denkf, data, study)
    lines = head("missing", "policy reads", "angles, deg", "velocities, rad/s", "tip to goal, cm", "return", "effort")
    for missing in (0.0, 0.3):
        lines += compare(arm, denkf, missing, study)
    write_text(study.out / "table.md", "\n".join(lines) + "\n")
    print(f"\n{study.task} from {study.source}, {study.episodes} episodes:\n", *lines, sep="\n")
    print(f"\n{time.perf_counter() - start:.0f} s")
