"""Which true values are known, and of which components: the one rule of all objectives.

Labels ``[*B, N]`` are of the leading N components, or of the components that ``dims`` names. What is NaN, what a mask
of labels leaves out and what is padding is no label: it has no value and no gradient, and no mean counts it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from tensordict import NestedKey, unravel_key
from torch import Tensor
from torch.nn.functional import pad

from torch_denkf._checks import check_mask
from torch_denkf.functional import wrap_angles

__all__ = ["Labels", "check_row_mask", "labels_of", "mask_of", "true_values"]


class Labels(NamedTuple):
    """True values, as far as they are known and count.

    Attributes:
        values: ``[*B, N]``; zero where there is no label.
        mask: ``[*B, N]``, True where there is one.
        dims: of the N components those that count.
        scale: ``[N]``, finite, by which errors are divided; ``None`` for one.
    """

    values: Tensor
    mask: Tensor
    dims: Sequence[int]
    scale: Tensor | None

    @property
    def rows(self) -> Tensor:
        """Which elements have a label, ``[*B]``."""
        return self.mask.any(-1)

    def errors(self, estimate: Tensor, angles: Sequence[int] = ()) -> Tensor:
        """Scaled errors of an estimate ``[*B, N]``, or of members ``[*B, E, N]``; zero where there is no label."""
        values, mask = self.values, self.mask
        if estimate.ndim > values.ndim:
            values, mask = values.unsqueeze(-2), mask.unsqueeze(-2)
        errors = wrap_angles(estimate - values, angles)
        return torch.where(mask, errors if self.scale is None else errors / self.scale, 0)

    def in_all_components(self, name: str, value: Tensor) -> Tensor:
        """One number for each of the N components, 1 where none is given.

        Args:
            name: its own, for the message.
            value: one number, or one for each of ``dims``; where these are the leading ones, also one for each of N.

        Raises:
            ValueError: if there are more or fewer.
        """
        size = self.values.shape[-1]
        if value.numel() == 1 or (value.numel() == size and isinstance(self.dims, range)):
            return value.expand(size)
        if value.numel() != len(self.dims):
            raise ValueError(
                f"{name} has {value.numel()} entries, but {len(self.dims)} dimensions are scored; pass one for each"
            )
        out = value.new_ones(size)
        out[list(self.dims)] = value
        return out


def labels_of(known: Tensor, dims: Sequence[int], name: str, scale: Tensor | None) -> Labels:
    """What counts of true values.

    Args:
        known: ``[*B, N]``, NaN where there is no label, see :func:`true_values`.
        dims: components that count.
        name: of the scale, for the message.
        scale: see :meth:`Labels.in_all_components`; a component with infinite scale does not count.

    Raises:
        ValueError: if the scale has another length.
    """
    mask = ~known.isnan()
    if not isinstance(dims, range):
        chosen = torch.zeros(known.shape[-1], dtype=torch.bool, device=known.device)
        chosen[list(dims)] = True
        mask = mask & chosen
    labels = Labels(known, mask, dims, None)
    if scale is not None:
        scale = labels.in_all_components(name, scale)
        counting = scale.isfinite()
        mask, scale = mask & counting, torch.where(counting, scale, 1)
    return Labels(torch.where(mask, known, 0), mask, dims, scale)


def true_values(
    key: NestedKey,
    values: Tensor,
    size: int,
    batch_size: Sequence[int],
    *,
    observed: Tensor | None = None,
    observed_key: NestedKey = "",
    padding: Sequence[Tensor] = (),
    dims: Sequence[int] | None = None,
) -> Tensor:
    """Labels in the places of their components, ``[*B, size]``, NaN where there is none.

    Args:
        key: theirs, for messages.
        values: ``[*B, N]``: of the leading components; or of ``dims``, in their order, where that is N components of
            which the last are beyond the first N.
        size: components that there are.
        batch_size: ``[*B]``.
        observed: which of them are labels, ``[*B, 1]`` or ``[*B, N]``, bool.
        observed_key: of this mask, for messages.
        padding: masks ``[*B]`` or ``[*B, 1]``, False where an element is padding.
        dims: components that count.

    Raises:
        ValueError: if values or mask have another shape, or ``dims`` names components that there are not.

    Example:
        >>> labels = torch.tensor([[1.0], [2.0]])
        >>> true_values("state", labels, 2, [2], observed=torch.tensor([[True], [False]]), observed_key="seen")
        tensor([[1., nan],
                [nan, nan]])
    """
    batch = list(batch_size)
    if values.ndim != len(batch) + 1 or list(values.shape[:-1]) != batch or not values.shape[-1]:
        raise ValueError(
            f"{key!r} must be [*B, N] = {[*batch, 'N']}, N labels in each element of the batch; got "
            f"{list(values.shape)}. Reshape it, e.g. by unsqueeze(-1)"
        )
    given = values.shape[-1]
    last = max(dims) if dims is not None else given - 1
    if last >= size:
        what = f"{key!r} is {list(values.shape)}" if dims is None else f"dims={list(dims)} names component {last}"
        raise ValueError(
            f"{what}, but what is scored against it has {size} components. Labels are of the leading ones, at most "
            f"{size}, or of dims=..., counted from 0"
        )
    if dims is not None and last >= given != len(dims):
        raise ValueError(
            f"dims={list(dims)} names component {last}, but {key!r} has {given}, from 0, which are taken for the "
            f"leading ones; pass these, or one for each of dims"
        )
    known = torch.ones_like(values[..., :1], dtype=torch.bool)
    if observed is not None:
        check_row_mask(observed_key, observed, values)
        known = known & observed
    for mask in padding:
        known = known & mask.reshape(*batch, 1)
    values = torch.where(known, values, torch.nan)
    if dims is not None and last >= given:
        placed = values.new_full((*batch, size), torch.nan)
        placed[..., list(dims)] = values
        return placed
    return pad(values[..., :size], (0, size - min(given, size)), value=torch.nan)


def check_row_mask(key: NestedKey, mask: Tensor, values: Tensor) -> None:
    """Raise unless a mask is ``[*B, 1]`` or ``[*B, N]``, bool, for values ``[*B, N]``."""
    check_mask(repr(key), mask)
    batch, count = list(values.shape[:-1]), values.shape[-1]
    if list(mask.shape) not in ([*batch, 1], [*batch, count]):
        raise ValueError(
            f"{key!r} must be [*B, 1] = {[*batch, 1]} or [*B, N] = {[*batch, count]}; got {list(mask.shape)}"
        )


def mask_of(key: NestedKey) -> NestedKey:
    """The mask that data sets write beside an entry.

    Example:
        >>> mask_of("state"), mask_of(("truth", "x"))
        ('state_observed', ('truth', 'x_observed'))
    """
    key = unravel_key(key)
    return f"{key}_observed" if isinstance(key, str) else (*key[:-1], f"{key[-1]}_observed")
