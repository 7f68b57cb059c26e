"""Base class of replays of recordings: returns rows in sequence, from a first to a last one."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from torch_denkf._arguments import Checked
from torch_denkf._checks import check_count

__all__ = ["RowsEnv"]

_FLAGS = ("is_init", "done", "terminated", "truncated")


class RowsEnv(Checked, EnvBase):
    """Replays rows of a recording in lockstep, a separate window in each element of the batch.

    A window is truncated in its last row; ``"_reset"`` marks elements to start a new window. Rewards are zero. A
    subclass implements :meth:`_rows_at` and :meth:`_choose`, and calls :meth:`_set_specs` at the end of its
    constructor.

    Args:
        batch_size: ``*B``.
        seed: seed of random draws; by default drawn from torch's generator.
        device: device of the outputs.
    """

    def __init__(self, batch_size: Sequence[int], seed: int | None, device: torch.device | str | None):
        for count in batch_size:
            check_count("batch_size, each number,", count, least=0)
        super().__init__(batch_size=torch.Size(batch_size), device=device)
        self.rng = torch.Generator()
        self._set_seed(int(torch.randint(2**31, ())) if seed is None else seed)

    def _rows_at(self, row: Tensor) -> TensorDict:
        """Returns the entries of rows ``[*B]``, batch size ``*B``."""
        raise NotImplementedError

    def _choose(self, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Returns first and last rows ``[*B]`` of new windows, for the elements that start one, ``[*B]`` bool."""
        raise NotImplementedError

    def _set_specs(self, row: Tensor, actions: int = 0, **specs: TensorSpec) -> None:
        """Derives specs from some rows.

        Args:
            row: ``[*B]``, any.
            actions: width of the action.
            **specs: specs of keys with bounded values.
        """
        shape, shown = self.batch_size, self._rows_at(row)
        self._first = self._now = self._last = row.clone()
        flag = Binary(shape=(*shape, 1), dtype=torch.bool)
        self.observation_spec = Composite(is_init=flag.clone(), shape=shape, device=self.device)
        for key, value in shown.items(True, True):
            spec = specs.get(key) if isinstance(key, str) else None
            if spec is None:
                kind = Binary if value.dtype == torch.bool else Unbounded
                spec = kind(shape=value.shape, dtype=value.dtype, device=self.device)
            self.observation_spec[key] = spec
        self.action_spec = Unbounded((*shape, actions), dtype=torch.float32)
        self.reward_spec = Unbounded((*shape, 1), dtype=torch.float32)
        self.full_done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=shape)

    def _set_seed(self, seed: int | None) -> None:
        self.rng.manual_seed(0 if seed is None else seed)

    def _draw(self, counts: Tensor) -> Tensor:
        """Returns integers ``[*B]``, each uniform in 0 to ``counts - 1``."""
        draw = torch.rand(self.batch_size, generator=self.rng, dtype=torch.float64).to(counts.device)
        return (draw * counts).long().minimum(counts - 1)

    def _emit(self) -> TensorDict:
        out = self._rows_at(self._now)
        truncated = (self._now >= self._last).unsqueeze(-1)
        values = ((self._now == self._first).unsqueeze(-1), truncated, torch.zeros_like(truncated), truncated.clone())
        return out.update(dict(zip(_FLAGS, values, strict=True)))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            mask = torch.ones(*self.batch_size, 1, dtype=torch.bool)
        mask = mask.to(self._now.device).reshape(self.batch_size)
        first, last = self._choose(mask)
        self._first, self._last = torch.where(mask, first, self._first), torch.where(mask, last, self._last)
        self._now = torch.where(mask, first, self._now)
        return self._emit()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        # A row that is stepped after its end stays there, truncated.
        self._now = torch.minimum(self._now + 1, self._last)
        return self._emit().set("reward", torch.zeros(*self.batch_size, 1, device=self._now.device))
