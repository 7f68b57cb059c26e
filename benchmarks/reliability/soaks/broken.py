"""Jobs that are interrupted: by kills at random moments, by full or read-only disks, by a second process.

Each job writes to a folder. When run again, it must end with the result of an uninterrupted run, and without incomplete
files.
"""

from __future__ import annotations

import math
import os
import random
import re
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from benchmarks.reliability.case import Case, apart, forked, judge
from tests.applications.ur5.data.ur5_demos import make_demo, write_folder
from tests.borders import kitti, ur5
from tests.borders.folders import made
from tests.borders.lerobot import V2, read_episodes
from tests.borders.recordings import own, read_own
from tests.filters.factories import linear_denkf
from tests.training.problem import make_trainer
from torch_denkf.applications.car import with_motion
from torch_denkf.applications.car.kitti.render import render_drives
from torch_denkf.applications.ur5.envs.collect import collect_ur5_demos
from torch_denkf.deployment import export_step, load_step
from torch_denkf.pretrained import from_pretrained, save_pretrained
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

SMALL, LARGE = "size=64k", "size=400m"
LEFT = re.compile(r"^\.(writing|demo|collection|.*\.part)|\.part$|\.tmp$|-[0-9a-f]{8}$")
GRACE = 90.0  # s in which workers of a killed process must end: they may be importing torch
PICTURE = (100, 300)


@dataclass(frozen=True)
class Work:
    """A job that writes to a folder.

    Args:
        do: runs or resumes it.
        result: reads its results.
        words: the message of a failed write must have one of them; empty to skip the tests with disks.
        killed: whether to test kills.
        alone: whether a second process may raise; ``None`` to skip that test.
    """

    do: Callable[[Path], Any]
    result: Callable[[Path], Any]
    words: tuple[str, ...] = ()
    killed: bool = False
    alone: bool | None = None


def files(folder: Path) -> dict[str, bytes]:
    """Returns names and bytes of all files that are not hidden."""
    names = {file: file.relative_to(folder).parts for file in folder.rglob("*") if file.is_file()}
    return {
        "/".join(parts): file.read_bytes() for file, parts in names.items() if not any(p.startswith(".") for p in parts)
    }


def equal(one: Any, other: Any) -> bool:
    """Returns whether tensors, files and plain values are equal."""
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    if isinstance(one, TensorDict):
        return equal(one.to_dict(), other.to_dict())
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(equal, one, other))
    return one == other


def read(reader: Callable[[Path], Any], words: tuple[str, ...] = ("cache",), **tried: Any) -> Work:
    """Returns a job that reads through a cache, and whose result is that of reading again."""
    return Work(reader, reader, words, **tried)


def _in(name: str) -> Callable[[Path], Any]:
    return lambda folder: files(folder / name)


large_drive = made("large-kitti", lambda root: render_drives(root, names=["a"], frames=60, size=PICTURE))
large_demos = made(
    "large-demos",
    lambda root: write_folder(root, [make_demo(number, 60, frames=30, size=(96, 96)) for number in range(12)]),
)


def _drive(folder: Path) -> TensorDict:
    return kitti.read_drive(large_drive(), "a", size=PICTURE, cache=folder)


def _motion(folder: Path) -> TensorDict:
    return with_motion(kitti.read_drive(large_drive(), "a", size=PICTURE), cache=folder, keep_images=False)


def _checkpoint(folder: Path) -> Any:
    write_checkpoint(folder / "last.pt", {"model": {"weight": torch.ones(400_000)}})
    return read_checkpoint(folder / "last.pt")


def _trained(folder: Path) -> Any:
    checkpoints = {file.name: read_checkpoint(file) for file in (folder / "run").glob("*.pt")}
    return checkpoints, files(folder / "run" / "logs" / "csv")


def _collect(folder: Path, processes: int = 1) -> None:
    collect_ur5_demos(folder / "demos", 12, frames=None, max_steps=100, processes=processes)


def _render(folder: Path, processes: int = 1) -> None:
    render_drives(folder / "drives", names=["a", "b", "c"], frames=12, size=PICTURE, processes=processes)


