r"""Learned sensors: :math:`\tilde y^i_t \sim s_\xi(\tilde y^i_t \mid y_t)` (the paper's eq. 8, Table I)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey
from torch import nn

from torch_denkf._checks import check_count
from torch_denkf._registered import diagnosis
from torch_denkf.modules._trunk import activation_bytes, couples_frames, in_chunks, reduced_precision
from torch_denkf.modules.stochastic import StochasticMLP
from torch_denkf.modules.tensors import as_vector, register_location_and_scale
from torch_denkf.submodel import Sensor

__all__ = ["ImageSensor", "VectorSensor", "convolutional_trunk"]

#: Bytes of a trunk's activations at a time, on a CPU: glibc reuses blocks of this size for the next chunk.
CPU_TRUNK_MEMORY = 32 * 2**20
#: Table I: (channels, kernel, stride) of each convolution.
PAPER_TRUNK = ((64, 7, 2), (32, 3, 2), (16, 3, 2))


def convolutional_trunk(in_channels: int, layers: Sequence[tuple[int, int, int]] = PAPER_TRUNK) -> nn.Sequential:
    """Builds convolutions with ReLU and 'same' padding (kernel // 2), then flattens.

    Args:
        in_channels: channels of the image.
        layers: (channels, kernel, stride) of each convolution; Table I's by default.

    Example:
        >>> convolutional_trunk(6)(torch.zeros(1, 6, 50, 150)).shape  # 16 channels, 7 x 19
        torch.Size([1, 2128])
    """
    parts: list[nn.Module] = []
    for channels, kernel, stride in layers:
        parts += [nn.Conv2d(in_channels, channels, kernel, stride, padding=kernel // 2), nn.ReLU()]
        in_channels = channels
    return nn.Sequential(*parts, nn.Flatten())


class StochasticSensor(Sensor):
    """A sensor with the noise of its head ``self.module["head"]``, a stochastic network."""

    ensemble_size: int

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Names the noise of the head."""
        return self.module["head"].noise_names

    def draw_noise(self, batch_size, *, time=False, device=None, dtype=None, generator=None, **_):
        """Draws the head's noise for ``[*batch_size, E]`` rows."""
        return self.module["head"].draw_noise(
            batch_size, self.ensemble_size, time=time, device=device, dtype=dtype, generator=generator
        )


class _Sensor(StochasticSensor):
    """A trunk that runs once per frame, and a stochastic head that runs for every member."""

    def __init__(
        self,
        trunk: nn.Module,
        head: StochasticMLP,
        ensemble_size: int,
        in_key: NestedKey,
        out_key: NestedKey,
        encoding_key: NestedKey | None,
        loc,
        scale,
        event_ndim: int,
        observed_key: NestedKey,
    ):
        super().__init__(
            nn.ModuleDict({"trunk": trunk, "head": head}),
            [in_key],
            [out_key] if encoding_key is None else [out_key, encoding_key],
            optional_keys=[observed_key],
        )
        self.ensemble_size, self.event_ndim, self.observation_dim = ensemble_size, event_ndim, head.out_features
        check_count("ensemble_size", ensemble_size)
        register_location_and_scale(self, 0.0 if loc is None else loc, 1.0 if scale is None else scale)

    def _prepare(self, measurement: torch.Tensor) -> torch.Tensor:
        return measurement

    def _encode(self, measurement: torch.Tensor, seen: torch.Tensor | None) -> torch.Tensor:
        """Returns features ``[N, F]`` of measurements ``[N, ...]``; ``seen`` ``[N, 1, ...]`` marks those observed."""
        measurement = self._prepare(measurement)
        if seen is not None:
            # An unobserved frame may have NaN, which would reach the gradients even behind a mask.
            measurement = torch.where(seen, measurement, 0.0)
        return self.module["trunk"](measurement)

    def _features(self, measurement: torch.Tensor, seen: torch.Tensor | None) -> torch.Tensor:
        return self._encode(measurement, seen)

    def compute(self, measurement, observed=None, *, noise):
        """Returns the learned observations of every member, and the encoding if it has a key."""
        batch_ndim = measurement.ndim - self.event_ndim
        batch_size, event_shape = measurement.shape[:batch_ndim], measurement.shape[batch_ndim:]
        seen = None if observed is None else observed.any(-1).reshape(-1, *(1,) * self.event_ndim)
        # A trunk takes one batch dimension; the entries may have none or several.
        frames = measurement.reshape(batch_size.numel(), *event_shape)
        code = self._features(frames, seen)
        code = code.reshape(*batch_size, code.shape[-1])
        # [*B, 1, F] against noise [*B, E, N]: computations that are equal for all members run once.
        samples, hidden = self.module["head"](code.unsqueeze(-2), noise, sample=noise is not None, with_hidden=True)
        samples = (self.loc + self.scale * samples).expand(*batch_size, self.ensemble_size, self.observation_dim)
        return (samples, hidden.mean(-2)) if len(self.out_keys) > 1 else samples


class ImageSensor(_Sensor):
    """Table I's sensor: three convolutions once per frame, then stochastic layers for each ensemble member.

    Args:
        observation_dim: O.
        image_shape: (channels, height, width); the paper's KITTI input is (6, 50, 150), a frame and its
            difference from the previous one.
        ensemble_size: E.
        trunk: a module from ``[N, C, H, W]`` to ``[N, F]``; Table I's convolutions by default.
        num_cells: widths of the head's hidden layers; Table I has (64, 64, 32, 32).
        layer: ``"dropout"``, ``"flipout"`` or ``"none"``, see :class:`StochasticMLP`.
        rate: drop probability of the head's hidden units.
        loc: mean of the observation ``[O]`` in its units; the head's output is standardised.
        scale: standard deviation of the observation ``[O]``.
        pixel_loc: mean of each channel ``[C]``, after the division by 255 of uint8 images.
        pixel_scale: standard deviation of each channel ``[C]``; the trunk reads standardised pixels.
        in_key: images ``[*B, C, H, W]``, uint8 (divided by 255) or floating point in [0, 1]. Floating-point images
            that seem to be in [0, 255] raise a warning; the first image that is not black is checked.
        out_key: learned observations ``[*B, E, O]``.
        encoding_key: key of the head's last hidden layer, averaged over the members, ``[*B, num_cells[-1]]``;
            ``None`` to not write it.
        trunk_memory: memory for the trunk's activations, in bytes; further frames are processed in further chunks.
            ``None``: 32 MiB on a CPU, where larger blocks go back to the system after each use, which costs up to half
            of the time; no limit elsewhere, nor with a batch norm, which couples all frames of a chunk. While
            gradients are recorded, all chunks stay in memory, unless ``recompute``.
        recompute: activation checkpointing: the trunk's activations are not stored for the backward pass but
            recomputed there, chunk by chunk, for a third more time.
        trunk_dtype: precision of the trunk's layers, ``torch.bfloat16`` for half the memory, and on recent
            processors half the time; parameters and features keep theirs. ``None``: that of the parameters.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``; frames without any observation are not read.

    Raises:
        ValueError: if an image does not have ``image_shape``, or ``trunk_memory`` is not positive.

    Example:
        >>> from tensordict import TensorDict
        >>> sensor = ImageSensor(2, image_shape=(6, 50, 150), ensemble_size=8)
        >>> sensor(TensorDict({"pixels": torch.zeros(3, 6, 50, 150)}, [3]))["sensor", "ensemble"].shape
        torch.Size([3, 8, 2])
    """

    def __init__(
        self,
        observation_dim: int,
        *,
        image_shape: tuple[int, int, int] = (6, 50, 150),
        ensemble_size: int = 32,
        trunk: nn.Module | None = None,
        num_cells: Sequence[int] = (64, 64, 32, 32),
        layer: Literal["dropout", "flipout", "none"] = "dropout",
        rate: float = 0.1,
        loc: Sequence[float] | torch.Tensor | None = None,
        scale: Sequence[float] | torch.Tensor | None = None,
        pixel_loc: Sequence[float] | torch.Tensor | None = None,
        pixel_scale: Sequence[float] | torch.Tensor | None = None,
        in_key: NestedKey = "pixels",
        out_key: NestedKey = ("sensor", "ensemble"),
        encoding_key: NestedKey | None = None,
        trunk_memory: int | None = None,
        recompute: bool = False,
        trunk_dtype: torch.dtype | None = None,
        observed_key: NestedKey = "observed",
    ):
        if trunk_memory is not None:
            check_count("trunk_memory", trunk_memory, cure="It is in bytes")
        check_count("observation_dim", observation_dim)
        if len(image_shape) != 3 or not all(isinstance(side, int) and side > 0 for side in image_shape):
            raise ValueError(f"image_shape is (channels, height, width), positive; got {image_shape!r}")
        trunk = convolutional_trunk(image_shape[0]) if trunk is None else trunk
        # Twice as fast on a CPU, with equal results. torch lacks this keyword among the overloads of Module.to.
        trunk = trunk.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        with torch.no_grad():
            features = trunk(torch.zeros(1, *image_shape)).shape[-1]
        head = StochasticMLP(features, observation_dim, num_cells, layer=layer, rate=rate)
        super().__init__(trunk, head, ensemble_size, in_key, out_key, encoding_key, loc, scale, 3, observed_key)
        self.image_shape = tuple(image_shape)
        self.trunk_memory, self.recompute, self.trunk_dtype = trunk_memory, recompute, trunk_dtype
        self._frame_bytes = activation_bytes(trunk, torch.zeros(1, *image_shape))
        for name, value, default in (("pixel_loc", pixel_loc, 0.0), ("pixel_scale", pixel_scale, 1.0)):
            limit = 0 if name == "pixel_scale" else None
            channels = as_vector(name, default if value is None else value, image_shape[0], above=limit)
            self.register_buffer(name, channels[:, None, None])
        self.standardise = pixel_loc is not None or pixel_scale is not None
        self._looked = False

    def _frames_at_once(self, device: torch.device) -> int | None:
        memory = self.trunk_memory
        if memory is None:
            if device.type != "cpu" or couples_frames(self.module["trunk"]):
                return None
            memory = CPU_TRUNK_MEMORY
        return max(memory // self._frame_bytes, 1)

    def _encode(self, measurement: torch.Tensor, seen: torch.Tensor | None) -> torch.Tensor:
        with reduced_precision(self.trunk_dtype, measurement.device):
            return super()._encode(measurement, seen).to(self.loc.dtype)

    def _features(self, measurement: torch.Tensor, seen: torch.Tensor | None) -> torch.Tensor:
        at_once = self._frames_at_once(measurement.device)
        return in_chunks(self._encode, measurement, seen, at_once=at_once, recompute=self.recompute)

    def _prepare(self, measurement: torch.Tensor) -> torch.Tensor:
        if tuple(measurement.shape[-3:]) != self.image_shape:
            raise ValueError(
                f"ImageSensor was built for images of shape [*B, {', '.join(map(str, self.image_shape))}]; "
                f"{self.in_keys[0]!r} has shape {list(measurement.shape)}. Pass image_shape=, or resize the images."
            )
        if measurement.dtype == torch.uint8:
            measurement = measurement.to(self.loc.dtype) / 255
            return (measurement - self.pixel_loc) / self.pixel_scale if self.standardise else measurement
        measurement = (measurement - self.pixel_loc) / self.pixel_scale if self.standardise else measurement
        if not torch.compiler.is_compiling() and not self._looked:  # this order keeps it out of compiled code
            self._looked = diagnosis().look_at_brightness(self.in_keys[0], measurement)
        return measurement


class VectorSensor(_Sensor):
    """A learned sensor for vectors (encoders, ranges, forces): a stochastic MLP, sampled for each member.

    Args:
        in_features: size of the measurement.
        observation_dim: O.
        ensemble_size: E.
        num_cells: widths of the hidden layers; Table I's head by default.
        layer: ``"dropout"``, ``"flipout"`` or ``"none"``, see :class:`StochasticMLP`.
        rate: drop probability of hidden units.
        loc: mean of the observation ``[O]`` in its units; the network's output is standardised.
        scale: standard deviation of the observation ``[O]``.
        in_key: measurements ``[*B, in_features]``.
        out_key: learned observations ``[*B, E, O]``.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``; rows without any observation are not read.

    Example:
        >>> from tensordict import TensorDict
        >>> sensor = VectorSensor(6, 2, ensemble_size=8, in_key="encoders")
        >>> sensor(TensorDict({"encoders": torch.zeros(6)}))["sensor", "ensemble"].shape
        torch.Size([8, 2])
    """

    def __init__(
        self,
        in_features: int,
        observation_dim: int,
        *,
        ensemble_size: int = 32,
        num_cells: Sequence[int] = (64, 64, 32, 32),
        layer: Literal["dropout", "flipout", "none"] = "dropout",
        rate: float = 0.1,
        loc: Sequence[float] | torch.Tensor | None = None,
        scale: Sequence[float] | torch.Tensor | None = None,
        in_key: NestedKey = "measurement",
        out_key: NestedKey = ("sensor", "ensemble"),
        observed_key: NestedKey = "observed",
    ):
        check_count("observation_dim", observation_dim)
        head = StochasticMLP(in_features, observation_dim, num_cells, layer=layer, rate=rate)
        super().__init__(nn.Identity(), head, ensemble_size, in_key, out_key, None, loc, scale, 1, observed_key)
