"""A policy that was trained with the base's true velocity, and runs on the filter's estimate.

python -m benchmarks.legged.policy --out runs/walk
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from itertools import count, product
from pathlib import Path

import pandas as pd
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs import EnvBase, ExplorationType, TransformedEnv, set_exploration_type
from torchrl.envs.transforms import Transform, UnaryTransform

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import markdown, pick, records, write_page, write_table
from benchmarks.control.arms import Arm, Inputs
from benchmarks.control.ppo import PPO, Settings
from benchmarks.legged.pictures import Camera
from benchmarks.legged.task import ROWS, Ground, Robot
from benchmarks.legged.training import LSTM, VAR, VELOCITY, trained_lstm
from benchmarks.legged.walk import FASTEST, Walk, acted, play, up_of
from torch_denkf.applications.legged import QUADRUPED, LearnedContacts, legged_filter
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.deployment import export_step, load_step
from torch_denkf.deployment.files import replacing
from torch_denkf.functional.manifolds import rotate
from torch_denkf.plots import write_video
from torch_denkf.training.checkpoint import read_checkpoint
from torch_denkf.transforms import DEnKFTransform

TRUE, INPUT = ("true", "velocity"), "input"
READ = ("imu", "joints", "joint_rates", "contact")
#: Grounds by name. All trainings are on the first.
GROUNDS = {
    "ground of the training": Ground((0.4, 1.0), (0.01, 0.01), (0.0, 60.0)),
    "slippery, friction 0.2": Ground((0.2, 0.2), (0.01, 0.01), (0.0, 60.0)),
    "soft": Ground((0.5, 1.0), (0.05, 0.05), (0.0, 60.0)),
}
TRUTH, SPREAD, GAIT = "truth", "belief and spread, trained on them", "nothing: the gait alone"
#: Sources of the velocity for the policy that was trained on the truth; a policy trained on beliefs; no policy.
ARMS = (TRUTH, "belief", "LSTM", "zero", "integrated inertial sensor", SPREAD, GAIT)
#: Units of velocities in m/s, vertical, angular rates in rad/s, joints in rad, commands in m/s and the gait's phase.
SCALE = (*[0.3] * 3, 0.2, 0.2, 1.0, *[0.5] * 3, *[0.5] * 16, 0.3, 0.2, 1.0, 1.0)
SPREADS = (0.05,) * 3  # m/s


@dataclass(frozen=True)
class Study:
    """Tests a walking policy on a belief about its base's velocity."""

    out: Path = Path("runs/walk")  # folder for policy.md, walk.gif and weights; finished parts are not run again
    robots: int = 32  # in a batch
    seconds: float = 6.0  # of an episode of the training
    test_seconds: float = 8.0
    batches: int = 60  # of one episode of each robot
    spread_batches: int = 40  # of the policy that is trained on the belief; 0 for none
    lstm_updates: int = 500
    seed: int = 0
    smoke: bool = False  # a few short episodes


class Reads(Transform):
    """Writes ``"input"``, the input of a policy, with the velocity of an arm.

    Args:
        arm: source of the velocity.
        sensor: pose of the inertial sensor on the base, ``[7]``.
    """

    def __init__(self, arm: str, sensor: Tensor):
        super().__init__(out_keys=[INPUT])
        self.arm, self.sensor = arm, sensor
        self.width = len(SCALE) + (3 if arm == SPREAD else 0)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        td, axes = next_tensordict, self.sensor[:4]
        if self.arm in (TRUTH, GAIT):
            up, velocity = up_of(td["true", "orientation"]), td[TRUE]
        else:
            up, velocity = rotate(axes, up_of(td["belief", "mean"][..., :4])), td[VELOCITY]
        if self.arm == "zero":
            velocity = torch.zeros_like(velocity)
        if self.arm == "LSTM":
            velocity = td["lstm"]
        more = [td[VAR].sqrt()] if self.arm == SPREAD else []
        parts = [velocity, up, rotate(axes, td["imu"][..., :3]), td["joints"], td["command"], td["phase"], *more]
        return td.set(INPUT, torch.cat(parts, -1))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec):
        observation_spec[INPUT] = Unbounded((*observation_spec.shape, self.width))
        return observation_spec


