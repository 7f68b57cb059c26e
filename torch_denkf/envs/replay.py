"""Replays a data set as an environment, row by row."""

from __future__ import annotations

from collections.abc import Sequence
from operator import index
from typing import ClassVar, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_denkf._checks import check_count
from torch_denkf.data.replay import EpisodeReplay
from torch_denkf.envs.rows import RowsEnv

__all__ = ["RecordedPolicy", "ReplayEnv"]

_RECORDED = ("recorded", "action")
_NOT_SHOWN = ("next", "done", "terminated", "truncated", "is_init", "action", "index")


class RecordedPolicy(TensorDictModuleBase):
    """Repeats the recorded commands: copies ``("recorded", "action")`` to ``"action"``.

    Examples:
        >>> now = TensorDict({"recorded": TensorDict({"action": torch.ones(3, 2)}, [3])}, [3])
        >>> RecordedPolicy()(now)["action"].shape
        torch.Size([3, 2])
    """

    in_keys: ClassVar[list[NestedKey]] = [_RECORDED]
    out_keys: ClassVar[list[NestedKey]] = ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds ``"action"`` to the tensordict."""
        return tensordict.set("action", tensordict.get(_RECORDED).clone())


class ReplayEnv(RowsEnv):
    """Replays the episodes of a data set, one in each element of the batch, in lockstep.

    At reset and at each step it returns a row ``data[row]``: readings, ``state``, ``observed``, ``step``, ``time``,
    ``episode`` and entries of the data set's transform. ``is_init`` is True at reset; ``truncated`` and ``done`` are
    True in the last row. Elements may end at different steps; a reset restarts only those that ``"_reset"`` marks.
    Rewards are zero.

    Elements take the episodes in order: with a batch of three, the first reset selects the first three, and each
    element that ends continues with the next unused one. ``set_seed`` restarts this order and the random starts. Each
    worker of a SerialEnv or ParallelEnv has its own order: pass each its ``episodes``.

    **Actions.** A replay does not depend on the actions.

    If the data set has an ``action``, the environment's has its shape. The recorded action, which was sent in this row
    and led to the next, is in ``("recorded", "action")``. ``env.rollout(n)`` without policy replays it (``rand_action``
    does), and so does the policy ``env.policy``, a :class:`RecordedPolicy`, which SerialEnv, ParallelEnv and collectors
    need: ``env.rollout(n, RecordedPolicy())``. A filter in a :class:`~torch_denkf.transforms.DEnKFTransform` reads the
    policy's ``action``, so that with this policy it is driven by the recorded commands.

    With another policy it predicts motions that never happened. Without recorded actions, the action has **width
    zero**, see :class:`~torch_denkf.applications.car.KITTIReplayEnv`.

    Args:
        data: a data set, such as :class:`~torch_denkf.data.RecordingReplay`.
        batch_size: ``*B``.
        episodes: episodes to replay, in this order: numbers in ``data.episodes``, or their names; by default all.
        start: row of its episode at which a replay starts, or ``"random"``: each reset draws an episode and a start,
            uniformly among all windows of ``length`` rows.
        length: rows of a replay, including the one at reset, at least 2; by default up to the episode's end.
        seed: seed of the random starts; by default drawn from torch's generator.
        device: device of the outputs; by default that of the data.

    Raises:
        TypeError: if ``data`` is no data set of episodes.
        KeyError: for an unknown name.
        ValueError: if an episode is shorter than the replay, random starts are used without ``length``, or the data set
            has single rows.

    Examples:
        >>> from torch_denkf.data import Episode, EpisodeReplay
        >>> step = torch.arange(10).repeat(2).unsqueeze(-1)
        >>> rows = TensorDict({"step": step, "time": step * 0.1, "state": torch.rand(20, 2)}, [20])
        >>> data = EpisodeReplay(rows, [Episode("a", 0, 10), Episode("b", 10, 10)], for_tests=lambda episode: False)
        >>> env = ReplayEnv(data, batch_size=[2])
        >>> rollout = env.rollout(100)
        >>> rollout["next", "state"].shape, bool((rollout["state"][1] == rows["state"][10:19]).all())
        (torch.Size([2, 9, 2]), True)
    """

    _turn: Tensor

    def __init__(
        self,
        data: EpisodeReplay,
        batch_size: Sequence[int] = (),
        *,
        episodes: Sequence[int | str] | int | str | None = None,
        start: int | Literal["random"] = 0,
        length: int | None = None,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ):
        if not isinstance(data, EpisodeReplay):
            raise TypeError(f"ReplayEnv replays a data set of episodes, an EpisodeReplay; got {type(data).__name__}")
        if not data.sequential:
            raise ValueError("the data set offers single rows, which do not follow each other; open it without them")
        super().__init__(batch_size, seed, device)
        self.data = data
        self._set_stretches(_numbers(data, episodes), start, length)
        first = self._starts[0].expand(self.batch_size)
        row = self._row(first)
        self._recorded = "action" in row
        self._set_specs(first, row["action"].shape[-1] if self._recorded else 0)

    @property
    def policy(self) -> RecordedPolicy | None:
        """Returns the policy of the recorded commands; None without recorded actions."""
        return RecordedPolicy() if self._recorded else None

    def _set_stretches(self, numbers: list[int], start: int | str, length: int | None) -> None:
        if isinstance(start, str) and start != "random":
            raise ValueError(f"start is a row of the episodes or 'random', got {start!r}")
        for name, value, least in (("start", 0 if isinstance(start, str) else start, 0), ("length", length, 0)):
            if value is not None:
                check_count(name, value, least=least)
        self._random = start == "random"
        if self._random and length is None:
            raise ValueError("random starts need the number of rows of a replay: pass length")
        chosen, begin = [self.data.episodes[number] for number in numbers], 0 if isinstance(start, str) else start
        short = {e.name: e.length for e in chosen if begin + (2 if length is None else length) > e.length}
        if begin < 0 or (length is not None and length < 2) or short:
            raise ValueError(
                f"replays of length={length} from start={start!r} do not fit in {len(short)} of {len(chosen)} "
                f"episodes: {dict(list(short.items())[:8])}; they need at least 2 rows and must end within the "
                "episode. Pass episodes= to choose longer ones"
            )
        where = self.device
        starts = torch.tensor([episode.start for episode in chosen], device=where)
        ends = starts + torch.tensor([episode.length for episode in chosen], device=where) - 1
        self._starts = starts + begin
        self._ends = ends if length is None else self._starts + length - 1
        self._stretches = (ends - self._ends + 1).cumsum(0)  # cumulative number of possible random starts

    def _choose(self, starts: Tensor) -> tuple[Tensor, Tensor]:
        if self._random:
            drawn = self._draw(self._stretches[-1].expand(self.batch_size))
            which = torch.searchsorted(self._stretches, drawn, right=True)
            shift = drawn - torch.where(which > 0, self._stretches[which - 1], 0)
            return self._starts[which] + shift, self._ends[which] + shift
        turn = self._turn + starts.reshape(-1).cumsum(0).reshape(self.batch_size) - 1
        self._turn = self._turn + starts.sum()
        which = turn.clamp_min(0) % len(self._starts)
        return self._starts[which], self._ends[which]

    def _set_seed(self, seed: int | None) -> None:
        super()._set_seed(seed)
        self._turn = torch.tensor(0, device=self.device)

    def _row(self, row: Tensor) -> TensorDict:
        rows = self.data[row.reshape(-1).to(getattr(self.data, "device", None) or "cpu")].reshape(self.batch_size)
        return rows if self.device is None else rows.to(self.device)

    def _rows_at(self, row: Tensor) -> TensorDict:
        shown = self._row(row)
        out = shown.exclude(*_NOT_SHOWN)
        return out.set(_RECORDED, shown["action"]) if self._recorded else out

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Writes the recorded action, if there is one, else a random one."""
        if not self._recorded:
            return super().rand_action(tensordict)
        if tensordict is None:
            tensordict = TensorDict({}, self.batch_size, device=self.device)
        recorded = tensordict.get(_RECORDED, None)
        return tensordict.set("action", self._row(self._now)["action"] if recorded is None else recorded.clone())


def _numbers(data: EpisodeReplay, episodes: Sequence[int | str] | int | str | None) -> list[int]:
    """Returns numbers of episodes by number or name."""
    if episodes is None:
        return list(range(len(data.episodes)))
    numbers = {episode.name: number for number, episode in enumerate(data.episodes)}
    chosen = []
    for asked in [episodes] if isinstance(episodes, (int, str)) else episodes:
        if not isinstance(asked, str) and not hasattr(asked, "__index__"):
            raise TypeError(f"episodes= are numbers or names; got {asked!r}")
        number = numbers.get(asked) if isinstance(asked, str) else index(asked)
        if number is None or not 0 <= number < len(numbers):
            raise KeyError(
                f"no episode {asked!r} among {len(numbers)} of the data set, such as {list(numbers)[:8]}; choose "
                "episodes= among these, by number or name"
            )
        chosen.append(number)
    if not chosen:
        raise ValueError("episodes is empty; leave it out for all")
    return chosen
