"""All pictures of a study's folder: videos and joints of the saved beliefs, paths, sizes of the ensemble."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from benchmarks.common.tables import pick
from benchmarks.ur5.pictures import draw_end_effector, draw_ensemble_size, draw_joints, draw_video
from benchmarks.ur5.study import rows_of


def draw_all(out: Path) -> Iterator[Path]:
    """Draws what a study left in its folder, into ``out/pictures``.

    Args:
        out: the study's ``--out``.

    Yields:
        Each file, when it is there.

    Raises:
        FileNotFoundError: if the folder holds no beliefs yet.
    """
    beliefs, folder = sorted((out / "beliefs").glob("*.npz")), out / "pictures"
    if not beliefs:
        raise FileNotFoundError(f"no beliefs in {out / 'beliefs'}; train and test a filter first, with --out {out}")
    folder.mkdir(exist_ok=True)
    for belief in beliefs:
        domain = "real_like" if "-real_like-" in belief.name else "sim"
        draw_joints(belief, folder / f"{belief.stem}-joints.png", belief.stem)
        yield folder / f"{belief.stem}-joints.png"
        draw_video(belief, folder / f"{belief.stem}.mp4", domain=domain)
        yield folder / f"{belief.stem}.mp4"
    for domain in ("sim", "real_like"):
        clean = [belief for belief in beliefs if f"-{domain}-clean-" in belief.name]
        if clean:
            draw_end_effector(clean, folder / f"{domain}-paths.png", [belief.stem for belief in clean])
            yield folder / f"{domain}-paths.png"
    rows = pick(rows_of(out), filter="denkf", domain="sim", training="sim", condition="clean")
    for sensor in {row["sensor"] for row in rows}:
        own = pick(rows, sensor=sensor)
        if len({row["ensemble_size"] for row in own}) > 1:
            draw_ensemble_size(own, folder / f"{sensor}-ensemble_size.png")
            yield folder / f"{sensor}-ensemble_size.png"
