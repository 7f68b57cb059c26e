"""The study: episodes, trained filters, and one controller on three estimates of an arm's state."""

from __future__ import annotations

import tempfile
import time
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import TransformedEnv

from benchmarks.arms.arms import ARMS, Arm, HoldAngles, make_env, make_one, wrap
from benchmarks.arms.filters import make_filter, train_motion, train_sensor
from benchmarks.arms.page import SOURCES, page
from benchmarks.arms.sensor import JointSensor
from benchmarks.common.arguments import some_of
from benchmarks.common.jobs import once, read_rows, same_settings
from benchmarks.common.tables import write_page, write_table
from torch_denkf.filters import DEnKF
from torch_denkf.transforms import DEnKFTransform

AT_ONCE = 20  # arms side by side
TEST = 1000  # seed of the test episodes


@dataclass(frozen=True)
class Study:
    """A filter between an arm and its policy: dm_control's reacher and manipulator, noisy encoders or pixels.

    Collects episodes, trains a DEnKF of the arm's joints, appends it to the environment, and lets one controller move
    the arm to a goal on the readings, on the belief and on the truth. See benchmarks/arms/README.md.
    """

    tasks: some_of(ARMS) = tuple(ARMS)
    sources: some_of(SOURCES) = ("encoders",)
    demos: int = 100  # episodes of 200 steps to learn the motion from
    pictures: int = 24000  # images of single poses, to learn the sensor from
    films: int = 40  # episodes of 60 steps with images, to measure the sensor's errors on
    episodes: int = 40  # to test on
    steps: int = 200  # of a test episode
    motion_updates: int = 8000
    sensor_updates: int = 6000
    seed: int = 0
    out: Path = Path("runs/dm_control_arms")  # an interrupted run resumes from here
    smoke: bool = False  # some seconds, to see that it runs


def run(env: TransformedEnv, policy: TensorDictModule, steps: int, seed: int) -> TensorDict:
    """Returns episodes ``[N, T]``; their initial states depend only on the seed."""
    torch.manual_seed(seed)
    env.set_seed(seed)
    with torch.no_grad():
        return env.rollout(steps, policy, break_when_any_done=False)


