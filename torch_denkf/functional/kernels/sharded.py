"""The measurement update of an ensemble whose columns are distributed over several processes."""

from __future__ import annotations

import os
from functools import partial

import torch
import torch.distributed as dist
from torch import Tensor

from torch_denkf.functional._ensemble_space import TILE_ELEMENTS, analyse_in_tiles
from torch_denkf.functional.analysis import Analysis, Scheme, check_analysis_arguments


def analyse_sharded(
    forecast: Tensor,
    predicted: Tensor,
    observation: Tensor,
    noise: Tensor,
    *,
    scheme: Scheme = "sensor",
    observed: Tensor | None = None,
    perturbation: Tensor | None = None,
    rotation: Tensor | None = None,
    group: dist.ProcessGroup | None = None,
) -> Analysis:
    """Runs :func:`~torch_denkf.functional.analyse` for a state too large for one process.

    Every process has all members of some components of the state, and of some components of the observation. In
    ensemble space the analysis needs from the other processes only sums over components: YYᵀ, E x E, and Y times the
    members' innovations, E x E (E x 1 for ``"etkf"``). One all-reduce adds them in double precision; then each process
    updates its own components.

    All processes must call this together, with the same members, batch, scheme and dtype. There are no gradients.
    Without a process group this process has all components.

    Args:
        forecast: this process's components, ``[*B, E, S_r]``.
        predicted: its share of the predicted observations, ``[*B, E, O_r]``; ``O_r`` may be 0.
        observation: its share of the readings, ``[*B, E, O_r]`` or ``[*B, O_r]``.
        noise: their variances, ``[*B, O_r]``.
        scheme: as in :func:`~torch_denkf.functional.analyse`.
        observed: boolean, ``[*B, 1]`` or ``[*B, O_r]``.
        perturbation: standard normal draws for ``"perturbed"``, ``[*B, E, O_r]``; different ones in each process.
        rotation: for ``"etkf"``, ``[*B, E, E]``; the same in all processes.
        group: the process group; ``None`` for all processes.

    Returns:
        The :class:`~torch_denkf.functional.analysis.Analysis`: ensemble and innovation of this process's components;
        ``nis`` and ``log_likelihood`` of all components.

    Raises:
        RuntimeError: if ``torchrun`` started several processes without a process group, or a tensor requires a
            gradient.
        ValueError: as in :func:`~torch_denkf.functional.analyse`, and for ``"perturbed"`` without ``perturbation``:
            processes with equal seeds would draw equal numbers for different components.

    Examples:
        With one process, which has all components; ``torchrun`` starts more.

        >>> import torch
        >>> ensemble = torch.tensor([[-1.0], [1.0]])
        >>> result = analyse_sharded(ensemble, ensemble, torch.tensor([4.0]), torch.tensor([2.0]), scheme="etkf")
        >>> print(f"{result.ensemble.mean():.2f} {result.ensemble.var():.2f}")
        2.00 1.00
    """
    check_analysis_arguments(
        forecast, predicted, observation, noise, scheme, observed, perturbation, rotation, None, None, "ensemble"
    )
    if scheme == "perturbed" and perturbation is None:
        raise ValueError("scheme 'perturbed' needs perturbation: draw it with a different seed in each process")
    given = {"forecast": forecast, "predicted": predicted, "observation": observation, "noise": noise}
    for name, tensor in given.items():
        if torch.is_grad_enabled() and tensor.requires_grad:
            raise RuntimeError(f"{name} requires a gradient, which analyse_sharded cannot give; use torch.no_grad()")
    begun = dist.is_initialized()
    if not begun and int(os.environ.get("WORLD_SIZE", 1)) > 1:
        raise RuntimeError(
            f"torchrun started {os.environ['WORLD_SIZE']} processes, which are not connected yet: call "
            "torch.distributed.init_process_group() first"
        )

    def total(*sums: Tensor) -> list[Tensor]:
        flat = [one.reshape(*forecast.shape[:-2], -1).double() for one in sums]
        packed = torch.cat(flat, -1)
        if begun:
            dist.all_reduce(packed, group=group)
        parts = packed.split([one.shape[-1] for one in flat], -1)
        return [part.view_as(one).to(one.dtype) for part, one in zip(parts, sums, strict=True)]

    columns = max(TILE_ELEMENTS // forecast[..., 0].numel(), 64)
    tiled = partial(analyse_in_tiles, scheme=scheme, columns=columns, observed=observed, total=total)
    return Analysis(*tiled(*given.values(), perturbation=perturbation, rotation=rotation))
