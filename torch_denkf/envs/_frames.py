"""Base classes of transforms of frames and images."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs.transforms import Transform

from torch_denkf._arguments import Checked
from torch_denkf._registered import diagnosis

CHUNK = 2**20  # values per chunk: 4 MB in float32


class FrameTransform(Checked, Transform):
    """Base class of transforms that change each frame with probability ``p``, in environments and in data.

    Subclasses implement ``_call``. Data are not changed in place: :meth:`forward` works on a shallow copy, as a drive
    may be a read-only memory map.

    Args:
        p: probability that a frame is changed.
        in_keys: entries of the frame.
        generator: source of randomness; torch's global one by default.

    Raises:
        ValueError: if ``p`` is no probability.
    """

    def __init__(self, p: float, *, in_keys: Sequence[NestedKey], generator: torch.Generator | None):
        if not isinstance(p, (int, float)) or not 0.0 <= p <= 1.0:
            raise ValueError(f"p is the probability that {type(self).__name__} hits a frame, in [0, 1]; got {p!r}.")
        super().__init__(in_keys=list(in_keys), out_keys=list(in_keys))
        self.p, self.generator = p, generator

    def _hit(self, shape: Sequence[int], device: torch.device | None) -> Tensor:
        return torch.rand(tuple(shape), generator=self.generator, device=device) < self.p

    def _frame(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        frame = tensordict.get(key, None)
        if frame is None:
            raise diagnosis().missing_entry(type(self).__name__, [key], tensordict.keys(True, True), "Set in_keys=.")
        return frame

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Transforms frames of data: a sample of a replay buffer, or a whole drive; the argument is not changed."""
        return self._call(tensordict.copy())

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)


class ImageDisturbance(FrameTransform):
    """Base class of disturbances of images ``[*B, C, H, W]``: uint8 in [0, 255] or floating in [0, 1].

    Subclasses implement ``_disturb``, which maps frames ``[n, C, H, W]`` to new ones of the same shape and dtype, in
    chunks of :data:`CHUNK` values. Each entry of ``in_keys`` is a separate camera with independent draws.
    """

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key in self.in_keys:
            next_tensordict.set(key, self._picture(key, self._frame(next_tensordict, key)))
        return next_tensordict

    def _picture(self, key: NestedKey, image: Tensor) -> Tensor:
        if image.ndim < 3 or not (image.dtype == torch.uint8 or image.is_floating_point()):
            raise ValueError(
                f"{type(self).__name__} takes images [*B, C, H, W], uint8 or floating; {key!r} is {image.dtype} "
                f"{list(image.shape)}."
            )
        frames = image.unsqueeze(0).flatten(0, -4)
        hit = self._hit(frames.shape[:1], image.device).nonzero().squeeze(-1)
        out = frames.clone()
        for part in hit.split(max(1, CHUNK // max(1, frames[:1].numel()))):
            if part.numel():
                out[part] = self._disturb(frames[part])
        return out.reshape(image.shape)

    def _disturb(self, frames: Tensor) -> Tensor:
        raise NotImplementedError

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Returns the spec unchanged; raises for entries that can be negative, which are no images.

        Raises:
            ValueError: if an entry's lowest value is negative.
        """
        for key in self.in_keys:
            spec = observation_spec[key] if key in observation_spec.keys(True, True) else None
            if isinstance(spec, Bounded) and bool((spec.space.low < 0).any()):
                raise ValueError(
                    f"{type(self).__name__} takes images in [0, 1], and {key!r} can be negative. Difference images and "
                    "standardised ones follow from disturbed frames: disturb those first, of a replayed drive its "
                    "'image', as in KITTIReplayEnv(SaltAndPepper(in_keys=['image'])(drive))."
                )
        return observation_spec


def scale_of(frames: Tensor) -> float:
    """Returns the value of white: 255 in integer images, 1 in floating ones."""
    return 1.0 if frames.is_floating_point() else 255.0


def to_float(frames: Tensor) -> Tensor:
    """Converts frames to a floating dtype: float64 is kept, others become float32; values keep their scale."""
    return frames if frames.dtype == torch.float64 else frames.to(torch.float32)


def to_dtype(values: Tensor, like: Tensor) -> Tensor:
    """Converts values back to the dtype of the frames, rounded and clamped to [0, white]."""
    values = values if like.is_floating_point() else values.round()
    return values.clamp(0.0, scale_of(like)).to(like.dtype)
