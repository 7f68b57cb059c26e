"""Full and read-only disks, and two processes that write to one place."""

from __future__ import annotations

import atexit
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from benchmarks.reliability.borders import kitti, lerobot, recordings, ur5
from benchmarks.reliability.case import Case, apart, judge
from benchmarks.reliability.damage import same
from benchmarks.reliability.soaks.kills import _files, _fork, _left_behind
from tests.applications.ur5.data.ur5_demos import make_demo, write_folder
from tests.filters.factories import linear_kalman
from tests.training.problem import make_trainer
from torch_denkf.applications.car import read_kitti_drive, with_motion
from torch_denkf.applications.car.kitti.render import render_drives
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.envs.collect import collect_ur5_demos
from torch_denkf.deployment import export_step, load_step
from torch_denkf.pretrained import from_pretrained, save_pretrained
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

SMALL, LARGE = "size=64k", "size=400m"


@dataclass(frozen=True)
class Writer:
    """Writes to a folder.

    Args:
        write: writes; returns what can be compared.
        words: one of them is in the message where it cannot.
    """

    write: Callable[[Path], Any]
    words: tuple[str, ...]


@cache
def _scratch() -> Path:
    """A folder for what writers start from."""
    return Path(tempfile.mkdtemp(prefix="disks-"))


def _large_drive() -> Path:
    root = _scratch() / "kitti"
    if not root.exists():
        apart(lambda: render_drives(root, names=["a"], frames=40, size=(100, 300)))
    return root


def _large_demos() -> Path:
    root = _scratch() / "demos"
    if not root.exists():
        root.mkdir(parents=True)
        write_folder(root, [make_demo(number, 60, frames=30, size=(96, 96)) for number in range(6)])
    return root


def _motion(folder: Path) -> TensorDict:
    drive = read_kitti_drive(_large_drive(), "a", size=(100, 300), cache=None)
    return with_motion(drive, cache=folder, keep_images=False)


def _checkpoint(folder: Path) -> Any:
    write_checkpoint(folder / "last.pt", {"model": {"weight": torch.ones(400_000)}})
    return read_checkpoint(folder / "last.pt")["model"]


def _trainer(folder: Path) -> Any:
    trainer = make_trainer(folder / "run", updates=4, progress=False)
    trainer.fit()
    return dict(trainer.model.state_dict())


def _package(folder: Path) -> Any:
    file = export_step(linear_kalman(), TensorDict({"observation": torch.ones(2)}), folder / "step.pt2", compiled=False)
    step = load_step(file)
    return step({name: torch.ones(shape) for name, (shape, _) in step.inputs.items()})


def _pretrained(folder: Path) -> Any:
    save_pretrained(from_pretrained("ur5-table"), folder / "filter")
    return dict(from_pretrained(folder / "filter").state_dict())


def _collection(folder: Path) -> Any:
    collect_ur5_demos(folder / "demos", 30, frames=None, max_steps=300)
    return UR5ExperienceReplay(folder / "demos", split="all", cache=None, progress=False)[:]


def _drives(folder: Path) -> Any:
    render_drives(folder / "drives", names=["a"], frames=30, size=(100, 300))
    return read_kitti_drive(folder / "drives", "a", size=(100, 300), cache=None)


WRITERS: dict[str, Writer] = {
    "cache of a drive": Writer(
        lambda folder: read_kitti_drive(_large_drive(), "a", size=(100, 300), cache=folder).clone(), ("cache",)
    ),
    "cache of a drive's motion": Writer(lambda folder: _motion(folder).clone(), ("cache",)),
    "cache of demos": Writer(
        lambda folder: UR5ExperienceReplay(_large_demos(), split="all", cache=folder, progress=False)[:], ("cache",)
    ),
    "cache of a LeRobot recording": Writer(
        lambda folder: lerobot.read(lerobot.sound(2), size=(200, 300), cache=folder), ("cache",)
    ),
    "cache of pictures": Writer(
        lambda folder: recordings.read(
            recordings.sound(), camera="images", replay={"cache": folder, "size": (300, 300)}
        ),
        ("cache",),
    ),
    "checkpoint": Writer(_checkpoint, ("last.pt",)),
    "trainer": Writer(_trainer, ("last.pt", "best_sensor.pt", "best_filter.pt", "best_end_to_end.pt", "logs", "run")),
    "package": Writer(_package, ("step.pt2",)),
    "pretrained folder": Writer(_pretrained, ("weights.safetensors", "filter")),
    "collection of demos": Writer(_collection, ("demos", "demo")),
    "rendered drives": Writer(_drives, ("drives",)),
}


@contextmanager
def _disk(options: str) -> Iterator[Path]:
    """A small file system in memory."""
    folder = Path(tempfile.mkdtemp(prefix="disk-"))
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)
        folder.rmdir()


