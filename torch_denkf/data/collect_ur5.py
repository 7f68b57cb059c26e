"""Collects demonstrations of the UR5 table, from the command line.

::

    python -m torch_denkf.data.collect_ur5 --demos 2000 --size 224 --out demos               # whole sequences
    python -m torch_denkf.data.collect_ur5 --demos 2000 --size 112 --frames 8 --out frames   # for a sensor
    python -m torch_denkf.data.collect_ur5 --out demos --verify                              # checksums

A repeated or killed command goes on with the demos that are missing, cut or changed. What comes out depends neither on
that nor on the number of processes: demo i follows from the seed and i alone, byte for byte (pictures on the same
machine and OpenGL library). :class:`torch_denkf.data.UR5ExperienceReplay` reads the folder.

A command stands above the layers (pyproject.toml names it as the exception): it drives an environment, and nothing
imports it.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from torch_denkf.data import _demo_files as files
from torch_denkf.data._demo_files import COLLECTION, TASKS, Domain, Entry, Task
from torch_denkf.envs._collect_ur5 import DOMAINS, Options, make_demos

__all__ = ["collect_ur5_demos", "main"]

FORMAT = 1  # raise it when demos of the same options come out differently
EPISODE = 350  # steps in which the expert has done the task


def collect_ur5_demos(
    root: str | Path,
    demos: int,
    *,
    size: tuple[int, int] = (224, 224),
    frames: int | None = 0,
    domain: Domain = "sim",
    tasks: Sequence[Task] = TASKS,
    seed: int = 0,
    max_steps: int = EPISODE,
    noise: float = 0.0,
    processes: int = 1,
    progress: Callable[[int], object] | None = None,
) -> int:
    """Collect demos 0 to ``demos - 1`` of :class:`torch_denkf.envs.UR5Expert`, those that the folder does not have yet.

    Demo i is of task ``tasks[i % len(tasks)]``. Only successes are kept: an episode at whose end the task is not done
    is left out, and the demo's next seed is drawn; the manifest counts these failures.

    Args:
        root: the folder, made if missing. Another collection's is refused.
        demos: how many the folder shall have. A larger number than before goes on where the last one ended.
        size: (H, W) of the pictures.
        frames: random steps of each demo to draw; 0 for all, None for no pictures (no OpenGL is needed then).
        domain: ``"sim"`` or ``"real_like"``, see :class:`torch_denkf.envs.UR5TableEnv`.
        tasks: some of ``"pick"``, ``"push"`` and ``"put_down"``, in turn.
        seed: another one gives other demos.
        max_steps: rows of a demo. The episode is run for 350 steps even if fewer are kept: its end tells success.
        noise: of the expert's joint targets, rad, see :class:`torch_denkf.envs.UR5Expert`.
        processes: how many collect at a time; 1 works in this process. More are spawned: a script that calls this
            needs ``if __name__ == "__main__":``.
        progress: called with the number of demos that were finished since the last call, those found there included.

    Returns:
        The number of demos that were made; the others were there.

    Raises:
        ValueError: for options out of range, or if the folder holds a collection of other options.
        OSError: if the folder cannot be written to, or another process is collecting into it.
        RuntimeError: without OpenGL (the message names the packages), or if a demo fails again and again.

    Warns:
        UserWarning: for each file whose checksum is wrong; it is made again.

    Examples:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> collect_ur5_demos(folder, 1, frames=None), collect_ur5_demos(folder, 2, frames=None)
        (1, 1)
    """
    if demos < 1 or processes < 1:
        raise ValueError(f"demos and processes must be positive, got {demos} and {processes}")
    options = Options(size, frames, domain, tuple(tasks), seed, max_steps, noise)
    root = Path(root).expanduser().resolve()
    try:
        root.mkdir(parents=True, exist_ok=True)
        lock = _lock(root)
    except OSError as error:
        raise OSError(f"cannot collect into {root}: {error}") from error
    try:
        missing, entries = _missing(root, demos, options)
        if progress is not None:
            progress(demos - len(missing))
        for entry in make_demos(root, options, missing, processes):
            files.append_to_manifest(root, entry)
            entries[entry.demo] = entry
            if progress is not None:
                progress(1)
        files.write_manifest(root, entries.values())
    finally:
        os.close(lock)
    return len(missing)


def _lock(root: Path) -> int:
    """Held until closed, or until this process is gone, however it ends."""
    import fcntl

    handle = os.open(root, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        raise OSError("another process is collecting into it; wait for it or choose another folder") from error
    return handle


def _missing(root: Path, demos: int, options: Options) -> tuple[list[int], dict[int, Entry]]:
    """Numbers of the demos to make, and the manifest without them."""
    ours = {"format": FORMAT, **asdict(options)}
    ours |= {"size": list(options.size), "tasks": list(options.tasks)}  # as JSON gives them back
    entries = files.read_manifest(root)
    theirs = files.read_options(root) if entries else ours
    if theirs is None:
        raise ValueError(f"{root} has demos but no {COLLECTION}; choose another folder")
    if theirs != ours:
        keys = [key for key in {**theirs, **ours} if theirs.get(key) != ours.get(key)]
        text = ", ".join(f"{key} {theirs.get(key)!r} instead of {ours.get(key)!r}" for key in keys)
        raise ValueError(f"{root} holds another collection, with {text}; pass its options or choose another folder")
    files.write_options(root, ours)
    for pattern in (".demo*-????????", f".{COLLECTION}-????????"):  # what a killed run left
        for left in root.glob(pattern):
            left.unlink(missing_ok=True)
    for number, entry in list(entries.items()):
        wrong = files.what_is_wrong(root, entry)
        if wrong is not None:
            again = "it is made again" if number < demos else "it is taken off the list: it is beyond the number asked"
            warnings.warn(f"{wrong}; {again}", stacklevel=3)
            del entries[number]
    files.write_manifest(root, entries.values())
    return [number for number in range(demos) if number not in entries], entries


# ----------------------------------------------------------------------------------------------------- the command


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: words of the command line; by default the process's own.

    Returns:
        The exit status: 0; 1 if ``--verify`` finds damaged files, named on stderr; 2 with a message on stderr; 130
        when interrupted.

    Examples:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> main(["--out", folder, "--demos", "1", "--no-pixels", "--processes", "1"])
        1 demos in ...: 1 made, 0 were there; 0 failed episodes left out
        0
        >>> main(["--out", folder, "--verify"])
        1 demos in ...: all checksums are right
        0
    """
    parser = argparse.ArgumentParser(
        prog=files.COMMAND,
        description="Collect demonstrations of the UR5 table; a repeated command goes on where the last one ended.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--out", required=True, type=Path, help="folder of the demos")
    parser.add_argument("--demos", type=int, default=2000, help="that the folder shall have")
    parser.add_argument(
        "--size", nargs="+", type=int, default=[224], metavar="PX", help="one side, or height and width"
    )
    parser.add_argument("--frames", type=int, default=0, help="random steps of each demo to draw; 0 for all")
    parser.add_argument("--no-pixels", action="store_true", help="states and actions alone")
    parser.add_argument("--domain", choices=DOMAINS, default="sim", help="of the environment")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS), help="in turn")
    parser.add_argument("--seed", type=int, default=0, help="another one gives other demos")
    parser.add_argument("--max-steps", type=int, default=EPISODE, help="of each demo that are kept")
    parser.add_argument("--noise", type=float, default=0.0, help="of the expert's joint targets, rad")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="that collect at a time")
    parser.add_argument("--verify", action="store_true", help="check the files that are there and make none")
    args = parser.parse_args(arguments)
    if args.verify:
        return _verify(args.out)
    bar = _bar(args.demos)
    try:
        made = collect_ur5_demos(
            args.out,
            args.demos,
            size=tuple(args.size * 2 if len(args.size) == 1 else args.size),
            frames=None if args.no_pixels else args.frames,
            domain=args.domain,
            tasks=args.tasks,
            seed=args.seed,
            max_steps=args.max_steps,
            noise=args.noise,
            processes=args.processes,
            progress=None if bar is None else bar.update,
        )
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; the same command goes on from here\n")
        return 130
    finally:
        if bar is not None:
            bar.close()
    failures = sum(entry.failures for entry in files.read_manifest(args.out).values())
    sys.stdout.write(
        f"{args.demos} demos in {args.out}: {made} made, {args.demos - made} were there; "
        f"{failures} failed episodes left out\n"
    )
    return 0


def _verify(root: Path) -> int:
    try:
        entries = files.read_manifest(root).values()
    except OSError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    if not entries:
        sys.stderr.write(f"error: no demos in {root}: no {files.MANIFEST}, or an empty one\n")
        return 2
    wrong = [text for text in (files.what_is_wrong(root, entry) for entry in entries) if text is not None]
    sys.stderr.write("".join(f"{text}\n" for text in wrong))
    found = f"{len(wrong)} are missing or damaged" if wrong else "all checksums are right"
    sys.stdout.write(f"{len(entries)} demos in {root}: {found}\n")
    return 1 if wrong else 0


def _bar(total: int):
    """A progress bar, where tqdm (of the extra ``examples``) is there and someone looks on."""
    try:
        from tqdm import tqdm
    except ImportError:
        return None
    return tqdm(total=total, unit=" demos", disable=None)


if __name__ == "__main__":
    raise SystemExit(main())