class Estimates(Transform):
    """Writes ``"lstm"``, the velocity by a recurrent network, whose memory is reset with the environment."""

    def __init__(self, network: LSTM):
        super().__init__(out_keys=["lstm"])
        self.network = network

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        features = (self.network.read(next_tensordict.unsqueeze(-1)) - self.network.loc) / self.network.scale
        hidden, self.memory = self.network.memory(features, self.memory)
        return next_tensordict.set("lstm", self.network.head(hidden)[..., 0, :3])

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self.memory = None
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec):
        observation_spec["lstm"] = Unbounded((*observation_spec.shape, 3))
        return observation_spec


class Laboratory:
    """Makes environments and policies of a study, which share the filter and its compiled step."""

    def __init__(self, study: Study):
        self.study = study
        self.model = Walk(1, GROUNDS["soft"], 0).robots[0].model
        self.sensor = LegKinematics(self.model, **QUADRUPED).base
        self.filter = legged_filter(self.model, **QUADRUPED, dt=0.01, kind="EKF")
        self.step, self.network = None, None

    def compiled(self) -> None:
        """Compiles a step of the filter for all robots in minutes, which reduces its time to a tenth."""
        file = self.study.out / f"step-{self.study.robots}.pt2"
        if not file.exists():
            row = Walk(self.study.robots, GROUNDS["soft"], 0).reset().select(*READ)
            export_step(self.filter, self.filter.initialise(row.clone()).update(row), file)
        self.step = load_step(file)

    def env(self, arm: str, ground: str, seed: int) -> EnvBase:
        """Returns robots on a ground, with the policy's input of an arm."""
        env = TransformedEnv(Walk(self.study.robots, GROUNDS[ground], seed))
        if arm == "integrated inertial sensor":
            env.append_transform(UnaryTransform(["contact"], ["contact"], fn=torch.zeros_like))  # no foot ever stands
        if arm not in (TRUTH, GAIT):
            env.append_transform(DEnKFTransform(self.filter, packaged=self.step))
        if arm == "LSTM":
            env.append_transform(Estimates(self.network))
        return env.append_transform(Reads(arm, self.sensor))

    def agent(self, arm: str, batches: int) -> PPO:
        """Returns a PPO agent with small initial actions."""
        scale = torch.tensor([*SCALE, *(SPREADS if arm == SPREAD else ())])
        settings = Settings(gamma=0.95, lmbda=0.95, minibatch=480, lr=1e-3)
        agent = PPO(Arm(INPUT), Inputs(0, 3, scale, 1.0), settings, batches)
        with torch.no_grad():
            for name, value in agent.actor.named_parameters():
                if name.endswith("log_std"):
                    value.fill_(-1.2)
        return agent

    def trained(self, arm: str, batches: int) -> PPO:
        """Returns a policy trained on an arm's input; resumes an interrupted training."""
        agent, file, first = self.agent(arm, batches), self.study.out / f"{arm}.pt", 0
        parts = {"loss": agent.loss, "optimiser": agent.optimiser, "schedule": agent.schedule}
        if file.exists():
            kept = torch.load(file, weights_only=True)
            first = kept.pop("batches")
            for name, state in kept.items():
                parts[name].load_state_dict(state)
        if first >= batches:
            return agent
        env = self.env(arm, next(iter(GROUNDS)), self.study.seed + 1 + first)
        for number in range(first, batches):
            torch.manual_seed(1000 * self.study.seed + number)
            began = time.process_time()
            with set_exploration_type(ExplorationType.RANDOM):
                data = acted(play(env, agent.policy, round(100 * self.study.seconds), [INPUT]))
            agent.update(data)
            reward, spent = data["next", "reward"].mean().item(), time.process_time() - began
            print(f"{arm}, batch {number + 1}: reward {reward:.3f}, {spent:.1f} s", flush=True)
            if (number + 1) % 5 == 0 or number + 1 == batches:
                state = {name: part.state_dict() for name, part in parts.items()}
                with replacing(file) as beside:
                    torch.save({**state, "batches": number + 1}, beside)
        return agent

    def lstm(self, agent: PPO) -> LSTM:
        """Returns an LSTM that estimates the velocity, trained on the walks of the policy that reads the truth."""
        contacts = LearnedContacts(self.model, **QUADRUPED, rows=ROWS)
        if (file := self.study.out / "lstm" / "lstm.pt").exists():
            network = LSTM(contacts)
            network.load_state_dict(read_checkpoint(file)["lstm"])
            return network
        logs = []
        for number in range(2):
            torch.manual_seed(number)
            env = self.env(TRUTH, next(iter(GROUNDS)), self.study.seed + 900 + number)
            keep = [*READ, "true"]
            with set_exploration_type(ExplorationType.RANDOM):
                log = play(env, agent.policy, round(100 * self.study.seconds), keep)["next"].select(*keep)
            rows = slice(min(100, log.shape[1] // 2), None)
            doubtful = torch.zeros(log.shape, dtype=torch.bool)
            logs.append(Robot("quadruped", self.model, QUADRUPED, 0.01, log, rows, doubtful))
        return trained_lstm(*logs, contacts, self.study.lstm_updates, self.study.out)


def scored(data: TensorDict) -> dict[str, Tensor]:
    """Returns each robot's return, velocity error against the command in m/s, falls, and error of the estimate.

    Args:
        data: of :func:`play`.
    """
    after = data["next"]
    wrong = (after[TRUE][..., :2] - data["command"]).square().sum(-1).mean(1).sqrt()
    fell = (up_of(after["true", "orientation"])[..., 2] < 0.5).any(1).float()
    off = (after[INPUT][..., :3] - after[TRUE]).square().sum(-1).mean(1).sqrt()
    return {"return": data["next", "reward"].sum((1, 2)) / 100, "error": wrong, "falls": fell, "off": off}


def tested(laboratory: Laboratory, policies: dict[str, TensorDictModuleBase]) -> pd.DataFrame:
    """Returns a row for each ground, arm and robot; robots, commands and forces are the same for all arms."""
    study, file = laboratory.study, laboratory.study.out / "policy.csv"
    rows = records(file)
    for (number, ground), arm in product(enumerate(GROUNDS), ARMS):
        policy = policies.get(arm if arm in (SPREAD, GAIT) else TRUTH)
        if policy is None or pick(rows, ground=ground, arm=arm):
            continue
        env = laboratory.env(arm, ground, study.seed + 500 + number)
        torch.manual_seed(0)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            data = play(env, policy, round(100 * study.test_seconds), ["true", "command", INPUT])
        found = pd.DataFrame({key: value.numpy() for key, value in scored(data).items()})
        print(ground, arm, found.mean().to_dict(), flush=True)
        rows += found.assign(ground=ground, arm=arm, robot=range(study.robots)).to_dict("records")
        write_table(rows, file, ())
    return pd.read_csv(file)


def film(laboratory: Laboratory, policy: PPO, every: int = 8) -> None:
    """Draws a robot on slippery ground with the command, the true and the estimated velocity."""
    alone = Laboratory(replace(laboratory.study, robots=1))
    env = alone.env("belief", list(GROUNDS)[1], laboratory.study.seed + 600)
    robot, frames, rows = env.base_env.robots[0], [], count()
    camera = Camera(robot.model, robot.data)

    def watch(row: TensorDict) -> None:
        if next(rows) % every == 0:
            command = torch.cat([row["command"][0], torch.zeros(1)])
            arrows = {"white": command, "limegreen": row[TRUE][0], "dodgerblue": row[VELOCITY][0]}
            frames.append(camera.frame(arrows, row[VAR][0].sqrt()))

    with set_exploration_type(ExplorationType.DETERMINISTIC):
        play(env, policy.policy, round(100 * laboratory.study.test_seconds), ["command"], watch)
    write_video(laboratory.study.out / "walk.gif", frames, 100 / every)


def page(rows: pd.DataFrame, study: Study) -> str:
    """Returns the tables."""
    text = [
        "# A policy that walks on the belief of its base's velocity",
        "",
        f'The return is the sum of rewards of {study.test_seconds:g} s, {study.test_seconds:g} at most. "Of the '
        "truth's\" is the share of the return on the true velocity of the policy that was trained with it; after it "
        "stands the standard error of the mean of the robots' differences. The velocity's error is how far the base is "
        "from its command, forwards and sideways; that of the estimate, how far what the policy reads is from the "
        "truth, all three axes. Both are root mean squares. The gait alone takes its strides from the command, without "
        "any policy.",
    ]
    for ground in GROUNDS:
        own = rows[rows["ground"] == ground].pivot(index="robot", columns="arm")
        own = own.reindex(columns=[arm for arm in ARMS if arm in own["return"]], level="arm")
        returned, truth = own["return"], own["return"][TRUTH]
        share, spread = 100 * returned.mean() / truth.mean(), 100 * returned.sub(truth, axis=0).sem() / truth.mean()
        wrong, off = ((own[name] ** 2).mean() ** 0.5 for name in ("error", "off"))
        falls = own["falls"].sum().map("{:.0f}".format) + f" of {len(own)}"
        cells = {
            "return": returned.mean().map("{:.2f}".format),
            "of the truth's, %": share.map("{:.1f}".format) + " ± " + spread.map("{:.1f}".format),
            "velocity's error, m/s": wrong.map("{:.3f}".format),
            "estimate's error, m/s": off.map("{:.3f}".format).drop(GAIT, errors="ignore"),
            "falls": falls,
        }
        table = pd.DataFrame(cells).reindex(returned.columns).rename_axis("velocity by")
        text += ["", f"## {ground.capitalize()}", "", *markdown(table)]
    text += [
        "",
        f"{study.robots} robots a ground, each with friction, motors, load, commands, forces and biases of its own, "
        f"the same for all rows. One training each: {study.batches} batches of {study.robots} episodes of "
        f"{study.seconds:g} s with the true velocity, {study.spread_batches} on the belief and its spread. Commands "
        f"are up to {FASTEST[0]:g} m/s forwards and {FASTEST[1]:g} m/s sideways.",
        "",
        *made_by("legged.policy"),
        f"* Seed: {study.seed}.",
    ]
    return "\n".join(text) + "\n"


def main() -> None:
    """Trains, tests, and writes the page and the video."""
    study = parse(Study)
    if study.smoke:
        tiny = {"robots": 2, "seconds": 0.1, "test_seconds": 0.1, "batches": 1, "spread_batches": 1, "lstm_updates": 1}
        study = replace(study, out=Path(tempfile.mkdtemp()), **tiny)
    study.out.mkdir(parents=True, exist_ok=True)
    laboratory = Laboratory(study)
    agent = laboratory.trained(TRUTH, study.batches)
    laboratory.network = laboratory.lstm(agent)
    still = TensorDictModule(lambda command: torch.zeros(len(command), 3), ["command"], ["action"])
    policies = {TRUTH: agent.policy, GAIT: still}
    if not study.smoke:
        laboratory.compiled()
    rows = tested(laboratory, policies)
    if study.spread_batches:
        policies[SPREAD] = laboratory.trained(SPREAD, study.spread_batches).policy
        rows = tested(laboratory, policies)
    write_page(page(rows, study), study.out / "policy.md")
    if not study.smoke:
        film(laboratory, agent)


if __name__ == "__main__":
    main()
