"""A filter inside collectors and worker processes, with every step compared to the same step by hand.

The filter is deterministic, so that an environment's outputs follow from its inputs: the belief at t+1 from that at t,
the action and the frame; the belief after a reset is known; and the inputs of each step and batch must be the outputs
of the one before.

Each process's environment has several rows, so that one exchange between processes moves steps of all of them. Steps
are counted per row: 64 rows that step once are 64 steps, and one exchange.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector, MultiCollector
from torchrl.envs import EnvBase, InitTracker, ParallelEnv, SerialEnv, TransformedEnv

from tests.filters.factories import linear_denkf
from tests.transforms.envs_for_tests import base_env
from torch_denkf.transforms import DEnKFTransform

ENVIRONMENTS, ROWS = 4, 16  # processes of a ParallelEnv, and rows of each
FRAMES = 6400  # steps of all rows in a batch
WORKERS = 2  # processes of a collector
LENGTHS = [3, 5, 17, 23] * (ROWS // 4)  # of the episodes in each row: resets are partial
BELIEF = (("belief", "ensemble"), ("belief", "mean"), ("belief", "var"))
CLOSE = 1e-4  # float32, another order of sums


def plain(seed: int = 0) -> EnvBase:
    """Returns rows without a filter; half of their readings are missing."""
    return base_env(seed=seed, missing=0.5, max_steps=LENGTHS, batch_size=[ROWS])


def filtered(base: EnvBase | None = None, *, seed: int = 0) -> EnvBase:
    """Returns an environment with the filter in it."""
    base = plain(seed) if base is None else base
    return TransformedEnv(TransformedEnv(base, DEnKFTransform(linear_denkf("etkf"))), InitTracker())


def _many(kind: type, inside: bool, first: int = 0) -> EnvBase:
    make = (lambda k: partial(filtered, seed=k)) if inside else (lambda k: partial(plain, k))
    env = kind(ENVIRONMENTS, [make(first + k) for k in range(ENVIRONMENTS)], serial_for_single=False)
    return env if inside else filtered(env)


def _collected(kind: type, make: Any, total: int, **options: Any) -> Iterator[TensorDictBase]:
    collector = kind(make, None, frames_per_batch=FRAMES, total_frames=total, **options)
    try:
        yield from collector
    finally:
        collector.shutdown()


def _rollouts(make: Callable[[], EnvBase], total: int) -> Iterator[TensorDictBase]:
    env = make()
    try:
        carry, steps = env.reset(), FRAMES // (ENVIRONMENTS * ROWS)
        for _ in range(-(-total // FRAMES)):
            out = env.rollout(
                steps, auto_reset=False, tensordict=carry, break_when_any_done=False, return_contiguous=True
            )
            yield out
            carry = env.maybe_reset(env._step_mdp(out[..., -1]))
    finally:
        with suppress(RuntimeError):
            env.close()


#: Environments by where the filter is: in the collector's process, in each of several, or around all of them.
PLACES: dict[str, Callable[[], EnvBase]] = {
    "": filtered,
    " over SerialEnv, filter inside": partial(_many, SerialEnv, True),
    " over ParallelEnv, filter inside": partial(_many, ParallelEnv, True),
    " over ParallelEnv, filter outside": partial(_many, ParallelEnv, False),
}
LAYOUTS: dict[str, Callable[[int], Iterator[TensorDictBase]]] = {
    **{f"Collector{name}": partial(_collected, Collector, make) for name, make in PLACES.items()},
    "ParallelEnv by hand, filter inside": partial(_rollouts, PLACES[" over ParallelEnv, filter inside"]),
}
for sync, options in ((True, {"cat_results": 0}), (False, {})):
    kind = f"MultiCollector, 2 workers, {'in turn' if sync else 'as they come'}"
    alone = [partial(filtered, seed=k) for k in range(WORKERS)]
    nested = [partial(_many, ParallelEnv, True, k * ENVIRONMENTS) for k in range(WORKERS)]
    LAYOUTS[kind] = partial(_collected, MultiCollector, alone, sync=sync, **options)
    LAYOUTS[f"{kind}, each over ParallelEnv, filter inside"] = partial(
        _collected, MultiCollector, nested, sync=sync, **options
    )


class Reference:
    """Compares batches with the filter's own steps, and each batch with the one before."""

    def __init__(self):
        self.filter = linear_denkf("etkf")
        self.start = self.filter.initial.members
        self.ends: list[TensorDictBase] = []  # last rows of the last batch, of each worker if the order is arbitrary
        self.worst = {"step": 0.0, "reset": 0.0, "handed on": 0.0}
        self.frames = self.resets = self.missing = 0

    def look(self, batch: TensorDictBase) -> None:
        """Compares a batch ``[rows, T]``."""
        batch = batch.reshape(-1, batch.shape[-1]) if batch.ndim != 2 else batch
        self.frames += batch.numel()
        following = batch["next"]
        self.missing += int((~following["observed"]).sum())
        row = batch.select(*BELIEF, "action").clone()
        row["observation"], row["observed"] = following["observation"], following["observed"]
        by_hand = self.filter.step(row.reshape(-1))
        for key in BELIEF:
            self._at("step", by_hand[key], following[key].flatten(0, 1))
        self._hands_on(batch[:, :-1]["next"], batch[:, 1:])
        before = [k for k, end in enumerate(self.ends) if _goes_on(end, batch[:, :1])]
        if before:
            self._hands_on(self.ends.pop(before[0])["next"], batch[:, :1])
        self.ends.append(batch[:, -1:].clone())

    def _hands_on(self, before: TensorDictBase, after: TensorDictBase) -> None:
        done = before["done"].squeeze(-1)
        self.resets += int(done.sum())
        for key in (*BELIEF, "state", "step"):
            self._at("handed on", before[key][~done].float(), after[key][~done].float())
        self._at("reset", after["belief", "ensemble"][done], self.start.expand(int(done.sum()), *self.start.shape))
        self._at("reset", after["step"][done].float(), torch.zeros(int(done.sum()), 1))
        if not bool((after["is_init"].squeeze(-1) == done).all()):
            self.worst["reset"] = float("inf")

    def _at(self, what: str, one: torch.Tensor, other: torch.Tensor) -> None:
        off = (one - other).abs()
        largest = float(off.max()) if off.numel() else 0.0
        self.worst[what] = float("nan") if largest != largest else max(self.worst[what], largest)


def _goes_on(end: TensorDictBase, start: TensorDictBase) -> bool:
    """Returns whether a batch continues the episodes of another, by the collectors' episode numbers."""
    episodes = [each.get(("collector", "traj_ids"), None) for each in (end, start)]
    if any(episode is None for episode in episodes):
        return True
    same = (episodes[0] == episodes[1]) | end["next", "done"].squeeze(-1)
    return bool(same.all())


def soak(name: str, steps: int) -> dict[str, Any]:
    """Returns a row of the table: a layout, for ``steps`` steps over all its environments."""
    torch.manual_seed(0)
    reference = Reference()
    for batch in LAYOUTS[name](steps):
        reference.look(batch)
    worst = {f"largest error, {what}": value for what, value in reference.worst.items()}
    right = reference.frames >= steps and all(value < CLOSE for value in worst.values())
    return {
        "steps": reference.frames,
        "resets": reference.resets,
        "missing readings": reference.missing,
        **worst,
        "right": right and len(reference.ends) == (WORKERS if "as they come" in name else 1),
    }


def jobs(steps: int) -> dict[str, Callable[[], dict[str, Any]]]:
    """Returns jobs that run ``steps`` steps in each layout."""
    return {name: partial(soak, name, steps) for name in LAYOUTS}
