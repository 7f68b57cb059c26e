"""Candidates of this library: a step on a tensordict, the same functions without tensordicts, and a sequence."""

from __future__ import annotations

import os
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.speed.workload import MEMBERS, STEPS, make_filter, make_frames, start
from torch_denkf.filters import DEnKF, Filter
from torch_denkf.functional import analyse
from torch_denkf.functional.moments import ensemble_mean, ensemble_var

#: Steps in one compiled graph.
CHUNK = 20


def sequences(batch: int, *, scheme: str = "sensor", backward: bool = False) -> dict[str, Callable[[], Tensor]]:
    """Returns the sequence by kind for the table: eager and, unless SPEED_COMPILE=0, compiled in chunks."""
    fields = {"samples": scheme == "sensor", "backward": backward}
    return {kind: sequence(filter, batch, **fields) for kind, filter in filters(make_filter, scheme).items()}


def steps(batch: int) -> dict[str, Callable[[], Tensor]]:
    """Returns a step on a tensordict by kind, eager and compiled."""
    return {kind: tensordict_loop(filter, batch) for kind, filter in filters(make_filter).items()}


def filters(make: Callable[..., Filter], *options: str) -> dict[str, Filter]:
    """Returns an eager filter and, unless SPEED_COMPILE=0, a compiled one; SPEED_PLAIN=1 uses plain inductor."""
    found = {"eager": make(*options)}
    if os.environ.get("SPEED_COMPILE") != "0":
        backend = {"backend": "inductor"} if os.environ.get("SPEED_PLAIN") == "1" else {}
        found["compiled"] = make(*options).compile(chunk=CHUNK, **backend)
    return found


def functional_step(filter: DEnKF) -> Callable[[Tensor, Tensor], tuple[Tensor, ...]]:
    """Returns the filter's step as plain functions of tensors: the same networks, noise, analysis and moments.

    Returns:
        A function of members ``[*B, E, S]`` and the sensor's samples ``[*B, E, O]`` or reading ``[*B, O]`` that returns
        all outputs of the filter: noise, forecast, predicted observation, members, mean, variance, diagnostics.
    """
    network, observe, noise = (filter[name].module for name in ("transition", "observation", "noise"))
    variance, floor, loc, scale = (getattr(filter["noise"], name) for name in ("variance", "floor", "loc", "scale"))
    scheme = filter["analysis"].scheme

    def step(ensemble: Tensor, samples: Tensor) -> tuple[Tensor, ...]:
        reading = samples.mean(-2) if samples.ndim == ensemble.ndim else samples
        r = variance * (1 + noise((reading - loc) / scale)) ** 2 + floor
        draws = network.draw_noise(ensemble.shape[:-2], MEMBERS)
        forecast = ensemble + network(ensemble, draws)
        predicted = observe(forecast)
        members, *diagnostics = analyse(forecast, predicted, samples, r, scheme=scheme)
        mean = ensemble_mean(members)
        return r, forecast, predicted, members, mean, ensemble_var(members, mean), *diagnostics

    return step


def functional_loop(filter: DEnKF, batch: int) -> Callable[[], Tensor]:
    """Returns a call that runs one step on plain tensors, from the members of the last call."""
    step, samples = functional_step(filter), make_frames(batch, 1).get(("sensor", "ensemble"))[:, 0]
    state = [start(filter, batch)]

    def call() -> Tensor:
        with torch.no_grad():
            state[0] = step(state[0], samples)[3]
        return state[0]

    return call


def tensordict_loop(filter: Filter, batch: int) -> Callable[[], Tensor]:
    """Returns a call that runs one step on a tensordict, from the belief of the last call."""
    row = make_frames(batch, 1)[:, 0].set(("belief", "ensemble"), start(filter, batch))

    def call() -> Tensor:
        with torch.no_grad():
            filter.step(row)
        return row

    return call


def sequence(filter: Filter, batch: int, *, samples: bool = True, backward: bool = False) -> Callable[[], Tensor]:
    """Returns a call that runs a sequence of STEPS steps; the first of its STEPS + 1 frames has the initial belief."""
    frames = make_frames(batch, STEPS + 1, samples=samples)
    parameters = list(filter.parameters())

    def call() -> Tensor:
        with torch.set_grad_enabled(backward):
            out = filter.sequence(frames.copy())
            mean = out.get(("belief", "mean"))
        if backward:
            torch.autograd.grad(mean.square().sum(), parameters)
        return mean

    return call
