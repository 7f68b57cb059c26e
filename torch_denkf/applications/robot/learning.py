"""Noises of a robot's sensors and of its motion, learned from a log by how likely the fixes are that are hidden."""

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
from torch_denkf.applications.robot.motion import ANGLES, STATES, RobotNoise
from torch_denkf.deployment.progress import progress_bar
from torch_denkf.smoothers import RTSSmoother

__all__ = ["Learned", "fix_error", "learn_noises", "scale_of"]


_HELD_OUT = 4  # every so many segments one is held out
_MOST = 20  # segments; of a longer log so many are spread over it
_RATE = 0.3  # of Adam, on logarithms of standard deviations
_BLIND = 5.0  # s: the longest window if nothing tells turns, and a filter's straight lines are wrong in longer ones
_SMALLER = 0.1  # of the drift of fixes, with which learning begins if that is likelier: most of it may be white noise
_LEAST = 1e-3  # of a reading's spread: quantised readings look as if they had no noise


class Learned(NamedTuple):
    """The end of learning.

    Attributes:
        before: mean log-likelihood of what is hidden in the held-out segments, nats, with the noises as they were.
        after: likewise, with the best of those that were learned.
        stages: ``after`` at the end of each stage.
        interrupted: whether it ended before all stages were done.
    """

    before: float
    after: float
    stages: Sequence[float]
    interrupted: bool


def learn_noises(
    model: RobotModel,
    rows: TensorDict,
    *,
    others: Sequence[tuple[RobotModel, TensorDict]] = (),
    steps: int = 6,
    window: float = 15.0,
    shown: bool = True,
) -> Learned:
    """Learns how large noises and drifts are, so that the fixes of a log are likely where they are hidden.

    The likelihood of each next reading tells little about coloured noise. So the log is cut into segments of three
    windows, each from the filter's belief at that time; fixes of the middle window are hidden, and are to be likely for
    the smoother, with the fix's own noise and drift. A log without fixes is learned by the likelihood of its readings.
    White noise starts from how much readings differ from the line through their neighbours, the drift of fixes from
    what is likelier, as large as it is, or a tenth of it. In three stages all is learned, each from the beliefs that
    the one before it leads to; what is kept is the best on held-out segments.

    Args:
        model: its parameters change.
        rows: of the log ``[T]``, see :func:`~torch_denkf.applications.robot.log.rows_of_log`.
        others: further logs to learn from: the model with the initial belief of each, and its rows.
        steps: of a stage.
        window: s; at most a sixth of the log, and 5 s where nothing tells turns.
        shown: whether progress is.

    Raises:
        ValueError: if the log is too short.
    """
    filter, logs = model.filter, [(model, rows), *others]
    seconds = [float(each["stamp"][-1] - each["stamp"][0]) for _, each in logs]
    window = min(window, min(seconds) / (_HELD_OUT + 2))
    if not any({STATES.index("yaw"), STATES.index("vyaw")} & set(reads) for reads in model.reads.values()):
        window = min(window, _BLIND)
    length = min(round(3 * window * len(each) / max(took, 1e-9)) for (_, each), took in zip(logs, seconds, strict=True))
    if length < 3 * _HELD_OUT:
        least = min(len(each) for _, each in logs)
        raise ValueError(f"the log has {least} rows, too few to cut it into {_HELD_OUT} segments: pass --steps 0")
    rows = torch.cat([each for _, each in logs])
    sensors = [part.log_scale for part in filter.modules() if isinstance(part, LearnedScale)]
    sensors += [] if model.drifts is None else list(model.drifts.parameters())
    motion = [part.log_scale for part in filter.modules() if isinstance(part, RobotNoise)]
    hooks = []
    for name in model.reads:
        varies = _varies(model, rows, name)
        hooks.append(scale_of(model, name).register_hook(partial(torch.mul, varies.to(rows[name].dtype))))
        _start_from(model, rows, name, varies)
    for parameter in motion:
        if model.config.two_d:  # what does not move has no noise to learn
            hooks.append(parameter.register_hook(lambda gradient: gradient.index_fill(0, torch.tensor(PLANE), 0.0)))
        hooks.append(parameter.register_hook(partial(_alike, at=(0, 1))))
    for name in _positions(model):
        hooks.append(scale_of(model, name).register_hook(partial(_alike, at=(0, 1))))
        slow = model.reading(name).slow[:2]
        if model.drifts is not None and None not in slow:
            at = [each - len(STATES) for each in slow if each is not None]
            hooks += [each.register_hook(partial(_alike, at=at)) for each in model.drifts.parameters()]
    every = (*sensors, *motion)
    best = [value.detach().clone() for value in every]
    before, reached, stages, interrupted = None, -torch.inf, [], False
    with progress_bar("learning noises", 3 * (steps + 1), unit=" steps", shown=shown) as bar:
        try:
            before = _smaller_drift(model, logs, every, window, length)
            best = [value.detach().clone() for value in every]
            for _ in range(3):
                cut = [_segments(*each, window, length) for each in logs]
                train, test = (torch.cat(parts) for parts in zip(*cut, strict=True))
                optimiser = torch.optim.Adam(every, lr=_RATE)
                for step in range(steps + 1):
                    with torch.no_grad():
                        score = float(_likelihood(model, test))
                    before = score if before is None else before
                    if score > reached:
                        reached, best = score, [value.detach().clone() for value in every]
                    bar.set_postfix({"held out": f"{score:.3f}"}, refresh=False)
                    bar.update()
                    if step == steps:
                        break
                    optimiser.zero_grad()
                    (-_likelihood(model, train)).backward()
                    nn.utils.clip_grad_norm_(every, 10.0)
                    optimiser.step()
                _load(logs, every, best)
                stages.append(reached)
        except KeyboardInterrupt:  # what was learned is kept
            interrupted = True
    _load(logs, every, best)
    for hook in hooks:
        hook.remove()
    return Learned(before if before is not None else float("nan"), reached, stages, interrupted)


