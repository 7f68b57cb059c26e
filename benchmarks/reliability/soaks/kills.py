"""Work that is killed at random moments and started again: does it end as if it had not been, and what is left?"""

from __future__ import annotations

import hashlib
import os
import random
import re
import shutil
import signal
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from tests.applications.ur5.data.ur5_demos import make_demo, write_folder
from tests.filters.factories import linear_denkf
from tests.training.problem import make_trainer
from torch_denkf.applications.car import read_kitti_drive
from torch_denkf.applications.car.kitti.render import render_drives
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.envs.collect import collect_ur5_demos
from torch_denkf.deployment import export_step, load_step
from torch_denkf.training.checkpoint import read_checkpoint

LEFT = re.compile(r"^\.(writing|demo|collection|.*\.part)|\.part$|\.tmp$|-[0-9a-f]{8}$")
GRACE = 90.0  # s in which workers of a killed process end themselves: they may be importing torch


@dataclass(frozen=True)
class Job:
    """Work in a folder.

    Args:
        work: does it, or goes on with it.
        result: bytes of all that it leaves, once it is done.
        prepare: makes what it starts from; at the first start alone.
    """

    work: Callable[[Path], Any]
    result: Callable[[Path], bytes]
    prepare: Callable[[Path], Any] = lambda folder: None


def _files(folder: Path) -> bytes:
    """Names and bytes of all files that are not hidden."""
    out = hashlib.sha256()
    for file in sorted(folder.rglob("*")):
        parts = file.relative_to(folder).parts
        if file.is_file() and not any(part.startswith(".") for part in parts):
            out.update("/".join(parts).encode() + b"\0" + file.read_bytes())
    return out.digest()


def _tensors(content: Any) -> bytes:
    """Bytes of all tensors and plain values."""
    if isinstance(content, torch.Tensor):
        return content.contiguous().numpy().tobytes()
    if isinstance(content, dict):
        return b"".join(
            str(key).encode() + _tensors(value) for key, value in sorted(content.items(), key=lambda item: str(item[0]))
        )
    if isinstance(content, list | tuple):
        return b"".join(map(_tensors, content))
    return repr(content).encode()


def _train(folder: Path) -> None:
    make_trainer(folder / "out", updates=12, progress=False).fit()


def _trained(folder: Path) -> bytes:
    out = folder / "out"
    parts = [_tensors(read_checkpoint(file)) for file in sorted(out.glob("*.pt"))]
    return b"".join(parts) + _files(out / "logs" / "csv")


def _collect(processes: int) -> Callable[[Path], Any]:
    def work(folder: Path) -> None:
        collect_ur5_demos(folder / "out", 6, frames=None, max_steps=60, processes=processes)

    return work


def _render(processes: int) -> Callable[[Path], Any]:
    def work(folder: Path) -> None:
        names = ["a", "b", "c"]
        render_drives(folder / "out", names=names, frames=20, size=(50, 150), processes=processes)

    return work


def _export(folder: Path) -> None:
    os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(folder / "inductor")
    frame = TensorDict({"observation": torch.zeros(2)})
    export_step(linear_denkf("etkf"), frame, folder / "out" / "step.pt2")


def _exported(folder: Path) -> bytes:
    step = load_step(folder / "out" / "step.pt2")
    entries = {name: torch.ones(shape) for name, (shape, _) in step.inputs.items()}
    entries["belief.ensemble"] = torch.arange(12.0).reshape(6, 2)
    return _tensors(step(entries))


def _drive(folder: Path) -> None:
    render_drives(folder / "kitti", names=["a"], frames=150, size=(100, 300))


def _read_drive(folder: Path) -> TensorDict:
    return read_kitti_drive(folder / "kitti", "a", size=(100, 300), cache=folder / "out")


def _demos(folder: Path) -> None:
    (folder / "demos").mkdir()
    write_folder(folder / "demos", [make_demo(number, 60, frames=40, size=(96, 96)) for number in range(40)])


