"""Missing frames."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torchrl.data import Binary, Composite

from torch_denkf.envs._frames import FrameTransform

__all__ = ["MissingFrames"]


class MissingFrames(FrameTransform):
    """Drops each frame with probability ``p``: its entries become zero and ``observed`` becomes ``False``.

    This is the paper's test with missing observations (section IV-A, p = 0.3). Frames that are already missing stay
    missing; the frame of a reset may be dropped, too. For unannounced black frames see
    :class:`torch_denkf.envs.BlackFrames`.

    Args:
        p: probability that a frame is dropped.
        in_keys: entries of the frame ``[*B, ...]``.
        observed_key: the mask ``[*B, 1]``; it is added if the environment has none.
        generator: source of randomness; torch's global one by default.

    Raises:
        ValueError: if ``p`` is no probability.
        KeyError: if an entry of the frame is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"pixels": torch.ones(2, 3, 4, 4)}, [2])
        >>> out = MissingFrames(1.0)(td)
        >>> out["observed"].tolist(), float(out["pixels"].sum())
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
        super().__init__(p, in_keys=in_keys, generator=generator)
        self.observed_key = observed_key

    @property
    def hidden_by(self) -> dict[NestedKey, NestedKey]:
        """Maps each entry that this transform drops to the mask that it writes."""
        return dict.fromkeys(map(unravel_key, self.in_keys), unravel_key(self.observed_key))

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        kept = ~self._hit((*next_tensordict.batch_size, 1), next_tensordict.device)
        observed = next_tensordict.get(self.observed_key, None)
        next_tensordict.set(self.observed_key, kept if observed is None else observed & kept)
        for key in self.in_keys:
            frame = self._frame(next_tensordict, key)
            mask = kept.reshape(*next_tensordict.batch_size, *(1,) * (frame.ndim - next_tensordict.ndim))
            next_tensordict.set(key, torch.where(mask, frame, torch.zeros_like(frame)))
        return next_tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the mask if there is none."""
        if self.observed_key not in observation_spec.keys(True, True):
            shape = (*observation_spec.shape, 1)
            observation_spec[self.observed_key] = Binary(shape=shape, dtype=torch.bool, device=observation_spec.device)
        return observation_spec
