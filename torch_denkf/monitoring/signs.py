"""Gates readings by signs of a sensor fault, such as the share of black in an image."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from torch_denkf._checks import check_count, check_number
from torch_denkf.modules.tensors import mask_of
from torch_denkf.monitoring._calibration import sign_limits
from torch_denkf.submodel import Sensor

__all__ = ["SignGate"]


class SignGate(Sensor):
    """Marks readings as not observed if a sign of a fault exceeds its limit, which is calibrated on clean data.

    A *sign* is a scalar that is small while a sensor works and large when it fails, independently of its reading: the
    share of an image that is black (:func:`torch_denkf.applications.car.vision.signs.picture_signs`), the residual of a
    fit, a motor's temperature. A sign shows a fault at once; innovations show it after some steps, or never. Put this
    module before the filter, or before its sensor. An :class:`InnovationMonitor` can use the same signs.

    Args:
        count: K, the number of signs of a reading.
        rate: share of the clean readings that all signs together reject.
        floor: lower bounds of the limits, one for all signs or one for each.
        sign_key: the signs ``[*B, K]``. NaN stands for an unknown sign, which never rejects.
        observed_key: optional observed mask ``[*B, 1]`` or ``[*B, O]``.
        out_key: new mask of the same shape: False if a sign exceeds its limit, or ``observed_key`` is False. Pass it to
            the filter as ``observed_key="seen"``.

    Raises:
        ValueError: if a number is out of range, or both masks have one key.

    Example:
        >>> from tensordict import TensorDict
        >>> clean = TensorDict({"signs": torch.linspace(0, 0.5, 1001).unsqueeze(-1)}, [1001])
        >>> gate = SignGate(1, rate=0.01).calibrate([clean])
        >>> gate(TensorDict({"signs": torch.tensor([[0.2], [0.8]])}, [2]))["seen"].tolist()
        [[True], [False]]
    """

    limits: Tensor
    floor: Tensor

    def __init__(
        self,
        count: int,
        *,
        rate: float = 1e-3,
        floor: float | Sequence[float] = 0.0,
        sign_key: NestedKey = "signs",
        observed_key: NestedKey = "observed",
        out_key: NestedKey = "seen",
    ):
        check_count("count", count)
        check_number("rate", rate, above=0, below=0.5)
        super().__init__(nn.Identity(), [sign_key], [out_key], optional_keys=[observed_key])
        self.rate, self.marks = rate, mask_of(observed_key, out_key)
        self.register_buffer("floor", floors(floor, count))
        self.register_buffer("limits", torch.full((count,), torch.inf))

    def compute(self, signs: Tensor, before: Tensor | None = None) -> Tensor:
        """Returns the observed mask."""
        sound = ~(signs > self.limits.to(signs.dtype)).any(-1, keepdim=True)
        return sound if before is None else sound & before

    @torch.no_grad()
    def calibrate(self, clean: Sequence[TensorDictBase], *, margin: float = 1.0) -> SignGate:
        """Sets the limits to quantiles of the signs on clean data.

        Args:
            clean: recordings ``[*B]`` with the signs.
            margin: factor on the limits, for data that are fewer or less varied than those in use.

        Returns:
            This module.
        """
        values = torch.cat([each[self.in_keys[0]].flatten(0, -2) for each in clean])
        self.limits.copy_(sign_limits(values, self.rate, self.floor, margin))
        return self


def floors(floor: float | Sequence[float], count: int) -> Tensor:
    """Returns the floors ``[K]``.

    Raises:
        ValueError: if the number of values is not K, or one is negative.
    """
    values = [floor] * count if isinstance(floor, (int, float)) else list(floor)
    if len(values) != count:
        raise ValueError(f"floor is one number, or one for each of the {count} signs; got {len(values)}")
    for value in values:
        check_number("floor", value, least=0)
    return torch.tensor(values, dtype=torch.get_default_dtype())