def _export(folder: Path, compiled: bool = False) -> None:
    with tempfile.TemporaryDirectory() as cache:  # of inductor
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = cache
        frame = TensorDict({"observation": torch.zeros(2)})
        export_step(linear_denkf("etkf"), frame, folder / "step.pt2", compiled=compiled)


def _stepped(folder: Path) -> Any:
    step = load_step(folder / "step.pt2")
    sizes = {name: size for name, (size, _) in step.inputs.items()}
    return step({name: torch.arange(1.0, 1.0 + math.prod(size)).view(size) for name, size in sizes.items()})


def _save(folder: Path) -> None:
    save_pretrained(from_pretrained("ur5-table"), folder / "filter")


_CHECKPOINTS = ("last.pt", "best_sensor.pt", "best_filter.pt", "best_end_to_end.pt", "logs", "run")
_train = lambda folder: make_trainer(folder / "run", updates=12, progress=False).fit()  # noqa: E731
WORKS: dict[str, Work] = {
    "cache of a drive": read(_drive, killed=True, alone=False),
    "cache of a drive's motion": read(_motion),
    "cache of demos": read(lambda folder: ur5.read_demos(large_demos(), cache=folder), killed=True),
    "cache of a LeRobot recording": read(lambda folder: read_episodes(V2.sound(), size=(200, 300), cache=folder)),
    "cache of pictures": read(
        lambda folder: read_own(own(), camera="images", replay={"cache": folder, "size": (300, 300)})
    ),
    "checkpoint": read(_checkpoint, ("last.pt",), alone=False),
    "trainer": Work(_train, _trained, _CHECKPOINTS, killed=True, alone=True),
    "package": Work(_export, _stepped, ("step.pt2",), alone=False),
    "export": Work(partial(_export, compiled=True), _stepped, killed=True),
    "pretrained folder": Work(_save, _in("filter"), ("weights.safetensors", "filter"), alone=True),
    "collection of demos": Work(_collect, _in("demos"), ("demos", "demo"), killed=True, alone=True),
    "collection of demos, 2 processes": Work(partial(_collect, processes=2), _in("demos"), killed=True),
    "rendered drives": Work(_render, _in("drives"), ("drives",), killed=True, alone=True),
    "rendered drives, 2 processes": Work(partial(_render, processes=2), _in("drives"), killed=True),
}


def workers(session: int) -> list[int]:
    """Returns the running processes of a session."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            fields = stat.read_text().rpartition(")")[2].split()
            found += [int(stat.parent.name)] if int(fields[3]) == session and fields[0] != "Z" else []
    return found


def left_behind(folder: Path) -> list[str]:
    """Returns files and folders of incomplete writes."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if LEFT.search(path.name))


@contextmanager
def two_folders() -> Iterator[tuple[Path, Path, Path]]:
    """Yields a folder for the interrupted job, one for the uninterrupted job, and a log file."""
    with tempfile.TemporaryDirectory(prefix="broken-", ignore_cleanup_errors=True) as root:
        broken, sound = Path(root, "broken"), Path(root, "sound")
        broken.mkdir()
        sound.mkdir()
        yield broken, sound, Path(root, "log.txt")


def ends_equal(work: Work, broken: Path, sound: Path, *again: Path) -> str:
    """Runs the job again in some folders, and returns the verdict on the equality of both results."""

    def alike(folder: Path) -> bool:
        for place in again:
            work.do(place)
        return equal(work.result(broken), work.result(sound))

    return judge(Case("soak", "result", (), alike, bool, within=240)).kind