def _on_disk(name: str, kind: str) -> dict[str, Any]:
    """Writing where there is no room, or nothing may be written; and again where there is."""
    writer, began = WRITERS[name], time.time()
    full = kind == "full"
    with _disk(SMALL if full else LARGE) as disk:
        if not full:
            subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
        refused = judge(Case("disk", name, (*writer.words, str(disk)), lambda folder: writer.write(disk), within=120))
        left = _left_behind(disk)
        subprocess.run(["mount", "-o", f"remount,rw,{LARGE}", disk], check=True)

        def sound(folder: Path) -> bool:
            expected = folder / "sound"
            expected.mkdir()
            return same(writer.write(disk), writer.write(expected))

        after = judge(Case("disk", name, (), sound, bool, within=240))
        left_after = _left_behind(disk)
    return {
        "name": f"{name}, {kind} disk",
        "said": refused.kind,
        "message": refused.text.replace(str(disk), "DISK"),
        "left behind": left,
        "with room again": after.kind,
        "left behind then": left_after,
        "right": refused.kind == "clear" and after.kind == "right" and not left_after,
        "seconds": round(time.time() - began, 1),
    }


def _two(
    name: str, work: Callable[[Path], Any], result: Callable[[Path], Any], one_may_be_refused: bool
) -> dict[str, Any]:
    """Two processes that do the same in one folder at a time."""
    began = time.time()
    root = Path(tempfile.mkdtemp(prefix="two-"))
    try:
        shared, alone = root / "shared", root / "alone"
        logs = [root / f"{k}.txt" for k in range(2)]
        for folder in (shared, alone):
            folder.mkdir()
        children = [_fork(partial(work, shared), log) for log in logs]
        statuses = [os.waitpid(child, 0)[1] for child in children]
        said = [log.read_text().strip().splitlines()[-1:] for log, status in zip(logs, statuses, strict=True) if status]
        apart(lambda: work(alone))
        verdict = judge(Case("pairs", name, (), lambda folder: result(shared) == result(alone), bool, within=120))
        refused = sum(status != 0 for status in statuses)
        named = all(line and str(shared) in line[0] for line in said)
        left = _left_behind(shared)
        return {
            "name": f"{name}, two processes",
            "refused": refused,
            "message": " ".join(line[0].replace(str(shared), "FOLDER") for line in said if line),
            "result": verdict.kind,
            "left behind": left,
            "right": verdict.kind == "right"
            and not left
            and (refused == 0 or (one_may_be_refused and refused == 1 and named)),
            "seconds": round(time.time() - began, 1),
        }
    finally:
        shutil.rmtree(root, ignore_errors=True)


def _weights(folder: Path) -> Any:
    content = read_checkpoint(folder / "run" / "last.pt")["model"]
    return {name: value.tolist() for name, value in content.items()}


def _cached(folder: Path) -> bytes:
    drive = read_kitti_drive(_large_drive(), "a", size=(100, 300), cache=folder)
    return b"".join(drive[key].contiguous().numpy().tobytes() for key in sorted(drive.keys()))


PAIRS: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any], bool]] = {
    "trainer": (lambda folder: make_trainer(folder / "run", updates=12, progress=False).fit(), _weights, True),
    "collection of demos": (
        lambda folder: collect_ur5_demos(folder / "demos", 4, frames=None, max_steps=60),
        lambda folder: _files(folder / "demos"),
        True,
    ),
    "rendered drives": (
        lambda folder: render_drives(folder / "drives", names=["a", "b"], frames=20),
        lambda folder: _files(folder / "drives"),
        True,
    ),
    "cache of a drive": (_cached, _cached, False),
    "package": (_package, lambda folder: str(_package(folder)), False),
    "pretrained folder": (_pretrained, lambda folder: _files(folder / "filter"), True),
    "checkpoint": (_checkpoint, lambda folder: _checkpoint(folder)["weight"].sum().item(), False),
}


def jobs() -> dict[str, Callable[[], dict[str, Any]]]:
    """Each writer on each kind of disk, and each pair; what they start from is made here, before any is forked.

    Raises:
        PermissionError: where one may not mount file systems.
    """
    if os.geteuid() != 0:
        raise PermissionError("small disks are mounted, which needs root; leave out the part 'disks'")
    for sound in (kitti.sound, ur5.sound, recordings.sound, partial(lerobot.sound, 2), _large_drive, _large_demos):
        sound()
    atexit.register(shutil.rmtree, _scratch(), ignore_errors=True)  # not in forked children, which leave by os._exit
    kinds = ("full", "read-only")
    alone = {f"{name}, {kind} disk": partial(_on_disk, name, kind) for name in WRITERS for kind in kinds}
    return alone | {f"{name}, two processes": partial(_two, name, *pair) for name, pair in PAIRS.items()}
