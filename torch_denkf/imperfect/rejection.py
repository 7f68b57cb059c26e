"""Rejects invalid readings before a filter: NaN, infinite, or too large."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, get_args
from weakref import ref

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs.transforms import Transform

from torch_denkf._arguments import Checked, check_key
from torch_denkf._checks import check_mask, check_number, flag_value
from torch_denkf.diagnosis import entry_of
from torch_denkf.functional.linalg import is_covariance
from torch_denkf.functional.manifolds import Space, places_of
from torch_denkf.submodel import Entries

__all__ = ["RejectReadings"]

OnBad = Literal["mask", "raise"]
#: Of each mask that was written, the mask that was given, and references to the readings that it was written for. In a
#: loop a tensordict keeps a mask after its reading was replaced.
_WRITTEN = WeakIdKeyDictionary()


class RejectReadings(Checked, Transform):
    """Sets the mask of each invalid reading to ``False``, or raises.

    A reading is invalid if it is NaN, infinite, or larger than ``limit``; or if its noise is not finite, negative, or
    no covariance. Invalid values become zero, so that networks and gradients have no NaN. The filter treats the reading
    as a missing observation.

    It is a TensorDict module: call it on one step ``[*B]`` or on a sequence ``[*B, T]``, put it before a filter in a
    ``TensorDictSequential``, or into a policy. It is also a transform: append it to an environment before
    :class:`~torch_denkf.transforms.DEnKFTransform`, or to a replay buffer. Like other TensorDict modules it sets
    entries of the given tensordict, and does not change tensors in place: ``reject(td.copy())`` keeps the NaN in
    ``td``.

    In a loop, call it on the frame before merging: ``filter.step(belief.update(reject(frame)))``. A tensordict that is
    kept from step to step, also in a policy, has the mask of the previous step. This is recognised and ignored, unless
    the tensordict was cloned in between or the call is compiled.

    Args:
        masks: the observed mask of each reading, such as ``{"pixels": "observed", "gps": "gps_observed"}``. An existing
            mask is combined with the rejections; a missing one is written. Readings that share a mask are rejected
            together. A filter must read each of them (``filter.in_keys`` names them).
        limit: largest absolute value of a reading, in its unit. Squares of values above 1e18 overflow in float32. The
            limit of float16 readings is the largest number of their dtype, integers have none.
        by_component: readings ``[*B, O]``, or samples ``[*B, E, O]``, whose components are rejected individually; their
            mask becomes ``[*B, O]``. Other readings are rejected as a whole, as a sensor network needs all of its
            input, and keep the width of their mask, by default ``[*B, 1]``.
        noises: entries with the variances ``[*B, O]`` or the covariance ``[*B, O, O]`` of readings. Invalid ones are
            replaced by one, or the identity.
        spaces: spaces of readings that are points ``[*B, P]``. Their parts, such as the pose, are rejected as a whole
            and become the neutral point; components of vectors are rejected individually. A quaternion of zeros is also
            invalid. The mask ``[*B, D]`` and the noise are those of tangents.
        on_bad: ``"mask"`` to reject invalid readings, ``"raise"`` to raise if one is marked as observed. The latter
            synchronises with the device in each call, and has no effect under ``torch.compile`` and ``torch.vmap``.
        count_key: number of rejections, ``[*B, 1]`` int64: components whose mask changed from ``True`` to ``False``.

    Raises:
        TypeError: if a key is no key, a space is no space, or ``noises`` is no dict.
        ValueError: if ``masks`` is empty, another argument names a reading that is not in ``masks``, two entries have
            the same key, or ``on_bad`` is unknown. In a call, if a mask is not boolean or of another shape, or a
            reading differs in size from its space's points; with ``on_bad="raise"``, if a reading is invalid.
        KeyError: in a call, if a reading or its noise is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> kf = KalmanFilter(one, one, process_noise_cov=one, noise_cov=one, mean=torch.zeros(1), cov=one)
        >>> reject = RejectReadings({"observation": "observed"})
        >>> drive = reject(TensorDict({"observation": torch.tensor([[1.0], [1.0], [torch.nan], [3.0]])}, [4]))
        >>> drive["observed"].flatten().tolist(), drive["info", "rejected"].flatten().tolist()
        ([True, True, False, True], [0, 0, 1, 0])
        >>> kf.sequence(drive)["belief", "mean"].flatten()
        tensor([0.0000, 0.6667, 0.6667, 2.3636])
    """

    def __init__(
        self,
        masks: Mapping[NestedKey, NestedKey],
        *,
        limit: float = 1e18,
        by_component: Sequence[NestedKey] = (),
        noises: Mapping[NestedKey, NestedKey] | None = None,
        spaces: Mapping[NestedKey, Space] | None = None,
        on_bad: OnBad = "mask",
        count_key: NestedKey = ("info", "rejected"),
    ):
        check_number("limit", limit, above=0)
        if not isinstance(masks, Mapping) or not masks:
            raise ValueError(f'masks says the mask of each reading, such as {{"gps": "gps_observed"}}; got {masks!r}')
        if on_bad not in get_args(OnBad):
            raise ValueError(f'on_bad is "mask" or "raise"; got {on_bad!r}')
        for name, value in (("noises", noises), ("spaces", spaces)):
            if value is not None and not isinstance(value, Mapping):
                raise TypeError(f"{name} is a dict, from the key of a reading; got {type(value).__name__}")
        for key in (*masks, *masks.values(), *(noises or {}).values()):
            check_key("each name in masks and noises", key)
        masks = {unravel_key(key): unravel_key(mask) for key, mask in masks.items()}
        noises = {unravel_key(key): unravel_key(noise) for key, noise in (noises or {}).items()}
        spaces = {unravel_key(key): space for key, space in (spaces or {}).items()}
        apart = list(map(unravel_key, by_component))
        for name, keys in (("by_component", apart), ("noises", noises), ("spaces", spaces)):
            unknown = [key for key in keys if key not in masks]
            if unknown:
                raise ValueError(f"{name} names {unknown[0]!r}, of which masks says no mask; it has {list(masks)}")
        for key, space in spaces.items():
            if not isinstance(space, Space):
                raise TypeError(f"the space of {key!r} is a Space, such as Circle(); got {space!r}")
        numbers, marks = {*masks, *noises.values()}, {*masks.values()}
        twice = (numbers & marks) | ((numbers | marks) & {unravel_key(count_key)})
        if twice:
            raise ValueError(
                f"readings and noises, masks and the count need keys of their own; got {twice.pop()!r} twice"
            )
        written = dict.fromkeys([*masks, *noises.values(), *masks.values()])
        super().__init__(in_keys=list(written), out_keys=list(dict.fromkeys([*written, unravel_key(count_key)])))
        #: The mask of each reading; :class:`~torch_denkf.transforms.DEnKFTransform` warns if its filter reads none.
        self.hidden_by = masks
        self.noises, self.spaces, self.by_component = noises, spaces, apart
        self.limit, self.on_bad, self.count_key = limit, on_bad, unravel_key(count_key)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Rejects the readings of one step ``[*B]`` or of a sequence ``[*B, T]``."""
        size = tensordict.ndim
        written: Entries = {}
        usable = {key: self._usable(key, tensordict, written) for key in self.hidden_by}
        fine: Entries = {}
        for key, mask in self.hidden_by.items():
            fine[mask] = fine[mask] & usable[key] if mask in fine else usable[key]
        count = torch.zeros(*tensordict.batch_size, 1, dtype=torch.int64, device=next(iter(fine.values())).device)
        observed, before = {}, {}
        for mask, seen in fine.items():
            now, before[mask] = self._given(mask, tensordict)
            observed[mask] = now = torch.ones_like(seen) if now is None else now
            check_mask(f"the mask {mask!r}", now)
            if now.shape[:-1] != tensordict.batch_size or not _fits(now.shape[size:], seen.shape[size:]):
                raise ValueError(
                    f"the mask {mask!r} must be [*B, 1] or [*B, O] with B = {list(tensordict.batch_size)}; got "
                    f"{list(now.shape)}"
                )
            written[mask] = now & seen
            count = count + (now & ~seen).sum(-1, keepdim=True)
        if self.on_bad == "raise" and flag_value((count > 0).any()):
            raise ValueError(next(self._messages(tensordict, usable, observed)))
        for key, value in written.items():
            tensordict.set(key, value)
        if not torch.compiler.is_compiling():
            for mask, given in before.items():
                _WRITTEN[written[mask]] = given, [ref(written[key]) for key in self._hidden(mask)]
        return tensordict.set(self.count_key, count)

    def _hidden(self, mask: NestedKey) -> list[NestedKey]:
        """Lists the readings that are masked."""
        return [key for key, other in self.hidden_by.items() if other == mask]

    def _given(self, mask: NestedKey, tensordict: TensorDictBase) -> tuple[Tensor | None, Tensor | None]:
        """Returns the mask of the current readings, and the mask before any rejection.

        Both are the latter if the mask belongs to readings that have been replaced since.
        """
        observed = tensordict.get(mask, None)
        if observed is None or torch.compiler.is_compiling() or observed not in _WRITTEN:
            return observed, observed
        before, readings = _WRITTEN[observed]
        now = map(tensordict.get, self._hidden(mask))
        rejected_already = any(old() is new for old, new in zip(readings, now, strict=True))
        return observed if rejected_already else before, before

    def _usable(self, key: NestedKey, tensordict: TensorDictBase, written: Entries) -> Tensor:
        """Returns the mask of valid components of a reading, ``[*B, 1]``, ``[*B, O]`` or ``[*B, D]``.

        Args:
            key: of the reading.
            tensordict: with the reading.
            written: output for the reading and its noise, with neutral numbers instead of invalid ones.
        """
        size, value = tensordict.ndim, entry_of(tensordict, key, "RejectReadings", "Rename it in the constructor.")
        good, neutral = self._within(value), value.new_zeros(())
        if key in self.spaces:
            self.spaces[key].check(**{repr(key): value[(0,) * size] if 0 not in value.shape[:size] else value})
            neutral = self.spaces[key].neutral(value)
            point = torch.where(good, value, neutral)
            point = point if point.is_floating_point() else point.float()
            good = good & self.spaces[key].normalise(point).isfinite()  # a quaternion of zeros is no rotation
        known = good.unsqueeze(-1).flatten(size).all(-1, keepdim=True)
        if key in self.spaces or key in self.by_component:  # samples of one reading count together
            known = good.flatten(size, -2).all(-2) if good.ndim > size + 1 else good
        noise = None
        if key in self.noises:
            name = self.noises[key]
            given = entry_of(tensordict, name, "RejectReadings", "Rename it in the constructor.")
            noise, written[name] = self._judged_noise(given, size)
        if key in self.spaces:
            points, known = _whole_parts(self.spaces[key], known, noise)
            good = points.reshape(*points.shape[:-1], *(1,) * (value.ndim - points.ndim), points.shape[-1])
        elif noise is not None:
            known = known & (noise if key in self.by_component else noise.all(-1, keepdim=True))
        written[key] = torch.where(good, value, neutral)
        return known

    def _within(self, value: Tensor) -> Tensor:
        """Masks values that are finite and at most ``limit``."""
        if not value.is_floating_point():
            return torch.ones_like(value, dtype=torch.bool)
        return value.abs() <= min(self.limit, torch.finfo(value.dtype).max)  # also false for NaN

    def _judged_noise(self, noise: Tensor, size: int) -> tuple[Tensor, Tensor]:
        """Masks valid variances ``[*B, O]``, and returns them with ones in place of invalid ones."""
        good = self._within(noise)
        if noise.ndim < size + 2:
            good = good & (noise >= 0)
            return good, torch.where(good, noise, 1)
        eye = torch.eye(noise.shape[-1], dtype=noise.dtype, device=noise.device)
        good = good.flatten(-2).all(-1)[..., None, None]
        good = good & is_covariance(torch.where(good, noise, eye))[..., None, None]
        return good[..., 0].expand(noise.shape[:-1]), torch.where(good, noise, eye)

    def _messages(
        self,
        tensordict: TensorDictBase,
        usable: Mapping[NestedKey, Tensor],
        observed: Mapping[NestedKey, Tensor],
    ) -> Iterator[str]:
        """Names the first invalid value of each reading, and of its noise, that the observed mask does not exclude."""
        for key, fine in usable.items():
            mask, noise = self.hidden_by[key], self.noises.get(key)
            lost = observed[mask] & ~fine
            cure = f'. Set its mask {mask!r} to False there, or let RejectReadings(..., on_bad="mask") do it.'
            for row in lost.any(-1).nonzero().tolist()[:1]:
                for name in (key,) if noise is None else (key, noise):
                    value = tensordict.get(name)[tuple(row)].detach()
                    negative = (value < 0) & (name == noise and value.ndim == 1)
                    bad = ~self._within(value) | negative
                    if key in self.by_component and lost.shape[-1:] == value.shape[-1:]:  # others may be hidden
                        bad = bad & lost[tuple(row)]
                    for place in bad.nonzero().tolist()[:1]:
                        number, what = value[tuple(place)].item(), "variance" if name == noise else "reading"
                        due = f"at most {self.limit:g} in size" if abs(number) < torch.inf else "finite"
                        due = "at least zero" if bool(negative[tuple(place)]) else due
                        yield f"{name!r} is {number:g} at {[*row, *place]}, and a {what} must be {due}{cure}"
                    if name == key in self.spaces:
                        yield f"{name!r} at {row} is no point of {self.spaces[key]}: {value.tolist()}{cure}"
                    if name == noise:
                        yield f"{name!r} at {row} is no covariance: symmetric, without negative eigenvalues{cure}"

    # ------------------------------------------------------------------------------------------ in an environment

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the masks, in the width that they get, and the count."""
        out = self.forward(observation_spec.zero())
        for mask in self.hidden_by.values():
            observation_spec[mask] = Binary(shape=out.get(mask).shape, dtype=torch.bool, device=observation_spec.device)
        count = out.get(self.count_key)
        observation_spec[self.count_key] = Unbounded(count.shape, dtype=count.dtype, device=observation_spec.device)
        return observation_spec


def _fits(given: Sequence[int], due: Sequence[int]) -> bool:
    """Returns True if masks of two widths can be combined."""
    return len(given) == 1 and (given[0] == 1 or due[0] in (1, given[0]))


def _whole_parts(space: Space, points: Tensor, tangents: Tensor | None) -> tuple[Tensor, Tensor]:
    """Widens the mask of points ``[*, P]``, and of their noise ``[*, D]``, to whole parts of the space."""
    parts: list[tuple[Tensor, Tensor]] = []
    for place in places_of(space):
        point, tangent = points[..., place.point], None if tangents is None else tangents[..., place.tangent]
        if place.space.flat is not None:
            known = point if tangent is None else point & tangent
            parts.append((known, known))
            continue
        whole = point.all(-1, keepdim=True)
        whole = whole if tangent is None else whole & tangent.all(-1, keepdim=True)
        dims = (place.space.point_dim, place.space.tangent_dim)
        parts.append((whole.expand(*whole.shape[:-1], dims[0]), whole.expand(*whole.shape[:-1], dims[1])))
    return torch.cat([point for point, _ in parts], -1), torch.cat([tangent for _, tangent in parts], -1)