@torch.no_grad()
def _smaller_drift(
    model: RobotModel,
    logs: Sequence[tuple[RobotModel, TensorDict]],
    parameters: Sequence[Tensor],
    window: float,
    length: int,
) -> float | None:
    """Makes the drift of fixes smaller where held-out segments are likelier then; returns how likely they were."""
    if model.drifts is None:
        return None
    places = [at - len(STATES) for name in _positions(model) for at in model.reading(name).slow[:2] if at is not None]
    given, scores = model.drifts.log_std.clone(), []
    smaller = given.index_add(
        0, torch.tensor(places, dtype=torch.long), given.new_full([len(places)], math.log(_SMALLER))
    )
    for tried in (given, smaller)[: 1 + bool(places)]:
        model.drifts.log_std.copy_(tried)
        _load(logs, parameters, parameters)
        scores.append(float(_likelihood(model, torch.cat([_segments(*each, window, length)[1] for each in logs]))))
    if scores[-1] <= scores[0]:
        model.drifts.log_std.copy_(given)
        _load(logs, parameters, parameters)
    return scores[0]


def _alike(gradient: Tensor, at: Sequence[int]) -> Tensor:
    """Averages a gradient over x and y, which keeps the ratio of their noises."""
    where = torch.tensor(list(at))
    return gradient.index_copy(0, where, gradient[where].mean().expand(len(where)))


def scale_of(model: RobotModel, name: str) -> Tensor:
    """Returns the parameter of a sensor's noise."""
    return model.filter[f"{name}_noise"].module.log_scale


def _varies(model: RobotModel, rows: TensorDict, name: str) -> Tensor:
    """Masks readings that differ: one that is always the same, such as zero, would be taken for one without noise."""
    seen = rows[name][rows[f"{name}_observed"][:, 0]]
    return (seen != seen[:1]).any(0)[: len(scale_of(model, name))]


def _start_from(model: RobotModel, rows: TensorDict, name: str, varies: Tensor) -> None:
    """Sets white noise to the residuals of readings from the line through their neighbours."""
    there = rows[f"{name}_observed"][:, 0]
    seen, given = rows[name][there], rows[f"{name}_noise"][there].diagonal(dim1=-2, dim2=-1).mean(0).sqrt()
    if len(seen) < 3 * _HELD_OUT or model.drifts is None:
        return
    apart = seen[2:] - 2 * seen[1:-1] + seen[:-2]
    for at, place in enumerate(model.reads[name]):
        if place in ANGLES:
            apart[:, at] = torch.atan2(apart[:, at].sin(), apart[:, at].cos())
    white = torch.maximum(1.4826 * apart.abs().median(0).values / 6**0.5, _LEAST * seen.std(0))
    with torch.no_grad():
        scale = scale_of(model, name)
        start = (white / given)[: len(scale)].log()
        if name in _positions(model):
            start[:2] = start[:2][varies[:2]].mean()  # an axis along which all fixes are zero says nothing
        scale.copy_(torch.where(varies, start, scale))


