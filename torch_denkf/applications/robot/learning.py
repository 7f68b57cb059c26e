"""Noises of a robot's sensors and of its motion, learned from a log by their likelihood."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torch_denkf.applications.robot.config import PLANE
from torch_denkf.applications.robot.model import LearnedScale, RobotModel
from torch_denkf.applications.robot.motion import RobotNoise
from torch_denkf.deployment.progress import progress_bar

__all__ = ["Learned", "learn_noises", "scale_of"]

_HELD_OUT = 4  # every so many segments one is held out
_RATE = 0.4  # of Adam, on logarithms of standard deviations
_LASTS = 1.0  # s, for which errors of poses last: one in that time says as much as all


class Learned(NamedTuple):
    """The end of learning.

    Attributes:
        before: mean log-likelihood of a row of the held-out segments, nats, with the noises as they were.
        after: likewise, with the best of those that were learned.
        stages: ``after`` at the end of each stage.
        interrupted: whether it ended before all stages were done.
    """

    before: float
    after: float
    stages: Sequence[float]
    interrupted: bool


def learn_noises(
    model: RobotModel, rows: TensorDict, *, steps: int = 8, length: int | None = None, shown: bool = True
) -> Learned:
    """Learns how large the noises are, so that the readings of a log are likely.

    The log is cut into segments. Each starts from the filter's belief at that time, and is used twice: as it is, and
    without poses in most of it, where the forecast is to be likely at those that are hidden. Errors of poses that
    follow each other within a second are alike: one of them is used, and the noise that is learned becomes that of all.
    First the noises of sensors are learned, then that of the motion, then all; what is kept is the best on segments
    that are held out.

    Args:
        model: its parameters change.
        rows: of the log ``[T]``, see :func:`~torch_denkf.applications.robot.log.rows_of_log`.
        steps: of a stage.
        length: rows of a segment; by default 200, or an eighth of a short log.
        shown: whether progress is.

    Raises:
        ValueError: if the log is shorter than four segments.
    """
    filter = model.filter
    length = min(200, max(len(rows) // (2 * _HELD_OUT), 20)) if length is None else length
    count = len(rows) // length
    if count < _HELD_OUT:
        raise ValueError(f"the log has {len(rows)} rows, fewer than {_HELD_OUT} segments of {length}: pass --steps 0")
    sensors = [part.log_scale for part in filter.modules() if isinstance(part, LearnedScale)]
    motion = [part.log_scale for part in filter.modules() if isinstance(part, RobotNoise)]
    rows, thinned = _thinned(model, rows)
    if model.config.two_d:  # what does not move has no noise to learn
        for parameter in motion:
            parameter.register_hook(lambda gradient: gradient.index_fill(0, torch.tensor(PLANE), 0.0))
    for scale in [*motion, *(scale_of(model, name) for name in _positions(model))]:
        scale.register_hook(_alike)
    for name in model.reads:  # a reading that is always the same, such as zero, would be taken for one without noise
        seen = rows[name][rows[f"{name}_observed"][:, 0]]
        varies = (seen != seen[:1]).any(0)[: len(scale_of(model, name))]
        scale_of(model, name).register_hook(partial(torch.mul, varies.to(rows[name].dtype)))
    best = [value.detach().clone() for value in (*sensors, *motion)]
    before, reached, stages, interrupted = None, -torch.inf, [], False
    with progress_bar("learning noises", 3 * (steps + 1), unit=" steps", shown=shown) as bar:
        try:
            for parameters in (sensors, motion, [*sensors, *motion]):
                train, test = _segments(model, rows, count, length)
                optimiser = torch.optim.Adam(parameters, lr=_RATE)
                for step in range(steps + 1):
                    with torch.no_grad():
                        score = float(_likelihood(model, test))
                    before = score if before is None else before
                    if score > reached:
                        reached, best = score, [value.detach().clone() for value in (*sensors, *motion)]
                    bar.set_postfix({"held out": f"{score:.3f}"}, refresh=False)
                    bar.update()
                    if step == steps:
                        break
                    optimiser.zero_grad()
                    (-_likelihood(model, train)).backward()
                    nn.utils.clip_grad_norm_(parameters, 10.0)
                    optimiser.step()
                _load((*sensors, *motion), best)
                stages.append(reached)
        except KeyboardInterrupt:  # what was learned is kept
            interrupted = True
    _load((*sensors, *motion), best)
    for name, each in thinned.items():
        scale_of(model, name).data += 0.5 * math.log(each)
    return Learned(before if before is not None else float("nan"), reached, stages, interrupted)


def _alike(gradient: Tensor) -> Tensor:
    """A gradient that keeps the noises of x and y in the ratio in which they were."""
    return torch.cat([gradient[:2].mean().expand(2), gradient[2:]])


def scale_of(model: RobotModel, name: str) -> Tensor:
    """The parameter of a sensor's noise."""
    return model.filter[f"{name}_noise"].module.log_scale


