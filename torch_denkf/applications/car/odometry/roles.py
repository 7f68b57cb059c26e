"""Training drives of a car filter, and their assignment to training stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from torch_denkf.applications.car.kitti.drive import list_kitti_drives
from torch_denkf.applications.car.kitti.render import render_drives
from torch_denkf.applications.car.odometry.streams import Drive
from torch_denkf.deployment.progress import progress_bar

__all__ = ["assign_roles", "drives_by_role", "recorded_drives", "rendered_drives"]

_PITCH = 0.03  # rad: largest pitch of rendered cameras, up or down


def assign_roles(names: Sequence[str]) -> dict[str, list[str]]:
    """Assigns drives to roles: a tenth for validation, a quarter for the filter, the others for the sensor.

    A single drive trains the filter; of two, the second trains the sensor.

    Args:
        names: names of drives of one kind, recorded or rendered.

    Returns:
        Names by role: ``"validation"``, ``"filter"``, ``"sensor"``.

    Example:
        >>> assign_roles(["00", "01", "02", "03"])
        {'validation': ['00'], 'filter': ['01'], 'sensor': ['02', '03']}
    """
    checked = max(len(names) // 10, 1) if len(names) > 2 else 0
    tuned = checked + (max(len(names) // 4, 1) if names else 0)
    return {"validation": list(names[:checked]), "filter": list(names[checked:tuned]), "sensor": list(names[tuned:])}


def recorded_drives(
    root: str | Path, names: Sequence[str] | None, leave_out: Sequence[str], *, height: float, **common: Any
) -> list[Drive]:
    """Returns the drives below ``root`` that training may use.

    Args:
        root: folder in KITTI's layout.
        names: names of the drives; all by default.
        leave_out: names of drives that must not be used.
        height: height of their camera over the road, in m.
        **common: size and cache of a :class:`Drive`.

    Raises:
        FileNotFoundError: if a named drive does not exist, or none is left.
    """
    there = list_kitti_drives(root)
    if unknown := [name for name in (*(names or ()), *leave_out) if name not in there]:
        raise FileNotFoundError(f"no drives {unknown} with images and poses below {root}; it has {there}")
    chosen = [name for name in (names or there) if name not in leave_out]
    if not chosen:
        raise FileNotFoundError(f"no drive below {root} has both images and poses, or all are left out")
    return [Drive(Path(root), name, height=height, **common) for name in chosen]


def rendered_drives(
    root: Path, count: int, *, frames: int, seed: int, processes: int | None, progress: bool, **common: Any
) -> list[Drive]:
    """Renders drives with traffic, each with a random small pitch of the camera.

    Args:
        root: folder to write to; existing drives are kept.
        count: number of drives.
        frames: frames per drive.
        seed: seed of the drives.
        processes: number of parallel processes.
        progress: whether to show a progress bar.
        **common: size and cache of a :class:`Drive`.
    """
    if not count:
        return []
    names = [f"r{number:02d}" for number in range(count)]
    with progress_bar("rendering", count * frames, unit=" images", shown=progress) as bar:
        render_drives(
            root,
            names=names,
            frames=frames,
            size=common["size"],
            seed=seed,
            processes=processes,
            progress=bar.update,
        )
    pitches = (torch.rand(count, generator=torch.Generator().manual_seed(seed)) * 2 - 1) * _PITCH
    return [Drive(root, name, pitch=round(float(p), 4), **common) for name, p in zip(names, pitches, strict=True)]


def drives_by_role(*kinds: Sequence[Drive]) -> dict[str, list[Drive]]:
    """Returns the drives of all kinds by role; in each role every drive has the same weight.

    Args:
        *kinds: recorded drives, rendered drives.

    Raises:
        ValueError: if there are too few for three roles.
    """
    roles: dict[str, list[Drive]] = {"validation": [], "filter": [], "sensor": []}
    for kind in kinds:
        of = {drive.name: drive for drive in kind}
        for role, names in assign_roles(list(of)).items():
            roles[role] += [of[name] for name in names]
    if lacking := [role for role, parts in roles.items() if not parts]:
        raise ValueError(
            f"{sum(map(len, kinds))} drives are too few: none is left for {lacking}. Pass three or more, recorded "
            "(root, drives) or rendered"
        )
    return {role: [replace(drive, weight=1 / len(parts)) for drive in parts] for role, parts in roles.items()}
