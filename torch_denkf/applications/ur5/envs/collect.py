"""Collects demonstrations of the UR5 table into a folder.

A repeated call continues with the demos that are missing, truncated or changed. The result is independent of
interruptions and of the number of processes: demo i depends on the seed and i only, byte for byte (images on the same
machine and OpenGL library). :class:`torch_denkf.applications.ur5.UR5ExperienceReplay` reads the folder.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from torch_denkf._checks import check_count
from torch_denkf.applications.ur5.data import files
from torch_denkf.applications.ur5.data.files import COLLECTION, Entry
from torch_denkf.applications.ur5.envs.episodes import Options, make_demos
from torch_denkf.applications.ur5.simulation.names import TASKS, DomainName, TaskName
from torch_denkf.compilation.lock import locked

__all__ = ["collect_ur5_demos"]

FORMAT = 1  # raise it when demos of the same options come out differently
LOCK = ".collecting"
EPISODE = 350  # steps in which the expert has done the task


def collect_ur5_demos(
    root: str | Path,
    demos: int,
    *,
    size: tuple[int, int] = (224, 224),
    frames: int | None = 0,
    domain: DomainName = "sim",
    tasks: Sequence[TaskName] = TASKS,
    seed: int = 0,
    max_steps: int = EPISODE,
    noise: float = 0.0,
    processes: int = 1,
    progress: Callable[[int], object] | None = None,
) -> int:
    """Collect demos 0 to ``demos - 1`` of :class:`torch_denkf.applications.ur5.envs.expert.UR5Expert`, those that the
    folder does not have yet.

    Demo i is of task ``tasks[i % len(tasks)]``. Only successes are kept: a failed episode is dropped, and repeated with
    the demo's next seed; the manifest has the number of failures.

    Args:
        root: the folder, created if missing. One of another collection raises an error.
        demos: total number of demos in the folder; a larger number than before extends the collection.
        size: (H, W) of the images.
        frames: number of random steps of each demo to render; 0 for all, None for no images (and no OpenGL).
        domain: ``"sim"`` or ``"real_like"``, see :class:`torch_denkf.applications.ur5.UR5TableEnv`.
        tasks: some of ``"pick"``, ``"push"`` and ``"put_down"``, in turn.
        seed: of the demos.
        max_steps: rows of a demo. The episode is run for 350 steps even if fewer are kept: its end tells success.
        noise: of the expert's joint targets, rad, see :class:`torch_denkf.applications.ur5.envs.expert.UR5Expert`.
        processes: number of processes; 1 for the current process. More are spawned: a script that calls this needs ``if
            __name__ == "__main__":``.
        progress: called with the number of demos finished since the last call, including existing ones.

    Returns:
        The number of new demos.

    Raises:
        ValueError: for options out of range, or if the folder holds a collection of other options.
        OSError: if the folder cannot be written to, the disk is full, or another process is collecting into it.
        RuntimeError: without OpenGL (the message names the packages), or if a demo fails repeatedly.

    Warns: UserWarning: for each file with a wrong checksum; it is recorded again.

    Examples:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> collect_ur5_demos(folder, 1, frames=None), collect_ur5_demos(folder, 2, frames=None)
        (1, 1)
    """
    check_count("demos", demos)
    check_count("processes", processes)
    options = Options(size, frames, domain, tuple(tasks), seed, max_steps, noise)
    root = Path(root).expanduser().resolve()
    with locked(root, LOCK, "is collecting into it"):
        missing, entries = _missing(root, demos, options)
        if progress is not None:
            progress(demos - len(missing))
        for entry in make_demos(root, options, missing, processes):
            files.append_to_manifest(root, entry)
            entries[entry.demo] = entry
            if progress is not None:
                progress(1)
        files.write_manifest(root, entries.values())
    return len(missing)


def _missing(root: Path, demos: int, options: Options) -> tuple[list[int], dict[int, Entry]]:
    """Returns the numbers of the demos to record, and the manifest without them."""
    ours = {"format": FORMAT, **asdict(options)}
    ours |= {"size": list(options.size), "tasks": list(options.tasks)}  # as JSON gives them back
    entries = files.read_manifest(root, skip_damaged=True)
    theirs = files.read_options(root) if entries else ours
    if theirs is None:
        raise ValueError(f"{root} has demos but no {COLLECTION}; choose another folder")
    if theirs != ours:
        keys = [key for key in {**theirs, **ours} if theirs.get(key) != ours.get(key)]
        text = ", ".join(f"{key} {theirs.get(key)!r} instead of {ours.get(key)!r}" for key in keys)
        raise ValueError(f"{root} holds another collection, with {text}; pass its options or choose another folder")
    files.write_options(root, ours)
    for number, entry in list(entries.items()):
        wrong = files.what_is_wrong(root, entry)
        if wrong is not None:
            again = "it is made again" if number < demos else "it is taken off the list: it is beyond the number asked"
            warnings.warn(f"{wrong}; {again}", stacklevel=3)
            del entries[number]
    files.write_manifest(root, entries.values())
    return [number for number in range(demos) if number not in entries], entries
