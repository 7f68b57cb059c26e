"""Episodes of the UR5 table's expert, written as demos: one after another, or in worker processes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from torch_denkf._checks import check_count, check_number
from torch_denkf.applications.ur5.data.files import Demo, Entry, write_demo
from torch_denkf.applications.ur5.envs.expert import UR5Expert
from torch_denkf.applications.ur5.envs.table import STEPS, UR5TableEnv
from torch_denkf.applications.ur5.simulation.names import DOMAIN_NAMES, TASKS, DomainName, TaskName
from torch_denkf.data.pictures import check_size
from torch_denkf.deployment.workers import follow_parent

DRAWS = 20  # episodes tried for a demo; the expert seldom fails


@dataclass(frozen=True)
class Options:
    """Settings of a demo, besides its number."""

    size: tuple[int, int]
    frames: int | None
    domain: DomainName
    tasks: tuple[TaskName, ...]
    seed: int
    max_steps: int
    noise: float

    def __post_init__(self):
        object.__setattr__(self, "size", tuple(self.size))  # a list has no hash
        unknown = [task for task in self.tasks if task not in TASKS]
        if unknown or not self.tasks or len(set(self.tasks)) < len(self.tasks):
            raise ValueError(f"tasks are some of {', '.join(TASKS)}, each once; got {list(self.tasks)}")
        if self.domain not in DOMAIN_NAMES:
            raise ValueError(f"unknown domain {self.domain!r}; there are {', '.join(DOMAIN_NAMES)}")
        check_size(self.size)
        check_count("seed", self.seed, least=0)
        check_count("max_steps", self.max_steps)
        if self.frames is not None:
            check_count("frames", self.frames, least=0)
        check_number("noise", self.noise, least=0)


def make_demos(root: Path, options: Options, numbers: list[int], processes: int) -> Iterator[Entry]:
    """Writes demos of these numbers and yields their entries in order of completion.

    Raises:
        RuntimeError: without OpenGL, if a demo fails repeatedly, or if a worker is killed.
        OSError: if a file cannot be written.
    """
    if not numbers:
        return
    if processes == 1:
        try:
            for number in numbers:
                yield _make(root, options, number)
        finally:
            _close()
        return
    # Not forked: OpenGL hangs in a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(processes, len(numbers)), context, initializer=_start_worker) as pool:
        try:
            waiting = [pool.submit(_make, root, options, number) for number in numbers]
            for future in as_completed(waiting):
                yield future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _start_worker() -> None:
    torch.set_num_threads(1)
    follow_parent()


_envs: dict[tuple[Options, str], UR5TableEnv] = {}  # of this process: compiling a scene and opening OpenGL take time


def _close() -> None:
    while _envs:
        _envs.popitem()[1].close()


def _make(root: Path, options: Options, number: int) -> Entry:
    for attempt in range(DRAWS):
        demo = _episode(options, number, attempt)
        if demo is not None:
            return write_demo(root, demo, failures=attempt)
    raise RuntimeError(
        f"the expert failed in all of {DRAWS} episodes drawn for demo {number}, {_task(options, number)!r} in domain "
        f"{options.domain!r}, noise {options.noise}; pass less noise"
    )


def _task(options: Options, number: int) -> TaskName:
    return options.tasks[number % len(options.tasks)]


def _episode(options: Options, number: int, attempt: int) -> Demo | None:
    """Returns one episode, or None if it failed."""
    task, length = _task(options, number), options.max_steps
    if (options, task) not in _envs:
        _envs[options, task] = UR5TableEnv(
            task,
            options.domain,
            size=options.size,
            from_pixels=options.frames is not None,
            pixels_dtype=torch.uint8,
            max_steps=max(length, STEPS),
            seed=0,
        )
    env = _envs[options, task]
    streams = np.random.SeedSequence([options.seed, number, attempt]).spawn(3)
    episode, shots, noise = (int(stream.generate_state(1, np.uint64)[0] >> np.uint64(1)) for stream in streams)
    env._set_seed(episode)  # set_seed would seed torch, too, and that is the caller's
    expert = UR5Expert(noise=options.noise, generator=torch.Generator().manual_seed(noise))
    drawn: list[int] = []
    if options.frames is not None:
        drawn = list(range(length))
        if 0 < options.frames < length:
            drawn = sorted(np.random.default_rng(shots).choice(length, options.frames, replace=False).tolist())
        env.render_at = drawn
    states, actions, successes, pictures = [], [], [], []
    with torch.no_grad():
        row = env.reset()
        for step in range(env.max_steps):
            row = expert(row)
            if step < length:
                states.append(row["state"])
                actions.append(row["action"])
                successes.append(row["success"])
                if options.frames is not None and row["observed"]:
                    pictures.append(row["pixels"])
            row = env.step(row)["next"]
    if not row["success"]:
        return None
    return Demo(
        number,
        task,
        options.domain,
        episode,
        torch.stack(states).numpy(),
        torch.stack(actions).numpy(),
        torch.cat(successes).numpy(),
        np.array(drawn, np.int32),
        torch.stack(pictures).numpy() if pictures else np.zeros((0, 3, *options.size), np.uint8),
    )