def _read_demos(folder: Path) -> TensorDict:
    return UR5ExperienceReplay(folder / "demos", split="all", cache=folder / "out", progress=False)[:]


def _of_cache(read: Callable[[Path], TensorDict]) -> Callable[[Path], bytes]:
    return lambda folder: _tensors(dict(read(folder).items(True, True)))


JOBS: dict[str, Job] = {
    "trainer": Job(_train, _trained),
    "UR5 collection": Job(_collect(1), lambda folder: _files(folder / "out")),
    "UR5 collection, 2 processes": Job(_collect(2), lambda folder: _files(folder / "out")),
    "rendering": Job(_render(1), lambda folder: _files(folder / "out")),
    "rendering, 2 processes": Job(_render(2), lambda folder: _files(folder / "out")),
    "export": Job(_export, _exported),
    "cache of a drive": Job(_read_drive, _of_cache(_read_drive), _drive),
    "cache of demos": Job(_read_demos, _of_cache(_read_demos), _demos),
}


def _fork(work: Callable[[], Any], log: Path) -> int:
    """Starts work in a process of its own session."""
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        os.setsid()
        with log.open("a") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        work()
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(status)


def _wait(child: int, log: Path) -> None:
    _, status = os.waitpid(child, 0)
    if status:
        raise RuntimeError(f"the work failed: {log.read_text()[-2000:]}")


def _workers(session: int) -> list[int]:
    """Processes of a session that are still there."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                fields = (folder / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[3]) == session and fields[0] != "Z":
                found.append(int(folder.name))
    return found


def _left_behind(folder: Path) -> list[str]:
    """Files and folders of writes that did not end."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if LEFT.search(path.name))


def soak(name: str, kills: int, seed: int) -> dict[str, Any]:
    """A row of the table."""
    job, began, chance = JOBS[name], time.time(), random.Random(f"{name} {seed}")
    root = Path(tempfile.mkdtemp(prefix="kills-"))
    log = root / "log.txt"
    try:
        for run in ("unbroken", "killed"):
            (root / run).mkdir()
            _wait(_fork(lambda run=run: job.prepare(root / run), log), log)
        started = time.time()
        _wait(_fork(lambda: job.work(root / "unbroken"), log), log)
        usual = time.time() - started
        expected, found = root / "expected", root / "found"
        _wait(_fork(lambda: expected.write_bytes(job.result(root / "unbroken")), log), log)
        killed, lingering, endings = 0, 0, 0
        while killed < kills:
            child = _fork(lambda: job.work(root / "killed"), log)
            time.sleep(chance.uniform(0.02, 0.95) * usual / (1 + killed % 3))
            done, status = os.waitpid(child, os.WNOHANG)
            if done:  # it came to its end: once more from the start
                if status:
                    raise RuntimeError(f"the work failed after {killed} kills: {log.read_text()[-2000:]}")
                endings += 1
                shutil.rmtree(root / "killed" / "out", ignore_errors=True)
                continue
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            killed += 1
            end = time.time() + GRACE
            while _workers(child) and time.time() < end:
                time.sleep(0.1)
            for worker in _workers(child):
                lingering += 1
                os.kill(worker, signal.SIGKILL)
        _wait(_fork(lambda: job.work(root / "killed"), log), log)
        left = _left_behind(root / "killed" / "out")
        _wait(_fork(lambda: found.write_bytes(job.result(root / "killed")), log), log)
        equal = found.read_bytes() == expected.read_bytes()
        return {
            "name": name,
            "kills": killed,
            "runs to the end between them": endings,
            "equal to an unbroken run": equal,
            "left behind": left,
            "workers that stayed": lingering,
            "right": equal and not left and not lingering,
            "seconds": round(time.time() - began, 1),
        }
    finally:
        shutil.rmtree(root, ignore_errors=True)


def jobs(kills: int, seed: int) -> dict[str, Callable[[], dict[str, Any]]]:
    """So many kills of each job, at moments of a seed."""
    return {name: partial(soak, name, kills, seed) for name in JOBS}
