"""Measures the cost of DEnKFTransform in an environment's step at B = 1: a KITTI replay, and dm_control's reacher.

    python -m benchmarks.speed.transform_cost --out benchmarks/speed/results/transform_cost.md

Steps are those of a collector, with random actions: ``env.step_and_maybe_reset``. They run in turn without the
transform, with it, and with a packaged step (``DEnKFTransform(filter, packaged=load_step(path))``), in processor time
of one thread; the cost is the median difference of neighbouring rounds. No filter here reads images: the KITTI filter
is Table I's on noisy velocities (the convolutions are in training_step.py), the reacher's that of
examples/append_to_env.py.
"""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

os.environ.setdefault("MUJOCO_GL", "disabled")  # before dm_control is imported: nothing is rendered here

import torch
from tensordict import TensorDict
from torchrl.envs import CatTensors, Compose, DMControlEnv, DoubleToFloat, EnvBase, TransformedEnv
from torchrl.envs.transforms import Transform

from benchmarks.common.arguments import command, parse
from benchmarks.common.tables import head, line, write_page
from benchmarks.speed.pairs import Row, Timings, in_turn
from benchmarks.speed.workload import car_filter
from examples.append_to_env import NOISE, make_filter
from torch_denkf.applications.car import KITTIReplayEnv
from torch_denkf.applications.car.kitti.render import render_drives
from torch_denkf.applications.reacher.encoders import NoisyEncoders
from torch_denkf.deployment import export_step, load_step
from torch_denkf.filters import DEnKF
from torch_denkf.modules import VectorSensor
from torch_denkf.transforms import DEnKFTransform

TARGETS_MS = {"filter": 0.8, "packaged": 0.3}
LAST = ("quietest", "target", "met")


class Reading(Transform):
    """Writes noisy velocities as ``"reading"`` [*B, 2]."""

    def __init__(self):
        super().__init__(in_keys=["state"], out_keys=["reading"])

    def _apply_transform(self, state: torch.Tensor) -> torch.Tensor:
        return state[..., 3:] + 0.1 * torch.randn_like(state[..., 3:])

    def _reset(self, tensordict, tensordict_reset):
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec):
        """Adds the reading."""
        observation_spec["reading"] = observation_spec["state"].clone()[..., 3:]
        return observation_spec


def kitti_filter() -> DEnKF:
    """Returns the README's filter, with Table I's stochastic head on a reading instead of the image sensor."""
    return car_filter(lambda: VectorSensor(2, 2, in_key="reading"))


def kitti_env(folder: str) -> EnvBase:
    """Returns an environment of a rendered drive in memory, 200 frames of 150x50; no module reads the frames."""
    render_drives(folder, names=["00"], frames=200, processes=1, progress=None)
    return TransformedEnv(KITTIReplayEnv(folder, sequence="00", cache=None), Reading())


def reacher_env() -> EnvBase:
    """Returns the arm with noisy encoders of examples/append_to_env.py."""
    return TransformedEnv(
        DMControlEnv("reacher", "easy"),
        Compose(
            DoubleToFloat(),
            NoisyEncoders(NOISE),
            CatTensors(in_keys=["position", "velocity"], out_key="state", del_keys=False),
        ),
    )


def cases(folder: str) -> dict[str, tuple]:
    """Returns functions that make the environment and its filter, by name."""
    states = torch.tensor([[0.0, 0.0, -1.0, -1.0], [1.0, 1.0, 1.0, 1.0]])  # scales of the transition, rad and rad/s
    return {
        "KITTIReplayEnv, Table I's head": (lambda: kitti_env(folder), kitti_filter),
        "dm_control reacher, learned dynamics": (reacher_env, lambda: make_filter(states)),
    }


class Stepper:
    """Steps an environment with random actions."""

    def __init__(self, env: EnvBase):
        self.env, self.row = env, env.reset()

    def __call__(self) -> None:
        """Runs one step."""
        _, self.row = self.env.step_and_maybe_reset(self.env.rand_action(self.row))


def example_step(env: EnvBase, filter: DEnKF) -> TensorDict:
    """Returns the filter's input in a step of the environment, as an example for the export."""
    start = env.rand_action(env.reset())
    frame = env.step(start.copy())["next"].select("reading", "encoder", "observed", strict=False)
    return filter.initialise(frame.update(start.select("action", "state", strict=False)))