def _load(
    logs: Sequence[tuple[RobotModel, TensorDict]], parameters: Sequence[Tensor], values: Sequence[Tensor]
) -> None:
    with torch.no_grad():
        for parameter, value in zip(parameters, values, strict=True):
            parameter.copy_(value)
        for model, _ in logs:
            if model.drifts is not None:  # the initial belief knows as little of them
                model.filter.initial.cov[len(STATES) :, len(STATES) :] = model.drifts.variance.diag()


def _segments(model: RobotModel, rows: TensorDict, window: float, length: int) -> tuple[TensorDict, TensorDict]:
    """Returns segments to learn from, and those held out, ``[B, length]``, with the beliefs that they start from."""
    with torch.no_grad():
        keys = [("belief", name) for name in ("mean", "cov", "var")]
        whole = model.filter.sequence(rows.clone(), keep=keys)
    stamp = (rows["stamp"] - rows["stamp"][0])[:, 0].contiguous()
    count = int(stamp[-1] / window) - 2
    first = torch.searchsorted(stamp, window * torch.arange(count, dtype=stamp.dtype))
    first = first[first + length <= len(rows)]
    first = first[torch.linspace(0, len(first) - 1, min(_MOST, len(first))).round().long()]
    cut = whole[first.unsqueeze(-1) + torch.arange(length)].clone()
    passed = cut["stamp"] - cut["stamp"][:, :1]
    for name in _positions(model):
        seen = cut[f"{name}_observed"]
        hidden = seen & (passed >= window) & (passed < 2 * window)
        cut[f"{name}_hidden"], cut[f"{name}_observed"] = hidden, seen & ~hidden
    held = torch.arange(len(first)) % _HELD_OUT == _HELD_OUT - 1
    return cut[~held], cut[held]


def _positions(model: RobotModel) -> list[str]:
    """Returns the sensors that read x and y first."""
    return [name for name, reads in model.reads.items() if tuple(reads[:2]) == (0, 1)]


def fix_error(model: RobotModel, name: str, out: TensorDict) -> tuple[Tensor, Tensor]:
    """Returns errors ``[*, 2]`` of fixes by a smoothed belief, drift included, and covariances, noise included.

    Args:
        model: of the belief.
        name: of the sensor.
        out: with its readings and ``("smoothed", "mean")`` and ``("smoothed", "cov")``.
    """
    read, jacobian = model.reading(name).jacobian(out["smoothed", "mean"].unsqueeze(-2), out[name])
    jacobian = jacobian.squeeze(-3)[..., :2, :]
    scale = scale_of(model, name)[:2].exp()
    noise = out[f"{name}_noise"][..., :2, :2] * scale * scale.unsqueeze(-1)
    error = out[name][..., :2] - read.squeeze(-2)[..., :2]
    return error, jacobian @ out["smoothed", "cov"] @ jacobian.mT + noise


def _likelihood(model: RobotModel, segments: TensorDict) -> Tensor:
    """Returns the mean log-likelihood of hidden fixes by the smoother; of readings where there are none."""
    positions = [name for name in _positions(model) if segments[f"{name}_hidden"].any()]
    if not positions:
        out = model.filter.sequence(segments.clone(), keep=[("info", "log_likelihood")])
        return out["info", "log_likelihood"].mean()
    out = RTSSmoother(model.filter)(segments.clone())
    scores = []
    for name in positions:
        error, cov = (value[out[f"{name}_hidden"][..., 0]] for value in fix_error(model, name, out))
        distance = (error * torch.linalg.solve(cov, error)).sum(-1)
        scores.append(-0.5 * (distance + torch.logdet(cov)) - math.log(2 * math.pi))
    return torch.cat(scores).mean()