def killed(name: str, kills: int, seed: int) -> dict[str, Any]:
    """Kills a job at random moments, and runs it again."""
    work, chance, count, lingering = WORKS[name], random.Random(f"{name} {seed}"), 0, 0
    with two_folders() as (broken, sound, log):
        began = time.monotonic()
        apart(lambda: work.do(sound))
        usual = time.monotonic() - began
        while count < kills:
            child = forked(lambda: work.do(broken), log)
            time.sleep(chance.uniform(0.02, 0.95) * usual / (1 + count % 3))
            done, status = os.waitpid(child, os.WNOHANG)
            if done:  # it finished before the kill: start over in an empty folder
                if status:
                    raise RuntimeError(f"the work failed after {count} kills: {log.read_text()[-2000:]}")
                subprocess.run(["find", broken, "-mindepth", "1", "-delete"], check=True)
                continue
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            count, end = count + 1, time.monotonic() + GRACE
            while workers(child) and time.monotonic() < end:
                time.sleep(0.1)
            for worker in workers(child):
                lingering += 1
                os.kill(worker, signal.SIGKILL)
        equal_ends, left = ends_equal(work, broken, sound, broken) == "right", left_behind(broken)
    return {
        "kills": count,
        "equal to an unbroken run": equal_ends,
        "left behind": left,
        "workers that stayed": lingering,
        "right": equal_ends and not left and not lingering,
    }


@contextmanager
def disk(options: str) -> Iterator[Path]:
    """Mounts a small file system in memory."""
    folder = Path(tempfile.mkdtemp(prefix="disk-"))
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)
        folder.rmdir()


def on_disk(name: str, full: bool) -> dict[str, Any]:
    """Runs a job on a full or read-only disk, and again after the disk has room."""
    work = WORKS[name]
    with disk(SMALL if full else LARGE) as broken, two_folders() as (_, sound, _):
        if not full:
            subprocess.run(["mount", "-o", "remount,ro", broken], check=True)
        case = Case("disk", name, (*work.words, str(broken)), lambda folder: work.do(broken), within=120)
        said, left = judge(case), left_behind(broken)
        subprocess.run(["mount", "-o", f"remount,rw,{LARGE}", broken], check=True)
        after, left_then = ends_equal(work, broken, sound, broken, sound), left_behind(broken)
    return {
        "said": said.kind,
        "message": said.text.replace(str(broken), "DISK"),
        "left behind": left,
        "with room again": after,
        "left behind then": left_then,
        "right": (said.kind, after, left_then) == ("clear", "right", []),
    }


def two(name: str) -> dict[str, Any]:
    """Runs the same job in two processes in one folder."""
    work = WORKS[name]
    with two_folders() as (broken, sound, log):
        logs = [log.with_suffix(f".{k}") for k in range(2)]
        children = [forked(lambda: work.do(broken), one) for one in logs]
        statuses = [os.waitpid(child, 0)[1] for child in children]
        said = [one.read_text().strip().splitlines()[-1] for one, status in zip(logs, statuses, strict=True) if status]
        result, left = ends_equal(work, broken, sound, sound), left_behind(broken)
    sound = not said or (work.alone and len(said) == 1 and str(broken) in said[0])
    return {
        "raised": len(said),
        "message": " ".join(said).replace(str(broken), "FOLDER"),
        "result": result,
        "left behind": left,
        "right": bool(sound) and result == "right" and not left,
    }


Rows = dict[str, Callable[[], dict[str, Any]]]


def kill_jobs(kills: int, seed: int) -> Rows:
    """Returns jobs that kill each work ``kills`` times, at moments from a seed."""
    large_drive(), large_demos()  # once here, not in each job's process
    return {name: partial(killed, name, kills, seed) for name, work in WORKS.items() if work.killed}


def disk_jobs() -> Rows:
    """Returns jobs that run each work on each kind of disk, and in two processes.

    Raises:
        PermissionError: without the permission to mount file systems.
    """
    if os.geteuid() != 0:
        raise PermissionError("small disks are mounted, which needs root; leave out the part 'disks'")
    for sound in (own, V2.sound, large_drive, large_demos):
        sound()
    kinds, tried = {"full": True, "read-only": False}, {name: work for name, work in WORKS.items() if work.words}
    alone = {f"{name}, {kind} disk": partial(on_disk, name, full) for name in tried for kind, full in kinds.items()}
    pairs = [name for name, work in WORKS.items() if work.alone is not None]
    return alone | {f"{name}, two processes": partial(two, name) for name in pairs}