def steppers(make_env, make_filter, folder: str) -> dict[str, Stepper]:
    """Returns steppers of the environment: without the filter, with it, and with a packaged step."""
    filter = make_filter()
    example = example_step(make_env(), filter)
    path = export_step(filter, example, Path(folder) / f"{id(filter)}.pt2")
    envs = {"without": make_env(), "filter": make_env(), "packaged": make_env()}
    envs["filter"].append_transform(DEnKFTransform(filter))
    envs["packaged"].append_transform(DEnKFTransform(filter, packaged=load_step(path)))
    return {kind: Stepper(env) for kind, env in envs.items()}


def measure(rounds: int = 41, steps: int = 50) -> dict[str, Timings]:
    """Returns the seconds per step of every round, by case and by kind."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as folder:
        return {name: in_turn(steppers(*makers, folder), rounds, steps) for name, makers in cases(folder).items()}


def cost_ms(timings: Timings, kind: str) -> float:
    """Returns the median over the rounds of the time that the transform adds to a step."""
    return 1e3 * median(b - a for a, b in zip(timings.rounds["without"], timings.rounds[kind], strict=True))


def rows_of(name: str, timings: Timings) -> dict[str, Row]:
    """Returns rows with the milliseconds that the transform adds to a step (not a ratio), by kind."""
    rates = {kind: f"{1e6 / timings.micro(kind):,.0f}" for kind in timings.rounds}
    return {
        kind: Row(
            f"DEnKFTransform ({kind}) on {name}, B=1: ms it adds to a step",
            cost_ms(timings, kind),
            TARGETS_MS[kind],
            ours_us=timings.micro(kind),
            theirs_us=timings.micro("without"),
            note=f"not a ratio; {rates['without']} steps per second without, {rates[kind]} with",
        )
        for kind in ("filter", "packaged")
    }


def rows(seconds: float) -> list[Row]:
    """Returns the rows for ``make bench``; ``seconds`` does not limit them."""
    return [row for name, timings in measure().items() for row in rows_of(name, timings).values()]


def table(found: dict[str, Timings], command: str, elapsed: float) -> str:
    """Returns the Markdown page."""
    lines = [
        "# Cost of DEnKFTransform",
        "",
        "One environment, E = 32, one thread, processor time, no image read; medians over rounds of all three kinds in",
        "turn. A step is `env.step_and_maybe_reset(env.rand_action(...))`. Filter: `DEnKFTransform(filter)`; packaged:",
        "`DEnKFTransform(filter, packaged=load_step(export_step(filter, example, path)))`.",
        "Quietest: between the fastest rounds of either kind, which other work disturbed least.",
        "",
        *head("environment and filter", "step", "steps/s without", "with", "added, ms per step", *LAST),
    ]
    for name, timings in found.items():
        for kind, row in rows_of(name, timings).items():
            rates = [f"{1e6 / timings.micro(key):,.0f}" for key in ("without", kind)]
            least = 1e3 * (min(timings.rounds[kind]) - min(timings.rounds["without"]))
            lines.append(line(name, kind, *rates, f"{row.ratio:.2f}", f"{least:.2f}", TARGETS_MS[kind], row.met_text))
    load = f"{os.cpu_count()} cores, load {os.getloadavg()[2]:.1f}"
    lines += [
        "",
        "Where other work shares the cores, caches are cold at every turn, and all of these times grow, also as",
        f"processor time: {load}. `{command}`: {elapsed:.0f} s; torch {torch.__version__}.",
    ]
    return "\n".join(lines) + "\n"


@dataclass
class TransformCost:
    """Measures the time that DEnKFTransform adds to an environment's step at B = 1."""

    rounds: int = 41  # measurements of each kind
    out: Path | None = None  # write the table to this Markdown file
    smoke: bool = False  # one round of few steps: does it run?

    def __call__(self) -> None:
        """Measures and prints."""
        began = time.perf_counter()
        found = measure(1, 5) if self.smoke else measure(self.rounds)
        write_page(table(found, command("speed.transform_cost"), time.perf_counter() - began), self.out)


if __name__ == "__main__":
    parse(TransformCost)()
