"""Compares a compiled function with the eager one, as compilers may be silently wrong."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

__all__ = ["check_same_numbers", "placed", "put_back", "tensors"]

#: Allowed rounding errors of reordered sums: relative to the largest value of a column, and of an entry.
_OF_COLUMN, _OF_ENTRY = 1000, 10
#: Perturbation of inputs in rounding errors, to measure the eager function's sensitivity; largest number of trials.
_NUDGE, _NUDGES = 8, 32


def check_same_numbers(
    compiled: Callable,
    eager: Callable,
    inputs: Sequence[Any],
    *,
    names: Sequence[NestedKey],
    outputs: Sequence[NestedKey],
    frames: Collection[NestedKey],
    parameters: Mapping[str, Tensor] | None = None,
    state: Iterable[Tensor] = (),
    what: str,
    cure: str,
    maker: str = "torch's compiler",
) -> None:
    """Raises unless a compiled function returns the eager result, up to rounding.

    Both run on the given inputs. If a frame is missing, or entirely zero, both run again with random numbers in it, as
    an update by zero does not test the gain. If an input is not finite, they run only on random numbers. NaN in both is
    equal.

    The effect of rounding depends on the filter: a variance that a reading reduces by 1e6 loses six digits, and a
    particle filter may draw another particle. So it is measured: if the results differ in more than their last digits,
    the eager function also runs on inputs with perturbed last digits, and with other random numbers, if it draws any.
    The compiled result may differ twice as much.

    Args:
        compiled: takes ``inputs``, and returns nested tuples of tensors.
        eager: the same function, eagerly.
        inputs: tensors, ``None``, or tuples of them. Replacements have the same shapes, strides and ``requires_grad``,
            so that nothing is compiled again.
        names: names of the tensors in ``inputs``, in their order.
        outputs: names of the returned tensors, in their order.
        frames: names of inputs with arbitrary values: readings, actions, masks.
        parameters: parameters by name; if given, a directional gradient of the outputs with respect to these and the
            frames is compared, too. This may compile a backward pass.
        state: buffers that the function may change, such as running means; they are restored after each run.
        what: name of the compiled code, for the message.
        cure: what to do, for the message.
        maker: whose error a difference is, for the message.

    Raises:
        RuntimeError: if they differ more; the message names the output with the largest difference.
    """
    given = list(tensors(inputs))
    free = [name in frames for name in names]
    telling = [_telling(value) if may else value for value, may in zip(given, free, strict=True)]
    labels, by, trained = [repr(name) for name in outputs], [], {}
    if parameters is not None and torch.is_grad_enabled():
        # Not with respect to beliefs: either triangle of a covariance may be read.
        by = [index for index, value in enumerate(given) if value.requires_grad and free[index]]
        trained = {name: value for name, value in parameters.items() if value.requires_grad}
        labels += [f"gradient by {name!r}" for name in [names[index] for index in by]]
        labels += [f"gradient by the parameter {name}" for name in trained]

    kept = [(value, value.detach().clone()) for value in state]

    def run(function: Callable, values: Sequence[Tensor], seed: int = 0) -> list[Tensor]:
        try:
            return _results(function, inputs, values, by, list(trained.values()), seed)
        finally:
            put_back(kept)

    same = all(one is other for one, other in zip(given, telling, strict=True))
    finite = all(bool(value.isfinite().all()) for value in given)  # a compiler may simplify NaN times zero to zero
    for values in [given] if same else [given, telling] if finite else [telling]:
        ours, theirs = run(compiled, values), run(eager, values)
        off, allowed = list(map(_distance, ours, theirs)), _last_digits(theirs, len(outputs))
        step = 0.0
        for nudge in range(1, _NUDGES + 1):
            if _fits(off, allowed):
                break
            step = step or _NUDGE * _coarsest_rounding(run, eager, values)
            near = run(eager, [_nudged(value, step, nudge) for value in values], nudge)
            spread = map(_distance, near, theirs)
            allowed = [torch.maximum(most, 2 * far) for most, far in zip(allowed, spread, strict=True)]
        if not _fits(off, allowed):
            pairs = zip(off, allowed, strict=True)
            times = [float((far / most.clamp(min=1e-300)).nan_to_num(nan=0.0).max()) for far, most in pairs]
            worst = times.index(max(times))
            raise RuntimeError(
                f"The {what} is wrong: {labels[worst]} is up to {float(off[worst].max()):.3g} off what the "
                f"same code gives eagerly, up to {float(theirs[worst].double().abs().max()):.3g}; rounding explains "
                f"{float(allowed[worst].max()):.1g}. That is an error of {maker} (torch {torch.__version__}), "
                f"and nothing is returned. {cure}"
            )


def put_back(kept: Sequence[tuple[Tensor, Tensor]]) -> None:
    """Restores the values of tensors; unchanged ones are not written, as a graph may have saved them."""
    with torch.no_grad():
        for value, before in kept:
            if not torch.equal(value, before):
                value.copy_(before)


def tensors(value: Any) -> Iterator[Tensor]:
    """Yields the tensors in nested tuples and lists."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, tuple | list):
        for part in value:
            yield from tensors(part)


