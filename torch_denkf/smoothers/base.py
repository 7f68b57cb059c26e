"""Base class of all smoothers of sequences: runs the filter, finds consecutive elements, and smooths."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_denkf._arguments import Checked
from torch_denkf._slices import as_rows, starts_of
from torch_denkf.filters import Filter
from torch_denkf.functional.smoothing.backward import check_lag
from torch_denkf.submodel import Entries

__all__ = ["Smoother"]


class Smoother(Checked, TensorDictModuleBase):
    """Filters a sequence ``[*B, T]``, then corrects each state by the later readings.

    It writes all outputs of the filter, and ``("smoothed", "mean")`` and ``("smoothed", "var")`` ``[*B, T, S]``, with
    ``("smoothed", "cov")`` or ``("smoothed", "ensemble")`` if the belief has one. The entry at time t is the belief of
    the state *at t*, given the readings up to t + lag. (:class:`FixedLag` writes at t the belief of t - lag.) No
    correction crosses the boundary of an episode or a slice, as found by :meth:`Filter.sequence`. Gradients flow
    through filter and smoother.

    A subclass implements :meth:`_smooth`, and :meth:`_extended` if the filter needs further outputs.

    Args:
        filter: the filter; its parameters are the smoother's.
        lag: number of later readings; ``None`` for all of the sequence (fixed interval).
        needed: outputs of the filter that the smoother needs.
        written: last names of the smoother's outputs.

    Raises:
        ValueError: if ``lag`` is negative.
    """

    #: Whether the filter depends on the lag, or for ``lag=None`` on the sequence's length.
    _by_lag = False

    def __init__(self, filter: Filter, lag: int | None, needed: Iterable[NestedKey], written: Iterable[str]):
        super().__init__()
        check_lag(lag)
        self.filter, self.lag, self._needed = filter, lag, list(needed)
        under = () if filter.prefix is None else (filter.prefix,)
        self.smoothed_keys: list[NestedKey] = [(*under, "smoothed", name) for name in written]
        self.in_keys = list(filter.in_keys)
        self.out_keys = [*filter.out_keys, *self.smoothed_keys]
        self._running: tuple = (None, None)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Runs :meth:`sequence`."""
        return self.sequence(tensordict)

    def sequence(
        self, tensordict: TensorDictBase, *, detach_every: int | None = None, keep: Sequence[NestedKey] | None = None
    ) -> TensorDictBase:
        """Filters and smooths ``[*B, T]``; its arguments are those of :meth:`Filter.sequence`.

        Args:
            tensordict: frames, see there.
            detach_every: truncates back-propagation through the filter's time; gradients through the smoother's
                backward pass are not truncated.
            keep: outputs of the filter to write in addition to the smoothed belief; all by default.

        Returns:
            ``tensordict``, with the outputs.

        Raises:
            ValueError: if there is no time dimension, no step, or the filter does not write a key in ``keep``.
            KeyError: if an entry is missing.
        """
        keep = list(self.filter.out_keys) if keep is None else list(keep)
        rows, new = as_rows(tensordict, starts_of(tensordict, self.filter.init_key))
        wanted = list(dict.fromkeys([*keep, *self._needed]))
        filter = self._filter_for(rows.batch_size[-1] if rows.ndim else 0)
        filtered = filter.sequence(rows.copy(), detach_every=detach_every, keep=wanted)
        out = filter.inside(filtered)
        # Elements one step on from the element before, but not from a stored belief, as at the start of a slice.
        follows = self.filter.stepped(rows)
        if new is not None:
            follows = follows & ~new.reshape(rows.batch_size)
        smoothed = self._smooth({key: out.get(key) for key in out.keys(True, True)}, follows, out)
        written = {**{key: filtered.get(key) for key in keep}, **dict(zip(self.smoothed_keys, smoothed, strict=True))}
        for key, value in written.items():
            tensordict.set(key, value if rows is tensordict else value.flatten(0, 1))
        return tensordict

    def stepped(self, tensordict: TensorDictBase) -> Tensor:
        """Marks the elements that are results of a step, see :meth:`Filter.stepped`."""
        return self.filter.stepped(tensordict)

    def _filter_for(self, count: int) -> Filter:
        """Returns the filter for sequences of ``count`` steps, rebuilt if a module has been replaced."""
        own = self.lag if self.lag is not None else max(count - 1, 1)
        lag = own if self._by_lag else None  # another filter would compile again
        if self._running[0] != lag or self._running[1] is not self.filter.structure:
            self._running = (lag, self.filter.structure, self._extended(lag))
        filter, compiled = self._running[2], self.filter.compiled
        if filter is not self.filter and (filter.compiled is None) != (compiled is None):
            filter.compile(**({"chunk": 0} if compiled is None else {"chunk": compiled.chunk, **compiled.options}))
        return filter

    def _extended(self, lag: int | None) -> Filter:
        """Returns the filter, or one of the same modules that also writes the smoother's inputs."""
        return self.filter

    def _smooth(self, entries: Entries, follows: Tensor, out: TensorDictBase) -> tuple[Tensor, ...]:
        """Returns the smoothed belief, in the order of ``smoothed_keys``.

        Args:
            entries: ``[*B, T, ...]``, inputs and outputs of the filter.
            follows: elements that are one step on from the element before, ``[*B, T]``; the first is ignored.
            out: the same as a tensordict.
        """
        raise NotImplementedError


def last_of_runs(follows: Tensor) -> Tensor:
    """Returns the last index of each element's run of consecutive elements, ``[*B, T]``.

    Example:
        >>> last_of_runs(torch.tensor([False, True, False, True, True])).tolist()
        [1, 1, 4, 4, 4]
    """
    count = follows.shape[-1]
    ends = torch.ones_like(follows)
    ends[..., :-1] = ~follows[..., 1:]
    index = torch.arange(count, device=follows.device).expand(follows.shape)
    # The first end at or after each element: a running minimum in reverse order.
    return torch.where(ends, index, count).flip(-1).cummin(-1).values.flip(-1)
