"""The command line of the study: ``python -m benchmarks.odometry --help``."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd
import torch

from benchmarks.common.arguments import command, parse
from benchmarks.common.tables import head, line, report
from torch_denkf.applications.car import write_drives
from torch_denkf.applications.car.kitti.clock import read_times
from torch_denkf.applications.car.kitti.drive import choose_camera, list_kitti_drives
from torch_denkf.applications.car.kitti.files import read_poses
from torch_denkf.applications.car.metrics.devkit import kitti_devkit_error
from torch_denkf.applications.car.metrics.odometry import kitti_endpoint_error
from torch_denkf.applications.car.odometry.images import read_frames
from torch_denkf.applications.car.odometry.paths import read_path
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.applications.car.vision.poses import poses_to_state
from torch_denkf.cli.main import main as denkf
from torch_denkf.deployment.files import write_text

WINDOW = 100  # steps of an end point error; half of a shorter drive
ERRORS = ["translation_m_per_m", "rotation_deg_per_m"]
COLUMNS = ("drive", "height_m", "frames", "window", *ERRORS, "devkit_percent", "devkit_deg_per_100m", "scale")


@dataclass(frozen=True)
class Study:
    """Runs ``denkf odometry`` on drives with known paths, with the right height of the camera and with wrong ones."""

    root: Path | None = None  # folder with sequences and poses
    out: Path = Path("runs/odometry")
    drives: tuple[str, ...] = ()  # by default all drives in the folder
    heights: tuple[float, ...] = (KITTI_HEIGHT, 1.4, 2.0)  # m; KITTI's is 1.65
    checkpoint: Path | None = None  # a folder of denkf train; by default the weights that come with the package
    smoke: bool = False  # a tiny run on a rendered drive


def track(study: Study, root: Path, drive: str, height: float) -> dict:
    """Runs the command once, and returns its errors."""
    folder = root / "sequences" / drive
    camera = choose_camera(folder, None)
    out, images = study.out / f"{drive}-{height:g}", read_frames(folder / camera)
    poses = read_poses(root / "poses" / f"{drive}.txt")
    clock = read_times(folder / "times.txt", len(poses))  # of the whole sequence; only a part may have images
    stamps = study.out / f"{drive}.txt"
    write_text(stamps, "".join(f"{time}\n" for time in clock.times[images.first : images.first + images.count]))
    words: list[str] = [str(folder / camera), "--calibration", str(folder / "calib.txt"), "--camera", camera]
    words += ["--times", str(stamps), "--height", f"{height:g}", "--out", str(out), "--no-pictures"]
    if study.checkpoint is not None:
        words += ["--checkpoint", str(study.checkpoint)]
    if denkf(["odometry", *words]) != 0:
        raise SystemExit(f"denkf odometry {' '.join(words)} failed")
    path = read_path(out / "path.csv")
    truth = torch.from_numpy(poses_to_state(poses, clock.dt[1:]))[path["frame"].squeeze(-1)][:, :3]
    believed = path["belief", "mean"][:, :3]
    window = WINDOW if len(truth) > WINDOW else (len(truth) - 1) // 2
    error = kitti_endpoint_error(believed, truth, window=window)
    way = (truth[1:, :2] - truth[:-1, :2]).norm(dim=-1).sum()
    row = {
        "drive": drive,
        "height_m": height,
        "frames": len(truth),
        "window": window,
        "translation_m_per_m": float(error.translation),
        "rotation_deg_per_m": float(error.rotation),
        "scale": float((believed[1:, :2] - believed[:-1, :2]).norm(dim=-1).sum() / way),
    }
    if way > 100:
        devkit = kitti_devkit_error(believed, truth)
        row |= {"devkit_percent": float(devkit.translation), "devkit_deg_per_100m": 100 * float(devkit.rotation)}
    return row


def page(rows: Sequence[dict]) -> str:
    """Returns a table of all drives at the first height, and the means at each height."""
    table = pd.DataFrame(rows, columns=COLUMNS)
    table["devkit"] = table["devkit_percent"].map("{:.2f}".format).replace("nan", "")
    table["devkit_turn"] = table["devkit_deg_per_100m"].map("{:.2f}".format).replace("nan", "")
    first = table["height_m"][0]
    lines = [f"`{command('odometry')}`", "", f"Camera {first:g} m over the road, as it is:", ""]
    lines += head("drive", "frames", "window", "m/m", "deg/m", "devkit, %", "deg/100 m", "length / true")
    for row in table[table["height_m"] == first].itertuples():
        errors = f"{row.translation_m_per_m:.3f}", f"{row.rotation_deg_per_m:.3f}"
        cells = (row.drive, row.frames, row.window, *errors, row.devkit, row.devkit_turn, f"{row.scale:.3f}")
        lines.append(line(*cells))
    lines += ["", "A height that is guessed wrong scales the path; means and medians over the drives:", ""]
    lines += head("height given, m", "m/m, mean", "m/m, median", "deg/m, mean", "deg/m, median", "length / true")
    for height, some in table.groupby("height_m", sort=False):
        numbers = [*some[ERRORS].agg(["mean", "median"]).T.stack(), some["scale"].mean()]
        lines.append(line(f"{height:g}", *(f"{number:.3f}" for number in numbers)))
    return "\n".join(lines) + "\n"


def main() -> None:
    """Runs the study."""
    study = parse(Study)
    if study.smoke:
        root = Path(tempfile.mkdtemp(prefix="odometry-"))
        write_drives(root, ["town"], frames=12, size=(100, 300))
        study = replace(study, root=root, out=root / "out", heights=study.heights[:2])
    if study.root is None:
        raise SystemExit("--root is missing: the folder with 'sequences' and 'poses' (or --smoke)")
    drives = study.drives or list_kitti_drives(study.root)
    rows = [track(study, study.root, drive, height) for height in study.heights for drive in drives]
    report(study.out, rows, page(rows), "odometry", ("height_m", "drive"), COLUMNS)


if __name__ == "__main__":
    main()
