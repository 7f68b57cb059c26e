"""Explains why a belief is wrong: names the entry, the row, and the module that made it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_denkf.beliefs import Belief
from torch_denkf.filters.structure import Structure
from torch_denkf.functional.linalg import is_covariance
from torch_denkf.modules.around import Wrapper
from torch_denkf.running import reads, run_module, writes
from torch_denkf.submodel import Call, Entries, SubModel, Transition, Update, in_role

__all__ = [
    "COVARIANCE",
    "NoiseEntry",
    "bad_inputs",
    "cure_of",
    "flaw_of",
    "named",
    "no_covariance",
    "noises_of",
    "reason",
    "why_not_finite",
]

#: States what a covariance is, and what to do about a noise that is none.
COVARIANCE = (
    "A covariance is symmetric, with variances of at least zero and no negative eigenvalue; a driver may write -1 for "
    "an unknown one. A mask that is False hides it, and RejectReadings(..., noises=...) in front of the filter makes "
    "one."
)


class NoiseEntry(NamedTuple):
    """The noise of a reading.

    Attributes:
        key: of the variances ``[*B, O]`` or the covariance ``[*B, O, O]``.
        mask: of the observed mask that hides it; ``None`` if there is none.
    """

    key: NestedKey
    mask: NestedKey | None


def noises_of(structure: Structure) -> list[NoiseEntry]:
    """Lists the noises that the analyses of a filter read."""
    found: dict[NestedKey, NoiseEntry] = {}
    for _, module in structure.update:
        for part in in_role(module, Update):
            if part.info_prefix is not None and len(part.reading_keys) == 2:  # the reading, and behind it its noise
                key, mask = unravel_key(part.reading_keys[1]), part.observed_key
                mask = None if mask is None else unravel_key(mask)
                found.setdefault(key, NoiseEntry(key, mask))
    return list(found.values())


def no_covariance(noise: Tensor, mask: Tensor | None, batch_dims: int, *, strict: bool = False) -> Tensor:
    """Masks rows in which a finite noise is no covariance, ``[*B]``.

    Args:
        noise: variances ``[*B, O]`` or covariances ``[*B, O, O]``.
        mask: ``[*B, 1]`` or ``[*B, O]``; noise of missing components is ignored.
        batch_dims: dimensions of ``*B``.
        strict: whether zero is no variance.
    """
    if noise.ndim == batch_dims + 1:
        bad = noise <= 0 if strict else noise < 0
        return (bad if mask is None else bad & mask).any(-1)
    if mask is not None:
        seen = mask.expand(noise.shape[:-1])
        eye = torch.eye(noise.shape[-1], dtype=noise.dtype, device=noise.device)
        noise = torch.where(seen.unsqueeze(-1) & seen.unsqueeze(-2), noise, eye)
    return noise.isfinite().flatten(-2).all(-1) & ~is_covariance(noise)


def flaw_of(noise: Tensor, mask: Tensor | None = None) -> str:
    """Describes why a noise, ``[O]`` or ``[O, O]``, is no covariance."""
    noise = noise.detach()
    variances = noise if noise.ndim == 1 else noise.diagonal()
    shown = torch.where(mask.expand(variances.shape), variances, torch.inf) if mask is not None else variances
    place = int(shown.argmin())
    if float(shown[place]) <= 0 and (noise.ndim == 1 or float(shown[place]) < 0):
        return f"its variance {place} is {float(shown[place]):g}"
    row, column = divmod(int((noise - noise.mT).abs().argmax()), len(noise))
    if abs(float(noise[row, column] - noise[column, row])) > 1e-4 * float(noise.abs().max()):
        return (
            f"it has {float(noise[row, column]):g} at {[row, column]} and {float(noise[column, row]):g} at "
            f"{[column, row]}"
        )
    return f"it has the eigenvalue {float(torch.linalg.eigvalsh(noise.double())[0]):.3g}"


def why_not_finite(structure: Structure, entries: Entries, written: Entries) -> str:
    """Returns why the belief that a step wrote, or that it started from, is not finite, as a message.

    Args:
        structure: of the filter.
        entries: inputs of the step.
        written: outputs of the step.
    """
    why = bad_inputs(structure, entries, written) or _of_first_row(structure, entries, written)
    return (
        f"The new belief is not finite, because of {why}. The tensordict was left as it is. {cure_of(why)}"
        "Where an input is not finite: a mask that is False hides it, and RejectReadings in front of the filter makes "
        "one. Where the filter diverged: look at the transition's weights and the noise floor, normalise the state, "
        "clip gradients in training. check_finite=False switches this off."
    )


def cure_of(why: str) -> str:
    """Returns the definition of a covariance, if that is the reason."""
    return f"{COVARIANCE} " if "no covariance" in why else ""


def bad_inputs(structure: Structure, entries: Entries, written: Entries) -> str:
    """Names observed inputs that are not finite, and flaws of the given belief."""
    kinds, bad = dict(structure.carried), []
    masks = {
        unravel_key(key): unravel_key(part.observed_key)
        for _, module in structure.update
        for part in in_role(module, Update)
        for key in part.reading_keys
        if part.observed_key is not None
    }
    for key, value in entries.items():
        if not value.is_floating_point():
            continue
        mask = written.get(masks.get(key), entries.get(masks.get(key)))
        finite = (kinds.get(key) or Belief()).finite(key[-1], value)
        if not finite and mask is not None and _hides(mask, value):
            finite = torch.where(_shown(mask, value), value, 0).isfinite().all()
        if not finite:
            bad.append(key)
    given = [key for key in bad if key not in structure.frame_keys]
    if bad:
        return f"NaN or infinity in {given or named(structure, bad[0])}"
    return " and ".join(flaw for kind in structure.kinds for flaw in kind.flaws(entries))


def _hides(mask: Tensor, value: Tensor) -> bool:
    """Returns True if a mask ``[*B, 1]`` or ``[*B, O]`` fits a value ``[*B, O]``, ``[*B, E, O]`` or ``[*B, O, O]``."""
    batch = mask.shape[:-1]
    return value.shape[: len(batch)] == batch and mask.shape[-1] in (1, value.shape[-1])


def _shown(mask: Tensor, value: Tensor) -> Tensor:
    """Marks the observed part of a value; of a covariance ``[*B, O, O]`` rows and columns."""
    if value.ndim == mask.ndim:
        return mask
    square = value.shape[-1] == value.shape[-2]
    return mask.unsqueeze(-2) & (mask.unsqueeze(-1) if square else mask.new_ones(1))


def _of_first_row(structure: Structure, entries: Entries, written: Entries) -> str:
    """Returns the reason in the first row whose belief is not finite."""
    mean = next((written[key] for kind in structure.kinds if (key := kind.key("mean")) in written), None)
    if mean is None:
        return _DIVERGED
    wrong = (~mean.isfinite()).any(-1)
    row = tuple(wrong.nonzero()[0].tolist()) if bool(wrong.any()) else (0,) * wrong.ndim
    here, made = (_row(values, wrong.shape, row) for values in (entries, written))
    return reason(structure, here, made) + (f", in row {list(row)}" if row else "")


def _row(values: Entries, size: torch.Size, row: tuple[int, ...]) -> Entries:
    return {key: value[row].detach() for key, value in values.items() if value.shape[: len(size)] == size}


_DIVERGED = "its motion: all inputs are finite, and the filter diverged"


def reason(structure: Structure, entries: Entries, written: Entries) -> str:
    """Returns why one row, ``[]``, of which all inputs are finite, has no finite belief."""
    belief = {*structure.carry, *structure.belief}
    now = {**{key: value for key, value in written.items() if key not in belief}, **entries}
    return (
        _noise(structure, now)
        or _no_point(structure, now)
        or _process_noise(structure, now)
        or _noise(structure, now, strict=True)
        or _module(structure, entries, written)
    )


def _noise(structure: Structure, now: Entries, *, strict: bool = False) -> str:
    """Names the noise of a reading if it is no covariance, or is zero and may be the cause."""
    for noise in noises_of(structure):
        value, mask = now.get(noise.key), None if noise.mask is None else now.get(noise.mask)
        if value is not None and bool(no_covariance(value, mask, 0, strict=strict)):
            what = f"{named(structure, noise.key)}, which is no covariance: {flaw_of(value, mask)}"
            return f"{what}, and an update divides by it" if strict else what
    return ""


def named(structure: Structure, key: NestedKey) -> str:
    """Names an entry, the module that wrote it, and that module's inputs."""
    for place, module in structure.modules:
        if key in writes(module):
            return f"{key!r}, which {_kind(module)} at {place!r} makes of {reads(module)[0]}"
    return repr(key)