def _thinned(model: RobotModel, rows: TensorDict) -> tuple[TensorDict, dict[str, float]]:
    """Rows with a pose a second, and how many of each sensor there were for one that is left."""
    out, shares = rows.clone(), {}
    for name in model.reads:
        if name.endswith("_pose") and model.reads[name][0] < 6:
            seen = rows[f"{name}_observed"][:, 0]
            second = (rows["stamp"][:, 0] // _LASTS).long()
            first = torch.ones_like(seen)
            there = seen.nonzero()[:, 0]
            first[there[1:]] = second[there[1:]] != second[there[:-1]]
            out[f"{name}_observed"] = (seen & first).unsqueeze(-1)
            shares[name] = float(seen.sum() / (seen & first).sum())
    return out, shares


def _load(parameters: Sequence[Tensor], values: Sequence[Tensor]) -> None:
    with torch.no_grad():
        for parameter, value in zip(parameters, values, strict=True):
            parameter.copy_(value)


def _segments(model: RobotModel, rows: TensorDict, count: int, length: int) -> tuple[TensorDict, TensorDict]:
    """Segments to learn from, and those held out, ``[B, length]``, with the beliefs that they start from."""
    with torch.no_grad():
        keys = [("belief", name) for name in ("mean", "cov", "var")]
        whole = model.filter.sequence(rows.clone(), keep=keys)[: count * length]
    cut = whole.reshape(count, length).clone()
    silent = cut.clone()
    for name in _positions(model):
        seen = silent[f"{name}_observed"]
        between = torch.zeros_like(seen)
        between[:, length // 8 : 7 * length // 8] = True
        cut[f"{name}_hidden"], silent[f"{name}_hidden"] = torch.zeros_like(seen), seen & between
        silent[f"{name}_observed"] = seen & ~between
    held = torch.arange(count) % _HELD_OUT == _HELD_OUT - 1
    return torch.cat([cut[~held], silent[~held]]), torch.cat([cut[held], silent[held]])


def _positions(model: RobotModel) -> list[str]:
    """The sensors that read x and y first."""
    return [name for name, reads in model.reads.items() if tuple(reads[:2]) == (0, 1)]


def _likelihood(model: RobotModel, segments: TensorDict) -> Tensor:
    """Mean log-likelihood of a row, of what is observed and of places that are hidden."""
    keys = [("info", "log_likelihood"), ("belief", "mean"), ("belief", "cov")]
    out = model.filter.sequence(segments.clone(), keep=keys)
    total = out["info", "log_likelihood"].mean()
    for name in _positions(model):
        scale = scale_of(model, name)[:2].exp()
        cov = out["belief", "cov"][..., :2, :2] + out[f"{name}_noise"][..., :2, :2] * scale * scale.unsqueeze(-1)
        error = (out[name] - out["belief", "mean"][..., : out[name].shape[-1]])[..., :2]
        distance = (error * torch.linalg.solve(cov, error)).sum(-1)
        score = -0.5 * (distance + torch.logdet(cov)) - math.log(2 * math.pi)
        total = total + torch.where(out[f"{name}_hidden"][..., 0], score, 0.0).mean()
    return total