def collect(arm: Arm, pixels: bool, episodes: int, steps: int, seed: int) -> TensorDict:
    """Returns episodes of the controller on the truth with noise on its actions."""
    env = make_env(arm, pixels, min(AT_ONCE, episodes))
    policy = TensorDictModule(partial(arm.control, explore=0.5), in_keys=["state", "goal"], out_keys=["action"])
    rounds = range(-(-episodes // AT_ONCE))
    data = torch.cat([run(env, policy, steps, seed + number).exclude("next") for number in rounds])
    env.close()
    return data


def poses(arm: Arm, count: int, seed: int) -> TensorDict:
    """Returns images and states ``[N]`` of arms at the start of episodes."""
    env = make_env(arm, True, min(AT_ONCE, count))
    torch.manual_seed(seed)
    env.set_seed(seed)
    frames = torch.cat([env.reset().select("pixels", "state") for _ in range(-(-count // AT_ONCE))])
    env.close()
    return frames


def trained(arm: Arm, pixels: bool, study: Study, out: Path) -> DEnKF:
    """Returns the trained filter of an arm; each part learns from data of another seed."""
    seed = 10_000 * (study.seed + 1)
    torch.manual_seed(study.seed)
    sensor = error = None
    if pixels:
        frames = poses(arm, study.pictures, seed)
        sensor = JointSensor(arm)
        train_sensor(sensor, frames, study.sensor_updates, out, study.seed)
        films = collect(arm, True, study.films, 60, seed + 1000)
        with torch.no_grad():
            read = torch.stack([sensor(film)["sensor", "reading"] for film in films])
        error = (read - arm.places(arm.split(films["state"])[0]).flatten(-2)).flatten(0, 1).std(0)
    motion = collect(arm, False, study.demos, 200, seed + 2000)
    denkf = make_filter(arm, motion, sensor, error)
    train_motion(denkf, motion, study.motion_updates, out, study.seed)
    return denkf


def scores(arm: Arm, episodes: TensorDict, key) -> list[dict]:
    """Returns a row for each episode; scores "at the end" are of its last quarter, when the arm should be at rest."""
    estimate, truth = (arm.split(episodes["next", name]) for name in (key, "state"))
    last = episodes.shape[1] // 4
    believed, tip = (100 * arm.tip(part[0][:, -last:]) for part in (estimate, truth))
    columns: dict[str, Tensor] = {
        "angle": wrap(estimate[0] - truth[0]).rad2deg().square().mean((1, 2)).sqrt(),
        "velocity": (estimate[1] - truth[1]).square().mean((1, 2)).sqrt(),
        "tip": (100 * arm.tip(episodes["goal"][:, -last:]) - tip).norm(dim=-1).mean(-1),
        "error": (believed - tip).norm(dim=-1).mean(-1),
        "offset": (believed - tip).mean(1).norm(dim=-1),
        "return": episodes["next", "reward"].sum((1, 2)),
        "effort": episodes["action"].square().mean((1, 2)),
    }
    return [
        {"episode": number, **{name: values[number].item() for name, values in columns.items()}}
        for number in range(len(episodes))
    ]


def compare(arm: Arm, denkf: DEnKF, missing: float, pixels: bool, study: Study) -> list[dict]:
    """Returns the rows of one controller on readings, belief and true state, in the same episodes."""
    reading = denkf["analysis"].in_keys[2]
    cases = {"reading": "held", "belief": ("belief", "mean")} | ({} if missing else {"truth": "state"})
    rows, envs = [], {}
    for name, key in cases.items():
        blind = name == "truth"
        if blind not in envs:
            envs[blind] = make_env(arm, pixels and not blind, study.episodes, missing)
            if not blind:
                envs[blind].append_transform(DEnKFTransform(denkf, diagnostics=[reading] if pixels else []))
                envs[blind].append_transform(HoldAngles(arm, reading))
        policy = TensorDictModule(arm.control, in_keys=[key, "goal"], out_keys=["action"])
        episodes = run(envs[blind], policy, study.steps, TEST)
        rows += [{"missing": missing, "estimate": name, **row} for row in scores(arm, episodes, key)]
    for env in envs.values():
        env.close()
    return rows


def rows_of(task: str, source: str, study: Study) -> list[dict]:
    """Collects, trains and compares.

    Raises:
        SystemExit: if dm_control cannot show the arm.
    """
    arm, pixels, start = ARMS[task], source == "pixels", time.process_time()
    try:
        make_one(arm, pixels).reset()
    except Exception as error:  # each OpenGL library has its own
        where = "libegl1 and libgl1-mesa-dri (Debian)" if pixels else "dm-control and mujoco<4"
        raise SystemExit(f"dm_control cannot show {task}: {type(error).__name__}: {error}. Install {where}.") from error
    denkf = trained(arm, pixels, study, study.out / "filters" / f"{task}-{source}")
    rows = [row for missing in (0.0, 0.3) for row in compare(arm, denkf, missing, pixels, study)]
    seconds = time.process_time() - start
    return [{"task": task, "source": source, "seed": study.seed, "cpu_s": seconds, **row} for row in rows]


def run_study(study: Study) -> None:
    """Runs the missing parts, and writes ``table.csv`` and ``table.md`` to the study's folder.

    Raises:
        SystemExit: if the folder was begun with other settings, or if dm_control cannot show an arm.
    """
    if study.smoke:
        with tempfile.TemporaryDirectory() as folder:
            tiny = {"demos": 4, "pictures": 40, "films": 2, "episodes": 2, "steps": 24}
            updates = {"motion_updates": 20, "sensor_updates": 3}
            run_study(replace(study, smoke=False, out=Path(folder), **tiny, **updates))
        print("A smoke run: it ran, and its figures say nothing.")
        return
    which = {"tasks", "sources", "out", "smoke"}
    same_settings(study.out, {name: value for name, value in asdict(study).items() if name not in which})
    for task in study.tasks:
        for source in study.sources:
            once(study.out / "parts" / f"{task}-{source}.json", partial(rows_of, task, source, study))
    rows = read_rows(sorted((study.out / "parts").glob("*.json")))
    order = ("task", "source", "missing", "estimate", "seed", "episode")
    write_page(page(write_table(rows, study.out / "table.csv", order)), study.out / "table.md")
