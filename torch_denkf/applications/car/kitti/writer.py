"""Writes rendered drives in chunks and parallel processes; a drive that exists is complete."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import shutil
import zlib
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from torch_denkf.applications.car.kitti.files import write_poses
from torch_denkf.applications.car.street.camera import Camera
from torch_denkf.applications.car.street.renderer import Renderer
from torch_denkf.applications.car.street.roadside import roadside_scene
from torch_denkf.applications.car.vision.poses import KITTI_DT, poses_to_state
from torch_denkf.deployment.files import clear_errors, place_beside, sync
from torch_denkf.deployment.workers import follow_parent

FORMAT = 3  # raise it when the drives of the same options change
MARKER = "drive.json"
STRETCH = 500  # frames per task; each process must build the scene again
REPORTED = 40  # frames between progress reports of a single process
GRAIN = 1.5  # grey values: standard deviation of the images' noise


@dataclass
class Job:
    """One drive to write.

    Attributes:
        root: folder that gets ``sequences`` and ``poses``.
        name: name of the drive.
        poses: camera-to-world matrices, ``[N, 3, 4]``.
        camera: camera of the images.
        folder: folder of the images; ``image_0`` and ``image_1`` are grey.
        traffic: whether cars move.
        options: options that determine the drive, for its marker, including ``seed``.
        beside: temporary folder until the drive is complete.
    """

    root: Path
    name: str
    poses: np.ndarray
    camera: Camera
    folder: str
    traffic: bool
    options: dict
    beside: Path = Path()

    @property
    def target(self) -> Path:
        """Returns the folder that the drive is written to."""
        return self.root / "sequences" / self.name

    def is_there(self, overwrite: bool) -> bool:
        """Returns True if the drive exists already.

        Raises:
            FileExistsError: if another drive exists that may not be replaced.
        """
        if not self.target.exists():
            return False
        marker = self.target / MARKER
        ours = json.loads(marker.read_text()) if marker.is_file() else None
        if ours == self.options:
            return True
        if ours is None or not overwrite:
            if ours is None:
                raise FileExistsError(f"{self.target} is there and was not rendered; choose another name or folder")
            other = ", ".join(f"{key} {ours.get(key)!r}" for key in self.options if ours.get(key) != self.options[key])
            raise FileExistsError(
                f"{self.target} is there and was rendered with other options ({other}); choose another name, or "
                "overwrite=True (--overwrite) to replace it"
            )
        return False

    def renderer(self) -> Renderer:
        """Returns the drive's scene, from its name and seed."""
        rng = np.random.default_rng([self.options["seed"], zlib.crc32(self.name.encode()), 1])
        ground = self.poses[:, 1, 3] + self.camera.height
        scene = roadside_scene(poses_to_state(self.poses, KITTI_DT), rng, ground=ground, traffic_on=self.traffic)
        return Renderer(scene, self.camera)

    def draw(self, renderer: Renderer, start: int, stop: int) -> None:
        """Writes the images of frames ``start`` to ``stop``."""
        folder = self.beside / self.folder
        folder.mkdir(parents=True, exist_ok=True)
        grey = self.folder in ("image_0", "image_1")
        for number in range(start, stop):
            picture = renderer.render(self.poses[number], number)
            picture = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if grey else picture
            rng = np.random.default_rng([self.options["seed"], zlib.crc32(self.name.encode()), 2, number])
            grain = rng.standard_normal(picture.shape, dtype=np.float32) * np.float32(GRAIN)
            picture = np.clip(picture + grain + np.float32(0.5), 0, 255).astype(np.uint8)
            file = folder / f"{number:06d}.png"
            _, data = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            with clear_errors(self.target / self.folder / file.name, beside=self.beside):
                file.write_bytes(data.tobytes())

    def finish(self) -> None:
        """Writes the text files and renames the folder: a drive that exists is complete.

        After a power failure an image may still be missing, for which the reader raises: syncing thousands of images
        would take as long as drawing them.
        """
        with clear_errors(self.target, beside=self.beside):
            self._finish()

    def _finish(self) -> None:
        camera, beside = self.camera, self.beside
        row = f"{camera.fx:.9e} 0 {camera.cx:.9e} 0 0 {camera.fy:.9e} {camera.cy:.9e} 0 0 0 1 0"
        (beside / "calib.txt").write_text("".join(f"P{k}: {row}\n" for k in range(4)))
        (beside / "times.txt").write_text("".join(f"{KITTI_DT * k:.6e}\n" for k in range(len(self.poses))))
        (beside / MARKER).write_text(json.dumps(self.options))
        for name in ("calib.txt", "times.txt", MARKER):
            sync(beside / name)
        write_poses(self.root / "poses" / f"{self.name}.txt", self.poses)
        if self.target.exists():
            shutil.rmtree(self.target)
        beside.rename(self.target)
        sync(self.target.parent)


def write(jobs: list[Job], processes: int, progress: Callable[[int], object] | None = None) -> None:
    """Draws and writes drives; the result does not depend on the number of processes.

    Args:
        jobs: the drives, all of one root.
        processes: number of parallel processes; 1 draws in this process.
        progress: called with the number of images that were written since the last call.

    Raises:
        OSError: if the folder cannot be written to.
    """
    if not jobs:
        return
    root = jobs[0].root
    with contextlib.ExitStack() as places:
        try:
            for folder in (root / "sequences", root / "poses"):
                folder.mkdir(parents=True, exist_ok=True)
            for job in jobs:
                job.beside = places.enter_context(place_beside(root / job.name))
                job.beside.mkdir()
        except OSError as error:
            raise OSError(f"cannot write to {root} ({error}); choose another folder") from error
        _write(jobs, processes, progress)


def _write(jobs: list[Job], processes: int, progress: Callable[[int], object] | None) -> None:
    stretch = min(STRETCH, REPORTED) if processes == 1 else STRETCH
    tasks = [
        (job, start, min(start + stretch, len(job.poses)))
        for job in jobs
        for start in range(0, len(job.poses), stretch)
    ]
    missing = {job.name: len(job.poses) for job in jobs}

    def done(job: Job, start: int, stop: int) -> None:
        missing[job.name] -= stop - start
        if not missing[job.name]:
            job.finish()
        if progress is not None:
            progress(stop - start)

    try:
        if processes == 1:
            for task in tasks:
                _draw(*task)
                done(*task)
            return
        # Not forked: a fork of a process with threads (PyTorch's, OpenCV's) can hang.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(min(processes, len(tasks)), context, initializer=_start_worker) as pool:
            waiting = {pool.submit(_draw, *task): task for task in tasks}
            try:
                for future in as_completed(waiting):
                    future.result()
                    done(*waiting[future])
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    finally:
        _last.clear()


_last: dict[Path, Renderer] = {}  # renderer of this process's drive, reused for the next chunk


def _start_worker() -> None:
    cv2.setNumThreads(1)
    follow_parent()


def _draw(job: Job, start: int, stop: int) -> None:
    if job.beside not in _last:
        _last.clear()
        _last[job.beside] = job.renderer()
    job.draw(_last[job.beside], start, stop)