def _kind(module: torch.nn.Module) -> str:
    """Names the class of a module, inside wrappers that only rename keys or add some."""
    while isinstance(module, Wrapper) and isinstance(module.module, TensorDictModuleBase):
        module = module.module
    return type(module).__name__


def _no_point(structure: Structure, now: Entries) -> str:
    """Names an entry that is no point of its space, such as a quaternion of zeros."""
    spaces = {} if structure.space is None else {kind.carry[0]: structure.space for kind in structure.kinds}
    for _, module in structure.update:
        for part in in_role(module, Update):
            if part.reading_space is not None and part.reading_keys:
                spaces[unravel_key(part.reading_keys[0])] = part.reading_space
    for key, space in spaces.items():
        value = now.get(key)
        if value is None or value.shape[-1] != space.point_dim:
            continue
        if value.isfinite().all() and not space.normalise(value).isfinite().all():
            who = repr(key) if key in structure.carry else named(structure, key)
            return (
                f"{who}, which is no point of {space}: it has {_told(value)}. A rotation is a "
                "quaternion of length one, [1, 0, 0, 0] for none"
            )
    return ""


def _process_noise(structure: Structure, now: Entries) -> str:
    """Names the process noise, which is computed again, if it is no covariance."""
    place, transition = structure.transition
    work = dict(now)
    for kind in structure.kinds:
        if all(key in work for key in kind.carry) and kind.key("mean") not in work:
            mean = kind.derived("mean", *(work[key] for key in kind.carry))
            if mean is not None:
                work[kind.key("mean")] = mean
    for owner, module in _noise_modules(transition):
        for key in reads(module)[0]:
            if key not in work and key[-1] == "mean":  # of the forecast, made inside
                work[key] = next(work[kind.key("mean")] for kind in structure.kinds if kind.key("mean") in work)
        try:
            value = run_module(module, work, Call(torch.Size(), sample=False))[unravel_key(module.out_keys[0])]
        except (KeyError, RuntimeError, StopIteration, TypeError, ValueError):
            continue  # it reads what is made inside
        read = ", ".join(f"{key!r} {_told(work[key])}" for key in reads(module)[0])
        made = f"the process noise that {_kind(module)} in {type(owner).__name__} at {place!r} makes of {read}"
        if not value.isfinite().all():
            return f"{made}, which is not finite"
        if value.ndim in (1, 2) and bool(no_covariance(value, None, 0)):
            return f"{made}, which is no covariance: {flaw_of(value)}"
    return ""