def placed(like: Any, values: Iterator[Tensor]) -> Any:
    """Replaces the tensors in nested tuples."""
    if isinstance(like, Tensor):
        return next(values)
    return tuple(placed(part, values) for part in like) if isinstance(like, tuple) else like


def _results(
    function: Callable,
    like: Sequence[Any],
    values: Sequence[Tensor],
    by: Sequence[int],
    parameters: Sequence[Tensor],
    seed: int,
) -> list[Tensor]:
    """Returns clones of a function's results, and its gradients with respect to some ``values`` and ``parameters``."""
    copies = {id(value): value.detach().requires_grad_() for value in values if value.requires_grad}
    leaves = [copies.get(id(value), value) for value in values]
    places = iter(leaves)
    devices = sorted({value.device.index or 0 for value in values if value.is_cuda})
    with torch.random.fork_rng(devices):
        for generator in (torch.default_generator, *(torch.cuda.default_generators[index] for index in devices)):
            generator.manual_seed(seed)
        out = list(tensors(function(*(placed(part, places) for part in like))))
    found = [value.detach().clone() for value in out]
    sources, ends = [*(leaves[index] for index in by), *parameters], [value for value in out if value.requires_grad]
    if not sources or not ends:
        return found + [torch.zeros_like(value) for value in sources]
    along = [_waves(end) for end in ends]
    return found + list(torch.autograd.grad(ends, sources, along, materialize_grads=True))


def _waves(value: Tensor) -> Tensor:
    """Returns fixed numbers between -1 and 1, in the shape and dtype of a tensor."""
    numbers = torch.arange(1, value.numel() + 1, dtype=torch.float64).sin()
    return numbers.reshape(value.shape).to(value.device, value.dtype)


def _telling(value: Tensor) -> Tensor:
    """Returns a frame with finite nonzero values in the layout of the given one; the given one if it has them."""
    if value.dtype == torch.bool:
        known, numbers = value, torch.ones_like(value)
    elif value.is_floating_point():
        known, numbers = value.abs() < 1e18, 1 + _waves(value) / 2  # also false for NaN
        some = known & (value != 0)
        if some.any():
            numbers = numbers * value.detach()[some].abs().mean()
        else:
            known = some
    else:
        return value
    if known.all():
        return value
    # expanded dimensions are written once
    one = [slice(0, 1) if stride == 0 else slice(None) for stride in value.stride()]
    new = torch.where(known, value.detach(), numbers)[*one]
    out = torch.empty_strided(new.shape, value.stride(), dtype=value.dtype, device=value.device)
    return out.copy_(new).expand(value.shape).requires_grad_(value.requires_grad)


def _nudged(value: Tensor, step: float, seed: int) -> Tensor:
    """Perturbs the last digits of values."""
    if not value.is_floating_point():
        return value
    noise = torch.randn(value.shape, generator=torch.Generator().manual_seed(seed)).to(value)
    return (value.detach() * (1 + step * noise)).requires_grad_(value.requires_grad)


def _distance(one: Tensor, other: Tensor) -> Tensor:
    """Returns the distance of two tensors in each column; infinite if only one of them is NaN."""
    one, other = one.cpu().double(), other.cpu().double()
    same = (one == other) | (one.isnan() & other.isnan())
    return _columns(torch.where(same, 0.0, (one - other).abs().nan_to_num(nan=torch.inf)))


def _columns(value: Tensor) -> Tensor:
    """Returns the largest number in each column."""
    value = value.reshape(-1, value.shape[-1] if value.ndim and value.numel() else 1)
    return value.amax(0) if len(value) else value.new_zeros(1)


def _last_digits(values: Sequence[Tensor], outputs: int) -> list[Tensor]:
    """Bounds the rounding between two orders of a sum, for each column; ``values`` after ``outputs`` are gradients."""
    sizes = [_columns(value.cpu().double().abs().nan_to_num(nan=0, posinf=0)) for value in values]
    steepest = max((float(size.max()) for size in sizes[outputs:]), default=0.0)
    found = []
    for index, (value, size) in enumerate(zip(values, sizes, strict=True)):
        eps = torch.finfo(value.dtype).eps if value.is_floating_point() else 0.0
        largest = float(size.max()) if index < outputs else steepest
        found.append(min(_OF_COLUMN * eps, 0.02) * size + _OF_ENTRY * eps * largest)
    return found


def _fits(off: Iterable[Tensor], allowed: Iterable[Tensor]) -> bool:
    return all(bool((far <= most).all()) for far, most in zip(off, allowed, strict=True))


class _Precision(TorchDispatchMode):
    """Finds the coarsest rounding among all operations."""

    coarsest = 0.0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        for value in tensors(out):
            if value.is_floating_point():
                self.coarsest = max(self.coarsest, torch.finfo(value.dtype).eps)
        return out


def _coarsest_rounding(run: Callable, *args: Any) -> float:
    """Returns the coarsest rounding of all operations, such as that of a trunk in bfloat16."""
    with _Precision() as mode:
        run(*args)
    products = 0.0 if torch.get_float32_matmul_precision() == "highest" else torch.finfo(torch.bfloat16).eps
    return max(mode.coarsest, products)
