"""Frames that do not arrive."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Binary, Composite
from torchrl.envs.transforms import Transform

__all__ = ["MissingFrames"]


class MissingFrames(Transform):
    """Drops each frame with probability ``p``: its entries become zero and ``observed`` becomes ``False``.

    This is the paper's test with missing observations (section IV-A, p = 0.3). Frames that are missing already stay
    so; the frame of a reset counts like any other.

    Args:
        p: probability that a frame is dropped.
        in_keys: entries of the frame ``[*B, ...]``.
        observed_key: the mask ``[*B, 1]``; it is added where the environment has none.
        generator: source of randomness; torch's global one by default.

    Raises:
        ValueError: if ``p`` is no probability.
        KeyError: if an entry of the frame is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"pixels": torch.ones(2, 3, 4, 4)}, [2])
        >>> MissingFrames(1.0)(td)["observed"].tolist(), float(td["pixels"].sum())
        ([[False], [False]], 0.0)
    """

    def __init__(
        self,
        p: float = 0.3,
        *,
        in_keys: tuple[NestedKey, ...] = ("pixels",),
        observed_key: NestedKey = "observed",
        generator: torch.Generator | None = None,
    ):
        if not 0.0 <= p <= 1.0:
            raise ValueError(f"p is the probability that a frame is missing, in [0, 1]; got {p}.")
        super().__init__(in_keys=list(in_keys), out_keys=list(in_keys))
        self.p, self.observed_key, self.generator = p, observed_key, generator

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        shape = (*next_tensordict.batch_size, 1)
        kept = torch.rand(shape, generator=self.generator, device=next_tensordict.device) >= self.p
        observed = next_tensordict.get(self.observed_key, None)
        next_tensordict.set(self.observed_key, kept if observed is None else observed & kept)
        for key in self.in_keys:
            frame = next_tensordict.get(key, None)
            if frame is None:
                present = sorted(map(str, next_tensordict.keys(True, True)))
                raise KeyError(f"MissingFrames drops {key!r}, which is not there; there are {present}. Set in_keys=.")
            mask = kept.reshape(*next_tensordict.batch_size, *(1,) * (frame.ndim - next_tensordict.ndim))
            next_tensordict.set(key, torch.where(mask, frame, torch.zeros_like(frame)))
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Drops frames of data, e.g. a sample of a replay buffer."""
        return self._call(tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the mask where there is none."""
        if self.observed_key not in observation_spec.keys(True, True):
            shape = (*observation_spec.shape, 1)
            observation_spec[self.observed_key] = Binary(shape=shape, dtype=torch.bool, device=observation_spec.device)
        return observation_spec