def _noise_modules(transition: torch.nn.Module) -> Iterator[tuple[SubModel, TensorDictModuleBase]]:
    for part in in_role(transition, Transition):
        for name, module in part.parts().items():
            if name in ("process_noise", "noise"):
                yield part, module


def _module(structure: Structure, entries: Entries, written: Entries) -> str:
    """Names the first module whose outputs are not finite though its inputs are, and the step's inputs."""
    before = dict(entries)
    place, module = structure.transition
    blamed = ""
    for place, module in structure.modules:
        made = [key for key in writes(module) if key in written and not _finite(written[key])]
        needed = [key for key in reads(module)[0] if key in before]
        if made and all(_finite(before[key]) for key in needed):
            blamed = f"{_kind(module)} at {place!r}, which made {made[0]!r} of {_all_told(before, needed)}"
            break
        before.update({key: written[key] for key in writes(module) if key in written})
    outside = [key for key in (*structure.needed, *structure.controls) if key in entries]
    told = _all_told(entries, outside)
    if not blamed:
        return f"{_DIVERGED}; it read {told}" if told else _DIVERGED
    extremes = f"; the step read {told}" if told else ""
    return f"{blamed}: all inputs are finite, and the filter diverged{extremes}"


def _all_told(values: Mapping[NestedKey, Tensor], keys: list[NestedKey]) -> str:
    return ", ".join(f"{key!r} {_told(values[key])}" for key in keys)


def _told(value: Tensor) -> str:
    """Returns a few numbers, or the largest of many."""
    value = value.detach()
    if value.numel() <= 4:
        numbers = value.flatten().tolist()
        return "[" + ", ".join(f"{number:g}" for number in numbers) + "]"
    return f"up to {float(value.abs().max()):g} in size"


def _finite(value: Tensor) -> bool:
    return not value.is_floating_point() or bool((value < torch.inf).all())  # a particle's weight may be zero
